// Which point lies under the pointer: the nearest to the eye among those close by; plain arrays, no three, no page.

import { isShown } from "./point_store.js";

// `matrix` is clip_from_part, 16 numbers column by column; x, y and the radius are CSS pixels from the top left corner.
// The row of the point, or -1. A point `slack` of the view's depth behind another one loses to it.
export function pickPoint({ xyz, state, end }, matrix, width, height, x, y, radiusPx = 9, slack = 0.004) {
  const m = matrix;
  const candidates = [];
  let nearest = Infinity;
  for (let row = 0; row < end; row += 1) {
    if (!isShown(state[row])) continue;
    const px = xyz[3 * row];
    const py = xyz[3 * row + 1];
    const pz = xyz[3 * row + 2];
    const w = m[3] * px + m[7] * py + m[11] * pz + m[15];
    if (w <= 0) continue;
    const dx = ((m[0] * px + m[4] * py + m[8] * pz + m[12]) / w + 1) * 0.5 * width - x;
    if (dx > radiusPx || dx < -radiusPx) continue;
    const dy = (1 - (m[1] * px + m[5] * py + m[9] * pz + m[13]) / w) * 0.5 * height - y;
    const square = dx * dx + dy * dy;
    if (square > radiusPx * radiusPx) continue;
    candidates.push({ row, square, depth: w });
    if (w < nearest) nearest = w;
  }
  let best = { row: -1, square: Infinity };
  for (const candidate of candidates) {
    if (candidate.depth <= nearest * (1 + slack) && candidate.square < best.square) best = candidate;
  }
  return best.row;
}
