"""The methods study: train a cell, and measure it on held-out episodes and in closed loop."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import environments
import methods
import numpy as np
from environments import GOALS, SAME, TASKS
from methods import BEFORE, MORE_SEEDS, PLANNING, SHIFTS, Cell, get_method
from offline import measure_offline
from prepare import base_model, data_before, data_shifted, encode_clips, exclude_episodes, prepare_shifts
from results import compact  # noqa: F401 - a part of the study, see __main__
from work import Work

from vjepa2_ac.config import Config, ModelConfig, ValidationConfig
from vjepa2_ac.config.section import Component
from vjepa2_ac.config.training import CheckpointConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.evaluation.measure import prediction_errors
from vjepa2_ac.evaluation.result import ActionMode, PredictionErrors
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.policies.action_prior import train_prior
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.checkpoint import NEWEST
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, Planning, run_task
from vjepa2_ac.simulation.domains import Domain, sample_domain
from vjepa2_ac.simulation.policies import Oracle, RandomActions, ZeroActions
from vjepa2_ac.simulation.rollout import Policy
from vjepa2_ac.training.cost import count_parameters
from vjepa2_ac.training.loop import train

TEST_GOALS = 9_000  # first seed of problems, to which a cell adds its own (`get_goals_seed`)
CLIPS = 128  # of held-out episodes


def all_cells() -> list[Cell]:
    """Return all cells but those of third-party tasks whose environment is not installed."""
    absent = {name: task for name, task in TASKS.items() if not task.is_installed}
    for name, task in absent.items():
        fix = f"Run `make worlds/{task.program}` (docs/worlds.md)"
        print(f"{name} is skipped: its environment is not installed. {fix}")
    return [cell for cell in methods.all_cells() if cell.shift not in absent]


def prepare(cells: Sequence[Cell], work: Work) -> int:
    """Make the inputs of all cells; return 0 (no failure)."""
    prepare_shifts(work.folder, {cell.shift for cell in cells}, MORE_SEEDS)
    return 0


def measure(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:
    """Train a cell and return its metrics; `folder` is the work folder with the output of `prepare`."""
    config, method = make_config(cell, folder), get_method(cell.method)
    started = time.process_time()
    result: dict[str, Any] = {}
    if method.kind == "cloned":
        prior, result["held_out"] = _prior(cell, config, folder)
        result |= {"trained_share": 1.0, "adapter_mb": 0.0, "cpu_minutes": (time.process_time() - started) / 60}
        model = load_base(config.model, seed=cell.seed)
        planning = PLANNING.model_copy(update={"planner": Component("prior"), "prior": prior})
        return result | {"reach": closed_loops(cell, Planning(Controller(model, planning)), folder, goals=goals)}
    if method.kind == "zero-shot":
        model, trained = load_base(config.model, seed=cell.seed), {"trained_share": 0.0, "adapter_mb": 0.0}
    else:
        model, trained = _load_trained(train(config, SILENT))
    planning = PLANNING.model_copy(update={"prior": _prior(cell, config, folder)[0]}) if method.prior else PLANNING
    result |= {**trained, "cpu_minutes": (time.process_time() - started) / 60}
    batches = encode_clips(config, model.eval(), "test", CLIPS)
    result["shifted"] = _relative_errors(prediction_errors(model, batches))
    if cell.shift in SHIFTS:
        result["offline"] = measure_offline(model, open_dataset(config.data).spaces.action, batches)
    result["reach"] = closed_loops(cell, Planning(Controller(model, planning)), folder, goals=goals)
    if cell.method == "zero-shot":
        result["baselines"] = measure_baselines(cell, folder, goals)
    return result


def _prior(cell: Cell, config: Config, folder: Path) -> tuple[str, Mapping[str, Any]]:
    """Train an action prior on a cell's demonstrations; return its folder and its metrics on held-out clips."""
    path = folder / "priors" / cell.name
    return str(path), train_prior(config, path).held_out


