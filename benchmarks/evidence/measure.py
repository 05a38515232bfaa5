"""How good does one cell become? Train it as anybody would, then measure it on held-out episodes and in closed loop."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import other_worlds
import torch
from cells import BEFORE, PLANNING, SHIFTS, Cell, energies_of, method_of
from offline import offline_figures, visited_correlation
from prepare import base_model, data_before, data_shifted, encoded, training_episodes

from vjepa2_ac.config import Config, ModelConfig, PlanningConfig, ValidationConfig
from vjepa2_ac.config.component import Component
from vjepa2_ac.config.data import DataConfig, Split
from vjepa2_ac.config.training import CheckpointConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.measure import prediction_errors
from vjepa2_ac.evaluation.result import PredictionErrors, Way
from vjepa2_ac.inspection.axes import calibrate_axes
from vjepa2_ac.model.adapter.lora import base_only, merge_adapter
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.axes import Axes
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.policies.train_prior import train_prior
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.checkpoint import NEWEST
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.simulation.agent import Planning
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, run_task
from vjepa2_ac.simulation.domains import Domain, sample_domain
from vjepa2_ac.simulation.policies import Oracle, RandomActions, ZeroActions
from vjepa2_ac.simulation.rollout import Image, Observation, Policy, Trial
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.storage.structured import json_text
from vjepa2_ac.training.cost import count_parameters
from vjepa2_ac.training.loop import train

TEST_GOALS, VALIDATION_GOALS = 9_000, 4_000  # seeds of problems, to which a cell adds its own (`goals_seed`)
PAIRS = 200  # of frames, that axes are fitted to
GOALS, CLIPS = 20, 128  # of one run; a row of the table pools its seeds, each with other goals


def measure(cell: Cell, folder: Path, *, goals: int = GOALS, choosing: bool = False) -> dict[str, Any]:
    """Return the figures of a cell.

    Args:
        cell: What to train.
        folder: Where `prepare` put things.
        goals: Problems of the closed loop.
        choosing: Measure on validation episodes and goals, to choose settings by.
    """
    config = config_of(cell, folder)
    if method_of(cell.method).kind == "cloned":
        return _cloned(cell, config, folder, goals, choosing=choosing)
    started = time.process_time(), time.perf_counter()
    file, axes = None, None
    if method_of(cell.method).kind in {"zero-shot", "calibrated"}:
        model = load_base(config.model, seed=cell.seed)
        trained: dict[str, Any] = {"trained_share": 0.0, "trained_parameters": 0, "adapter_mb": 0.0}
        if method_of(cell.method).kind == "calibrated":
            file, axes, trained["axes"] = _calibrated(config, model, folder / "axes" / f"{cell.name}.json")
    else:
        run = train(config, SILENT)
        model, trained = _trained(run)
    acts = PLANNING
    if method_of(cell.method).prior:
        acts = acts.model_copy(update={"prior": _prior(cell, config, folder)[0]})
    seconds = time.process_time() - started[0], time.perf_counter() - started[1]
    split: Split = "validation" if choosing else "test"
    figures = {
        "cell": asdict(cell) | {"name": cell.name},
        "cpu_minutes": seconds[0] / 60,
        "minutes": seconds[1] / 60,
        **trained,
        "shifted": _as_dict(held_out(model, config, split, axes=axes)),
    }
    if cell.shift in SHIFTS and method_of(cell.method).kind != "calibrated":  # no other model than zero-shot
        figures["offline"] = _offline(model, config, split)
    if cell.base != "none":
        figures["forgetting"] = _forgetting(model, data_before(folder, cell.shift), config)
    if model.adaptation is not None:
        merge_adapter(model)
    seed = goals_seed(cell, choosing=choosing)
    settings: dict[str, Any] = {"axes": file} if cell.shift in SHIFTS else {}
    figures["reach"] = {
        distance: closed_loop(cell, planner(model, distance, acts, **settings), folder, seed=seed, goals=goals)
        for distance in energies_of(cell)
    }
    return figures


def _cloned(cell: Cell, config: Config, folder: Path, goals: int, *, choosing: bool) -> dict[str, Any]:
    """Return the figures of a policy that imitates: it predicts nothing, and does not search."""
    began = time.process_time()
    place, found = _prior(cell, config, folder)
    minutes, seed = (time.process_time() - began) / 60, goals_seed(cell, choosing=choosing)
    acts = PLANNING.model_copy(update={"planner": Component("prior"), "prior": place})
    model = load_base(config.model, seed=cell.seed)
    policy = planner(model, "l1", acts)
    reached = closed_loop(cell, policy, folder, seed=seed, goals=goals)
    trained = {"trained_share": 1.0, "adapter_mb": 0.0, "cpu_minutes": minutes, "minutes": minutes, "held_out": found}
    return {"cell": asdict(cell) | {"name": cell.name}, **trained, "reach": {"l1": reached}}


def _prior(cell: Cell, config: Config, folder: Path) -> tuple[str, Mapping[str, Any]]:
    """Train an action prior on a cell's demonstrations; return its folder, and how it does on held-out clips."""
    place = folder / "priors" / cell.name
    return str(place), train_prior(config, place).held_out


