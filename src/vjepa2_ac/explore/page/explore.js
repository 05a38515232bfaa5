// @ts-check
/** The page of `explore`. The server computes the predictions; the link contains the complete state of the page. */

import { Wire, byRole, createElement, createShape, formatValue, getDigits, replaceImage } from "./shared.js";

/** @typedef {import("./shared.js").Header} Header */
/** @typedef {import("./shared.js").Reply} Reply */
/** @typedef {{episode: number, step: number}} Goal */
/** @typedef {{episode: number, start: number, actions: number[][], goal: Goal | null}} Position objects of this type are replaced, never modified */
/** @typedef {{text: string, rating: string}} StepLabel */

const GOOD_RATIO = 0.8; // a rating is good below this ratio of the error to the persistence error
const METER_MAX = 1.25; // largest ratio on the meter
const PLAYBACK_MS = 450; // time between the steps of a playback
const QUICK_S = 0.05; // if a model step takes less time, the energy map is updated after each step
const RATINGS = { good: "✓ good", fair: "~ fair", poor: "✕ poor" };
const LAYOUT = ["turn left", "forward", "turn right", "up", "left", "back", "right", "down", "open", "close", "zero action"];
const KEYS = /** @type {{[key: string]: string}} */ ({
  w: "forward", s: "back", a: "left", d: "right", r: "up", f: "down", q: "turn left", e: "turn right", o: "open",
  c: "close", " ": "zero action", arrowup: "forward", arrowdown: "back", arrowleft: "left", arrowright: "right",
  pageup: "up", pagedown: "down",
}); // prettier-ignore
const LETTERS = new Map(Object.entries(KEYS).slice(0, 11).map(([key, id]) => [id, key === " " ? "␣" : key.toUpperCase()]));

let hello = /** @type {any} */ (null);
let position = /** @type {Position} */ ({ episode: 0, start: 0, actions: [], goal: null });
let prediction = /** @type {Header | null} */ (null); // header of the reply for the current position
const labels = /** @type {Map<string, StepLabel>} */ (new Map()); // by position
let frames = { episode: -1, steps: /** @type {number[]} */ ([]) }; // frames of the image strips
let sizes = /** @type {Map<string, HTMLInputElement>} */ (new Map()); // sliders of the step sizes, by group
let sliders = /** @type {HTMLInputElement[]} */ ([]); // sliders of the custom action
let shownModel = 0; // index of the model in the view with one model
let generation = 0; // incremented to cancel queued actions, playback and searches
let isPlaying = false;
let queue = Promise.resolve(); // resolved when all requested actions have been executed, one after another
let numQueued = 0; // number of actions in the queue
const seenRatings = new Set(); // ratings so far, which determine the hint

const wire = new Wire("socket", {
  received: ({ header }) => setUp(header),
  progress: ({ what, done, total }) => showProgress(`${done} of ${total} ${what}`, total ? done / total : 0),
  disconnected(reason) {
    byRole("disconnected-text").textContent = `No connection to the server${reason ? ` (${reason})` : ""}. Reconnecting …`;
    byRole("disconnected").hidden = false;
    showProgress(null);
  },
});

// ---- position and navigation ----

/** @param {Position} of */
const getKey = (of) => [of.episode, of.start, ...of.actions.map((action) => action.join())].join(";");

/** @param {number} count number of actions that are kept */
const truncatePath = (count) => ({ ...position, actions: position.actions.slice(0, count) });

/** Return the state of the page as the fragment of a link. */
function formatFragment() {
  /** @param {number} value */
  const format = (value) => (Math.round(value * 1e5) ? String(Math.round(value * 1e5) / 1e5) : "");
  const actions = position.actions.map((action) => action.map(format).join(",")).join(";");
  const goal = position.goal && `&g=${position.goal.episode}.${position.goal.step}`;
  return `#e=${position.episode}&t=${position.start}${position.actions.length ? `&a=${actions}` : ""}${goal ?? ""}`;
}

/** Go to the position in the fragment of the address, or to the initial position of the server. */
async function restore() {
  const values = new URLSearchParams(location.hash.slice(1));
  const numbers = (/** @type {string} */ text) => text.split(/[.,]/).map(Number);
  const episode = Number(values.get("e") ?? hello.position.episode);
  const [goalEpisode, goalStep] = numbers(values.get("g")?.replace(",", "") ?? "");
  const goal = values.has("g") ? { episode: goalEpisode, step: goalStep } : values.has("e") ? null : hello.goal;
  const actions = (values.get("a")?.split(";") ?? []).map((action) => action.split(",").map(Number));
  await goTo({ episode, start: Number(values.get("t") ?? hello.position.start), actions: [], goal });
  for (const action of values.has("a") ? actions : []) act(action);
}

