// The hand in 3-D: links as their joints stand, pads in the colour of their health, contacts.

import * as m from "./matrix.js";
import { Renderer, lathe } from "./renderer.js";
import { BODY, CONTACT, ELLIPSE, MAGNIFIED, forceText, lookOf, problemOf, rgb } from "./looks.js";

const FIELD_OF_VIEW = (32 * Math.PI) / 180;
const M_PER_N = 0.012, LONGEST_M = 0.06, SHORTEST_M = 0.004;
const HEAD_M = 0.006, PLACE_M = 0.0017;
const PAD_NEARER_M = 0.002, CONTACT_NEARER_M = 0.004;
const LETTER = 6.4, LINE = 17, ASIDE = 12; // of a label, pixels
const MOST_WORDS = 6; // pads beside which all that is felt stands; of more, only the motion
const MOST_PIXELS = 1.5; // of the canvas to one of the page

const numbers = (text) => new Float32Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);

export class HandView {
  constructor(canvas, labels) {
    this.renderer = new Renderer(canvas);
    this.canvas = canvas;
    this.labels = labels;
    this.hovered = null;
    this.scene = null;
    const circle = Array.from({ length: 9 }, (_, k) => -Math.PI / 2 + (Math.PI * k) / 8);
    this.ball = this.renderer.mesh(...lathe(circle.map((a) => [Math.cos(a), Math.sin(a)])));
    this.disc = this.renderer.mesh(...lathe([[1, 0], [0, 0]], 40));
    this.shaft = this.renderer.mesh(...lathe([[1, 0], [1, 1], [0, 1]], 12));
    this.head = this.renderer.mesh(...lathe([[0, 0], [1, 1], [0, 1]], 16));
    this.view = { round: 0, over: 0, near: 1, shift: [0, 0, 0] };
  }

  show(scene) {
    this.scene = scene;
    const meshes = (things) => things.map((thing) => ({ ...thing, mesh: this.renderer.mesh(numbers(thing.corners), numbers(thing.normals)) }));
    this.bodies = meshes(scene.bodies);
    this.pads = meshes(scene.pads);
    this.still = scene.nodes.map((node) => m.pose(node.turn, node.at));
    this.home();
  }

  // Looks from where it looked at first.
  home() {
    if (!this.scene) return;
    const { toward } = this.scene.camera;
    this.view = { round: Math.atan2(toward[1], toward[0]), over: Math.asin(toward[2]), near: 1, shift: [0, 0, 0] };
  }

  turn(right, up) {
    this.view.round -= right * 0.008;
    this.view.over = Math.max(-1.55, Math.min(1.55, this.view.over + up * 0.008));
  }

  zoom(factor) {
    this.view.near = Math.max(0.1, Math.min(6, this.view.near * factor));
  }

  move(right, up) {
    const { view, span } = this.lookAround(), k = span / this.canvas.clientHeight;
    const x = [view[0], view[4], view[8]], y = [view[1], view[5], view[9]];
    this.view.shift = m.add(this.view.shift, m.add(m.scale(x, -right * k), m.scale(y, up * k)));
  }

  lookAround() {
    const { camera } = this.scene, { round, over, near, shift } = this.view;
    const wide = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
    const fits = Math.min(1, wide), distance = (near * camera.radius * 1.0) / Math.sin(FIELD_OF_VIEW / 2) / fits;
    const toward = [Math.cos(over) * Math.cos(round), Math.cos(over) * Math.sin(round), Math.sin(over)];
    const middle = m.add(camera.middle, shift);
    const view = m.lookAt(m.add(middle, m.scale(toward, distance)), middle, [0, 0, 1]);
    const projection = m.perspective(FIELD_OF_VIEW, wide, distance / 50, distance + 8 * camera.radius);
    return { view, projection, span: 2 * distance * Math.tan(FIELD_OF_VIEW / 2) };
  }

  // Where the links are in the world.
  place(joints) {
    const placed = [];
    this.scene.nodes.forEach((node, number) => {
      let here = this.still[number];
      if (node.joint) {
        const [hand, name] = [node.joint.slice(0, node.joint.indexOf("/")), node.joint.slice(node.joint.indexOf("/") + 1)];
        const at = node.factor * (joints[hand]?.[name] ?? 0) + node.offset;
        const moved = node.slides ? m.frame([1, 0, 0], [0, 1, 0], [0, 0, 1], m.scale(node.axis, at)) : m.turned(node.axis, at);
        here = m.multiply(here, moved);
      }
      placed.push(node.parent < 0 ? here : m.multiply(placed[node.parent], here));
    });
    return placed;
  }

  draw(state) {
    if (!this.scene) return;
    const { renderer } = this, { view, projection } = this.lookAround();
    this.placed = this.place(state.joints);
    this.seen = m.multiply(projection, view);
    renderer.begin(view, projection, Math.min(MOST_PIXELS, window.devicePixelRatio || 1));
    for (const body of this.bodies) renderer.draw(body.mesh, this.placed[body.node], BODY);
    for (const pad of this.pads) renderer.draw(pad.mesh, this.placed[pad.node], rgb(lookOf(state.pads[pad.key])), { nearer: PAD_NEARER_M });
    const touched = this.pads.map((pad) => [pad, state.contacts[pad.key]]).filter(([, contact]) => contact?.at);
    for (const [pad, contact] of touched) this.drawContact(this.placed[pad.node], contact, false);
    for (const [pad, contact] of touched) this.drawContact(this.placed[pad.node], contact, true);
    this.label(state, touched);
  }

