// How figures read on the page: grouped, rounded, with units; pure.

const LOCALE = "en-GB"; // one look everywhere, in pictures and reports too
const NARROW = "\u202f";

const group = new Intl.NumberFormat(LOCALE, { maximumFractionDigits: 0 });

export const missing = (value) => value === null || value === undefined || !Number.isFinite(value);

export const whole = (value) => (missing(value) ? "–" : group.format(value).replaceAll(",", NARROW));

// `digits` significant figures without an exponent.
export function significant(value, digits = 3) {
  if (missing(value)) return "–";
  if (Math.abs(value) >= 10 ** digits) return whole(value);
  return Number(value.toPrecision(digits)).toLocaleString(LOCALE, { maximumSignificantDigits: digits, useGrouping: false });
}

export const fixed = (value, digits) => (missing(value) ? "–" : value.toFixed(digits).replace("-", "−"));

export const percent = (share) => (missing(share) ? "–" : `${(100 * share).toFixed(1)}${NARROW}%`);

export const words = (key) => String(key).replaceAll("_", " ");

export const sentence = (key) => words(key).replace(/^./, (first) => first.toUpperCase());

// A message with a capital at its beginning, unless it begins with a name: of a file, a device, a field.
export const opening = (text) => text.replace(/^[a-z](?=[a-z]*[ ,;])/, (first) => first.toUpperCase());

export const plural = (count, one, many) => `${whole(count)} ${count === 1 ? one : many}`;

// A time the service gave, as ISO text or seconds since 1970; "" when it is neither.
export function moment(created) {
  const date = new Date(typeof created === "number" ? created * 1000 : created ?? "");
  return Number.isNaN(date.getTime()) ? "" : date.toLocaleString(LOCALE, { dateStyle: "medium", timeStyle: "short" });
}
