"""Goals from one demonstration, an episode or a film: key frames with durations, gripper, energies and noise floor."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from vjepa2_ac import __version__
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.windows import require_frames, spread_with_ends
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.episode import FrameReader, Progress, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.goals.key_frames import (
    KeyFrame,
    StillRule,
    Timing,
    every_key_frame,
    gripper_key_frames,
    latent_key_frames,
    resting,
    resting_pairs,
    sub_goals_of,
)
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.media.video import read_frames, read_header
from vjepa2_ac.planning.cameras import read_views, require_views
from vjepa2_ac.planning.energy import distance
from vjepa2_ac.planning.goals import NoiseFloor, SubGoal, write_goals
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.storage import user_can_write, write_atomically
from vjepa2_ac.storage.structured import utc_now

By = Literal["gripper", "latent", "every"]

_MOST_ENCODED = 600  # frames of a demonstration; of a longer one every second, third ...
_APART = 4  # model steps from one goal to the next, by latents
_AT_ONCE = 16  # frames that are read and encoded together
_MOST_PAIRS = 64
_LONGEST_LABEL = 120  # letters, in the name of a file
_UPPER = 0.95  # quantile of the energies between resting frames that is their floor


@dataclass(frozen=True, eq=False)
class Recording:
    """A demonstration. A frame is a control step of an episode, or a frame of a film.

    Raises:
        InputError: It has one frame.
    """

    name: str
    frames: int
    read: FrameReader  # of frames at these positions
    states: Float[np.ndarray, "frames 7"] | None  # None: nothing was measured, or the states are no poses
    origin: Mapping[str, Any]  # where it comes from, as plain values

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise InputError(where=self.name, found=f"{self.frames} frames", needed="2 at least")


def recording_of_episode(
    config: DataConfig, wanted: str, progress: Progress | None = None, *, views: int = 1
) -> Recording:
    """Return an episode of a data set.

    Args:
        config: The data set, and which camera, or cameras.
        wanted: The episode's name in the data, or its number among the episodes, from 0.
        progress: Called with (done, total) while the data set is indexed for the first time.
        views: How many of the cameras are seen side by side, from the first on.

    Raises:
        InputError: There is no such episode, it cannot be read, the data are latents without frames, or there are not
            as many cameras.
    """
    require_views(config, views)
    dataset = open_dataset(config, progress=progress)
    return recording_of(dataset, number_of_episode(dataset, wanted), views)


def recording_of(dataset: Dataset, index: int, views: int = 1) -> Recording:
    """Return an episode of an open data set, with so many of its cameras side by side.

    Raises:
        InputError: It cannot be read.
    """
    config, name = dataset.config, dataset.table.identity(index)
    episode = dataset.source.read(index, config.cameras[0])
    origin = {"data": config.path, "episode": name, "camera": config.camera}
    states = episode.states if config.states == "pose" else None
    return Recording(name, len(episode.states), partial(read_views, dataset, index, views), states, origin)


def number_of_episode(dataset: Dataset, wanted: str) -> int:
    """Return which episode of a data set is meant by its name, or by its number, from 0.

    Raises:
        InputError: There is no such episode.
    """
    table, index = dataset.table, dataset.table.find(wanted)
    if index is None and wanted.isdecimal() and len(wanted) < 10 and int(wanted) < len(table):
        index = int(wanted)
    if index is None:
        found = f"no such episode in {dataset.config.path}"
        needed = f"a name such as {table.identity(int(dataset.episodes[0]))}, or a number from 0 to {len(table) - 1}"
        raise InputError(where=f"--episode {wanted}", found=found, needed=needed)
    return index


def frame_of_episode(config: DataConfig, place: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return the image at EPISODE:STEP of a data set, or the last one of EPISODE.

    Raises:
        InputError: There is no such episode or step, or it cannot be read.
    """
    name, _, step = place.rpartition(":") if re.fullmatch(r".+:\d+", place) else (place, "", "")
    require_frames(config, to="take a goal from")
    dataset = open_dataset(config)
    episode = dataset.source.read(number_of_episode(dataset, name))
    count = len(episode.states)
    if step and int(step) >= count:
        found = f"an episode of {counted(count, 'step')}"
        raise InputError(where=f"--goal-from {place}", found=found, needed="one of them, from 0")
    return np.asarray(episode.read_frames([int(step) if step else count - 1])[0])


