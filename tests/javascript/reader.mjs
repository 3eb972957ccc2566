// Subscriber of a handtouch daemon, written from docs/wire.md: node reader.mjs ENDPOINT TOPIC...
//
// A TOPIC that ends with a slash includes all topics below it. Every message is printed as one line of
// JSON, {"topic", "payload"}, with columns as arrays, unknown values as null, and integers of any size.
// {"alive": false} and {"alive": true} report that the daemon disconnected and connected again. At the end of
// standard input, {"summary"} is printed with all counters, and the program ends.

import { readFileSync } from "node:fs";

import { decode } from "@msgpack/msgpack";
import { Subscriber } from "zeromq";

const VERSION = 1;
const SERVICE_TIMEOUT_MS = 1500;
const PARTS = { contact: 3, hand: 2, health: 3, raw: 2, service: 1 };

const uint8 = { bytes: 1, read: (view, at) => view.getUint8(at) };
const uint32 = { bytes: 4, read: (view, at) => view.getUint32(at, true) };
const int64 = { bytes: 8, read: (view, at) => view.getBigInt64(at, true) };
const float32 = { bytes: 4, read: (view, at) => view.getFloat32(at, true) };

// as docs/wire.schema.json declares them: topic -> column -> {type, elements}
const ELEMENTS = { uint8, uint32, int64, float32 };
const SCHEMA = JSON.parse(readFileSync(new URL("wire.schema.json", import.meta.url)));
const DEFINITIONS = { hand: SCHEMA.$defs.HandFrame, raw: SCHEMA.$defs.Raw };

function columnOf(bytes, column, rows) {
  const [type, elements] = [ELEMENTS[column.type], column.elements];
  if (!(bytes instanceof Uint8Array) || bytes.length !== rows * elements * type.bytes) {
    throw new Error("a column doesn't match its links");
  }
  // the bytes are not aligned in the message, so a typed array can't view them in place
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const element = (index) => type.read(view, index * type.bytes);
  if (elements === 1) return Array.from({ length: rows }, (_, row) => element(row));
  return Array.from({ length: rows }, (_, row) =>
    Array.from({ length: elements }, (_, column) => element(row * elements + column)),
  );
}

function read(parts) {
  if (parts.length !== 2) throw new Error("not two parts");
  const topic = parts[0].toString("utf8");
  const kind = topic.split("/")[0];
  if (PARTS[kind] !== topic.split("/").length) throw new Error("no such topic");
  const payload = decode(parts[1], { useBigInt64: true });
  if (payload?.v !== VERSION) throw new Error("another version");
  for (const key of ["session", "seq"]) {
    if (!["number", "bigint"].includes(typeof payload[key])) throw new Error(`no ${key}`);
  }
  const { properties, required } = DEFINITIONS[kind] ?? { properties: {}, required: [] };
  for (const [name, { column }] of Object.entries(properties)) {
    if (column && (name in payload || required.includes(name))) {
      payload[name] = columnOf(payload[name], column, payload.links.length);
    }
  }
  return { topic, payload };
}

class SequenceTracker {
  gaps = 0;
  retained = 0;
  restarts = 0;
  #session = null;
  #seq = new Map();

  // returns true for a new message
  accept({ topic, payload }) {
    if (this.#session !== null && payload.session !== this.#session) {
      this.restarts += 1;
      this.#seq.clear();
    }
    this.#session = payload.session;
    const seq = Number(payload.seq);
    const last = this.#seq.get(topic);
    if (last !== undefined) {
      if (payload.retained && seq <= last) {
        this.retained += 1;
        return false;
      }
      this.gaps += Math.max(0, seq - last - 1);
    }
    this.#seq.set(topic, seq);
    return true;
  }
}

const MARK = "an integer: "; // JSON.stringify doesn't support BigInt
function print(value) {
  const text = JSON.stringify(value, (_, item) => (typeof item === "bigint" ? `${MARK}${item}` : item));
  process.stdout.write(text.replaceAll(new RegExp(`"${MARK}(-?\\d+)"`, "g"), "$1") + "\n");
}

const [endpoint, ...topics] = process.argv.slice(2);
const subscribed = (topic) => topics.some((t) => (t.endsWith("/") ? topic.startsWith(t) : topic === t));
const keepalive = { tcpKeepalive: 1, tcpKeepaliveIdle: 1, tcpKeepaliveInterval: 1, tcpKeepaliveCount: 2 };
const socket = new Subscriber({ receiveHighWaterMark: 100_000, linger: 0, ...keepalive });
socket.connect(endpoint);
socket.subscribe(...topics, "service");

const tracker = new SequenceTracker();
let malformed = 0;
let alive = false;
let receivedMs = 0;
const watch = setInterval(() => {
  if (alive && performance.now() - receivedMs > SERVICE_TIMEOUT_MS) print({ alive: (alive = false) });
}, 50);
process.stdin.resume();
process.stdin.on("end", () => socket.close());

for await (const parts of socket) {
  receivedMs = performance.now();
  if (!alive) print({ alive: (alive = true) });
  if (!subscribed(parts[0].toString("utf8"))) continue;
  try {
    const message = read(parts);
    if (tracker.accept(message)) print(message);
  } catch {
    malformed += 1;
  }
}
clearInterval(watch);
const { gaps, retained, restarts } = tracker;
print({ summary: { gaps, retained, restarts, malformed } });