def measure_alone(cell: Cell, folder: Path, goals: int, choosing: bool) -> dict[str, Any]:
    """Measure a cell in a process of its own, on one thread; beside a zero-shot base, those who need no model, too."""
    torch.set_num_threads(1)
    figures = measure(cell, folder, goals=goals, choosing=choosing) | {"made_with": made_with()}
    if cell.method == "zero-shot":
        figures["baselines"] = baselines(cell, folder, goals=goals)
    return figures


def made_with() -> dict[str, str]:
    """Return which PyTorch and which commit of this project, if it is a checkout, compute."""
    git = shutil.which("git")
    command = [git or "git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=7"]
    found = subprocess.run(command, capture_output=True, text=True, check=False) if git else None  # noqa: S603
    commit = found.stdout.strip() if found and found.returncode == 0 else "unknown"
    return {"torch": torch.__version__, "commit": commit}


def config_of(cell: Cell, folder: Path) -> Config:
    """Return the run of a cell: the config that anybody would write."""
    method = method_of(cell.method, cell.shift)
    data = (data_before if cell.method == BEFORE else data_shifted)(folder, cell.shift)
    left_out = training_episodes(data, cell.episodes, cell.seed) if cell.episodes else ()
    return Config(
        run_dir=str(folder / "runs" / cell.name),
        seed=cell.seed,
        data=data.model_copy(update={"exclude": left_out}),
        model=ModelConfig(base=base_model(folder, cell.base, cell.seed, cell.shift, method.layer), dtype="float32"),
        adapter=method.adapter,
        training=method.training,
        validation=ValidationConfig(every=method.training.steps, clips=40, batch_size=20),
        checkpoint=CheckpointConfig(every=method.training.steps),
    )


def goals_seed(cell: Cell, *, choosing: bool = False) -> int:
    """Return the seed of a cell's problems.

    Our own arm draws other ones from each; in worlds of others it is the first of twice as many as there are problems.
    """
    apart = 1 if cell.shift in SHIFTS else 100
    return (VALIDATION_GOALS if choosing else TEST_GOALS) + apart * cell.seed


def baselines(cell: Cell, folder: Path, *, goals: int = GOALS) -> dict[str, Any]:
    """Return how far those get who need no model, on the same goals."""
    limits, seed = PLANNING.limits, goals_seed(cell)
    policies: list[Policy] = [ZeroActions(), RandomActions(limits, cell.seed)]
    policies += [Oracle(limits)] if cell.shift in SHIFTS else []
    found = {policy.name: closed_loop(cell, policy, folder, seed=seed, goals=goals) for policy in policies}
    if cell.shift not in SHIFTS:
        _, shown = other_worlds.problems(folder, cell.shift, seed, goals)
        found["oracle"] = other_worlds.figures_of(shown, seed, shown)
    return found


def planner(
    model: WorldModel,
    distance: str,
    config: PlanningConfig,
    axes: str | None = None,
) -> Policy:
    """Return a policy that plans with a model, in calibrated axes where a file of them is given."""
    energy = config.energy.model_copy(update={"distance": Component(distance)})
    controller = Controller(model, config.model_copy(update={"energy": energy, "axes": axes}))
    return Watched(controller)


class Watched(Planning):
    """A planner that is asked after each decision how its energies agree with true distances (`reach` only)."""

    def reset(self, trial: Trial, goal_image: Image) -> None:
        """Begin an episode."""
        super().reset(trial, goal_image)
        self._goal_m = None if trial.problem is None else trial.problem.goal[:3]
        self.agreements: list[float] = getattr(self, "agreements", [])

    def act(self, observation: Observation) -> np.ndarray:
        """Return the first action of a plan."""
        action = super().act(observation)
        if self._goal_m is None:
            return action
        found = visited_correlation(self.controller, self._goal_m, len(self.agreements))
        self.agreements += [] if found is None else [found]
        return action


