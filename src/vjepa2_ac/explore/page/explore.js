// @ts-check
/** What does a person see and do who drives a model's imagination? The server computes; the link has all state. */

import { Wire, amount, digits, make, part, shape, swap } from "./shared.js";

/** @typedef {import("./shared.js").Header} Header */
/** @typedef {import("./shared.js").Answer} Answer */
/** @typedef {{episode: number, step: number}} Goal */
/** @typedef {{episode: number, start: number, actions: number[][], goal: Goal | null}} Place replaced, never changed */
/** @typedef {{text: string, verdict: string}} Told of a step */

const UNDERSTOOD = 0.8; // of the error of copying the first frame
const METER_ENDS = 1.25; // of the same
const FILM_MS = 450; // between the steps of a film
const QUICK_S = 0.05; // a step of imagination; then energy maps follow every step
const WORDS = { understood: "✓ understood", partly: "~ partly", "not understood": "✕ not understood" };
const LAYOUT = ["turn left", "forward", "turn right", "up", "left", "back", "right", "down", "open", "close", "still"];
const KEYS = /** @type {{[key: string]: string}} */ ({
  w: "forward", s: "back", a: "left", d: "right", r: "up", f: "down", q: "turn left", e: "turn right", o: "open",
  c: "close", " ": "still", arrowup: "forward", arrowdown: "back", arrowleft: "left", arrowright: "right",
  pageup: "up", pagedown: "down",
}); // prettier-ignore
const LETTERS = new Map(Object.entries(KEYS).slice(0, 11).map(([key, id]) => [id, key === " " ? "␣" : key.toUpperCase()]));

let hello = /** @type {any} */ (null);
let place = /** @type {Place} */ ({ episode: 0, start: 0, actions: [], goal: null });
let look = /** @type {Header | null} */ (null); // of the place, once it is known
let told = /** @type {Map<string, Told>} */ (new Map()); // of the places on the path
let frames = { episode: -1, steps: /** @type {number[]} */ ([]) }; // of the film strips
let sizes = /** @type {Map<string, HTMLInputElement>} */ (new Map()); // step sizes, by their groups
let sliders = /** @type {HTMLInputElement[]} */ ([]); // of the numbers of any action
let shownTeller = 0; // in the view that switches
let turn = 0; // grows when what is under way shall end
let isPlaying = false;
let underWay = Promise.resolve(); // actions that were asked for, one after another
let waiting = 0; // how many of them
const seen = new Set(); // verdicts, for the hint

const wire = new Wire("socket", {
  told: ({ header }) => setUp(header),
  progress: ({ what, done, total }) => working(`${done} of ${total} ${what}`, total ? done / total : 0),
  lost(why) {
    part("lost-text").textContent = `The server does not answer${why ? `: ${why}` : ""}. Trying again by itself …`;
    part("lost").hidden = false;
    working(null);
  },
});

// ---- where we are ----

/** @param {Place} one */
const keyOf = (one) => [one.episode, one.start, ...one.actions.map((action) => action.join())].join(";");

/** @param {number} count of actions */
const before = (count) => ({ ...place, actions: place.actions.slice(0, count) });

/** Return the state as a link's fragment. */
function fragment() {
  /** @param {number} value */
  const short = (value) => (Math.round(value * 1e5) ? String(Math.round(value * 1e5) / 1e5) : "");
  const actions = place.actions.map((action) => action.map(short).join(",")).join(";");
  const goal = place.goal && `&g=${place.goal.episode}.${place.goal.step}`;
  return `#e=${place.episode}&t=${place.start}${place.actions.length ? `&a=${actions}` : ""}${goal ?? ""}`;
}

/** Go to the place of the address's fragment, or where the server proposes. */
async function restore() {
  const values = new URLSearchParams(location.hash.slice(1));
  const numbers = (/** @type {string} */ text) => text.split(/[.,]/).map(Number);
  const episode = Number(values.get("e") ?? hello.place.episode);
  const [of, step] = numbers(values.get("g")?.replace(",", "") ?? "");
  const goal = values.has("g") ? { episode: of, step } : values.has("e") ? null : hello.goal;
  const actions = (values.get("a")?.split(";") ?? []).map((action) => action.split(",").map(Number));
  await goTo({ episode, start: Number(values.get("t") ?? hello.place.start), actions: [], goal });
  for (const action of values.has("a") ? actions : []) act(action);
}

