// Recommended passes beside the picture: the list, buttons to accept and carry out, and what became of each order.

import { byId, element } from "./element.js";
import { percent, plural, sentence, significant, whole, words } from "./numbers.js";
import { pressedTwice } from "./second_press.js";
import { acceptPass, cancelOrder, carryOut, endLoop, keepOrder, listOrders, listPasses, loopState, startLoop, withdrawOrder } from "./service.js";

const FOLLOW_MS = 1000;
const SAY_MS = 500;
const SOON_S = 1;
const unit = (text) => element("span.unit", {}, text);

// Where a pass or an order goes, the same words wherever it is told of.
const way = (pass) => [`${significant(pass.start_mm)} to ${significant(pass.end_mm)}`, unit("mm"), `, ${plural(pass.lines, "line", "lines")} ${significant(pass.line_spacing_mm)}`, unit("mm"), " apart"];

// The regions that a pass serves, by the numbers that the list and the picture have: "regions 3, 7 and unseen surface".
export function served(pass) {
  const named = pass.serves.map(({ region }) => region).filter((region) => region !== null);
  const regions = named.length ? `${named.length > 1 ? "regions" : "region"} ${named.join(", ")}` : "";
  const unseen = named.length < pass.serves.length ? "unseen surface" : "";
  return [regions, unseen].filter(Boolean).join(" and ");
}

// An area as it was foretold, with the interval in which it lies four times in five: "12 (8 to 15)".
const bound = (mm2) => (Math.abs(mm2) < 0.05 ? "0" : significant(mm2, 2));
const area = (mm2, between) => `${significant(mm2)}${between ? ` (${between.map(bound).join(" to ")})` : ""}`;

// What a pass promises, and what it explores: "promises 12 (8 to 15), explores for 30 (0 to 80) mm²".
export function foretold({ promised_mm2, promised_between_mm2, explores_mm2, explores_between_mm2 }) {
  const promised = promised_mm2 >= 0.5 ? `promises ${area(promised_mm2, promised_between_mm2)}` : "";
  const explores = explores_mm2 >= 0.5 || !promised ? `explores for ${area(explores_mm2, explores_between_mm2)}` : "";
  return `${[promised, explores].filter(Boolean).join(", ")} mm²`;
}

// Surface that no pass brings: as much of its region as this reason holds for, or of the guess where none lists it.
export const outOfReach = ({ region, area_mm2, share, why }) =>
  `Unreachable: ${significant(area_mm2, 2)} mm² ${region === null ? "outside of any region, as guessed" : `of region ${region}`} (${percent(share)} of what is wanted there): ${why}`;

// What became of an order that is over, in words; "" while nothing has.
export function fate({ status, message, outcome, reached_end: whole }) {
  if (status === "doubted") return ["nothing of it is counted until you withdraw or keep it", message].filter(Boolean).join("; ");
  if (status === "withdrawn") return "its points are out of the map; the lines stay in the record";
  const said = outcome && !(outcome.promised_mm2 < 0.5 && outcome.expected_mm2 >= 1) ? `promised ${area(outcome.promised_mm2, outcome.promised_between_mm2)}, reached ${significant(outcome.reached_mm2)} mm²` : "";
  const explored = outcome?.expected_mm2 >= 1 ? `explored: ${significant(outcome.found_mm2)} found, ${area(outcome.expected_mm2, outcome.expected_between_mm2)} mm² expected` : "";
  const early = status === "done" && whole === false ? "ended before its end" : "";
  return [said, explored, early, message].filter(Boolean).join("; ");
}

// What is said while a plan is made; the seconds are left out while they say nothing.
export const planning = (seconds) => `Planning passes…${seconds >= SOON_S ? ` ${whole(Math.floor(seconds))} s` : ""}`;

// How far the closed loop is: what it is at, or why it ended.
export function loopSaid({ running, passes, max_passes: most, why_ended: why }, orders) {
  if (!running) return `The loop ended: ${why}.`;
  const scans = orders.some(({ status }) => status === "running");
  return `Closed loop: ${scans ? `pass ${passes} of at most ${most}` : `planning, ${passes} of at most ${most} passes done`}`;
}

