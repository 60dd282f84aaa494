// Puts the page together: which part is told what, and when; every rule lives in the part that it calls.

import { FileBringer } from "./bringing.js";
import { byId, element } from "./element.js";
import { ExportMenu } from "./exports.js";
import { freeAreas } from "./free_areas.js";
import { drawRuler, drawTriad } from "./gauges.js";
import { untilReady } from "./getting_ready.js";
import { Guide } from "./guide.js";
import { InterestBox } from "./interest_box.js";
import { listenToKeys } from "./keyboard.js";
import { drawLegend } from "./legend.js";
import { Look } from "./look.js";
import { opening as capitalised, whole, words } from "./numbers.js";
import { drawFigures, drawInspector, drawLosses, drawRegions } from "./panels.js";
import { JudgingNote } from "./judging_note.js";
import { NominalPart } from "./nominal_part.js";
import { PassArrow } from "./pass_arrow.js";
import { PassesPanel } from "./passes_panel.js";
import { pickPoint } from "./picking.js";
import { PointCloud } from "./point_cloud.js";
import { RegionOverlay } from "./region_overlay.js";
import { RequirementPanel } from "./requirement_panel.js";
import { SceneView } from "./scene_view.js";
import { listSessions, pauseSession, resumeSession, startSession, stopSession } from "./service.js";
import { SessionPicker } from "./session_picker.js";
import { OVER, SessionView } from "./session_view.js";

const TROUBLE_MS = 15000;
const SURVEY_MS = 1000;
const CLICK_SLACK_PX = 4;

let chosenRegion = null;
let inspectedRow = -1;
let connectionState = "none";
let frames = 0;
let ordered = null; // the order that is waited for, or carried out
let troubled = { text: "", until: 0 };

const session = new SessionView({ points, status, regions, opening, connection, trouble });
const view = openView();
const cloud = new PointCloud(session.store);
const overlay = new RegionOverlay(byId("labels"), chooseRegion);
const interest = new InterestBox();
const marker = element("div.marker", { hidden: true, "aria-hidden": "true" });
byId("view").append(marker);
view.scene.add(cloud.object, overlay.group, interest.object);
const look = new Look({ onChange: applyLook, measure: (range) => session.densityRange(range) });

const arrow = new PassArrow();
view.scene.add(arrow.object);
const guide = new Guide(byId("guide"), (share) => {
  arrow.at(share);
  view.invalidate();
});
const passes = new PassesPanel({ trouble, scanned: () => session.renew(), onOrder: followOrder, onPass: (pass) => showPass(pass ?? ordered?.pass ?? null) });
const judging = new JudgingNote(() => session.regions);
const awaiting = {
  onAsked: () => judging.ask(),
  onJudging: (told) => judging.status(told),
  onRefused: () => judging.open(),
  onJudged: () => {
    judging.answered();
    if (connectionState === "finished") session.renew(); // nothing more comes by itself
  },
};
const requirement = new RequirementPanel({ onInterest: showInterest, partBox, ...awaiting });
const nominal = new NominalPart(awaiting);
const exports = new ExportMenu(byId("export-links"), byId("exports"));
const picker = new SessionPicker({ onChoose: openSession, onMissing: (text) => notice(text), current: () => session.id });
new FileBringer({
  onSession: (made) => {
    byId("sessions").close();
    openSession(made);
  },
  onMesh: (name) => (session.id ? nominal.use(name) : trouble("Open a session first: a nominal part is measured against in a session.")),
  onNews: (text) => (text ? notice(text) : explainEmptiness()),
  onRefusal: (text) => {
    byId("sessions").close();
    trouble(text);
  },
});

function openView() {
  try {
    return new SceneView(byId("canvas"), { beforeDraw, afterDraw, freeAreas });
  } catch (error) {
    notice("This browser shows no WebGL 2, which the point cloud needs. Figures, regions and exports still work elsewhere.");
    throw error;
  }
}

// --- what arrives ---------------------------------------------------------------------------------------------------

function points() {
  explainEmptiness();
  view.invalidate();
}

