// The newest state of a hand, for a control loop: see README.md. The wire contract is docs/wire.md.

import { Subscriber } from "zeromq";

import { WireError, decodeContact, decodeFrame } from "./messages.js";

export * from "./messages.js";

const QUEUE_MESSAGES = 10_000;
const SERVICE_TIMEOUT_MS = 1500;

/** Newest frame and contacts from decoded messages; needs no socket. */
export class HandState {
  /** The newest frame of the session, or null. */
  frame = null;
  #contacts = new Map();
  #frameOrder = -1;
  #newestOrder = -1;
  #session = null;

  /** Active contacts by link: also without the message of an end, once a frame shows it. */
  get contacts() {
    const active = [...this.#contacts].filter(
      ([link, { order, contact }]) => order > this.#frameOrder || this.#frameId(link) === contact.id,
    );
    return new Map(active.map(([link, { contact }]) => [link, contact]));
  }

  /** `order`: number of the message in the order of reception. */
  feedContact(contact, order) {
    if (!this.#accept(contact.session, order)) return;
    if (contact.event === "end") this.#contacts.delete(contact.link);
    else this.#contacts.set(contact.link, { order, contact });
  }

  feedFrame(frame, order) {
    if (!this.#accept(frame.session, order) || frame.seq <= (this.frame?.seq ?? -1)) return;
    if (!frame.retained) this.#frameOrder = order; // a retained one may be older than a contact before it
    this.frame = frame;
  }

  // Another session voids the state, unless the message was received before those of this one.
  #accept(session, order) {
    if (session !== this.#session) {
      if (order < this.#newestOrder) return false;
      this.frame = null;
      this.#contacts.clear();
      this.#session = session;
    }
    this.#newestOrder = Math.max(order, this.#newestOrder);
    return true;
  }

  #frameId(link) {
    return this.frame?.links.includes(link) ? this.frame.at("contact_id", link) : 0;
  }
}

/** A connection to a daemon that keeps the newest state of one hand. */
export class Hand {
  /** Messages dropped because they violate the wire contract. */
  malformedMessages = 0;
  #socket;
  #frameTopic;
  #contactPrefix;
  #state = new HandState();
  #newest = new Map(); // topic -> order and payload, not decoded yet
  #listeners = new Set();
  #waiting = new Set();
  #received = 0;
  #receivedMs = -Infinity;
  #seen = null;
  #failure = null;

  constructor(name, { endpoint = "tcp://127.0.0.1:5580", key } = {}) {
    this.#frameTopic = `hand/${name}`;
    this.#contactPrefix = `contact/${name}/`;
    this.#socket = new Subscriber({
      receiveHighWaterMark: QUEUE_MESSAGES,
      linger: 0,
      tcpKeepalive: 1,
      tcpKeepaliveIdle: 1,
      tcpKeepaliveInterval: 1,
      tcpKeepaliveCount: 2,
      reconnectInterval: 50,
      reconnectMaxInterval: 1000,
      ...(key && {
        curveServerKey: key.server_key,
        curvePublicKey: key.public_key,
        curveSecretKey: key.secret_key,
      }),
    });
    this.#socket.connect(endpoint);
    this.#socket.subscribe(this.#frameTopic, this.#contactPrefix, "service");
    this.#receive();
  }

  /** The newest frame that has arrived, or null before the first and without a daemon. Doesn't wait. */
  async latest() {
    // #receive takes what arrived while the program computed in the next turns of the event loop; reading
    // socket.readable instead could hide a message from it
    for (let before = -1; this.#received !== before; ) {
      before = this.#received;
      await new Promise(setImmediate);
    }
    return this.#current();
  }

  /** As `latest`, as soon as it is newer than the one returned before; null after the timeout. */
  async wait(timeoutMs = Infinity) {
    const endMs = performance.now() + timeoutMs;
    let frame = await this.latest();
    while (frame === null || frame === this.#seen) {
      const leftMs = endMs - performance.now();
      if (this.#socket.closed || leftMs <= 0) return null;
      await this.#nextMessage(leftMs);
      frame = await this.latest();
    }
    return (this.#seen = frame);
  }

  /** The newest frames, each once, until `close`. */
  async *[Symbol.asyncIterator]() {
    for (let frame; !this.#socket.closed; ) if ((frame = await this.wait()) !== null) yield frame;
  }

  /** Active contacts by link, of the messages received so far; none without a daemon. */
  get contacts() {
    if (!this.alive) return new Map();
    this.#decodeNewest();
    return this.#state.contacts;
  }

  /** True if any message, the daemon's heartbeat at least, was received within 1.5 s. */
  get alive() {
    return performance.now() - this.#receivedMs < SERVICE_TIMEOUT_MS;
  }

  /** Call a function for every begin, update and end of a contact; returns a function that ends that. */
  onContact(callback) {
    this.#listeners.add(callback);
    return () => this.#listeners.delete(callback);
  }

  close() {
    this.#socket.close();
    this.#wake();
  }

  [Symbol.dispose ?? Symbol.for("dispose")]() {
    this.close();
  }

  async #receive() {
    try {
      for await (const [topic, ...payloads] of this.#socket) this.#take(topic.toString("utf8"), payloads);
    } catch (error) {
      this.#failure = error; // of the socket, or of a callback: `latest` and `wait` throw it
      this.close();
    }
  }

  #take(topic, payloads) {
    this.#receivedMs = performance.now();
    const order = this.#received++;
    const isContact = topic.startsWith(this.#contactPrefix);
    if (isContact || topic === this.#frameTopic) {
      if (payloads.length !== 1) this.malformedMessages += 1;
      else this.#newest.set(topic, { order, payload: payloads[0] });
      if (isContact && this.#listeners.size > 0) this.#decodeNewest(topic);
    }
    this.#wake();
  }

  #current() {
    if (this.#failure !== null) throw this.#failure;
    if (!this.alive) return null;
    this.#decodeNewest();
    return this.#state.frame;
  }

  #decodeNewest(...topics) {
    for (const topic of topics.length > 0 ? topics : [...this.#newest.keys()]) {
      const waiting = this.#newest.get(topic);
      this.#newest.delete(topic);
      if (waiting !== undefined) this.#decode(topic, waiting);
    }
  }

  #decode(topic, { order, payload }) {
    try {
      if (topic === this.#frameTopic) return this.#state.feedFrame(decodeFrame(payload), order);
      const contact = decodeContact(payload);
      this.#state.feedContact(contact, order);
      for (const callback of this.#listeners) callback(contact);
    } catch (error) {
      if (!(error instanceof WireError)) throw error;
      this.malformedMessages += 1;
    }
  }

  #nextMessage(timeoutMs) {
    return new Promise((resolve) => {
      const timer = timeoutMs < Infinity ? setTimeout(() => this.#wakeOne(done), timeoutMs) : undefined;
      const done = () => {
        clearTimeout(timer);
        resolve();
      };
      this.#waiting.add(done);
    });
  }

  #wakeOne(done) {
    this.#waiting.delete(done);
    done();
  }

  #wake() {
    for (const done of [...this.#waiting]) this.#wakeOne(done);
  }
}
