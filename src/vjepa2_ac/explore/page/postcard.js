// @ts-check
/** How does one walk through a tree of imagined futures? All of it is in the page: nothing is asked of anybody. */

/** @typedef {{images: string[], at?: number[], errors?: number[], copying?: number, reached?: boolean}} Future */

const byId = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));
const content = JSON.parse(byId("data").textContent);
const { subject, episode, is_pose, seconds, moves, depth } = content;
const places = /** @type {Future[]} */ (content.places);
const tellers = /** @type {string[]} */ (content.tellers); // the subject last

const UNDERSTOOD = 0.8; // of the error of copying the first frame
const KEYS = /** @type {{[key: string]: number}} */ ({
  w: 0, s: 1, a: 2, d: 3, r: 4, f: 5, arrowup: 0, arrowdown: 1, arrowleft: 2, arrowright: 3, pageup: 4, pagedown: 5,
}); // prettier-ignore
const LETTERS = ["W", "S", "A", "D", "R", "F"];
const WORDS = { understood: "✓ understood", partly: "~ partly", "not understood": "✕ not understood", "": "" };
const isKnown = places[1].copying !== undefined; // what is true, everywhere

let path = /** @type {number[]} */ ([]); // of moves
let failure = 0; // the next to be shown

/** Return the number of a path's place: they stand level by level, those of a level in the order of their moves. */
const numberOf = (/** @type {number[]} */ way) => way.reduce((number, move) => number * moves.length + move + 1, 0);

/** Return the path to a place. @returns {number[]} */
const pathTo = (/** @type {number} */ number) =>
  number ? [...pathTo(Math.floor((number - 1) / moves.length)), (number - 1) % moves.length] : [];

/** Return a model's error as a share of that of copying the first frame; NaN: nobody knows. */
const shareOf = (/** @type {Future} */ { errors, copying = NaN }, teller = tellers.length - 1) => (errors?.[teller] ?? NaN) / copying;

function wordOf(/** @type {number} */ share) {
  return share < UNDERSTOOD ? "understood" : share > 1 ? "not understood" : share <= 1 ? "partly" : "";
}

/** Make an element within another one; texts become text, never HTML. */
function make(/** @type {any} */ within, /** @type {string} */ tag, /** @type {object} */ properties) {
  const made = /** @type {any} */ (Object.assign(document.createElement(tag), properties));
  within.append(made);
  return made;
}

const figures = ["true", ...tellers].map((name, order) => {
  const className = !order ? "true" : order < tellers.length ? "base" : "";
  const figure = make(document.createDocumentFragment(), "figure", { className });
  const title = order ? `the ${name} imagines` : isKnown ? "what really happens" : "the given frame";
  const caption = make(figure, "figcaption", {});
  make(caption, "span", { textContent: title });
  byId("moves").before(figure);
  return { title, verdict: make(caption, "span", { className: "verdict" }), image: make(figure, "img", { alt: title }) };
});

/** Return an image of the place, decoded; that of the first place lies behind it, where the two look alike. */
async function decoded(/** @type {string} */ title, /** @type {number} */ order, /** @type {string} */ done) {
  const which = order ? order - 1 : tellers.length; // the true one comes last, where it is known
  const images = [places[0].images[which], places[numberOf(path)].images[which]];
  const [first, url] = images.map((one) => `data:image/webp;base64,${one ?? images[0]}`);
  const image = Object.assign(new Image(), { alt: `${title}, after ${done}`, src: url });
  image.style.backgroundImage = `url(${first})`;
  await image.decode();
  return image;
}

async function draw() {
  const [way, place, isFull] = [path, places[numberOf(path)], path.length === depth];
  const done = way.map((move) => moves[move].label).join(", ");
  const images = await Promise.all(figures.map(({ title }, order) => decoded(title, order, done || "nothing")));
  if (way !== path) return; // somebody went on while images were decoded
  const words = figures.map((_, order) => (order && way.length ? wordOf(shareOf(place, order - 1)) : ""));
  figures.forEach((figure, order) => {
    figure.image.replaceWith(images[order]);
    figure.image = images[order];
    figure.verdict.textContent = WORDS[words[order]];
    figure.verdict.dataset.is = words[order];
  });
  const compared = tellers.map((name, at) => `${name} ${place.errors?.[at]}, ${words[at + 1]}`).join("; ");
  byId("said").textContent = !way.length
    ? "The given frame. Press a direction."
    : `${done}: ${(way.length * seconds).toFixed(1)} s later.` +
      (place.errors ? ` Errors: ${compared}; copying the first frame ${place.copying}.` : "") +
      (place.reached === false ? " The arm cannot go so far." : "") +
      (isFull ? " Here the futures end: undo, or begin anew." : "");
  for (const one of byId("moves").children) one.ariaDisabled = String(one.dataset.move ? isFull : !way.length);
  if (is_pose) drawAbove(way);
}