def goals_by_label(
    config: DataConfig, text: str, folder: Path, reporter: Reporter = SILENT
) -> tuple[dict[str, str], Path]:
    """Write the last frame of a successful episode of each language label, a picture that has the label as its name.

    `vjepa2-ac serve --goals FOLDER` then takes the label as a prompt. All episodes count where a set does not say which
    succeeded.

    Args:
        config: The data set, and which camera.
        text: Part of a label, in any case; empty: of all.
        folder: New or empty.
        reporter: Shows the progress.

    Returns:
        The episode of each label, and the folder.

    Raises:
        InputError: There is no such label, an episode cannot be read, or the folder cannot be written.
    """
    require_frames(config, to="make goals of")
    dataset, found = open_dataset(config, progress=reporter.task(INDEXING)), dict[str, str]()
    chosen = np.flatnonzero(dataset.taking_part & (dataset.table.success != 0)).tolist()
    progress = reporter.task("looking for labels", "episodes")
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for done, index in enumerate(chosen, start=1):
            episode = dataset.source.read(index)
            label = re.sub(r"[^\w ,.'-]+", " ", episode.metadata.get("language", "")).strip(" .")[:_LONGEST_LABEL]
            if label and label not in found and text.lower() in label.lower():
                found[label] = dataset.table.identity(index)
                pixels = episode.read_frames([len(episode.states) - 1])[0]
                write_atomically(folder / f"{label}.png", encode_png(pixels))
            progress(done, len(chosen))
    if not found:
        found_text = f"no successful episode with a language label that has {text!r}" if text else "no language labels"
        raise InputError(where=config.path, found=found_text, fix="Take goals of one episode: --episode")
    return found, folder


def recording_of_film(path: Path) -> Recording:
    """Return a film, of which nothing is known but its frames.

    Raises:
        InputError: PyAV is not installed, or it is no MP4 of two frames or more.
    """
    where = str(path)
    frames = read_header(path, where=where).num_frames
    return Recording(path.name, frames, partial(read_frames, path, where=where), None, {"film": where})


@dataclass(frozen=True)
class KeyFrameOptions(Timing):
    """Which frames become goals, and how long each may take."""

    by: By = "gripper"
    every: int | None = None  # frames, by `every`
    apart: int | None = None  # least frames between a stop and another goal (4), or between goals by latents
    stride: int = 4  # frames of a model step


@dataclass(frozen=True, eq=False)
class EnergyCourse:
    """The energy of frames of a demonstration to the goal that applies then."""

    frames: Int[np.ndarray, " encoded"]
    energy: Float[np.ndarray, " encoded"]
    began: tuple[float, ...]  # of each goal: energy of the key frame before to it
    step_before: tuple[float, ...]  # of each goal: energy one model step before it is reached


@dataclass(frozen=True, eq=False)
class MadeGoals:
    """The goals of a demonstration, and what is known about them."""

    recording: Recording
    options: KeyFrameOptions
    keys: tuple[KeyFrame, ...]
    goals: tuple[SubGoal, ...]
    first: UInt8[np.ndarray, "height width 3"]  # the first frame of the demonstration
    course: EnergyCourse | None = None  # None: without a model
    noise: NoiseFloor | None = None

    def write(self, folder: Path) -> Path:
        """Write the folder of goals, and return the path of its goals.json.

        Raises:
            InputError: It cannot be written.
        """
        about = {"by": self.options.by, "every": self.options.every, "stride": self.options.stride}
        made = {"frames": self.recording.frames, "version": __version__, "time": utc_now()}
        return write_goals(
            folder,
            self.goals,
            frames=[key.frame for key in self.keys],
            began=() if self.course is None else self.course.began,
            noise=self.noise,
            origin={**self.recording.origin, **about, **made},
        )


def make_goals(
    recording: Recording,
    options: KeyFrameOptions,
    session: Subject | None = None,
    *,
    still: Recording | None = None,
    reporter: Reporter = SILENT,
) -> MadeGoals:
    """Return the key frames of a demonstration as goals.

    Args:
        recording: The demonstration.
        options: Which frames, and how long they may take.
        session: Of the model that will plan; needed by latents, and for the noise floor.
        still: A film of the resting arm, for the noise floor; None: where the arm rests in the demonstration.
        reporter: Shows the progress.

    Raises:
        InputError: The demonstration has no poses, or there is no model, and the options need them.
    """
    seen = None if session is None else _Encoded.of(session, recording, reporter)
    keys = _keys(recording, options, seen)
    first, *images = recording.read([0, *(key.frame for key in keys)])
    goals = sub_goals_of(images, keys, options, recording.states)
    course = noise = None
    if session is not None and seen is not None:
        course = seen.course([key.frame for key in keys], options.stride)
        noise = _noise_floor(session, recording, still, options.stride, reporter)
    return MadeGoals(recording, options, keys, goals, first, course, noise)


