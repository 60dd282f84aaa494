// The text beside the picture: figures, losses, regions, the inspected point; asks the service for nothing.

import { element } from "./element.js";
import { lineSample } from "./legend.js";
import { accounts, headline } from "./loss_ledger.js";
import { fixed, missing, percent, plural, sentence, significant, whole, words } from "./numbers.js";
import { reasonByKey, RESCAN_REASONS, rescanReason, STATE_ISOLATED, STATE_NOT_COUNTED, STATE_RELIABLE, STATE_RESCAN, STATE_SETTLED, UNRELIABLE_REASONS, unreliableReason } from "./stream_format.js";

const figure = (name, value, unit = null) => element("div", {}, element("dt", {}, name), element("dd", {}, value, unit === null ? null : element("span.unit", {}, unit)));

export const UNDER_WAY = new Set(["scanning", "paused"]);

// Nobody knows of the surface that a scan has still to come to, unless there is a nominal part.
export function coverageName(status) {
  if (status?.coverage_kind === "reference") return "Coverage of the nominal part";
  return UNDER_WAY.has(status?.state) ? "Coverage so far" : "Observed coverage";
}

export function noRegions(status) {
  if (UNDER_WAY.has(status?.state)) return "No region of the surface seen so far needs another scan.";
  return status?.coverage === null ? "Nothing was judged." : "No region needs another scan."; // such as where all lies outside of what is of interest
}

export function drawFigures(place, status, store, box) {
  const size = box ? box.high.map((high, axis) => significant(high - box.low[axis])).join(" × ") : "–";
  place.replaceChildren(
    figure("Lines", whole(status?.lines)),
    figure("Points", whole(status?.points ?? (store.total || null))),
    figure("Rate", whole(status?.points_per_s), missing(status?.points_per_s) ? null : "points/s"),
    figure(coverageName(status), percent(status?.coverage)),
    figure("Extent x × y × z", size, box ? "mm" : null),
    status?.state === "scanning" && !missing(status.verdict_age_s) ? figure("Verdict", whole(status.verdict_age_s), "s old") : "",
    store.skipped > 0 ? figure("Updates merged", whole(store.skipped)) : "",
  );
}

export function drawLosses(place, count, losses) {
  count.textContent = headline(losses);
  count.classList.toggle("lost", losses !== null && count.textContent !== "nothing lost");
  const tally = ({ title, unit, total, rows }) => {
    const share = (value) => (total > 0 && value > 0 ? element("span.unit", {}, percent(value / total)) : null);
    const some = rows.filter(([, value, kind]) => value > 0 || kind === "kept");
    const none = rows.filter((entry) => !some.includes(entry)).map(([name]) => name.toLowerCase());
    return element(
      "section.tally-group",
      {},
      element("h3", {}, title, total === null ? null : element("span", {}, whole(total), element("span.unit", {}, unit))),
      element("dl.tally", {}, ...some.flatMap(([name, value, kind]) => [element(`dt.${kind}`, {}, name), element(`dd.${kind}`, {}, share(value), " ", whole(value))])),
      none.length ? element("p.none", {}, `None: ${none.join(", ")}`) : null,
    );
  };
  place.replaceChildren(...(losses ? accounts(losses).map(tally) : [element("p.empty", {}, "Not known yet.")]));
}

// How far a limit is met, 0 to 1: of a density what there is of what is needed, of all else what is allowed of what there is.
function shareOf({ measured, required, bound }) {
  const [part, whole] = bound === "at most" ? [required, measured] : [measured, required];
  return whole > 0 ? Math.min(1, part / whole) : 0;
}

