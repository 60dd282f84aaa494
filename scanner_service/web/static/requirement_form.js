// What is asked for, as fields of a form and back, and in one line; pure: no page, no service.

import { missing, percent, significant } from "./numbers.js";

// Each field of the form: its name in the request, what it is called, its unit, and how much of the unit one of the request is.
export const FIELDS = [
  { name: "density_per_mm2", label: "Density, at least", unit: "points/mm²", said: (text) => `${text} points/mm²` },
  { name: "density_share", label: "or of what the lines give", unit: "%", factor: 100, said: null },
  { name: "line_spacing_mm", label: "Line spacing, at most", unit: "mm", said: (text) => `lines ${text} mm` },
  { name: "chord_error_mm", label: "Chord error, at most", unit: "mm", said: (text) => `chord ${text} mm` },
  { name: "finest_line_spacing_mm", label: "but lines no finer than", unit: "mm", said: null },
  { name: "incidence_deg", label: "Incidence, at most", unit: "°", said: (text) => `incidence ${text}°` },
  { name: "noise_mm", label: "Noise, at most", unit: "mm", said: (text) => `noise ${text} mm` },
  { name: "coverage_share", label: "Coverage, at least", unit: "%", factor: 100, said: null },
];
export const CORNERS = ["low_mm", "high_mm"];
export const AXES = ["x", "y", "z"];

const shown = (value, factor = 1) => (missing(value) ? "" : String(Number((factor * value).toPrecision(9))));

// The texts of all fields, interest.low_mm.x and so on included; "" is not asked for.
export function textsOf(asked) {
  const texts = Object.fromEntries(FIELDS.map(({ name, factor }) => [name, shown(asked?.[name], factor)]));
  for (const corner of CORNERS) AXES.forEach((axis, i) => (texts[`interest.${corner}.${axis}`] = shown(asked?.interest?.[corner]?.[i])));
  return texts;
}

// {body, refused}: the request that the texts make, or what of them is no number, by field.
export function requestOf(texts) {
  const body = {};
  const refused = {};
  const number = (name, factor = 1) => {
    const text = texts[name].trim().replace(",", ".");
    const value = text === "" ? null : Number(text) / factor;
    if (value === null || Number.isFinite(value)) return value;
    refused[name] = "This is no number.";
    return null;
  };
  for (const { name, factor } of FIELDS) {
    const value = number(name, factor);
    if (value !== null) body[name] = value;
  }
  const box = CORNERS.map((corner) => AXES.map((axis) => number(`interest.${corner}.${axis}`)));
  const given = box.flat().filter((value) => value !== null).length;
  if (given === 6) body.interest = Object.fromEntries(CORNERS.map((corner, i) => [corner, box[i]]));
  else if (given > 0) refused.interest = "A region of interest has six coordinates, or none.";
  return { body, refused };
}

// The name of the preset that asks for the same as a request, or null.
export function presetOf(body, presets) {
  const asks = (name, preset) => (body[name] ?? null) === (preset[name] ?? null);
  const same = ([, preset]) => !body.interest && FIELDS.every(({ name }) => asks(name, preset));
  return Object.entries(presets).find(same)?.[0] ?? null;
}

// What was refused, by field; what is about no single field is under "".
export function refusalsByField({ message, body }) {
  const told = {};
  const places = new Set(["interest", ...FIELDS.map(({ name }) => name)]);
  const say = (name, text) => {
    const [place] = name.split(".");
    told[places.has(place) ? place : ""] ??= text;
  };
  for (const { at, message: text } of body?.errors ?? []) say(at.replace(/^body\./, ""), text);
  for (const name of body?.fields ?? []) say(name, message);
  return Object.keys(told).length ? told : { "": message };
}

// In one line, such as "inspection: lines 0.3 mm · chord 0.01 mm · incidence 65° · coverage 98 %".
export function inWords(asked) {
  if (!asked) return "";
  const said = FIELDS.filter(({ name, said: how }) => how && !missing(asked[name])).map(({ name, factor = 1, said: how }) => how(significant(factor * asked[name])));
  if (missing(asked.density_per_mm2)) said.unshift(`${significant(100 * (asked.density_share ?? 0.5))} % of the lines' density`);
  if (!missing(asked.coverage_share)) said.push(`coverage ${significant(100 * asked.coverage_share)} %`);
  if (asked.interest) said.push("in a box");
  return `${asked.preset ? `${asked.preset}: ` : ""}${said.join(" · ")}`;
}

// Whether it is reached, in words; "" when no coverage is asked for.
export function reached(status) {
  const asked = status?.requirement?.coverage_share;
  if (missing(asked)) return "";
  if (missing(status.coverage)) return "not known yet";
  return status.holds ? `holds: ${percent(status.coverage)}` : `${percent(status.coverage)} of ${percent(asked)}`;
}
