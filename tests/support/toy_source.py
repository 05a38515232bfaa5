"""A form of data as somebody else would add it: a section that owns its knobs, and a class that reads it."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np

from vjepa2_ac.config import DataConfig, Section
from vjepa2_ac.config.section import Affects
from vjepa2_ac.data.index.episode_table import EpisodeTable
from vjepa2_ac.episode import Episode, EpisodeInfo, Progress, StepRanges


class ToyKnobs(Section):
    """How many episodes there are, and how long they are."""

    episodes: Annotated[int, Affects.EPISODES] = 6
    """Number of episodes."""
    steps: Annotated[int, Affects.EPISODES] = 20
    """Control steps of each."""


class ToyData(DataConfig):
    """Episodes of an arm that moves along a line, in front of a wall that gets brighter."""

    reader: ClassVar[str] = "toy_source:ToySource"
    has_vectors: ClassVar[bool] = False

    source: Annotated[Literal["toy"], Affects.EPISODES] = "toy"
    """toy: drawn from nothing."""
    toy: ToyKnobs = ToyKnobs()
    """How many there are."""

    @property
    def first_camera(self) -> str:
        """The only one."""
        return "front"


class ToySource:
    """Reads them."""

    def __init__(self, config: ToyData) -> None:
        self._toy = config.toy

    def infos(self, progress: Progress | None = None) -> EpisodeTable:
        del progress
        infos = [EpisodeInfo(f"toy/{number}", self._toy.steps) for number in range(self._toy.episodes)]
        return EpisodeTable.of(infos, texts={"control_rate_hz": "15"})

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        del camera, needed
        states = np.zeros((self._toy.steps, 7))
        states[:, index % 3] = np.linspace(0.3, 0.5, self._toy.steps)

        def read_frames(steps: Sequence[int]) -> np.ndarray:
            return np.stack([np.full((24, 32, 3), 10 * step, np.uint8) for step in steps])

        info = EpisodeInfo(f"toy/{index}", self._toy.steps)
        return Episode(info=info, states=states, read_frames=read_frames, control_rate_hz=15.0)
