"""Measure action coverage: do the data contain enough directions and magnitudes of motion to plan with?

A planner searches all directions up to its limits and takes the action with the lowest energy. Where the data have no
such actions, the model extrapolates, and the optimiser exploits its errors. Data have low diversity if they move in few
directions, or hardly at all; the orientation of the axes does not matter.

Sources of the advice: GPC (arXiv 2502.00622: a world model needs random exploration in addition to demonstrations),
DreamZero (a new robot from 30 minutes of play), lassesofus/thesis @ 4a2f29f (V-JEPA 2-AC fine-tuned on one-direction
reaches plans worse than its base).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.files import map_in_threads, num_connections
from vjepa2_ac.data.windows import spread_indices
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.inspection.findings import Finding
from vjepa2_ac.spaces import POSE, StateSpace, states_in_camera_frame

T = TypeVar("T")

PERCENTILE = 99  # percentile that is reported as the usual size of changes
PLAY = (
    "Record half an hour of random motion in all directions, with steps as long as the planner's: this helps planning"
    " more than further demonstrations"
)

ENOUGH_NEAR = 0.5  # a direction is covered from this density on, relative to equally frequent directions
_SHORT_CM = 0.5  # shorter steps have no reliable direction, and no reliable sign along an axis
_NEAR_DEG = 30.0  # angle within which a step counts for a direction
# Measured: random reaching of the simulated arm 0.99 or more, of 100 random steps 0.90; half of all directions 0.61,
# a plane 0.50 (0.58 if a fifth as thick as wide), an axis 0.14 (0.43), one way 0.07; starts of BridgeData 0.41.
ENOUGH_DIRECTIONS = 0.7
_SMALL_CM = 1.0  # shorter steps are hardly visible in an image
_MIN_STEPS = 100  # minimum number of steps that do not overlap
_ROWS, _COLUMNS, _MAX_STEPS = 24, 48, 5000  # cells of the map of directions, and most steps that are used for it
_SAME_DIRECTION, _SAME_AXIS, _SAME_PLANE, _PREFERRED = 0.8, 0.8, 0.1, 0.3
_GRIPPER = 0.1  # smallest change of closedness that counts as motion of the gripper
_HARDLY = 0.01  # smaller changes of numbers in vectors count as rest, because the numbers are of the order of 1
_STEP, _OFTEN, _HALF = 0.1, 0.05, 0.5  # thresholds: share of the usual change, of the steps, of the numbers


@dataclass(frozen=True, eq=False)
class ReadEpisode:
    """An episode of a sample, without frames."""

    index: int  # index into the data set's table
    states: Float[np.ndarray, "steps state_dim"]
    selected: tuple[tuple[int, int], ...]  # ranges of control steps from which clips are taken
    extrinsics: Float[np.ndarray, "steps 6"] | None = None  # camera poses, if `data.pose_frame` is camera

    def changes(self, stride: int, space: StateSpace) -> Iterator[Float[np.ndarray, "pairs state_dim"]]:
        """Yield the changes of the state over `stride` control steps, within selected ranges, in the model's frame."""
        states = self.states if self.extrinsics is None else states_in_camera_frame(self.states, self.extrinsics)
        for start, end in self.selected:
            for first in range(start, min(start + stride, end - stride)):
                yield space.compute_differences(states[first:end:stride])


def sample_of(dataset: Dataset, count: int) -> list[int]:
    """Return at most `count` of the used episodes, drawn deterministically by the hash of their identities."""
    # A latent cache contains only episodes from which clips are taken.
    members = dataset.starts.episodes if dataset.config.is_cache else dataset.episodes
    members = members[np.argsort(dataset.table.id_hash[members], kind="stable")]
    return [int(members[index]) for index in spread_indices(len(members), count)]


def read_each(
    dataset: Dataset, chosen: Sequence[int], read: Callable[[int], T], progress: Progress = no_progress
) -> Iterator[tuple[int, T]]:
    """Apply a function to some episodes in parallel, and yield each index with its result.

    Episodes that cannot be read are skipped if `data.broken_episodes` allows it.

    Raises:
        InputError: An episode cannot be read, and `data.broken_episodes` does not skip it.
    """

    def read_or_error(index: int) -> T | InputError:
        try:
            return read(index)
        except InputError as error:
            return error

    results = map_in_threads(read_or_error, chosen, num_connections(dataset.config))
    for done, (index, result) in enumerate(zip(chosen, results, strict=True), start=1):
        progress(done, len(chosen))
        if isinstance(result, InputError):
            dataset.skip_episode(index, result)
        else:
            yield index, result


def read_sample(
    dataset: Dataset, count: int, progress: Progress = no_progress, *, also: Iterable[int] = ()
) -> Iterator[ReadEpisode]:
    """Read at most `count` episodes, and those in `also`, without frames.

    Raises:
        InputError: As for `read_each`.
    """
    chosen = list(dict.fromkeys([*also, *sample_of(dataset, count)]))
    for index, episode in read_each(dataset, chosen, dataset.source.read, progress):
        camera = episode.extrinsics if dataset.config.pose_frame == "camera" else None
        yield ReadEpisode(
            index, np.asarray(episode.states, np.float64), tuple(dataset.selected_steps.ranges_of(index)), camera
        )


