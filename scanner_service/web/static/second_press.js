// A button for what cannot be undone: the first press only asks, the second does it. Works by mouse and by keyboard alike.

import { element } from "./element.js";

const ASKS_MS = 10000;

// `says` is what it says before, `asks` between the presses, `does` behind the second, while `act()` is under way.
export function pressedTwice({ says, asks, does, title = null }, act) {
  let timer = null;
  const calm = () => {
    clearTimeout(timer);
    timer = null;
    button.textContent = says;
    button.classList.remove("asks");
  };
  const press = () => {
    if (timer === null) {
      button.textContent = asks;
      button.classList.add("asks");
      timer = setTimeout(calm, ASKS_MS);
      return;
    }
    calm();
    button.textContent = does;
    button.disabled = true;
    act();
  };
  const leave = () => timer !== null && calm();
  const button = element("button.quiet", { type: "button", title, "aria-live": "polite", onclick: press, onblur: leave, onkeydown: (event) => event.key === "Escape" && leave() }, says);
  return button;
}