/** The hand's way from above: x forward is up, y left is left; the dot grows with its height. */
function drawAbove(/** @type {number[]} */ way) {
  const ats = /** @type {number[][]} */ (places.map(({ at }) => at));
  const size = 85 / Math.max(...ats.flatMap((at) => at.map((one, axis) => Math.abs(one - ats[0][axis]))));
  const here = ats[numberOf(way)];
  const points = [0, ...way]
    .map((_, end) => ats[numberOf(way.slice(0, end))])
    .map((at) => at.map((one, axis) => (ats[0][axis] - one) * size));
  const [down, across, below] = points[way.length];
  function set(/** @type {string} */ part, /** @type {object} */ values) {
    for (const [name, value] of Object.entries(values)) byId("above").querySelector(part).setAttribute(name, value);
  }
  set(".way", { points: points.map(([x, y]) => `${y},${x}`).join(" ") });
  set(".now", { cx: across, cy: down, r: 9 - below / 15 });
  const where = here.map((one, axis) => `${"xyz"[axis]} ${(100 * one).toFixed(0)}`).join(", ");
  set("svg", { "aria-label": `the hand's way from above, forward is up; now at ${where} cm` });
}

function go(/** @type {number[]} */ way) {
  path = way;
  draw();
}
const act = (/** @type {number} */ move) => path.length < depth && move < moves.length && go([...path, move]);
const undo = () => path.length && go(path.slice(0, -1));
const reset = () => path.length && go([]);

const shares = places.map((place, number) => (number ? shareOf(place) : NaN));
const failures = [...shares.keys()].filter((at) => shares[at] > 1).sort((one, other) => shares[other] - shares[one]);
const fail = () => failures.length && go(pathTo(failures[failure++ % failures.length]));

function button(/** @type {string} */ text, /** @type {string} */ key, /** @type {() => void} */ onclick, data = {}) {
  const made = make(byId("moves"), "button", { type: "button", textContent: text, onclick });
  make(made, "kbd", { textContent: key });
  Object.assign(made.dataset, data);
}
const ORDER = is_pose ? ["undo", 0, "reset", 4, 2, 1, 3, 5] : [...moves.keys(), "undo", "reset"]; // of the buttons
for (const one of ORDER) {
  if (one === "undo") button("undo", "Z", undo);
  else if (one === "reset") button("reset", "0", reset);
  else button(moves[one].label, is_pose ? LETTERS[one] : String(one + 1), () => act(one), { move: one });
}
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const key = event.key.toLowerCase();
  const move = is_pose ? KEYS[key] : Number(key) - 1;
  if (move >= 0) act(move);
  else if (key === "z" || key === "backspace") undo();
  else if (key === "0") reset();
  else if (key === "x") fail();
  else return;
  event.preventDefault();
});

const futures = places.slice(1);
function percent(/** @type {number} */ teller) {
  return Math.round((100 * futures.filter((one) => shareOf(one, teller) < UNDERSTOOD).length) / futures.length);
}
byId("play").style.setProperty("--figures", String(figures.length));
byId("above").hidden = !is_pose;
byId("failure").hidden = !failures.length;
byId("failure").onclick = fail;
byId("explained").textContent =
  "From one camera frame and your moves, a world model imagines what the camera will see. " +
  `Press a direction, up to ${depth} times` + (isKnown ? ", and see how close it comes to what really happens." : ".");
byId("tally").textContent = isKnown
  ? `Of ${futures.length.toLocaleString("en")} futures, understood: ${tellers.map((name, at) => `${name} ${percent(at)} %`).join(", ")}.`
  : "";
byId("about").textContent =
  (isKnown ? `Understood: the error, in the encoder's numbers, is below ${UNDERSTOOD} of that of copying the first frame;` : "") +
  (isKnown ? " not understood: above it. " : "") +
  `${subject}, episode ${episode}; a move is ${moves[0].size}. Nothing is computed here: every future was imagined beforehand. ${content.notes.join(" ")}`;
draw();
