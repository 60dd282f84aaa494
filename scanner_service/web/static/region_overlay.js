// Rescan regions in the view: outlines on the surface, each reason its own dash, and numbered labels; chooses nothing.

import { Color, GreaterDepth, Group, Vector2, Vector3 } from "three";
import { LineMaterial } from "./vendor/three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "./vendor/three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "./vendor/three/addons/lines/LineSegmentsGeometry.js";
import { roomFor } from "./label_places.js";
import { reasonByKey } from "./stream_format.js";

export class RegionOverlay {
  // `labels` is the element above the canvas that takes the numbers; onChoose(number) is called when one is activated.
  constructor(labels, onChoose) {
    this.labels = labels;
    this.onChoose = onChoose;
    this.group = new Group();
    this.items = [];
    this.shown = true;
  }

  // The numbers of the regions whose outline is in the picture.
  get outlined() {
    return this.shown ? this.items.filter(({ front }) => front.visible).map(({ region }) => region.id) : [];
  }

  set visible(on) {
    this.shown = on;
    this.group.visible = on;
    this.labels.hidden = !on;
  }

  // `origin` is subtracted: regions come in the part frame, points relative to the session's origin.
  show(regions, origin, sizeMm) {
    for (const line of this.group.children) {
      line.geometry.dispose();
      line.material.dispose();
    }
    this.group.clear();
    this.kept = new Map(this.items.map((item) => [item.region.id, item.label]));
    this.items = regions.map((region) => this.#build(region, origin, sizeMm));
    const labels = this.items.map((item) => item.label);
    if (labels.length !== this.labels.children.length || labels.some((label, i) => label !== this.labels.children[i])) this.labels.replaceChildren(...labels);
  }

  choose(number) {
    for (const item of this.items) {
      const chosen = item.region.id === number;
      item.chosen = chosen;
      item.label.classList.toggle("chosen", chosen);
      const width = chosen ? 4 : 1.5 + Math.min(1, item.region.priority ?? 0); // the urgent ones stand out
      item.front.material.linewidth = width;
      item.halo.material.linewidth = 2 * width;
    }
  }

  #build(region, origin, sizeMm) {
    const reason = reasonByKey(region.reason);
    const normal = new Vector3(...(region.normal ?? [0, 0, 1]));
    if (!(normal.lengthSq() > 0)) normal.set(0, 0, 1);
    const lift = normal.clone().normalize().multiplyScalar(0.003 * sizeMm); // clear of the points it runs through
    const place = (point) => [0, 1, 2].map((axis) => point[axis] - origin[axis] + lift.getComponent(axis));
    const segments = [];
    for (const ring of region.outline_mm ?? []) {
      ring.forEach((point, i) => segments.push(...place(point), ...place(ring[(i + 1) % ring.length])));
    }
    const line = (options) => {
      const material = new LineMaterial({ worldUnits: false, ...options });
      const made = new LineSegments2(new LineSegmentsGeometry().setPositions(segments.length ? segments : [0, 0, 0, 0, 0, 0]), material);
      made.frustumCulled = false;
      made.visible = segments.length > 0;
      this.group.add(made);
      return made;
    };
    // drawn after each other at one depth: a dark halo, the line itself; and a faint trace where the part hides them
    const behind = line({ color: new Color("#ffffff"), linewidth: 1, transparent: true, opacity: 0.3, depthFunc: GreaterDepth, depthWrite: false });
    const halo = line({ color: new Color("#05070a"), linewidth: 5, depthWrite: false });
    const front = line({ color: new Color(reason.colour), linewidth: 2.5, dashed: reason.dash.length > 0 });
    [halo, front, behind].forEach((made, order) => {
      made.renderOrder = order + 1;
    });
    front.computeLineDistances();
    const label = this.kept.get(region.id) ?? this.#label(region.id);
    label.title = `Region ${region.id}: ${reason.text}`;
    return { region, reason, behind, halo, front, label, chosen: false, centre: region.centroid_mm.map((value, axis) => value - origin[axis]), normal };
  }

  #label(number) {
    const label = document.createElement("button");
    label.type = "button";
    label.className = "region-label";
    label.textContent = String(number);
    label.tabIndex = -1; // the list holds the same actions for the keyboard
    label.addEventListener("click", () => this.onChoose(number));
    return label;
  }

  // Dashes and labels have a size on the screen, so they follow the camera.
  follow(view) {
    if (!this.shown) return;
    const resolution = new Vector2(view.width, view.height);
    const mmPerPixel = 1 / view.pixelsPerMm;
    const eye = view.camera.position;
    const seen = [];
    for (const item of this.items) {
      const { front, halo, behind, reason, label, centre, normal } = item;
      for (const line of [front, halo, behind]) line.material.resolution.copy(resolution);
      if (reason.dash.length) {
        front.material.dashSize = reason.dash[0] * mmPerPixel;
        front.material.gapSize = reason.dash[1] * mmPerPixel;
      }
      const at = view.project(centre);
      const inside = at.visible && at.x > -20 && at.y > -20 && at.x < view.width + 20 && at.y < view.height + 20;
      label.hidden = !inside;
      if (!inside) continue;
      label.style.transform = `translate(${at.x.toFixed(1)}px, ${at.y.toFixed(1)}px) translate(-50%, -50%)`;
      const facing = normal.x * (eye.x - centre[0]) + normal.y * (eye.y - centre[1]) + normal.z * (eye.z - centre[2]) > 0;
      label.classList.toggle("behind", !facing);
      seen.push({ x: at.x, y: at.y, text: label.textContent, label, importance: (item.chosen ? 2 : 0) + (facing ? 1 : 0) });
    }
    // the list is in order of urgency, and sorting keeps that order among equals
    const whole = roomFor(seen.sort((a, b) => b.importance - a.importance));
    for (const place of seen) place.label.classList.toggle("dot", !whole.has(place));
  }
}