/**
 * Go to another position and cancel running work. Return whether the position is shown.
 *
 * @param {Position} next
 */
async function goTo(next) {
  stop();
  position = next;
  if (next.episode !== frames.episode && !(await openEpisode(next.episode))) return false;
  return show();
}

/** Request the prediction at the current position and draw it. Return whether it is shown. */
async function show() {
  const requested = position;
  history.replaceState(null, "", formatFragment());
  const reply = await sendRequest("predict", requested);
  if (!reply || requested !== position) return false;
  draw(reply);
  if (byRole("goal").open && hello.step_seconds < QUICK_S && !isPlaying && numQueued < 2) showEnergy();
  return true;
}

/**
 * Send a request and show its progress, or the server's error. Return the reply; null if there is none.
 *
 * @param {string} kind
 * @param {object} fields
 */
async function sendRequest(kind, fields) {
  showProgress("computing …");
  try {
    return await wire.send(kind, fields);
  } catch (error) {
    stop();
    showMessage(error instanceof Error ? error.message : String(error));
    return null;
  } finally {
    showProgress(null);
  }
}

/** @param {number} episode */
async function openEpisode(episode) {
  const reply = await sendRequest("episode", { episode });
  if (!reply || position.episode !== episode) return false;
  const steps = /** @type {number[]} */ (reply.header.steps);
  frames = { episode, steps };
  byRole("episode").value = String(episode);
  const images = steps.map((_, number) => reply.images.get(`frame-${number}`));
  const last = hello.episodes[episode].steps - 1 - hello.stride;
  drawStrip("start-strip", images, (step) => goTo({ ...position, start: step, actions: [] }), last);
  const copies = images.map((image) => image?.cloneNode());
  drawStrip("goal-strip", copies, (step) => goTo({ ...position, goal: { episode, step } }), Infinity);
  position = { ...position, goal: position.goal ?? { episode, step: steps[steps.length - 1] } };
  return true;
}

// ---- actions ----

/**
 * Execute an action after those in the queue.
 *
 * @param {number[]} action
 */
function act(action) {
  if (isPlaying) stop();
  const current = generation;
  numQueued += 1;
  queue = queue.then(async () => {
    if (current === generation) await step(action);
    numQueued -= 1;
  });
  return queue;
}

/** @param {number[]} action */
async function step(action) {
  if (position.actions.length >= hello.max_steps) {
    stop();
    showMessage(`A path has at most ${hello.max_steps} steps. Undo some steps, or reset.`);
    return false;
  }
  const previous = position;
  position = { ...position, actions: [...position.actions, action] };
  const requested = position;
  const isShown = await show();
  if (!isShown && position === requested) position = previous; // the server rejected the action, or the connection was lost
  return isShown;
}

/** Cancel queued actions, playback and searches. */
function stop() {
  generation += 1;
  isPlaying = false;
  byRole("play").setAttribute("aria-pressed", "false");
}

/**
 * Execute actions one after another, with a pause between them.
 *
 * @param {() => number[] | null | undefined} next returns the next action; null or undefined: no more actions
 */
async function play(next) {
  stop();
  const current = generation;
  await queue;
  isPlaying = true;
  byRole("play").setAttribute("aria-pressed", "true");
  for (let action = next(); action && current === generation; action = next()) {
    if (!(await step(action))) break;
    await new Promise((resolve) => setTimeout(resolve, PLAYBACK_MS));
  }
  if (current === generation) stop();
}

/** @param {number} count number of actions that are kept */
const backTo = (count) => goTo(truncatePath(Math.max(0, count)));

function executeRecordedAction() {
  if (prediction?.next_recorded) act(prediction.next_recorded);
  else showMessage("There is no recorded action here, because the recording ends or your actions differ from it. Undo, or reset.");
}

/** @param {any} move */
function getMoveAction(move) {
  return hello.action.map((/** @type {any} */ number, /** @type {number} */ axis) =>
    axis === move.axis ? (move.sign * Number(sizes.get(getStepGroup(axis))?.value)) / number.factor : 0,
  );
}

