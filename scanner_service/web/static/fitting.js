// How far away and how far beside the middle a box must be seen to fit into the free part of the picture; plain numbers.

const HALVINGS = 40;

// `corners` are [right, up, toward the eye] from the point the camera turns about, mm; `focalPx` is the picture's size in
// pixels of 1 mm at a distance of 1 mm; `areas` are the free parts to choose from, {left, top, right, bottom} in pixels.
// {distance, x, y}: the nearest distance at which one of the areas holds the box, and the pixel of the turning point.
export function fitInto(corners, focalPx, areas, nearest = 0) {
  const closest = Math.max(nearest, 1.01 * Math.max(...corners.map(([, , toward]) => toward)), 1e-6);
  let best = null;
  for (const area of areas) {
    const distance = fittingDistance(corners, focalPx, area, closest);
    if (best !== null && best.distance <= distance) continue;
    const seen = extent(corners, focalPx, distance);
    best = {
      distance,
      x: 0.5 * (area.left + area.right) - 0.5 * (seen.left + seen.right),
      y: 0.5 * (area.top + area.bottom) - 0.5 * (seen.top + seen.bottom),
    };
  }
  return best;
}

function fittingDistance(corners, focalPx, area, closest) {
  const fits = (distance) => {
    const seen = extent(corners, focalPx, distance);
    return seen.right - seen.left <= area.right - area.left && seen.bottom - seen.top <= area.bottom - area.top;
  };
  let far = closest;
  while (!fits(far) && far < 1e9) far *= 2;
  let near = closest;
  if (fits(near)) return near;
  for (let i = 0; i < HALVINGS; i += 1) {
    const middle = 0.5 * (near + far);
    if (fits(middle)) far = middle;
    else near = middle;
  }
  return far;
}

// Where the corners are seen from `distance`, in pixels from the turning point; y runs down.
function extent(corners, focalPx, distance) {
  const seen = { left: Infinity, right: -Infinity, top: Infinity, bottom: -Infinity };
  for (const [right, up, toward] of corners) {
    const x = (focalPx * right) / (distance - toward);
    const y = (-focalPx * up) / (distance - toward);
    seen.left = Math.min(seen.left, x);
    seen.right = Math.max(seen.right, x);
    seen.top = Math.min(seen.top, y);
    seen.bottom = Math.max(seen.bottom, y);
  }
  return seen;
}
