// How the points are drawn, as the controls above the picture say: rule, scale, range, size; knows no session.

import { SCALES } from "./colours.js";
import { byId, element } from "./element.js";

export class Look {
  rule = "density";
  scale = "viridis";
  range = [0, 1];
  follows = true; // the range goes with the densities that there are
  pointScale = 1;

  // `onChange` is called after each change; `measure(range)` tells the range of the densities that there are, `range` when it fits still.
  constructor({ onChange, measure }) {
    this.onChange = onChange;
    this.measure = measure;
    for (const [name, { text }] of Object.entries(SCALES)) byId("scale").append(element("option", { value: name }, text));
    this.on("rule", "change", ({ value }) => (this.rule = value));
    this.on("scale", "change", ({ value }) => (this.scale = value));
    this.on("point-size", "input", ({ value }) => (this.pointScale = Number(value)));
    this.on("range-auto", "change", ({ checked }) => {
      this.follows = checked;
      byId("range-low").disabled = byId("range-high").disabled = checked;
      if (checked) this.range = measure([-1, 0]);
    });
    for (const id of ["range-low", "range-high"]) byId(id).addEventListener("change", () => this.takeRange());
  }

  on(id, kind, change) {
    byId(id).addEventListener(kind, (event) => {
      change(event.target);
      this.onChange();
    });
  }

  takeRange() {
    const [low, high] = [byId("range-low").valueAsNumber, byId("range-high").valueAsNumber];
    byId("range-high").setCustomValidity(low < high ? "" : "must be larger than the lower end");
    if (!byId("range-high").reportValidity()) return;
    this.range = [low, high];
    this.onChange();
  }

  // A session is begun with: of its densities nothing is known yet.
  begin() {
    if (this.follows) this.range = [0, 1];
  }

  // The densities have changed.
  survey() {
    if (this.follows) this.range = this.measure(this.range);
  }

  // The controls show what is in force.
  show() {
    byId("scale-label").hidden = this.rule === "normals" || this.rule === "rescan";
    if (this.follows) [byId("range-low").value, byId("range-high").value] = this.range;
  }
}