/** @param {string} id */
function move(id) {
  const command = hello.moves.find((/** @type {any} */ candidate) => candidate.id === id);
  if (command) act(getMoveAction(command));
  flash(byRole("moves").querySelector(`[data-move="${CSS.escape(id)}"]`));
}

const getCustomAction = () => sliders.map((slider, axis) => Number(slider.value) / hello.action[axis].factor);

/** @param {HTMLElement | null} button */
function flash(button) {
  button?.classList.add("pressed");
  setTimeout(() => button?.classList.remove("pressed"), 140);
}

async function showEnergy() {
  const requested = position;
  const action = getCustomAction();
  const reply = await sendRequest("energy", { ...requested, model: byRole("model").value, action });
  if (reply && requested === position) drawMaps(reply.header, action);
}

async function plan() {
  stop();
  const current = generation;
  byRole("goal").open = true;
  const steps = Math.min(8, Math.max(1, Math.round(Number(byRole("plan-steps").value)) || 1));
  const reply = await sendRequest("plan", { ...position, model: byRole("model").value, steps });
  if (!reply || current !== generation) return;
  const { energy_now: energyNow, energy_plan: planEnergy, iterations, actions } = reply.header;
  const energies = `Energy ${formatNumber(energyNow)} at the current frame, ${formatNumber(planEnergy)} predicted after ${pluralize(actions.length, "step")}.`;
  byRole("plan-text").textContent = `${energies} Best sample of each iteration:`;
  replaceImages(byRole("best"), iterations.map((/** @type {any} */ item, /** @type {number} */ number) => {
    const image = reply.images.get(`best-${number}`);
    return createElement("figure", {}, ...(image ? [image] : []), createElement("figcaption", {}, `${number + 1}: ${formatNumber(item.lowest)}`));
  })); // prettier-ignore
  byRole("planned").hidden = false;
  const remaining = [...actions];
  await play(() => remaining.shift());
}

// ---- display ----

/** @param {number | null | undefined} number */
const formatNumber = (number) => (number === null || number === undefined ? "–" : number.toFixed(2));

/** @param {number} number @param {string} noun */
const pluralize = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;

/** @param {string} text */
function showMessage(text) {
  byRole("sentence").textContent = text;
}

/**
 * Show or hide the progress of a computation.
 *
 * @param {string | null} text null: nothing is computed
 * @param {number | null} fraction null: unknown
 */
function showProgress(text, fraction = null) {
  byRole("main").setAttribute("aria-busy", String(text !== null));
  byRole("working").classList.toggle("on", text !== null);
  byRole("progress-text").textContent = text ?? "";
  if (fraction === null) byRole("progress").removeAttribute("value");
  else byRole("progress").value = fraction;
}

/** @param {Element} parent @param {Node[]} children */
function replaceImages(parent, children) {
  for (const image of parent.querySelectorAll("img")) URL.revokeObjectURL(image.src);
  parent.replaceChildren(...children);
}

/** @param {number | null} error @param {number | null} persistence */
function getRating(error, persistence) {
  if (error === null || persistence === null) return "";
  return error < GOOD_RATIO * persistence ? "good" : error > persistence ? "poor" : "fair";
}

/** @param {HTMLElement} chip @param {string} rating */
function drawRating(chip, rating) {
  chip.hidden = !rating;
  chip.dataset.rating = rating;
  chip.textContent = RATINGS[/** @type {keyof RATINGS} */ (rating)] ?? "";
}