function explainEmptiness() {
  const state = session.status?.state;
  if (session.store.end > 0) notice("");
  else if (session.startable) notice("Not scanning. Start begins the scan.");
  else if (OVER.has(state)) notice("No point was scanned in this session.");
  else notice("Waiting for the first points…");
}

function status() {
  const { status: told } = session;
  const state = byId("session-state");
  const isEnding = told.judging?.why === "scan_ended";
  state.hidden = false;
  state.textContent = isEnding ? "judging" : words(told.state);
  state.dataset.state = told.state;
  byId("stop").hidden = OVER.has(told.state) || told.state === "created" || isEnding;
  byId("start").hidden = !session.startable;
  byId("pause").hidden = told.state !== "scanning" || !told.can_pause || isEnding;
  byId("resume").hidden = told.state !== "paused" || !told.held;
  byId("start").textContent = told.state === "created" ? "Start" : "Go on";
  byId("stop-note").hidden = byId("stop").hidden;
  explainEmptiness();
  const progress = byId("progress");
  progress.hidden = told.progress === null || told.progress === undefined;
  if (!progress.hidden) progress.value = told.progress;
  progress.dataset.state = told.state;
  say();
  drawFigures(byId("figures"), told, session.store, session.box);
  drawLosses(byId("losses"), byId("losses-count"), told.losses);
  judging.status(told);
  requirement.status(told);
  nominal.status(told);
  passes.status(told);
}

// The service builds the map of a closed session from the record, line by line.
function opening({ lines, of, progress: share }) {
  notice(`Opening from the record: ${whole(lines)} of ${whole(of)} scanlines`);
  const progress = byId("progress");
  progress.hidden = false;
  progress.value = share;
  progress.dataset.state = "opening";
}

function regions() {
  const list = session.regions ?? [];
  if (session.status) judging.status(session.status);
  overlay.show(list, session.origin, view.radius);
  overlay.choose(chosenRegion);
  drawRegions(byId("regions"), byId("regions-count"), session.regions, chosenRegion, chooseRegion, session.status);
  legend();
  view.invalidate();
}

function connection({ state, seconds, attempt, reason }) {
  connectionState = state;
  const texts = {
    connecting: attempt ? "Connecting again…" : "Connecting…",
    open: "Live",
    quiet: `No word from the service for ${seconds} s`,
    waiting: `Connection lost. Trying again in ${Math.max(1, Math.round(seconds))} s`,
    finished: "Finished",
    absent: "No such session",
    closed: "Closed",
  };
  byId("connection").dataset.state = state;
  byId("connection-text").textContent = texts[state] ?? state;
  byId("connection").title = reason || "";
  byId("retry").hidden = state !== "waiting";
  document.body.classList.toggle("stale", state === "waiting" || state === "connecting" || state === "quiet");
  if (state === "open") trouble("");
  if (state === "absent") notice(reason || "There is no such session.");
  if (state === "waiting") listSessions().catch((refusal) => trouble(refusal.message)); // it may say why
}

// Stays in sight before what the status says, for a while or until the connection is mended.
function trouble(text) {
  troubled = { text, until: performance.now() + TROUBLE_MS };
  say();
}

// --- the picture ----------------------------------------------------------------------------------------------------

function followOrder(order) {
  ordered = order;
  showPass(order?.pass ?? null);
  guide.follow(session.id, order?.status === "running" && session.status?.source?.kind === "push" ? order : null);
}

function showPass(pass) {
  arrow.show(pass, session.origin, pass && servedMiddle(pass));
  view.invalidate();
}

// The middle of the regions that a pass serves, relative to the origin; of all points where it serves none that is listed.
function servedMiddle(pass) {
  const served = new Set(pass.serves.map(({ region }) => region));
  const centres = (session.regions ?? []).filter(({ id }) => served.has(id)).map(({ centroid_mm: at }) => at.map((value, axis) => value - session.origin[axis]));
  if (!centres.length && session.box) centres.push([...session.box.low], [...session.box.high]);
  return centres.length ? [0, 1, 2].map((axis) => centres.reduce((sum, centre) => sum + centre[axis], 0) / centres.length) : null;
}

