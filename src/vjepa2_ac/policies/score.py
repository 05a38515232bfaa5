"""Offline comparison of policies: the energy of their action chunks at frames of held-out episodes.

For a chunk of N model steps, the goal is the frame of the demonstration that comes N model steps later. A policy that
imitates the demonstration therefore scores well. The score does not show whether a policy finds a better solution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.intervals import Estimate, estimate_mean, estimate_ratio, estimate_ratio_difference
from vjepa2_ac.planning.cameras import read_views, require_views
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.runs.checkpoint import parse_step
from vjepa2_ac.runs.folder import METRICS, is_run
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.spaces import POSE, StateSpace, apply_actions, integrate_changes
from vjepa2_ac.storage.structured import to_plain

CHANCE = 0.5  # share of other actions with a lower energy than the true ones, if a model ignores the actions
_NUM_ALTERNATIVES = 16  # number of actions from other evaluation points that the true actions are compared with
_NEEDED = (
    "arrays `episodes` (names), `frames` (control steps)"
    " and `chunks` (evaluation points x chunks x control steps x components of an action)"
)

ChunkForm = Literal["targets", "deltas", "offsets"]
"""targets: absolute target states, one after another. deltas: the change from each target to the next. offsets: the
difference of each target from the current state."""


@dataclass(frozen=True, eq=False)
class PolicyChunks:
    """The action chunks that a policy proposes at frames of episodes."""

    name: str
    points: tuple[tuple[str, int], ...]  # evaluation points: name of the episode, control step
    chunks: Float[np.ndarray, "points chunks steps dim"]


@dataclass(frozen=True)
class PolicyScore:
    """The score of a policy: its mean energy relative to the zero action's; lower is better."""

    name: str
    mean: Estimate  # over all chunks at an evaluation point
    best: Estimate  # score of the chunk that the model would select at each evaluation point, with the lowest energy
    behind: Estimate | None  # `mean` minus `mean` of the next better policy; None: this policy is the best


@dataclass(frozen=True)
class PolicyScores:
    """The scores of policies, best first, and whether the model can rank actions."""

    policies: tuple[PolicyScore, ...]
    demonstrated: Estimate  # score of the demonstrated actions; no policy is expected to be better
    others_below_true: Estimate  # share of actions from other evaluation points with a lower energy than the true ones
    places: int  # number of evaluation points
    episodes: int
    left_out: int  # number of points whose goal would be after the end of the episode

    @property
    def is_blind(self) -> bool:
        """Whether the model ranks the true actions no better than chance, so that the order is meaningless."""
        return is_blind(self.others_below_true)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        values: dict[str, Any] = to_plain(asdict(self) | {"is_blind": self.is_blind})
        return values