/**
 * Show another place; what is under way ends. Returns whether it is shown.
 *
 * @param {Place} next
 */
async function goTo(next) {
  stop();
  place = next;
  if (next.episode !== frames.episode && !(await openEpisode(next.episode))) return false;
  return show();
}

/** Ask what is at the place, and show it; returns whether that is shown. */
async function show() {
  const asked = place;
  history.replaceState(null, "", fragment());
  const answer = await request("look", asked);
  if (!answer || asked !== place) return false;
  draw(answer);
  if (part("goal").open && hello.step_seconds < QUICK_S && !isPlaying && waiting < 2) showEnergy();
  return true;
}

/**
 * Ask, and say so; what the server cannot do is said instead.
 *
 * @param {string} kind
 * @param {object} fields
 */
async function request(kind, fields) {
  working("computing …");
  try {
    return await wire.ask(kind, fields);
  } catch (error) {
    stop();
    say(error instanceof Error ? error.message : String(error));
    return null;
  } finally {
    working(null);
  }
}

/** @param {number} episode */
async function openEpisode(episode) {
  const answer = await request("episode", { episode });
  if (!answer || place.episode !== episode) return false;
  const steps = /** @type {number[]} */ (answer.header.steps);
  frames = { episode, steps };
  part("episode").value = String(episode);
  const pictures = steps.map((_, number) => answer.pictures.get(`frame-${number}`));
  const last = hello.episodes[episode].steps - 1 - hello.stride;
  strip("start-strip", pictures, (step) => goTo({ ...place, start: step, actions: [] }), last);
  const copies = pictures.map((picture) => picture?.cloneNode());
  strip("goal-strip", copies, (step) => goTo({ ...place, goal: { episode, step } }), Infinity);
  place = { ...place, goal: place.goal ?? { episode, step: steps[steps.length - 1] } };
  return true;
}

// ---- what one does ----

/**
 * Take an action, after those that wait.
 *
 * @param {number[]} action
 */
function act(action) {
  if (isPlaying) stop();
  const mine = turn;
  waiting += 1;
  underWay = underWay.then(async () => {
    if (mine === turn) await step(action);
    waiting -= 1;
  });
  return underWay;
}

/** @param {number[]} action */
async function step(action) {
  if (place.actions.length >= hello.most_steps) {
    stop();
    say(`${hello.most_steps} steps are the most: undo some, or reset.`);
    return false;
  }
  const was = place;
  place = { ...place, actions: [...place.actions, action] };
  const asked = place;
  const isShown = await show();
  if (!isShown && place === asked) place = was; // refused, or lost
  return isShown;
}

/** End what waits, plays or is searched. */
function stop() {
  turn += 1;
  isPlaying = false;
  part("play").setAttribute("aria-pressed", "false");
}

/**
 * Play a film: one action after another, until there is none.
 *
 * @param {() => number[] | null | undefined} next
 */
async function play(next) {
  stop();
  const mine = turn;
  await underWay;
  isPlaying = true;
  part("play").setAttribute("aria-pressed", "true");
  for (let action = next(); action && mine === turn; action = next()) {
    if (!(await step(action))) break;
    await new Promise((resolve) => setTimeout(resolve, FILM_MS));
  }
  if (mine === turn) stop();
}

/** @param {number} count of actions that stay */
const backTo = (count) => goTo(before(Math.max(0, count)));

function recordedStep() {
  if (look?.next_recorded) act(look.next_recorded);
  else say("There is no recorded action here: the recording ends, or you went another way. Undo, or reset.");
}

/** @param {any} move */
function actionOf(move) {
  return hello.action.map((/** @type {any} */ number, /** @type {number} */ axis) =>
    axis === move.axis ? (move.sign * Number(sizes.get(groupOf(axis))?.value)) / number.factor : 0,
  );
}

/** @param {string} id */
function move(id) {
  const found = hello.moves.find((/** @type {any} */ one) => one.id === id);
  if (found) act(actionOf(found));
  flash(part("moves").querySelector(`[data-move="${CSS.escape(id)}"]`));
}

