"""Find the steps in which the robot moves, by a rule or from a published list, and cache the result on disk."""

from __future__ import annotations

import logging
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig, IdleConfig
from vjepa2_ac.data.files import map_in_threads, num_connections
from vjepa2_ac.data.index import (
    EpisodeProblem,
    EpisodeTable,
    StepSelection,
    compute_fingerprint,
    get_or_build,
    hash_key,
)
from vjepa2_ac.episode import Episode, EpisodeSource, Progress, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.spaces import POSE, rotation_angles
from vjepa2_ac.storage.structured import read_json_object, short_repr

logger = logging.getLogger(__name__)

_MAX_BYTES = 1 << 28  # size limit of a published list
_NUM_TRIED = 10  # if all of the first ten episodes are broken, a setting is probably wrong, so an error is raised

RangesOrProblem = list[tuple[int, int]] | EpisodeProblem


def find_ranges(
    source: EpisodeSource, table: EpisodeTable, config: DataConfig, progress: Progress | None
) -> StepSelection:
    """Return the ranges of steps that `data.idle.rule` keeps, also for episodes that other filters remove.

    Raises:
        InputError: The list of ranges cannot be read or belongs to another data set, or the rule cannot be applied to
            any of the first episodes.
    """
    values = {"idle": config.idle.model_dump(mode="json"), **config.format_values}
    parts: dict[str, object] = {"found": "idle ranges", "table": compute_fingerprint(table), "data": values}
    make = partial(_compute_ranges, source, table, config, progress or no_progress)
    if config.idle.rule == "published":
        path = str(config.idle.ranges)
        make = partial(read_published_ranges, path, table)
        with storage.translate_read_errors(path):
            parts["list"] = [storage.canonical_path(path), storage.file_size(path), storage.file_version(path)]
    return get_or_build(config.disk_cache, hash_key(parts), make, StepSelection)


def _compute_ranges(
    source: EpisodeSource, table: EpisodeTable, config: DataConfig, progress: Progress
) -> StepSelection:
    def find_ranges_at(index: int) -> RangesOrProblem:
        try:
            return find_selected_ranges(source.read(index), config.idle)
        except InputError as error:
            return EpisodeProblem.from_error(error, table.identity(index))

    results: list[RangesOrProblem] = []
    for result in map_in_threads(find_ranges_at, range(len(table)), num_connections(config)):
        results.append(result)
        progress(len(results), len(table))
        if len(results) == min(_NUM_TRIED, len(table)):
            problems = [problem for problem in results if isinstance(problem, EpisodeProblem)]
            if len(problems) == len(results):
                raise problems[0].error
    return StepSelection.from_ranges(results)


def read_published_ranges(path: str, table: EpisodeTable) -> StepSelection:
    """Read the ranges of all episodes from a published list; see `data.idle.ranges`.

    Raises:
        InputError: The list cannot be read, contains none of the episodes, or has invalid ranges.
    """
    where = f"data.idle.ranges: {path}"
    needed = 'a JSON object {"identity of an episode": [[start, end], ...], ...}'
    fix = "Use the list for this version of the data set, or set data.idle.rule: commands or motion"
    ranges_by_identity = read_json_object(path, max_bytes=_MAX_BYTES, needed=needed)
    names = [table.identity(index) for index in range(len(table))]
    num_listed = sum(name in ranges_by_identity for name in names)
    if not num_listed:
        first = next(iter(ranges_by_identity), "missing")
        problem = (
            f"the list has none of the {counted(len(table), 'episode')} of the data set. Its first entry is {first}"
        )
        needed = "the identities of the episodes" + (f", such as {names[0]}" if names else "")
        raise InputError(where=where, found=problem, needed=needed, fix=fix)
    ranges: list[RangesOrProblem] = []
    for name, steps in zip(names, table.num_steps.tolist(), strict=True):
        pairs = _parse_ranges(ranges_by_identity.get(name, []), steps)
        if pairs is None:
            needed = f"pairs [start, end) of steps from 0 to {steps}, the episode's length, that do not overlap"
            raise InputError(
                where=f"{where}: {name}", found=short_repr(ranges_by_identity[name]), needed=needed, fix=fix
            )
        ranges.append(pairs)
    logger.log(
        logging.INFO if num_listed == len(table) else logging.WARNING,
        "%s: lists %d of the %d episodes; the other %d are treated as idle",
        path, num_listed, len(table), len(table) - num_listed,
    )  # fmt: skip
    return StepSelection.from_ranges(ranges)


