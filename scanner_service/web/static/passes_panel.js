// Recommended passes beside the picture: the list, buttons to accept and carry out, and what each pass brought.

import { byId, element } from "./element.js";
import { plural, significant } from "./numbers.js";
import { acceptPass, cancelOrder, carryOut, endLoop, listOrders, listPasses, loopState, startLoop } from "./service.js";

const unit = (text) => element("span.unit", {}, text);

export class PassesPanel {
  #id = null;
  #asked = 0;
  #said = null; // how far the orders were when last heard of

  // scanned: a pass has begun or ended, so the session's points are flowing again, or have changed
  constructor(trouble, scanned) {
    this.trouble = trouble;
    this.scanned = scanned;
    byId("find-passes").addEventListener("click", () => this.refresh());
    byId("run-loop").addEventListener("click", () => this.#act(() => startLoop(this.#id)));
    byId("end-loop").addEventListener("click", () => this.#act(() => endLoop(this.#id)));
  }

  open(id) {
    this.#id = id;
    this.#said = null;
    byId("passes").replaceChildren(element("li.empty", {}, "Not asked for yet."));
    byId("orders").replaceChildren();
    byId("passes-count").textContent = "";
    byId("loop-note").textContent = "";
    byId("end-loop").hidden = true;
  }

  async refresh() {
    const id = this.#id;
    const asked = ++this.#asked;
    try {
      const [plan, { orders }, { loop }] = [await listPasses(id), await listOrders(id), await loopState(id)];
      if (id !== this.#id || asked !== this.#asked) return;
      this.#draw(plan, orders, loop);
      const said = orders.filter((order) => order.status !== "accepted").map((order) => order.order + order.status).join();
      if (this.#said !== null && said !== this.#said) this.scanned();
      this.#said = said;
      if (loop?.running || orders.some((order) => order.status === "running")) setTimeout(() => this.refresh(), 1000);
    } catch (refusal) {
      this.trouble(refusal.message);
    }
  }

  async #act(act) {
    try {
      await act();
      this.trouble("");
    } catch (refusal) {
      this.trouble(refusal.message);
    }
    await this.refresh();
  }

  #draw(plan, orders, loop) {
    byId("passes-count").textContent = String(plan.passes.length);
    const none = element("li.empty", {}, "Nothing that this rig reaches would be a gain.");
    byId("passes").replaceChildren(...(plan.passes.length ? plan.passes.map((one) => this.#pass(one)) : [none]));
    byId("orders").replaceChildren(...orders.map((order) => this.#order(order)));
    byId("end-loop").hidden = !loop?.running;
    byId("loop-note").textContent = loop === null ? "" : loop.running ? `Closed loop: pass ${loop.passes} of at most ${loop.max_passes}` : `The loop ended: ${loop.why_ended}.`;
  }

  #pass(one) {
    const served = one.serves.filter((item) => item.region !== null).length;
    return element(
      "li.pass",
      {},
      element("strong", {}, `${one.number}. ${significant(one.gain_mm2)}`, unit("mm²"), ` in ${significant(one.duration_s + one.approach_s, 2)}`, unit("s")),
      element("span", {}, `${significant(one.start_mm)} to ${significant(one.end_mm)}`, unit("mm"), `, ${plural(one.lines, "line", "lines")} ${significant(one.line_spacing_mm)}`, unit("mm"), " apart"),
      element("span", {}, served ? `for ${plural(served, "region", "regions")}` : "for unseen surface"),
      one.explores_mm2 > 0.5 * one.gain_mm2 ? element("span", {}, "Explores: most of it may not be there.") : null,
      one.turn_part ? element("span", {}, `First: ${one.turn_part}.`) : null,
      element("button", { type: "button", onclick: () => this.#act(() => acceptPass(this.#id, one.number)) }, "Accept"),
    );
  }

  #order({ order, status, message, outcome, pass }) {
    const explored = outcome?.expected_mm2 >= 1 ? `; explored: ${significant(outcome.found_mm2)} found of ${significant(outcome.expected_mm2)} mm² expected` : "";
    const said = outcome ? `promised ${significant(outcome.promised_mm2)}, reached ${significant(outcome.reached_mm2)} mm²${explored}` : (message ?? status);
    const go = () => this.#act(() => carryOut(this.#id, order, pass.turn_part !== null));
    return element(
      "li.pass",
      {},
      element("span", {}, `Order ${order}: ${said}`),
      outcome?.doubt ? element("span.doubt", { role: "alert" }, `Warning: ${outcome.doubt}.`) : null,
      status === "accepted" ? element("button", { type: "button", onclick: go }, pass.turn_part ? "The part is turned: carry out" : "Carry out (laser on)") : null,
      status === "accepted" ? element("button.quiet", { type: "button", onclick: () => this.#act(() => cancelOrder(this.#id, order)) }, "Cancel") : null,
    );
  }
}