export function drawRegions(place, count, regions, chosen, onChoose, status = null) {
  count.textContent = regions === null ? "" : whole(regions.length);
  if (!regions?.length) {
    place.replaceChildren(element("li.empty", {}, regions === null ? "Not known yet." : noRegions(status)));
    return;
  }
  const item = (region, said) => {
    const reason = reasonByKey(region.reason);
    const limit = region.limit ?? { measured: region.measured_per_mm2, required: region.required_per_mm2, unit: "points/mm²", bound: "at least", text: null };
    const share = shareOf(limit);
    return element(
      "li",
      { "data-said": said },
      element(
        "button.region",
        { type: "button", "aria-pressed": String(region.id === chosen), onclick: () => onChoose(region.id), title: region.remedy ? `Remedy: ${region.remedy}` : null },
        element("span.number", {}, String(region.id)),
        element("span.reason", {}, sentence(reason.text), lineSample(reason)),
        element("span.area", {}, significant(region.area_mm2), element("span.unit", {}, "mm²")),
        element("span.density", { title: limit.text }, `${significant(limit.measured)}, ${limit.bound === "at most" ? "≤" : "≥"} ${significant(limit.required)}`, element("span.unit", {}, limit.unit)),
        element("span.priority", {}, "priority ", significant(region.priority, 2)),
        region.status && region.status !== "open" ? element(`span.status.${region.status}`, { title: region.history?.at(-1)?.why ?? null }, region.status) : null,
        element("meter", { min: 0, max: 1, value: share, "aria-label": "how far what is required is met" }),
        region.remedy ? element("span.remedy", {}, region.remedy) : null,
      ),
    );
  };
  // an entry that says the same stays the same element: a click that is under way while the list is renewed still counts
  const said = (region) => JSON.stringify([region.id === chosen, { ...region, outline_mm: null, centroid_mm: null, normal: null }]);
  const old = new Map([...place.children].map((entry) => [entry.dataset.said, entry]));
  const focused = place.contains(document.activeElement) ? [...place.querySelectorAll("button")].indexOf(document.activeElement) : -1;
  const scrolled = place.scrollTop;
  const entries = regions.map((region) => old.get(said(region)) ?? item(region, said(region)));
  if (entries.length !== place.children.length || entries.some((entry, i) => entry !== place.children[i])) place.replaceChildren(...entries);
  place.scrollTop = scrolled;
  if (focused >= 0) place.querySelectorAll("button")[Math.min(focused, regions.length - 1)].focus();
}

export function drawInspector(place, store, row, origin, onClose) {
  place.hidden = row < 0 || row >= store.end;
  if (place.hidden) return;
  const state = store.state[row];
  const reliable = (state & STATE_RELIABLE) !== 0;
  const triple = (array, digits, shift) => [0, 1, 2].map((axis) => fixed(array[3 * row + axis] + shift[axis], digits));
  const said = [
    reliable ? "reliable" : `unreliable: ${UNRELIABLE_REASONS[unreliableReason(state)] ?? `reason ${unreliableReason(state)}`}`,
    state & STATE_SETTLED ? "settled" : "not settled yet",
    state & STATE_ISOLATED ? "isolated" : null,
    state & STATE_NOT_COUNTED ? "not counted" : null,
  ].filter(Boolean);
  const rescan = state & STATE_RESCAN ? (RESCAN_REASONS[rescanReason(state)]?.text ?? `reason ${rescanReason(state)}`) : "no";
  const vector = (values) => element("span.vector", {}, ...values.map((value, axis) => element("span", {}, element("i", {}, "xyz"[axis]), value)));
  const line = (name, ...value) => [element("dt", {}, name), element("dd", {}, ...value)];
  const density = store.density[row];
  place.replaceChildren(
    element("header", {}, element("h3", {}, `Point ${whole(row)}`), element("button.quiet", { type: "button", "aria-label": "Close the inspector", onclick: onClose }, "✕")),
    element(
      "dl",
      {},
      ...line("Position, mm", vector(triple(store.xyz, 3, origin))),
      ...line("Normal", reliable ? vector(triple(store.normal, 3, [0, 0, 0])) : "not given"),
      ...line("Density", significant(density), element("span.unit", {}, "points/mm²")),
      ...line("State", said.join(", ")),
      ...line("Rescan", rescan),
    ),
  );
}

export function drawSessions(place, sessions, chosen, describe, onChoose, onDelete = null) {
  const item = (session) =>
    element(
      "li",
      {},
      element(
        "button.session",
        { type: "button", "aria-current": session.id === chosen ? "true" : null, onclick: () => onChoose(session.id) },
        element("span.name", {}, session.name || session.id),
        element("span.badge", { "data-state": session.state }, words(session.state)),
        element("span.detail", {}, describe(session)),
      ),
      onDelete ? element("button.quiet.delete", { type: "button", title: "Delete this session", "aria-label": `Delete ${session.name || session.id}`, onclick: () => onDelete(session.id) }, "Delete…") : null,
    );
  place.replaceChildren(...(sessions.length ? sessions.map(item) : [element("li.empty", {}, "No session yet. Start one on a device, replay a file, or run the demonstration.")]));
}

export const sessionDetail = (session, created) => [created, plural(session.lines ?? 0, "line", "lines"), plural(session.points ?? 0, "point", "points")].filter(Boolean).join(" · ");
