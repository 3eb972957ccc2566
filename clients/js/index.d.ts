import type { Columns, Contact, Envelope, Scalars, Vectors } from "./fields.js";

export * from "./fields.js";

export const SCHEMA_VERSION: 1;

/** A message that violates the wire contract. */
export class WireError extends Error {}

/** A pad isn't sampled, so that nobody knows whether it is touched; the text has link, state and age. */
export class NotSampledError extends Error {}

/** The daemon has no such hand; the text names those that it has. */
export class UnknownNameError extends Error {}

/** A loop over the frames of a daemon that is gone, or was restarted. */
export class DisconnectedError extends Error {}

/** `hand/<hand>`: the whole hand at one tick; columns have a row for each link, NaN where unknown. */
export interface Frame extends Envelope, Columns {}
export class Frame {
  tick: number;
  hand: string;
  links: string[];
  /** The row of a link. Throws RangeError for an unknown one. */
  row(link: string): number;
  /** The value of a link in a column, or the elements of its row. */
  at(name: Scalars, link: string): number;
  at(name: Vectors, link: string): Float32Array;
  at(name: "sample_ns", link: string): bigint;
  /** True where the pad has a contact. Throws NotSampledError where the pad isn't sampled. */
  touched(link: string): boolean;
  /** True where the pad is sampled, so that no contact means none. */
  sampled(link: string): boolean;
}

/** Decode the payload of `contact/<hand>/<link>`. Throws WireError. */
export function decodeContact(payload: Uint8Array): Contact;
/** Decode the payload of `hand/<hand>`. Throws WireError. */
export function decodeFrame(payload: Uint8Array): Frame;

/** What a client needs of `service`, the heartbeat. */
export interface Service extends Envelope {
  period_s: number;
  frame_period_s?: number;
  replay?: boolean;
}

/** Decode the payload of `service`. Throws WireError. */
export function decodeService(payload: Uint8Array): Service;

/** Newest frame and contacts from decoded messages; needs no socket. */
export class HandState {
  readonly frame: Frame | null;
  readonly contacts: Map<string, Contact>;
  feedContact(contact: Contact, order: number): void;
  feedFrame(frame: Frame, order: number): void;
  feedService(service: Service, order: number): void;
}

export interface HandOptions {
  /** default: tcp://127.0.0.1:5580 */
  endpoint?: string;
  /** the three keys of a file by `handtouch keys client` */
  key?: { server_key: string; public_key: string; secret_key: string };
  /** age of a frame up to which it counts; default: three of the hand's periods, 50 ms at least */
  maxAgeMs?: number;
}

/** A connection to a daemon that keeps the newest state of one hand. */
export class Hand {
  constructor(name: string, options?: HandOptions);
  /** Messages dropped because they violate the wire contract. */
  readonly malformedMessages: number;
  /** True while the newest frame is young enough, and the connection wasn't lost since. */
  readonly alive: boolean;
  /** Age of the newest frame; Infinity without one. From another machine a lower bound. */
  readonly ageMs: number;
  /** Active contacts by link; none without a daemon. */
  readonly contacts: Map<string, Contact>;
  /**
   * The newest frame that has arrived; null before the first, without a daemon, and while the newest is older
   * than maxAgeMs by its own time. Doesn't wait.
   */
  latest(): Promise<Frame | null>;
  /** As `latest`, as soon as it is newer than the one returned before; null after the timeout. */
  wait(timeoutMs?: number): Promise<Frame | null>;
  /** The newest frames, each once, until `close`. Throws DisconnectedError when the daemon is gone. */
  [Symbol.asyncIterator](): AsyncGenerator<Frame, void, void>;
  /** Call a function for every begin, update and end of a contact; returns a function that ends that. */
  onContact(callback: (contact: Contact) => void): () => void;
  close(): void;
}
