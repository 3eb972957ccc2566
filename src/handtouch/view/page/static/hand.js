// The hand in 3-D: links at their joint positions, pads in the colour of their status, contacts.

import * as m from "./matrix.js";
import { Renderer, lathe } from "./renderer.js";
import { BODY, CONTACT, ELLIPSE, STATUS_SIGNS, forceText, colourOfStatus, rgb, statusText } from "./colours.js";

const FIELD_OF_VIEW = (32 * Math.PI) / 180;
const M_PER_N = 0.012, LONGEST_M = 0.06, SHORTEST_M = 0.004;
const HEAD_M = 0.006, DOT_M = 0.0017;
const PAD_NEARER_M = 0.002, CONTACT_NEARER_M = 0.004;
const HOVERED = [1, 1, 1], HOVERED_PART = 0.35; // colour added to the pad under the pointer
const MAGNIFICATIONS = [100, 30, 10, 3, 1]; // of ellipses
const LARGEST_ELLIPSE_M = 0.02; // half axis as drawn; what is larger is cut, and paler
const LINE_PX = 17, PADDING_PX = 12, EDGE_PX = 4; // of a label
const FAULTS = ["stale", "lost", "faulted", "unreliable"]; // statuses that are labelled
const OBJECT_AXIS_M = 0.04; // length of the drawn z axis of a known object
const MAX_FULL_LABELS = 6; // contacts labelled with all percepts; beyond, with motion only
const MAX_PIXEL_RATIO = 1.5; // canvas pixels per page pixel

const decodeFloats = (text) => new Float32Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);

export class HandView {
  constructor(canvas, labels) {
    this.renderer = new Renderer(canvas);
    this.canvas = canvas;
    this.labels = labels;
    this.hovered = null;
    this.magnified = MAGNIFICATIONS[0];
    this.widths = new Map();
    this.scene = null;
    const circle = Array.from({ length: 9 }, (_, k) => -Math.PI / 2 + (Math.PI * k) / 8);
    this.ball = this.renderer.mesh(...lathe(circle.map((a) => [Math.cos(a), Math.sin(a)])));
    this.disc = this.renderer.mesh(...lathe([[1, 0], [0, 0]], 40));
    this.shaft = this.renderer.mesh(...lathe([[1, 0], [1, 1], [0, 1]], 12));
    this.head = this.renderer.mesh(...lathe([[0, 0], [1, 1], [0, 1]], 16));
    this.view = { azimuth: 0, elevation: 0, zoom: 1, shift: [0, 0, 0] };
  }

  show(scene) {
    this.scene = scene;
    const meshes = (parts) => parts.map((part) => ({ ...part, mesh: this.renderer.mesh(decodeFloats(part.corners), decodeFloats(part.normals)) }));
    this.bodies = meshes(scene.bodies);
    this.pads = meshes(scene.pads);
    this.restPoses = scene.nodes.map((node) => m.pose(node.rotation, node.translation));
    this.resetView();
  }

  // Resets the camera.
  resetView() {
    if (!this.scene) return;
    const { direction } = this.scene.camera;
    this.view = { azimuth: Math.atan2(direction[1], direction[0]), elevation: Math.asin(direction[2]), zoom: 1, shift: [0, 0, 0] };
  }

  rotate(right, up) {
    this.view.azimuth -= right * 0.008;
    this.view.elevation = Math.max(-1.55, Math.min(1.55, this.view.elevation + up * 0.008));
  }

  zoom(factor) {
    this.view.zoom = Math.max(0.1, Math.min(6, this.view.zoom * factor));
  }

  pan(right, up) {
    const { view, span } = this.cameraMatrices(), k = span / this.canvas.clientHeight;
    const x = [view[0], view[4], view[8]], y = [view[1], view[5], view[9]];
    this.view.shift = m.add(this.view.shift, m.add(m.scale(x, -right * k), m.scale(y, up * k)));
  }

  cameraMatrices() {
    const { camera } = this.scene, { azimuth, elevation, zoom, shift } = this.view;
    const aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
    const distance = (zoom * camera.radius) / Math.sin(FIELD_OF_VIEW / 2) / Math.min(1, aspect);
    const direction = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
    const centre = m.add(camera.centre, shift);
    const view = m.lookAt(m.add(centre, m.scale(direction, distance)), centre, [0, 0, 1]);
    const projection = m.perspective(FIELD_OF_VIEW, aspect, distance / 50, distance + 8 * camera.radius);
    return { view, projection, span: 2 * distance * Math.tan(FIELD_OF_VIEW / 2) };
  }

  // Returns the poses of the links in the world, at these joint positions.
  linkPoses(joints) {
    const poses = [];
    this.scene.nodes.forEach((node, number) => {
      let pose = this.restPoses[number];
      if (node.joint) {
        const [hand, name] = [node.joint.slice(0, node.joint.indexOf("/")), node.joint.slice(node.joint.indexOf("/") + 1)];
        const position = node.factor * (joints[hand]?.[name] ?? 0) + node.offset;
        const motion = node.prismatic ? m.frame([1, 0, 0], [0, 1, 0], [0, 0, 1], m.scale(node.axis, position)) : m.axisRotation(node.axis, position);
        pose = m.multiply(pose, motion);
      }
      poses.push(node.parent < 0 ? pose : m.multiply(poses[node.parent], pose));
    });
    return poses;
  }

