// Print what the JavaScript client reads, as lines of JSON; as tests/cpp/dump.cpp does.
//
//     node dump.mjs all ENDPOINT COUNT     every contact and hand message, until so many have come
//     node dump.mjs newest ENDPOINT COUNT  newest frames of the hand `right`, and the contacts with each
//     node dump.mjs decode                 for each line of hexadecimal digits "ok" or "refused"
import { createInterface } from "node:readline";

import { Hand, WireError, decodeContact, decodeFrame } from "handtouch";
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
  const hand = new Hand("right", { endpoint });
  hand.onContact((contact) => print("contact", contact));
  for (let i = 0; i < count; i += 1) {
    const frame = await hand.wait(60_000);
    const contacts = [...hand.contacts].map(([link, contact]) => [link, contact.id]);
    print("hand", frame, { contacts: Object.fromEntries(contacts) });
  }
  hand.close();
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
await { all, newest, decode: decodeLines }[mode](endpoint, Number(count));
