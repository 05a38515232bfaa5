"""The data set of a run: its selected episodes and steps, opened once and pickled to every loader worker."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from jaxtyping import Bool, Int, UInt8, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.files import num_connections
from vjepa2_ac.data.idle import find_ranges
from vjepa2_ac.data.index import EpisodeTable, StepSelection
from vjepa2_ac.data.selection import (
    BrokenEpisodes,
    add_exclusion_fix,
    hash_groups,
    held_out_splits,
    require_distinct,
    select_included,
    select_outcome,
    select_split,
)
from vjepa2_ac.data.sources.indexed_source import get_spaces, open_source
from vjepa2_ac.data.windows import Windows, draw_uniform, find_clip_windows, require_stride, select_split_windows
from vjepa2_ac.episode import POSE_WIDTHS, Batch, Clip, Episode, EpisodeSource, Progress, StepRanges, Widths
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.spaces import Spaces

if TYPE_CHECKING:  # PyTorch is imported when clips are read
    from vjepa2_ac.data.clips import ClipDataset, ClipRequest

logger = logging.getLogger(__name__)

_MAX_EPISODES_READ = 8  # episodes to try in order to determine the widths


@dataclass(frozen=True)
class Removed:
    """The episodes, steps and clips that a filter removed from the result of the previous filters."""

    name: str  # name of the filter: excluded, broken, outcome or idle
    episodes: int  # number of episodes without remaining steps
    steps: int  # number of steps, without those of episodes that cannot be read
    windows: int | None  # number of clips; None while data.stride is auto

    def __str__(self) -> str:
        clips = "" if self.windows is None else f", {counted(self.windows, 'clip')}"
        return f"{counted(self.episodes, 'episode')}, {counted(self.steps, 'step')}{clips}"


@dataclass(frozen=True, eq=False)
class Dataset:
    """An open data set: its episodes, and the steps that the config selects. It can be pickled to a loader worker."""

    config: DataConfig
    source: EpisodeSource  # a LatentSource if the data are a latent cache
    table: EpisodeTable
    selected_steps: StepSelection
    broken: BrokenEpisodes  # broken episodes are recorded in the process that opened the data set
    groups: UInt64[np.ndarray, " episodes"] | None = None  # hash of each episode's group; None without `data.split_by`

    @cached_property
    def is_selected(self) -> Bool[np.ndarray, " episodes"]:
        """A mask of the episodes that are used; the idle filter may still remove all steps of such an episode."""
        selected = np.asarray(select_included(self.table, self.config) & select_outcome(self.table, self.config))
        selected[[index for index, _ in self.selected_steps.problems]] = False
        return selected

    @property
    def split_hash(self) -> UInt64[np.ndarray, " episodes"]:
        """The hash that determines the split of each episode."""
        return self.table.id_hash if self.groups is None else self.groups

    def split_mask(self, split: Split) -> Bool[np.ndarray, " episodes"]:
        """Return a mask of the episodes that are used and belong to a split."""
        among = select_outcome(self.table, self.config)
        return np.asarray(self.is_selected & select_split(self.table, self.split_hash, self.config, split, among))

    def clips(self, split: Split = "train") -> ClipDataset:
        """Return the clips of a split as a `torch.utils.data.Dataset`.

        The order is fixed: clips are sorted by the identity of their episode and then by their first control step,
        independent of the seed. With several cameras a hash of the clip selects the camera. `data.transforms` are not
        applied, because they depend on the position of a clip in a training run.

        Returns:
            `len(clips)` clips; `clips[i]` is an `episode.Clip` of `frames` (time x height x width x 3, uint8, RGB,
            cropped; None for a latent cache, which has `latents`), `states` (time x 7: metres, radians, gripper
            position) and `actions` (time-1 x 7), float32. A DataLoader collates clips to an `episode.Batch` of tensors.
            It may shuffle and use any number of workers; for data behind a URL the workers must not be forked.

        Raises:
            InputError: There is no such split, it has no clips, or `data.stride` is auto. `clips[i]` raises the error
                if the clip cannot be read, independent of `data.broken_episodes`. In workers it is a RuntimeError.

        Example:
            >>> loader = torch.utils.data.DataLoader(dataset.clips("train"), batch_size=8, shuffle=True, num_workers=4)
            >>> latents = encode(model, next(iter(loader))).latents
        """
        from vjepa2_ac.data.clips import ClipDataset

        windows = self.windows(split)
        return ClipDataset(partial(_read_window, self, windows), len(windows), num_connections(self.config))

    def clip_request(self, window: tuple[int, int]) -> ClipRequest:
        """Return the request for the clip of a window (episode, first control step); a hash selects its camera."""
        from vjepa2_ac.data.clips import ClipRequest

        episode, start = window
        fraction = draw_uniform(int(~self.table.id_hash[episode]), start)
        return ClipRequest(episode, start, self.config.cameras[int(fraction * len(self.config.cameras))])

    def windows(self, split: Split) -> Windows:
        """Return the windows of a split, one per clip, in the fixed order of `clips`.

        Raises:
            InputError: There is no such split, it has no clips, or `data.stride` is auto.
        """
        if split not in get_args(Split):
            raise InputError(where="split", found=repr(split), needed=", ".join(get_args(Split)))
        require_stride(self.config, to="read clips", fix="Pass a stride: open_dataset(config, stride=4)")
        members = self.split_mask(split)
        if not members.any():
            raise self._empty_split_error(split)
        return select_split_windows(self.table, members, self.starts, self.config, split)

    def _empty_split_error(self, split: Split) -> InputError:
        config, is_selected = self.config, self.is_selected
        num_groups = len(np.unique(self.split_hash[is_selected]))
        grouping = "" if config.split_by is None else f" in {num_groups} groups (data.split_by)"
        shares = f"validation_share {config.validation_share:g}, test_share {config.test_share:g}"
        fix = "Lower data.validation_share or data.test_share" if split == "train" else f"Raise data.{split}_share"
        if split in held_out_splits(self.table, config):
            fix = "Set data.splits: hash to draw the splits from all episodes"
        problem = f"no {split} episodes among {is_selected.sum()}{grouping} ({shares})"
        return InputError(where=f"data.path: {config.path}", found=problem, fix=fix)

    def with_frames(self, frames: int) -> Dataset:
        """Return the data set with clips of another length. A latent cache must have the frames of these clips."""
        return replace(self, config=self.config.model_copy(update={"frames": frames}))

    def with_stride(self, stride: int) -> Dataset:
        """Return the data set with another stride.

        Raises:
            InputError: The data are a latent cache, which has the frames of one stride only.
        """
        if self.config.is_cache and stride != self.config.stride:
            problem = f"latents for clips at stride {self.config.stride}, not {stride}"
            fix = "Use the data set itself, with data.cache: off"
            raise InputError(where=self.config.path, found=problem, fix=fix)
        return replace(self, config=self.config.with_stride(stride))

    @cached_property
    def removed(self) -> tuple[Removed, ...]:
        """The parts that the filters removed, in the order of the filters."""
        not_excluded = select_included(self.table, self.config)
        selected = not_excluded & select_outcome(self.table, self.config)
        masks = np.ones(len(self.table), bool), not_excluded, selected, self.is_selected
        remaining = [self._count(StepSelection.all_steps(self.table, mask)) for mask in masks]
        removed = -np.diff([*remaining, self._count(self.selected_steps)], axis=0)
        excluded = sum(problem.name in self.config.exclude for problem in self.table.problems)
        unusable = {"excluded": excluded, "outcome": 0, "broken": len(self.table.problems) - excluded, "idle": 0}
        has_stride = self.config.stride != "auto"
        return tuple(
            Removed(name, episodes + unusable[name], steps, windows if has_stride else None)
            for name, (episodes, steps, windows) in zip(unusable, removed.tolist(), strict=True)
        )

    def _count(self, steps: StepSelection) -> tuple[int, int, int]:
        """Return the numbers of episodes, steps and windows (0 while `data.stride` is auto)."""
        has_stride = self.config.stride != "auto"
        windows = len(find_clip_windows(self.table, steps, self.config)) if has_stride else 0
        return len(np.unique(steps.episode)), steps.num_steps, windows

    @property
    def episodes(self) -> Int[np.ndarray, " episodes"]:
        """The indices of the episodes that clips may come from."""
        return np.unique(self.selected_steps.episode)

    @cached_property
    def starts(self) -> Windows:
        """The windows of the clips of all splits.

        Raises:
            ValueError: `data.stride` is auto.
        """
        return find_clip_windows(self.table, self.selected_steps, self.config)

    @cached_property
    def control_rate_hz(self) -> float:
        """Control steps per second of the data set, or of its first episode if the source does not provide it."""
        rate = self.table.texts.get("control_rate_hz")
        return float(rate) if rate is not None else self.source.read(int(self.episodes[0])).control_rate_hz

    @cached_property
    def spaces(self) -> Spaces:
        """The spaces of states and actions."""
        return get_spaces(self.config, self.widths)

    @cached_property
    def widths(self) -> Widths:
        """How many numbers a state and an action have: 7 for poses, otherwise as in the first readable episode.

        Raises:
            InputError: The first episodes cannot be read.
        """
        if self.config.states == "pose":
            return POSE_WIDTHS
        if widths := self.table.texts.get("widths"):
            return Widths(*map(int, widths.split()))
        for episode in self.episodes[:_MAX_EPISODES_READ].tolist():
            with suppress(InputError):
                return get_widths(self.source.read(episode))
        return get_widths(self.source.read(int(self.episodes[0])))

    def skip_episode(self, episode: int, error: InputError) -> None:
        """Apply `data.broken_episodes` to an episode that cannot be read: record the episode, or raise the error.

        Raises:
            InputError: `data.broken_episodes` is error, or too many episodes are broken.
        """
        name = self.table.identity(episode)
        if self.config.broken_episodes == "error":
            raise self.broken.add_fix(error, [name]) from None
        self.broken.record(name, str(error))

    def read(self, episode: int, camera: str | None = None) -> Episode:
        """Return an episode; frames are only read by `Episode.read_frames`.

        Raises:
            InputError: The episode cannot be read, or its states or actions have other widths than the data set.
        """
        recording = self.source.read(episode, camera, self.needed_steps(episode))
        require_widths(recording, self.widths)
        return recording

    def needed_steps(self, episode: int) -> StepRanges | None:
        """Return the steps of an episode that clips may come from; None: all of them."""
        return None if self.config.idle.rule == "none" else self.selected_steps.ranges_of(episode)


def open_dataset(config: DataConfig, *, progress: Progress | None = None) -> Dataset:
    """Open a data set and select its episodes and steps.

    Args:
        config: The data set and its filters.
        progress: Called with (done, total) while the data set is indexed for the first time.

    Raises:
        InputError: There is no such data set; an episode is broken and `data.broken_episodes` does not skip it, or too
            many are broken; two episodes have the same identity; a filter or `data.split_by` cannot be applied; or no
            episode remains.
    """
    source: Any = open_source(config)
    table = EpisodeTable.from_infos(source.infos(progress))
    selected = select_included(table, config)
    require_distinct(table, selected, config)
    selected &= select_outcome(table, config)
    broken = BrokenEpisodes(config, len(table) + len(table.problems), table.id_hash[selected])
    broken.record_problems([problem for problem in table.problems if problem.name not in config.exclude])
    steps = StepSelection.all_steps(table, selected)
    if config.idle.rule != "none":
        ranges = source.read_selected_steps() if config.is_cache else find_ranges(source, table, config, progress)
        broken.record_problems([problem for index, problem in ranges.problems if selected[index]])
        steps = ranges.select_episodes(selected)
    dataset = Dataset(config, source, table, steps, broken)
    dataset = replace(dataset, groups=hash_groups(table, dataset.is_selected, config))
    if not len(dataset.episodes):
        filters = ", ".join(f"{removal.name} {removal.episodes}" for removal in dataset.removed if removal.episodes)
        removed = f" (removed: {filters})" if filters else ""
        problem = f"none of {counted(len(table) + len(table.problems), 'episode')} remains{removed}"
        fix = "Check data.exclude, data.outcome and data.idle" if filters else ""
        raise InputError(where=f"data.path: {config.path}", found=problem, fix=fix)
    logger.info("%s: using %d episodes with %d steps", config.path, dataset.is_selected.sum(), steps.num_steps)
    return _resolve_cameras(dataset)


def open_cached_latents(dataset: Dataset, folder: Path | str) -> Dataset:
    """Return the data set with the same clips in the same order, but read from its latent cache.

    Raises:
        InputError: The cache lacks episodes or is damaged.
    """
    config = dataset.config.with_source("latents", path=str(folder), cache="off", camera=dataset.config.cameras)
    source = open_source(config)
    # The labels are copied, because caches of older versions lack the labels of splits.
    table = replace(EpisodeTable.from_infos(source.infos()), labels=dataset.table.labels)
    return _resolve_cameras(replace(dataset, source=source, table=table, config=config))


def _resolve_cameras(dataset: Dataset) -> Dataset:
    """Check that a latent cache has the files of all clips, and set its cameras in the config."""
    source: Any = dataset.source
    return (
        replace(dataset, config=source.resolve_cameras(dataset.starts.episode)) if dataset.config.is_cache else dataset
    )


def read_clip(dataset: Dataset, request: ClipRequest) -> Clip:
    """Return a clip, decoding only the frames of the clip.

    Raises:
        InputError: The episode or one of the frames cannot be read. The fix of the error does not exclude the episode.
    """
    from vjepa2_ac.data.clips import cut_clip

    return cut_clip(dataset.read(request.episode, request.camera), request, dataset.config)


def _read_window(dataset: Dataset, windows: Windows, index: int) -> Clip:
    request = dataset.clip_request(windows[index])
    try:
        return read_clip(dataset, request)
    except InputError as error:
        raise add_exclusion_fix(error, [dataset.table.identity(request.episode)]) from None


def frames_for_display(dataset: Dataset, batch: Batch, row: int) -> UInt8[np.ndarray, "time height width 3"]:
    """Return the cropped frames of a clip in a batch, for display; a latent cache has only small frames.

    Raises:
        InputError: The frames of a cache cannot be read.
        ValueError: The clip belongs to another data set.
    """
    from vjepa2_ac.data.transforms import crop_frames

    if batch.frames is not None:
        return batch.frames[row].numpy()
    episode, start = dataset.table.find(batch.episode_ids[row]), batch.starts[row]
    if episode is None:
        raise ValueError(f"no episode {batch.episode_ids[row]}")
    steps = range(start, start + dataset.config.clip_steps, dataset.config.model_stride)
    return crop_frames(dataset.source.read(episode, batch.cameras[row]).read_frames(steps), dataset.config.crop)


def find_episode(dataset: Dataset, name: str) -> int:
    """Return the index of an episode by its identity, its number from 0, or a unique part of its identity.

    Raises:
        InputError: No episode matches, or several match.
    """
    table = dataset.table
    if (index := table.find(name)) is not None:
        return index
    if name.isdecimal() and len(name) < 10 and int(name) < len(table):
        return int(name)
    matching = [int(index) for index in dataset.episodes if name in table.identity(int(index))]
    if len(matching) != 1:
        problem = f"{counted(len(matching), 'episode')} with this name in {dataset.config.path}"
        example = table.identity((matching or dataset.episodes.tolist())[0])
        needed = f"an identity such as {example}, a unique part of an identity, or an index from 0 to {len(table) - 1}"
        raise InputError(where=f"--episode {name}", found=problem, needed=needed)
    return matching[0]


def get_widths(episode: Episode) -> Widths:
    """Return how many numbers the states and the actions of an episode have."""
    state = int(episode.states.shape[1])
    return Widths(state, state if episode.commands is None else int(episode.commands.shape[1]))


def require_widths(episode: Episode, widths: Widths) -> None:
    """Refuse an episode whose widths differ from those of the data set.

    Raises:
        InputError: The widths differ.
    """
    actual = get_widths(episode)
    if actual != widths:
        problem = f"states of {actual.state} and actions of {actual.action} numbers"
        needed = f"{widths.state} and {widths.action}, as in the other episodes"
        fix = "Keep the recordings of different robots in separate data sets"
        raise InputError(where=f"episode {episode.info.id}", found=problem, needed=needed, fix=fix)
