// What is told in words: the daemon, its buses and nodes, messages.

import { LEGEND, LOOK, lookOf, problemOf } from "./looks.js";

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

export function drawLegend() {
  for (const [look, text] of LEGEND) {
    const entry = element("span", "", text), dot = element("i", "dot", "");
    dot.style.background = LOOK[look];
    entry.prepend(dot);
    byId("legend").append(entry);
  }
}

export function drawService({ connected, alive, service, scene }) {
  const waiting = !scene;
  const trouble = !connected ? "handtouch view has ended: start it again and this page follows"
    : waiting ? "waiting for the daemon ..."
    : !alive ? "the daemon is silent: is handtouch run up?" : "";
  document.body.classList.toggle("silent", Boolean(trouble));
  set("trouble", trouble);
  byId("trouble").hidden = !trouble;
  byId("status").style.background = trouble ? LOOK.lost : LOOK.clear;
  if (!service) return;
  const tick = service.tick_us ? `tick ${(service.tick_us / 1000).toFixed(2)} ms` : "";
  const supervisor = service.supervisor ? `supervisor ${service.supervisor}` : "";
  set("service", [`handtouch ${service.version}`, `${service.rate_hz} ticks/s`, tick, `${service.drops} dropped`, supervisor].filter(Boolean).join(" · "));
  byId("buses").replaceChildren(...Object.entries(service.buses).map(([name, bus]) => {
    const ill = bus.state !== "active" || bus.problem;
    const line = element("div", ill ? "ill" : "", `${name} ${bus.state}, load ${Math.round(100 * bus.load)} %${bus.problem ? `: ${bus.problem}` : ""}`);
    const load = element("b", "load", ""), part = element("i", "", "");
    part.style.width = `${Math.min(100, 100 * bus.load)}%`;
    load.append(part);
    line.append(load);
    return line;
  }));
}

export function drawNodes({ scene, pads }) {
  if (!scene) return;
  const up = scene.pads.filter((pad) => pads[pad.key]?.node === "operational").length;
  set("up", `${up} of ${scene.pads.length} operational`);
  byId("nodes").replaceChildren(...scene.pads.map((pad) => {
    const told = pads[pad.key], chip = element("span", "", pad.link.replaceAll("_", " "));
    const dot = element("i", "dot", "");
    dot.style.background = lookOf(told);
    chip.prepend(dot);
    if (told?.node && told.node !== "operational") chip.append(element("em", "", told.node));
    chip.title = `${pad.link}, ${pad.where}: ${told ? `${told.state}, ${told.node ?? "?"}, ${told.hz ?? 0} samples/s` : "unknown"}${told && problemOf(told) ? `\n${problemOf(told)}` : ""}`;
    return chip;
  }));
}

// What is felt of each touch and of the whole hand, and what is open, in words.
export function drawFelt({ scene, felt, percepts }) {
  if (!scene) return;
  if (!percepts) return byId("felt").replaceChildren(element("li", "dim", "handtouch view --percepts tells slip, hardness, shape, texture"));
  const order = new Map(scene.pads.map((pad, number) => [pad.key, number]));
  const entries = Object.entries(felt).filter(([, told]) => told);
  entries.sort(([a], [b]) => (order.get(a) ?? -1) - (order.get(b) ?? -1)); // whole hands first
  const nameOf = (key) => (key.endsWith("/") ? `${key.slice(0, -1)} hand` : key.slice(key.indexOf("/") + 1).replaceAll("_", " "));
  const known = ([, told]) => told.lines.length || told.asks.length, lines = [];
  for (const [key, told] of entries.filter(known)) {
    const line = element("li", "", "");
    line.append(element("b", "", nameOf(key)), ` ${told.lines.join(" · ")}`);
    for (const ask of told.asks) line.append(element("em", "", ask));
    line.title = told.missing.join("\n");
    lines.push(line);
  }
  const open = entries.filter((entry) => !known(entry)), line = element("li", "dim", "");
  line.textContent = open.length ? `too little is known yet of ${lines.length ? `${open.length} more` : open.length === 1 ? "one touch" : `${open.length} touches`}` : "nothing beyond contacts";
  line.title = open.map(([key, told]) => `${nameOf(key)}: ${told.missing.join("; ")}`).join("\n");
  byId("felt").replaceChildren(...lines, ...(open.length || !lines.length ? [line] : []));
}

export function drawMessages({ messages }) {
  const newest = [...messages].reverse();
  byId("messages").replaceChildren(...newest.map(({ at_s, links, text, look }) => {
    const line = element("li", "", ""), time = at_s ? new Date(1000 * at_s).toLocaleTimeString("en-GB") : "";
    line.style.borderColor = LOOK[look] ?? LOOK.starting;
    line.append(element("time", "", time));
    if (links.length) line.append(element("b", "", links.length > 3 ? `${links.length} pads` : links.join(", ")), " ");
    line.append(text);
    line.title = links.length > 3 ? links.join(", ") : "";
    return line;
  }));
  byId("quiet").hidden = messages.length > 0;
}
