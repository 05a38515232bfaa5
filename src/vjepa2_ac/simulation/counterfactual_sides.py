"""Does the imagined hand move to the true side? Actions that were not taken, from held-out starts of simulated data.

From each start every model imagines what happens under named actions (up, down, ...), its images are decoded, and the
hand's position is read from them by a probe that was fitted on true frames. The simulator carries out the same actions.
A cell counts as right if the imagined displacement, along the true one in the image, is above 0: chance, and a model
that ignores its actions, is 0.5. Where the hand truly moves by less than 2 pixels, no side is the true one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.data.clips.dataset import Dataset, open_dataset
from vjepa2_ac.data.clips.loader import batches_of, validation_windows
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder, load_decoder
from vjepa2_ac.decoding.imagine import Start, imagined_latents
from vjepa2_ac.distributed.launch import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch, encode_frames
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.decoded.hand import HandPositions, HandProbe
from vjepa2_ac.evaluation.decoded_rollouts.setup import fitted_probe
from vjepa2_ac.evaluation.request import EvaluationOptions, settle
from vjepa2_ac.evaluation.subject import Subject, load_subject
from vjepa2_ac.intervals import Estimate, share_of
from vjepa2_ac.planning.counterfactual.named_actions import STEP_M, named_actions
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
from vjepa2_ac.simulation.counterfactual import resimulate
from vjepa2_ac.simulation.hand_in_images import hand_positions

AXES: Mapping[str, tuple[str, str]] = {"x": ("forward", "back"), "y": ("left", "right"), "z": ("up", "down")}
"""Axis of the robot base frame -> the named actions along it."""
DECODED_TRUTH = "decoded_truth"
LEAST_PX = 2.0
CHANCE = 0.5


@dataclass(frozen=True)
class SidesOptions:
    """What is asked of the counterfactuals."""

    decoder: str
    starts: int = 24  # held-out windows, spread over the episodes
    steps: int = 3  # model steps
    size_m: float = STEP_M  # of each step, if the limits allow it
    split: Split = "test"
    evaluation: EvaluationOptions = field(default_factory=EvaluationOptions)  # checkpoint, data, against


@dataclass(frozen=True)
class Cell:
    """One start under one named action, after each model step."""

    episode_id: str
    start: int
    name: str  # of the action
    true_px: Float[np.ndarray, " steps"]  # length of the true displacement in the image
    along_px: Mapping[str, Float[np.ndarray, " steps"]]  # source -> the displacement that is read, along the true one


@dataclass(frozen=True)
class Side:
    """In how many cells the imagined hand moves to the true side."""

    right: int
    cells: int  # that count
    left_out: int  # the true displacement is too small

    @property
    def share(self) -> Estimate | None:
        """The share with Wilson's interval, which takes cells as independent; None: no cell counts."""
        return share_of(self.right, self.cells) if self.cells else None


@dataclass(frozen=True)
class Sides:
    """The cells of all starts, and what they were read with."""

    cells: tuple[Cell, ...]
    sources: tuple[str, ...]  # models, and the decoded truth: the ceiling of decoder and probe
    image_px: int
    probe_fitted_on: tuple[int, int]  # frames, episodes

    def of(self, source: str, axis: str | None = None, step: int = -1) -> Side:
        """Return the count for one source, along an axis of the robot (None: all), after a model step (-1: last)."""
        names = [name for one, pair in AXES.items() for name in pair if axis in {None, one}]
        cells = [cell for cell in self.cells if cell.name in names]
        counted = [cell for cell in cells if cell.true_px[step] >= LEAST_PX]
        right = sum(bool(cell.along_px[source][step] > 0) for cell in counted)
        return Side(right, len(counted), len(cells) - len(counted))


