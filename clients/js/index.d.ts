export const SCHEMA_VERSION: 1;
export const PAD_STATES: readonly PadState[];
export const POSITION_STATUSES: readonly PositionStatus[];
export const FORCE_STATUSES: readonly ForceStatus[];
export const FRAME_STATUSES: readonly FrameStatus[];

export type PadState = "clear" | "touched" | "stale" | "lost" | "faulted" | "starting" | "off";
export type PositionStatus = "not_computed" | "valid" | "unreliable" | "invalid";
export type ForceStatus = "not_computed" | "valid" | "lower_bound" | "unreliable" | "invalid";
export type FrameStatus = "not_computed" | "valid" | "stale" | "invalid";

/** A message that violates the wire contract. */
export class WireError extends Error {}

/** A pad isn't sampled, so that nobody knows whether it is touched; the text has link, state and age. */
export class NotSampledError extends Error {}

/** The daemon has no such hand; the text names those that it has. */
export class UnknownNameError extends Error {}

/** A loop over the frames of a daemon that is gone, or was restarted. */
export class DisconnectedError extends Error {}

interface Envelope {
  v: 1;
  session: number | bigint;
  seq: number;
  t_ns: bigint;
  retained: boolean;
}

/** `contact/<hand>/<link>`: begin, update or end of one contact; fields as in docs/wire.md. */
export interface Contact extends Envelope {
  event: "begin" | "update" | "end";
  id: number;
  hand: string;
  link: string;
  frame: string;
  begin_ns: bigint;
  duration_s: number;
  age_s: number;
  position_m: number[] | null;
  normal: number[] | null;
  covariance_m2: number[] | null;
  pad_m: number[] | null;
  position_status: PositionStatus;
  force_n: number | null;
  force_std_n: number | null;
  peak_force_n: number | null;
  force_status: ForceStatus;
  total_current_a: number;
  residual: number | null;
  residual_std: number | null;
  begin_threshold_n: number;
  end_threshold_n: number;
  calibration_id: string;
  end_reason: "released" | "stale" | "lost" | "faulted" | "off" | "restarted" | "stopped" | "";
  group?: number;
  palm_status?: FrameStatus;
  palm_position_m?: number[] | null;
  palm_normal?: number[] | null;
  palm_covariance_m2?: number[] | null;
  base_status?: FrameStatus;
  base_position_m?: number[] | null;
  base_normal?: number[] | null;
  base_covariance_m2?: number[] | null;
  joints_age_s?: number | null;
  uncompensated_force_n?: number | null;
  diagnoses?: string[];
  /** two contacts at once on a pad of six or more electrodes; absent for one */
  parts?: {
    position_m: number[];
    normal: number[];
    covariance_m2: number[];
    force_n: number | null;
    force_std_n: number | null;
    /** absent unless the contact's own status in that frame is valid */
    palm_position_m?: number[];
    palm_normal?: number[];
    palm_covariance_m2?: number[];
    base_position_m?: number[];
    base_normal?: number[];
    base_covariance_m2?: number[];
    /** the same while it is followed by nearness */
    id?: number;
  }[];
  /** false while samples are missing: values of the last sample; absent where true */
  fresh?: boolean;
  force_vector_status?: ForceStatus;
  /** force on the pad above a shear pad, in the link's frame, and its covariance row by row */
  force_vector_n?: number[];
  force_vector_covariance_n2?: number[];
  /** part of covariance_m2 by the pad's mount on its link */
  mount_covariance_m2?: number[];
  palm_force_vector_n?: number[];
  base_force_vector_n?: number[];
}

interface RequiredColumns {
  state: Uint8Array;
  contact_id: Uint32Array;
  sample_ns: BigInt64Array;
  total_current_a: Float32Array;
  position_m: Float32Array;
  normal: Float32Array;
  covariance_m2: Float32Array;
  pad_m: Float32Array;
  position_status: Uint8Array;
  force_n: Float32Array;
  force_std_n: Float32Array;
  force_status: Uint8Array;
  residual: Float32Array;
  residual_std: Float32Array;
}

interface OptionalColumns {
  group?: Uint32Array;
  palm_status?: Uint8Array;
  palm_position_m?: Float32Array;
  palm_normal?: Float32Array;
  palm_covariance_m2?: Float32Array;
  base_status?: Uint8Array;
  base_position_m?: Float32Array;
  base_normal?: Float32Array;
  base_covariance_m2?: Float32Array;
  joints_age_s?: Float32Array;
  force_vector_status?: Uint8Array;
  force_vector_n?: Float32Array;
  force_vector_covariance_n2?: Float32Array;
  mount_covariance_m2?: Float32Array;
  palm_force_vector_n?: Float32Array;
  base_force_vector_n?: Float32Array;
}

type Scalars = "state" | "contact_id" | "total_current_a" | "position_status" | "force_n" | "force_std_n"
  | "force_status" | "residual" | "residual_std" | "group" | "palm_status" | "base_status" | "joints_age_s"
  | "force_vector_status";
type Vectors = "position_m" | "normal" | "covariance_m2" | "pad_m" | "palm_position_m" | "palm_normal"
  | "palm_covariance_m2" | "base_position_m" | "base_normal" | "base_covariance_m2"
  | "force_vector_n" | "force_vector_covariance_n2" | "palm_force_vector_n" | "base_force_vector_n"
  | "mount_covariance_m2";

/** `hand/<hand>`: the whole hand at one tick; columns have a row for each link, NaN where unknown. */
export interface Frame extends Envelope, RequiredColumns, OptionalColumns {}
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
