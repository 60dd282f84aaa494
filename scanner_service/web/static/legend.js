// The legend: what the colours mean, in units, with the distribution of what is shown; colours no point itself.

import { colourAt, ticks } from "./colours.js";
import { element, svg } from "./element.js";
import { significant } from "./numbers.js";
import { RESCAN_REASONS } from "./stream_format.js";

const WIDTH = 236;
const BINS = 59;
const UNRELIABLE = ["#78797f", "no reliable normal"];
const UNSETTLED = ["#4d5966", "darker: not settled yet"];

// {rule, scale, range: [low, high], sample: sorted values, required: [least, most] | null}
export function drawLegend(place, { rule, scale, range, sample, required }) {
  place.hidden = false;
  if (rule === "rescan") place.replaceChildren(title("Rescan reason"), reasonList());
  else if (rule === "normals") place.replaceChildren(title("Normal direction"), axisList());
  else place.replaceChildren(...scaleParts(rule, scale, range, sample, required));
}

const title = (text, unit = null) => element("h3", {}, text, unit === null ? null : element("span.unit", {}, unit));

const key = (colour, text) => element("li", {}, swatch(colour), text);

function swatch(colour) {
  return svg("svg", { width: 12, height: 12, "aria-hidden": "true" }, svg("circle", { cx: 6, cy: 6, r: 5, fill: colour }));
}

export function lineSample({ colour, dash }) {
  const line = { x1: 2, x2: 26, y1: 6, y2: 6, stroke: colour, "stroke-width": 2.5, "stroke-dasharray": dash.length ? dash.map((length) => length / 1.3).join(" ") : null };
  return svg("svg", { width: 28, height: 12, "aria-hidden": "true", class: "line-sample" }, svg("line", line));
}

function reasonList() {
  const items = RESCAN_REASONS.slice(1).map((reason) => element("li", {}, swatch(reason.colour), lineSample(reason), reason.text));
  return element("ul.keys-list", {}, ...items, element("li", {}, swatch("#45525f"), "no rescan needed"), key(...UNRELIABLE));
}

function axisList() {
  return element("ul.keys-list", {}, key("#ff8080", "x, along the laser line"), key("#80ff80", "y, along the travel"), key("#8080ff", "z, height"), key(...UNRELIABLE));
}

function scaleParts(rule, scale, [low, high], sample, required) {
  const density = rule === "density";
  const x = (value) => Math.min(WIDTH, Math.max(0, ((value - low) / (high - low)) * WIDTH));
  const bins = new Float32Array(BINS);
  for (const value of sample) {
    const bin = Math.floor(((value - low) / (high - low)) * BINS);
    if (bin >= 0 && bin < BINS) bins[bin] += 1;
  }
  const most = Math.max(1, ...bins);
  const picture = svg("svg", { class: "scale", width: "100%", viewBox: `-8 0 ${WIDTH + 16} 66`, role: "img", "aria-label": `${scale} colours from ${significant(low)} to ${significant(high)} ${density ? "points per square millimetre" : "millimetres"}` });
  for (let bin = 0; bin < BINS; bin += 1) {
    const [r, g, b] = colourAt(scale, (bin + 0.5) / BINS);
    const at = (bin * WIDTH) / BINS;
    const step = WIDTH / BINS;
    const height = bins[bin] > 0 ? 1 + 25 * Math.sqrt(bins[bin] / most) : 0;
    picture.append(
      svg("rect", { x: at, y: 28 - height, width: step - 0.8, height, fill: `rgb(${r},${g},${b})`, opacity: 0.9 }),
      svg("rect", { x: at, y: 30, width: step + 0.4, height: 12, fill: `rgb(${r},${g},${b})` }),
    );
  }
  for (const value of ticks(low, high)) {
    picture.append(svg("line", { x1: x(value), x2: x(value), y1: 42, y2: 46, class: "tick" }), svg("text", { x: x(value), y: 58, "text-anchor": "middle" }, significant(value)));
  }
  const notes = [];
  if (density && required !== null) {
    const ends = [...new Set(required.map((value) => significant(value)))];
    picture.append(svg("path", { d: required.filter((value) => value > low && value < high).map((value) => `M${x(value)} 2V47`).join(""), class: "required" }));
    notes.push(element("p.note", {}, element("b", {}, "┆"), ` required ${ends.join(" – ")} points/mm²`));
  }
  return [title(density ? "Density" : "Height", density ? "points/mm²" : "mm"), picture, ...notes, element("ul.keys-list", {}, key(...UNRELIABLE), key(...UNSETTLED))];
}