/** @param {Reply} reply to a request `predict` */
function draw({ header, images }) {
  prediction = header;
  const last = header.actions.length ? header.actions[header.actions.length - 1] : null;
  const ratings = header.models.map((/** @type {any} */ item) => getRating(item.error, header.persistence_error));
  const text = !last ? "start frame" : header.recorded ? "recorded" : describeAction(last);
  labels.set(getKey(position), { text, rating: ratings[ratings.length - 1] });
  header.models.forEach((/** @type {any} */ item, /** @type {number} */ number) => {
    const figure = getView(item.id);
    const map = images.get(`error-${item.id}`);
    replaceImage(byRole("large", figure), images.get(`predicted-${item.id}`));
    replaceImage(byRole("small", figure), map);
    drawRating(byRole("rating", figure), ratings[number]);
    const ratio = item.error === null || !header.persistence_error || !last ? null : item.error / header.persistence_error;
    byRole("meter", figure).hidden = ratio === null;
    byRole("meter", figure).firstChild.style.left = `${(100 * Math.min(ratio ?? 0, METER_MAX)) / METER_MAX}%`;
    const comparison = ratio === null ? "" : `error ${formatNumber(item.error)}, ${Math.round(100 * ratio)} % of persistence`;
    byRole("about", figure).textContent = comparison || (last ? "" : "no action yet");
  });
  const truth = getView("truth");
  replaceImage(byRole("large", truth), images.get("truth"));
  replaceImage(byRole("small", truth), images.get("start"));
  truth.dataset.truth = header.truth ?? "";
  byRole("empty", truth).textContent = "Not available, because your actions differ from the recorded actions.";
  const kind = { simulated: "simulated", recorded: "recorded" }[/** @type {string} */ (header.truth)] ?? "not available";
  byRole("label", truth).textContent = `ground truth, ${kind}`;
  byRole("about", truth).textContent = header.note || `start frame, control step ${header.start}`;
  replaceImage(byRole("goal-image"), images.get("goal"));
  drawSummary(header, text, ratings);
  drawHint(last ? ratings : []);
  drawMetrics(header, ratings);
  drawPose(header);
  drawTrail();
  markFrame("start-strip", header.start);
  markFrame("goal-strip", position.goal?.episode === frames.episode ? position.goal.step : -1);
  byRole("maps").classList.add("outdated");
  byRole("undo").disabled = byRole("reset").disabled = !last;
  const recorded = byRole("moves").querySelector('[data-move="recorded"]');
  recorded?.setAttribute("aria-disabled", String(!header.next_recorded));
}

/** @param {Header} header @param {string} text @param {string[]} ratings */
function drawSummary(header, text, ratings) {
  const errors = header.models.map(
    (/** @type {any} */ item, /** @type {number} */ number) =>
      `${item.id} error ${formatNumber(item.error)}${ratings[number] && ` (${ratings[number]})`}`,
  );
  const { name } = hello.episodes[header.episode];
  const result = header.persistence_error === null ? "ground truth not available" : `${errors.join(", ")}, persistence ${formatNumber(header.persistence_error)}`;
  showMessage(header.actions.length ? `${text}: ${result}. ${header.note}` : `${name}, control step ${header.start}: the start frame.`);
}

/** @param {string[]} ratings ratings of the models; the last item is that of the main model */
function drawHint(ratings) {
  const rating = ratings[ratings.length - 1];
  if (rating) seenRatings.add(rating);
  const [hasGood, hasPoor] = [seenRatings.has("good"), seenRatings.has("poor")];
  let text = hello.is_pose
    ? "Press W, A, S or D to command a motion, and compare the predicted frame with the ground truth."
    : "Press + or − of a number to command a motion, and compare the predicted frame with the ground truth.";
  if (hasGood && hasPoor) text = "Try smaller and larger steps to find where the predictions break down.";
  else if (hasGood) text = "This action is predicted well. Try other actions: the gripper (C), a rotation (Q), a larger step, or many steps.";
  else if (seenRatings.size) text = "Find an action that is predicted well: try other directions, larger steps or the recorded action (N).";
  byRole("hint").textContent = text;
}

/** @param {string} id of a model, or "truth" */
const getView = (id) => /** @type {any} */ (byRole("images").querySelector(`[data-of="${CSS.escape(id)}"]`));

/** @param {number[]} action */
function describeAction(action) {
  const changed = action.flatMap((number, axis) => {
    const unit = hello.action[axis];
    return Math.abs(number * unit.factor) < 0.5 * 10 ** -getDigits(unit) ? [] : [axis];
  });
  if (!changed.length) return "zero action";
  const [axis] = changed;
  const command = hello.moves.find((/** @type {any} */ item) => item.axis === axis && item.sign === Math.sign(action[axis]));
  if (changed.length === 1 && hello.is_pose && command) {
    return `${command.label} ${formatValue(Math.abs(action[axis]), hello.action[axis])}`;
  }
  return changed.map((item) => `${hello.action[item].name} ${formatValue(action[item], hello.action[item], true)}`).join(", ");
}