@dataclass(frozen=True, eq=False)
class Coverage:
    """Action coverage, from the changes of the state over `stride` control steps."""

    low_diversity_reason: str  # why the data are not diverse enough; empty if they are, or unknown
    moving_steps: int  # number of consecutive model steps that move
    usual: Float[np.ndarray, " dim"]  # the 99th percentile of the size of each number's change
    lines: Mapping[str, str]  # the results as text, by name
    metrics: Mapping[str, Any]  # the results as plain values
    density: Float[np.ndarray, "rows columns"] | None = None  # density of directions, for poses; see `density_of`

    @property
    def is_known(self) -> bool:
        """Whether there are enough moving steps for a verdict."""
        return self.moving_steps >= _MIN_STEPS

    @property
    def verdict(self) -> str:
        """A sentence that states whether the motion is diverse enough to plan with, and if not, what to record."""
        if self.low_diversity_reason:
            return f"motions are not diverse enough to plan with: {self.low_diversity_reason}. {PLAY}"
        return "motions are diverse enough to plan with" if self.is_known else _describe_need(self.moving_steps)

    def as_record(self) -> dict[str, Any]:
        """Return the values that a run stores about its data, as plain values."""
        return {"percentile": PERCENTILE, "changes": self.usual.tolist(), "narrow": self.low_diversity_reason}


def coverage_findings(coverage: Coverage | None) -> Iterator[Finding]:
    """Yield the findings about action coverage, with the verdict last.

    Args:
        coverage: The coverage; None: no episode is as long as a model step.
    """
    if coverage is None:
        yield Finding("skipped", "coverage", "needs episodes with more consecutive steps than data.stride, found none")
        return
    directions = coverage.metrics.get("directions", 1.0)
    is_low = {"directions": directions < ENOUGH_DIRECTIONS, "coverage": bool(coverage.low_diversity_reason)}
    for name, text in {**coverage.lines, "coverage": coverage.verdict}.items():
        yield Finding("skipped" if text.startswith("needs") else "warning" if is_low.get(name) else "ok", name, text)


def coverage_in(dataset: Dataset, *, episodes: int = 64) -> Coverage | None:
    """Measure action coverage in a sample of episodes, without frames; None if no episode is as long as a model step.

    Raises:
        InputError: As for `read_sample`.
    """
    return coverage_by(read_sample(dataset, episodes), dataset.spaces.state, dataset.config.model_stride)


def coverage_by(sample: Iterable[ReadEpisode], space: StateSpace, stride: int) -> Coverage | None:
    """Measure action coverage in some episodes; None if none of them is as long as a model step."""
    changes = [piece for episode in sample for piece in episode.changes(stride, space)]
    return coverage_of(np.concatenate(changes), space, stride) if changes else None


def coverage_of(changes: Float[np.ndarray, "pairs dim"], space: StateSpace, stride: int) -> Coverage:
    """Measure action coverage from changes of states, which may overlap in time."""
    usual = np.asarray(np.percentile(np.abs(changes), PERCENTILE, axis=0))
    coverage = _pose_coverage(changes, usual, stride) if space.is_pose else _vector_coverage(changes, usual, stride)
    metrics = {"stride": stride, "steps": len(changes), **coverage.metrics, "percentile_99": usual.tolist()}
    reason = coverage.low_diversity_reason if len(changes) >= _MIN_STEPS * stride else ""
    return replace(coverage, low_diversity_reason=reason, metrics=metrics | {"narrow": reason})


def _describe_need(moving_steps: int) -> str:
    return f"needs at least {_MIN_STEPS} consecutive moving steps, found {moving_steps}"