  draw(state) {
    if (!this.scene) return;
    const { renderer } = this, { view, projection } = this.cameraMatrices();
    this.poses = this.linkPoses(state.joints);
    this.viewProjection = m.multiply(projection, view);
    renderer.begin(view, projection, Math.min(MAX_PIXEL_RATIO, window.devicePixelRatio || 1));
    for (const body of this.bodies) renderer.draw(body.mesh, this.poses[body.node], BODY);
    for (const pad of this.pads) {
      const colour = rgb(colourOfStatus(state.pads[pad.key])), hovered = pad.key === this.hovered?.key;
      renderer.draw(pad.mesh, this.poses[pad.node], hovered ? m.mix(colour, HOVERED, HOVERED_PART) : colour, { nearer: PAD_NEARER_M });
    }
    const touched = this.pads.map((pad) => [pad, state.contacts[pad.key]]).filter(([, contact]) => contact?.position_m);
    this.magnified = magnificationOf(touched.map(([, contact]) => contact), this.magnified);
    for (const [pad, contact] of touched) this.drawContact(this.poses[pad.node], contact, false);
    for (const [pad, contact] of touched) this.drawContact(this.poses[pad.node], contact, true);
    for (const [hand, palm] of Object.entries(this.scene.palms)) for (const pose of state.percepts[`${hand}/`]?.poses ?? []) this.drawObject(this.poses[palm], pose);
    this.label(state, touched);
  }

  // Draws a hypothesis about a known object: the 95 % ellipsoid of its position and its z axis; the likelier, the more opaque.
  drawObject(palm, pose) {
    const { renderer } = this, at = m.point(palm, pose.position_m), z = m.unit(m.direction(palm, pose.z)), [x, y] = m.across(z);
    const style = { lit: 0, alpha: 0.1 + 0.6 * pose.weight, nearer: CONTACT_NEARER_M, through: true };
    const [a, b, c] = pose.axes_m.map((axis) => m.direction(palm, axis));
    renderer.draw(this.ball, m.frame(a, b, c, at), rgb(ELLIPSE), style);
    renderer.draw(this.shaft, m.frame(m.scale(x, OBJECT_AXIS_M / 40), m.scale(y, OBJECT_AXIS_M / 40), m.scale(z, OBJECT_AXIS_M), at), rgb(ELLIPSE), style);
  }

  // Draws position, force and 95 % ellipse; what the hand hides shines through.
  drawContact(link, contact, through) {
    const { renderer } = this, colour = rgb(CONTACT);
    const at = m.point(link, contact.position_m), z = m.unit(m.direction(link, contact.normal)), [x, y] = m.across(z);
    const sized = (wide, high, origin) => m.frame(m.scale(x, wide), m.scale(y, wide), m.scale(z, high), origin);
    const style = { lit: 0, alpha: through ? 0.3 : 1, nearer: CONTACT_NEARER_M, through };
    if (!through) {
      const scale = Math.min(this.magnified, LARGEST_ELLIPSE_M / Math.max(halfAxisM(contact), 1e-9));
      const axes = contact.axes_m.map((axis) => m.scale(m.direction(link, axis), scale));
      const disc = m.frame(axes[0], axes[1], z, m.add(at, m.scale(z, 0.0011)));
      renderer.draw(this.disc, disc, rgb(ELLIPSE), { lit: 0, alpha: scale < this.magnified ? 0.3 : 0.8, nearer: PAD_NEARER_M + 0.001 });
    }
    renderer.draw(this.ball, sized(DOT_M, DOT_M, at), colour, style);
    if (contact.force_n === null) return;
    const long = arrowM(contact.force_n), head = Math.min(HEAD_M, 0.6 * long);
    renderer.draw(this.head, sized(head * 0.42, head, m.add(at, m.scale(z, DOT_M))), colour, style);
    renderer.draw(this.shaft, sized(0.0009, long - head, m.add(at, m.scale(z, DOT_M + head))), colour, style);
  }

  // Returns the page coordinates of a point of the world, in pixels.
  pixels(p) {
    const s = this.viewProjection, w = s[3] * p[0] + s[7] * p[1] + s[11] * p[2] + s[15];
    const [x, y] = m.point(s, p), { left, top, width, height } = this.canvas.getBoundingClientRect();
    return [left + ((x / w + 1) / 2) * width, top + ((1 - y / w) / 2) * height];
  }

  // Returns the page coordinates of a point of a pad's link; default: the centre of the pad.
  pixelsOf(key, at) {
    const pad = this.pads.find((one) => one.key === key);
    return this.pixels(m.point(this.poses[pad.node], at ?? pad.centre));
  }

  // Returns the pad whose centre is nearest to a point of the page.
  nearest(x, y) {
    if (!this.scene || !this.viewProjection) return null;
    const far = this.pads.map((pad) => [Math.hypot(...m2(this.pixels(m.point(this.poses[pad.node], pad.centre)), [x, y])), pad]);
    const [distance, pad] = far.reduce((one, two) => (two[0] < one[0] ? two : one), [Infinity, null]);
    return distance < 28 ? pad : null;
  }

