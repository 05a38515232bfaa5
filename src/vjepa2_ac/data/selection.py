"""Selection of episodes: exclusion, broken episodes, outcomes, and the splits train, validation and test."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.index import EpisodeProblem, EpisodeTable, Labels, hash_identity
from vjepa2_ac.errors import InputError, counted

logger = logging.getLogger(__name__)

MAX_NAMED = 10  # largest number of identities in one message
_ALLOWED_BROKEN = 3  # broken episodes that are tolerated in all but the smallest data sets
_ALLOWED_SHARE = 0.01  # fraction of broken episodes that is tolerated in large data sets
SPLIT_LABEL = "split"  # label of an episode: the name of its split in the data set

_HELD_OUT: tuple[Split, ...] = ("validation", "test")
# How a split of a data set is used, by its name in lower case.
_ROLES: dict[str, Split] = {"val": "validation", "valid": "validation", "validation": "validation", "test": "test"}
_MIN_GROUPS = 3  # one per split; with fewer groups no episode is moved into an empty split

Members = Bool[np.ndarray, " episodes"]

# Patterns for DROID, whose identities contain .../LAB/success|failure/DATE/..., and for any data in folders.
IDENTITY_PATTERNS = {
    "lab": r"([^/]+)/(?:success|failure)/",
    "day": r"/(?:success|failure)/([0-9]{4}-[0-9]{2}-[0-9]{2})(?:/|$)",
    "folder": r"^(.+)/[^/]*$",
}


def select_included(table: EpisodeTable, config: DataConfig) -> Bool[np.ndarray, " episodes"]:
    """Return a mask of the episodes that are not in `data.exclude`.

    Raises:
        InputError: `data.exclude` contains an unknown identity.
    """
    excluded = frozenset(config.exclude)
    hashes = np.array([hash_identity(name) for name in excluded], np.uint64)
    candidates = np.flatnonzero(np.isin(table.id_hash, hashes)).tolist()
    names = {index: name for index in candidates if (name := table.identity(index)) in excluded}
    unknown = excluded.difference(names.values(), (problem.name for problem in table.problems))
    if unknown:
        needed = "identities of episodes" + (f", such as {table.identity(0)}" if len(table) else "")
        raise InputError(
            where="data.exclude", found=f"unknown episodes: {format_identities(sorted(unknown))}", needed=needed
        )
    is_selected = np.ones(len(table), bool)
    is_selected[list(names)] = False
    return is_selected


def select_outcome(table: EpisodeTable, config: DataConfig) -> Bool[np.ndarray, " episodes"]:
    """Return a mask of the episodes that have the outcome of `data.outcome`.

    Raises:
        InputError: The outcome of all episodes is unknown.
    """
    if config.outcome == "all":
        return np.ones(len(table), bool)
    if len(table) and (table.success < 0).all():
        problem = f"no episode of {config.path} has a success label"
        raise InputError(where=f"data.outcome: {config.outcome}", found=problem, fix="Set data.outcome: all")
    return np.asarray(table.success == (config.outcome == "success"))


def require_distinct(table: EpisodeTable, is_selected: Bool[np.ndarray, " episodes"], config: DataConfig) -> None:
    """Refuse two episodes with the same identity, because errors and `data.exclude` could not distinguish them.

    Raises:
        InputError: Two used episodes have the same identity.
    """
    members = np.flatnonzero(is_selected)
    hashes, counts = np.unique(table.id_hash[members], return_counts=True)
    indices: dict[str, int] = {}
    for index in members[np.isin(table.id_hash[members], hashes[counts > 1])].tolist():
        name = table.identity(index)
        if name in indices:
            problem = f"episodes {indices[name]} and {index} have the same identity: {name}"
            error = InputError(where=f"data.path: {config.path}", found=problem, fix=config.same_identity_fix)
            # If all episodes have this identity, excluding it would leave no episode.
            raise add_exclusion_fix(error, [name]) if hashes.size > 1 else error
        indices[name] = index


def max_broken(episodes: int) -> int:
    """Return the number of broken episodes that `data.broken_episodes: skip` tolerates.

    The limit is 3 episodes or 1 %, whichever is larger. With fewer than 6 episodes the limit is half of them, because a
    setting is probably wrong if most episodes cannot be read.
    """
    return max(min(_ALLOWED_BROKEN, episodes // 2), int(_ALLOWED_SHARE * episodes))


class BrokenEpisodes:
    """The broken episodes of an open data set, found while opening it or while reading clips.

    The list is in the process that opened the data set; loader workers report to this process. According to
    `data.broken_episodes` the first error is raised, or broken episodes are skipped until there are too many.

    Args:
        config: The data.
        episodes: Number of episodes, including broken ones.
        usable: The identity hashes of the episodes that are used for clips; None: unknown.
    """

    def __init__(self, config: DataConfig, episodes: int, usable: UInt64[np.ndarray, " usable"] | None = None) -> None:
        self._config, self._episodes, self._usable = config, episodes, usable
        self.reasons: dict[str, str] = {}  # by identity, in the order of discovery

    def __len__(self) -> int:
        return len(self.reasons)

    def record_problems(self, problems: Sequence[EpisodeProblem]) -> None:
        """Record problems that were found while the data set was opened or indexed.

        Raises:
            InputError: `data.broken_episodes` is error (raises the first problem), or too many episodes are broken.
        """
        if not problems:
            return
        names = [problem.name for problem in problems]
        if self._config.broken_episodes == "error":
            first, num_more = problems[0], len(problems) - 1
            more_problems = f"{counted(num_more, 'more episode')} cannot be used either. " if num_more else ""
            raise self.add_fix(replace(first, fix=more_problems + first.fix).error, names)
        logger.warning(
            "%s: %d of %d episodes are broken and skipped: %s. First error: %s",
            self._config.path, len(problems), self._episodes, format_identities(names), problems[0].error,
        )  # fmt: skip
        self._add({problem.name: str(problem.error) for problem in problems})

    def record(self, name: str, reason: str) -> None:
        """Record that a clip of an episode could not be read.

        Raises:
            InputError: Too many episodes are broken.
        """
        if name not in self.reasons:
            count = len(self) + 1
            logger.warning("Skipped a clip; %d of %d episodes are broken: %s", count, self._episodes, reason)
            self._add({name: reason})

    def restore(self, reasons: Mapping[str, str]) -> None:
        """Record broken episodes that the run found before it was resumed, or in other processes.

        Raises:
            InputError: Too many episodes are broken in total.
        """
        self._add({name: reason for name, reason in reasons.items() if name not in self._config.exclude})

    def add_fix(self, error: InputError, names: Sequence[str]) -> InputError:
        """Return an error about broken episodes whose fix names the config keys that would leave them out.

        The fix names `data.broken_episodes: skip` if the episodes are few enough, and `data.exclude` if other episodes
        remain.

        Args:
            error: The error of one or all of these episodes.
            names: The identities of all episodes that are known to be broken.
        """
        names = list(dict.fromkeys(names))
        hashes = np.array([hash_identity(name) for name in names], np.uint64)
        if self._usable is not None and np.isin(self._usable, hashes).all():  # no episode would remain
            return error
        is_skippable = len(names) <= max_broken(self._episodes) and self._config.broken_episodes == "error"
        return add_exclusion_fix(error, names, is_skippable=is_skippable)

    def _add(self, reasons: Mapping[str, str]) -> None:
        new_reasons = {name: reason for name, reason in reasons.items() if name not in self.reasons}
        self.reasons = {**self.reasons, **new_reasons}  # a new dict, because a checkpoint may be writing the old one
        if len(self) <= (allowed := max_broken(self._episodes)):
            return
        name, reason = next(iter(self.reasons.items()))
        problem = f"{len(self)} of {self._episodes} episodes are broken. The first, {name}: {reason.rstrip('.')}"
        needed, fix = f"at most {allowed} with data.broken_episodes: skip", "Repair or fetch them again"
        error = InputError(where=f"data.path: {self._config.path}", found=problem, needed=needed, fix=fix)
        raise self.add_fix(error, tuple(self.reasons))


def add_exclusion_fix(error: InputError, names: Sequence[str], *, is_skippable: bool = False) -> InputError:
    """Return an error about some episodes whose fix also shows how to exclude them.

    Args:
        error: The error.
        names: The identities of the episodes, all different; the fix lists at most ten, and the total number.
        is_skippable: Whether `data.broken_episodes: skip` would leave them out.
    """
    fix = f"{error.fix.rstrip('.')}. " if error.fix else ""
    listing = json.dumps(names[:MAX_NAMED], ensure_ascii=False)
    excerpt = f" (the first {MAX_NAMED} of {len(names)})" if len(names) > MAX_NAMED else ""
    skip = "set data.broken_episodes: skip, or " if is_skippable else ""
    fix = f"{fix}To leave {'it' if len(names) == 1 else 'them'} out, {skip}add{excerpt} to data.exclude: {listing}"
    return InputError(where=error.where, found=error.found, needed=error.needed, fix=fix)


def format_identities(ids: Sequence[str], count: int | None = None) -> str:
    """Return identities for a message: the first ten, and the number of the rest (of `count` in total)."""
    num_more = (len(ids) if count is None else count) - MAX_NAMED
    return ", ".join(ids[:MAX_NAMED]) + (f" and {num_more} more" if num_more > 0 else "")


# ---- splits ----


def map_split_roles(names: Iterable[str]) -> dict[str, Split]:
    """Map the name of each split of a data set to its use in this package: train, validation or test.

    An unknown name counts as train. The result is empty unless the data set has both a training split and a held-out
    split.
    """
    roles = {name: _ROLES.get(name.lower(), "train") for name in names}
    return roles if "train" in roles.values() and len(set(roles.values())) > 1 else {}


def add_split_labels(table: EpisodeTable, names: Sequence[str | None]) -> EpisodeTable:
    """Add the name of each episode's split in the data set as a label, if the data set has several splits."""
    labels = Labels.from_names(names)
    return table if len(labels.names) < 2 else replace(table, labels={**table.labels, SPLIT_LABEL: labels})


