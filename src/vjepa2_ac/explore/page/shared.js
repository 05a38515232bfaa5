// @ts-check
/** The connection to the server, and helpers that create elements of the page. */

/** @typedef {{kind: string, seq: number | null, images: {name: string, bytes: number, alt: string}[]}} Common */
/** @typedef {Common & {[key: string]: any}} Header of a message; its kind determines the further fields */
/** @typedef {Map<string, HTMLImageElement>} Images decoded images by name */
/** @typedef {{header: Header, images: Images}} Reply */
/** @typedef {{kind: string, fields: object, seq: number, settle: (reply: Reply | Error | null) => void}} Request */
/** @typedef {{display_unit: string, factor: number}} Unit displayed unit of a number */

const SEARCHES = new Set(["energy", "plan"]); // requests that are cancelled by a newer request
const FIRST_RETRY_MS = 500;
const LAST_RETRY_MS = 5000;

/**
 * A websocket that reconnects. One request is processed at a time, and only the newest request of each kind is queued.
 * A newer request cancels a running search. Replies are passed on in order, after their images are decoded.
 */
export class Wire {
  #socket = /** @type {WebSocket | null} */ (null);
  #running = /** @type {Request | null} */ (null);
  #waiting = /** @type {Request[]} */ ([]);
  #received = Promise.resolve();
  #seq = 0;
  #retry = FIRST_RETRY_MS;
  #timer = 0;

  /**
   * @param {string} path of the socket, relative to the page
   * @param {{received: (reply: Reply) => void, progress: (header: Header) => void, disconnected: (reason: string) => void}} events
   *   received: a message without a request, the first one after connecting is `hello`; disconnected: the connection was
   *   lost and is retried automatically
   */
  constructor(path, events) {
    this.url = new URL(path, location.href.replace(/^http/, "ws").replace(/#.*/, ""));
    this.events = events;
    this.connect();
  }

  /** Connect immediately. */
  connect() {
    clearTimeout(this.#timer);
    this.#socket?.close();
    const socket = new WebSocket(this.url);
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      this.#received = this.#received.then(() => (socket === this.#socket ? this.#receive(data) : undefined));
    };
    socket.onclose = ({ reason }) => {
      if (socket !== this.#socket) return;
      const pending = this.#running ? [this.#running, ...this.#waiting] : this.#waiting;
      this.#running = null;
      this.#waiting = [];
      for (const request of pending) request.settle(null);
      this.events.disconnected(reason);
      this.#timer = setTimeout(() => this.connect(), this.#retry);
      this.#retry = Math.min(2 * this.#retry, LAST_RETRY_MS);
    };
  }

  /**
   * Send a request. Resolves to null if a newer request replaced it or the connection was lost; rejects with the server's
   * error.
   *
   * @param {string} kind
   * @param {object} fields
   * @returns {Promise<Reply | null>}
   */
  send(kind, fields) {
    if (this.#socket?.readyState !== WebSocket.OPEN) return Promise.resolve(null);
    return new Promise((resolve, reject) => {
      /** @param {Reply | Error | null} reply */
      const settle = (reply) => (reply instanceof Error ? reject(reply) : resolve(reply));
      for (const older of this.#waiting.filter((request) => request.kind === kind)) older.settle(null);
      this.#waiting = [...this.#waiting.filter((request) => request.kind !== kind), { kind, fields, seq: 0, settle }];
      this.#sendNext();
    });
  }

  #sendNext() {
    if (!this.#waiting.length || (this.#running && !SEARCHES.has(this.#running.kind))) return;
    this.#running?.settle(null);
    const request = /** @type {Request} */ (this.#waiting.shift());
    request.seq = this.#seq += 1;
    this.#running = request;
    this.#socket?.send(JSON.stringify({ seq: request.seq, kind: request.kind, ...request.fields }));
  }

  /** @param {ArrayBuffer} data */
  async #receive(data) {
    const { header, buffer } = parseMessage(data);
    const isOutdated = () => header.seq !== null && header.seq !== this.#running?.seq;
    if (isOutdated()) return;
    if (header.kind === "progress") return this.events.progress(header);
    /** @type {Reply | Error} */
    let reply;
    try {
      reply = header.kind === "error" ? new Error(header.text) : { header, images: await decodeImages(header, buffer) };
    } catch {
      reply = new Error("An image from the server could not be decoded.");
    }
    if (isOutdated()) return; // a newer request was sent while the images were decoded
    if (header.seq === null) {
      this.#retry = FIRST_RETRY_MS;
      if (!(reply instanceof Error)) this.events.received(reply);
      return;
    }
    const request = this.#running;
    this.#running = null;
    request?.settle(reply);
    this.#sendNext();
  }
}

/**
 * @param {ArrayBuffer} data length of the header in 4 bytes, the header, the images
 * @returns {{header: Header, buffer: ArrayBuffer}}
 */
function parseMessage(data) {
  const end = 4 + new DataView(data).getUint32(0);
  return { header: JSON.parse(new TextDecoder().decode(data.slice(4, end))), buffer: data.slice(end) };
}

/**
 * @param {Header} header
 * @param {ArrayBuffer} buffer the images in sequence
 * @returns {Promise<Images>}
 */
async function decodeImages(header, buffer) {
  let begin = 0;
  const images = header.images.map(({ name, bytes, alt }) => {
    const image = new Image();
    image.src = URL.createObjectURL(new Blob([buffer.slice(begin, (begin += bytes))], { type: "image/jpeg" }));
    image.alt = alt;
    return /** @type {[string, HTMLImageElement]} */ ([name, image]);
  });
  await Promise.all(images.map(([, image]) => image.decode()));
  return new Map(images);
}

/**
 * Replace an image of the page by a decoded image; hide it if there is none.
 *
 * @param {HTMLImageElement} element
 * @param {HTMLImageElement | undefined} image
 */
export function replaceImage(element, image) {
  element.hidden = !image;
  if (!image) return;
  image.className = element.className;
  image.draggable = false;
  Object.assign(image.dataset, element.dataset);
  URL.revokeObjectURL(element.src);
  element.replaceWith(image);
}

/**
 * Return the element with the attribute `data-role` in the page, or within another element.
 *
 * @param {string} role
 * @param {ParentNode} within
 * @returns {any} the element
 */
export function byRole(role, within = document) {
  return within.querySelector(`[data-role="${role}"]`);
}

/**
 * Create an element. Strings become text nodes, never HTML.
 *
 * @param {string} tag
 * @param {{[name: string]: any}} properties of the element; `data`: its data attributes
 * @param {(Node | string)[]} children
 * @returns {any}
 */
export function createElement(tag, { data = {}, ...properties } = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  Object.assign(element.dataset, data);
  element.append(...children);
  return element;
}

/**
 * Create an SVG element.
 *
 * @param {string} tag
 * @param {{[name: string]: string | number}} values of its attributes
 */
export function createShape(tag, values) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(values)) element.setAttribute(name, String(value));
  return element;
}

/**
 * Format a number in its displayed unit.
 *
 * @param {number | null} value
 * @param {Unit} unit
 * @param {boolean} isSigned whether positive numbers begin with +
 */
export function formatValue(value, unit, isSigned = false) {
  if (value === null) return "–";
  const text = Math.abs(value * unit.factor).toFixed(getDigits(unit));
  const sign = value < 0 && Number(text) !== 0 ? "−" : isSigned ? "+" : "";
  return `${sign}${text}${unit.display_unit && unit.display_unit !== "°" ? " " : ""}${unit.display_unit}`;
}

/** @param {Unit} unit */
export const getDigits = (unit) => (unit.factor === 1 ? 2 : 1);