const anyAction = () => sliders.map((slider, axis) => Number(slider.value) / hello.action[axis].factor);

/** @param {HTMLElement | null} button */
function flash(button) {
  button?.classList.add("pressed");
  setTimeout(() => button?.classList.remove("pressed"), 140);
}

async function showEnergy() {
  const asked = place;
  const action = anyAction();
  const answer = await request("energy", { ...asked, teller: part("teller").value, action });
  if (answer && asked === place) drawMaps(answer.header, action);
}

async function plan() {
  stop();
  const mine = turn;
  part("goal").open = true;
  const steps = Math.min(8, Math.max(1, Math.round(Number(part("plan-steps").value)) || 1));
  const answer = await request("plan", { ...place, teller: part("teller").value, steps });
  if (!answer || mine !== turn) return;
  const { energy_now: now, energy_plan: then, iterations, actions } = answer.header;
  const from = `Energy ${value(now)} now, ${value(then)} imagined at the end of ${count(actions.length, "step")}.`;
  part("plan-text").textContent = `${from} The best sample of each iteration:`;
  refill(part("best"), iterations.map((/** @type {any} */ one, /** @type {number} */ number) => {
    const picture = answer.pictures.get(`best-${number}`);
    return make("figure", {}, ...(picture ? [picture] : []), make("figcaption", {}, `${number + 1}: ${value(one.lowest)}`));
  })); // prettier-ignore
  part("planned").hidden = false;
  const left = [...actions];
  await play(() => left.shift());
}

// ---- what one sees ----

/** @param {number | null | undefined} number */
const value = (number) => (number === null || number === undefined ? "–" : number.toFixed(2));

/** @param {number} number @param {string} noun */
const count = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;

/** @param {string} text */
function say(text) {
  part("sentence").textContent = text;
}

/**
 * Show that something is computed, and how far it is.
 *
 * @param {string | null} text null: it is done
 * @param {number | null} share
 */
function working(text, share = null) {
  part("main").setAttribute("aria-busy", String(text !== null));
  part("working").classList.toggle("on", text !== null);
  part("progress-text").textContent = text ?? "";
  if (share === null) part("progress").removeAttribute("value");
  else part("progress").value = share;
}

/** @param {Element} parent @param {Node[]} children */
function refill(parent, children) {
  for (const image of parent.querySelectorAll("img")) URL.revokeObjectURL(image.src);
  parent.replaceChildren(...children);
}

/** @param {number | null} error @param {number | null} copying */
function verdictOf(error, copying) {
  if (error === null || copying === null) return "";
  return error < UNDERSTOOD * copying ? "understood" : error > copying ? "not understood" : "partly";
}

/** @param {HTMLElement} chip @param {string} verdict */
function drawVerdict(chip, verdict) {
  chip.hidden = !verdict;
  chip.dataset.verdict = verdict;
  chip.textContent = WORDS[/** @type {keyof WORDS} */ (verdict)] ?? "";
}

/** @param {Answer} answer to a look */
function draw({ header, pictures }) {
  look = header;
  const last = header.actions.length ? header.actions[header.actions.length - 1] : null;
  const verdicts = header.tellers.map((/** @type {any} */ one) => verdictOf(one.error, header.copying));
  const text = !last ? "given frame" : header.recorded ? "recorded" : inWords(last);
  told.set(keyOf(place), { text, verdict: verdicts[verdicts.length - 1] });
  header.tellers.forEach((/** @type {any} */ one, /** @type {number} */ number) => {
    const figure = pictureOf(one.id);
    const map = pictures.get(`error-${one.id}`);
    swap(part("large", figure), pictures.get(`imagined-${one.id}`));
    swap(part("small", figure), map);
    drawVerdict(part("verdict", figure), verdicts[number]);
    const share = one.error === null || !header.copying || !last ? null : one.error / header.copying;
    part("meter", figure).hidden = share === null;
    part("meter", figure).firstChild.style.left = `${(100 * Math.min(share ?? 0, METER_ENDS)) / METER_ENDS}%`;
    const against = share === null ? "" : `error ${value(one.error)}, ${Math.round(100 * share)} % of copying`;
    part("about", figure).textContent = against || (last ? "" : "nothing was done yet");
  });
  const truth = pictureOf("truth");
  swap(part("large", truth), pictures.get("truth"));
  swap(part("small", truth), pictures.get("given"));
  truth.dataset.truth = header.truth ?? "";
  part("empty", truth).textContent = "Not available: your actions differ from the recorded ones.";
  const how = { simulated: "simulated", recorded: "recorded" }[/** @type {string} */ (header.truth)] ?? "not available";
  part("label", truth).textContent = `truth, ${how}`;
  part("about", truth).textContent = header.note || `the given frame, at control step ${header.start}`;
  swap(part("goal-picture"), pictures.get("goal"));
  sentence(header, text, verdicts);
  hint(last ? verdicts : []);
  drawNumbers(header, verdicts);
  drawPose(header);
  drawTrail();
  mark("start-strip", header.start);
  mark("goal-strip", place.goal?.episode === frames.episode ? place.goal.step : -1);
  part("maps").classList.add("old");
  part("undo").disabled = part("reset").disabled = !last;
  const recorded = part("moves").querySelector('[data-move="recorded"]');
  recorded?.setAttribute("aria-disabled", String(!header.next_recorded));
}