def held_out_splits(table: EpisodeTable, config: DataConfig) -> dict[Split, Members]:
    """Return the masks of the data set's own validation and test splits, if it has them and `data.splits` uses them."""
    labels = table.labels.get(SPLIT_LABEL)
    if labels is None or config.splits == "hash":
        return {}
    roles = map_split_roles(labels.names)
    masks = {
        split: np.isin(labels.number, [index for index, name in enumerate(labels.names) if roles.get(name) == split])
        for split in _HELD_OUT
    }
    return {split: mask for split, mask in masks.items() if split in roles.values()}


def describe_splits(table: EpisodeTable, config: DataConfig) -> str:
    """Describe how the data set's own splits are used; return an empty text if it has only one split."""
    labels = table.labels.get(SPLIT_LABEL)
    if labels is None:
        return ""
    counts = np.bincount(labels.number[labels.number >= 0], minlength=len(labels.names)).tolist()
    listing = [f"{name} ({counted(count, 'episode')})" for name, count in zip(labels.names, counts, strict=True)]
    if not (held_out := held_out_splits(table, config)):
        reason = (
            "data.splits is hash" if config.splits == "hash" else "they do not include both train and a held-out split"
        )
        return f"drawn by hash; the data set's own splits are not used because {reason}: {', '.join(listing)}"
    roles = zip(listing, map_split_roles(labels.names).items(), strict=True)
    used = ", ".join(text if name == role else f"{text} as {role}" for text, (name, role) in roles)
    drawn = next((f"; {split} is drawn from train by hash" for split in _HELD_OUT if split not in held_out), "")
    return f"the data set's own: {used}{drawn}"