/** @param {Header} header @param {string[]} ratings */
function drawMetrics(header, ratings) {
  const rows = /** @type {{[row: string]: (item: any, number: number) => string}} */ ({
    rating: (_, number) => ratings[number] || "–",
    error: (item) => formatNumber(item.error),
    persistence: () => formatNumber(header.persistence_error),
    spread: (item) => formatNumber(item.spread),
    energy: (item) => formatNumber(item.energy),
  });
  for (const [row, text] of Object.entries(rows)) {
    const line = /** @type {HTMLElement} */ (byRole("numbers").querySelector(`[data-row="${row}"]`));
    const cells = header.models.map((/** @type {any} */ item, /** @type {number} */ number) =>
      createElement("td", { data: { rating: row === "rating" ? ratings[number] : "" } }, text(item, number)),
    );
    line.replaceChildren(/** @type {Element} */ (line.firstElementChild), ...cells);
  }
}

/** @param {Header} header */
function drawPose(header) {
  const rows = hello.state.map((/** @type {any} */ unit, /** @type {number} */ number) =>
    createElement("tr", {},
      createElement("th", { scope: "row" }, unit.name),
      createElement("td", {}, formatValue(header.state[number], unit)),
      createElement("td", {}, header.truth_state ? formatValue(header.truth_state[number], unit) : "–")),
  ); // prettier-ignore
  const head = createElement("tr", {}, createElement("td"), ...["expected", "true"].map((text) => createElement("th", { scope: "col" }, text)));
  byRole("pose").replaceChildren(createElement("thead", {}, head), createElement("tbody", {}, ...rows));
  byRole("map").toggleAttribute("hidden", !header.path);
  if (header.path) drawPath(header.path, header.truth_state);
}

/**
 * Draw the path of the gripper from above (x points up, y to the left), and its height at the right edge.
 *
 * @param {number[][]} path
 * @param {number[] | null} truth
 */
function drawPath(path, truth) {
  const [x0, y0, z0] = path[0];
  const offsets = [...path, truth ?? path[0]].map(([x, y, z]) => [y0 - y, x0 - x, z0 - z]);
  const scale = 78 / Math.max(0.12, ...offsets.flat().map(Math.abs));
  const toPixels = (/** @type {number[]} */ offset) => offset.map((item) => item * scale);
  const points = offsets.slice(0, -1).map(toPixels);
  const [u, v, w] = points[points.length - 1];
  const [tu, tv, tw] = toPixels(offsets[offsets.length - 1]);
  const grid = [-0.2, -0.15, -0.1, -0.05, 0, 0.05, 0.1, 0.15, 0.2].map((item) => item * scale).filter((item) => Math.abs(item) < 92);
  const lines = grid.map((item) => `M${item - 8} -92V92M-100 ${item}H84`).join("");
  const shapes = [
    createShape("path", { class: "grid", d: lines }),
    createShape("path", { class: "height", d: "M93 -92V92" }),
    createShape("polyline", { class: "path-line", points: points.map(([a, b]) => `${a - 8},${b}`).join(" ") }),
    createShape("circle", { class: "start", cx: -8, cy: 0, r: 4 }),
    createShape("circle", { class: "current", cx: u - 8, cy: v, r: 6 }),
    createShape("circle", { class: "current", cx: 93, cy: w, r: 5 }),
  ];
  if (truth) shapes.push(createShape("circle", { class: "truth", cx: tu - 8, cy: tv, r: 4 }), createShape("circle", { class: "truth", cx: 93, cy: tw, r: 3.5 }));
  byRole("map").replaceChildren(...shapes);
  const [x, y, z] = path[path.length - 1].map((item, axis) => formatValue(item - path[0][axis], hello.state[axis], true));
  byRole("map").setAttribute("aria-label", `From above: x ${x}, y ${y}, height ${z} relative to the start frame; grid of 5 cm`);
}

function drawTrail() {
  const steps = [...Array(position.actions.length + 1).keys()].map((number) => {
    const label = labels.get(getKey(truncatePath(number)));
    const isLast = number === position.actions.length;
    const chip = createElement("span", { className: "rating" });
    drawRating(chip, number ? (label?.rating ?? "") : "");
    const text = label?.text ?? describeAction(position.actions[number - 1]);
    const button = createElement("button", { type: "button", onclick: () => backTo(number) },
      createElement("small", {}, String(number)), ` ${text} `, chip); // prettier-ignore
    if (isLast) button.setAttribute("aria-current", "step");
    return createElement("li", { data: { step: number } }, button);
  });
  byRole("trail").replaceChildren(...steps);
  byRole("trail").scrollLeft = byRole("trail").scrollWidth;
}