/** @param {Header} header @param {string} text @param {string[]} verdicts */
function sentence(header, text, verdicts) {
  const errors = header.tellers.map(
    (/** @type {any} */ one, /** @type {number} */ number) =>
      `${one.id} error ${value(one.error)}${verdicts[number] && ` (${verdicts[number]})`}`,
  );
  const { name } = hello.episodes[header.episode];
  const known = header.copying === null ? "ground truth not available" : `${errors.join(", ")}, copying ${value(header.copying)}`;
  say(header.actions.length ? `${text}: ${known}. ${header.note}` : `${name}, control step ${header.start}: the given frame.`);
}

/** @param {string[]} verdicts of the models, the subject's last */
function hint(verdicts) {
  const verdict = verdicts[verdicts.length - 1];
  if (verdict) seen.add(verdict);
  const [does, fails] = [seen.has("understood"), seen.has("not understood")];
  const first = hello.is_pose ? "Press W, A, S, D …" : "Press + or − of a number:";
  let text = `${first} what does the model predict?`;
  if (does && fails) text = "Try smaller and larger steps to find where the predictions break down.";
  else if (does) text = "This action is predicted well. Try others: the gripper (C), a turn (Q), a longer step, many steps.";
  else if (seen.size) text = "Find an action that is predicted well: other directions, longer steps, or the recorded one (N).";
  part("hint").textContent = text;
}

/** @param {string} id of a teller, or truth */
const pictureOf = (id) => /** @type {any} */ (part("pictures").querySelector(`[data-of="${CSS.escape(id)}"]`));

/** @param {number[]} action */
function inWords(action) {
  const moved = action.flatMap((number, axis) => {
    const unit = hello.action[axis];
    return Math.abs(number * unit.factor) < 0.5 * 10 ** -digits(unit) ? [] : [axis];
  });
  if (!moved.length) return "still";
  const [axis] = moved;
  const known = hello.moves.find((/** @type {any} */ one) => one.axis === axis && one.sign === Math.sign(action[axis]));
  if (moved.length === 1 && hello.is_pose && known) {
    return `${known.label} ${amount(Math.abs(action[axis]), hello.action[axis])}`;
  }
  return moved.map((one) => `${hello.action[one].name} ${amount(action[one], hello.action[one], true)}`).join(", ");
}

/** @param {Header} header @param {string[]} verdicts */
function drawNumbers(header, verdicts) {
  const rows = /** @type {{[row: string]: (one: any, number: number) => string}} */ ({
    verdict: (_, number) => verdicts[number] || "–",
    error: (one) => value(one.error),
    copying: () => value(header.copying),
    spread: (one) => value(one.spread),
    energy: (one) => value(one.energy),
  });
  for (const [row, text] of Object.entries(rows)) {
    const line = /** @type {HTMLElement} */ (part("numbers").querySelector(`[data-row="${row}"]`));
    const cells = header.tellers.map((/** @type {any} */ one, /** @type {number} */ number) =>
      make("td", { data: { verdict: row === "verdict" ? verdicts[number] : "" } }, text(one, number)),
    );
    line.replaceChildren(/** @type {Element} */ (line.firstElementChild), ...cells);
  }
}

