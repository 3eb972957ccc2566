// Text of the page: daemon, buses, nodes, percepts and messages.

import { LEGEND, STATUS_COLOURS, STATUS_SIGNS, colourOfStatus, statusOf, statusText } from "./colours.js";

const byId = (id) => document.getElementById(id);

function set(id, text) {
  if (byId(id).textContent !== text) byId(id).textContent = text;
}

function element(kind, className, text) {
  const made = document.createElement(kind);
  made.className = className;
  made.textContent = text;
  return made;
}

function signOf(status) {
  const sign = element("i", "sign", STATUS_SIGNS[status]);
  sign.style.color = STATUS_COLOURS[status];
  return sign;
}

export function drawMagnification(magnified) {
  set("magnified", magnified === 1 ? "to scale" : `magnified ${magnified} times`);
}

export function drawLegend() {
  for (const [status, text] of LEGEND) {
    const entry = element("span", "", text);
    entry.prepend(signOf(status));
    byId("legend").append(entry);
  }
}

export function drawService({ connected, alive, service, scene }) {
  const waiting = !scene;
  const trouble = !connected ? "disconnected from handtouch view; start it again and this page reconnects"
    : waiting ? "waiting for the daemon ..."
    : !alive ? "daemon disconnected; check that handtouch run is running" : "";
  document.body.classList.toggle("disconnected", Boolean(trouble));
  set("trouble", trouble);
  byId("trouble").hidden = !trouble;
  byId("status").style.background = trouble ? STATUS_COLOURS.lost : STATUS_COLOURS.clear;
  if (!service) return;
  const tick = service.tick_us ? `tick ${(service.tick_us / 1000).toFixed(2)} ms` : "";
  const supervisor = service.supervisor ? `supervisor ${service.supervisor}` : "";
  set("service", [`handtouch ${service.version}`, `${service.tick_rate} ticks/s`, tick, `${service.congestion_episodes} congestion episodes`, supervisor].filter(Boolean).join(" · "));
  byId("buses").replaceChildren(...Object.entries(service.buses).map(([name, bus]) => {
    const faulty = bus.state !== "active" || bus.problem;
    const line = element("div", faulty ? "faulty" : "", `${name} ${bus.state}, load ${Math.round(100 * bus.load)} %${bus.problem ? `: ${bus.problem}` : ""}`);
    const load = element("b", "load", ""), part = element("i", "", "");
    part.style.width = `${Math.min(100, 100 * bus.load)}%`;
    load.append(part);
    line.append(load);
    return line;
  }));
}

// Every pad with its status; count, sign, colour and words follow from the same status, the last known one without a daemon.
export function drawNodes({ connected, alive, scene, pads }) {
  if (!scene) return;
  const counts = new Map();
  for (const { key } of scene.pads) {
    const status = statusOf(pads[key]) === "clear" ? "ok" : statusOf(pads[key]);
    counts.set(status, (counts.get(status) ?? 0) + 1);
  }
  const others = [...counts].filter(([status]) => status !== "ok").map(([status, count]) => `${count} ${status}`);
  set("up", (connected && alive ? "" : "last known: ") + [`${counts.get("ok") ?? 0} of ${scene.pads.length} ok`, ...others].join(" · "));
  const list = byId("nodes"), chips = new Map([...list.children].map((chip) => [chip.dataset.key, chip]));
  const shown = scene.pads.map((pad) => chips.get(pad.key) ?? newChip(pad));
  if (shown.length !== chips.size || shown.some((chip) => !chip.isConnected)) list.replaceChildren(...shown);
  shown.forEach((chip, number) => {
    const health = pads[scene.pads[number].key], words = statusText(health), [sign, , note] = chip.children;
    sign.textContent = STATUS_SIGNS[statusOf(health)];
    sign.style.color = colourOfStatus(health);
    note.textContent = words === "ok" ? "" : words.split(",")[0];
    chip.setAttribute("aria-label", `${scene.pads[number].name}: ${words}`);
  });
}

// Returns the chip of a pad, a button so that the keyboard reaches it; it stays while its pad is shown, and keeps the focus.
function newChip(pad) {
  const chip = element("button", "", "");
  chip.type = "button";
  chip.dataset.key = pad.key;
  chip.append(signOf("starting"), element("span", "", pad.name.replace(/[^/]*$/, (link) => link.replaceAll("_", " "))), element("em", "", ""));
  return chip;
}

// Percepts of each contact and of the whole hand, and action requests.
export function drawPercepts({ scene, percepts, percepts_enabled: enabled }) {
  if (!scene) return;
  if (!enabled) return byId("percepts").replaceChildren(element("li", "dim", "handtouch view --percepts shows slip, shape and friction"));
  const order = new Map(scene.pads.map((pad, number) => [pad.key, number]));
  const entries = Object.entries(percepts).filter(([, summary]) => summary);
  entries.sort(([a], [b]) => (order.get(a) ?? -1) - (order.get(b) ?? -1)); // whole hands first
  const names = new Map(scene.pads.map((pad) => [pad.key, pad.name]));
  const nameOf = (key) => (key.endsWith("/") ? `${key.slice(0, -1)} hand` : (names.get(key) ?? key).replaceAll("_", " "));
  const known = ([, summary]) => summary.lines.length || summary.requests.length, lines = [];
  for (const [key, summary] of entries.filter(known)) {
    const line = element("li", "", "");
    line.append(element("b", "", nameOf(key)), ` ${summary.lines.join(" · ")}`);
    for (const request of summary.requests) line.append(element("em", "", request));
    line.title = summary.missing.join("\n");
    lines.push(line);
  }
  const open = entries.filter((entry) => !known(entry)), line = element("li", "dim", "");
  line.textContent = open.length ? `not determined yet: ${lines.length ? `${open.length} more` : open.length === 1 ? "one contact" : `${open.length} contacts`}` : "no percepts";
  line.title = open.map(([key, summary]) => `${nameOf(key)}: ${summary.missing.join("; ")}`).join("\n");
  byId("percepts").replaceChildren(...lines, ...(open.length || !lines.length ? [line] : []));
}

export function drawMessages({ messages }) {
  const newest = [...messages].reverse();
  byId("messages").replaceChildren(...newest.map(({ wall_s, links, text, status, count }) => {
    const line = element("li", "", ""), time = wall_s ? new Date(1000 * wall_s).toLocaleTimeString("en-GB") : "";
    line.style.borderColor = STATUS_COLOURS[status] ?? STATUS_COLOURS.starting;
    line.append(element("time", "", time));
    if (links.length) line.append(element("b", "", links.length > 3 ? `${links.length} pads` : links.join(", ")), " ");
    line.append(text);
    if (count > 1) line.append(" ", element("em", "", `${count} times`));
    line.title = links.length > 3 ? links.join(", ") : "";
    return line;
  }));
  byId("no-messages").hidden = messages.length > 0;
}