export class PassesPanel {
  #id = null;
  #asked = 0;
  #state = null; // of the session, as last heard
  #orders = [];
  #timer = null;
  #saying = null;

  // trouble(text); scanned(): a pass has begun or ended, so the session's points flow again, or have changed;
  // onOrder(order): the one that is waited for or carried out, null when there is none; onPass(pass) is pointed at, or null
  constructor({ trouble, scanned, onOrder, onPass }) {
    Object.assign(this, { trouble, scanned, onOrder, onPass });
    byId("find-passes").addEventListener("click", () => this.#refresh(true));
    byId("run-loop").addEventListener("click", () => this.#act(() => startLoop(this.#id)));
    byId("end-loop").addEventListener("click", () => this.#act(() => endLoop(this.#id)));
  }

  get #isUnderWay() {
    return this.#orders.some(({ status }) => status === "running");
  }

  open(id) {
    this.#id = id;
    this.#state = null;
    this.#orders = [];
    clearTimeout(this.#timer);
    byId("passes").replaceChildren(element("li.empty", {}, "Not asked for yet."));
    byId("orders").replaceChildren();
    byId("passes-count").textContent = "";
    byId("loop-note").textContent = "";
    this.#saysPlanning(false);
    byId("end-loop").hidden = true;
    this.onOrder(null);
    this.onPass(null);
  }

  // Orders outlast the page and the service: they are looked at when the session is opened, and when its state changes.
  status(told) {
    if (told.state === this.#state) return;
    this.#state = told.state;
    this.#refresh(false);
  }

  async #refresh(withPlan) {
    const id = this.#id;
    const asked = ++this.#asked;
    clearTimeout(this.#timer);
    try {
      const [{ orders }, { loop }] = [await listOrders(id), await loopState(id)];
      if (id !== this.#id || asked !== this.#asked) return;
      const wasRunning = this.#isUnderWay;
      this.#orders = orders;
      const isRunning = this.#isUnderWay;
      this.#draw(orders, loop); // at once, whatever becomes of the plan
      if (wasRunning !== isRunning) this.scanned();
      const plan = withPlan ? await this.#planned(id) : null;
      if (id !== this.#id || asked !== this.#asked) return;
      if (plan) this.#drawPlan(plan);
      if (loop?.running || isRunning) this.#timer = setTimeout(() => this.#refresh(false), FOLLOW_MS);
      else if (wasRunning) this.#refresh(true); // what it brought changes what is worth another one
    } catch (refusal) {
      if (id === this.#id) this.trouble(refusal.message);
    }
  }

  // The plan, which may take a while on a busy computer: that it is being made stays in sight until it is there. Null, and
  // why, when there is none: orders are followed all the same.
  async #planned(id) {
    this.#saysPlanning(true);
    try {
      return await listPasses(id);
    } catch (refusal) {
      if (id === this.#id) this.trouble(refusal.message);
      return null;
    } finally {
      if (id === this.#id) this.#saysPlanning(false);
    }
  }

  #saysPlanning(isPlanning) {
    const note = byId("plan-note");
    const begun = performance.now();
    const say = () => (note.textContent = planning((performance.now() - begun) / 1000));
    clearInterval(this.#saying);
    note.textContent = "";
    byId("find-passes").disabled = isPlanning;
    if (!isPlanning) return;
    say();
    this.#saying = setInterval(say, SAY_MS);
  }

  async #act(act) {
    try {
      await act();
      this.trouble("");
    } catch (refusal) {
      this.trouble(refusal.message);
      await this.#refresh(false);
      return;
    }
    await this.#refresh(true);
  }

  #drawPlan({ plan, passes, unreachable }) {
    byId("passes-count").textContent = String(passes.length);
    const none = element("li.empty", {}, "Nothing that this rig reaches would be a gain.");
    byId("passes").replaceChildren(...(passes.length ? passes.map((one) => this.#pass(one, plan)) : [none]), ...unreachable.map((one) => element("li.small", {}, outOfReach(one))));
    this.onPass(null);
  }

  #draw(orders, loop) {
    const had = document.activeElement?.closest("#orders button")?.dataset;
    byId("orders").replaceChildren(...orders.toReversed().map((order) => this.#order(order)));
    if (had) sameButton(byId("orders").querySelectorAll("button"), had)?.focus();
    this.onOrder(orders.findLast(({ status }) => status === "running") ?? orders.findLast(({ status }) => status === "accepted") ?? null);
    byId("end-loop").hidden = !loop?.running;
    byId("run-loop").hidden = Boolean(loop?.running);
    byId("loop-note").textContent = loop === null ? "" : loopSaid(loop, orders);
  }

  #pass(one, plan) {
    const pointed = { onmouseenter: () => this.onPass(one), onmouseleave: () => this.onPass(null), onfocusin: () => this.onPass(one), onfocusout: () => this.onPass(null) };
    return element(
      "li.pass",
      pointed,
      element("strong", {}, `Pass ${one.number}: ${significant(one.gain_mm2)}`, unit("mm²"), ` in ${significant(one.duration_s + one.approach_s, 2)}`, unit("s")),
      element("span", {}, ...way(one)),
      element("span", {}, `for ${served(one) || "nothing"}`),
      element("span", {}, sentence(foretold(one))),
      one.turn_part ? element("span", {}, `First: ${one.turn_part}.`) : null,
      element("button", { type: "button", onclick: () => this.#act(() => acceptPass(this.#id, one.number, plan)) }, "Accept"),
    );
  }

  // Withdrawing is there wherever it can be done, keeping where somebody has to say which.
  #decisions({ order: number, status, passes }) {
    if (!["done", "failed", "doubted"].includes(status) || !passes.length || this.#isUnderWay) return null;
    const said = { says: "Withdraw", asks: "Press again: its points leave the map", does: "Withdrawing…", title: "Take what this pass has scanned out of the map, such as when the part was not turned" };
    const withdraw = pressedTwice(said, () => this.#act(() => withdrawOrder(this.#id, number).then(this.scanned)));
    const keep = element("button.quiet", { type: "button", "data-order": number, "data-action": "keep", title: "The part lies as the pass asks: count what it has brought", onclick: () => this.#act(() => keepOrder(this.#id, number)) }, "Keep");
    Object.assign(withdraw.dataset, { order: number, action: "withdraw" });
    return element("span.row", {}, withdraw, status === "doubted" ? keep : null);
  }

  #order(order) {
    const { order: number, status, pass } = order;
    const go = () => this.#act(() => carryOut(this.#id, number, pass.turn_part !== null));
    const said = fate(order);
    const waits = status === "accepted";
    return element(
      "li.pass",
      { "data-order": number },
      element("span.head", {}, element("strong", {}, `Order ${number}`), element("span.badge", { "data-state": status }, words(status))),
      element("span", {}, ...way(pass)),
      waits && pass.turn_part ? element("span", {}, `First: ${pass.turn_part}.`) : null,
      said ? element("span", {}, sentence(said)) : null,
      status === "doubted" ? element("span.doubt", { role: "alert" }, sentence(order.outcome.doubt)) : null,
      this.#decisions(order),
      waits
        ? element(
            "span.row",
            {},
            element("button", { type: "button", "data-order": number, "data-action": "carry-out", onclick: go }, pass.turn_part ? "The part is turned: carry out" : "Carry out (laser on)"),
            element("button.quiet", { type: "button", "data-order": number, "data-action": "cancel", onclick: () => this.#act(() => cancelOrder(this.#id, number)) }, "Cancel"),
          )
        : null,
    );
  }
}

// Of buttons that were drawn anew, the one that did the same for the same order; none when it is gone: another does something else.
export function sameButton(buttons, { order, action }) {
  return [...buttons].find(({ dataset }) => dataset.action === action && dataset.order === order) ?? null;
}
