// Print what the JavaScript client reads, as lines of JSON; as tests/cpp/dump.cpp does.
//
//     node dump.mjs all ENDPOINT COUNT     every contact and hand message, until so many have come
//     node dump.mjs newest ENDPOINT COUNT  newest frames of the hand `right`, and the contacts with each
//     node dump.mjs ages ENDPOINT COUNT    after a line of input, the ages of so many newest frames, or "none"
//     node dump.mjs unknown ENDPOINT       the error of a hand that the daemon doesn't have
//     node dump.mjs touched                for each line of hexadecimal digits whether the first pad is touched
//     node dump.mjs decode                 for each line of hexadecimal digits "ok" or "refused"
import { readSync } from "node:fs";
import { createInterface } from "node:readline";

import { Hand, NotSampledError, UnknownNameError, WireError, decodeContact, decodeFrame } from "handtouch";
import { Subscriber } from "zeromq";

// an integer beyond 2^53 is printed as text; JSON.stringify makes null of NaN
function print(kind, message, more = {}) {
  const plain = (_, value) => {
    if (typeof value === "bigint") return `${value}`;
    return ArrayBuffer.isView(value) ? Array.from(value) : value;
  };
  process.stdout.write(`${JSON.stringify({ kind, ...message, ...more }, plain)}\n`);
}

async function all(endpoint, count) {
  const socket = new Subscriber({ receiveHighWaterMark: 100_000, linger: 0 });
  socket.connect(endpoint);
  socket.subscribe();
  for (let i = 0; i < count; i += 1) {
    const [topic, payload] = await socket.receive();
    if (topic.toString().startsWith("contact/")) print("contact", decodeContact(payload));
    else print("hand", decodeFrame(payload));
  }
  socket.close();
}

async function newest(endpoint, count) {
  const hand = new Hand("right", { endpoint, maxAgeMs: 1e15 }); // whatever its age
  hand.onContact((contact) => print("contact", contact));
  for (let i = 0; i < count; i += 1) {
    const frame = await hand.wait(60_000);
    const contacts = [...hand.contacts].map(([link, contact]) => [link, contact.id]);
    print("hand", frame, { contacts: Object.fromEntries(contacts) });
  }
  hand.close();
}

async function ages(endpoint, count) {
  const hand = new Hand("right", { endpoint });
  while ((await hand.wait(10)) === null) continue;
  console.log('{"kind":"ready"}');
  readSync(0, Buffer.alloc(1)); // blocks the event loop, as a long computation does
  for (let i = 0; i < count; i += 1) {
    const frame = await hand.latest();
    if (frame === null) print("none", {});
    else print("hand", { age_s: Number(process.hrtime.bigint() - frame.t_ns) / 1e9 });
    await new Promise((resolve) => setTimeout(resolve, 5));
  }
  hand.close();
}

async function unknown(endpoint) {
  const hand = new Hand("rigth", { endpoint });
  await hand.wait(60_000).catch((error) => {
    if (!(error instanceof UnknownNameError)) throw error;
    console.log(error.message);
  });
  hand.close();
}

async function touchedLines() {
  for await (const line of createInterface({ input: process.stdin })) {
    const frame = decodeFrame(Buffer.from(line, "hex"));
    try {
      console.log(frame.touched(frame.links[0]) ? "touched" : "clear");
    } catch (error) {
      if (!(error instanceof NotSampledError)) throw error;
      console.log(error.message);
    }
  }
}

async function decodeLines() {
  for await (const line of createInterface({ input: process.stdin })) {
    try {
      decodeFrame(Buffer.from(line, "hex"));
      console.log("ok");
    } catch (error) {
      if (!(error instanceof WireError)) throw error;
      console.log("refused");
    }
  }
}

const [mode, endpoint, count] = process.argv.slice(2);
await { all, newest, ages, unknown, touched: touchedLines, decode: decodeLines }[mode](endpoint, Number(count));
