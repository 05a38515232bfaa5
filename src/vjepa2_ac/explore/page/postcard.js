// @ts-check
/** How does one walk through a tree of imagined futures? All of it is in the page: nothing is asked of anybody. */

const byId = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));
const { subject, episode, is_pose, seconds, moves, depth, places } = JSON.parse(byId("data").textContent);

const UNDERSTOOD = 0.8; // of the error of copying the first frame
const KEYS = /** @type {{[key: string]: number}} */ ({
  w: 0, s: 1, a: 2, d: 3, r: 4, f: 5, arrowup: 0, arrowdown: 1, arrowleft: 2, arrowright: 3, pageup: 4, pagedown: 5,
}); // prettier-ignore
const LETTERS = ["W", "S", "A", "D", "R", "F"];

let path = /** @type {number[]} */ ([]); // of moves

/** Return where the place of a path stands: level by level, those of a level in the order of their moves. */
function placeOf(/** @type {number[]} */ way) {
  let before = 0;
  for (let length = 0; length < way.length; length += 1) before += moves.length ** length;
  return places[before + way.reduce((sum, move) => sum * moves.length + move, 0)];
}

/** Show an image once it is decoded. */
async function show(/** @type {string} */ id, /** @type {string | undefined} */ data, /** @type {string} */ alt) {
  const old = byId(id);
  old.style.visibility = data ? "visible" : "hidden";
  if (!data) return;
  const image = Object.assign(new Image(), { id, className: old.className, alt, src: `data:image/webp;base64,${data}` });
  await image.decode();
  byId(id).replaceWith(image);
}

function verdictOf(/** @type {any} */ { error, copying }) {
  if (!path.length || error === undefined) return "";
  return error < UNDERSTOOD * copying ? "understood" : error > copying ? "not understood" : "partly";
}

async function draw() {
  const place = placeOf(path);
  const done = path.map((move) => moves[move].label).join(", ");
  const verdict = verdictOf(place);
  await Promise.all([
    show("imagined", place.imagined, `what the model imagines after ${done || "nothing"}`),
    show("true", place.true, `what really happens after ${done || "nothing"}`),
  ]);
  byId("said").textContent = path.length ? `${done}: ${(path.length * seconds).toFixed(1)} s later.` : "The given frame.";
  byId("verdict").textContent = verdict && `${verdict}: error ${place.error}, copying the first frame ${place.copying}`;
  byId("verdict").dataset.is = verdict;
  const isFull = path.length === depth;
  byId("moves").querySelectorAll("[data-move]").forEach((/** @type {any} */ button) => (button.disabled = isFull));
  byId("undo").disabled = byId("reset").disabled = !path.length;
  drawAbove();
}

/** The hand's way from above: x forward is up, y left is left; a ring is as large as it is high. */
function drawAbove() {
  byId("above").style.display = is_pose ? "" : "none";
  if (!is_pose) return;
  const ways = path.map((_, end) => placeOf(path.slice(0, end + 1)).at);
  const [x0, y0, z0] = placeOf([]).at;
  const points = [[x0, y0, z0], ...ways].map(([x, y, z]) => [(y0 - y) * 320, (x0 - x) * 320, 8 + (z - z0) * 40]);
  const [across, down, size] = points[points.length - 1];
  byId("above").innerHTML = `<polyline class="way" points="${points.map((one) => one.slice(0, 2).join()).join(" ")}"/><circle class="now" cx="${across}" cy="${down}" r="${Math.max(3, size)}"/>`; // numbers only
  byId("above").setAttribute("aria-label", `the hand from above, ${path.length} steps from where it was`);
}

function go(/** @type {number} */ move) {
  if (path.length === depth || move >= moves.length) return;
  path = [...path, move];
  draw();
}

function back(/** @type {number} */ count) {
  path = path.slice(0, Math.max(0, count));
  draw();
}

function button(/** @type {string} */ text, /** @type {() => void} */ onclick, /** @type {object} */ more) {
  const made = Object.assign(document.createElement("button"), { type: "button", textContent: text, onclick, ...more });
  byId("moves").append(made);
  return made;
}

moves.forEach(({ label }, /** @type {number} */ move) => {
  button(is_pose ? `${label} (${LETTERS[move]})` : `${label} (${move + 1})`, () => go(move), {}).dataset.move = String(move);
});
button("undo (Z)", () => back(path.length - 1), { id: "undo" });
button("reset (0)", () => back(0), { id: "reset" });
byId("about").textContent =
  `${subject}, episode ${episode}; moves of ${moves[0].size}, up to ${depth}. "Understood": the error, in the encoder's` +
  ` numbers, is below ${UNDERSTOOD} of what showing the first frame again would cost.`;
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const key = event.key.toLowerCase();
  const move = is_pose ? KEYS[key] : Number(key) - 1;
  if (move >= 0) go(move);
  else if (key === "z" || key === "backspace") back(path.length - 1);
  else if (key === "0") back(0);
  else return;
  event.preventDefault();
});
draw();
