// One pass in the view: an arrow along which the laser goes over the part, and where on it the scanner is now.

import { ArrowHelper, Color, Group, Mesh, MeshBasicMaterial, SphereGeometry, Vector3 } from "three";

const COLOUR = new Color("#7ef0ff");

export class PassArrow {
  object = new Group();
  #arrow = new ArrowHelper(new Vector3(0, 1, 0), new Vector3(), 1, COLOUR);
  #place = new Mesh(new SphereGeometry(1, 16, 12), new MeshBasicMaterial({ color: COLOUR, depthTest: false, transparent: true }));
  #start = new Vector3();
  #way = new Vector3();

  constructor() {
    this.object.visible = false;
    for (const material of [this.#arrow.line.material, this.#arrow.cone.material]) Object.assign(material, { depthTest: false, transparent: true });
    this.#arrow.renderOrder = this.#place.renderOrder = 9;
    this.object.add(this.#arrow, this.#place);
  }

  // Show a pass, or null; `origin` is subtracted, and it is drawn at the depth of `middle` below the sensor, where the part lies.
  show(pass, origin, middle) {
    this.object.visible = pass !== null && middle !== null;
    if (!this.object.visible) return;
    const local = (point) => new Vector3(...point.map((value, axis) => value - origin[axis]));
    const [from, to] = [local(pass.start_pose.translation_mm), local(pass.end_pose.translation_mm)];
    const ray = new Vector3(...pass.laser_direction);
    const depth = new Vector3(...middle).sub(from.clone().lerp(to, 0.5)).dot(ray);
    this.#start = from.addScaledVector(ray, depth);
    this.#way = to.addScaledVector(ray, depth).sub(this.#start);
    const length = Math.max(this.#way.length(), 1e-6);
    this.#arrow.position.copy(this.#start);
    this.#arrow.setDirection(this.#way.clone().normalize());
    this.#arrow.setLength(length, 0.16 * length, 0.08 * length);
    this.#place.scale.setScalar(0.025 * length);
    this.at(null);
  }

  // How much of the pass lies behind the scanner, or null when nobody is on it.
  at(share) {
    this.#place.visible = share !== null;
    if (share !== null) this.#place.position.copy(this.#start).addScaledVector(this.#way, share);
  }
}
