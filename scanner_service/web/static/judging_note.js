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
  #isAsked = false; // somebody asked for it, and has no answer yet
  #isAwaited = false;
  #isThere = false; // the verdict that was awaited last, whose regions are not known yet
  #hasFaded = false;
  #before = null; // the regions of the verdict before it
  #told = null; // the status that was heard last
  #timer = null;

  // `regions()` tells those of the latest verdict.
  constructor(regions) {
    this.regions = regions;
  }

  open() {
    clearTimeout(this.#timer);
    this.#isAsked = this.#isAwaited = this.#isThere = false;
    this.#told = null;
    this.#show("", null);
  }

  // Something else is asked for on this page; until `answered` no status says that its verdict is there.
  ask() {
    this.#begin();
    this.#isAsked = true;
    this.#show(`${WHY.asked_anew}…`, 0);
  }

  answered() {
    this.#isAsked = false;
    this.#isAwaited = true;
    if (this.#told) this.status({ ...this.#told, judging: null });
  }

  status(told) {
    this.#told = told;
    if (told.judging) {
      if (!this.#isAwaited && !this.#isAsked) this.#begin();
      this.#isAwaited = true;
      this.#show(underWay(told.judging), told.judging.share);
      return;
    }
    if (this.#isAsked) return;
    if (this.#isAwaited) {
      this.#isAwaited = false;
      this.#isThere = true;
      this.#fade();
    }
    if (!this.#isThere) return;
    const now = this.regions();
    const isKnown = now !== null && now !== this.#before;
    if (isKnown || !this.#hasFaded) this.#show(outcome(told, isKnown ? now : null), null);
    if (!isKnown) return;
    this.#isThere = false;
    this.#fade();
  }

  #begin() {
    clearTimeout(this.#timer);
    this.#isThere = false;
    this.#before = this.regions();
  }

  // The outcome goes when it was read; one whose regions come later is shown once more.
  #fade() {
    clearTimeout(this.#timer);
    this.#hasFaded = false;
    this.#timer = setTimeout(() => {
      this.#hasFaded = true;
      this.#show("", null);
    }, OUTCOME_MS);
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