def _keys(recording: Recording, options: KeyFrameOptions, seen: _Encoded | None) -> tuple[KeyFrame, ...]:
    if options.by == "every":
        return every_key_frame(recording.frames, options.every or 1)
    if options.by == "latent":
        if seen is None:
            raise InputError(where="--by latent", found="no model", needed="--model: whose latents are compared")
        return seen.key_frames(options.apart or _APART * options.stride)
    if recording.states is None:
        found, fix = f"{recording.name}: no measured poses", "Take --by latent with --model, or --by every N"
        raise InputError(where="--by gripper", found=found, needed="an episode with poses and gripper", fix=fix)
    return gripper_key_frames(recording.states, StillRule(apart=options.apart or StillRule.apart))


@dataclass(frozen=True, eq=False)
class _Encoded:
    """The latents of a demonstration: of all its frames, or of so many that they fit into memory."""

    session: Subject
    recording: Recording
    frames: Int[np.ndarray, " encoded"]
    latents: Float[Tensor, "encoded tokens dim"]

    @classmethod
    def of(cls, session: Subject, recording: Recording, reporter: Reporter) -> _Encoded:
        step = math.ceil(recording.frames / _MOST_ENCODED)
        frames = np.unique(np.append(np.arange(0, recording.frames, step), recording.frames - 1))
        latents = _latents(session, recording.read, frames.tolist(), reporter.task("encoding frames"))
        return cls(session, recording, frames, latents)

    def key_frames(self, apart: int) -> tuple[KeyFrame, ...]:
        least = max(1, math.ceil(apart / int(self.frames[1] - self.frames[0])))

        def distances(goal: int) -> Float[np.ndarray, " frames"]:
            return energies_of(self.session, self.latents, itertools.repeat(self.latents[goal]))

        found = latent_key_frames(len(self.frames), distances, least)
        frames = [int(self.frames[key.frame]) for key in found]
        return (*(KeyFrame(frame, f"frame {frame}") for frame in frames[:-1]), KeyFrame(frames[-1], "end"))

    def course(self, goals: Sequence[int], stride: int) -> EnergyCourse:
        """Return the energies of all frames to the goal that applies then: the next key frame."""
        begins = [0, *goals[:-1]]
        before = [max(begin, goal - stride) for begin, goal in zip(begins, goals, strict=True)]
        taken = _latents(self.session, self.recording.read, [*begins, *before, *goals])
        began, step_before, wanted = taken.split(len(goals))  # type: ignore[no-untyped-call]  # torch
        places = np.searchsorted(goals, self.frames).clip(max=len(goals) - 1)
        energy = energies_of(self.session, self.latents, (wanted[place] for place in places.tolist()))
        ends = (energies_of(self.session, one, wanted) for one in (began, step_before))
        return EnergyCourse(self.frames, energy, *(tuple(one.tolist()) for one in ends))


def _latents(
    session: Subject, read: FrameReader, frames: Sequence[int], progress: Progress = no_progress
) -> Float[Tensor, "frames tokens dim"]:
    """Return the latents of some frames, as the session's model sees them; few pixels at a time are in memory."""
    found, crop, views = [], session.config.data.crop, session.config.planning.views
    for start in range(0, len(frames), _AT_ONCE):
        part = frames[start : start + _AT_ONCE]
        found.append(encode_frames(session.world_model, read(part), crop, views=views))
        progress(min(start + _AT_ONCE, len(frames)), len(frames))
    return torch.cat(found)


def energies_of(session: Subject, seen: Iterable[Tensor], wanted: Iterable[Tensor]) -> Float[np.ndarray, " frames"]:
    """Return the energy of latents of each frame to those of the wanted one: without a mask."""
    energy = session.config.planning.energy
    return np.array([float(distance(one, to, energy)) for one, to in zip(seen, wanted, strict=False)])


def _noise_floor(
    session: Subject, recording: Recording, still: Recording | None, gap: int, reporter: Reporter
) -> NoiseFloor | None:
    """Return the 95th percentile of energies between frames of a resting arm, `gap` apart; None: none rests."""
    if still is not None:
        shown, rests = still, np.ones(still.frames - 1, dtype=bool)
    elif recording.states is not None:
        shown, rests = recording, resting(recording.states)
    else:
        return None
    pairs = resting_pairs(rests, gap)
    if not len(pairs):
        return None
    taken = pairs[list(spread_with_ends(len(pairs), _MOST_PAIRS))]
    frames, places = np.unique(taken, return_inverse=True)
    latents = _latents(session, shown.read, frames.tolist(), reporter.task("encoding frames of a resting arm"))
    one, other = latents[torch.from_numpy(places.reshape(taken.shape).T)]
    energies = energies_of(session, one, other)
    kind = session.config.planning.energy.distance.name
    encoder = session.world_model.fingerprints().encoder
    return NoiseFloor(float(np.quantile(energies, _UPPER)), len(taken), encoder, kind)
