// The tooltip of a pad, beside the pointer or the focused element: status, node, contact and faults.

import { forceText, problemOf, statusText } from "./colours.js";

const AWAY_PX = 14, EDGE_PX = 6;

export class Tooltip {
  constructor(box) {
    this.box = box;
    this.pad = null;
  }

  // Shows a pad's tooltip at a point of the page.
  show(pad, x, y, state) {
    this.pad = pad;
    this.at = [x, y];
    this.update(state);
  }

  hide() {
    this.pad = null;
    this.box.hidden = true;
  }

  // Repeats the pad's present values, which change while the tooltip is open.
  update(state) {
    if (!this.pad) return;
    const { pad } = this, health = state.pads[pad.key], contact = state.contacts[pad.key];
    const known = state.connected && state.alive ? "" : "last known: ";
    const lines = [`${pad.name}: ${known}${statusText(health)}`, pad.node_text];
    if (health?.rate_hz !== undefined) lines[1] += `, ${health.rate_hz} samples/s`;
    if (contact) lines.push(`contact ${contact.id}, ${forceText(contact)}`);
    if (health && problemOf(health)) lines.push(problemOf(health));
    const text = lines.join("\n");
    if (this.box.textContent !== text) this.box.textContent = text;
    this.box.hidden = false;
    const { width, height } = this.box.getBoundingClientRect(), [x, y] = this.at;
    const left = Math.max(EDGE_PX, Math.min(x + AWAY_PX, innerWidth - width - EDGE_PX));
    const below = y + AWAY_PX + height < innerHeight - EDGE_PX;
    this.box.style.transform = `translate(${left}px, ${Math.max(EDGE_PX, below ? y + AWAY_PX : y - AWAY_PX - height)}px)`;
  }
}