def _parse_ranges(ranges: object, steps: int) -> list[tuple[int, int]] | None:
    """Return the ranges of one episode in order; None if they overlap or are not pairs of steps of the episode."""
    try:
        pairs = sorted((start, end) for start, end in ranges)  # type: ignore[attr-defined] # see the except clause
        edges = [edge for pair in pairs for edge in pair]
        are_steps = all(type(edge) is int and 0 <= edge <= steps for edge in edges)
    except (TypeError, ValueError):
        return None
    return pairs if are_steps and edges == sorted(edges) and all(start < end for start, end in pairs) else None


def find_selected_ranges(episode: Episode, config: IdleConfig) -> list[tuple[int, int]]:
    """Return the ranges [start, end) of an episode's steps that the rule `commands` or `motion` keeps.

    Raises:
        InputError: The rule is `commands` and the joint velocities are missing or not finite.
    """
    if config.rule == "motion":
        return find_moving_ranges(find_idle_by_motion(episode.states, config), config)
    where, velocities = f"episode {episode.info.id}", episode.joint_velocities
    if velocities is None:
        fix = "Set data.idle.rule: motion, which needs only poses, or set the key for the feature with the velocities"
        raise InputError(where=where, found="no commanded joint velocities", fix=fix)
    if not np.isfinite(velocities).all():
        raise InputError(where=where, found="a joint velocity that is not finite", needed="finite numbers")
    return find_moving_ranges(find_idle_by_commands(velocities, config), config)


def find_idle_by_commands(
    velocities: Float[np.ndarray, "steps joints"], config: IdleConfig
) -> Bool[np.ndarray, " steps"]:
    """Return a mask of the steps at which no commanded joint velocity changes; False at the first step.

    Source: Physical-Intelligence/openpi @ 15a9616, examples/droid/compute_droid_nonidle_ranges.py.
    """
    is_still = (abs(np.diff(velocities, axis=0)) < config.velocity_change_rad_s).all(axis=1)
    return np.concatenate([np.zeros(min(1, len(velocities)), bool), is_still])


def find_idle_by_motion(states: Float[np.ndarray, "steps 7"], config: IdleConfig) -> Bool[np.ndarray, " steps"]:
    """Return a mask of the steps at which the measured pose changes less than the thresholds; False at the first."""
    if len(states) < 2:
        return np.zeros(len(states), bool)
    motion = POSE.compute_differences(states.astype(np.float64))
    is_still = (
        (np.linalg.norm(motion[:, POSE.position], axis=1) < config.translation_m)
        & (rotation_angles(motion[:, POSE.rotation]) < config.rotation_rad)
        & (abs(motion[:, POSE.gripper]) < config.gripper)
    )
    return np.concatenate([[False], is_still])


def find_long_idle(idle: Bool[np.ndarray, " steps"], config: IdleConfig) -> Bool[np.ndarray, " steps"]:
    """Return a mask of the steps in idle runs of at least `data.idle.shortest_idle_steps` steps."""
    is_long = np.zeros(len(idle), bool)
    for start, end in find_runs(idle):
        is_long[start:end] = end - start >= config.shortest_idle_steps
    return is_long


def find_moving_ranges(idle: Bool[np.ndarray, " steps"], config: IdleConfig) -> list[tuple[int, int]]:
    """Return the ranges that remain without long idle runs, then without short ranges and the last steps of each range.

    Source: Physical-Intelligence/openpi @ 15a9616, examples/droid/compute_droid_nonidle_ranges.py.
    """
    moving_runs, cut = find_runs(~find_long_idle(idle, config)), config.cut_last_steps
    ranges = [(start, end) for start, end in moving_runs if end - start >= config.shortest_kept_steps]
    return [(start, end - cut) for start, end in ranges if end - cut > start]


def find_runs(mask: Bool[np.ndarray, " steps"]) -> list[tuple[int, int]]:
    """Return the ranges [start, end) of consecutive steps at which a mask is true."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))
