// The service's REST answers, as this page needs them; shows nothing.

// What the service refused, in its own words (problem details), with the HTTP status; 0 when it did not answer.
export class ServiceRefusal extends Error {
  constructor(status, detail, body = null) {
    super(detail);
    this.status = status;
    this.body = body; // the problem document, which may name fields
  }
}

const address = (path) => new URL(path, document.baseURI).href; // relative: the page may live under a prefix

async function answer(path, options) {
  let response;
  try {
    response = await fetch(address(path), { credentials: "same-origin", headers: { accept: "application/json" }, ...options });
  } catch {
    throw new ServiceRefusal(0, "The service does not answer. Is it running?");
  }
  const body = await response.json().catch(() => null);
  if (response.ok) return body;
  if (response.status === 401) throw new ServiceRefusal(401, "Not signed in. A one-time address holds once and for ten minutes: `scanner open` gives a fresh one.");
  throw new ServiceRefusal(response.status, body?.detail ?? body?.title ?? `The service answered ${response.status}.`, body);
}

const sessionPath = (id, rest) => `api/v1/sessions/${encodeURIComponent(id)}/${rest}`;

// {checks, preparing}: whether sessions can be opened, and what is still being done for that.
export const readiness = () =>
  answer("readyz").catch((refusal) => {
    if (refusal.status === 503 && refusal.body?.checks) return refusal.body;
    throw refusal;
  });

// {sessions, next}: one page of sessions; `next` goes into `after` for the following page, null when there is none.
export const listSessions = (after = null) => answer(`api/v1/sessions${after === null ? "" : `?after=${encodeURIComponent(after)}`}`);

export const createSession = (name, source) => send("api/v1/sessions", { name, source });

// Brings a file to the service; `onShare` hears how much of it is there, from 0 to 1. {name, bytes, kind}.
export function bringFile(file, onShare) {
  const sent = new XMLHttpRequest(); // fetch does not tell how far it is
  return new Promise((resolve, reject) => {
    sent.open("PUT", address(`api/v1/files/${encodeURIComponent(file.name)}`));
    sent.responseType = "json";
    sent.setRequestHeader("accept", "application/json");
    sent.setRequestHeader("content-type", "application/octet-stream");
    sent.upload.addEventListener("progress", (event) => onShare(event.total ? event.loaded / event.total : 0));
    sent.addEventListener("error", () => reject(new ServiceRefusal(0, "The service ended the transfer: the file may be too large, or it is not running.")));
    sent.addEventListener("load", () => (sent.status < 300 ? resolve(sent.response) : reject(new ServiceRefusal(sent.status, sent.response?.detail ?? sent.response?.title ?? `The service answered ${sent.status}.`))));
    sent.send(file);
  });
}

export const startSession = (id) => answer(sessionPath(id, "start"), { method: "POST" });

export const stopSession = (id) => answer(sessionPath(id, "stop"), { method: "POST" });

export const listPasses = (id) => answer(sessionPath(id, "recommended-passes"));

export const listOrders = (id) => answer(sessionPath(id, "pass-orders"));

export const loopState = (id) => answer(sessionPath(id, "rescan"));

const send = (path, body, method = "POST") => answer(path, { method, headers: { accept: "application/json", "content-type": "application/json" }, body: JSON.stringify(body) });

// {presets: {name: requirement}}, from the loosest to the finest.
export const listPresets = () => answer("api/v1/sessions/presets");

// Ask for something else; answered when everything is judged anew: {requirement, holds, coverage}.
export const askFor = (id, requirement) => send(sessionPath(id, "requirement"), requirement, "PUT");

const LOOK_MS = 500;

// What `request` answers; `onStatus` hears the session's status meanwhile and once more at its end, also where nothing is streamed any more.
export async function whileJudged(id, request, onStatus) {
  let isAnswered = false;
  const look = (isLast) =>
    answer(`api/v1/sessions/${encodeURIComponent(id)}`).then((told) => {
      if (isLast || !isAnswered) onStatus(told); // what was under way when the answer came is of before
    }, () => {});
  const watch = async () => {
    while (!isAnswered) {
      await look(false);
      await new Promise((resolve) => setTimeout(resolve, LOOK_MS));
    }
  };
  watch();
  try {
    return await request;
  } finally {
    isAnswered = true;
    await look(true);
  }
}

// Measure coverage against a mesh in the service's folder, or against the surface seen when `file` is null.
export const measureAgainst = (id, file, units) => (file === null ? answer(sessionPath(id, "reference"), { method: "DELETE" }) : send(sessionPath(id, "reference"), { file, units }, "PUT"));

// `plan` is the one in which the pass is shown: refused when another is in force.
export const acceptPass = (id, number, plan) => send(sessionPath(id, `recommended-passes/${number}/accept`), { plan });

export const cancelOrder = (id, order) => answer(sessionPath(id, `pass-orders/${order}`), { method: "DELETE" });

// Take what an order has scanned out of the map; answered when all is judged anew.
export const withdrawOrder = (id, order) => answer(sessionPath(id, `pass-orders/${order}/withdraw`), { method: "POST" });

// Count what a doubted order has brought after all.
export const keepOrder = (id, order) => answer(sessionPath(id, `pass-orders/${order}/keep`), { method: "POST" });

// Where the scanner is beside a pass that a hand scans: {along_mm, aside_mm, angle_deg, speed_mm_per_s, wanted_mm_per_s, say}.
export const guidanceOf = (id, order) => answer(sessionPath(id, `pass-orders/${order}/guidance`));

export const carryOut = (id, order, turned) => send(sessionPath(id, `pass-orders/${order}/carry-out`), { part_is_turned: turned });

export const startLoop = (id) => send(sessionPath(id, "rescan"), {});

export const endLoop = (id) => answer(sessionPath(id, "rescan"), { method: "DELETE" });
export const pauseSession = (id) => answer(sessionPath(id, "pause"), { method: "POST" });

export const resumeSession = (id) => answer(sessionPath(id, "resume"), { method: "POST" });

// `confirm` is the id once more: the service deletes nothing without it.
export const deleteSession = (id) => answer(`api/v1/sessions/${encodeURIComponent(id)}?confirm=${encodeURIComponent(id)}`, { method: "DELETE" });

const JSON_BODY = { "content-type": "application/json" };

// {formats, exports}: what can be written, and what was.
export const listExports = (id) => answer(sessionPath(id, "exports"));

export const orderExport = (id, formats) => answer(sessionPath(id, "exports"), { method: "POST", headers: { accept: "application/json", ...JSON_BODY }, body: JSON.stringify({ formats }) });

export const getExport = (id, job) => answer(sessionPath(id, `exports/${encodeURIComponent(job)}`));

export const fileAddress = (id, job, file) => address(sessionPath(id, `exports/${encodeURIComponent(job)}/files/${encodeURIComponent(file)}`));

export const exportAddress = (id, file) => address(sessionPath(id, `export/${file}`));

export function liveAddress(id) {
  const url = new URL(address(sessionPath(id, "live")));
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  return url.href;
}
