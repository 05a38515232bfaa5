"""Record demonstrations of the simulated arm as RLDS in DROID's schema, with a `simulation.json`.

`simulation.json` contains everything that determines the episodes, so that each can be simulated again.
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
from vjepa2_ac.simulation.arm import SimulatedArm, StepCallback
from vjepa2_ac.simulation.domains import Domain, DomainRanges, load_mujoco, named_domain, sample_domain
from vjepa2_ac.simulation.droid_writer import CAMERAS, DroidEpisode, write_droid_rlds
from vjepa2_ac.simulation.motion import CONTROL_RATE_HZ, Motion, MotionRecipe, random_reaching
from vjepa2_ac.simulation.policies import play
from vjepa2_ac.simulation.tasks import arm_for
from vjepa2_ac.storage.paths import SIMULATION_FILE
from vjepa2_ac.storage.structured import format_json, parse_record, read_json_object

RecordedTask = Literal["push", "pick", "place"]

INSTRUCTIONS: dict[RecordedTask | None, str] = {
    None: "reach around over the table",
    "push": "push the block",
    "pick": "pick up the block",
    "place": "put the block on the mark",
}
"""Language instruction by task; None is random reaching without a block."""


def default_steps(task: RecordedTask | None) -> int:
    """Return the default number of control steps per episode; `place` needs more than the other tasks."""
    return 81 if task == "place" else 41


SUCCESS_SHARE = 0.9

_MOTION, _WORLD, _SUCCESS = range(3)  # random streams of an episode


@dataclass(frozen=True)
class RecordingSpec:
    """The options that determine the episodes of a simulated data set."""

    # A domain or its name; with ranges, or `random`, a domain is drawn for each episode.
    domain: str | Domain | DomainRanges = "A"
    steps: Annotated[int, Field(ge=2, le=1_000_000)] = 41  # control steps (15 per second); see `default_steps`
    seed: Annotated[int, Field(ge=0)] = 0  # determines motion, outcome and worlds
    cameras: Literal[1, 2, 3] = 1  # number of rendered cameras, fixed ones first; the others repeat the first image
    recipe: MotionRecipe = field(default_factory=MotionRecipe)  # ranges of random reaching, if there is no task
    task: RecordedTask | None = None  # a task with a block: half of the episodes are scripted, half are random play

    @property
    def worlds(self) -> Domain | DomainRanges:
        """The domain of all episodes, or the ranges from which the domain of each episode is drawn.

        Raises:
            InputError: There is no domain with this name.
        """
        if not isinstance(self.domain, str):
            return self.domain
        return DomainRanges() if self.domain == "random" else named_domain(self.domain)


def make_arm(index: int, spec: RecordingSpec) -> SimulatedArm:
    """Return an arm in the domain of an episode, with contacts if there is a task.

    Raises:
        InputError: The domain is unknown.
        UnreachableError: MuJoCo is not installed.
    """
    worlds = spec.worlds
    world = worlds if isinstance(worlds, Domain) else sample_domain(_stream(index, spec, _WORLD), worlds)
    return arm_for(spec.task or "reach", world)


def execute_episode(
    arm: SimulatedArm, index: int, spec: RecordingSpec, *, until: int | None = None, on_step: StepCallback | None = None
) -> Motion:
    """Carry out an episode and return its motion.

    Args:
        arm: An arm from `make_arm`.
        index: Number of the episode.
        spec: The options of the recording.
        until: Control step at which the episode stops, with arm and block in its measured state; None: the last one.
        on_step: Called with the arm at every control step.
    """
    rng = _stream(index, spec, _MOTION)
    if spec.task is not None:  # contacts depend on all earlier steps, so these are simulated as well
        return play(arm, spec.task, spec.steps if until is None else until, rng, script=index % 2 == 0, on_step=on_step)
    arm.reset_clock()
    motion = random_reaching(arm.domain, spec.steps, rng, spec.recipe)
    measured = slice(None if until is None else until + 1)
    for joints, gripper_position in zip(motion.joints[measured], motion.gripper[measured], strict=True):
        arm.set_joints(joints, float(gripper_position))
        if on_step:
            on_step(arm)
    return motion


def episode_folder(index: int, seed: int, domain_name: str) -> str:
    """Return the source folder that is stored in the episode. As in DROID, only its name contains the outcome."""
    succeeded = np.random.default_rng([seed, index, _SUCCESS]).uniform() < SUCCESS_SHARE
    minute, hour, day = index % 60, index // 60 % 24, 1 + index // 1440 % 28
    name = f"{domain_name}_seed{seed}_{hour:02d}h{minute:02d}_{index:06d}"
    return f"/simulated/SIM/{'success' if succeeded else 'failure'}/2026-01-{day:02d}/{name}"


def _stream(index: int, spec: RecordingSpec, purpose: int) -> np.random.Generator:
    return np.random.default_rng([spec.seed, index, purpose])


# ---- the data set ----

JPEG_QUALITY = 85  # about 11 KB per image, as in DROID
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
    """Record episodes and write them as a data set. The same arguments give the same bytes for any number of workers.

    Other versions of MuJoCo, NumPy or the JPEG library may change last digits and bytes.

    Args:
        folder: A new or empty folder for the data set.
        spec: The options of the recording.
        episodes: Number of episodes.
        shards: Number of TFRecord files; None: one per 32 episodes.
        workers: Number of processes. More than one requires `if __name__ == "__main__":` in a calling script.
        progress: Called with (episodes done, episodes in total).

    Raises:
        InputError: The domain is unknown, a number is out of range, or the folder is not empty or cannot be written.
        UnreachableError: MuJoCo is not installed.
    """
    load_mujoco()
    if min(episodes, spec.steps - 1, workers, 1 if shards is None else shards, spec.seed + 1) < 1:
        problem = f"episodes {episodes}, steps {spec.steps}, shards {shards}, workers {workers}, seed {spec.seed}"
        needed = "at least 1 episode, 2 steps, 1 shard, 1 worker, seed 0"
        raise InputError(where="simulate record", found=problem, needed=needed)
    record = partial(record_episode, spec=replace(spec, domain=spec.worlds))

    def episodes_with_progress() -> Iterator[DroidEpisode]:
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
            with safe_imports():  # `pool.map` starts the workers
                recorded = (map if workers == 1 else pool.map)(record, range(episodes))
            for done, episode in enumerate(recorded, start=1):
                yield episode
                progress(done, episodes)

    notes = {SIMULATION_FILE: format_json(RecordedSimulation.of(spec, episodes).as_dict())}
    return write_droid_rlds(folder, episodes_with_progress(), shards=shards or -(-episodes // 32), notes=notes)


def record_episode(index: int, spec: RecordingSpec) -> DroidEpisode:
    """Record one episode. The result is a pure function of the arguments.

    Raises:
        InputError: The domain is unknown.
        UnreachableError: MuJoCo is not installed.
    """
    arm = make_arm(index, spec)
    images: dict[str, list[bytes]] = {feature: [] for feature in CAMERAS[: spec.cameras]}

    def store_images(arm: SimulatedArm) -> None:
        for feature, jpegs in images.items():
            jpegs.append(encode_jpeg(arm.image(_SIMULATED_CAMERAS[feature]), quality=JPEG_QUALITY))

    motion = execute_episode(arm, index, spec, on_step=store_images)
    folder = episode_folder(index, spec.seed, arm.domain.name)
    return DroidEpisode(
        file_path=f"{folder}/trajectory.h5",
        recording_folderpath=f"{folder}/recordings/MP4",
        arrays=_arrays(motion),
        images={feature: images.get(feature, images[CAMERAS[0]]) for feature in CAMERAS},
        language_instruction=INSTRUCTIONS[spec.task],
    )


def _arrays(motion: Motion) -> dict[str, Float[np.ndarray, "steps width"]]:
    """Return commands and measurements by DROID's feature names; velocities are those of the commands, per second."""
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
    """Return the velocity before each position; the first one equals the second."""
    changes = np.diff(positions, axis=0)
    return np.concatenate([changes[:1], changes]) * CONTROL_RATE_HZ


