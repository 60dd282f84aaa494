// Which key does what on the page; the acts themselves are handed in.

const TURN_RAD = Math.PI / 24;
const MOVE_PX = 40;

export function listenToKeys(view, { openSessions, clear }) {
  const arrows = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  const keys = {
    f: () => view.fit(),
    1: () => view.look("front"),
    3: () => view.look("right"),
    7: () => view.look("top"),
    "+": () => view.zoom(0.8),
    "=": () => view.zoom(0.8),
    "-": () => view.zoom(1.25),
    s: openSessions,
    escape: clear,
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, select, textarea, dialog")) return;
    const arrow = arrows[event.key];
    const onCanvas = event.target === view.canvas || event.target === document.body;
    if (arrow && onCanvas) {
      const [left, up] = arrow;
      if (event.shiftKey) view.pan(left * MOVE_PX, up * MOVE_PX);
      else view.rotate(left * TURN_RAD, up * TURN_RAD);
    } else if (keys[event.key.toLowerCase()]) {
      keys[event.key.toLowerCase()]();
    } else {
      return;
    }
    event.preventDefault();
  });
}
