"""The `simulation.json` of a recorded data set: how its episodes were simulated, and can be again."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation.recording.demonstration import RecordedTask, RecordingSpec, episode_folder, world_of
from vjepa2_ac.simulation.world.domains import Domain, DomainRanges
from vjepa2_ac.simulation.world.motion import MotionRecipe
from vjepa2_ac.storage.structured import json_text, read_json_object, record_of

SIMULATION_FILE = "simulation.json"

_LIBRARIES = ("mujoco", "numpy", "scipy", "simplejpeg")  # other versions may change last digits
_NEEDED = "what `vjepa2-ac simulate record` writes"
_AGAIN = "Record it again: the same options give the same episodes"
_NUMBER = re.compile(r"_(\d{6,})/")  # as `episode_folder` writes it


@dataclass(frozen=True)
class _Content:
    """The values of the file; exactly one of domain and ranges is given."""

    version: str
    libraries: dict[str, str]
    episodes: Annotated[int, Field(ge=1)]
    steps: Annotated[int, Field(ge=2, le=1_000_000)]
    seed: Annotated[int, Field(ge=0)]
    cameras: Literal[1, 3]
    recipe: MotionRecipe
    task: RecordedTask | None
    domain: Domain | None = None
    ranges: DomainRanges | None = None


@dataclass(frozen=True)
class RecordedSimulation:
    """How a data set was simulated: everything that determines its episodes."""

    folder: str
    spec: RecordingSpec
    episodes: int
    version: str  # of this program
    libraries: dict[str, str]  # and of those that determine last digits

    def number_of(self, episode_id: str) -> int:
        """Return the number under which an episode was recorded, from its identity.

        Raises:
            InputError: It is no episode of this data set.
        """
        found = _NUMBER.search(episode_id)
        number = int(found[1]) if found else self.episodes
        if number < self.episodes:
            worlds = self.spec.worlds
            name = worlds.name if isinstance(worlds, Domain) else world_of(number, self.spec).name
            if f"{episode_folder(number, self.spec.seed, name)}/" in episode_id:
                return number
        raise InputError(
            where=f"{self.folder}: {SIMULATION_FILE}",
            found=f"not the episode {episode_id!r}",
            needed=f"one of the {self.episodes} simulated with seed {self.spec.seed}",
            fix="Episodes are told apart by the folder in their identity; keep data.fields.identity as it is",
        )

    def world_of(self, episode_id: str) -> Domain:
        """Return the world of an episode.

        Raises:
            InputError: It is no episode of this data set.
        """
        return world_of(self.number_of(episode_id), self.spec)


def simulation_text(spec: RecordingSpec, episodes: int) -> str:
    """Return the content of the file; worlds and recipe are written out, whatever names and defaults mean later."""
    worlds = spec.worlds
    content = _Content(
        version=version("vjepa2-ac"),
        libraries=_versions(),
        episodes=episodes,
        steps=spec.steps,
        seed=spec.seed,
        cameras=spec.cameras,
        recipe=spec.recipe or MotionRecipe(),
        task=spec.task,
        domain=worlds if isinstance(worlds, Domain) else None,
        ranges=None if isinstance(worlds, Domain) else worlds,
    )
    return json_text(asdict(content))


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
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(
            where=where,
            found="no such file: these are not simulated episodes, or an older version recorded them",
            needed=_NEEDED,
            fix=f"What happens under other actions can only be simulated. {_AGAIN}",
        ) from None
    content = record_of(_Content, values, where=where, needed=_NEEDED, fix=_AGAIN)
    worlds = [world for world in (content.domain, content.ranges) if world is not None]
    if len(worlds) != 1:
        found = f"{len(worlds)} of the keys domain and ranges"
        raise InputError(where=where, found=found, needed=_NEEDED, fix=_AGAIN)
    spec = RecordingSpec(worlds[0], content.steps, content.seed, content.cameras)
    spec = replace(spec, recipe=content.recipe, task=content.task)
    return RecordedSimulation(str(folder), spec, content.episodes, content.version, content.libraries)


def other_versions(simulation: RecordedSimulation) -> str:
    """Return what has another version here than where it was recorded, such as "mujoco 3.5.0, here 3.6.0"."""
    here = {"vjepa2-ac": version("vjepa2-ac"), **_versions()}
    then = {"vjepa2-ac": simulation.version, **simulation.libraries}
    return "; ".join(f"{name} {was}, here {here.get(name)}" for name, was in then.items() if here.get(name) != was)


def _versions() -> dict[str, str]:
    return {name: version(name) for name in _LIBRARIES}