def _pose_coverage(changes: Float[np.ndarray, "pairs 7"], usual: Float[np.ndarray, " 7"], stride: int) -> Coverage:
    moves_cm, lengths_cm = 100 * changes[:, POSE.position], POSE.compute_display_size(changes)
    directions = (moves_cm / np.maximum(lengths_cm, 1e-12)[:, None])[lengths_cm >= _SHORT_CM]
    moving_steps = len(directions) // stride
    is_known = moving_steps >= _MIN_STEPS
    density = density_of(directions)
    covered = float((density >= ENOUGH_NEAR).mean())
    mean = directions.mean(axis=0) if len(directions) else np.zeros(3)
    mean_length = float(np.linalg.norm(mean))  # 0 if the directions are balanced, 1 if all are the same
    shares, axes = np.linalg.eigh(directions.T @ directions / max(1, len(directions)))  # in ascending order
    usual_cm = [float(length) for length in np.percentile(lengths_cm, [10, 50, 90, 99])]
    share = f"{100 * covered:.0f} % of all directions"
    reason = ""
    if usual_cm[2] < _SMALL_CM:
        reason = f"90 % of the steps are at most {usual_cm[2]:.1f} cm long, which images hardly show: raise data.stride"
    elif is_known and covered < ENOUGH_DIRECTIONS:
        reason = f"they cover {share}; {_describe_directions(mean, mean_length, shares, axes.T)}"
    negative, positive = ((sign * moves_cm >= _SHORT_CM).mean(axis=0) for sign in (-1, 1))
    gripper = float((np.abs(changes[:, POSE.gripper]) >= _GRIPPER).mean())
    by_axis = (
        f"{100 * size_m:.1f} cm along {axis} ({100 * minus:.0f} % towards -{axis}, {100 * plus:.0f} % towards +{axis})"
        for axis, size_m, minus, plus in zip("xyz", usual[:3], negative, positive, strict=True)
    )
    lines = {
        "directions": f"{'motions' if is_known else f'{_describe_need(moving_steps)}; these'} cover {share}"
        f" (below {100 * ENOUGH_DIRECTIONS:.0f} % planning is unreliable);"
        f" the mean direction has length {mean_length:.2f} (0: balanced, 1: all in the same direction)",
        "axes": f"{PERCENTILE} % of the steps move at most {', '.join(by_axis)};"
        f" the gripper moves in {100 * gripper:.0f} % of the steps",
    }
    metrics = {
        "directions": covered,
        "mean_direction": mean_length,
        "length_cm_10_50_90_99": usual_cm,
        "gripper_share": gripper,
    }
    return Coverage(reason, moving_steps, usual, lines, metrics, density)


def density_of(directions: Float[np.ndarray, "steps 3"]) -> Float[np.ndarray, "rows columns"]:
    """Return the number of steps within 30 degrees of each direction, relative to equally frequent directions.

    The cells have equal areas: rows are equally spaced in z (-1 to 1), columns in azimuth (-180 to 180 degrees).
    """
    sampled = directions[:: -(-len(directions) // _MAX_STEPS) or 1].astype(np.float32)
    if not len(sampled):
        return np.zeros((_ROWS, _COLUMNS))
    height = (np.arange(_ROWS, dtype=np.float32)[:, None] + 0.5) / _ROWS * 2 - 1
    azimuth = ((np.arange(_COLUMNS, dtype=np.float32) + 0.5) / _COLUMNS * 2 - 1) * np.pi
    across = np.sqrt(1 - height**2)
    cells = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height + 0 * azimuth], axis=-1)
    near = np.cos(np.deg2rad(_NEAR_DEG))
    return np.asarray((cells @ sampled.T > near).mean(axis=-1) / ((1 - near) / 2), np.float64)


def _describe_directions(
    mean: Float[np.ndarray, " 3"], mean_length: float, shares: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "3 3"]
) -> str:
    """Describe the distribution of directions, by their mean and principal axes."""
    if mean_length >= _SAME_DIRECTION:
        return f"nearly all point in the same direction, {_format_direction(mean / mean_length)}"
    if shares[2] >= _SAME_AXIS:
        return f"nearly all are along one axis, {_format_direction(axes[2])}"
    if shares[0] <= _SAME_PLANE:
        return f"nearly all are in one plane, normal to {_format_direction(axes[0])}"
    if mean_length >= _PREFERRED:
        return f"few point towards {_format_direction(-mean / mean_length)}"
    return f"few are along {_format_direction(axes[0])}"


def _format_direction(direction: Float[np.ndarray, " 3"]) -> str:
    numbers = np.round(direction, 1) + 0.0  # without -0.0
    return f"({', '.join(f'{name} {number:+.1f}' for name, number in zip('xyz', numbers, strict=True))})"


def _vector_coverage(
    changes: Float[np.ndarray, "pairs dim"], usual: Float[np.ndarray, " dim"], stride: int
) -> Coverage:
    """Measure the coverage of each number separately, because the dependence between numbers is unknown."""
    negative, positive = ((sign * changes > _STEP * usual).mean(axis=0) for sign in (-1, 1))
    both = np.flatnonzero((np.minimum(negative, positive) >= _OFTEN) & (usual >= _HARDLY)).tolist()
    still = np.flatnonzero(usual < _HARDLY).tolist()
    width = len(usual)
    has_low_diversity = len(both) <= _HALF * width
    lines = {
        "numbers": f"{len(both)} of {width} numbers increase and decrease, {len(still)} hardly change",
        "changes": f"{PERCENTILE} % of the steps change the numbers by at most"
        f" {', '.join(f'{change:.2g}' for change in usual)}",
    }
    reason = (
        f"{len(still)} of {width} numbers hardly change, {width - len(both) - len(still)} change in one direction only"
    )
    metrics = {"both_ways": both, "still": still}
    return Coverage(reason if has_low_diversity else "", len(changes) // stride, usual, lines, metrics)
