// Laws of what is put where and said how: fitting a box into the free picture, room for labels, the ledger of losses.

import assert from "node:assert/strict";
import { test } from "node:test";

const { fitInto } = await import("../../../scanner_service/web/static/fitting.js");
const { roomFor } = await import("../../../scanner_service/web/static/label_places.js");
const { coverageName, noRegions } = await import("../../../scanner_service/web/static/panels.js");
const { accounts, headline } = await import("../../../scanner_service/web/static/loss_ledger.js");

// a small linear congruential generator: the same draws on every machine
function draws(seed) {
  let state = seed;
  return (low, high) => {
    state = (1664525 * state + 1013904223) % 2 ** 32;
    return low + ((high - low) * state) / 2 ** 32;
  };
}

const FOCAL_PX = 1200;
const seenAt = ([right, up, toward], { distance, x, y }) => [x + (FOCAL_PX * right) / (distance - toward), y - (FOCAL_PX * up) / (distance - toward)];

test("every corner of a box is seen inside a free area, and the box fills its width or its height", () => {
  const draw = draws(1);
  for (let i = 0; i < 200; i += 1) {
    const corners = Array.from({ length: 8 }, () => [draw(-40, 60), draw(-30, 30), draw(-20, 25)]);
    const area = { left: draw(0, 200), top: draw(0, 100), right: draw(500, 900), bottom: draw(300, 700) };
    const fit = fitInto(corners, FOCAL_PX, [area]);
    const seen = corners.map((corner) => seenAt(corner, fit));
    const [xs, ys] = [seen.map(([x]) => x), seen.map(([, y]) => y)];
    assert.ok(Math.min(...xs) >= area.left - 1e-3 && Math.max(...xs) <= area.right + 1e-3);
    assert.ok(Math.min(...ys) >= area.top - 1e-3 && Math.max(...ys) <= area.bottom + 1e-3);
    const filled = Math.max((Math.max(...xs) - Math.min(...xs)) / (area.right - area.left), (Math.max(...ys) - Math.min(...ys)) / (area.bottom - area.top));
    assert.ok(filled > 0.999, `only ${filled} of the area is used`);
  }
});

test("of two areas the one is chosen that shows the box larger", () => {
  const tall = [[-5, -20, 0], [5, 20, 0]];
  const beside = { left: 300, top: 50, right: 900, bottom: 700 };
  const above = { left: 0, top: 50, right: 900, bottom: 450 };
  assert.equal(fitInto(tall, FOCAL_PX, [above, beside]).x, 600);
  const wide = [[-20, -5, 0], [20, 5, 0]];
  assert.equal(fitInto(wide, FOCAL_PX, [above, beside]).x, 450);
});

test("a single point is seen from the nearest distance allowed", () => {
  assert.equal(fitInto([[0, 0, 0]], FOCAL_PX, [{ left: 0, top: 0, right: 100, bottom: 100 }], 7).distance, 7);
});

test("labels that are shown never cover each other, the first is always among them, and what is not shown would have covered one", () => {
  const draw = draws(2);
  const labels = Array.from({ length: 60 }, (_, i) => ({ x: draw(0, 400), y: draw(0, 300), text: String(i + 1) }));
  const shown = [...roomFor(labels, 1000)];
  const width = ({ text }) => 16 + 8 * text.length;
  const apart = (a, b) => Math.abs(a.x - b.x) >= 0.5 * (width(a) + width(b)) || Math.abs(a.y - b.y) >= 24;
  assert.equal(shown[0], labels[0]);
  for (const a of shown) for (const b of shown) assert.ok(a === b || apart(a, b));
  for (const label of labels) assert.ok(shown.includes(label) || shown.some((other) => labels.indexOf(other) < labels.indexOf(label) && !apart(other, label)));
  assert.equal(roomFor(labels, 3).size, 3);
});

const LOSSES = {
  lines: { received: 410, pending: 3, stored: 400, duplicates: 4, conflicts: 1, refused: { invalid: 2 } },
  points: { places: 1000, counted: 700, dropped: { dropout: 250, missing: 30 }, left_out: { stationary: 20 } },
  device: {
    chunks: { sent: 3300, stored: 3290, lost: { damaged: 9, device_dropped: 1 } },
    lines: { sent: 415, stored: 410, whole: 405, partial: 5, open: 1, lost: { disconnected: 4 } },
    duplicates: 0, stale: 0, disagreements: 0, damage: { bad_crc: 9 }, bytes_skipped: 4600, late_reads: 2, largest_pause_s: 0.4,
  },
};

