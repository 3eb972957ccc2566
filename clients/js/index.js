// The newest state of a hand, for a control loop: see README.md. The wire contract is docs/wire.md.

import { Subscriber } from "zeromq";

import { WireError, decodeContact, decodeFrame, decodeService } from "./messages.js";

export * from "./messages.js";

const QUEUE_MESSAGES = 10_000;
const SERVICE_TIMEOUT_NS = 1_500_000_000n;
const MIN_AGE_NS = 50_000_000n;
const MAX_DRIFT_PPM = 500n;
const SILENCE_MS = 2000; // without any message: a warning
const POLL_MS = 20;
const LOCAL = /^(ipc:\/\/|inproc:\/\/|tcp:\/\/(127\.|localhost|\[::1\]))/;
const nowNs = () => process.hrtime.bigint(); // CLOCK_MONOTONIC, the clock of t_ns on the daemon's machine
const max = (a, b) => (a > b ? a : b);
const min = (a, b) => (a < b ? a : b);

/** The daemon has no such hand; the text names those that it has. */
export class UnknownNameError extends Error {}

/** A loop over the frames of a daemon that is gone, or was restarted. */
export class DisconnectedError extends Error {}

/** Newest frame and contacts from decoded messages; needs no socket. */
export class HandState {
  /** The newest frame of the session, or null. */
  frame = null;
  /** Number of the newest frame in the order of reception. */
  frameOrder = -1;
  /** True if the frames are of a replay, as `service` says. */
  isReplay = false;
  /** Period of the hand's frames, as `service` states it; 0 before the first. */
  periodNs = 0n;
  #contacts = new Map();
  #liveOrder = -1;
  #newestOrder = -1;
  #session = null;

