// Waiting, in words, for a service that was just started and loads or compiles its kernels; opens no session.

import { whole } from "./numbers.js";
import { readiness } from "./service.js";

const LOOK_MS = 1000;

// What the service is at, for people; `preparing` is null at the very beginning.
export function preparingSaid(preparing) {
  if (preparing === null) return "The service is starting…";
  const { what, step, of, seconds, compiles } = preparing;
  const how = compiles ? "It compiles what it reckons with, which takes a minute or two, once after an installation" : "It loads what it reckons with";
  return `The service is starting. ${how}: ${what}, step ${step} of ${of}, ${whole(Math.floor(seconds))} s so far.`;
}

// Resolves as soon as sessions can be opened, or when the service does not answer, which is for others to tell.
export async function untilReady(say, look = readiness, pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms))) {
  for (;;) {
    const { checks, preparing } = await look().catch(() => ({ checks: { kernels: true } }));
    if (checks.kernels) return;
    say(preparingSaid(preparing));
    await pause(LOOK_MS);
  }
}
