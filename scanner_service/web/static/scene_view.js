// The camera, its controls and when to draw; knows a box to look at, but neither points nor regions.

import { Color, MOUSE, PerspectiveCamera, Scene, Vector3, WebGLRenderer } from "three";
import { fitInto } from "./fitting.js";
import { OrbitControls } from "./vendor/three/addons/controls/OrbitControls.js";

const FIELD_OF_VIEW_DEG = 32;
const FLIGHT_MS = 320;
// from where one looks at the part; z is height, x runs along the laser line, y is travel
export const VIEWS = {
  front: [0, -1, 0],
  right: [1, 0, 0],
  top: [0, -1e-4, 1],
  oblique: [0.55, -0.95, 0.75],
};

export class SceneView {
  // beforeDraw and afterDraw run around each drawn picture; nothing is drawn until something asks for it. freeAreas(width,
  // height) tells the parts of the picture that nothing lies on, {left, top, right, bottom} in pixels, to choose from.
  constructor(canvas, { beforeDraw, afterDraw, freeAreas }) {
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(Math.min(globalThis.devicePixelRatio || 1, 2));
    this.scene = new Scene();
    this.scene.background = new Color("#0b0d11");
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, 0.1, 1000);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.mouseButtons = { LEFT: MOUSE.ROTATE, MIDDLE: MOUSE.DOLLY, RIGHT: MOUSE.PAN };
    this.controls.zoomToCursor = true;
    this.controls.zoomSpeed = 1.4;
    this.controls.addEventListener("change", () => this.invalidate());
    this.controls.addEventListener("start", () => {
      this.touched = true;
      this.flight = null;
    });
    this.touched = false; // the user has chosen a view; from then on the page leaves it alone
    this.box = { low: [-50, -50, -10], high: [50, 50, 10] };
    this.beforeDraw = beforeDraw;
    this.afterDraw = afterDraw;
    this.freeAreas = freeAreas;
    this.shift = [0, 0]; // of the point the camera turns about, beside the middle of the picture, px
    this.flight = null;
    this.asked = false;
    this.width = this.height = 1;
    this.calm = globalThis.matchMedia?.("(prefers-reduced-motion: reduce)").matches ?? false;
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    this.#resize();
    this.look("oblique", { fly: false });
    this.touched = false;
  }

  get centre() {
    return new Vector3(...this.box.low).add(new Vector3(...this.box.high)).multiplyScalar(0.5);
  }

  get radius() {
    return Math.max(0.5 * new Vector3(...this.box.low).distanceTo(new Vector3(...this.box.high)), 1e-3);
  }

  // Pixels (CSS) that one millimetre covers at the point the camera turns about.
  get pixelsPerMm() {
    const distance = this.camera.position.distanceTo(this.controls.target);
    return this.#focalPx / distance;
  }

  get #focalPx() {
    return this.height / (2 * Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360));
  }

  // The pixel of the point that the camera turns about.
  get middle() {
    return [0.5 * this.width + this.shift[0], 0.5 * this.height + this.shift[1]];
  }

  invalidate() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame((time) => this.#draw(time));
  }

  setBox(box) {
    const before = this.radius;
    this.box = box;
    const grown = Math.abs(this.radius - before) > 0.01 * before;
    if (!this.touched && (grown || !this.flight)) this.fit({ fly: grown });
  }

  // Everything in view, seen from where the camera is.
  fit({ fly = true } = {}) {
    const direction = this.camera.position.clone().sub(this.controls.target).normalize();
    this.#travelTo(this.centre, direction, this.#fitting(direction, this.centre, this.box), fly);
  }

  look(name, { fly = true } = {}) {
    const direction = new Vector3(...VIEWS[name]).normalize();
    this.touched = true;
    this.#travelTo(this.centre, direction, this.#fitting(direction, this.centre, this.box), fly);
  }

  // Turn about `point` from now on, from as far as before.
  focus(point) {
    this.touched = true;
    this.#travel(new Vector3(...point), this.camera.position.clone().sub(this.controls.target), this.shift);
  }

  // Turn about `point` and see the box around it, with something of what lies about it, from the side of its normal.
  inspect(point, box, normal) {
    this.touched = true;
    const centre = new Vector3(...point);
    const direction = this.camera.position.clone().sub(this.controls.target).normalize();
    if (normal) direction.multiplyScalar(0.45).add(new Vector3(...normal).normalize()).add(new Vector3(0, -0.25, 0.25)).normalize();
    const least = 0.1 * this.radius;
    const around = (values, sign) => values.map((value, axis) => point[axis] + 1.5 * (value - point[axis]) + sign * least);
    const near = this.#fitting(direction, centre, { low: around(box.low, -1), high: around(box.high, 1) });
    const whole = this.#fitting(direction, centre, this.box);
    this.#travelTo(centre, direction, near.distance < whole.distance ? near : whole, true);
  }

  rotate(leftRad, upRad) {
    this.touched = true;
    this.controls.rotateLeft(leftRad);
    this.controls.rotateUp(upRad);
    this.controls.update();
  }

  pan(rightPx, downPx) {
    this.touched = true;
    this.controls.pan(rightPx, downPx);
    this.controls.update();
  }

  zoom(factor) {
    this.touched = true;
    const { target, arm, shift } = this.flight?.to ?? { target: this.controls.target, arm: this.camera.position.clone().sub(this.controls.target), shift: this.shift };
    this.#travel(target.clone(), arm.clone().multiplyScalar(factor), shift);
  }

  // [x, y] in CSS pixels and whether it lies before the camera.
  project(point, into = new Vector3()) {
    into.set(...point).project(this.camera);
    return { x: (into.x + 1) * 0.5 * this.width, y: (1 - into.y) * 0.5 * this.height, visible: into.z > -1 && into.z < 1 };
  }

  clipFromPart() {
    this.camera.updateMatrixWorld();
    return this.camera.projectionMatrix.clone().multiply(this.camera.matrixWorldInverse).elements;
  }

  // From how far, and about which pixel, all eight corners of the box are seen in a free part of the picture.
  #fitting(direction, centre, box) {
    const forward = direction.clone().negate();
    const right = new Vector3().crossVectors(forward, this.camera.up).normalize();
    const up = new Vector3().crossVectors(right, forward);
    const corners = Array.from({ length: 8 }, (_, corner) => {
      const offset = new Vector3(...[0, 1, 2].map((axis) => (corner & (1 << axis) ? box.high : box.low)[axis])).sub(centre);
      return [offset.dot(right), offset.dot(up), offset.dot(direction)];
    });
    return fitInto(corners, this.#focalPx, this.freeAreas(this.width, this.height), 0.3 * this.radius);
  }

  #travelTo(target, direction, { distance, x, y }, fly) {
    this.#travel(target, direction.clone().multiplyScalar(distance), [x - 0.5 * this.width, y - 0.5 * this.height], fly);
  }

  #travel(target, arm, shift, fly = true) {
    if (!fly || this.calm) {
      this.flight = null;
      this.controls.target.copy(target);
      this.camera.position.copy(target).add(arm);
      this.shift = shift;
      this.controls.update();
    } else {
      const from = { target: this.controls.target.clone(), arm: this.camera.position.clone().sub(this.controls.target), shift: this.shift };
      this.flight = { from, to: { target, arm, shift }, start: performance.now() };
    }
    this.invalidate();
  }

  #fly() {
    const { from, to, start } = this.flight;
    const share = Math.min(1, Math.max(0, (performance.now() - start) / FLIGHT_MS));
    const eased = share * share * (3 - 2 * share);
    const length = from.arm.length() + (to.arm.length() - from.arm.length()) * eased;
    const arm = from.arm.clone().normalize().lerp(to.arm.clone().normalize(), eased);
    if (share === 1 || arm.lengthSq() < 1e-6) arm.copy(to.arm);
    this.controls.target.lerpVectors(from.target, to.target, eased);
    this.shift = [0, 1].map((axis) => from.shift[axis] + (to.shift[axis] - from.shift[axis]) * eased);
    this.camera.position.copy(this.controls.target).add(arm.setLength(share === 1 ? to.arm.length() : length));
    this.controls.update();
    if (share === 1) this.flight = null;
    else this.invalidate();
  }

  #draw() {
    this.asked = false;
    if (this.flight) this.#fly();
    const toCentre = this.camera.position.distanceTo(this.centre);
    this.camera.near = Math.max(toCentre - 1.5 * this.radius, 1e-3 * (toCentre + this.radius));
    this.camera.far = toCentre + 2 * this.radius;
    this.camera.setViewOffset(this.width, this.height, -this.shift[0], -this.shift[1], this.width, this.height);
    this.camera.updateMatrixWorld();
    this.beforeDraw();
    this.renderer.render(this.scene, this.camera);
    this.afterDraw();
  }

  #resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    if (!clientWidth || !clientHeight) return;
    this.width = clientWidth;
    this.height = clientHeight;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    if (!this.touched && !this.flight) this.fit({ fly: false });
    this.invalidate();
  }
}