/**
 * @param {string} role
 * @param {any[]} images
 * @param {(step: number) => void} choose
 * @param {number} last last control step that can be chosen
 */
function drawStrip(role, images, choose, last) {
  replaceImages(byRole(role), images.map((image, number) => {
    const step = frames.steps[number];
    const seconds = ((step / hello.stride) * hello.seconds_per_step).toFixed(1);
    const label = `control step ${step}, ${seconds} s`;
    const properties = { type: "button", disabled: step > last, title: label, onclick: () => choose(step), data: { step } };
    return createElement("button", properties, image, createElement("small", {}, `${seconds} s`));
  })); // prettier-ignore
}

/** @param {string} role of a strip @param {number} step control step of the frame to mark; below 0: no frame */
function markFrame(role, step) {
  const buttons = /** @type {HTMLElement[]} */ ([...byRole(role).children]);
  for (const button of buttons) button.removeAttribute("aria-current");
  const chosen = buttons.filter((item) => step >= 0 && Number(item.dataset.step) <= step).pop();
  chosen?.setAttribute("aria-current", "true");
  if (!byRole(role).contains(document.activeElement)) setTabStop(byRole(role), chosen ?? buttons[0]);
}

/** @param {Header} header @param {number[]} action the centre of the maps */
function drawMaps(header, action) {
  const focusedMap = document.activeElement?.closest(".map"); // the focus moves to the same cell of the new map
  const [mapIndex, cell] = focusedMap ? [[...byRole("maps").children].indexOf(focusedMap), /** @type {any} */ (document.activeElement).dataset.cell] : [-1, ""];
  byRole("maps").classList.remove("outdated");
  byRole("maps").replaceChildren(...header.maps.map((/** @type {any} */ item) => createEnergyMap(item, action)));
  const lowest = Math.min(...header.maps.flatMap((/** @type {any} */ item) => item.energy.flat()));
  byRole("maps-text").textContent = `Energy ${formatNumber(header.energy_now)} at the current frame, ${formatNumber(lowest)} after the best action (outlined). Click a cell to execute its action.`;
  if (mapIndex >= 0) byRole("maps").children[mapIndex]?.querySelector(`[data-cell="${cell}"]`)?.focus();
}

/**
 * Return an energy map as a grid of buttons. For poses, x points up (to the right in the map with the height) and y to the left.
 *
 * @param {any} map
 * @param {number[]} action
 */
function createEnergyMap(map, action) {
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
  const energies = cells.map((/** @type {any} */ item) => item.energy);
  const [low, high] = [Math.min(...energies), Math.max(...energies)];
  const buttons = cells.map(({ energy, numbers }, /** @type {number} */ number) => {
    const words = [across, up].map((item) => `${hello.action[item].name} ${formatValue(numbers[item], hello.action[item], true)}`);
    const text = `${words.join(", ")}: energy ${formatNumber(energy)}${energy === low ? ", the lowest" : ""}`;
    const button = createElement("button", { type: "button", title: text, data: { cell: number }, onclick: () => act(numbers) });
    button.setAttribute("aria-label", text);
    button.classList.toggle("lowest", energy === low);
    button.style.setProperty("--share", `${Math.round((100 * (energy - low)) / (high - low || 1))}%`);
    return button;
  });
  const columns = (isFromAbove ? map.up_values : map.across_values).length;
  const names = [across, up].map((item) => hello.action[item].name);
  const grid = createElement("div", { className: "cells", data: { columns } }, ...buttons);
  grid.style.gridTemplateColumns = `repeat(${columns}, 1fr)`;
  grid.setAttribute("role", "group");
  grid.setAttribute("aria-label", `Energy over ${names.join(" and ")}`);
  setTabStop(grid, buttons[energies.indexOf(low)]);
  const caption = createElement("figcaption", {}, `${names[1]} ↑   ${toTheRight < 0 ? `← ${names[0]}` : `${names[0]} →`}`);
  return createElement("figure", { className: "map", data: { role: "energy-map" } }, grid, caption);
}

/**
 * Make one button of a group reachable by Tab, and the others by the arrow keys.
 *
 * @param {HTMLElement} group
 * @param {HTMLElement | undefined} item
 */
