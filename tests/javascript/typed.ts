// Compiled, not run: the types of the JavaScript client.
import { Hand, type Contact, type Frame } from "handtouch";

const hand = new Hand("right", { endpoint: "tcp://127.0.0.1:5580" });
const frame: Frame | null = await hand.latest();
if (frame !== null) {
  const force_n: number = frame.at("force_n", "index_distal");
  const position_m: Float32Array = frame.at("position_m", "index_distal");
  const sample_ns: bigint = frame.at("sample_ns", "index_distal");
  console.log(force_n, position_m, sample_ns, frame.force_n[frame.row("index_distal")]);
  // @ts-expect-error: no such column
  frame.at("force", "index_distal");
}
const events: Contact["event"][] = [];
hand.onContact((contact) => events.push(contact.event));
for await (const newest of hand) console.log(newest.t_ns);