/** @param {Header} header */
function drawPose(header) {
  const rows = hello.state.map((/** @type {any} */ unit, /** @type {number} */ number) =>
    make("tr", {},
      make("th", { scope: "row" }, unit.name),
      make("td", {}, amount(header.state[number], unit)),
      make("td", {}, header.truth_state ? amount(header.truth_state[number], unit) : "–")),
  ); // prettier-ignore
  const head = make("tr", {}, make("td"), ...["expected", "measured"].map((text) => make("th", { scope: "col" }, text)));
  part("pose").replaceChildren(make("thead", {}, head), make("tbody", {}, ...rows));
  part("map").toggleAttribute("hidden", !header.path);
  if (header.path) drawPath(header.path, header.truth_state);
}

/**
 * Draw the hand's path from above, x up and y to the left, and its height beside it.
 *
 * @param {number[][]} path
 * @param {number[] | null} truth
 */
function drawPath(path, truth) {
  const [x0, y0, z0] = path[0];
  const ways = [...path, truth ?? path[0]].map(([x, y, z]) => [y0 - y, x0 - x, z0 - z]);
  const scale = 78 / Math.max(0.12, ...ways.flat().map(Math.abs));
  const at = (/** @type {number[]} */ way) => way.map((one) => one * scale);
  const points = ways.slice(0, -1).map(at);
  const [u, v, w] = points[points.length - 1];
  const [tu, tv, tw] = at(ways[ways.length - 1]);
  const grid = [-0.2, -0.15, -0.1, -0.05, 0, 0.05, 0.1, 0.15, 0.2].map((one) => one * scale).filter((one) => Math.abs(one) < 92);
  const lines = grid.map((one) => `M${one - 8} -92V92M-100 ${one}H84`).join("");
  const shapes = [
    shape("path", { class: "grid", d: lines }),
    shape("path", { class: "height", d: "M93 -92V92" }),
    shape("polyline", { class: "way", points: points.map(([a, b]) => `${a - 8},${b}`).join(" ") }),
    shape("circle", { class: "first", cx: -8, cy: 0, r: 4 }),
    shape("circle", { class: "now", cx: u - 8, cy: v, r: 6 }),
    shape("circle", { class: "now", cx: 93, cy: w, r: 5 }),
  ];
  if (truth) shapes.push(shape("circle", { class: "true", cx: tu - 8, cy: tv, r: 4 }), shape("circle", { class: "true", cx: 93, cy: tw, r: 3.5 }));
  part("map").replaceChildren(...shapes);
  const [x, y, z] = path[path.length - 1].map((one, axis) => amount(one - path[0][axis], hello.state[axis], true));
  part("map").setAttribute("aria-label", `From above: x ${x}, y ${y}, height ${z} from the first frame; grid of 5 cm`);
}

function drawTrail() {
  const steps = [...Array(place.actions.length + 1).keys()].map((number) => {
    const known = told.get(keyOf(before(number)));
    const isLast = number === place.actions.length;
    const chip = make("span", { className: "verdict" });
    drawVerdict(chip, number ? (known?.verdict ?? "") : "");
    const text = known?.text ?? inWords(place.actions[number - 1]);
    const button = make("button", { type: "button", onclick: () => backTo(number) },
      make("small", {}, String(number)), ` ${text} `, chip); // prettier-ignore
    if (isLast) button.setAttribute("aria-current", "step");
    return make("li", { data: { step: number } }, button);
  });
  part("trail").replaceChildren(...steps);
  part("trail").scrollLeft = part("trail").scrollWidth;
}

/**
 * @param {string} role
 * @param {any[]} pictures
 * @param {(step: number) => void} choose
 * @param {number} last step that can be chosen
 */
function strip(role, pictures, choose, last) {
  refill(part(role), pictures.map((picture, number) => {
    const step = frames.steps[number];
    const seconds = ((step / hello.stride) * hello.seconds_per_step).toFixed(1);
    const label = `control step ${step}, ${seconds} s`;
    const properties = { type: "button", disabled: step > last, title: label, onclick: () => choose(step), data: { step } };
    return make("button", properties, picture, make("small", {}, `${seconds} s`));
  })); // prettier-ignore
}

