// Colours of statuses and pads, and texts of forces and problems.

// Distinguishable with each kind of colour blindness (tests/view/test_colours.py); a sign repeats each of them.
export const STATUS_COLOURS = {
  clear: "#4fa58b", unreliable: "#f2d64b", stale: "#e07b2e", lost: "#e5484d", faulted: "#e5484d",
  starting: "#c9d1da", off: "#4a525e",
};
export const STATUS_SIGNS = { clear: "●", unreliable: "◆", stale: "▲", lost: "✕", faulted: "✕", starting: "○", off: "–" };
export const LEGEND = [
  ["clear", "ok"], ["unreliable", "unreliable"], ["stale", "stale"], ["lost", "lost or faulted"], ["starting", "starting"], ["off", "off"],
];
export const BODY = [0.36, 0.4, 0.46];
export const CONTACT = "#ff5a1f";
export const EMPTY = "#1a2028";
const FULL_FORCE_N = 5;
export const ELLIPSE = "#ffe9a8";

export const rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
export const statusOf = (pad) => (pad?.status in STATUS_COLOURS ? pad.status : "starting");
export const colourOfStatus = (pad) => STATUS_COLOURS[statusOf(pad)];

// Returns the state of a pad and its node in words: "ok", "stale", "lost, node absent".
export function statusText(pad) {
  const status = statusOf(pad), node = pad?.node_state;
  if (status === "clear") return "ok";
  return node && node !== "operational" && node !== status ? `${status}, node ${node}` : status;
}

// Colour that fills a pad by the root of its force, so that light touches show, too.
export function fillOf(contact) {
  const part = Math.min(1, Math.sqrt(Math.max(0, contact?.force_n ?? 0) / FULL_FORCE_N));
  const mixed = rgb(EMPTY).map((from, k) => Math.round(255 * (from + (rgb(CONTACT)[k] - from) * part)));
  return `rgb(${mixed.join(" ")})`;
}

// Colour of a pad's trail and force history.
export const colourOf = (number, lightness = 66) => `hsl(${(number * 137.5 + 190) % 360} 70% ${lightness}%)`;

export function forceText(contact) {
  if (contact.force_n === null) return "?";
  if (contact.force_status === "lower_bound") return `> ${contact.force_n.toFixed(2)} N`;
  return `${contact.force_status === "unreliable" ? "~ " : ""}${contact.force_n.toFixed(2)} N`;
}

export const problemOf = (state) => [state.reason, ...(state.diagnoses ?? [])].filter(Boolean).join("; ");