function setTabStop(group, item) {
  for (const button of /** @type {HTMLElement[]} */ ([...group.children])) button.tabIndex = button === item ? 0 : -1;
  group.onkeydown = (event) => {
    const columns = Number(group.dataset.columns ?? group.children.length);
    const offsets = /** @type {{[key: string]: number}} */ ({ ArrowLeft: -1, ArrowRight: 1, ArrowUp: -columns, ArrowDown: columns });
    if (!(event.key in offsets) || event.ctrlKey || event.altKey || event.metaKey) return;
    const buttons = /** @type {HTMLButtonElement[]} */ ([...group.children]);
    const next = buttons[buttons.indexOf(/** @type {any} */ (event.target)) + offsets[event.key]];
    event.preventDefault();
    event.stopPropagation(); // the key does not command a motion
    if (!next || next.disabled) return;
    setTabStop(group, next);
    next.focus();
  };
}

// ---- set-up after the connection ----

/** @param {Header} header */
function setUp(header) {
  hello = header;
  byRole("disconnected").hidden = true;
  const step = hello.step_seconds ? `; ${hello.step_seconds.toFixed(2)} s per model step` : "";
  byRole("subject").textContent = `${hello.subject} on ${hello.device}${step}`;
  byRole("notes").textContent = hello.notes.join(" ");
  byRole("notes").hidden = !hello.notes.length;
  byRole("episode").replaceChildren(
    ...hello.episodes.map(({ name, full }, /** @type {number} */ value) => createElement("option", { value, title: full }, name)),
  );
  for (const element of document.querySelectorAll(".of-pose")) /** @type {any} */ (element).hidden = !hello.is_pose;
  setUpViews();
  setUpMoves();
  setUpSliders();
  frames = { episode: -1, steps: [] };
  restore();
}

function setUpViews() {
  const models = hello.models;
  const figures = [...models, { id: "truth", label: "ground truth" }].map(({ id, label }) => {
    const figure = byRole("image-template").content.firstElementChild.cloneNode(true);
    figure.dataset.of = id;
    byRole("label", figure).textContent = id === "truth" ? label : `predicted by ${label}`;
    return figure;
  });
  byRole("images").replaceChildren(...figures);
  byRole("model").replaceChildren(...models.map(({ id, label }) => createElement("option", { value: id }, label)));
  byRole("model").value = models[models.length - 1].id;
  byRole("numbers-head").replaceChildren(createElement("td"), ...models.map(({ label }) => createElement("th", { scope: "col" }, label)));
  byRole("model-label").hidden = byRole("views").hidden = models.length < 2;
  shownModel = models.length - 1;
  setViewMode(byRole("switch").getAttribute("aria-pressed") === "true" && models.length > 1);
}

/** @param {boolean} isSingle whether only one model is shown */
function setViewMode(isSingle) {
  const models = hello.models;
  models.forEach(({ id }, /** @type {number} */ number) => (getView(id).hidden = isSingle && number !== shownModel));
  byRole("images").dataset.columns = String(isSingle ? 2 : models.length + 1);
  byRole("switch").setAttribute("aria-pressed", String(isSingle));
  byRole("compare").setAttribute("aria-pressed", String(!isSingle));
}

function showNextModel() {
  if (hello.models.length < 2) return showMessage("There is only one model. Add another model with --against.");
  if (byRole("switch").getAttribute("aria-pressed") === "true") shownModel = (shownModel + 1) % hello.models.length;
  setViewMode(true);
  showMessage(`Model ${hello.models[shownModel].label} is shown. Press T for the next model.`);
}

function setUpMoves() {
  const rank = (/** @type {any} */ item) => LAYOUT.indexOf(item.id);
  const moves = hello.is_pose ? [...hello.moves].sort((a, b) => rank(a) - rank(b)) : hello.moves;
  const button = (/** @type {string} */ id, /** @type {string} */ label, /** @type {string} */ key, /** @type {() => void} */ onclick) =>
    createElement("button", { type: "button", onclick, data: { move: id } }, ...(key ? [createElement("kbd", {}, key)] : []), ` ${label}`);
  const buttons = moves.map(({ id, label }) => button(id, label, hello.is_pose || id === "zero action" ? (LETTERS.get(id) ?? "") : "", () => move(id)));
  byRole("moves").replaceChildren(...buttons, button("recorded", "recorded", "N", executeRecordedAction));
  byRole("moves").classList.toggle("of-vector", !hello.is_pose);
}

