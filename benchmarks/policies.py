"""Do a prior, a judge and a watchman earn their keep? On the simulated arm; docs/policies.md has the answers.

    vjepa2-ac simulate record demo/push-data --task push --episodes 300 --seed 31 && vjepa2-ac train configs/push.yaml
    vjepa2-ac prior demo/push-run
    python benchmarks/policies.py prior demo/push-run --task push      # search, prior alone, search from the prior
    python benchmarks/policies.py judge demo/push-run --task push      # best of 8 noisy proposals, beside their mean
    python benchmarks/policies.py order demo/push-run                  # three policies of known quality, by energy
    python benchmarks/policies.py monitor demo/push-run --task push    # disturbances, and promised false alarms
    python benchmarks/policies.py replan demo/push-run --task push     # searches saved where nothing surprises

A row that is done stands in --out as JSON and is not run again. Settings were looked at on seed 3.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.evaluation.policies.monitor import calibrate_monitor
from vjepa2_ac.evaluation.policies.score import PolicyChunks, score_policies
from vjepa2_ac.intervals import share_of
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.prior.action_prior import load_prior
from vjepa2_ac.planning.prior.train_prior import PriorOptions, train_prior
from vjepa2_ac.planning.session import PlanningSession, load_to_plan
from vjepa2_ac.planning.surprise import MONITOR, conformal_threshold, error_by_patch
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.benchmark import DemonstratedGoals, DemonstrationSpec, every_step
from vjepa2_ac.simulation.domains import Domain, named_domain
from vjepa2_ac.simulation.policies import GoalsOf, Planning
from vjepa2_ac.simulation.rollout import RolloutSpec, put, run_task, send_action
from vjepa2_ac.simulation.tasks import STEPS, arm_for, make_problem
from vjepa2_ac.storage import write_atomically

PROPOSALS = 8
NOISE = 1.0  # of a proposal, in standard deviations of the actions in the data
STRIDE, MORE = 4, 6  # control steps of a model step; model steps beyond the default of `pick`


def main(words: list[str] | None = None) -> None:
    """Run what is not there yet, and print every row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("run", help="with RUN/prior beside it, but of `monitor`")
    parser.add_argument("overrides", nargs="*", help="such as planning.samples=64")
    parser.add_argument("--task", default="reach", choices=["reach", "push", "pick"])
    parser.add_argument("--domain", default="A")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--false-alarms", type=float, default=0.05, help="of `monitor`")
    parser.add_argument("--steps", type=int, nargs=3, default=[30, 200, 2000], help="of the priors of `order`")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/policies.json"))
    options = parser.parse_intermixed_args(words)
    torch.set_num_threads(1)
    session = load_to_plan(options.run, overrides=options.overrides)
    done: dict[str, Any] = json.loads(options.out.read_text()) if options.out.exists() else {}
    for name, measure in PARTS[options.part](session, options):
        key = f"{options.part} {Path(options.run).name} {options.task} {options.domain} seed {options.seed}: {name}"
        if key not in done:
            done[key] = measure()
            write_atomically(options.out, json.dumps(done, indent=1) + "\n")
        print(key, json.dumps(done[key]), flush=True)


Rows = Iterator[tuple[str, Callable[[], dict[str, Any]]]]


