// Guides a hand along a pass: a card above the picture that says where, which way and how fast; plans nothing.

import { element } from "./element.js";
import { fixed, missing, opening, significant } from "./numbers.js";
import { guidanceOf, ServiceRefusal } from "./service.js";

const PERIOD_MS = 400;

export class Guide {
  #followed = null; // "session/order"
  #timer = null;

  // onPlace(share): how much of the pass lies behind the scanner, from 0 to 1, null when that is not known
  constructor(place, onPlace) {
    this.place = place;
    this.onPlace = onPlace;
  }

  // Follow an order that a hand carries out; null: nobody is guided.
  follow(session, order) {
    const wanted = order === null ? null : `${session}/${order.order}`;
    if (wanted === this.#followed) return;
    this.#followed = wanted;
    clearTimeout(this.#timer);
    this.place.hidden = true; // until there is something to say
    this.onPlace(null);
    if (order !== null) this.#look(session, order, wanted);
  }

  async #look(session, order, wanted) {
    let told = null;
    let said = "";
    try {
      told = await guidanceOf(session, order.order);
      said = told.say;
    } catch (refusal) {
      if (!(refusal instanceof ServiceRefusal)) throw refusal;
      said = refusal.message;
    }
    if (wanted !== this.#followed) return;
    this.#draw(order, said, told);
    this.#timer = setTimeout(() => this.#look(session, order, wanted), PERIOD_MS);
  }

  #draw(order, said, told) {
    const length = Math.abs(order.pass.end_mm - order.pass.start_mm);
    const share = told && !missing(told.along_mm) ? Math.min(1, Math.max(0, 1 - told.along_mm / length)) : null;
    const figure = (name, value, unit) => element("div", {}, element("dt", {}, name), element("dd", {}, fixed(value, 1), element("span.unit", {}, unit)));
    this.place.hidden = false;
    this.place.replaceChildren(
      element("p.say", {}, opening(said)),
      ...(told
        ? [
            element("progress", { max: 1, value: share ?? 0, "aria-label": "how much of the pass is done" }),
            element(
              "dl",
              {},
              figure("to go", told.along_mm, "mm"),
              figure("aside", told.aside_mm, "mm"),
              figure("turned", told.angle_deg, "°"),
              figure("speed", told.speed_mm_per_s, `of ${significant(told.wanted_mm_per_s)} mm/s`),
            ),
          ]
        : []),
    );
    this.onPlace(share);
  }
}
