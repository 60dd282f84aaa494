// The bytes of the live stream's binary messages (docs/live-stream.md); knows no socket, no page and no map.

export const HEADER_BYTES = 40;
export const KIND_POINTS = 1;
export const FLAG_SNAPSHOT = 1;
const BYTES_PER_POINT = 36;
const MAGIC = 0x31564c53; // "SLV1", read little endian

export const STATE_RELIABLE = 1;
export const STATE_SETTLED = 2;
export const STATE_ISOLATED = 4;
export const STATE_RESCAN = 8;
export const STATE_NOT_COUNTED = 16;

export const UNRELIABLE_REASONS = ["reliable", "too few neighbours", "a single scanline", "ill-determined normal", "not counted"];
// index = reason number; dash = the outline's pattern in pixels ([] is a solid line), so that colour is never the only sign
export const RESCAN_REASONS = [
  { key: "none", text: "no rescan", colour: "#5b6470", dash: [] },
  { key: "steep", text: "steep", colour: "#e69f00", dash: [] },
  { key: "sparse", text: "sparse", colour: "#56b4e9", dash: [10, 5] },
  { key: "shadow", text: "shadow", colour: "#cc79a7", dash: [3, 4] },
  { key: "out_of_range", text: "out of range", colour: "#f0e442", dash: [14, 4] },
  { key: "lost_lines", text: "lost lines", colour: "#ff5d4d", dash: [6, 6] },
  { key: "noisy", text: "noisy", colour: "#22c494", dash: [2, 2] },
  { key: "isolated", text: "isolated", colour: "#b9a5ff", dash: [1, 6] },
  { key: "untouched", text: "untouched", colour: "#e8e8e8", dash: [8, 3, 2, 3] }, // of a nominal part; no point has it
];

export const unreliableReason = (state) => (state >>> 8) & 0xff;
export const rescanReason = (state) => (state >>> 16) & 0xff;
export const reasonByKey = (key) => RESCAN_REASONS.find((reason) => reason.key === key) ?? { ...RESCAN_REASONS[0], key, text: String(key).replaceAll("_", " ") };

// The bytes are not a message of this format; the text says what is wrong with them.
export class StreamDamage extends Error {}

const littleEndianHost = new Uint8Array(new Uint32Array([1]).buffer)[0] === 1;

// Views on the buffer, nothing copied: {snapshot, version, base, skipped, total, ids, xyz, density, normal, state}.
export function decodeMessage(buffer) {
  if (!littleEndianHost) throw new StreamDamage("this machine is big endian; the stream is little endian");
  if (buffer.byteLength < HEADER_BYTES) throw new StreamDamage(`a message of ${buffer.byteLength} bytes has no room for its ${HEADER_BYTES}-byte header`);
  const header = new DataView(buffer, 0, HEADER_BYTES);
  if (header.getUint32(0, true) !== MAGIC) throw new StreamDamage("a message does not begin with SLV1");
  const kind = header.getUint16(4, true);
  if (kind !== KIND_POINTS) return { kind };
  const n = header.getUint32(24, true);
  const total = header.getUint32(32, true);
  const expected = HEADER_BYTES + n * BYTES_PER_POINT;
  if (buffer.byteLength !== expected) throw new StreamDamage(`a message of ${n} points must have ${expected} bytes, not ${buffer.byteLength}`);
  let at = HEADER_BYTES;
  const take = (ArrayType, length) => {
    const view = new ArrayType(buffer, at, length);
    at += view.byteLength;
    return view;
  };
  const ids = take(Uint32Array, n);
  for (let i = 0; i < n; i += 1) {
    if (ids[i] >= total) throw new StreamDamage(`row ${ids[i]} is outside of a map of ${total} points`);
  }
  return {
    kind,
    snapshot: (header.getUint16(6, true) & FLAG_SNAPSHOT) !== 0,
    version: Number(header.getBigUint64(8, true)), // exact below 2^53 versions
    base: Number(header.getBigUint64(16, true)),
    skipped: header.getUint32(28, true),
    total,
    ids,
    xyz: take(Float32Array, 3 * n),
    density: take(Float32Array, n),
    normal: take(Float32Array, 3 * n),
    state: take(Uint32Array, n),
  };
}
