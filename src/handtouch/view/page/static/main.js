// Receives changes from `handtouch view` and draws them.

import { controlChips, controlHand, controlPads } from "./controls.js";
import { HandView } from "./hand.js";
import { HistoryView } from "./history.js";
import { PadsView } from "./pads.js";
import { Tooltip } from "./tooltip.js";
import { drawMagnification, drawPercepts, drawLegend, drawMessages, drawNodes, drawService } from "./text_panel.js";

const state = {
  connected: false, alive: false, filled: false, scene: null, service: null, joints: {}, pads: {}, contacts: {}, percepts: {}, percepts_enabled: false, messages: [], time_s: 0,
};
const counts = { updates: 0, frames: 0 };
const SLOW_MS = 40;
const byId = (id) => document.getElementById(id);
const hand = new HandView(byId("hand"), byId("labels"));
const pads = new PadsView(byId("pads"));
const tooltip = new Tooltip(byId("tooltip"));
const history = new HistoryView(byId("history"));
byId("fill").addEventListener("change", (event) => {
  state.filled = event.target.checked;
  redraw();
});
let numbers = new Map(); // of pads, by key
let dirty = true;

function applyChanges(changes) {
  if (changes.time_s !== undefined) state.time_s = changes.time_s;
  if (changes.scene) {
    Object.assign(state, { scene: changes.scene, pads: {}, contacts: {}, percepts: {} });
    numbers = new Map(changes.scene.pads.map((pad, number) => [pad.key, number]));
    for (const view of [hand, pads]) view.show(changes.scene);
    history.clear();
  }
  for (const [key, value] of Object.entries(changes)) {
    const [kind, name] = [key.slice(0, key.indexOf("/")), key.slice(key.indexOf("/") + 1)];
    if (kind === "joints") state.joints[name] = value ?? {};
    else if (kind === "pad") state.pads[name] = value;
    else if (kind === "percepts") state.percepts[name] = value;
    else if (kind === "contact") {
      state.contacts[name] = value;
      pads.addSample(name, value, state.time_s);
      if (numbers.has(name)) history.addSample(numbers.get(name), value, state.time_s);
    } else if (["alive", "service", "messages", "percepts_enabled"].includes(key)) state[key] = value;
  }
  if ("alive" in changes || "service" in changes || changes.scene) drawService(state);
  if (changes.scene || "alive" in changes || Object.keys(changes).some((key) => key.startsWith("pad/"))) drawNodes(state);
  if (changes.scene || Object.keys(changes).some((key) => key.startsWith("percepts/"))) drawPercepts(state);
  if (changes.messages) drawMessages(state);
  dirty = true;
}

// Where drawing is slow, as in software, it takes at most half of the time: the processor is shared with controllers.
let drawnAt = 0, pausedUntil = 0;

function redraw() {
  dirty = true;
}

function draw(now) {
  requestAnimationFrame(draw);
  if (drawnAt) {
    if (now - drawnAt > SLOW_MS) pausedUntil = 2 * now - drawnAt;
    drawnAt = 0;
  }
  if (!dirty || now < pausedUntil) return;
  dirty = false;
  drawnAt = now;
  hand.draw(state);
  pads.draw(state);
  tooltip.update(state);
  drawMagnification(hand.magnified);
  history.draw(state.time_s);
  counts.frames += 1;
}

function connect() {
  const changes = new EventSource("changes");
  changes.onopen = () => {
    state.connected = true;
    drawService(state);
    drawNodes(state);
  };
  changes.onmessage = (message) => {
    counts.updates += 1;
    applyChanges(JSON.parse(message.data));
  };
  changes.onerror = () => { // the browser reconnects by itself, unless the response was no event stream
    state.connected = false;
    drawService(state);
    drawNodes(state);
    redraw();
    if (changes.readyState === EventSource.CLOSED) setTimeout(connect, 1000);
  };
}

function reportRates() {
  let before = { ...counts, at: performance.now() };
  setInterval(() => {
    const now = { ...counts, at: performance.now() }, seconds = (now.at - before.at) / 1000;
    const rate = (name) => Math.round((now[name] - before[name]) / seconds);
    byId("rates").textContent = `${rate("updates")} updates/s · ${rate("frames")} frames/s drawn`;
    before = now;
  }, 1000);
}

window.handtouch = { state, counts, hand, pads, tooltip }; // for the console and for tests
drawLegend();
drawService(state);
controlHand(byId("hand"), hand, tooltip, state, redraw);
controlPads(byId("pads"), pads, hand, tooltip, state, redraw);
controlChips(byId("nodes"), hand, tooltip, state, redraw);
new ResizeObserver(redraw).observe(document.body);
reportRates();
connect();
requestAnimationFrame(draw);
