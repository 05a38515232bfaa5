"""Which policy is better, without a robot: the energy of what each would do at frames of held-out episodes.

The goal of a chunk is what the demonstration saw as many model steps later. So a policy that does what was shown is
good, and one that finds a better way is not seen to be.
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
from vjepa2_ac.intervals import Estimate, mean_of, ratio, ratio_difference
from vjepa2_ac.planning.cameras import read_views, require_views
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.runs.checkpoint import step_of
from vjepa2_ac.runs.folder import METRICS, is_run
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.spaces import POSE, StateSpace, apply_actions, states_along
from vjepa2_ac.storage.structured import plain

CHANCE = 0.5  # share of other actions with a lower energy than the true ones, for a model that ignores actions
_OTHERS = 16  # actions of other places, in addition to the true ones
_NEEDED = "arrays `episodes` (names), `frames` (control steps) and `chunks` (places x chunks x control steps x numbers)"

ChunkForm = Literal["targets", "deltas", "offsets"]
"""targets: states to be reached, one after another. deltas: the change from each target to the next. offsets: of all
targets from the present state."""


@dataclass(frozen=True, eq=False)
class PolicyChunks:
    """What a policy would do at some frames of episodes."""

    name: str
    places: tuple[tuple[str, int], ...]  # name of the episode, and the control step
    chunks: Float[np.ndarray, "places chunks steps dim"]


@dataclass(frozen=True)
class PolicyScore:
    """How a policy fares: mean energy over that of the zero action, below 1 is better."""

    name: str
    mean: Estimate  # of all its chunks
    best: Estimate  # of its chunk of lowest energy, as the model would choose
    behind: Estimate | None  # `mean` minus that of the policy before it in the order; None: it is the first


@dataclass(frozen=True)
class PolicyScores:
    """Policies, the best first, and whether the model can tell."""

    policies: tuple[PolicyScore, ...]
    demonstrated: Estimate  # what was done, over the zero action: no policy is expected to be better
    others_below_true: Estimate  # share of the actions of other places with a lower energy than the true ones
    places: int
    episodes: int
    left_out: int  # places whose goal would be after the episode's end

    @property
    def is_blind(self) -> bool:
        """Whether the model ranks the true actions no better than chance, so that its order means nothing."""
        return is_blind(self.others_below_true)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        found: dict[str, Any] = plain(asdict(self) | {"is_blind": self.is_blind})
        return found


def read_policy_chunks(path: Path) -> PolicyChunks:
    """Read what a policy would do from an .npz file; nothing in it is executed.

    Raises:
        InputError: It cannot be read, or an array is missing or has another shape.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            episodes, frames, chunks = (arrays[name] for name in ("episodes", "frames", "chunks"))
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", needed=_NEEDED) from None
    fits = episodes.shape == frames.shape == chunks.shape[:1] and chunks.ndim == 4 and len(episodes) > 0
    if not fits or frames.dtype.kind not in "iu" or chunks.dtype.kind != "f":
        shapes = ", ".join(f"{one.dtype} {one.shape}" for one in (episodes, frames, chunks))
        raise InputError(where=str(path), found=f"arrays {shapes}", needed=_NEEDED)
    places = tuple(zip(map(str, episodes.tolist()), map(int, frames.tolist()), strict=True))
    return PolicyChunks(path.stem, places, chunks.astype(np.float64))


def changes_of_chunks(
    chunks: np.ndarray,
    state: Float[np.ndarray, " dim"],
    *,
    form: ChunkForm,
    control_steps: int,
    space: StateSpace = POSE,
) -> Float[np.ndarray, "chunks model_steps dim"]:
    """Return the change of each model step, as the planner's actions are.

    Rotations act on the left (R' = R_delta @ R), as in `vjepa2_ac.episode`. Control steps at the end that fill no model
    step are left out.

    Args:
        chunks: What the policy would do, chunks x control steps x dim: poses in metres, radians and closedness, or
            vectors.
        state: Where the robot is.
        form: What the numbers mean.
        control_steps: Of a model step, in steps of the chunk: `data.stride` where both have one rate.
        space: What a state is.

    Raises:
        InputError: A chunk has other numbers than a state, one that no robot has, or is shorter than a model step; or
            the state is none.
    """
    state = np.array(state, dtype=np.float64)
    space.require_state(state, "state")
    found = np.array(chunks, dtype=np.float64)
    if found.ndim != 3 or not len(found) or found.shape[2] != len(space) or not np.isfinite(found).all():
        needed = f"finite numbers, chunks x control steps x {len(space)}: {', '.join(space.names)}"
        raise InputError(where="chunks", found=f"an array of the shape {found.shape}", needed=needed)
    if found.shape[1] < control_steps:
        needed = f"{control_steps} at least, which are one model step"
        raise InputError(where="chunks", found=counted(found.shape[1], "control step"), needed=needed)
    now, given = torch.from_numpy(state), torch.from_numpy(found)
    if form == "deltas":
        targets = states_along(now, given, space)[:, 1:].numpy()
    else:
        targets = found if form == "targets" else apply_actions(now.expand_as(given), given, space).numpy()
    space.require_plausible(targets.reshape(-1, len(space)), "chunks")
    ends = targets[:, control_steps - 1 :: control_steps]
    return np.stack([space.differences(np.concatenate([state[None], one])) for one in ends])


def is_blind(error: Estimate | None) -> bool:
    """Return whether a model ranks true actions no better than chance, so that its energies order nothing.

    Args:
        error: Share of other actions with a lower energy than the true ones. None, not measured: False is returned.
    """
    return error is not None and not (error.high if error.has_interval else error.value) < CHANCE


