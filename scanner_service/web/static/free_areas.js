// Where in the picture there is room for the part: beside and above what lies on it; knows no part.

import { byId } from "./element.js";

// The picture's parts that no control and no legend lies on: all of it, or what is left beside or above the legend.
export function freeAreas(width, height) {
  const tools = document.querySelector(".tools");
  const whole = { left: 28, top: tools.offsetTop + tools.offsetHeight + 22, right: width - 28, bottom: height - 28 };
  const card = byId("legend");
  if (card.hidden) return [whole];
  const beside = { ...whole, left: card.offsetLeft + card.offsetWidth + 20 };
  const above = { ...whole, bottom: card.offsetTop - 14 };
  const areas = [beside, above].filter(({ left, top, right, bottom }) => right - left > 0.4 * width && bottom - top > 0.4 * height);
  return areas.length ? areas : [whole];
}