def select_split(
    table: EpisodeTable, split_hash: UInt64[np.ndarray, " episodes"], config: DataConfig, split: Split, among: Members
) -> Members:
    """Return a mask of the episodes of a split: the data set's own split, or drawn by `draw_split`.

    Args:
        table: The episodes, with the names of the data set's own splits.
        split_hash: As for `draw_split`.
        config: `data.splits` and the shares; the share of a split that the data set has is not used.
        split: The split.
        among: As for `draw_split`.
    """
    held_out = held_out_splits(table, config)
    if split in held_out:
        return np.asarray(among & held_out[split])
    shares = {f"{split_name}_share": 0.0 for split_name in held_out}
    remaining = among & ~np.any([*held_out.values()], axis=0) if held_out else among
    return draw_split(split_hash, config.model_copy(update=shares), split, remaining)


def draw_split(
    split_hash: UInt64[np.ndarray, " episodes"],
    config: DataConfig,
    split: Split,
    among: Bool[np.ndarray, " episodes"] | None = None,
) -> Bool[np.ndarray, " episodes"]:
    """Return a mask of the episodes that belong to a split.

    The hash, as a number in [0, 1), is compared with the shares. If validation or test would be empty although its
    share is above 0, which may happen with few episodes, the episode with the next larger hash is assigned to it.

    Args:
        split_hash: Hash of each episode's identity; with `data.split_by`, of the name of its group.
        config: The shares.
        split: The split.
        among: Mask of the episodes to split; None: all. With few episodes the split of an episode depends on the
            other episodes, so the mask includes broken and excluded episodes, and stays the same throughout a run.
    """
    number = split_hash.astype(np.float64) / 2**64
    among = np.ones(len(number), bool) if among is None else among
    test, held_out = _compute_bounds(np.unique(number[among]), config)
    low, high = {"test": (0.0, test), "validation": (test, held_out), "train": (held_out, 2.0)}[split]
    return np.asarray(among & (number >= low) & (number < high))


