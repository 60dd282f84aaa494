// The two small instruments in the corner: which way the axes point, and how long a millimetre is on the screen.

import { Vector3 } from "three";
import { svg } from "./element.js";
import { significant } from "./numbers.js";

const LONGEST_PX = 130;
const AXES = [["x", [1, 0, 0], "#ff7b72"], ["y", [0, 1, 0], "#7ee787"], ["z", [0, 0, 1], "#79b8ff"]];

export function drawTriad(place, camera) {
  const turned = AXES.map(([name, axis, colour]) => ({ name, colour, to: new Vector3(...axis).transformDirection(camera.matrixWorldInverse) }));
  turned.sort((a, b) => a.to.z - b.to.z);
  place.replaceChildren(
    ...turned.flatMap(({ name, colour, to }) => {
      const opacity = to.z < -0.2 ? 0.55 : 1;
      const line = svg("line", { x1: 0, y1: 0, x2: 20 * to.x, y2: -20 * to.y, stroke: colour, "stroke-width": 2, opacity });
      return [line, svg("text", { x: 27 * to.x, y: -27 * to.y + 3.5, fill: colour, "text-anchor": "middle", opacity }, name)];
    }),
  );
}

// A bar of a round number of millimetres, at the depth of the point the camera turns about.
export function drawRuler(text, bar, pixelsPerMm) {
  const longest = LONGEST_PX / pixelsPerMm;
  const power = 10 ** Math.floor(Math.log10(longest));
  const length = [5, 2, 1].find((step) => step * power <= longest) * power;
  text.textContent = `${significant(length)} mm`;
  bar.style.width = `${(length * pixelsPerMm).toFixed(1)}px`;
}
