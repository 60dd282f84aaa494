// One open session on the page: its stream into its store, and when each part of the picture is due; owns no session list.

import { roundUp } from "./colours.js";
import { LiveConnection } from "./live_connection.js";
import { PointStore, VersionGap } from "./point_store.js";
import { liveAddress } from "./service.js";
import { decodeMessage, KIND_POINTS, StreamDamage } from "./stream_format.js";

export const SCANNING = new Set(["scanning"]);
export const OVER = new Set(["stopped", "failed", "interrupted"]);

export class SessionView {
  store = new PointStore();
  status = null;
  regions = null; // null until the service has spoken of them
  origin = [0, 0, 0];
  box = null;
  sample = new Float32Array(0);
  #connection = null;
  #owed = 0; // binary messages taken in but not drawn yet; credit for them follows the picture
  #surveyed = null;
  #known = new Map(); // regions by id, as they were last told of

  // tell: {points(), status(), regions(), opening(told), connection(state), trouble(text)}
  constructor(tell) {
    this.tell = tell;
  }

  open(id) {
    this.id = id;
    this.status = this.regions = this.box = null;
    this.#surveyed = null;
    this.sample = new Float32Array(0);
    this.store.clear();
    this.renew();
  }

  // Ask for everything again, such as when points flow again or were withdrawn; what is in sight stays until it is there.
  renew() {
    this.#connection?.close();
    this.#connection = new LiveConnection(liveAddress(this.id), {
      onBinary: (buffer) => this.#takeBinary(buffer),
      onText: (text) => this.#takeText(text),
      onState: (state) => {
        if (state.state === "connecting") this.#owed = 0; // a new socket has a new window
        this.tell.connection(state);
      },
      isScanning: () => SCANNING.has(this.status?.state),
    });
    this.#connection.connect();
  }

  retryNow() {
    this.#connection?.retryNow();
  }

  // The picture has been drawn: the service may send as many messages again as went into it.
  drawn() {
    if (this.#owed > 0) this.#connection?.grant(this.#owed);
    this.#owed = 0;
  }

  // Box and distribution of the points, walked through at most once for each version; true when they are new.
  survey() {
    if (this.#surveyed === this.store.version || this.store.end === 0) return false;
    this.#surveyed = this.store.version;
    this.box = this.store.box();
    this.sample = this.store.densitySample();
    return true;
  }

  // An absolute range from 0 that nearly all densities are within, in round points/mm²; calm, it does not follow each line.
  densityRange([low, high]) {
    if (this.sample.length === 0) return [low, high];
    const wanted = roundUp(this.sample[Math.floor(0.98 * (this.sample.length - 1))]);
    return wanted > high || wanted < 0.6 * high || low !== 0 ? [0, wanted] : [low, high];
  }

  // The distance between points as they typically lie, mm.
  get spacingMm() {
    const median = this.sample[Math.floor(this.sample.length / 2)];
    return median > 0 ? 1 / Math.sqrt(median) : 0.3;
  }

  // The least and the most that is required of any region, points/mm², or null; it follows the spacing on the surface.
  get requiredPerMm2() {
    const all = (this.regions ?? []).map((region) => region.required_per_mm2).filter(Number.isFinite);
    return all.length ? [Math.min(...all), Math.max(...all)] : null;
  }

  // Whether the service would start it: a new one, or one whose scanlines are pushed, as often as wanted.
  get startable() {
    return this.status !== null && (this.status.state === "created" || (OVER.has(this.status.state) && this.status.source?.kind === "push"));
  }

  #takeBinary(buffer) {
    this.#owed += 1;
    try {
      const message = decodeMessage(buffer);
      if (message.kind === KIND_POINTS) this.store.apply(message);
    } catch (error) {
      if (!(error instanceof VersionGap || error instanceof StreamDamage)) throw error;
      this.tell.trouble(`${error.message}; asking for everything again.`);
      this.#connection.restart(error.message);
      return;
    }
    this.tell.points();
  }

  #takeText(text) {
    let message;
    try {
      message = JSON.parse(text);
    } catch {
      this.tell.trouble("the service sent a text that is not JSON; it was left out.");
      return;
    }
    if (message.type === "status") {
      this.status = message;
      const moved = message.origin_mm?.some((value, axis) => value !== this.origin[axis]);
      if (moved) this.origin = message.origin_mm;
      this.tell.status();
      if (moved && this.regions) this.tell.regions();
    } else if (message.type === "regions") {
      for (const region of message.regions) this.#known.set(region.id, region);
      this.regions = message.order.map((id) => this.#known.get(id)); // the most urgent first, each called by its id
      this.#known = new Map(this.regions.map((region) => [region.id, region]));
      this.tell.regions();
    } else if (message.type === "opening") {
      this.tell.opening(message);
    } else if (message.type === "error") {
      this.tell.trouble(message.detail);
    }
  }
}