def _compute_bounds(groups: Float[np.ndarray, " groups"], config: DataConfig) -> tuple[float, float]:
    """Return two bounds: groups below the first bound are test, and groups between the bounds are validation.

    `groups` holds the numbers of all groups, sorted.
    """
    test, held_out = config.test_share, config.test_share + config.validation_share
    if len(groups) < _MIN_GROUPS:
        return test, held_out
    if config.test_share > 0 and not (groups < test).any():
        test = float(np.nextafter(groups[0], 2.0))
    held_out = max(test, held_out)
    remaining = groups[groups >= test]
    if config.validation_share > 0 and len(remaining) > 1 and not (remaining < held_out).any():
        held_out = float(np.nextafter(remaining[0], 2.0))
    return test, held_out


def hash_groups(
    table: EpisodeTable, is_selected: Bool[np.ndarray, " episodes"], config: DataConfig
) -> UInt64[np.ndarray, " episodes"] | None:
    """Return the hash of each episode's group (`data.split_by`), which determines its split; None without groups.

    Args:
        table: The episodes.
        is_selected: Mask of the used episodes; other episodes without a group get the hash of an arbitrary group.
        config: `data.split_by`.

    Raises:
        InputError: There is no such field, a used episode has no value of the field, or the pattern does not match the
            identity of a used episode.
    """
    split_by = config.split_by
    if split_by is None:
        return None
    groups = _get_groups(table, split_by)
    ungrouped = [table.identity(index) for index in np.flatnonzero(is_selected).tolist() if not groups[index]]
    if ungrouped:
        from_source = split_by in table.labels
        reason = "the data set has no value for" if from_source else "the pattern does not match the identities of"
        alternative = "choose another field" if from_source else "choose a pattern that fits every identity"
        problem = (
            f"{reason} {len(ungrouped)} of {counted(is_selected.sum(), 'episode')}: {format_identities(ungrouped)}"
        )
        fix = f"Exclude these with data.exclude, or {alternative}"
        raise InputError(where=f"data.split_by: {split_by}", found=problem, fix=fix)
    hashes = {group: hash_identity(group) for group in groups if group}
    any_hash = next(iter(hashes.values()), 0)
    return np.array([hashes[group] if group else any_hash for group in groups], np.uint64)


def _get_groups(table: EpisodeTable, split_by: str) -> list[str | None]:
    if labels := table.labels.get(split_by):
        return [labels.name_at(index) for index in range(len(table))]
    identities = [table.identity(index) for index in range(len(table))]
    if split_by not in IDENTITY_PATTERNS and re.fullmatch(r"[A-Za-z_]+", split_by):
        fields = ", ".join(table.labels) or "no fields"
        example = f", such as {identities[0]}" if identities else ""
        problem = f"unknown field. This data set has {fields}; built-in patterns are {', '.join(IDENTITY_PATTERNS)}"
        needed = f"a field, a built-in pattern, or a regular expression with one group for the identity{example}"
        raise InputError(where=f"data.split_by: {split_by}", found=problem, needed=needed)
    search = re.compile(IDENTITY_PATTERNS.get(split_by, split_by)).search
    return [match.group(1) if (match := search(identity)) else None for identity in identities]