/** @param {string} role of a strip @param {number} step whose frame is chosen */
function mark(role, step) {
  const buttons = /** @type {HTMLElement[]} */ ([...part(role).children]);
  for (const button of buttons) button.removeAttribute("aria-current");
  const chosen = buttons.filter((one) => step >= 0 && Number(one.dataset.step) <= step).pop();
  chosen?.setAttribute("aria-current", "true");
  if (!part(role).contains(document.activeElement)) rove(part(role), chosen ?? buttons[0]);
}

/** @param {Header} header @param {number[]} action around which it is */
function drawMaps(header, action) {
  const had = document.activeElement?.closest(".map");
  const [which, cell] = had ? [[...part("maps").children].indexOf(had), /** @type {any} */ (document.activeElement).dataset.cell] : [-1, ""];
  part("maps").classList.remove("old");
  part("maps").replaceChildren(...header.maps.map((/** @type {any} */ one) => energyMap(one, action)));
  const lowest = Math.min(...header.maps.flatMap((/** @type {any} */ one) => one.energy.flat()));
  part("maps-text").textContent = `Energy ${value(header.now)} for the current frame, ${value(lowest)} at the best action (ringed). Click a cell to execute its action.`;
  if (which >= 0) part("maps").children[which]?.querySelector(`[data-cell="${cell}"]`)?.focus();
}

/**
 * Return a map as a grid of buttons; of a pose x points up or, beside the height, to the right, and y to the left.
 *
 * @param {any} map
 * @param {number[]} action
 */
function energyMap(map, action) {
  const cells = map.energy.flatMap((/** @type {number[]} */ row, /** @type {number} */ up) =>
    row.map((energy, across) => {
      const numbers = [...action];
      numbers[map.across] = map.across_values[across];
      numbers[map.up] = map.up_values[up];
      return { energy, numbers };
    }),
  );
  const isFromAbove = hello.is_pose && map.across === 0 && map.up === 1;
  const [across, up] = isFromAbove ? [1, 0] : [map.across, map.up];
  const toTheRight = hello.is_pose && across === 1 ? -1 : 1;
  cells.sort((/** @type {any} */ a, /** @type {any} */ b) =>
    b.numbers[up] - a.numbers[up] || toTheRight * (a.numbers[across] - b.numbers[across]));
  const energies = cells.map((/** @type {any} */ one) => one.energy);
  const [low, high] = [Math.min(...energies), Math.max(...energies)];
  const buttons = cells.map(({ energy, numbers }, /** @type {number} */ number) => {
    const words = [across, up].map((one) => `${hello.action[one].name} ${amount(numbers[one], hello.action[one], true)}`);
    const text = `${words.join(", ")}: energy ${value(energy)}${energy === low ? ", the lowest" : ""}`;
    const button = make("button", { type: "button", title: text, data: { cell: number }, onclick: () => act(numbers) });
    button.setAttribute("aria-label", text);
    button.classList.toggle("lowest", energy === low);
    button.style.setProperty("--share", `${Math.round((100 * (energy - low)) / (high - low || 1))}%`);
    return button;
  });
  const columns = (isFromAbove ? map.up_values : map.across_values).length;
  const names = [across, up].map((one) => hello.action[one].name);
  const grid = make("div", { className: "cells", data: { columns } }, ...buttons);
  grid.style.gridTemplateColumns = `repeat(${columns}, 1fr)`;
  grid.setAttribute("role", "group");
  grid.setAttribute("aria-label", `Energy over ${names.join(" and ")}`);
  rove(grid, buttons[energies.indexOf(low)]);
  const caption = make("figcaption", {}, `${names[1]} ↑   ${toTheRight < 0 ? `← ${names[0]}` : `${names[0]} →`}`);
  return make("figure", { className: "map", data: { role: "energy-map" } }, grid, caption);
}

/**
 * Let one button of a group be reached by Tab, the others by arrows.
 *
 * @param {HTMLElement} group
 * @param {HTMLElement | undefined} one
 */