function showInterest(box) {
  interest.show(box, session.origin);
  view.invalidate();
}

// How far the points reach, part frame: [lowest, highest] corner, or null before there are any.
function partBox() {
  return session.box ? [session.box.low, session.box.high].map((corner) => [...corner].map((value, axis) => value + session.origin[axis])) : null;
}

function beforeDraw() {
  cloud.upload();
  cloud.pointPx = Math.min(9, Math.max(1.6, 1.5 * session.spacingMm * view.pixelsPerMm)) * look.pointScale * view.renderer.getPixelRatio();
  overlay.follow(view);
}

function afterDraw() {
  frames += 1;
  session.drawn();
  drawTriad(byId("triad"), view.camera);
  drawRuler(byId("ruler-text"), byId("ruler-bar"), view.pixelsPerMm);
  marker.hidden = inspectedRow < 0;
  if (inspectedRow < 0) return;
  const at = view.project(session.store.xyz.subarray(3 * inspectedRow, 3 * inspectedRow + 3));
  marker.style.transform = `translate(${at.x.toFixed(1)}px, ${at.y.toFixed(1)}px)`;
}

function survey() {
  if (!session.survey()) return;
  look.survey();
  applyLook();
  if (session.box) view.setBox(session.box); // behind the legend's drawing: its size says where there is room
  drawFigures(byId("figures"), session.status, session.store, session.box);
  inspect(inspectedRow);
}

function applyLook() {
  [cloud.rule, cloud.scale, cloud.range] = [look.rule, look.scale, look.range];
  if (session.box) cloud.heightRange = [session.box.low[2], session.box.high[2]];
  look.show();
  legend();
  view.invalidate();
}

function legend() {
  if (!session.box) return;
  const height = look.rule === "height";
  const range = height ? [session.box.low[2] + session.origin[2], session.box.high[2] + session.origin[2]] : look.range;
  drawLegend(byId("legend"), { rule: look.rule, scale: look.scale, range, sample: height ? [] : session.sample, required: session.requiredPerMm2 });
}

// --- what the user does ---------------------------------------------------------------------------------------------

function openSession(chosen) {
  byId("session-name").textContent = chosen.name || chosen.id;
  document.title = `${chosen.name || chosen.id} – scan viewer`;
  byId("session-state").hidden = true;
  for (const id of ["start", "pause", "resume", "stop"]) byId(id).hidden = true;
  history.replaceState(null, "", `?session=${encodeURIComponent(chosen.id)}`);
  chosenRegion = null;
  inspect(-1);
  trouble("");
  view.touched = false;
  look.begin();
  session.open(chosen.id);
  passes.open(chosen.id);
  judging.open();
  requirement.open(chosen.id);
  nominal.open(chosen.id);
  explainEmptiness();
  overlay.show([], session.origin, view.radius);
  drawFigures(byId("figures"), null, session.store, null);
  drawLosses(byId("losses"), byId("losses-count"), null);
  drawRegions(byId("regions"), byId("regions-count"), null, null, chooseRegion);
  byId("legend").hidden = true;
  byId("exports").hidden = false;
  exports.open(chosen.id);
  view.invalidate();
}

function chooseRegion(number) {
  const region = session.regions?.find((candidate) => candidate.id === number);
  if (!region) return;
  chosenRegion = number;
  overlay.choose(number);
  drawRegions(byId("regions"), byId("regions-count"), session.regions, chosenRegion, chooseRegion, session.status);
  byId("regions").querySelector("[aria-pressed=true]")?.scrollIntoView({ block: "nearest" });
  const local = (point) => point.map((value, axis) => value - session.origin[axis]);
  const corners = [region.centroid_mm, ...(region.outline_mm ?? []).flat()].map(local);
  const ends = (end) => [0, 1, 2].map((axis) => end(...corners.map((corner) => corner[axis])));
  view.inspect(local(region.centroid_mm), { low: ends(Math.min), high: ends(Math.max) }, region.normal);
}

