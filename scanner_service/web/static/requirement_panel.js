// The form of what is asked for, beside the picture: filled from the status, sent when the user says so.

import { byId, element } from "./element.js";
import { AXES, CORNERS, FIELDS, inWords, presetOf, reached, refusalsByField, requestOf, textsOf } from "./requirement_form.js";
import { askFor, listPresets, whileJudged } from "./service.js";

const OWN = "";

export class RequirementPanel {
  #id = null;
  #presets = {};
  #known = null; // what the service was last heard to ask for, as text
  #touched = false;
  #inputs = new Map();

  // onInterest(box) hears of the box in the fields, {low_mm, high_mm} or null; partBox() tells how far the points reach;
  // onAsked() hears that a verdict is asked for, onJudging(status) how far it is, onJudged() that it is there, and
  // onRefused() that there will be none.
  constructor({ onInterest, partBox, onAsked, onJudging, onJudged, onRefused }) {
    this.onInterest = onInterest;
    this.partBox = partBox;
    Object.assign(this, { onAsked, onJudging, onJudged, onRefused });
    const form = byId("requirement-form");
    byId("requirement-fields").append(...FIELDS.map((field) => this.#field(field)));
    byId("interest-fields").append(...CORNERS.map((corner) => this.#corner(corner)));
    form.addEventListener("input", (event) => this.#edited(event.target));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#send();
    });
    byId("requirement-fold").addEventListener("toggle", () => Object.keys(this.#presets).length || this.#loadPresets());
    byId("requirement-undo").addEventListener("click", () => this.#fill(JSON.parse(this.#known)));
    byId("interest-part").addEventListener("click", () => this.#takeBox(this.partBox()));
    byId("interest-none").addEventListener("click", () => this.#takeBox(null));
  }

  open(id) {
    this.#id = id;
    this.#known = null;
    this.#touched = false;
    byId("requirement-said").textContent = "";
    byId("requirement-holds").textContent = "";
    byId("requirement-apply").disabled = byId("requirement-undo").disabled = true;
    this.#refuse({});
    this.onInterest(null);
  }

  // A form that somebody is filling in is left alone.
  status(told) {
    const now = JSON.stringify(told.requirement ?? null);
    byId("requirement-said").textContent = inWords(told.requirement);
    const holds = byId("requirement-holds");
    holds.textContent = reached(told);
    holds.dataset.holds = String(told.holds ?? "unknown");
    if (now === this.#known) return;
    this.#known = now;
    if (!this.#touched) this.#fill(told.requirement);
  }

  async #loadPresets() {
    try {
      this.#presets = (await listPresets()).presets;
    } catch (refusal) {
      this.#refuse({ "": refusal.message });
      return;
    }
    const choice = byId("requirement-preset");
    choice.replaceChildren(element("option", { value: OWN }, "own values"), ...Object.keys(this.#presets).map((name) => element("option", { value: name }, name)));
    choice.value = presetOf(requestOf(this.#texts()).body, this.#presets) ?? OWN;
  }

  #field({ name, label, unit }) {
    const input = element("input", { type: "text", inputmode: "decimal", id: `ask-${name}`, name, autocomplete: "off", "aria-describedby": `why-${name}` });
    this.#inputs.set(name, input);
    return element("div.ask", {}, element("label", { for: input.id }, label), element("span.value", {}, input, element("span.unit", {}, unit)), this.#why(name));
  }

  #corner(corner) {
    const inputs = AXES.map((axis) => {
      const name = `interest.${corner}.${axis}`;
      const input = element("input", { type: "text", inputmode: "decimal", name, autocomplete: "off", placeholder: axis, "aria-label": `${corner === "low_mm" ? "lowest" : "highest"} ${axis}, mm`, "aria-describedby": "why-interest" });
      this.#inputs.set(name, input);
      return input;
    });
    return element("div.corner-fields", {}, element("span", {}, corner === "low_mm" ? "from" : "to"), ...inputs);
  }

  #why(name) {
    return element("p.why", { id: `why-${name}`, role: "alert", hidden: true });
  }

  #texts() {
    return Object.fromEntries([...this.#inputs].map(([name, input]) => [name, input.value]));
  }

  #fill(asked) {
    const texts = textsOf(asked);
    for (const [name, input] of this.#inputs) input.value = texts[name];
    byId("requirement-preset").value = asked?.preset ?? OWN;
    this.#touched = false;
    this.#refuse({});
    byId("requirement-apply").disabled = byId("requirement-undo").disabled = true;
    this.onInterest(asked?.interest ?? null);
  }

  #edited(target) {
    const preset = byId("requirement-preset");
    if (target === preset && preset.value !== OWN) {
      const texts = textsOf({ ...this.#presets[preset.value], interest: null });
      for (const { name } of FIELDS) this.#inputs.get(name).value = texts[name];
    }
    this.#touched = true;
    const { body, refused } = requestOf(this.#texts());
    preset.value = presetOf({ ...body, interest: undefined }, this.#presets) ?? OWN;
    this.#refuse(refused);
    byId("requirement-apply").disabled = Object.keys(refused).length > 0;
    byId("requirement-undo").disabled = this.#known === null;
    this.onInterest(body.interest ?? null);
  }

  #takeBox(box) {
    CORNERS.forEach((corner, i) =>
      AXES.forEach((axis, j) => {
        this.#inputs.get(`interest.${corner}.${axis}`).value = box ? box[i][j].toFixed(2) : "";
      }),
    );
    this.#edited(null);
  }

  async #send() {
    const id = this.#id;
    const { body, refused } = requestOf(this.#texts());
    if (Object.keys(refused).length) return;
    const apply = byId("requirement-apply");
    apply.disabled = true;
    apply.textContent = "Judging…";
    this.onAsked();
    try {
      const { requirement } = await whileJudged(id, askFor(id, body), (told) => id === this.#id && this.onJudging(told));
      if (id !== this.#id) return;
      this.#known = JSON.stringify(requirement);
      this.#fill(requirement);
      this.onJudged();
    } catch (refusal) {
      if (id !== this.#id) return;
      this.onRefused();
      this.#refuse(refusalsByField(refusal));
      apply.disabled = false;
    } finally {
      apply.textContent = "Apply";
    }
  }

  // Says beside each field what is wrong with it, and below the form what is wrong with all of it.
  #refuse(refused) {
    for (const place of byId("requirement-form").querySelectorAll(".why")) {
      const name = place.id.replace(/^why-/, "");
      place.textContent = refused[name] ?? "";
      place.hidden = !refused[name];
      this.#inputs.get(name)?.setAttribute("aria-invalid", String(Boolean(refused[name])));
    }
  }
}