function rove(group, one) {
  for (const button of /** @type {HTMLElement[]} */ ([...group.children])) button.tabIndex = button === one ? 0 : -1;
  group.onkeydown = (event) => {
    const columns = Number(group.dataset.columns ?? group.children.length);
    const ways = /** @type {{[key: string]: number}} */ ({ ArrowLeft: -1, ArrowRight: 1, ArrowUp: -columns, ArrowDown: columns });
    if (!(event.key in ways) || event.ctrlKey || event.altKey || event.metaKey) return;
    const buttons = /** @type {HTMLButtonElement[]} */ ([...group.children]);
    const next = buttons[buttons.indexOf(/** @type {any} */ (event.target)) + ways[event.key]];
    event.preventDefault();
    event.stopPropagation(); // it is no move of the arm
    if (!next || next.disabled) return;
    rove(group, next);
    next.focus();
  };
}

// ---- once the server is there ----

/** @param {Header} header */
function setUp(header) {
  hello = header;
  part("lost").hidden = true;
  const step = hello.step_seconds ? `, a step of imagination ${hello.step_seconds.toFixed(2)} s` : "";
  part("subject").textContent = `${hello.subject} on ${hello.device}${step}`;
  part("notes").textContent = hello.notes.join(" ");
  part("notes").hidden = !hello.notes.length;
  part("episode").replaceChildren(
    ...hello.episodes.map(({ name, full }, /** @type {number} */ value) => make("option", { value, title: full }, name)),
  );
  for (const element of document.querySelectorAll(".of-pose")) /** @type {any} */ (element).hidden = !hello.is_pose;
  setUpPictures();
  setUpMoves();
  setUpSliders();
  frames = { episode: -1, steps: [] };
  restore();
}

function setUpPictures() {
  const tellers = hello.tellers;
  const figures = [...tellers, { id: "truth", label: "truth" }].map(({ id, label }) => {
    const figure = part("picture-template").content.firstElementChild.cloneNode(true);
    figure.dataset.of = id;
    part("label", figure).textContent = id === "truth" ? label : `${label} imagines`;
    return figure;
  });
  part("pictures").replaceChildren(...figures);
  part("teller").replaceChildren(...tellers.map(({ id, label }) => make("option", { value: id }, label)));
  part("teller").value = tellers[tellers.length - 1].id;
  part("numbers-head").replaceChildren(make("td"), ...tellers.map(({ label }) => make("th", { scope: "col" }, label)));
  part("teller-label").hidden = part("views").hidden = tellers.length < 2;
  shownTeller = tellers.length - 1;
  view(part("switch").getAttribute("aria-pressed") === "true" && tellers.length > 1);
}

/** @param {boolean} isSwitch whether only one of the models is shown */
function view(isSwitch) {
  const tellers = hello.tellers;
  tellers.forEach(({ id }, /** @type {number} */ number) => (pictureOf(id).hidden = isSwitch && number !== shownTeller));
  part("pictures").dataset.columns = String(isSwitch ? 2 : tellers.length + 1);
  part("switch").setAttribute("aria-pressed", String(isSwitch));
  part("compare").setAttribute("aria-pressed", String(!isSwitch));
}

function switchTeller() {
  if (hello.tellers.length < 2) return say("There is one model here: --against names another one.");
  if (part("switch").getAttribute("aria-pressed") === "true") shownTeller = (shownTeller + 1) % hello.tellers.length;
  view(true);
  say(`${hello.tellers[shownTeller].label} is shown. T shows the other.`);
}

function setUpMoves() {
  const rank = (/** @type {any} */ one) => LAYOUT.indexOf(one.id);
  const moves = hello.is_pose ? [...hello.moves].sort((a, b) => rank(a) - rank(b)) : hello.moves;
  const button = (/** @type {string} */ id, /** @type {string} */ label, /** @type {string} */ key, /** @type {() => void} */ onclick) =>
    make("button", { type: "button", onclick, data: { move: id } }, ...(key ? [make("kbd", {}, key)] : []), ` ${label}`);
  const buttons = moves.map(({ id, label }) => button(id, label, hello.is_pose || id === "still" ? (LETTERS.get(id) ?? "") : "", () => move(id)));
  part("moves").replaceChildren(...buttons, button("recorded", "recorded", "N", recordedStep));
  part("moves").classList.toggle("of-vector", !hello.is_pose);
}

