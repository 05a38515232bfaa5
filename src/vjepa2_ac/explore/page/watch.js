// @ts-check
/** What does a served robot's planner see, want and do? Read-only, but for STOP. */

import { Wire, amount, make, part, shape, swap } from "./shared.js";

/** @typedef {{energy: {now: number | null, plan: number | null}, goal: any, episode: number}} Past */

const MOST = 200; // decisions that are drawn
const WIDTH = 400;
const HEIGHT = 80;

let hello = /** @type {any} */ (null);
let past = /** @type {Past[]} */ ([]);
let status = /** @type {any} */ ({});
let seconds = /** @type {number | null} */ (null);

const wire = new Wire("socket", {
  told({ header, pictures }) {
    if (header.kind === "hello") setUp(header);
    if (header.kind === "decision") draw(header, pictures);
    if (header.kind === "status") drawStatus(header);
  },
  progress: () => {},
  lost(why) {
    part("lost-text").textContent = `The server does not answer${why ? `: ${why}` : ""}. STOP reaches nobody. Trying again …`;
    part("lost").hidden = false;
    part("stop").disabled = true;
  },
});

/** @param {any} header */
function setUp(header) {
  hello = header;
  past = [];
  part("lost").hidden = true;
  part("stop").disabled = false;
  part("subject").textContent = `${header.subject}${header.dry_run ? ", dry run: the robot gets zeros" : ""}`;
  part("release").textContent = header.release;
}

/** @param {any} header @param {import("./shared.js").Pictures} pictures */
function draw(header, pictures) {
  const { goal, energy, why } = header;
  for (const name of ["camera", "imagined"]) swap(part(name), pictures.get(name));
  part("no-image").textContent = hello.decodes ? "There is no plan." : "serve --decoder shows it";
  part("no-image").hidden = pictures.has("imagined");
  if (goal) swap(part("goal"), pictures.get("goal"));
  if (goal) part("goal-name").textContent = `goal ${goal.index + 1} of ${goal.count}${isNaN(goal.name) ? `: ${goal.name}` : ""}`;
  const words = header.action
    .map((/** @type {number} */ one, /** @type {number} */ axis) => ({ one, unit: hello.action[axis] }))
    .filter((/** @type {any} */ each) => each.one !== 0)
    .map((/** @type {any} */ each) => `${each.unit.name} ${amount(each.one, each.unit, true)}`);
  part("sentence").textContent = `Decision ${header.number + 1}, ${why}: ${words.join(", ") || "no motion"}.`;
  table("action", hello.action.map((/** @type {any} */ unit, /** @type {number} */ axis) => [unit.name, amount(header.action[axis], unit, true)]));
  part("notes").textContent = header.notes.join(" ");
  seconds = header.seconds;
  past = [...past, { energy, goal, episode: header.episode }].slice(-MOST);
  drawEnergies();
  drawStatus(status);
}

/** @param {any} header */
function drawStatus(header) {
  status = header;
  part("stopped").hidden = !header.stopped;
  document.body.classList.toggle("is-stopped", Boolean(header.stopped));
  table("server", [
    ["robot", header.robot ?? "none"],
    ["latency", seconds === null ? "–" : `${seconds.toFixed(2)} s`],
    ["refused messages", String(header.refused ?? 0)],
    ["failures", String(header.failed ?? 0)],
    ["episodes", String(header.episodes ?? 0)],
  ]);
}

/** @param {string} role @param {string[][]} rows */
function table(role, rows) {
  part(role).replaceChildren(make("tbody", {}, ...rows.map(([name, value]) => make("tr", {}, make("th", { scope: "row" }, name), make("td", {}, value)))));
}

function drawEnergies() {
  const all = past.flatMap(({ energy }) => [energy.now, energy.plan]).filter((one) => one !== null);
  const top = Math.max(1e-9, .../** @type {number[]} */ (all));
  const x = (/** @type {number} */ at) => (WIDTH * (at + 0.5)) / Math.max(20, past.length);
  const y = (/** @type {number} */ energy) => HEIGHT - 4 - ((HEIGHT - 8) * energy) / top;
  const points = past.flatMap(({ energy }, at) => (energy.now === null ? [] : [`${x(at)},${y(energy.now)}`]));
  const shapes = [shape("polyline", { class: "way", points: points.join(" ") })];
  past.forEach(({ energy, goal, episode }, at) => {
    const before = past[at - 1];
    if (before && (before.episode !== episode || (goal && before.goal && before.goal.index !== goal.index))) shapes.push(shape("path", { class: "height", d: `M${x(at - 0.5)} 0V${HEIGHT}` }));
    if (energy.plan !== null) shapes.push(shape("circle", { class: "now", cx: x(at), cy: y(energy.plan), r: 2 }));
  });
  part("energies").replaceChildren(...shapes);
  const now = past[past.length - 1]?.energy.now;
  part("energies").setAttribute("aria-label", `Energy over ${past.length} decisions, now ${now === null ? "not measured" : now?.toFixed(3)}`);
}

async function stop() {
  await wire.ask("stop", {}); // the next status says that it holds
}

part("stop").addEventListener("click", stop);
part("retry").addEventListener("click", () => wire.connect());
addEventListener("keydown", (event) => event.key === "Escape" && stop());
