// The region of interest as a box in the view; judges nothing.

import { Box3, Box3Helper, Color, Vector3 } from "three";

export class InterestBox {
  constructor() {
    this.box = new Box3();
    this.object = new Box3Helper(this.box, new Color("#ffffff"));
    this.object.visible = false;
  }

  // `box` is {low_mm, high_mm} in the part frame, or null; `origin` is subtracted, as from the points.
  show(box, origin) {
    const corner = (name) => new Vector3(...box[name].map((value, axis) => value - origin[axis]));
    this.object.visible = box !== null && [0, 1, 2].every((axis) => box.low_mm[axis] < box.high_mm[axis]);
    if (this.object.visible) this.box.set(corner("low_mm"), corner("high_mm"));
  }
}