def read_policy_chunks(path: Path) -> PolicyChunks:
    """Read the action chunks of a policy from an .npz file; no code from the file is executed.

    Raises:
        InputError: The file cannot be read, or an array is missing or has another shape.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            episodes, frames, chunks = (arrays[name] for name in ("episodes", "frames", "chunks"))
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", needed=_NEEDED) from None
    is_valid = episodes.shape == frames.shape == chunks.shape[:1] and chunks.ndim == 4 and len(episodes) > 0
    if not is_valid or frames.dtype.kind not in "iu" or chunks.dtype.kind != "f":
        shapes = ", ".join(f"{array.dtype} {array.shape}" for array in (episodes, frames, chunks))
        raise InputError(where=str(path), found=f"arrays {shapes}", needed=_NEEDED)
    points = tuple(zip(map(str, episodes.tolist()), map(int, frames.tolist()), strict=True))
    return PolicyChunks(path.stem, points, chunks.astype(np.float64))


def changes_of_chunks(
    chunks: np.ndarray,
    state: Float[np.ndarray, " dim"],
    *,
    form: ChunkForm,
    control_steps: int,
    space: StateSpace = POSE,
) -> Float[np.ndarray, "chunks model_steps dim"]:
    """Convert action chunks to changes of the state in each model step, which are the actions of the planner.

    Rotations act on the left (R' = R_delta @ R), as in `vjepa2_ac.episode`. Control steps at the end that do not fill a
    model step are left out.

    Args:
        chunks: Actions of the policy, chunks x control steps x dim: poses in metres, radians and gripper position, or
            states in another space.
        state: The current state of the robot.
        form: Whether the chunks contain targets, deltas or offsets.
        control_steps: Steps of a chunk per model step: `data.stride` if policy and data have the same rate.
        space: Meaning of a state.

    Raises:
        InputError: A chunk has another width than a state, implausible values, or is shorter than a model step; or the
            state is invalid.
    """
    state = np.array(state, dtype=np.float64)
    space.require_state(state, "state")
    values = np.array(chunks, dtype=np.float64)
    if values.ndim != 3 or not len(values) or values.shape[2] != len(space) or not np.isfinite(values).all():
        needed = f"finite numbers, chunks x control steps x {len(space)}: {', '.join(space.names)}"
        raise InputError(where="chunks", found=f"an array with shape {values.shape}", needed=needed)
    if values.shape[1] < control_steps:
        needed = f"at least {control_steps} control steps (one model step)"
        raise InputError(where="chunks", found=counted(values.shape[1], "control step"), needed=needed)
    current, changes = torch.from_numpy(state), torch.from_numpy(values)
    if form == "deltas":
        targets = integrate_changes(current, changes, space)[:, 1:].numpy()
    else:
        targets = values if form == "targets" else apply_actions(current.expand_as(changes), changes, space).numpy()
    space.require_plausible(targets.reshape(-1, len(space)), "chunks")
    ends = targets[:, control_steps - 1 :: control_steps]
    return np.stack([space.compute_differences(np.concatenate([state[None], chunk_ends])) for chunk_ends in ends])


def is_blind(error: Estimate | None) -> bool:
    """Return whether a model ranks true actions no better than chance, so that its energies cannot rank actions.

    Args:
        error: Share of other actions with a lower energy than the true ones. None (not measured) returns False.
    """
    return error is not None and not error.is_below(CHANCE)


def read_run_ranking_error(subject: str, checkpoint: str) -> Estimate | None:
    """Return the action-ranking error in the validation of a run's checkpoint; None: not measured.

    Args:
        subject: The folder of a run; for a model the result is None.
        checkpoint: Name of the checkpoint, which contains its step.
    """
    if not is_run(subject):
        return None
    step = parse_step(checkpoint.split(maxsplit=1)[0]) or 0
    log = [row for row in read_metrics_log(Path(subject) / METRICS) if row["step"] <= step]
    keys = ("action_ranking_error", "action_rank")  # the second key was used before 2026-11-29
    key, rows = max(((key, [row for row in log if key in row]) for key in keys), key=lambda item: len(item[1]))
    if not rows:
        return None
    numbers = (rows[-1][name] for name in (key, f"{key}_low", f"{key}_high"))
    return Estimate(*(math.nan if number is None else float(number) for number in numbers))


def score_policies(
    controller: Controller,
    dataset: Dataset,
    policies: Sequence[PolicyChunks],
    *,
    form: ChunkForm = "targets",
    control_steps: int | None = None,
    progress: Progress = no_progress,
) -> PolicyScores:
    """Score policies at the evaluation points (episode and control step) that all of them have.

    Args:
        controller: The controller of the model that scores; its goals are replaced.
        dataset: The data set with the episodes.
        policies: One or more policies.
        form: Whether the chunks contain targets, deltas or offsets.
        control_steps: Steps of a chunk per model step; None: the stride of the data.
        progress: Called with (done, total) in evaluation points.

    Raises:
        InputError: There is no common evaluation point, an episode or a frame does not exist, the data have fewer
            cameras than the controller has views, or chunks are invalid.
    """
    views, stride, space = controller.config.views, dataset.config.model_stride, controller.spaces.state
    require_views(dataset.config, views, to="score policies")
    common_points = sorted(set.intersection(*(set(policy.points) for policy in policies)))
    if not common_points:
        needed = "at least one evaluation point (episode and frame) that all files contain"
        raise InputError(where="--policy", found="no common evaluation point", needed=needed)
    control_steps = control_steps or stride
    goal_distance = max(1, min(policy.chunks.shape[2] for policy in policies) // control_steps) * stride
    read_points = (_read_point(dataset, point, goal_distance, space) for point in common_points)
    points = [point for point in read_points if point is not None]
    if not points:
        needed = f"{counted(goal_distance, 'control step')} after the frame in the same episode"
        raise InputError(where="--policy", found="no evaluation point whose episode is long enough", needed=needed)
    rng, ids = np.random.default_rng(0), [point.point[0] for point in points]
    chunk_indices = [{point: index for index, point in reversed([*enumerate(policy.points)])} for policy in policies]
    energies: list[np.ndarray] = []
    for number, point in enumerate(points):
        alternatives = [points[index].changes for index in _draw_alternatives(rng, number, ids)]
        chunks = [
            changes_of_chunks(
                policy.chunks[indices[point.point]], point.state, form=form, control_steps=control_steps, space=space
            )[:, : len(point.changes)]
            for policy, indices in zip(policies, chunk_indices, strict=True)
        ]
        step = point.point[1]
        frame, goal = read_views(dataset, point.episode, views, [step, step + goal_distance])
        controller.reset(goal)
        scores = controller.score(frame, point.state, np.concatenate([point.changes[None], alternatives, *chunks]))
        demonstrated_energy, alternative_energies, proposed_energies = np.split(
            scores.energies, [1, 1 + len(alternatives)]
        )
        energies_by_policy = np.split(
            proposed_energies, np.cumsum([len(policy_chunks) for policy_chunks in chunks])[:-1]
        )
        means = [float(chunk_energies.mean()) for chunk_energies in energies_by_policy]
        lowest = [float(chunk_energies.min()) for chunk_energies in energies_by_policy]
        share_below_true = float((alternative_energies < demonstrated_energy).mean())
        energies.append(
            np.array([scores.zero_action_energy, demonstrated_energy[0], share_below_true, *means, *lowest])
        )
        progress(number + 1, len(points))
    zero_action, demonstrated, shares_below_true, *policy_energies = np.stack(energies).T
    return PolicyScores(
        policies=_rank_policies(
            policies, policy_energies[: len(policies)], policy_energies[len(policies) :], zero_action, ids
        ),
        demonstrated=estimate_ratio(demonstrated, zero_action, ids),
        others_below_true=estimate_mean(shares_below_true, ids),
        places=len(ids),
        episodes=len(set(ids)),
        left_out=len(common_points) - len(points),
    )


def _rank_policies(
    policies: Sequence[PolicyChunks],
    means: Sequence[Float[np.ndarray, " points"]],
    lowest: Sequence[Float[np.ndarray, " points"]],
    zero_action: Float[np.ndarray, " points"],
    ids: Sequence[str],
) -> tuple[PolicyScore, ...]:
    """Return the scores of the policies, best first.

    Args:
        policies: The policies.
        means: Mean energy of each policy's chunks, at each evaluation point.
        lowest: Lowest energy of each policy's chunks, at each evaluation point.
        zero_action: Energy of the zero action at each evaluation point.
        ids: Episode of each evaluation point.
    """
    order = sorted(range(len(policies)), key=lambda index: float(means[index].mean()))
    scores = []
    for better, index in zip([None, *order], order, strict=False):
        difference = None
        if better is not None:
            difference = estimate_ratio_difference((means[index], zero_action), (means[better], zero_action), ids)
        mean, best = estimate_ratio(means[index], zero_action, ids), estimate_ratio(lowest[index], zero_action, ids)
        scores.append(PolicyScore(policies[index].name, mean, best, difference))
    return tuple(scores)


class _EvaluationPoint(NamedTuple):
    """An evaluation point: a frame of an episode, its state, and the demonstrated changes after it."""

    point: tuple[str, int]  # name of the episode, control step
    episode: int  # index in the data set
    state: Float[np.ndarray, " dim"]
    changes: Float[np.ndarray, "steps dim"]


def _read_point(
    dataset: Dataset, point: tuple[str, int], goal_distance: int, space: StateSpace
) -> _EvaluationPoint | None:
    """Read an evaluation point with a goal `goal_distance` control steps later; None: the episode ends before the goal.

    Raises:
        InputError: There is no such episode, or it cannot be read.
    """
    name, step = point
    index = dataset.table.find(name)
    if index is None:
        raise InputError(where=f"--policy: episode {name}", found=f"{dataset.config.path} has no such episode")
    states = dataset.source.read(index).states
    if not 0 <= step < len(states) - goal_distance:
        return None
    path = states[step : step + goal_distance + 1 : dataset.config.model_stride]
    return _EvaluationPoint(point, index, states[step], space.compute_differences(path))


def _draw_alternatives(
    rng: np.random.Generator, number: int, episodes: Sequence[str]
) -> Int[np.ndarray, " alternatives"]:
    """Draw evaluation points from other episodes; from the same episode if there is only one.

    Args:
        rng: Random generator.
        number: Index of the evaluation point.
        episodes: Episode of each evaluation point.
    """
    other_episodes = [index for index, name in enumerate(episodes) if name != episodes[number]]
    choices = other_episodes or [index for index in range(len(episodes)) if index != number] or [number]
    return rng.choice(np.array(choices), size=_NUM_ALTERNATIVES)