def ranking_of_run(subject: str, checkpoint: str) -> Estimate | None:
    """Return the action-ranking error in the validation of a run's checkpoint; None: not measured.

    Args:
        subject: The folder of a run, or a model, of which nothing is known.
        checkpoint: Which one, as text with its step.
    """
    if not is_run(subject):
        return None
    step = step_of(checkpoint.split(maxsplit=1)[0]) or 0
    log = [row for row in read_metrics_log(Path(subject) / METRICS) if row["step"] <= step]
    keys = ("action_ranking_error", "action_rank")  # the second one in runs before 2026-11-29
    key, rows = max(((key, [row for row in log if key in row]) for key in keys), key=lambda one: len(one[1]))
    if not rows:
        return None
    numbers = (rows[-1][name] for name in (key, f"{key}_low", f"{key}_high"))
    return Estimate(*(math.nan if one is None else float(one) for one in numbers))


def score_policies(
    controller: Controller,
    dataset: Dataset,
    policies: Sequence[PolicyChunks],
    *,
    form: ChunkForm = "targets",
    control_steps: int | None = None,
    progress: Progress = no_progress,
) -> PolicyScores:
    """Score policies at the places that all of them have.

    Args:
        controller: Plans with the model; it is reset.
        dataset: Has the episodes.
        policies: One or more.
        form: What the numbers of their chunks mean.
        control_steps: Of a model step, in steps of the chunks; None: as in the data.
        progress: Called with (done, total) in places.

    Raises:
        InputError: There is no common place, an episode or a frame is not there, the data have fewer cameras than the
            controller has views, or chunks cannot be used.
    """
    views, stride, space = controller.config.views, dataset.config.model_stride, controller.spaces.state
    require_views(dataset.config, views, to="score policies at")
    places = sorted(set.intersection(*(set(one.places) for one in policies)))
    if not places:
        raise InputError(where="--policy", found="no frame that all of them have", needed="the same places in all")
    control_steps = control_steps or stride
    ahead = max(1, min(one.chunks.shape[2] for one in policies) // control_steps) * stride
    known = (_place_of(dataset, place, ahead, space) for place in places)
    kept = [one for one in known if one is not None]
    if not kept:
        needed = f"{counted(ahead, 'control step')} after it in the episode"
        raise InputError(where="--policy", found="no place with a goal", needed=needed)
    rng, energies, ids = np.random.default_rng(0), list[np.ndarray](), [name for (name, _), *_ in kept]
    rows = [{place: row for row, place in reversed([*enumerate(one.places)])} for one in policies]
    for number, (place, episode, state, changes) in enumerate(kept):
        others = [kept[other].changes for other in _drawn(rng, number, ids)]
        chunks = [
            changes_of_chunks(one.chunks[row[place]], state, form=form, control_steps=control_steps, space=space)
            for one, row in zip(policies, rows, strict=True)
        ]
        chunks = [one[:, : len(changes)] for one in chunks]
        frame, goal = read_views(dataset, episode, views, [place[1], place[1] + ahead])
        controller.reset(goal)
        scored = controller.score(frame, state, np.concatenate([changes[None], others, *chunks]))
        true, worse, rest = np.split(scored.energies, [1, 1 + len(others)])
        by_policy = np.split(rest, np.cumsum([len(one) for one in chunks])[:-1])
        of_chunks = [float(take(one)) for take in (np.mean, np.min) for one in by_policy]
        energies.append(np.array([scored.doing_nothing, true[0], float((worse < true).mean()), *of_chunks]))
        progress(number + 1, len(kept))
    nothing, demonstrated, better, *of_policies = np.stack(energies).T
    means, bests = of_policies[: len(policies)], of_policies[len(policies) :]
    order = sorted(range(len(policies)), key=lambda number: float(means[number].mean()))
    scores = []
    for before, number in zip([None, *order], order, strict=False):
        pair = None if before is None else ((means[number], nothing), (means[before], nothing))
        scores.append(
            PolicyScore(
                name=policies[number].name,
                mean=ratio(means[number], nothing, ids),
                best=ratio(bests[number], nothing, ids),
                behind=None if pair is None else ratio_difference(*pair, ids),
            )
        )
    return PolicyScores(
        policies=tuple(scores),
        demonstrated=ratio(demonstrated, nothing, ids),
        others_below_true=mean_of(better, ids),
        places=len(ids),
        episodes=len(set(ids)),
        left_out=len(places) - len(kept),
    )


class _Place(NamedTuple):
    """A frame of an episode, what was done there, and where it led."""

    place: tuple[str, int]
    episode: int  # index in the data set
    state: Float[np.ndarray, " dim"]
    changes: Float[np.ndarray, "steps dim"]


def _place_of(dataset: Dataset, place: tuple[str, int], ahead: int, space: StateSpace) -> _Place | None:
    """Return a place whose goal is so many control steps later; None: the episode ends before that."""
    name, step = place
    index = dataset.table.find(name)
    if index is None:
        raise InputError(where=f"--policy: episode {name}", found=f"no such episode in {dataset.config.path}")
    states = dataset.source.read(index).states
    if not 0 <= step < len(states) - ahead:
        return None
    way = states[step : step + ahead + 1 : dataset.config.model_stride]
    return _Place(place, index, states[step], space.differences(way))


def _drawn(rng: np.random.Generator, number: int, episodes: Sequence[str]) -> Int[np.ndarray, " others"]:
    """Draw places of other episodes than that of one; of all others where there is one episode only."""
    apart = [other for other, name in enumerate(episodes) if name != episodes[number]]
    choices = apart or [other for other in range(len(episodes)) if other != number] or [number]
    return rng.choice(np.array(choices), size=_OTHERS)