function inspect(row) {
  inspectedRow = row < session.store.end ? row : -1;
  drawInspector(byId("inspector"), session.store, inspectedRow, session.origin, () => inspect(-1));
  view.invalidate();
}

function clear() {
  inspect(-1);
  chosenRegion = null;
  overlay.choose(null);
  drawRegions(byId("regions"), byId("regions-count"), session.regions, null, chooseRegion, session.status);
}

function rowUnder(event) {
  const frame = view.canvas.getBoundingClientRect();
  return pickPoint(session.store, view.clipFromPart(), view.width, view.height, event.clientX - frame.left, event.clientY - frame.top);
}

function say() {
  const trouble = performance.now() < troubled.until && troubled.text;
  const text = capitalised(trouble || session.status?.message || "");
  const place = byId("message");
  place.hidden = !text;
  place.dataset.kind = trouble ? "trouble" : (session.status?.state ?? "");
  if (place.textContent !== text) place.textContent = text;
}

function notice(text) {
  if (byId("notice").textContent !== text) byId("notice").textContent = text;
}

async function command(button, act) {
  button.disabled = true;
  try {
    await act(session.id);
    trouble("");
  } catch (refusal) {
    trouble(refusal.message);
  }
  button.disabled = false;
}

function listen() {
  let down = null;
  view.canvas.addEventListener("pointerdown", (event) => {
    down = event.button === 0 ? event : null;
  });
  view.canvas.addEventListener("pointerup", (event) => {
    if (down && Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) < CLICK_SLACK_PX) inspect(rowUnder(event));
    down = null;
  });
  view.canvas.addEventListener("dblclick", (event) => {
    const row = rowUnder(event);
    if (row >= 0) view.focus(session.store.xyz.slice(3 * row, 3 * row + 3));
  });
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => (button.dataset.view === "fit" ? view.fit() : view.look(button.dataset.view)));
  }
  byId("show-regions").addEventListener("change", (event) => {
    overlay.visible = event.target.checked;
    view.invalidate();
  });
  byId("shaded").addEventListener("change", (event) => {
    cloud.shaded = event.target.checked;
    view.invalidate();
  });
  byId("start").addEventListener("click", (event) => command(event.currentTarget, startSession));
  byId("pause").addEventListener("click", (event) => command(event.currentTarget, pauseSession));
  byId("resume").addEventListener("click", (event) => command(event.currentTarget, resumeSession));
  byId("stop").addEventListener("click", (event) => command(event.currentTarget, stopSession));
  byId("retry").addEventListener("click", () => session.retryNow());
  addEventListener("online", () => session.retryNow());
  document.addEventListener("visibilitychange", () => document.hidden || session.retryNow()); // such as after signing in elsewhere
  document.addEventListener("pointerdown", (event) => {
    for (const menu of document.querySelectorAll("details.menu[open]")) if (!menu.contains(event.target)) menu.open = false;
  });
  listenToKeys(view, { openSessions: () => picker.show(), clear });
  setInterval(survey, SURVEY_MS);
}

// Numbers for tests and the curious; nothing can be changed through it.
globalThis.viewer = Object.freeze({
  get session() { return session.id ?? null; },
  get points() { return session.store.received; },
  get total() { return session.store.total; },
  get version() { return session.store.version; },
  get skipped() { return session.store.skipped; },
  get capacity() { return session.store.capacity; },
  get uploadedRows() { return cloud.uploadedRows; },
  get regions() { return session.regions?.length ?? 0; },
  get outlined() { return overlay.outlined; },
  get connection() { return connectionState; },
  get flying() { return view.flight !== null; },
  get frames() { return frames; },
  get inspected() { return inspectedRow; },
  get densityRange() { return [...look.range]; },
  get middle() { return view.middle; },
  get target() { return view.controls.target.toArray(); },
  get eye() { return view.camera.position.toArray(); },
});

listen();
drawFigures(byId("figures"), null, session.store, null);
applyLook();
untilReady(notice).then(() => session.id ?? picker.begin(new URLSearchParams(location.search).get("session")));