  /** Active contacts by link: also without the message of an end, once a frame shows it. */
  get contacts() {
    const active = [...this.#contacts].filter(
      ([link, { order, contact }]) => order > this.#liveOrder || this.#frameId(link) === contact.id,
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
    this.frameOrder = order;
    if (!frame.retained) this.#liveOrder = order; // a retained one may be older than a contact before it
    this.frame = frame;
  }

  feedService(service, order) {
    if (!this.#accept(service.session, order)) return;
    this.periodNs = BigInt(Math.round(1e9 * (service.frame_period_s ?? service.period_s)));
    this.isReplay = service.replay === true;
  }

  // Another session voids the state, unless the message was received before those of this one.
  #accept(session, order) {
    if (session !== this.#session) {
      if (order < this.#newestOrder) return false;
      this.frame = null;
      this.isReplay = false;
      this.periodNs = 0n;
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
  #receivedNs = 0n;
  #frameNs = 0n; // reception of the newest frame
  #voidOrder = 0; // frames before it are of a lost connection
  #maxAgeNs;
  #isLocal;
  #offsetNs = null; // of this clock from the daemon's, at most
  #offsetAtNs = 0n;
  #clockSession = null;
  #seen = null;
  #failure = null;
  #name;
  #unknown = "";
  #warning;

  constructor(name, { endpoint = "tcp://127.0.0.1:5580", key, maxAgeMs } = {}) {
    this.#name = name;
    this.#warning = setTimeout(() => {
      if (this.#received === 0) console.warn(`handtouch: no daemon at ${endpoint}; start \`handtouch run FILE\``);
    }, SILENCE_MS).unref();
    this.#maxAgeNs = maxAgeMs === undefined ? null : BigInt(Math.round(1e6 * maxAgeMs));
    this.#isLocal = LOCAL.test(endpoint);
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
    this.#socket.events.on("disconnect", () => {
      this.#voidOrder = this.#received;
      this.#wake();
    });
    this.#socket.connect(endpoint);
    this.#socket.subscribe(this.#frameTopic, this.#contactPrefix, "service");
    this.#receive();
  }

  /**
   * The newest frame that has arrived; null before the first, without a daemon, and while the newest is older
   * than maxAgeMs by its own time. Doesn't wait. Throws UnknownNameError while the daemon has no such hand.
   * Nothing received for 2 s is logged once.
   */
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

  /** The newest frames, each once, until `close`. Throws DisconnectedError when the daemon is gone. */
  async *[Symbol.asyncIterator]() {
    let seen = null;
    while (!this.#socket.closed) {
      const frame = await this.wait(POLL_MS);
      if (frame !== null) {
        if (seen !== null && frame.session !== seen.session) throw new DisconnectedError("another daemon");
        yield (seen = frame);
      } else if (seen !== null && !this.#socket.closed) {
        const isSilent = nowNs() - this.#receivedNs >= SERVICE_TIMEOUT_NS;
        if (isSilent || this.#state.frameOrder < this.#voidOrder) {
          throw new DisconnectedError("the daemon is gone; iterate again to wait for it");
        }
      }
    }
  }

  /** Active contacts by link, of the messages received so far; none without a daemon. */
  get contacts() {
    return this.alive ? this.#state.contacts : new Map();
  }

  /** True while the newest frame is young enough, and the connection wasn't lost since. */
  get alive() {
    this.#decodeNewest();
    const { frame, frameOrder, periodNs } = this.#state;
    const now = this.#daemonNs();
    if (frame === null || now === null || frameOrder < this.#voidOrder) return false;
    return now - frame.t_ns <= (this.#maxAgeNs ?? max(MIN_AGE_NS, 3n * periodNs));
  }

  /** Age of the newest frame [ms]; Infinity without one. From another machine a lower bound. */
  get ageMs() {
    const now = this.#daemonNs();
    return this.#state.frame === null || now === null ? Infinity : Number(now - this.#state.frame.t_ns) / 1e6;
  }

  /** Call a function for every begin, update and end of a contact; returns a function that ends that. */
  onContact(callback) {
    this.#listeners.add(callback);
    return () => this.#listeners.delete(callback);
  }

  close() {
    clearTimeout(this.#warning);
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
    this.#receivedNs = nowNs();
    const order = this.#received++;
    const isContact = topic.startsWith(this.#contactPrefix);
    if (isContact || topic === this.#frameTopic || topic === "service") {
      if (payloads.length !== 1) this.malformedMessages += 1;
      else this.#newest.set(topic, { order, payload: payloads[0], receivedNs: this.#receivedNs });
      if (isContact && this.#listeners.size > 0) this.#decodeNewest(topic);
    }
    this.#wake();
  }

  #current() {
    if (this.#failure !== null) throw this.#failure;
    const frame = this.alive ? this.#state.frame : null;
    if (this.#unknown !== "") throw new UnknownNameError(this.#unknown);
    return frame;
  }

  // Now on the daemon's clock; on another machine the least that it may be, by the smallest delay seen, which
  // widens by the drift of clocks. Null before a message.
  #daemonNs() {
    const here = nowNs();
    if (this.#state.isReplay && this.#state.frame !== null) return here - this.#frameNs + this.#state.frame.t_ns;
    if (this.#isLocal) return here;
    return this.#offsetNs === null ? null : here - this.#widened(here);
  }

  #widened(here) {
    return this.#offsetNs + ((here - this.#offsetAtNs) * MAX_DRIFT_PPM) / 1_000_000n + 1n;
  }

  #observe({ session, t_ns, retained }, receivedNs) {
    if (session !== this.#clockSession) this.#offsetNs = null;
    this.#clockSession = session;
    if (retained) return;
    if (receivedNs < t_ns) this.#isLocal = false; // a tunnel to another machine
    const found = receivedNs - t_ns;
    this.#offsetNs = this.#offsetNs === null ? found : min(this.#widened(receivedNs), found);
    this.#offsetAtNs = receivedNs;
  }

  #decodeNewest(...topics) {
    for (const topic of topics.length > 0 ? topics : [...this.#newest.keys()]) {
      const waiting = this.#newest.get(topic);
      this.#newest.delete(topic);
      if (waiting !== undefined) this.#decode(topic, waiting);
    }
  }

  #decode(topic, { order, payload, receivedNs }) {
    try {
      if (topic === this.#frameTopic || topic === "service") {
        const message = topic === "service" ? decodeService(payload) : decodeFrame(payload);
        const before = this.#state.frame;
        if (topic === "service") this.#feedService(message, order);
        else this.#state.feedFrame(message, order);
        if (this.#state.frame !== before) this.#frameNs = receivedNs;
        return this.#observe(message, receivedNs);
      }
      const contact = decodeContact(payload);
      this.#state.feedContact(contact, order);
      for (const callback of this.#listeners) callback(contact);
    } catch (error) {
      if (!(error instanceof WireError)) throw error;
      this.malformedMessages += 1;
    }
  }

  #feedService(service, order) {
    this.#state.feedService(service, order);
    const hands = Object.keys(service.hands);
    const isKnown = hands.includes(this.#name);
    this.#unknown = isKnown ? "" : `the daemon has no hand '${this.#name}'; it has ${hands.join(", ")}`;
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