def make_config(cell: Cell, folder: Path) -> Config:
    """Return the config of a cell."""
    method = get_method(cell.method, cell.shift)
    data = (data_before if cell.method == BEFORE else data_shifted)(folder, cell.shift)
    excluded = exclude_episodes(data, cell.episodes, cell.seed) if cell.episodes else ()
    return Config(
        run_dir=str(folder / "runs" / cell.name),
        seed=cell.seed,
        data=data.model_copy(update={"exclude": excluded}),
        model=ModelConfig(base=base_model(folder, cell.base, cell.seed, cell.shift), dtype="float32"),
        adapter=method.adapter,
        training=method.training,
        validation=ValidationConfig(every=method.training.steps, clips=40, batch_size=20),
        checkpoint=CheckpointConfig(every=method.training.steps),
    )


def get_goals_seed(cell: Cell) -> int:
    """Return the seed of a cell's problems; in third-party environments it is the first of several seeds."""
    return TEST_GOALS + (1 if cell.shift in SHIFTS else 100) * cell.seed


def measure_baselines(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:
    """Return the results of policies without a model on the same goals."""
    policies: list[Policy] = [ZeroActions(), RandomActions(PLANNING.limits, cell.seed)]
    policies += [Oracle(PLANNING.limits)] if cell.shift in SHIFTS else []
    loops = {policy.name: closed_loops(cell, policy, folder, goals=goals, conditions=[SAME]) for policy in policies}
    result = {name: by_condition[SAME] for name, by_condition in loops.items()}
    if cell.shift not in SHIFTS:
        _, expert = environments.problems(folder, cell.shift, get_goals_seed(cell), goals)
        result["oracle"] = environments.summarize(expert, expert)
    return result


def closed_loops(
    cell: Cell, policy: Policy, folder: Path, *, goals: int, conditions: Sequence[str] = GOALS
) -> dict[str, dict[str, Any]]:
    """Return the distances to the goal (cm) before the first and after each step, and the solved problems.

    The results are by kind of goals (`environments.GOALS`). On the simulated arm the goal is always one image, and the
    result has the key l1.
    """
    seed = get_goals_seed(cell)
    if cell.shift not in SHIFTS:
        when = "before" if cell.method == BEFORE else "after"
        return environments.closed_loops(
            folder, cell.shift, policy, seed=seed, goals=goals, when=when, conditions=conditions
        )
    results = [run_task(spec, policy) for spec in _list_goals(cell.shift, seed, goals)]
    return {SAME: {"distance_cm": np.round(np.concatenate([each.distance_cm for each in results]), 3).tolist()}}


def _list_goals(shift: str, seed: int, goals: int) -> Iterator[BenchmarkOptions]:
    """Yield the goals: all in one world, or each in a new world in which no episode was recorded."""
    world = SHIFTS[shift]
    if isinstance(world, Domain):
        yield BenchmarkOptions("reach", world, goals, seed)
        return
    for goal in range(goals):
        domain = sample_domain(np.random.default_rng([seed, goal]), world)
        yield BenchmarkOptions("reach", domain, 1, seed * 100 + goal)


def _load_trained(run: Path) -> tuple[WorldModel, dict[str, Any]]:
    loaded = load_subject(run, NEWEST)  # the last checkpoint
    assert loaded.checkpoint is not None, "a run"
    counts = count_parameters(loaded.config, loaded.world_model.sizes)
    count = counts.trained if loaded.config.adapter.kind == "lora" else counts.predictor
    files = list((loaded.checkpoint / "adapter").rglob("*.safetensors"))
    return loaded.world_model, {
        "trained_share": count / counts.predictor,
        "adapter_mb": sum(path.stat().st_size for path in files) / 1e6,
    }


def _relative_errors(errors: PredictionErrors) -> dict[str, Any]:
    """Return ratios to persistence."""
    one_step = {
        actions: errors.of("teacher_forced", actions=actions).mean(axis=1).sum() for actions in get_args(ActionMode)
    }
    rollout, persistence = (errors.of("rollout", actions=actions).sum(axis=0) for actions in ("true", "persistence"))
    return {
        "rollout_over_persistence": (rollout / persistence).tolist(),
        "one_step": float(one_step["true"] / one_step["persistence"]),
        "one_step_zero_actions": float(one_step["zero"] / one_step["persistence"]),
        "one_step_shuffled_actions": float(one_step["shuffled"] / one_step["persistence"]),
    }
