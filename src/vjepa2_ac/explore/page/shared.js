// @ts-check
/** How does the page talk with its server, and draw the answers? */

/** @typedef {{kind: string, seq: number | null, images: {name: string, bytes: number, alt: string}[]}} Common */
/** @typedef {Common & {[key: string]: any}} Header of a message: its kind says which further fields it has */
/** @typedef {Map<string, HTMLImageElement>} Pictures decoded, by their names */
/** @typedef {{header: Header, pictures: Pictures}} Answer */
/** @typedef {{kind: string, fields: object, seq: number, settle: (answer: Answer | Error | null) => void}} Request */
/** @typedef {{shown_unit: string, factor: number}} Unit of a number, as people read it */

const SEARCHES = new Set(["energy", "plan"]); // a newer request ends them
const FIRST_RETRY_MS = 500;
const LAST_RETRY_MS = 5000;

/**
 * A socket that comes back. One request is under way at a time, and the newest of a kind waits; only a search is
 * interrupted. Answers are handed over when their images are decoded, in the order in which they were sent.
 */
export class Wire {
  #socket = /** @type {WebSocket | null} */ (null);
  #running = /** @type {Request | null} */ (null);
  #waiting = /** @type {Request[]} */ ([]);
  #order = Promise.resolve();
  #seq = 0;
  #retry = FIRST_RETRY_MS;
  #timer = 0;

  /**
   * @param {string} path of the socket, relative to the page
   * @param {{told: (answer: Answer) => void, progress: (header: Header) => void, lost: (why: string) => void}} events
   *   told: what nobody asked for, `hello` first, after every connection; lost: it is tried again by itself
   */
  constructor(path, events) {
    this.url = new URL(path, location.href.replace(/^http/, "ws").replace(/#.*/, ""));
    this.events = events;
    this.connect();
  }

  /** Connect, now. */
  connect() {
    clearTimeout(this.#timer);
    this.#socket?.close();
    const socket = new WebSocket(this.url);
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      this.#order = this.#order.then(() => (socket === this.#socket ? this.#take(data) : undefined));
    };
    socket.onclose = ({ reason }) => {
      if (socket !== this.#socket) return;
      const unanswered = this.#running ? [this.#running, ...this.#waiting] : this.#waiting;
      this.#running = null;
      this.#waiting = [];
      for (const request of unanswered) request.settle(null);
      this.events.lost(reason);
      this.#timer = setTimeout(() => this.connect(), this.#retry);
      this.#retry = Math.min(2 * this.#retry, LAST_RETRY_MS);
    };
  }

  /**
   * Ask the server; null: a newer request took its place, or the server was lost. Rejects with what the server says.
   *
   * @param {string} kind
   * @param {object} fields
   * @returns {Promise<Answer | null>}
   */
  ask(kind, fields) {
    if (this.#socket?.readyState !== WebSocket.OPEN) return Promise.resolve(null);
    return new Promise((resolve, reject) => {
      /** @param {Answer | Error | null} answer */
      const settle = (answer) => (answer instanceof Error ? reject(answer) : resolve(answer));
      for (const older of this.#waiting.filter((one) => one.kind === kind)) older.settle(null);
      this.#waiting = [...this.#waiting.filter((one) => one.kind !== kind), { kind, fields, seq: 0, settle }];
      this.#next();
    });
  }

  #next() {
    if (!this.#waiting.length || (this.#running && !SEARCHES.has(this.#running.kind))) return;
    this.#running?.settle(null);
    const request = /** @type {Request} */ (this.#waiting.shift());
    request.seq = this.#seq += 1;
    this.#running = request;
    this.#socket?.send(JSON.stringify({ seq: request.seq, kind: request.kind, ...request.fields }));
  }

  /** @param {ArrayBuffer} data */
  async #take(data) {
    const { header, images } = unpacked(data);
    const isLate = () => header.seq !== null && header.seq !== this.#running?.seq;
    if (isLate()) return;
    if (header.kind === "progress") return this.events.progress(header);
    /** @type {Answer | Error} */
    let answer;
    try {
      answer = header.kind === "error" ? new Error(header.text) : { header, pictures: await decoded(header, images) };
    } catch {
      answer = new Error("An image of the answer cannot be shown.");
    }
    if (isLate()) return; // a newer request came while images were decoded
    if (header.seq === null) {
      this.#retry = FIRST_RETRY_MS;
      if (!(answer instanceof Error)) this.events.told(answer);
      return;
    }
    const request = this.#running;
    this.#running = null;
    request?.settle(answer);
    this.#next();
  }
}

/**
 * @param {ArrayBuffer} data 4 bytes: length of the header; the header; the images
 * @returns {{header: Header, images: ArrayBuffer}}
 */
function unpacked(data) {
  const end = 4 + new DataView(data).getUint32(0);
  return { header: JSON.parse(new TextDecoder().decode(data.slice(4, end))), images: data.slice(end) };
}

/**
 * @param {Header} header
 * @param {ArrayBuffer} images one after another
 * @returns {Promise<Pictures>}
 */
async function decoded(header, images) {
  let begin = 0;
  const pictures = header.images.map(({ name, bytes, alt }) => {
    const picture = new Image();
    picture.src = URL.createObjectURL(new Blob([images.slice(begin, (begin += bytes))], { type: "image/jpeg" }));
    picture.alt = alt;
    return /** @type {[string, HTMLImageElement]} */ ([name, picture]);
  });
  await Promise.all(pictures.map(([, picture]) => picture.decode()));
  return new Map(pictures);
}

/**
 * Put a decoded picture where another one is; without one, hide that.
 *
 * @param {HTMLImageElement} place
 * @param {HTMLImageElement | undefined} picture
 */
export function swap(place, picture) {
  place.hidden = !picture;
  if (!picture) return;
  picture.className = place.className;
  picture.draggable = false;
  Object.assign(picture.dataset, place.dataset);
  URL.revokeObjectURL(place.src);
  place.replaceWith(picture);
}

/**
 * Return the element with a role in the page, or within another element.
 *
 * @param {string} role
 * @param {ParentNode} within
 * @returns {any} an element; which one, the page's HTML says
 */
export function part(role, within = document) {
  return within.querySelector(`[data-role="${role}"]`);
}

/**
 * Make an element; texts become text, never HTML.
 *
 * @param {string} tag
 * @param {{[name: string]: any}} properties of the element; `data`: its data attributes
 * @param {(Node | string)[]} children
 * @returns {any}
 */
export function make(tag, { data = {}, ...properties } = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  Object.assign(element.dataset, data);
  element.append(...children);
  return element;
}

/**
 * Make a shape of an SVG.
 *
 * @param {string} tag
 * @param {{[name: string]: string | number}} values of its attributes
 */
export function shape(tag, values) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, one] of Object.entries(values)) element.setAttribute(name, String(one));
  return element;
}

/**
 * Write a number in its unit.
 *
 * @param {number | null} value
 * @param {Unit} unit
 * @param {boolean} signed
 */
export function amount(value, unit, signed = false) {
  if (value === null) return "–";
  const text = Math.abs(value * unit.factor).toFixed(digits(unit));
  const sign = value < 0 && Number(text) !== 0 ? "−" : signed ? "+" : "";
  return `${sign}${text}${unit.shown_unit && unit.shown_unit !== "°" ? " " : ""}${unit.shown_unit}`;
}

/** @param {Unit} unit */
export const digits = (unit) => (unit.factor === 1 ? 2 : 1);