# ---- simulation.json ----

_PROGRAM, _LIBRARIES = "vjepa2-ac", ("mujoco", "numpy", "scipy", "simplejpeg")  # other versions may change last digits
_NEEDED = "a file written by `vjepa2-ac simulate record`"
_RECORD_AGAIN = "Record the data set again; the same options give the same episodes"
_NUMBER = re.compile(r"_(\d{6,})/")  # number of an episode in the result of `episode_folder`


@dataclass(frozen=True, kw_only=True)
class RecordedSimulation(RecordingSpec):
    """The content of simulation.json: everything that determines the episodes, with domains written out."""

    version: str  # version of this package
    libraries: dict[str, str]  # versions of libraries that affect last digits
    episodes: Annotated[int, Field(ge=1)]

    @classmethod
    def of(cls, spec: RecordingSpec, episodes: int) -> RecordedSimulation:
        """Return the record of a data set. Domains are written out, so that it does not depend on later definitions."""
        libraries, options = {name: version(name) for name in _LIBRARIES}, vars(spec) | {"domain": spec.worlds}
        return cls(version=version(_PROGRAM), libraries=libraries, episodes=episodes, **options)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the file as plain values; one of the keys `domain` and `ranges` is None."""
        values, key = asdict(self), "domain" if isinstance(self.domain, Domain) else "ranges"
        return values | {"domain": None, "ranges": None} | {key: values["domain"]}

    def number_of(self, episode_id: str) -> int:
        """Return the number of an episode in the recording, from its identity.

        Raises:
            InputError: The episode is not one of this data set.
        """
        match = _NUMBER.search(episode_id)
        number = int(match[1]) if match else self.episodes
        name = self.domain.name if isinstance(self.domain, Domain) else "random"
        if number < self.episodes and f"{episode_folder(number, self.seed, name)}/" in episode_id:
            return number
        problem, needed = (
            f"an unknown episode, {episode_id!r}",
            f"one of the {self.episodes} episodes recorded with seed {self.seed}",
        )
        fix = "Episodes are identified by the folder in their identity. Leave data.fields.identity at its default"
        raise InputError(where=SIMULATION_FILE, found=problem, needed=needed, fix=fix)


def read_simulation(folder: str | Path) -> RecordedSimulation:
    """Read the simulation.json of a data set.

    Args:
        folder: Folder or URL of the data set.

    Raises:
        InputError: There is no such file, because the data were not simulated or an older version recorded them; or
            the file is damaged.
        UnreachableError: The network fails.
    """
    where = storage.join(str(folder), SIMULATION_FILE)
    try:
        values = read_json_object(where, needed=_NEEDED, fix=_RECORD_AGAIN)
    except MissingFileError:
        problem = "no such file; the data were not simulated, or were recorded by an older version"
        fix = f"Outcomes of other actions are available for simulated data only. {_RECORD_AGAIN}"
        raise InputError(where=where, found=problem, needed=_NEEDED, fix=fix) from None
    worlds = [world for key in ("domain", "ranges") if (world := values.pop(key, None)) is not None]
    if len(worlds) != 1:
        raise InputError(
            where=where, found="both or neither of the keys domain and ranges", needed=_NEEDED, fix=_RECORD_AGAIN
        )
    return parse_record(
        RecordedSimulation, values | {"domain": worlds[0]}, where=where, needed=_NEEDED, fix=_RECORD_AGAIN
    )