def closed_loop(cell: Cell, policy: Policy, folder: Path, *, seed: int, goals: int) -> dict[str, Any]:
    """Return distances to the goal (cm) before the first step and after each, and seconds of a decision."""
    if cell.shift not in SHIFTS:
        when = "before" if cell.method == BEFORE else "after"
        return other_worlds.closed_loop(folder, cell.shift, policy, seed=seed, goals=goals, when=when)
    results = [run_task(spec, policy) for spec in _rollouts(cell.shift, seed, goals)]
    agreements = policy.agreements if isinstance(policy, Watched) else []
    return {
        **({"visited": float(np.mean(agreements))} if agreements else {}),
        "goals_seed": seed,
        "distance_cm": np.round(np.concatenate([one.distance_cm for one in results]), 3).tolist(),
        "seconds_per_decision": float(np.mean([one.seconds.mean() for one in results])),
        "unreachable": int(sum(one.unreachable.sum() for one in results)),
        "whys": dict(sum((Counter(one.why_counts) for one in results), Counter())),
    }


def _rollouts(shift: str, seed: int, goals: int) -> Iterator[BenchmarkOptions]:
    """Yield what is to be reached: in one world, or each goal in another that no episode was recorded in."""
    world = SHIFTS[shift]
    if isinstance(world, Domain):
        yield BenchmarkOptions("reach", world, goals, seed)
        return
    for goal in range(goals):
        drawn = sample_domain(np.random.default_rng([seed, goal]), world)
        yield BenchmarkOptions("reach", drawn, 1, seed * 100 + goal)


def held_out(
    model: WorldModel, config: Config, split: Split = "test", clips: int = CLIPS, axes: Axes | None = None
) -> PredictionErrors:
    """Return errors on clips of held-out episodes, from the latents that training used; in the model's own axes."""
    model.eval()
    batches = encoded(config, model, split, clips)
    return prediction_errors(model, batches if axes is None else (_turned(batch, axes) for batch in batches))


def _offline(model: WorldModel, config: Config, split: Split) -> dict[str, float]:
    """Return what might tell how a model fares in closed loop."""
    train, test = encoded(config, model, "train", CLIPS), encoded(config, model, split, CLIPS)
    return offline_figures(model, open_dataset(config.data).spaces.action, train, test)


def _turned(batch: LatentBatch, axes: Axes) -> LatentBatch:
    return replace(batch, states=axes.poses(batch.states), actions=axes.actions(batch.actions))


def _calibrated(config: Config, model: WorldModel, path: Path) -> tuple[str | None, Axes | None, dict[str, Any]]:
    """Fit a base's axes to the demonstrations; return file and axes if they can be planned by, and what was found."""
    fit, found = calibrate_axes(config, str(config.model.base), pairs=PAIRS, split="train")
    path.parent.mkdir(exist_ok=True)
    write_atomically(path, json_text(found))
    if fit.problem is not None:
        return None, None, found
    return str(path), Axes.read(str(path), model.fingerprints()), found


def _forgetting(model: WorldModel, before: DataConfig, config: Config) -> dict[str, Any]:
    """Return errors before the shift with the adapter on and off, and whether off is the base's to the last bit."""
    config = config.model_copy(update={"data": before})
    on = held_out(model, config)
    if model.adaptation is None:
        return {"on": _as_dict(on)}
    with base_only(model):
        off = held_out(model, config)
    base = held_out(load_base(config.model, seed=0), config)
    same = all(np.array_equal(off.arrays[kind], base.arrays[kind]) for kind in base.arrays)
    return {"on": _as_dict(on), "off": _as_dict(off), "off_is_base_bit_for_bit": same}


def _trained(run: Path) -> tuple[WorldModel, dict[str, Any]]:
    loaded = load_subject(run, NEWEST)  # as it was made: the last
    counts = count_parameters(loaded.config, loaded.world_model.sizes)
    count = counts.trained if loaded.config.adapter.kind == "lora" else counts.predictor
    files = list((loaded.checkpoint / "adapter").rglob("*.safetensors"))
    return loaded.world_model, {
        "trained_share": count / counts.predictor,
        "trained_parameters": count,
        "adapter_mb": sum(path.stat().st_size for path in files) / 1e6,
    }


def _as_dict(errors: PredictionErrors) -> dict[str, Any]:
    """Return ratios to persistence, and the sums by episode that intervals are made of."""
    one_step = {way: errors.of("teacher_forced", way=way).mean(axis=1).sum() for way in get_args(Way)}
    rolled, nothing = (errors.of("rollout", way=way).sum(axis=0) for way in ("true", "persistence"))
    return {
        "rollout_over_persistence": (rolled / nothing).tolist(),
        "one_step": float(one_step["true"] / one_step["persistence"]),
        "one_step_zero_actions": float(one_step["zero"] / one_step["persistence"]),
        "one_step_shuffled_actions": float(one_step["shuffled"] / one_step["persistence"]),
        "clips": len(errors.episode_ids),
        "episodes": len(set(errors.episode_ids)),
    }