def _prior_rows(session: PlanningSession, options: argparse.Namespace) -> Rows:
    planning, prior = session.config.planning, str(Path(options.run) / "prior")
    few = {"iterations": 1, "samples": max(10, planning.samples * planning.iterations // 20)}
    ways: dict[str, dict[str, Any]] = {
        "search": {},
        "search, a quarter": {"samples": planning.samples // 4},
        "search, a twentieth": few,
        "prior alone": {"prior": prior, "planner": "prior"},
        "from the prior": {"prior": prior},
        "from the prior, a quarter": {"prior": prior, "samples": planning.samples // 4},
        "from the prior, a twentieth": {"prior": prior, **few},
    }
    for name, changes in ways.items():
        yield name, partial(_planned, session, options, changes)


def _planned(session: PlanningSession, options: argparse.Namespace, changes: dict[str, Any]) -> dict[str, Any]:
    controller = controller_of(session, changes)
    return _solved(Planning(controller, goals_of=goals_of(controller, options)), options)


def controller_of(session: PlanningSession, changes: dict[str, Any], model: WorldModel | None = None) -> Controller:
    """Return a controller with other settings of planning than the session's, perhaps of another model."""
    planning = session.config.planning.model_copy(update=changes)
    return Controller.of_config(model or session.world_model, session.config.model_copy(update={"planning": planning}))


def goals_of(controller: Controller, options: argparse.Namespace) -> GoalsOf | None:
    """Return what makes the goals of a problem: of `pick` one for each model step; None: its goal image alone."""
    if options.task != "pick":
        return None
    spec = every_step(DemonstrationSpec(controller.config.limits, None, STRIDE, 3, None))
    return DemonstratedGoals(options.task, named_domain(options.domain), spec)


def _solved(policy: Planning, options: argparse.Namespace) -> dict[str, Any]:
    """Return how many problems are solved, and milliseconds of a decision."""
    domain, steps = named_domain(options.domain), STEPS[options.task] + MORE * (options.task == "pick")
    problems = RolloutSpec(options.task, domain, options.episodes, options.seed, steps, STRIDE)
    found = run_task(problems, policy, arm_for(options.task, domain))
    return {
        "solved": found.success_rate.as_dict(),
        "left_cm": found.final_distance_cm.as_dict(),
        "ms": round(1e3 * float(found.seconds.mean()), 1),
        "searches": found.why_counts.get("planned", 0) / found.seconds.size,
        "by_episode": found.successes.tolist(),
    }


class Proposing(Planning):
    """Acts on one of a policy's noisy proposals: the first, their mean, or the one that a model likes best.

    Args:
        policy: A prior that acts alone: behaviour cloning towards a goal.
        judge: Scores; None: the first proposal is taken, or the mean.
        how: Which proposal.
        scale: Standard deviations of the noise.
        goals: As of `Planning`.
    """

    def __init__(
        self, policy: Controller, judge: Controller | None, how: str, scale: np.ndarray, goals: GoalsOf | None
    ) -> None:
        super().__init__(policy, how, goals_of=goals)
        self._judge = None if judge is None else Planning(judge, how, goals_of=goals)
        self._scale, self._rng = scale, np.random.default_rng(0)

    def reset(self, problem: Any, goal_image: np.ndarray) -> None:
        """Begin an episode."""
        super().reset(problem, goal_image)
        self._rng = np.random.default_rng(problem.index)  # the same noise, whoever judges
        if self._judge is not None:
            self._judge.reset(problem, goal_image)

    def act(self, image: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Return the action of the chosen proposal."""
        mean = super().act(image, state)
        drawn = mean + self._scale * self._rng.normal(size=(PROPOSALS, len(mean)))
        chunks = self.controller.space.allowed(torch.from_numpy(drawn)[:, None].float()).double().numpy()
        if self._judge is None:
            return np.asarray(chunks[0, 0] if self.name == "one" else chunks[:, 0].mean(axis=0))
        best = self._judge.controller.score(image, state, chunks).best
        self._judge.act(image, state)  # its goals take their turns, too
        return np.asarray(chunks[best, 0])


def _judge_rows(session: PlanningSession, options: argparse.Namespace) -> Rows:
    prior = str(Path(options.run) / "prior")
    acts = {"prior": prior, "planner": "prior"}
    scale = NOISE * load_prior(prior, where="prior").network.scale.numpy()
    models = {"one": None, "mean": None, "best of 8": session.world_model, "best of 8, untrained": None}

    def measure(how: str) -> dict[str, Any]:
        model = untrained(session.world_model) if how.endswith("untrained") else models[how]
        policy = controller_of(session, acts)
        judge = None if model is None else controller_of(session, acts, model)
        return _solved(Proposing(policy, judge, how, scale, goals_of(policy, options)), options)

    for how in models:
        yield how, partial(measure, how)


def untrained(model: WorldModel) -> WorldModel:
    """Return a model with the same encoder and a predictor of fresh weights."""
    fresh = WorldModel.random(model.sizes, seed=5)
    fresh.encoder.load_state_dict(model.encoder.state_dict())
    return fresh.to(model.device).eval()


def _order_rows(session: PlanningSession, options: argparse.Namespace) -> Rows:
    """Priors of few and many steps, in closed loop and by the energy of their chunks on held-out episodes."""
    qualities = dict(zip(("hasty", "short", "whole"), options.steps, strict=True))

    def measure() -> dict[str, Any]:
        dataset = open_dataset(session.config.data)
        held_out = np.flatnonzero(dataset.members("test") | dataset.members("validation")).tolist()
        loop, policies = {}, []
        for name, steps in qualities.items():
            folder = Path(tempfile.mkdtemp())
            train_prior(session.config, folder, PriorOptions(steps=steps))
            loop[name] = _planned(session, options, {"prior": str(folder), "planner": "prior"})["left_cm"]
            policies.append(_chunks_of(name, folder, session, dataset, held_out))
        judge = Controller.of_config(session.world_model, session.config)
        found = score_policies(judge, dataset, policies, form="deltas", control_steps=1)
        by_energy = [one.name for one in found.policies]
        return {
            "by_energy": by_energy, "in_order": by_energy == [*qualities][::-1], "left_cm": loop,
            "scores": found.as_dict(),
        }  # fmt: skip

    yield "three policies", measure


def _chunks_of(name: str, folder: Path, session: PlanningSession, dataset: Any, episodes: list[int]) -> PolicyChunks:
    """Return the action of one model step that a prior proposes at frames of episodes, towards the next frame."""
    prior, model = load_prior(folder, where="prior").network, session.world_model
    stride, places, chunks = dataset.config.model_stride, [], []
    for index in episodes:
        episode = dataset.source.read(index)
        steps = list(range(0, len(episode.states) - stride, stride))
        latents = encode_frames(model, episode.read_frames([*steps, steps[-1] + stride]), dataset.config.crop)
        states = torch.from_numpy(episode.states[steps]).float()
        with torch.no_grad():
            mean, _ = prior(latents[:-1], latents[1:], torch.ones(len(steps), dtype=torch.long), states)
        places += [(dataset.table.identity(index), step) for step in steps]
        chunks.append((mean * prior.scale).double().numpy()[:, None, None])
    return PolicyChunks(name, tuple(places), np.concatenate(chunks))


def _replan_rows(session: PlanningSession, options: argparse.Namespace) -> Rows:
    """Plans of several steps, made anew at each or carried on until something surprises."""
    threshold = Path(tempfile.mkdtemp()) / MONITOR
    found = calibrate_monitor(session.world_model, open_dataset(session.config.data), options.false_alarms)
    threshold.write_text(json.dumps(asdict(found)))
    ahead = {"horizon": session.config.data.frames - 1}
    carried = {**ahead, "monitor": str(threshold), "replan": "on_surprise"}
    ways: dict[str, dict[str, Any]] = {"one step, at each": {}, "at each step": ahead, "on surprise": carried}
    for name, changes in ways.items():
        yield name, partial(_planned, session, options, changes)


DISTURBED_FROM, STEPS_WATCHED = (4, 8), 12
DISTURBANCES = ("pushed arm", "blocked gripper", "moved camera", "light out", "dropped block")
CONTROLS = ("action-conditioned", "observation only", "shuffled actions")


def _monitor_rows(session: PlanningSession, options: argparse.Namespace) -> Rows:
    """Random moves with and without a disturbance: AUC and recall at the promised rate of false alarms."""
    domain, count = named_domain(options.domain), options.episodes
    calm = [_watched(session, domain, options, number, "") for number in range(2 * count)]
    usual = {name: np.stack([one[name].mean(axis=0) for one in calm[:count]]) for name in CONTROLS}

    def highest(name: str, one: dict[str, np.ndarray], left_out: int | None = None) -> float:
        others = usual[name] if left_out is None or count == 1 else np.delete(usual[name], left_out, axis=0)
        return float(np.maximum(one[name] - others.mean(axis=0), 0.0).mean(axis=1).max())

    fresh = {name: [highest(name, one) for one in calm[count:]] for name in CONTROLS}
    thresholds = {}
    for name in CONTROLS:
        known = torch.tensor([highest(name, one, place) for place, one in enumerate(calm[:count])])
        thresholds[name] = conformal_threshold(known, options.false_alarms)

    def above(name: str, scores: list[float]) -> dict[str, float | None]:
        return share_of(sum(one > thresholds[name] for one in scores), len(scores)).as_dict()

    def measure(what: str) -> dict[str, Any]:
        bad = [_watched(session, domain, options, 10_000 + number, what) for number in range(count)]
        found = {}
        for name in CONTROLS:
            disturbed = [highest(name, one) for one in bad]
            found[name] = {"auc": _auc(fresh[name], disturbed), "recall": above(name, disturbed)}
        return found

    yield "undisturbed", lambda: {name: above(name, fresh[name]) for name in CONTROLS}
    for what in DISTURBANCES if options.task != "reach" else DISTURBANCES[:-1]:
        yield what, partial(measure, what)


def _auc(calm: list[float], bad: list[float]) -> float:
    """Return how often a disturbed episode has the higher score, ties by half."""
    one, other = np.array(calm)[:, None], np.array(bad)[None]
    return float((one < other).mean() + 0.5 * (one == other).mean())


def _watched(
    session: PlanningSession, domain: Domain, options: argparse.Namespace, number: int, what: str
) -> dict[str, np.ndarray]:
    """Return the errors of an episode of random moves by patch, by what the watchman knows."""
    rng = np.random.default_rng([options.seed, number])
    problem = make_problem(options.task, domain, options.seed, number)
    arm = put(arm_for(options.task, domain), problem.start, problem.block_start, problem.mark)
    seen = arm
    if what == "moved camera":
        turned = replace(domain.camera, azimuth_deg=domain.camera.azimuth_deg + 8.0)
        seen = arm_for(options.task, replace(domain, camera=turned))
    at = int(rng.integers(*DISTURBED_FROM))
    frames, states, actions = [arm.image()], [arm.state], []
    way = np.zeros(7)
    for step in range(STEPS_WATCHED):
        if step == 0 or rng.uniform() < 0.5:
            way[:3], way[6] = rng.uniform(-1, 1, 3) * 0.05, rng.choice([-0.5, 0.0, 0.5])
        actions.append(way.copy())
        done = way.copy()
        if what == "blocked gripper" and step >= at:
            done[6] = 0.0
        send_action(arm, done, STRIDE)
        if step == at:
            _disturb(arm, what, rng)
        frames.append(_image(arm, seen, what, is_on=step >= at))
        states.append(arm.state)
    latents = encode_frames(session.world_model, np.stack(frames), session.config.data.crop)
    given = torch.from_numpy(np.stack(actions)).float()
    before = torch.from_numpy(np.stack(states[:-1])).float()
    with torch.no_grad():
        predicted, shuffled = (
            session.world_model.predict(latents[:-1, None], one[:, None], before[:, None])[:, 0]
            for one in (given, given[torch.from_numpy(rng.permutation(len(given)))])
        )
    known = {CONTROLS[0]: predicted, CONTROLS[1]: latents[:-1], CONTROLS[2]: shuffled}
    return {name: error_by_patch(one, latents[1:]).double().numpy() for name, one in known.items()}


def _disturb(arm: SimulatedArm, what: str, rng: np.random.Generator) -> None:
    if what == "pushed arm":
        for _ in range(20):
            way = rng.normal(size=3)
            state = arm.state.copy()
            state[:3] += 0.1 * way / np.linalg.norm(way)
            if arm.can_reach(state):
                arm.set_state(state)
                return
    if what == "dropped block" and arm.block is not None:
        block = arm.block.copy()
        block[:2] += 0.12 * rng.choice([-1.0, 1.0], 2)
        arm.place(block, None)


def _image(arm: SimulatedArm, seen: SimulatedArm, what: str, *, is_on: bool) -> np.ndarray:
    if what == "moved camera" and is_on:
        seen.set_joints(arm.joints, arm.closedness)
        seen.place(arm.block, None)
        return seen.image()
    image = arm.image()
    return (0.4 * image).astype(np.uint8) if what == "light out" and is_on else image


PARTS: dict[str, Callable[[PlanningSession, argparse.Namespace], Rows]] = {
    "prior": _prior_rows,
    "judge": _judge_rows,
    "order": _order_rows,
    "monitor": _monitor_rows,
    "replan": _replan_rows,
}

if __name__ == "__main__":
    main()
