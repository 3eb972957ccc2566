// Follows the changes that `handtouch view` tells, and draws when there are any.

import { HandView } from "./hand.js";
import { HistoryView } from "./history.js";
import { PadsView } from "./pads.js";
import { drawFelt, drawLegend, drawMessages, drawNodes, drawService } from "./panel.js";

const state = {
  connected: false, alive: false, scene: null, service: null, joints: {}, pads: {}, contacts: {}, felt: {}, percepts: false, messages: [], t: 0,
};
const counts = { updates: 0, frames: 0 };
const SLOW_MS = 40;
const byId = (id) => document.getElementById(id);
const hand = new HandView(byId("hand"), byId("labels"));
const pads = new PadsView(byId("pads"));
const history = new HistoryView(byId("history"));
let numbers = new Map(); // of pads, by key
let dirty = true;

function take(changes) {
  if (changes.t !== undefined) state.t = changes.t;
  if (changes.scene) {
    Object.assign(state, { scene: changes.scene, pads: {}, contacts: {}, felt: {} });
    numbers = new Map(changes.scene.pads.map((pad, number) => [pad.key, number]));
    for (const view of [hand, pads]) view.show(changes.scene);
    history.clear();
  }
  for (const [key, value] of Object.entries(changes)) {
    const [kind, name] = [key.slice(0, key.indexOf("/")), key.slice(key.indexOf("/") + 1)];
    if (kind === "joints") state.joints[name] = value ?? {};
    else if (kind === "pad") state.pads[name] = value;
    else if (kind === "felt") state.felt[name] = value;
    else if (kind === "contact") {
      state.contacts[name] = value;
      pads.follow(name, value, state.t);
      if (numbers.has(name)) history.follow(numbers.get(name), value, state.t);
    } else if (["alive", "service", "messages", "percepts"].includes(key)) state[key] = value;
  }
  if ("alive" in changes || "service" in changes || changes.scene) drawService(state);
  if (changes.scene || Object.keys(changes).some((key) => key.startsWith("pad/"))) drawNodes(state);
  if (changes.scene || Object.keys(changes).some((key) => key.startsWith("felt/"))) drawFelt(state);
  if (changes.messages) drawMessages(state);
  dirty = true;
}

// Where drawing takes long, as in software, half of the time is left to others: a controller has better to do.
let drawnAt = 0, restUntil = 0;

function draw(now) {
  requestAnimationFrame(draw);
  if (drawnAt) {
    if (now - drawnAt > SLOW_MS) restUntil = 2 * now - drawnAt;
    drawnAt = 0;
  }
  if (!dirty || now < restUntil) return;
  dirty = false;
  drawnAt = now;
  hand.draw(state);
  pads.draw(state);
  history.draw(state.t);
  counts.frames += 1;
}

function follow() {
  const changes = new EventSource("changes");
  changes.onopen = () => {
    state.connected = true;
    drawService(state);
  };
  changes.onmessage = (message) => {
    counts.updates += 1;
    take(JSON.parse(message.data));
  };
  changes.onerror = () => { // the browser comes back by itself, but for an answer that is no stream
    state.connected = false;
    drawService(state);
    if (changes.readyState === EventSource.CLOSED) setTimeout(follow, 1000);
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

function listen(canvas) {
  let from = null;
  canvas.addEventListener("pointerdown", (event) => {
    from = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointerup", () => { from = null; });
  canvas.addEventListener("pointermove", (event) => {
    const to = [event.clientX, event.clientY];
    if (from) {
      const way = [to[0] - from[0], to[1] - from[1]];
      if (event.shiftKey || event.buttons & 6) hand.move(...way);
      else hand.turn(...way);
      from = to;
    } else hand.hovered = hand.nearest(...to);
    dirty = true;
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    hand.zoom(Math.exp(event.deltaY * 0.001));
    dirty = true;
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { hand.home(); dirty = true; });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  new ResizeObserver(() => { dirty = true; }).observe(document.body);
}

window.handtouch = { state, counts, hand, pads }; // for the console, and for tests
drawLegend();
drawService(state);
listen(byId("hand"));
reportRates();
follow();
requestAnimationFrame(draw);
