// What a page that was just opened does: waits for a service that is not ready, in words, and chooses a session.

import assert from "node:assert/strict";
import { test } from "node:test";

const { preparingSaid, untilReady } = await import("../../../scanner_service/web/static/getting_ready.js");
const { firstChoice } = await import("../../../scanner_service/web/static/session_picker.js");

const session = (id, state, lines, minute) => ({ id, state, lines, created: `2026-11-26T10:0${minute}:00Z` });

test("a page opens what scans, else the newest scan that has lines, else what there is", () => {
  const old = session("old", "stopped", 90, 1);
  const finished = session("finished", "stopped", 70, 2);
  const scans = session("scans", "paused", 0, 3);
  const empty = session("empty", "created", 0, 4);
  assert.equal(firstChoice([empty, scans, finished, old]).id, "scans");
  assert.equal(firstChoice([old, empty, finished]).id, "finished");
  assert.equal(firstChoice([empty]).id, "empty");
  assert.equal(firstChoice([]), null);
});

test("until the service is ready it is said what it is at; one that does not answer is not waited for", async () => {
  const preparing = { what: "the live map", step: 2, of: 4, seconds: 18.4, compiles: true };
  const answers = [{ checks: { kernels: false }, preparing: null }, { checks: { kernels: false }, preparing }, { checks: { kernels: true }, preparing: null }];
  const said = [];
  await untilReady((text) => said.push(text), async () => answers.shift(), async () => {});
  assert.deepEqual(said, [preparingSaid(null), preparingSaid(preparing)]);
  assert.match(said[1], /compiles .* once after an installation: the live map, step 2 of 4, 18 s so far/);
  assert.doesNotMatch(preparingSaid({ ...preparing, compiles: false }), /compil/);
  await untilReady(assert.fail, async () => { throw new Error("nobody is there"); });
});
