// Force of each pad over the last seconds.

import { colourOf } from "./colours.js";
import { clearedContext } from "./pads.js";

const SPAN_S = 10, LEFT = 30, BOTTOM = 16, TOP = 6;

export class HistoryView {
  constructor(canvas) {
    this.canvas = canvas;
    this.lines = new Map();
  }

  addSample(number, contact, t) {
    if (!this.lines.has(number)) this.lines.set(number, []);
    const line = this.lines.get(number);
    const force = contact ? contact.force_n : null;
    if (force !== null || line.at(-1)?.force != null) line.push({ t, force });
  }

  clear() {
    this.lines.clear();
  }

  draw(t) {
    const context = clearedContext(this.canvas), wide = this.canvas.clientWidth - LEFT, high = this.canvas.clientHeight - BOTTOM - TOP;
    let most = 0;
    for (const line of this.lines.values()) {
      while (line.length && t - line[0].t > SPAN_S + 1) line.shift();
      for (const { force } of line) most = Math.max(most, force ?? 0);
    }
    const step = [0.25, 0.5, 1, 2, 5, 10, 20, 50].find((s) => most / s <= 4) ?? 100;
    const upper = Math.max(2, Math.ceil(most / step)) * step;
    const x = (at) => LEFT + wide * (1 - (t - at) / SPAN_S), y = (force) => TOP + high * (1 - force / upper);
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    for (let force = 0; force <= upper + 1e-9; force += step) {
      context.strokeStyle = force ? "#252d37" : "#4a5563";
      context.beginPath();
      context.moveTo(LEFT, y(force));
      context.lineTo(LEFT + wide, y(force));
      context.stroke();
      context.fillStyle = "#8b96a3";
      context.textAlign = "right";
      context.fillText(`${+force.toFixed(2)}`, LEFT - 5, y(force) + 4);
    }
    for (let back = 0; back <= SPAN_S; back += 2) {
      context.textAlign = back === 0 ? "right" : "center";
      context.fillText(back === 0 ? "now" : `−${back} s`, back === SPAN_S ? LEFT + 12 : LEFT + wide * (1 - back / SPAN_S), TOP + high + 13);
    }
    context.save();
    context.beginPath();
    context.rect(LEFT, 0, wide, TOP + high + 1);
    context.clip();
    context.lineWidth = 1.75;
    context.lineJoin = "round";
    for (const [number, line] of this.lines) {
      context.strokeStyle = colourOf(number);
      context.beginPath();
      line.forEach(({ t: at, force }, k) => {
        if (force === null) return;
        if (k > 0 && line[k - 1].force !== null) context.lineTo(x(at), y(force));
        else context.moveTo(x(at), y(force));
      });
      context.stroke();
    }
    context.restore();
  }
}
