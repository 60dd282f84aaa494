// Every point of the map this page has been told, in arrays that grow by doubling; draws nothing and hears no socket.

import { STATE_NOT_COUNTED, STATE_SETTLED } from "./stream_format.js";

export const ABSENT = 0xffffffff; // the state of a row that no message has brought yet
const BLOCK_ROWS = 1024; // changes are remembered in blocks, so that scattered rows cost few uploads
const FIRST_CAPACITY = 1 << 16;

// Whether a point is in the picture: one that is not counted (withdrawn, stationary, over-dense) is not, nor one that is absent.
export const isShown = (state) => (state & STATE_NOT_COUNTED) === 0;

// A message builds on a version this store does not hold; only a full snapshot can mend it.
export class VersionGap extends Error {}

export class PointStore {
  version = 0;
  skipped = 0; // versions that were merged because this client was slow
  total = 0; // rows of the map
  received = 0; // rows that have arrived
  end = 0; // one behind the last row that has arrived
  capacity = 0;
  generation = 0; // counts the times the arrays were replaced

  constructor(firstCapacity = FIRST_CAPACITY) {
    this.firstCapacity = firstCapacity;
    this.#allocate(firstCapacity);
  }

  #allocate(capacity) {
    const old = this.capacity ? this : null;
    const grown = (ArrayType, name, width) => {
      const array = new ArrayType(width * capacity);
      if (old) array.set(old[name].subarray(0, width * this.end));
      return array;
    };
    this.xyz = grown(Float32Array, "xyz", 3);
    this.density = grown(Float32Array, "density", 1);
    this.normal = grown(Float32Array, "normal", 3);
    this.state = grown(Uint32Array, "state", 1).fill(ABSENT, this.end);
    this.dirty = new Uint8Array(Math.ceil(capacity / BLOCK_ROWS));
    this.capacity = capacity;
    this.generation += 1;
  }

  clear() {
    this.version = this.total = this.received = this.end = this.skipped = 0;
    this.state.fill(ABSENT);
    this.dirty.fill(0);
  }

  // Takes a decoded message in; raises VersionGap, and changes nothing, when it does not follow what is held.
  apply(message) {
    if (message.snapshot) this.clear();
    else if (message.base !== this.version) throw new VersionGap(`an update on version ${message.base} cannot follow version ${this.version}`);
    if (message.total > this.capacity) {
      let capacity = this.capacity;
      while (capacity < message.total) capacity *= 2;
      this.#allocate(capacity);
    }
    const { ids } = message;
    const n = ids.length;
    const oneRun = n > 0 && ids[n - 1] - ids[0] === n - 1 && isRun(ids);
    if (oneRun) this.#takeRun(ids[0], n, message);
    else this.#takeScattered(message);
    if (message.version !== this.version) this.skipped += message.skipped; // once, however many parts a version came in
    this.version = message.version;
    this.total = message.total;
  }

  #takeRun(first, n, { xyz, density, normal, state }) {
    for (let row = first; row < first + n; row += 1) this.received += this.state[row] === ABSENT;
    this.xyz.set(xyz, 3 * first);
    this.density.set(density, first);
    this.normal.set(normal, 3 * first);
    this.state.set(state, first);
    this.dirty.fill(1, Math.floor(first / BLOCK_ROWS), Math.floor((first + n - 1) / BLOCK_ROWS) + 1);
    this.end = Math.max(this.end, first + n);
  }

  #takeScattered({ ids, xyz, density, normal, state }) {
    for (let i = 0; i < ids.length; i += 1) {
      const row = ids[i];
      this.received += this.state[row] === ABSENT;
      for (let axis = 0; axis < 3; axis += 1) {
        this.xyz[3 * row + axis] = xyz[3 * i + axis];
        this.normal[3 * row + axis] = normal[3 * i + axis];
      }
      this.density[row] = density[i];
      this.state[row] = state[i];
      this.dirty[Math.floor(row / BLOCK_ROWS)] = 1;
      if (row >= this.end) this.end = row + 1;
    }
  }

  // The rows changed since the last call, as [first, count] pairs in order; few, since whole blocks are named.
  takeDirty() {
    const runs = [];
    for (let block = 0; block * BLOCK_ROWS < this.end; block += 1) {
      if (!this.dirty[block]) continue;
      const first = block * BLOCK_ROWS;
      while (this.dirty[block]) block += 1;
      runs.push([first, Math.min(block * BLOCK_ROWS, this.end) - first]);
    }
    this.dirty.fill(0);
    return runs;
  }

  // Smallest box around the points: {low, high} of three millimetres each, or null without points.
  box() {
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (let row = 0; row < this.end; row += 1) {
      if (!isShown(this.state[row])) continue;
      for (let axis = 0; axis < 3; axis += 1) {
        const value = this.xyz[3 * row + axis];
        if (value < low[axis]) low[axis] = value;
        if (value > high[axis]) high[axis] = value;
      }
    }
    return low.every(Number.isFinite) ? { low, high } : null;
  }

  // Up to `most` densities of settled points, evenly strided, sorted; all points when none has settled yet.
  densitySample(most = 20000) {
    const stride = Math.max(1, Math.floor(this.end / most));
    const settled = [];
    const all = [];
    for (let row = 0; row < this.end; row += stride) {
      const density = this.density[row];
      if (!isShown(this.state[row]) || !(density > 0)) continue;
      all.push(density);
      if (this.state[row] & STATE_SETTLED) settled.push(density);
    }
    return Float32Array.from(settled.length ? settled : all).sort();
  }
}

function isRun(ids) {
  for (let i = 1; i < ids.length; i += 1) if (ids[i] !== ids[i - 1] + 1) return false;
  return true;
}
