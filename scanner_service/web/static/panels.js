// The text beside the picture: figures, losses, regions, the inspected point; asks the service for nothing.

import { element } from "./element.js";
import { lineSample } from "./legend.js";
import { fixed, missing, percent, plural, sentence, significant, whole, words } from "./numbers.js";
import { reasonByKey, RESCAN_REASONS, rescanReason, STATE_ISOLATED, STATE_NOT_COUNTED, STATE_RELIABLE, STATE_RESCAN, STATE_SETTLED, UNRELIABLE_REASONS, unreliableReason } from "./stream_format.js";

const figure = (name, value, unit = null) => element("div", {}, element("dt", {}, name), element("dd", {}, value, unit === null ? null : element("span.unit", {}, unit)));

export function drawFigures(place, status, store, box) {
  const size = box ? box.high.map((high, axis) => significant(high - box.low[axis])).join(" × ") : "–";
  place.replaceChildren(
    figure("Lines", whole(status?.lines)),
    figure("Points", whole(status?.points ?? (store.total || null))),
    figure("Rate", whole(status?.points_per_s), missing(status?.points_per_s) ? null : "points/s"),
    figure("Observed coverage", percent(status?.coverage)),
    figure("Extent x × y × z", size, box ? "mm" : null),
    store.skipped > 0 ? figure("Updates merged", whole(store.skipped)) : "",
  );
}

// Sum of all numbers in a nested tally.
export const tallyTotal = (tally) => (typeof tally === "number" ? tally : Object.values(tally ?? {}).reduce((sum, part) => sum + tallyTotal(part), 0));

export function drawLosses(place, count, losses) {
  const groups = Object.entries(losses ?? {}).filter(([, value]) => typeof value === "object" && value !== null);
  const single = Object.entries(losses ?? {}).filter(([, value]) => typeof value === "number");
  const total = tallyTotal(losses);
  count.textContent = losses ? (total > 0 ? "" : "none") : "";
  const rows = (entries) => element("dl.tally", {}, ...entries.flatMap(([name, value]) => [element(value > 0 ? "dt" : "dt.zero", {}, sentence(name)), element(value > 0 ? "dd" : "dd.zero", {}, whole(value))]));
  const flat = (tally, prefix = "") => Object.entries(tally).flatMap(([name, value]) => (typeof value === "number" ? [[prefix + name, value]] : flat(value ?? {}, `${prefix}${name}: `)));
  place.replaceChildren(
    single.length ? rows(single) : "",
    ...groups.map(([name, tally]) => element("section.tally-group", {}, element("h3", {}, sentence(name), element("span.unit", {}, whole(tallyTotal(tally)))), rows(flat(tally)))),
    total === 0 && !groups.length && !single.length ? element("p.empty", {}, losses ? "Nothing was lost." : "Not known yet.") : "",
  );
}

export function drawRegions(place, count, regions, chosen, onChoose) {
  count.textContent = regions === null ? "" : whole(regions.length);
  if (!regions?.length) {
    place.replaceChildren(element("li.empty", {}, regions === null ? "Not known yet." : "No region needs another scan."));
    return;
  }
  const item = (region) => {
    const reason = reasonByKey(region.reason);
    const share = region.required_per_mm2 > 0 ? Math.min(1, region.measured_per_mm2 / region.required_per_mm2) : 0;
    return element(
      "li",
      {},
      element(
        "button.region",
        { type: "button", "aria-pressed": String(region.number === chosen), onclick: () => onChoose(region.number), title: region.remedy ? `Remedy: ${region.remedy}` : null },
        element("span.number", {}, String(region.number)),
        element("span.reason", {}, sentence(reason.text), lineSample(reason)),
        element("span.area", {}, significant(region.area_mm2), element("span.unit", {}, "mm²")),
        element("span.density", {}, `${significant(region.measured_per_mm2)} of ${significant(region.required_per_mm2)}`, element("span.unit", {}, "points/mm²")),
        element("span.priority", {}, "priority ", significant(region.priority, 2)),
        element("meter", { min: 0, max: 1, value: share, "aria-label": "measured share of the required density" }),
        region.remedy ? element("span.remedy", {}, region.remedy) : null,
      ),
    );
  };
  const focused = place.contains(document.activeElement) ? [...place.querySelectorAll("button")].indexOf(document.activeElement) : -1;
  const scrolled = place.scrollTop;
  place.replaceChildren(...regions.map(item));
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

export function drawSessions(place, sessions, chosen, describe, onChoose) {
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
    );
  place.replaceChildren(...(sessions.length ? sessions.map(item) : [element("li.empty", {}, "No session yet. Start one on a device, replay a file, or run the demonstration.")]));
}

export const sessionDetail = (session, created) => [created, plural(session.lines ?? 0, "line", "lines"), plural(session.points ?? 0, "point", "points")].filter(Boolean).join(" · ");
