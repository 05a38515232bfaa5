"""Recording of a simulated data set: demonstrations, filmed, written as RLDS in DROID's schema; and `simulation.json`.

The latter has everything that determines the episodes, so that each can be simulated again.
"""

from __future__ import annotations

import multiprocessing
import re
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from vjepa2_ac import storage
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError, MissingFileError
from vjepa2_ac.media.images import encode_jpeg
from vjepa2_ac.process import safe_imports
from vjepa2_ac.simulation.arm import Look, SimulatedArm
from vjepa2_ac.simulation.domains import Domain, DomainRanges, load_mujoco, named_domain, sample_domain
from vjepa2_ac.simulation.droid_writer import CAMERAS, DroidEpisode, write_droid_rlds
from vjepa2_ac.simulation.motion import CONTROL_RATE_HZ, Motion, MotionRecipe, random_reaching
from vjepa2_ac.simulation.policies import play
from vjepa2_ac.simulation.tasks import arm_for
from vjepa2_ac.storage.places import SIMULATION_FILE
from vjepa2_ac.storage.structured import json_text, read_json_object, record_of

RecordedTask = Literal["push", "pick", "place"]

INSTRUCTIONS: dict[RecordedTask | None, str] = {
    None: "reach around over the table",
    "push": "push the block",
    "pick": "pick up the block",
    "place": "put the block on the mark",
}
"""Language instruction of an episode; None: random reaching, without a block."""


def default_steps(task: RecordedTask | None) -> int:
    """Return the control steps of an episode, enough for its task: the script of `place` releases the block late."""
    return 81 if task == "place" else 41


SUCCESS_SHARE = 0.9

_MOTION, _WORLD, _SUCCESS = range(3)  # random streams of an episode


@dataclass(frozen=True)
class RecordingSpec:
    """What an episode of a simulated data set is."""

    domain: str | Domain | DomainRanges = "A"  # or its name; ranges, or `random`: another world in every episode
    steps: Annotated[int, Field(ge=2, le=1_000_000)] = 41  # control steps (15 per second); see `default_steps`
    seed: Annotated[int, Field(ge=0)] = 0  # determines motion, outcome and worlds
    cameras: Literal[1, 2, 3] = 1  # so many have an image of their own, those that stand still first
    recipe: MotionRecipe = field(default_factory=MotionRecipe)  # ranges of the motion, without a task
    task: RecordedTask | None = None  # with a block: half of the episodes by script, half at random

    @property
    def worlds(self) -> Domain | DomainRanges:
        """The world of all episodes, or the ranges to draw each one's from.

        Raises:
            InputError: No domain has this name.
        """
        if not isinstance(self.domain, str):
            return self.domain
        return DomainRanges() if self.domain == "random" else named_domain(self.domain)


def arm_of(index: int, spec: RecordingSpec) -> SimulatedArm:
    """Return an arm in the world of an episode; with a task it has contacts.

    Raises:
        InputError: An unknown domain.
        UnreachableError: MuJoCo is not installed.
    """
    worlds = spec.worlds
    world = worlds if isinstance(worlds, Domain) else sample_domain(_stream(index, spec, _WORLD), worlds)
    return arm_for(spec.task or "reach", world)


def carry_out(
    arm: SimulatedArm, index: int, spec: RecordingSpec, *, until: int | None = None, look: Look | None = None
) -> Motion:
    """Carry out an episode, and return its motion.

    Args:
        arm: From `arm_of`; its pose does not matter.
        index: Number of the episode.
        spec: What an episode is.
        until: Control step at which arm and block are left, as they were when it was measured; None: after the last.
        look: Called with the arm.
    """
    rng = _stream(index, spec, _MOTION)
    if spec.task is not None:  # contacts depend on all that happened before
        return play(arm, spec.task, spec.steps if until is None else until, rng, script=index % 2 == 0, look=look)
    arm.reset_clock()
    motion = random_reaching(arm.domain, spec.steps, rng, spec.recipe)
    measured = slice(None if until is None else until + 1)
    for joints, closedness in zip(motion.joints[measured], motion.gripper[measured], strict=True):
        arm.set_joints(joints, float(closedness))
        if look:
            look(arm)
    return motion


