// Decoding of the messages of docs/wire.md that a controller reads: contacts and hand frames.

import { decode } from "@msgpack/msgpack";

import { OPTIONAL_COLUMNS, PAD_STATES, REQUIRED_COLUMNS } from "./fields.js";

export { FORCE_STATUSES, FRAME_STATUSES, PAD_STATES, POSITION_STATUSES } from "./fields.js";

export const SCHEMA_VERSION = 1;

/** A message that violates the wire contract. */
export class WireError extends Error {}

/** A pad isn't sampled, so that nobody knows whether it is touched; the text has link, state and age. */
export class NotSampledError extends Error {}

const isInteger = (value) => typeof value === "bigint" || Number.isSafeInteger(value);

// Integers of nanoseconds are BigInt, however they were encoded; all others are numbers where they fit.
function decodeMap(payload) {
  let map;
  try {
    map = decode(payload, { useBigInt64: true });
  } catch (error) {
    throw new WireError(`not msgpack: ${error.message}`);
  }
  if (map === null || typeof map !== "object" || map.v !== SCHEMA_VERSION) {
    throw new WireError("another schema version");
  }
  for (const key of ["session", "seq", "t_ns"]) {
    if (!isInteger(map[key])) throw new WireError(`${key} is missing`);
  }
  for (const [key, value] of Object.entries(map)) {
    if (!isInteger(value)) continue;
    if (key.endsWith("_ns")) map[key] = BigInt(value);
    else if (Number.isSafeInteger(Number(value))) map[key] = Number(value);
  }
  return map;
}

/** Decode the payload of `contact/<hand>/<link>`; optional keys that are absent stay absent. */
export function decodeContact(payload) {
  const contact = decodeMap(payload);
  if (!["begin", "update", "end"].includes(contact.event) || typeof contact.link !== "string") {
    throw new WireError("a contact without event or link");
  }
  return contact;
}

/** Decode the payload of `service`. */
export function decodeService(payload) {
  const service = decodeMap(payload);
  if (typeof service.period_s !== "number") throw new WireError("service without period_s");
  if (typeof (service.frame_period_s ?? 0) !== "number") throw new WireError("frame_period_s is no number");
  if (typeof service.hands !== "object" || service.hands === null) throw new WireError("service without hands");
  return service;
}

/** `hand/<hand>`: the whole hand at one tick; columns are typed arrays with a row for each link. */
export class Frame {
  #rows;

  constructor(map) {
    if (!Array.isArray(map.links)) throw new WireError("links is missing");
    for (const [name, layout] of Object.entries(REQUIRED_COLUMNS)) map[name] = column(map, name, layout);
    for (const [name, layout] of Object.entries(OPTIONAL_COLUMNS)) {
      if (name in map) map[name] = column(map, name, layout);
    }
    Object.assign(this, map);
    this.#rows = new Map(this.links.map((link, row) => [link, row]));
  }

  /** The row of a link. Throws RangeError for an unknown one. */
  row(link) {
    const row = this.#rows.get(link);
    if (row === undefined) throw new RangeError(`no link ${link}; the links are ${this.links.join(", ")}`);
    return row;
  }

  /** The values of a link in a column: a number, or the elements of its row. */
  at(name, link) {
    const values = this[name];
    if (!ArrayBuffer.isView(values)) {
      const columns = Object.keys(this).filter((key) => ArrayBuffer.isView(this[key]));
      throw new RangeError(`no column ${name} in this frame; its columns are ${columns.join(", ")}`);
    }
    const size = values.length / this.links.length;
    const row = this.row(link);
    return size === 1 ? values[row] : values.subarray(row * size, (row + 1) * size);
  }

  /** True where the pad has a contact. Throws NotSampledError where the pad isn't sampled. */
  touched(link) {
    if (!this.sampled(link)) {
      const state = this.at("state", link);
      const sampleNs = this.at("sample_ns", link);
      const age = sampleNs ? `its last sample is ${Number(this.t_ns - sampleNs) / 1e9} s old` : "no sample yet";
      throw new NotSampledError(
        `whether ${link} is touched isn't known: the pad is ${PAD_STATES[state] ?? `in state ${state}`}, ${age}`,
      );
    }
    return PAD_STATES[this.at("state", link)] === "touched";
  }

  /** True where the pad is sampled, so that no contact means none. */
  sampled(link) {
    return ["clear", "touched"].includes(PAD_STATES[this.at("state", link)]);
  }
}

function column(map, name, [Type, elements]) {
  const bytes = map[name];
  const size = map.links.length * elements * Type.BYTES_PER_ELEMENT;
  if (!(bytes instanceof Uint8Array) || bytes.length !== size) {
    throw new WireError(`${name} doesn't match its links`);
  }
  return new Type(new Uint8Array(bytes).buffer); // a copy, as columns aren't aligned in the message
}

/** Decode the payload of `hand/<hand>`. */
export function decodeFrame(payload) {
  return new Frame(decodeMap(payload));
}