  // Returns the middle of each hand's pads, where there are several hands.
  handNames() {
    const points = Map.groupBy ? Map.groupBy(this.pads, (pad) => pad.hand) : new Map();
    if (points.size < 2) return [];
    const middle = (all) => m.scale(all.reduce(m.add), 1 / all.length);
    return [...points].map(([hand, pads]) => [middle(pads.map((pad) => m.point(this.poses[pad.node], pad.centre))), "hand-name", hand]);
  }

  label(state, touched) {
    const labels = [], few = touched.length <= MAX_FULL_LABELS;
    for (const [pad, contact] of touched) {
      const link = this.poses[pad.node], z = m.unit(m.direction(link, contact.normal));
      const end = m.add(m.point(link, contact.position_m), m.scale(z, arrowM(contact.force_n ?? 0) + 0.004));
      const percepts = state.percepts[pad.key], names = percepts?.labels ?? [];
      labels.push([end, "force", [forceText(contact), ...(few ? names : names.slice(0, 1))].join("\n")]);
      if (few) for (const request of percepts?.requests ?? []) labels.push([end, "request", request]);
    }
    for (const pad of this.pads) {
      const health = state.pads[pad.key];
      if (FAULTS.includes(health?.status) && this.countFaults(state) <= 4) labels.push([m.point(this.poses[pad.node], pad.centre), health.status, `${STATUS_SIGNS[health.status]} ${pad.name}: ${statusText(health)}`]);
    }
    labels.push(...this.handNames());
    while (this.labels.children.length < labels.length) this.labels.append(document.createElement("span"));
    const corner = this.canvas.getBoundingClientRect();
    const taken = [...this.canvas.parentElement.querySelectorAll("header, footer")].map((part) => boxOf(part.getBoundingClientRect()));
    [...this.labels.children].forEach((label, number) => {
      label.hidden = number >= labels.length;
      if (label.hidden) return;
      const [at, kind, text] = labels[number];
      const [x, y] = this.freePosition(this.pixels(at), text, corner, taken);
      label.className = kind;
      if (label.textContent !== text) label.textContent = text;
      label.style.transform = `translate(${(x - corner.left).toFixed(1)}px, ${(y - corner.top).toFixed(1)}px) translate(-50%, -50%)`;
    });
  }

  // Returns the nearest position below or above, within the canvas, at which a label covers nothing in `taken`, and adds it there.
  freePosition([wantedX, wantedY], text, corner, taken) {
    const lines = text.split("\n"), wide = Math.max(...lines.map((line) => this.widthOf(line))) + PADDING_PX, high = LINE_PX * lines.length + 2;
    const within = (value, low, size, own) => Math.max(low + own / 2 + EDGE_PX, Math.min(low + size - own / 2 - EDGE_PX, value));
    const x = within(wantedX, corner.left, corner.width, wide), y = within(wantedY, corner.top, corner.height, high);
    const clear = (at) => taken.every((one) => Math.abs(x - one.x) >= (wide + one.wide) / 2 || Math.abs(at - one.y) >= (high + one.high) / 2);
    const steps = Array.from({ length: 120 }, (_, k) => within(y + 4 * Math.ceil(k / 2) * (k % 2 ? 1 : -1), corner.top, corner.height, high));
    const found = steps.find(clear) ?? y;
    taken.push({ x, y: found, wide, high });
    return [x, found];
  }

  // Returns the width of a line of a label, in pixels.
  widthOf(line) {
    const shape = line.replace(/\d/g, "0"); // all digits are equally wide
    if (!this.widths.has(shape)) {
      this.measure ??= document.createElement("canvas").getContext("2d");
      this.measure.font = "600 12px system-ui, sans-serif";
      this.widths.set(shape, this.measure.measureText(shape).width);
    }
    return this.widths.get(shape);
  }

  countFaults(state) {
    return this.pads.filter((pad) => FAULTS.includes(state.pads[pad.key]?.status)).length;
  }
}

const boxOf = ({ left, top, width, height }) => ({ x: left + width / 2, y: top + height / 2, wide: width, high: height });
const halfAxisM = (contact) => Math.max(...contact.axes_m.map((axis) => Math.hypot(...axis)));

// Returns the largest magnification at which every ellipse of a valid position can be drawn whole; a larger one than before
// only with some room to spare, so that it doesn't flicker.
function magnificationOf(contacts, before) {
  const valid = contacts.filter((contact) => contact.position_status === "valid");
  const largest = Math.max(0, ...(valid.length ? valid : contacts).map(halfAxisM));
  if (!largest) return before;
  return MAGNIFICATIONS.find((scale) => scale * largest <= LARGEST_ELLIPSE_M * (scale > before ? 0.7 : 1)) ?? 1;
}

const m2 = (a, b) => [a[0] - b[0], a[1] - b[1]];
const arrowM = (force) => Math.min(LONGEST_M, SHORTEST_M + M_PER_N * force);