def episode_folder(index: int, seed: int, domain_name: str) -> str:
    """Return the source folder stored in the episode; as in DROID, the only record of success or failure."""
    succeeded = np.random.default_rng([seed, index, _SUCCESS]).uniform() < SUCCESS_SHARE
    minute, hour, day = index % 60, index // 60 % 24, 1 + index // 1440 % 28
    place = f"{domain_name}_seed{seed}_{hour:02d}h{minute:02d}_{index:06d}"
    return f"/simulated/SIM/{'success' if succeeded else 'failure'}/2026-01-{day:02d}/{place}"


def _stream(index: int, spec: RecordingSpec, purpose: int) -> np.random.Generator:
    return np.random.default_rng([spec.seed, index, purpose])


# ---- the data set ----

JPEG_QUALITY = 85  # some 11 KB an image, as in DROID
_SIMULATED_CAMERAS = dict(zip(CAMERAS, ("exterior_1", "exterior_2", "wrist"), strict=True))


def record_dataset(
    folder: str | Path,
    spec: RecordingSpec,
    *,
    episodes: int,
    shards: int | None = None,
    workers: int = 1,
    progress: Progress = no_progress,
) -> Path:
    """Record episodes and write them as a data set; the same arguments give the same bytes, whatever `workers`.

    Other versions of MuJoCo, NumPy or the JPEG library may change last digits and bytes, not the episodes.

    Args:
        folder: The folder of the data set; must be new or empty.
        spec: What an episode is.
        episodes: Number of episodes.
        shards: TFRecord files; one for every 32 episodes by default.
        workers: Processes. More than one needs `if __name__ == "__main__":` in a script that calls this.
        progress: Called with (episodes done, episodes in total).

    Raises:
        InputError: An unknown domain, a number out of range, or a folder that is in use or cannot be written.
        UnreachableError: MuJoCo is not installed.
    """
    load_mujoco()
    if min(episodes, spec.steps - 1, workers, 1 if shards is None else shards, spec.seed + 1) < 1:
        found = f"episodes {episodes}, steps {spec.steps}, shards {shards}, workers {workers}, seed {spec.seed}"
        needed = "at least 1 episode, 2 steps, 1 shard, 1 worker, seed 0"
        raise InputError(where="simulate record", found=found, needed=needed)
    record = partial(record_episode, spec=replace(spec, domain=spec.worlds))

    def watched() -> Iterator[DroidEpisode]:
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
            with safe_imports():  # `pool.map` starts the workers
                recorded = (map if workers == 1 else pool.map)(record, range(episodes))
            for done, episode in enumerate(recorded, start=1):
                yield episode
                progress(done, episodes)

    notes = {SIMULATION_FILE: json_text(RecordedSimulation.of(spec, episodes).as_dict())}
    return write_droid_rlds(folder, watched(), shards=shards or -(-episodes // 32), notes=notes)


def record_episode(index: int, spec: RecordingSpec) -> DroidEpisode:
    """Return one episode: a pure function of its arguments.

    Raises:
        InputError: An unknown domain.
        UnreachableError: MuJoCo is not installed.
    """
    arm = arm_of(index, spec)
    images: dict[str, list[bytes]] = {feature: [] for feature in CAMERAS[: spec.cameras]}

    def take(arm: SimulatedArm) -> None:
        for feature, taken in images.items():
            taken.append(encode_jpeg(arm.image(_SIMULATED_CAMERAS[feature]), quality=JPEG_QUALITY))

    motion = carry_out(arm, index, spec, look=take)
    folder = episode_folder(index, spec.seed, arm.domain.name)
    return DroidEpisode(
        file_path=f"{folder}/trajectory.h5",
        recording_folderpath=f"{folder}/recordings/MP4",
        arrays=_arrays(motion),
        images={feature: images.get(feature, images[CAMERAS[0]]) for feature in CAMERAS},
        language_instruction=INSTRUCTIONS[spec.task],
    )


def _arrays(motion: Motion) -> dict[str, Float[np.ndarray, "steps width"]]:
    """Return commands and measurements by DROID's features; velocities are what the commands ask for, per second."""
    poses, gripper = motion.commanded_poses, motion.commanded_gripper[:, None]
    angles = np.concatenate([poses[:, :3], np.unwrap(poses[:, 3:], axis=0)], axis=1)
    return {
        "action": np.concatenate([poses, gripper], axis=1),
        "action_dict/cartesian_position": poses,
        "action_dict/cartesian_velocity": _velocity(angles),
        "action_dict/gripper_position": gripper,
        "action_dict/gripper_velocity": _velocity(gripper),
        "action_dict/joint_position": motion.commanded_joints,
        "action_dict/joint_velocity": _velocity(motion.commanded_joints),
        "observation/cartesian_position": motion.poses,
        "observation/gripper_position": motion.gripper[:, None],
        "observation/joint_position": motion.joints,
    }


def _velocity(positions: Float[np.ndarray, "steps dim"]) -> Float[np.ndarray, "steps dim"]:
    """Return the velocity that led to each position; the first equals the second."""
    ways = np.diff(positions, axis=0)
    return np.concatenate([ways[:1], ways]) * CONTROL_RATE_HZ


# ---- simulation.json ----

_PROGRAM, _LIBRARIES = "vjepa2-ac", ("mujoco", "numpy", "scipy", "simplejpeg")  # other versions may change last digits
_NEEDED = "what `vjepa2-ac simulate record` writes"
_AGAIN = "Record it again: the same options give the same episodes"
_NUMBER = re.compile(r"_(\d{6,})/")  # as `episode_folder` writes it


@dataclass(frozen=True, kw_only=True)
class RecordedSimulation(RecordingSpec):
    """Everything that determines the episodes of a data set; the worlds are no name."""

    version: str  # of this program
    libraries: dict[str, str]  # and of those that determine last digits
    episodes: Annotated[int, Field(ge=1)]

    @classmethod
    def of(cls, spec: RecordingSpec, episodes: int) -> RecordedSimulation:
        """Return the record of a data set, worlds and recipe written out, whatever names and defaults mean later."""
        libraries, how = {name: version(name) for name in _LIBRARIES}, vars(spec) | {"domain": spec.worlds}
        return cls(version=version(_PROGRAM), libraries=libraries, episodes=episodes, **how)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the file: one of its keys `domain` and `ranges` has the world or worlds."""
        values, key = asdict(self), "domain" if isinstance(self.domain, Domain) else "ranges"
        return values | {"domain": None, "ranges": None} | {key: values["domain"]}

    def number_of(self, episode_id: str) -> int:
        """Return the number under which an episode was recorded, from its identity.

        Raises:
            InputError: It is no episode of this data set.
        """
        match = _NUMBER.search(episode_id)
        number = int(match[1]) if match else self.episodes
        name = self.domain.name if isinstance(self.domain, Domain) else "random"
        if number < self.episodes and f"{episode_folder(number, self.seed, name)}/" in episode_id:
            return number
        found, needed = f"not the episode {episode_id!r}", f"one of {self.episodes} simulated with seed {self.seed}"
        fix = "Episodes are told apart by the folder in their identity; keep data.fields.identity as it is"
        raise InputError(where=SIMULATION_FILE, found=found, needed=needed, fix=fix)


def read_simulation(folder: str | Path) -> RecordedSimulation:
    """Read how a data set was simulated.

    Args:
        folder: Of the data set, on this machine or behind a URL.

    Raises:
        InputError: It was not simulated, or by an older version that did not write the file; or the file is damaged.
        UnreachableError: The network fails.
    """
    where = storage.join(str(folder), SIMULATION_FILE)
    try:
        values = read_json_object(where, needed=_NEEDED, fix=_AGAIN)
    except MissingFileError:
        found = "no such file: these are not simulated episodes, or an older version recorded them"
        fix = f"What happens under other actions can only be simulated. {_AGAIN}"
        raise InputError(where=where, found=found, needed=_NEEDED, fix=fix) from None
    worlds = [one for key in ("domain", "ranges") if (one := values.pop(key, None)) is not None]
    if len(worlds) != 1:
        raise InputError(where=where, found="not one of the keys domain and ranges", needed=_NEEDED, fix=_AGAIN)
    return record_of(RecordedSimulation, values | {"domain": worlds[0]}, where=where, needed=_NEEDED, fix=_AGAIN)