/** @param {number} axis */
function groupOf(axis) {
  return hello.is_pose ? ["distance", "angle", "gripper"][Math.min(2, Math.floor(axis / 3))] : `step, ${hello.action[axis].unit || "number"}`;
}

function setUpSliders() {
  /** @param {string} name @param {any} unit @param {number} low @param {number} most @param {number} now */
  const slider = (name, unit, low, most, now) => {
    const step = 10 ** -digits(unit);
    const input = make("input", { type: "range", min: low ? -most : step, max: most, step, value: now, data: { name } });
    const output = make("output");
    input.oninput = () => (output.textContent = amount(Number(input.value) / unit.factor, unit, Boolean(low)));
    input.oninput();
    return { input, row: make("label", {}, make("span", {}, name), input, output) };
  };
  const limit = (/** @type {any} */ one) => Number((Math.max(one.most, 2 * one.step) * one.factor).toFixed(digits(one)));
  const groups = new Map(hello.action.map((/** @type {any} */ one, /** @type {number} */ axis) => [groupOf(axis), one]));
  const steps = [...groups].map(([name, one]) => ({ name, ...slider(name, one, 0, limit(one), one.step * one.factor) }));
  sizes = new Map(steps.map(({ name, input }) => [name, input]));
  part("sizes").replaceChildren(...steps.map(({ row }) => row));
  const free = hello.action.map((/** @type {any} */ one) => slider(one.name, one, -1, limit(one), 0));
  sliders = free.map((/** @type {any} */ one) => one.input);
  part("sliders").replaceChildren(...free.map((/** @type {any} */ one) => one.row));
  part("any").open = !hello.is_pose;
}

// ---- what is pressed ----

const shortcuts = /** @type {{[key: string]: () => void}} */ ({
  n: recordedStep,
  z: () => backTo(place.actions.length - 1),
  backspace: () => backTo(place.actions.length - 1),
  0: () => backTo(0),
  t: switchTeller,
  m: () => ((part("goal").open = true), showEnergy()),
  p: plan,
  escape: () => isPlaying || waiting ? stop() : show(),
  "?": () => part("keys").showModal(),
});

addEventListener("keydown", (event) => {
  const target = /** @type {HTMLElement} */ (event.target);
  if (!hello || event.ctrlKey || event.altKey || event.metaKey || part("keys").open) return;
  if (target.closest("input, select, textarea") || (event.key === " " && target.closest("button, summary"))) return;
  const key = event.key.toLowerCase();
  if (!(key in shortcuts) && !(key in KEYS)) return;
  event.preventDefault();
  if (event.repeat && (waiting || isPlaying)) return; // a held key goes as fast as answers come
  if (key in shortcuts) shortcuts[key]();
  else move(KEYS[key]);
});

// A slider that was dragged gives the keys back; one that was reached by Tab keeps them.
addEventListener("pointerup", ({ target }) => target instanceof HTMLInputElement && target.type === "range" && target.blur());
addEventListener("hashchange", restore);

/** @param {string} role @param {() => void} what */
const on = (role, what) => part(role).addEventListener("click", what);
on("retry", () => wire.connect());
on("help", () => part("keys").showModal());
on("close-keys", () => part("keys").close());
on("undo", () => backTo(place.actions.length - 1));
on("reset", () => backTo(0));
on("play", () => (isPlaying ? stop() : play(() => look?.next_recorded)));
on("do", () => act(anyAction()));
on("zero", setUpSliders);
on("energy", showEnergy);
on("plan", plan);
on("compare", () => view(false));
on("switch", switchTeller);
on("show-errors", () => {
  const isOff = document.body.classList.toggle("no-errors");
  part("show-errors").setAttribute("aria-pressed", String(!isOff));
});
on("copy-link", async () => {
  const link = new URL(fragment(), location.href).href;
  await navigator.clipboard?.writeText(link).then(() => say("The link is copied: it leads here."), () => say(link)) ?? say(link);
});
part("episode").addEventListener("change", () => goTo({ episode: Number(part("episode").value), start: 0, actions: [], goal: null }));
working("loading the model …");