/** @param {number} axis */
function getStepGroup(axis) {
  return hello.is_pose ? ["distance", "angle", "gripper"][Math.min(2, Math.floor(axis / 3))] : `step, ${hello.action[axis].unit || "number"}`;
}

function setUpSliders() {
  /** @param {string} name @param {any} unit @param {boolean} isSigned @param {number} max @param {number} value */
  const createSlider = (name, unit, isSigned, max, value) => {
    const step = 10 ** -getDigits(unit);
    const input = createElement("input", { type: "range", min: isSigned ? -max : step, max, step, value, data: { name } });
    const output = createElement("output");
    input.oninput = () => (output.textContent = formatValue(Number(input.value) / unit.factor, unit, isSigned));
    input.oninput();
    return { input, row: createElement("label", {}, createElement("span", {}, name), input, output) };
  };
  const limit = (/** @type {any} */ item) => Number((Math.max(item.most, 2 * item.step) * item.factor).toFixed(getDigits(item)));
  const groups = new Map(hello.action.map((/** @type {any} */ item, /** @type {number} */ axis) => [getStepGroup(axis), item]));
  const steps = [...groups].map(([name, item]) => ({ name, ...createSlider(name, item, false, limit(item), item.step * item.factor) }));
  sizes = new Map(steps.map(({ name, input }) => [name, input]));
  byRole("sizes").replaceChildren(...steps.map(({ row }) => row));
  const free = hello.action.map((/** @type {any} */ item) => createSlider(item.name, item, true, limit(item), 0));
  sliders = free.map((/** @type {any} */ item) => item.input);
  byRole("sliders").replaceChildren(...free.map((/** @type {any} */ item) => item.row));
  byRole("custom-action").open = !hello.is_pose;
}

// ---- keys and buttons ----

const shortcuts = /** @type {{[key: string]: () => void}} */ ({
  n: executeRecordedAction,
  z: () => backTo(position.actions.length - 1),
  backspace: () => backTo(position.actions.length - 1),
  0: () => backTo(0),
  t: showNextModel,
  m: () => ((byRole("goal").open = true), showEnergy()),
  p: plan,
  escape: () => isPlaying || numQueued ? stop() : show(),
  "?": () => byRole("keys").showModal(),
});

addEventListener("keydown", (event) => {
  const target = /** @type {HTMLElement} */ (event.target);
  if (!hello || event.ctrlKey || event.altKey || event.metaKey || byRole("keys").open) return;
  if (target.closest("input, select, textarea") || (event.key === " " && target.closest("button, summary"))) return;
  const key = event.key.toLowerCase();
  if (!(key in shortcuts) && !(key in KEYS)) return;
  event.preventDefault();
  if (event.repeat && (numQueued || isPlaying)) return; // a held key commands the next action after the previous one is shown
  if (key in shortcuts) shortcuts[key]();
  else move(KEYS[key]);
});

// After dragging a slider with the pointer, the keys command motions again; a slider focused by Tab keeps the keys.
addEventListener("pointerup", ({ target }) => target instanceof HTMLInputElement && target.type === "range" && target.blur());
addEventListener("hashchange", restore);

/** @param {string} role @param {() => void} handler */
const on = (role, handler) => byRole(role).addEventListener("click", handler);
on("retry", () => wire.connect());
on("help", () => byRole("keys").showModal());
on("close-keys", () => byRole("keys").close());
on("undo", () => backTo(position.actions.length - 1));
on("reset", () => backTo(0));
on("play", () => (isPlaying ? stop() : play(() => prediction?.next_recorded)));
on("execute", () => act(getCustomAction()));
on("set-zero", setUpSliders);
on("energy", showEnergy);
on("plan", plan);
on("compare", () => setViewMode(false));
on("switch", showNextModel);
on("show-errors", () => {
  const isOff = document.body.classList.toggle("no-errors");
  byRole("show-errors").setAttribute("aria-pressed", String(!isOff));
});
on("copy-link", async () => {
  const link = new URL(formatFragment(), location.href).href;
  await navigator.clipboard?.writeText(link).then(() => showMessage("The link was copied."), () => showMessage(link)) ?? showMessage(link);
});
byRole("episode").addEventListener("change", () => goTo({ episode: Number(byRole("episode").value), start: 0, actions: [], goal: null }));
showProgress("loading the model …");