  // The place, the push on it, how sure the place is; what is hidden by the hand shines through.
  drawContact(link, contact, through) {
    const { renderer } = this, colour = rgb(CONTACT);
    const at = m.point(link, contact.at), z = m.unit(m.direction(link, contact.normal)), [x, y] = m.across(z);
    const sized = (wide, high, origin) => m.frame(m.scale(x, wide), m.scale(y, wide), m.scale(z, high), origin);
    const how = { lit: 0, alpha: through ? 0.3 : 1, nearer: CONTACT_NEARER_M, through };
    if (!through) {
      const axes = contact.axes.map((axis) => m.scale(m.direction(link, axis), MAGNIFIED));
      const disc = m.frame(axes[0], axes[1], z, m.add(at, m.scale(z, 0.0011)));
      renderer.draw(this.disc, disc, rgb(ELLIPSE), { lit: 0, alpha: 0.8, nearer: PAD_NEARER_M + 0.001 });
    }
    renderer.draw(this.ball, sized(PLACE_M, PLACE_M, at), colour, how);
    if (contact.force_n === null) return;
    const long = arrowM(contact.force_n), head = Math.min(HEAD_M, 0.6 * long);
    renderer.draw(this.head, sized(head * 0.42, head, m.add(at, m.scale(z, PLACE_M))), colour, how);
    renderer.draw(this.shaft, sized(0.0009, long - head, m.add(at, m.scale(z, PLACE_M + head))), colour, how);
  }

  // Pixels of the page at which a point of the world is seen.
  pixels(p) {
    const s = this.seen, w = s[3] * p[0] + s[7] * p[1] + s[11] * p[2] + s[15];
    const [x, y] = m.point(s, p), { left, top, width, height } = this.canvas.getBoundingClientRect();
    return [left + ((x / w + 1) / 2) * width, top + ((1 - y / w) / 2) * height];
  }

  // Where a point of the link that carries a pad is seen.
  pixelsOf(key, at) {
    const pad = this.pads.find((one) => one.key === key);
    return this.pixels(m.point(this.placed[pad.node], at ?? pad.middle));
  }

  // The pad whose middle is nearest to a place on the page.
  nearest(x, y) {
    if (!this.scene || !this.seen) return null;
    const far = this.pads.map((pad) => [Math.hypot(...m2(this.pixels(m.point(this.placed[pad.node], pad.middle)), [x, y])), pad]);
    const [distance, pad] = far.reduce((one, two) => (two[0] < one[0] ? two : one), [Infinity, null]);
    return distance < 28 ? pad : null;
  }

  label(state, touched) {
    const wanted = [], few = touched.length <= MOST_WORDS;
    for (const [pad, contact] of touched) {
      const link = this.placed[pad.node], z = m.unit(m.direction(link, contact.normal));
      const end = m.add(m.point(link, contact.at), m.scale(z, arrowM(contact.force_n ?? 0) + 0.004));
      const felt = state.felt[pad.key], words = felt?.short ?? [];
      wanted.push([end, "force", [forceText(contact), ...(few ? words : words.slice(0, 1))].join("\n")]);
      if (few) for (const ask of felt?.asks ?? []) wanted.push([end, "open", ask]);
    }
    for (const pad of this.pads) {
      const told = state.pads[pad.key], ill = told && ["stale", "lost", "faulted", "doubted"].includes(told.look);
      if (ill && this.ill(state) <= 4) wanted.push([m.point(this.placed[pad.node], pad.middle), told.look, `${pad.link}: ${told.look}`]);
      if (pad === this.hovered) {
        const why = told ? problemOf(told) : "";
        wanted.push([m.point(this.placed[pad.node], pad.middle), "hover", `${pad.link}: ${told?.state ?? "unknown"}, ${pad.where}${why ? `: ${why}` : ""}`]);
      }
    }
    while (this.labels.children.length < wanted.length) this.labels.append(document.createElement("span"));
    const corner = this.canvas.getBoundingClientRect(), taken = [];
    [...this.labels.children].forEach((label, number) => {
      label.hidden = number >= wanted.length;
      if (label.hidden) return;
      const [at, kind, text] = wanted[number];
      const [x, y] = free(this.pixels(at), text, taken);
      label.className = kind;
      if (label.textContent !== text) label.textContent = text;
      label.style.transform = `translate(${(x - corner.left).toFixed(1)}px, ${(y - corner.top).toFixed(1)}px) translate(-50%, -50%)`;
    });
  }

  ill(state) {
    return this.pads.filter((pad) => ["stale", "lost", "faulted", "doubted"].includes(state.pads[pad.key]?.look)).length;
  }
}

// The nearest place below, or else above, where a label covers none of those that are there; it is added to them.
function free([x, y], text, taken) {
  const lines = text.split("\n"), wide = LETTER * Math.max(...lines.map((line) => line.length)) + ASIDE, high = LINE * lines.length + 2;
  const clear = (at) => taken.every((one) => Math.abs(x - one.x) >= (wide + one.wide) / 2 || Math.abs(at - one.y) >= (high + one.high) / 2);
  const steps = Array.from({ length: 60 }, (_, k) => y + 4 * Math.ceil(k / 2) * (k % 2 ? 1 : -1));
  const found = steps.find(clear) ?? y;
  taken.push({ x, y: found, wide, high });
  return [x, found];
}

const m2 = (a, b) => [a[0] - b[0], a[1] - b[1]];
const arrowM = (force) => Math.min(LONGEST_M, SHORTEST_M + M_PER_N * force);