test("whatever came in is found again in the rows of its account", () => {
  const balanced = accounts(LOSSES).filter(({ total }) => total !== null);
  assert.deepEqual(balanced.map(({ title, total }) => [title, total]), [["Points", 1000], ["Scanlines", 410], ["Scanlines on the wire", 415], ["Chunks on the wire", 3300]]);
  for (const { title, total, rows } of balanced) assert.equal(rows.reduce((sum, [, count]) => sum + count, 0), total, title);
  const noise = accounts(LOSSES).find(({ title }) => title === "Noise on the wire");
  assert.deepEqual(noise.rows.filter(([, count]) => count > 0), [["Damage: wrong checksum", 9, "lost"], ["Bytes skipped", 4600, "aside"], ["Times this computer read late", 2, "aside"]]);
});

test("the headline counts what was lost for good, and no place without a return", () => {
  assert.equal(headline(LOSSES), "7 scanlines, 30 points lost");
  assert.equal(headline({ points: { dropped: { dropout: 99 } }, lines: { refused: {} }, device: null }), "nothing lost");
  assert.equal(headline({ lines: { conflicts: 1, refused: {} }, device: null }), "1 scanline lost");
  assert.equal(headline(null), "");
  const pass = (partial, lost) => ({ lines: { sent: 9, stored: 9, partial, lost } });
  assert.equal(headline({ lines: { refused: {} }, passes: [pass(2, {}), pass(1, { outside_pass: 40 })], device: null }), "3 scanlines partial");
  assert.equal(headline({ lines: { refused: {} }, passes: [pass(1, { damaged: 2 }), pass(0, { record_busy: 1 })], device: null }), "3 scanlines lost, 1 scanline partial");
});

test("a file's account and a tally of a shape unknown here are told too", () => {
  const [file] = accounts({ device: { points_declared: 40256, dropped: { not_finite: 6 } } });
  assert.deepEqual([file.title, file.total, file.rows], ["File", 40256, [["Read", 40250, "kept"], ["Not finite", 6, "lost"]]]);
  const [other] = accounts({ robot: { stops: 2, moves: { late: 3 } } });
  assert.deepEqual(other.rows.map(([name, count]) => [name, count]), [["Robot, stops", 2], ["Robot, moves, late", 3]]);
  assert.deepEqual(accounts(null), []);
});

test("every pass is told as one balance, and boots are named only where there are several", () => {
  const lines = { sent: 12, stored: 9, whole: 8, partial: 1, under_way: 1, duplicates: 0, lost: { record_busy: 2 } };
  const pass = (boot, index) => ({ device_id: "S1", boot_id: boot, pass_index: index, lines, chunks: null });
  const [one] = accounts({ passes: [pass(7, 3)] });
  assert.deepEqual([one.title, one.total], ["Pass 3 of S1", 12]);
  assert.equal(one.rows.reduce((sum, [, count]) => sum + count, 0), one.total);
  assert.ok(one.rows.some(([name, count, kind]) => name === "Lost: the disk failed" && count === 2 && kind === "lost"));
  const many = accounts({ passes: Array.from({ length: 40 }, (_, index) => pass(7 + (index % 2), index)) });
  assert.equal(many.at(-1).title, "Pass 39 of S1, boot 8");
  assert.ok(many.length <= 12);
});

test("while a scan is under way coverage and regions are said to be of what was seen so far", () => {
  assert.equal(coverageName({ state: "scanning", coverage_kind: "observed" }), "Coverage so far");
  assert.equal(coverageName({ state: "stopped", coverage_kind: "observed" }), "Observed coverage");
  assert.equal(coverageName({ state: "scanning", coverage_kind: "reference" }), "Coverage of the nominal part");
  assert.equal(noRegions({ state: "scanning" }), "No region of the surface seen so far needs another scan.");
  assert.equal(noRegions({ state: "stopped", coverage: 0.9 }), "No region needs another scan.");
  assert.equal(noRegions({ state: "stopped", coverage: null }), "Nothing was judged.");
  assert.equal(coverageName(null), "Observed coverage");
});
