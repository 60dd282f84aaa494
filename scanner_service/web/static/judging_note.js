// Says that a verdict is being waited for, how far it is, and what came of it; asks the service for nothing.

import { byId } from "./element.js";
import { missing, percent, plural, whole } from "./numbers.js";

const WHY = { scan_ended: "Judging the scan", asked_anew: "Judging by what is asked for now" };
const SOON_S = 1;
const OUTCOME_MS = 30000;

// "Judging the scan: looking for regions… 3 s"; the seconds are left out while they say nothing.
export const underWay = ({ why, step, for_s: seconds }) => `${WHY[why] ?? "Judging"}: ${step}…${seconds >= SOON_S ? ` ${whole(Math.round(seconds))} s` : ""}`;

// "Judged: 3 regions need another scan, coverage 91 %."; regions null are not known yet.
export function outcome(status, regions) {
  const found = regions?.length ? `${plural(regions.length, "region needs", "regions need")} another scan` : "no region needs another scan";
  const said = [regions === null ? null : found, missing(status?.coverage) ? null : `coverage ${percent(status.coverage)}`].filter(Boolean);
  return said.length ? `Judged: ${said.join(", ")}.` : "Judged.";
}

export class JudgingNote {
  #isAwaited = false;
  #isThere = false; // the verdict that was awaited last
  #before = null; // the regions of the verdict before it
  #timer = null;

  // `regions()` tells those of the latest verdict.
  constructor(regions) {
    this.regions = regions;
  }

  open() {
    clearTimeout(this.#timer);
    this.#isAwaited = this.#isThere = false;
    this.#show("", null);
  }

  status(told) {
    if (told.judging) {
      clearTimeout(this.#timer);
      if (!this.#isAwaited) this.#before = this.regions();
      this.#isAwaited = true;
      this.#show(underWay(told.judging), told.judging.share);
      return;
    }
    if (this.#isAwaited) {
      this.#timer = setTimeout(() => this.open(), OUTCOME_MS);
      this.#isThere = true;
    }
    this.#isAwaited = false;
    if (!this.#isThere) return;
    const now = this.regions();
    this.#show(outcome(told, now === this.#before ? null : now), null);
  }

  #show(text, share) {
    const [place, said, bar] = [byId("judging"), byId("judging-text"), byId("judging-share")];
    place.hidden = !text;
    place.dataset.done = String(share === null);
    if (said.textContent !== text) said.textContent = text;
    bar.hidden = share === null;
    bar.value = share ?? 0;
  }
}
