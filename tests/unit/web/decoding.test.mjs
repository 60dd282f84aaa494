// Laws of the stream's decoding, the store, picking and colours; messages are made here byte by byte, by hand.

import assert from "node:assert/strict";
import { test } from "node:test";

const web = "../../../scanner_service/web/static/";
const { decodeMessage, rescanReason, StreamDamage, unreliableReason } = await import(`${web}stream_format.js`);
const { ABSENT, PointStore, VersionGap } = await import(`${web}point_store.js`);
const { pickPoint } = await import(`${web}picking.js`);
const { colourAt, colourTable, roundUp, ticks, SCALES } = await import(`${web}colours.js`);

// Row i of a message: x = id, y = id + 0.5, z = -id, density 10 + id, normal (0, 0, 1), the given state.
function message(ids, { version = 1, base = 0, snapshot = false, total = Math.max(0, ...ids) + 1, skipped = 0, state = 3, kind = 1 } = {}) {
  const n = ids.length;
  const bytes = new DataView(new ArrayBuffer(40 + 36 * n));
  [0x53, 0x4c, 0x56, 0x31].forEach((byte, at) => bytes.setUint8(at, byte));
  bytes.setUint16(4, kind, true);
  bytes.setUint16(6, snapshot ? 1 : 0, true);
  bytes.setBigUint64(8, BigInt(version), true);
  bytes.setBigUint64(16, BigInt(base), true);
  bytes.setUint32(24, n, true);
  bytes.setUint32(28, skipped, true);
  bytes.setUint32(32, total, true);
  ids.forEach((id, i) => {
    bytes.setUint32(40 + 4 * i, id, true);
    [id, id + 0.5, -id].forEach((value, axis) => bytes.setFloat32(40 + 4 * n + 4 * (3 * i + axis), value, true));
    bytes.setFloat32(40 + 16 * n + 4 * i, 10 + id, true);
    [0, 0, 1].forEach((value, axis) => bytes.setFloat32(40 + 20 * n + 4 * (3 * i + axis), value, true));
    bytes.setUint32(40 + 32 * n + 4 * i, state, true);
  });
  return bytes.buffer;
}

const run = (from, to) => Array.from({ length: to - from }, (_, i) => from + i);
const take = (store, ...args) => store.apply(decodeMessage(message(...args)));

test("a message of three points, written by hand, is read back field by field", () => {
  const read = decodeMessage(message([4, 7, 5], { version: 9, base: 8, total: 12, skipped: 2, state: 0x00020208 }));
  assert.deepEqual([read.version, read.base, read.snapshot, read.total, read.skipped], [9, 8, false, 12, 2]);
  assert.deepEqual([...read.ids], [4, 7, 5]);
  assert.deepEqual([...read.xyz], [4, 4.5, -4, 7, 7.5, -7, 5, 5.5, -5]);
  assert.deepEqual([...read.density], [14, 17, 15]);
  assert.deepEqual([...read.normal.subarray(3, 6)], [0, 0, 1]);
  assert.deepEqual([unreliableReason(read.state[1]), rescanReason(read.state[1])], [2, 2]);
});

test("a message without points is a message", () => {
  assert.equal(decodeMessage(message([], { version: 3, base: 2, total: 0 })).ids.length, 0);
});

test("every truncation, every trailing byte and a foreign beginning are refused in words", () => {
  const whole = message([0, 1]);
  for (let length = 0; length < whole.byteLength; length += 1) assert.throws(() => decodeMessage(whole.slice(0, length)), StreamDamage);
  const longer = new Uint8Array(whole.byteLength + 1);
  longer.set(new Uint8Array(whole));
  assert.throws(() => decodeMessage(longer.buffer), StreamDamage);
  new Uint8Array(whole)[0] = 0;
  assert.throws(() => decodeMessage(whole), /SLV1/);
});

test("a row outside of the map is refused", () => {
  assert.throws(() => decodeMessage(message([5], { total: 5 })), /row 5 is outside of a map of 5 points/);
});

test("a kind of a later version is left alone", () => {
  assert.deepEqual(decodeMessage(message([], { kind: 7 })), { kind: 7 });
});

test("a version that comes in parts is held when its last part is there, and its skipped versions count once", () => {
  const store = new PointStore(4);
  take(store, run(0, 5), { version: 0, base: 0, snapshot: true, total: 12, skipped: 3 });
  take(store, run(5, 10), { version: 0, base: 0, total: 12, skipped: 3 });
  assert.deepEqual([store.version, store.received, store.skipped], [0, 10, 0]);
  take(store, run(10, 12), { version: 7, base: 0, total: 12, skipped: 3 });
  assert.deepEqual([store.version, store.received, store.total, store.skipped], [7, 12, 12, 3]);
});

test("however a map is cut into messages, the store holds the same", () => {
  const whole = new PointStore(4);
  take(whole, run(0, 100), { snapshot: true });
  for (const cuts of [[0, 1, 100], [0, 50, 60, 100], [0, 3, 4, 5, 99, 100]]) {
    const pieces = new PointStore(4);
    for (let i = 1; i < cuts.length; i += 1) take(pieces, run(cuts[i - 1], cuts[i]), { version: i, base: i - 1, snapshot: i === 1 });
    assert.equal(pieces.received, 100);
    for (const name of ["xyz", "density", "normal", "state"]) {
      const width = name === "xyz" || name === "normal" ? 3 : 1;
      assert.deepEqual(pieces[name].subarray(0, 100 * width), whole[name].subarray(0, 100 * width), name);
    }
  }
});

