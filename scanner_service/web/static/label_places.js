// Which numbers have room in the picture and which shrink to a dot, so that none covers another; plain numbers.

const MOST = 24;
const HEIGHT_PX = 24;
const widthPx = (text) => 16 + 8 * text.length;

// `labels` are {x, y, text}, the most important first; the set of those that are shown whole.
export function roomFor(labels, most = MOST) {
  const placed = [];
  for (const label of labels) {
    if (placed.length === most) break;
    const covers = (other) => Math.abs(other.x - label.x) < 0.5 * (widthPx(other.text) + widthPx(label.text)) && Math.abs(other.y - label.y) < HEIGHT_PX;
    if (!placed.some(covers)) placed.push(label);
  }
  return new Set(placed);
}
