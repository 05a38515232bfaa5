"""Measure action coverage: do the data contain enough directions and magnitudes of motion to plan with?

A planner searches all directions up to its limits and takes the action with the lowest energy. If the data contain no
such actions, the model extrapolates, and the optimiser exploits the errors of the model. Data have low diversity if the
robot moves in few directions, or hardly at all. The orientation of the axes does not matter.

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

ENOUGH_NEAR = 0.5  # minimum density of a covered direction, relative to the density of equally frequent directions
_SHORT_CM = 0.5  # shorter steps have no reliable direction, and no reliable sign along an axis
_NEAR_DEG = 30.0  # maximum angle between a step and a direction for which it counts
# Minimum fraction of directions that are covered. Measured fractions: 0.99 or more for random reaching of the simulated
# arm (0.90 with only 100 steps), 0.61 for motion in half of all directions, 0.50 in a plane (0.58 if it is a fifth as
# thick as wide), 0.14 along an axis (0.43 if it is equally thick), 0.07 in one direction, 0.41 for the first steps of
# BridgeData's episodes.
ENOUGH_DIRECTIONS = 0.7
_SMALL_CM = 1.0  # shorter steps are hardly visible in an image
_MIN_STEPS = 100  # minimum number of steps that do not overlap
_ROWS, _COLUMNS, _MAX_STEPS = 24, 48, 5000  # cells of the map of directions, and maximum number of steps used for it
_SAME_DIRECTION, _SAME_AXIS, _SAME_PLANE, _PREFERRED = 0.8, 0.8, 0.1, 0.3  # thresholds of `_describe_directions`
_GRIPPER = 0.1  # smallest change of gripper position that counts as motion of the gripper
_HARDLY = 0.01  # smaller changes of a vector's numbers count as rest, because the numbers are of the order of 1
# A number of a vector changes in both directions if it increases, and decreases, by more than _STEP x its usual change
# in at least _OFTEN of the steps. Vectors have low diversity if at most _HALF of the numbers change in both directions.
_STEP, _OFTEN, _HALF = 0.1, 0.05, 0.5


@dataclass(frozen=True, eq=False)
class ReadEpisode:
    """An episode that was read without frames."""

    index: int  # index into the data set's table
    states: Float[np.ndarray, "steps state_dim"]
    selected: tuple[tuple[int, int], ...]  # ranges of control steps from which clips are taken
    extrinsics: Float[np.ndarray, "steps 6"] | None = None  # camera poses, if `data.pose_frame` is camera

    def changes(self, stride: int, space: StateSpace) -> Iterator[Float[np.ndarray, "pairs state_dim"]]:
        """Yield the changes of the state over `stride` control steps, within selected ranges, in `data.pose_frame`."""
        states = self.states if self.extrinsics is None else states_in_camera_frame(self.states, self.extrinsics)
        for start, end in self.selected:
            for first in range(start, min(start + stride, end - stride)):
                yield space.compute_differences(states[first:end:stride])


def select_sample(dataset: Dataset, max_episodes: int) -> list[int]:
    """Return the indices of some of the used episodes, selected deterministically by the hashes of their identities."""
    # A latent cache contains only episodes from which clips are taken.
    indices = dataset.starts.episodes if dataset.config.is_cache else dataset.episodes
    indices = indices[np.argsort(dataset.table.id_hash[indices], kind="stable")]
    return [int(indices[position]) for position in spread_indices(len(indices), max_episodes)]


def read_each(
    dataset: Dataset, indices: Sequence[int], read: Callable[[int], T], progress: Progress = no_progress
) -> Iterator[tuple[int, T]]:
    """Apply a function to the indices of some episodes in parallel, and yield each index with the result.

    Episodes that cannot be read are skipped if `data.broken_episodes` allows it.

    Raises:
        InputError: An episode cannot be read, and `data.broken_episodes` does not skip it.
    """

    def read_or_error(index: int) -> T | InputError:
        try:
            return read(index)
        except InputError as error:
            return error

    results = map_in_threads(read_or_error, indices, num_connections(dataset.config))
    for num_read, (index, result) in enumerate(zip(indices, results, strict=True), start=1):
        progress(num_read, len(indices))
        if isinstance(result, InputError):
            dataset.skip_episode(index, result)
        else:
            yield index, result


def read_sample(
    dataset: Dataset, max_episodes: int, progress: Progress = no_progress, *, also: Iterable[int] = ()
) -> Iterator[ReadEpisode]:
    """Read a sample of the used episodes, and the episodes with the indices in `also`, without frames.

    Raises:
        InputError: As for `read_each`.
    """
    indices = list(dict.fromkeys([*also, *select_sample(dataset, max_episodes)]))
    for index, episode in read_each(dataset, indices, dataset.source.read, progress):
        camera = episode.extrinsics if dataset.config.pose_frame == "camera" else None
        yield ReadEpisode(
            index, np.asarray(episode.states, np.float64), tuple(dataset.selected_steps.ranges_of(index)), camera
        )


@dataclass(frozen=True, eq=False)
class Coverage:
    """Action coverage of a data set, measured by the changes of the state over one model step."""

    low_diversity_reason: str  # why the data are not diverse enough; empty if they are, or if there are too few steps
    moving_steps: int  # number of moving steps that do not overlap
    usual: Float[np.ndarray, " dim"]  # 99th percentile of the absolute change of each number
    lines: Mapping[str, str]  # the results as text, by name
    metrics: Mapping[str, Any]  # the results as plain values
    density: Float[np.ndarray, "rows columns"] | None = None  # density of directions, for poses; see `compute_density`

    @property
    def is_known(self) -> bool:
        """Whether there are enough moving steps for a verdict."""
        return self.moving_steps >= _MIN_STEPS

    @property
    def verdict(self) -> str:
        """The result as text: whether the motion is diverse enough to plan with, and if not, what to record."""
        if self.low_diversity_reason:
            return f"motions are not diverse enough to plan with: {self.low_diversity_reason}. {PLAY}"
        if self.is_known:
            return "motions are diverse enough to plan with"
        return f"needs at least {_MIN_STEPS} consecutive moving steps, found {self.moving_steps}"

    def as_record(self) -> dict[str, Any]:
        """Return the values that a run stores about its data."""
        return {"percentile": PERCENTILE, "changes": self.usual.tolist(), "narrow": self.low_diversity_reason}


def coverage_findings(coverage: Coverage | None) -> Iterator[Finding]:
    """Yield the findings about action coverage, the verdict last.

    Args:
        coverage: The coverage; None: no episode is longer than a model step.
    """
    if coverage is None:
        yield Finding("skipped", "coverage", "needs episodes with more consecutive steps than data.stride, found none")
        return
    directions = coverage.metrics.get("directions", 1.0)
    for name, text in coverage.lines.items():
        yield Finding("warning" if name == "directions" and directions < ENOUGH_DIRECTIONS else "ok", name, text)
    has_warning = bool(coverage.low_diversity_reason)
    yield Finding("warning" if has_warning else "ok" if coverage.is_known else "skipped", "coverage", coverage.verdict)


def measure_coverage(dataset: Dataset, *, episodes: int = 64) -> Coverage | None:
    """Measure action coverage in a sample of a data set; None if no episode is longer than a model step.

    Raises:
        InputError: As for `read_sample`.
    """
    return coverage_of_episodes(read_sample(dataset, episodes), dataset.spaces.state, dataset.config.model_stride)


def coverage_of_episodes(sample: Iterable[ReadEpisode], space: StateSpace, stride: int) -> Coverage | None:
    """Measure action coverage in some episodes; None if no episode is longer than a model step."""
    changes = [piece for episode in sample for piece in episode.changes(stride, space)]
    return coverage_of_changes(np.concatenate(changes), space, stride) if changes else None


def coverage_of_changes(changes: Float[np.ndarray, "pairs dim"], space: StateSpace, stride: int) -> Coverage:
    """Measure action coverage from changes of the state over `stride` control steps, which may overlap in time."""
    usual = np.asarray(np.percentile(np.abs(changes), PERCENTILE, axis=0))
    coverage = _pose_coverage(changes, usual, stride) if space.is_pose else _vector_coverage(changes, usual, stride)
    metrics = {"stride": stride, "steps": len(changes), **coverage.metrics, "percentile_99": usual.tolist()}
    reason = coverage.low_diversity_reason if len(changes) >= _MIN_STEPS * stride else ""
    return replace(coverage, low_diversity_reason=reason, metrics=metrics | {"narrow": reason})


def _pose_coverage(changes: Float[np.ndarray, "pairs 7"], usual: Float[np.ndarray, " 7"], stride: int) -> Coverage:
    moves_cm, lengths_cm = 100 * changes[:, POSE.position], POSE.compute_display_size(changes)
    directions = (moves_cm / np.maximum(lengths_cm, 1e-12)[:, None])[lengths_cm >= _SHORT_CM]
    moving_steps = len(directions) // stride
    is_known = moving_steps >= _MIN_STEPS
    density = compute_density(directions)
    covered = float((density >= ENOUGH_NEAR).mean())
    mean = directions.mean(axis=0) if len(directions) else np.zeros(3)
    mean_length = float(np.linalg.norm(mean))  # 0 if the directions are balanced, 1 if all directions are equal
    moments, axes = np.linalg.eigh(directions.T @ directions / max(1, len(directions)))  # in ascending order
    percentiles_cm = [float(length) for length in np.percentile(lengths_cm, [10, 50, 90, 99])]
    covered_text = f"{100 * covered:.0f} % of all directions"
    reason = ""
    if percentiles_cm[2] < _SMALL_CM:
        reason = f"90 % of the steps are at most {percentiles_cm[2]:.1f} cm long, which images hardly show:"
        reason += " raise data.stride"
    elif is_known and covered < ENOUGH_DIRECTIONS:
        reason = f"they cover {covered_text}; {_describe_directions(mean, mean_length, moments, axes.T)}"
    negative, positive = ((sign * moves_cm >= _SHORT_CM).mean(axis=0) for sign in (-1, 1))
    gripper = float((np.abs(changes[:, POSE.gripper]) >= _GRIPPER).mean())
    axis_texts = (
        f"{100 * size_m:.1f} cm along {axis} ({100 * minus:.0f} % towards -{axis}, {100 * plus:.0f} % towards +{axis})"
        for axis, size_m, minus, plus in zip("xyz", usual[:3], negative, positive, strict=True)
    )
    lines = {}
    if is_known:
        lines["directions"] = (
            f"motions cover {covered_text} (below {100 * ENOUGH_DIRECTIONS:.0f} % planning is unreliable);"
            f" the mean direction has length {mean_length:.2f} (0: balanced, 1: all in the same direction)"
        )
    lines["axes"] = (
        f"{PERCENTILE} % of the steps move at most {', '.join(axis_texts)};"
        f" the gripper moves in {100 * gripper:.0f} % of the steps"
    )
    metrics = {
        "directions": covered,
        "mean_direction": mean_length,
        "length_cm_10_50_90_99": percentiles_cm,
        "gripper_share": gripper,
    }
    return Coverage(reason, moving_steps, usual, lines, metrics, density)


def compute_density(directions: Float[np.ndarray, "steps 3"]) -> Float[np.ndarray, "rows columns"]:
    """Return the density of steps in each direction, relative to the density of equally frequent directions.

    The density in a direction counts the steps within 30 degrees of it. The cells have equal areas: rows are equally
    spaced in z (-1 to 1), columns in azimuth (-180 to 180 degrees).
    """
    sampled = directions[:: -(-len(directions) // _MAX_STEPS) or 1].astype(np.float32)
    if not len(sampled):
        return np.zeros((_ROWS, _COLUMNS))
    height = (np.arange(_ROWS, dtype=np.float32)[:, None] + 0.5) / _ROWS * 2 - 1
    azimuth = ((np.arange(_COLUMNS, dtype=np.float32) + 0.5) / _COLUMNS * 2 - 1) * np.pi
    across = np.sqrt(1 - height**2)
    cells = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height + 0 * azimuth], axis=-1)
    min_cosine = np.cos(np.deg2rad(_NEAR_DEG))
    return np.asarray((cells @ sampled.T > min_cosine).mean(axis=-1) / ((1 - min_cosine) / 2), np.float64)


def _describe_directions(
    mean: Float[np.ndarray, " 3"], mean_length: float, moments: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "3 3"]
) -> str:
    """Describe the distribution of directions by the mean direction and the second moments along the principal axes."""
    if mean_length >= _SAME_DIRECTION:
        return f"nearly all point in the same direction, {_format_direction(mean / mean_length)}"
    if moments[2] >= _SAME_AXIS:
        return f"nearly all are along one axis, {_format_direction(axes[2])}"
    if moments[0] <= _SAME_PLANE:
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
    both_ways = np.flatnonzero((np.minimum(negative, positive) >= _OFTEN) & (usual >= _HARDLY)).tolist()
    still = np.flatnonzero(usual < _HARDLY).tolist()
    width = len(usual)
    num_one_way = width - len(both_ways) - len(still)
    has_low_diversity = len(both_ways) <= _HALF * width
    lines = {
        "numbers": f"{len(both_ways)} of {width} numbers increase and decrease, {len(still)} hardly change",
        "changes": f"{PERCENTILE} % of the steps change the numbers by at most"
        f" {', '.join(f'{change:.2g}' for change in usual)}",
    }
    reason = f"{len(still)} of {width} numbers hardly change, {num_one_way} change in one direction only"
    metrics = {"both_ways": both_ways, "still": still}
    return Coverage(reason if has_low_diversity else "", len(changes) // stride, usual, lines, metrics)