test("scattered rows and a run of the same rows store the same", () => {
  const [first, second] = [new PointStore(4), new PointStore(4)];
  take(first, run(0, 20), { snapshot: true });
  take(second, run(0, 20).reverse(), { snapshot: true, total: 20 });
  assert.deepEqual(first.xyz.subarray(0, 60), second.xyz.subarray(0, 60));
  assert.equal(second.received, 20);
});

test("capacity grows by doubling and nothing is forgotten", () => {
  const store = new PointStore(4);
  for (let i = 0; i < 1000; i += 1) take(store, [i], { version: i + 1, base: i });
  assert.equal(store.capacity, 1024);
  assert.equal(store.generation, 1 + 8);
  assert.deepEqual(run(0, 1000), [...store.xyz].filter((_, at) => at % 3 === 0).slice(0, 1000));
});

test("only what changed is named for upload, once", () => {
  const store = new PointStore(4);
  take(store, run(0, 10000), { snapshot: true });
  assert.deepEqual(store.takeDirty(), [[0, 10000]]);
  assert.deepEqual(store.takeDirty(), []);
  take(store, [2, 5000, 9999], { version: 2, base: 1, total: 10000 });
  const runs = store.takeDirty();
  for (const row of [2, 5000, 9999]) assert.ok(runs.some(([first, count]) => row >= first && row < first + count));
  assert.ok(runs.reduce((sum, [, count]) => sum + count, 0) <= 3 * 1024);
});

test("an update that builds on another version changes nothing", () => {
  const store = new PointStore(4);
  take(store, [0, 1], { version: 5, snapshot: true });
  assert.throws(() => take(store, [0], { version: 8, base: 7, total: 2, state: 0 }), VersionGap);
  assert.deepEqual([store.version, store.state[0], store.total], [5, 3, 2]);
});

test("a snapshot forgets what was there; rows not sent yet are absent and nowhere in the box", () => {
  const store = new PointStore(4);
  take(store, run(0, 50), { snapshot: true });
  take(store, [3, 1], { version: 9, snapshot: true, total: 6 });
  assert.deepEqual([store.received, store.total, store.end, store.state[0], store.state[2]], [2, 6, 4, ABSENT, ABSENT]);
  assert.deepEqual(store.box(), { low: [1, 1.5, -3], high: [3, 3.5, -1] });
});

test("without points there is no box and no sample", () => {
  assert.equal(new PointStore(4).box(), null);
  assert.equal(new PointStore(4).densitySample().length, 0);
});

// clip = (x, y, z, 2 - z): an eye at z = 2 that looks down
const EYE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, -1, 0, 0, 0, 2];
const cloud = (...points) => ({ xyz: Float32Array.from(points.flat()), state: new Uint32Array(points.length), end: points.length });

test("of two points under the pointer the nearer to the eye is picked, wherever it stands in the map", () => {
  assert.equal(pickPoint(cloud([0, 0, 0], [0, 0, 1]), EYE, 100, 100, 50, 50), 1);
  assert.equal(pickPoint(cloud([0, 0, 1], [0, 0, 0]), EYE, 100, 100, 50, 50), 0);
});

test("of points at one depth the closest to the pointer is picked; none beyond the radius, none behind the eye, none absent", () => {
  assert.equal(pickPoint(cloud([0.1, 0, 0], [0.04, 0, 0]), EYE, 100, 100, 50, 50), 1);
  assert.equal(pickPoint(cloud([0.8, 0, 0]), EYE, 100, 100, 50, 50), -1);
  assert.equal(pickPoint(cloud([0, 0, 3]), EYE, 100, 100, 50, 50), -1);
  const absent = cloud([0, 0, 0]);
  for (absent.state[0] of [ABSENT, 16]) assert.equal(pickPoint(absent, EYE, 100, 100, 50, 50), -1); // 16: not counted, such as withdrawn
});

test("viridis only grows brighter; blue is dense and red is sparse in the third scale", () => {
  const brightness = ([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b;
  const steps = run(0, 101).map((i) => brightness(colourAt("viridis", i / 100)));
  steps.slice(1).forEach((value, i) => assert.ok(value > steps[i] - 0.6, `at ${i}`));
  const [sparse, dense] = [colourAt("bgyr", 0), colourAt("bgyr", 1)];
  assert.ok(sparse[0] > sparse[2] + 100 && dense[2] > dense[0] + 100);
});

test("colours outside of the range are the ends of the scale; a table is the scale sampled", () => {
  for (const scale of Object.keys(SCALES)) {
    assert.deepEqual(colourAt(scale, -3), colourAt(scale, 0));
    assert.deepEqual(colourAt(scale, 7), colourAt(scale, 1));
    assert.deepEqual([...colourTable(scale).subarray(4 * 51, 4 * 52)], [...colourAt(scale, 51 / 255), 255]);
  }
});

test("a legend's upper end is round, not below the value and less than twice it", () => {
  for (let value = 0.003; value < 5000; value *= 1.07) {
    const rounded = roundUp(value);
    assert.ok(rounded >= value * (1 - 1e-6) && rounded < 2 * value, `${value} -> ${rounded}`);
    assert.ok(String(rounded).replace(/[0.]/g, "").length <= 2);
  }
});

test("ticks are round, within the range and between 2 and 12 of them", () => {
  for (const [low, high] of [[0, 20], [0, 0.3], [-3, 17], [101.2, 104.9], [0, 1500]]) {
    const list = ticks(low, high);
    assert.ok(list.length >= 2 && list.length <= 12);
    list.forEach((value) => assert.ok(value >= low - 1e-9 && value <= high + 1e-9));
  }
});