def measure_sides(subject: str, asked: SidesOptions, *, reporter: Reporter = SILENT) -> Sides:
    """Measure a run, or a model with `asked.evaluation.data`, on held-out starts of simulated data.

    Raises:
        InputError: Subject, data or decoder cannot be used; or the data were not simulated.
    """
    decoder = load_decoder(asked.decoder)
    config, planning, _ = settle(subject, asked.evaluation, frames=asked.steps + 1)
    accelerator = make_accelerator(config)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    size = decoder.card.shape.image_size
    positions = hand_positions(dataset, size)
    if isinstance(positions, str) or config.data.is_cache:
        found = positions if isinstance(positions, str) else "latents of a cache, which has no frames"
        raise InputError(where=config.data.path, found=found, needed="a data set that `simulate record` made")
    loaded = load_subject(subject, config, asked.evaluation, dataset, decoder)
    loaded.put_on(accelerator.device)
    probe = fitted_probe(dataset, positions, size)
    reader = _Reader(decoder.to(accelerator.device), probe, positions)
    imagine = _Imagination(config, dataset, loaded, reader)
    windows, cells = validation_windows(dataset, asked.split, clips=asked.starts), []
    progress = reporter.task("actions that were not taken", "starts")
    for done, window in enumerate(windows, 1):
        with accelerator.autocast():
            cells += imagine.cells_of(window, asked, planning.limits)
        progress(done, len(windows))
    sources = (DECODED_TRUTH, *(one.name for one in loaded.contenders))
    return Sides(tuple(cells), sources, size, probe.fitted_on)


@dataclass(frozen=True, eq=False)
class _Reader:
    """Reads positions of the hand from latents."""

    decoder: TrainedDecoder
    probe: HandProbe
    positions: HandPositions

    def of(self, latents: torch.Tensor) -> Float[np.ndarray, "time 2"]:
        """Return the positions in the decoded images."""
        with torch.autocast(latents.device.type, enabled=False), torch.no_grad():
            return self.probe.read(self.decoder.decoder.decode(latents.float()))


@dataclass(frozen=True, eq=False)
class _Imagination:
    config: Config
    dataset: Dataset
    subject: Subject
    reader: _Reader

    def cells_of(self, window: tuple[int, int], asked: SidesOptions, limits: LimitsConfig) -> list[Cell]:
        """Return the cells of one start: a model's images and the simulator's under every named action."""
        episode, first = window
        camera = self.config.data.cameras[0]
        arm = resimulate(self.config.data.path, self.dataset.source.read(episode, camera), first, camera)
        start, name = self._start(window)
        cells = []
        for action in (one for pair in AXES.values() for one in pair):
            actions = named_actions(action, asked.steps, size_m=asked.size_m, limits=limits)
            outcome = arm.under(actions, self.config.data.model_stride)
            true = self.reader.positions(name, outcome.states)
            truth = encode_frames(
                self.subject.world_model,
                outcome.frames,
                self.config.data.crop,
                chunk=self.config.model.encode_chunk,
            )
            read = {DECODED_TRUTH: truth}
            for each in self.subject.contenders:
                with each.switched():
                    imagined = imagined_latents(each.model, start, actions)
                read[each.name] = torch.cat([start.latents[None], imagined.to(start.latents)])
            moved = true[1:] - true[0]
            length = np.linalg.norm(moved, axis=1)
            with np.errstate(invalid="ignore", divide="ignore"):
                along = {
                    source: _along(self.reader.of(latents), moved / length[:, None]) for source, latents in read.items()
                }
            cells.append(Cell(name, first, action, np.nan_to_num(length), along))
        return cells

    def _start(self, window: tuple[int, int]) -> tuple[Start, str]:
        (batch,) = batches_of(self.dataset, [window], batch_size=1)
        model, chunk = self.subject.world_model, self.config.model.encode_chunk
        latents = encode_batch(model, batch, device=model.device, chunk=chunk)
        return Start.of(latents, self.dataset.spaces.state), batch.episode_ids[0]


def _along(read: Float[np.ndarray, "time 2"], direction: Float[np.ndarray, "steps 2"]) -> Float[np.ndarray, " steps"]:
    """Return the displacements since the start along directions."""
    return np.asarray(((read[1:] - read[0]) * direction).sum(axis=1))
