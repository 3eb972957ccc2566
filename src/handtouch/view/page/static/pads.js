// Every pad unrolled, seen from outside with x0 below, arranged as on the hand: contacts and their trails.

import { CONTACT, EMPTY, STATUS_SIGNS, colourOf, fillOf, forceText, colourOfStatus, statusOf } from "./colours.js";

const TRAIL_S = 4, GAP = 6, LABEL = 26, HEADER = 16, REACH_PX = 5;

export class PadsView {
  constructor(canvas) {
    this.canvas = canvas;
    this.trails = {};
    this.boxes = {}; // [left, top, width, height] of each pad in the canvas
  }

  show(scene) {
    this.scene = scene;
    this.trails = {};
    this.sizes = scene.pads.map(({ outline }) => {
      const u = outline.map((p) => p[0]), v = outline.map((p) => p[1]);
      return [Math.max(...u), Math.max(...v) - Math.min(...v)];
    });
  }

  // Adds a new position of a contact, or its end; `t` in seconds.
  addSample(key, contact, t) {
    const trail = (this.trails[key] ??= []);
    if (contact?.pad_m) trail.push({ t, id: contact.id, position: contact.pad_m });
  }

  draw(state) {
    if (!this.scene) return;
    const context = clearedContext(this.canvas), wide = this.canvas.clientWidth, high = this.canvas.clientHeight;
    const columns = this.scene.columns, widths = columns.map((c) => Math.max(...c.map((k) => this.sizes[k][1])));
    const across = widths.reduce((a, b) => a + b, 0);
    const tall = columns.map((c) => c.reduce((sum, k) => sum + this.sizes[k][0], 0));
    const most = Math.max(...columns.map((c) => c.length));
    const k = Math.max(200, Math.min((wide - GAP * (columns.length + 1)) / across, (high - HEADER - most * (LABEL + GAP)) / Math.max(...tall)));
    const gap = (wide - across * k) / (columns.length + 1); // columns as far apart as there is room, for their texts
    let x = gap;
    columns.forEach((column, number) => {
      const middle = x + (widths[number] * k) / 2;
      const used = tall[number] * k + column.length * (LABEL + GAP) - GAP;
      let y = high - used - GAP;
      const first = this.scene.pads[column[0]], hand = first.name === first.link ? "" : `${first.hand} `;
      if (column.length > 1 || hand) this.write(context, hand + (column.length > 1 ? digitOf(first.link) : ""), middle, 11, "#d5dce4", 600);
      for (const pad of [...column].reverse()) { // the fingertip on top
        const size = this.sizes[pad][0] * k;
        this.drawPad(context, state, pad, middle, y + LABEL + size / 2, k);
        y += size + LABEL + GAP;
      }
      x += widths[number] * k + gap;
    });
  }

  // Returns the pad at a point of the canvas.
  padAt(x, y) {
    return this.scene?.pads.find((pad) => {
      const [left, top, wide, high] = this.boxes[pad.key] ?? [Infinity, 0, 0, 0];
      return x > left - REACH_PX && x < left + wide + REACH_PX && y > top - REACH_PX && y < top + high + REACH_PX;
    }) ?? null;
  }

  drawPad(context, state, number, middle, centre, k) {
    const pad = this.scene.pads[number], health = state.pads[pad.key], contact = state.contacts[pad.key];
    const [long] = this.sizes[number];
    const toCanvas = (u, offset) => [middle - offset * k, centre - (u - long / 2) * k];
    const half = halfWidth(pad.outline);
    const onPad = ([u, v]) => toCanvas(u, v - half(u)); // seen from outside with x up, y points to the left
    context.beginPath();
    pad.outline.forEach(([u, offset]) => context.lineTo(...toCanvas(u, offset)));
    context.closePath();
    context.fillStyle = state.filled ? fillOf(contact) : EMPTY;
    context.fill();
    context.lineWidth = 1.5;
    context.strokeStyle = colourOfStatus(health);
    context.stroke();
    if (!["clear", "unreliable"].includes(statusOf(health))) this.write(context, STATUS_SIGNS[statusOf(health)], middle, centre + 5, colourOfStatus(health), 600, 16);
    const trail = (this.trails[pad.key] ?? []).filter((point) => state.time_s - point.t < TRAIL_S);
    this.trails[pad.key] = trail;
    context.lineWidth = 2;
    for (let j = 1; j < trail.length; j++) {
      if (trail[j].id !== trail[j - 1].id) continue;
      context.globalAlpha = 1 - (state.time_s - trail[j].t) / TRAIL_S;
      context.strokeStyle = colourOf(number);
      context.beginPath();
      context.moveTo(...onPad(trail[j - 1].position));
      context.lineTo(...onPad(trail[j].position));
      context.stroke();
    }
    context.globalAlpha = 1;
    const across = this.sizes[number][1];
    this.boxes[pad.key] = [...toCanvas(long, across / 2), across * k, long * k];
    if (contact?.pad_m) {
      const [px, py] = onPad(contact.pad_m);
      context.fillStyle = CONTACT;
      context.beginPath();
      context.arc(px, py, 3 + Math.min(6, 2 * Math.sqrt(contact.force_n ?? 0)), 0, 2 * Math.PI);
      context.fill();
    }
    const top = centre - (long / 2) * k - 4, column = this.scene.columns.find((c) => c.includes(number));
    const name = column.length > 1 ? pad.link.slice(digitOf(pad.link).length + 1) || pad.link : pad.link;
    this.write(context, name.replaceAll("_", " "), middle, top - (contact ? 12 : 0), "#aeb8c4");
    if (contact) this.write(context, forceText(contact), middle, top, colourOf(number, 74), 600);
  }

  write(context, text, x, y, colour, weight = 400, size = 11) {
    context.font = `${weight} ${size}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.fillStyle = colour;
    context.fillText(text, x, y);
  }
}

const digitOf = (link) => link.split("_")[0];

// Returns half the width of an unrolled pad as a function of arc length.
function halfWidth(outline) {
  const upper = outline.slice(0, outline.length / 2);
  return (u) => {
    const at = upper.findIndex((p) => p[0] >= u);
    if (at <= 0) return upper[at === 0 ? 0 : upper.length - 1][1];
    const [[u0, v0], [u1, v1]] = [upper[at - 1], upper[at]];
    return v0 + ((v1 - v0) * (u - u0)) / (u1 - u0);
  };
}

// Returns the context of a canvas resized to screen resolution and cleared.
export function clearedContext(canvas) {
  const pixels = window.devicePixelRatio || 1;
  const wide = Math.round(canvas.clientWidth * pixels), high = Math.round(canvas.clientHeight * pixels);
  if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
  const context = canvas.getContext("2d");
  context.setTransform(pixels, 0, 0, pixels, 0, 0);
  context.clearRect(0, 0, wide, high);
  return context;
}
