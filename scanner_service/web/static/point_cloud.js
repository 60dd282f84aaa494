// The cloud on the graphics card: uploads what changed, colours by a rule in the shader; decides nothing about the data.

import { BufferAttribute, BufferGeometry, DataTexture, DynamicDrawUsage, GLSL3, LinearFilter, NearestFilter, Points, ShaderMaterial, Sphere, Vector2, Vector3 } from "three";
import { colourTable } from "./colours.js";
import { RESCAN_REASONS } from "./stream_format.js";

export const COLOUR_RULES = { density: 0, normals: 1, rescan: 2, height: 3 };

const VERTEX = `
in float density;
in vec3 direction;
in uint state;
uniform int rule;
uniform vec2 range;
uniform vec2 heightRange;
uniform float pointPx;
uniform bool shaded;
uniform sampler2D scale;
uniform sampler2D reasons;
out vec3 tint;
const vec3 UNRELIABLE = vec3(0.47, 0.48, 0.50);

void main() {
  if ((state & 16u) != 0u || any(isnan(position))) {  // not counted, or not received yet: outside of every view
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = 0.0;
    return;
  }
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * seen;
  bool reliable = (state & 1u) != 0u;
  bool settled = (state & 2u) != 0u;
  bool rescan = (state & 8u) != 0u;
  int reason = int((state >> 16) & 255u);
  if (rule == 2) {
    tint = rescan ? texelFetch(reasons, ivec2(min(reason, 7), 0), 0).rgb : reliable ? vec3(0.27, 0.32, 0.38) : UNRELIABLE;
  } else if (!reliable) {
    tint = UNRELIABLE;
  } else if (rule == 1) {
    tint = 0.5 + 0.5 * direction;
  } else {
    float share = rule == 3 ? (position.z - heightRange.x) / (heightRange.y - heightRange.x) : (density - range.x) / (range.y - range.x);
    tint = texture(scale, vec2((clamp(share, 0.0, 1.0) * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  }
  if (shaded && reliable && rule != 1) {
    vec3 facing = normalize(normalMatrix * direction);
    tint *= 0.74 + 0.26 * abs(dot(facing, normalize(seen.xyz)));
  }
  if (!settled) tint *= 0.6;
  gl_PointSize = pointPx;
}`;

const FRAGMENT = `
in vec3 tint;
out vec4 colour;
void main() {
  vec2 offset = gl_PointCoord - 0.5;
  if (dot(offset, offset) > 0.25) discard;
  colour = vec4(tint, 1.0);  // the tables are sRGB already
}`;

export class PointCloud {
  constructor(store) {
    this.store = store;
    const reasons = new Uint8Array(4 * RESCAN_REASONS.length);
    RESCAN_REASONS.forEach(({ colour }, i) => reasons.set([1, 3, 5].map((at) => Number.parseInt(colour.slice(at, at + 2), 16)).concat(255), 4 * i));
    this.material = new ShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: {
        rule: { value: COLOUR_RULES.density },
        range: { value: new Vector2(0, 1) },
        heightRange: { value: new Vector2(0, 1) },
        pointPx: { value: 3 },
        shaded: { value: true },
        scale: { value: scaleTexture("viridis") },
        reasons: { value: texture(reasons, NearestFilter) },
      },
    });
    this.object = new Points(new BufferGeometry(), this.material);
    this.object.frustumCulled = false;
    this.generation = -1;
    this.uploadedRows = 0; // rows named in uploads so far, a figure for the tests
  }

  set rule(name) {
    this.material.uniforms.rule.value = COLOUR_RULES[name];
  }

  set scale(name) {
    if (name === this.scaleName) return;
    this.scaleName = name;
    this.material.uniforms.scale.value.dispose();
    this.material.uniforms.scale.value = scaleTexture(name);
  }

  set range([low, high]) {
    this.material.uniforms.range.value.set(low, high);
  }

  set heightRange([low, high]) {
    this.material.uniforms.heightRange.value.set(low, Math.max(high, low + 1e-6));
  }

  set shaded(on) {
    this.material.uniforms.shaded.value = on;
  }

  set pointPx(pixels) {
    this.material.uniforms.pointPx.value = pixels;
  }

  // Bring the graphics card up to the store: whole arrays when they were replaced, else only the changed rows.
  upload() {
    const { store } = this;
    const dirty = store.takeDirty();
    const geometry = this.object.geometry;
    if (this.generation !== store.generation) {
      geometry.dispose();
      const fresh = new BufferGeometry();
      const add = (name, array, width) => fresh.setAttribute(name, new BufferAttribute(array, width).setUsage(DynamicDrawUsage));
      add("position", store.xyz, 3);
      add("density", store.density, 1);
      add("direction", store.normal, 3);
      add("state", store.state, 1);
      fresh.boundingSphere = new Sphere(new Vector3(), Infinity);
      this.object.geometry = fresh;
      this.generation = store.generation;
      this.uploadedRows += store.end;
    } else if (dirty.length > 0) {
      for (const attribute of Object.values(geometry.attributes)) {
        for (const [first, count] of dirty) attribute.addUpdateRange(first * attribute.itemSize, count * attribute.itemSize);
        attribute.needsUpdate = true;
      }
      for (const [, count] of dirty) this.uploadedRows += count;
    }
    this.object.geometry.setDrawRange(0, store.end);
  }
}

function texture(bytes, filter) {
  const made = new DataTexture(bytes, bytes.length / 4, 1);
  made.magFilter = made.minFilter = filter;
  made.needsUpdate = true;
  return made;
}

const scaleTexture = (name) => texture(colourTable(name), LinearFilter);
