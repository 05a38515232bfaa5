"""Does the imagined hand move to the true side? Actions that were not taken, from held-out starts of simulated data.

From each start every model imagines what happens under named actions (up, down, ...), its images are decoded, and the
hand's position is read from them by a probe that was fitted on true frames. The simulator carries out the same actions.
A cell counts as right if the imagined displacement, along the true one in the image, is above 0: chance, and a model
that ignores its actions, is 0.5. Where the hand truly moves by less than 2 pixels, no side is the true one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import batches_of, validation_windows
from vjepa2_ac.data.transforms import frames_as_seen, view
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder, load_decoder
from vjepa2_ac.decoding.frame_pairs import as_images
from vjepa2_ac.decoding.imagine import Start, imagined_latents
from vjepa2_ac.distributed.processes import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch, encode_frames
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.decoded.hand import HandPositions, HandProbe
from vjepa2_ac.evaluation.decoded_rollouts.setup import fitted_probe
from vjepa2_ac.evaluation.request import EvaluationOptions, settle
from vjepa2_ac.evaluation.subject import Subject, load_subject
from vjepa2_ac.intervals import Estimate, share_of
from vjepa2_ac.planning.counterfactual import STEP_M, named_actions
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
from vjepa2_ac.simulation.counterfactual import Outcome, resimulate
from vjepa2_ac.simulation.hand_in_images import hand_positions
from vjepa2_ac.simulation.world.camera import HAND_MIDDLE_M

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
    setup = open_setup(subject, asked, reporter)
    positions = setup.positions()
    probe = fitted_probe(setup.dataset, positions, setup.image_size)
    names = [name for pair in AXES.values() for name in pair]
    starts = setup.counterfactuals(names, reporter)
    cells = tuple(_cell(case, positions, probe) for cases in starts for case in cases.values())
    return Sides(cells, setup.sources, setup.image_size, probe.fitted_on)


def open_setup(subject: str, asked: SidesOptions, reporter: Reporter = SILENT) -> CounterfactualSetup:
    """Load the decoder, the data and the models. Cheap failures first.

    Raises:
        InputError: Subject, data or decoder cannot be used; or the data were not simulated.
    """
    decoder = load_decoder(asked.decoder)
    config, planning, _ = settle(subject, asked.evaluation, frames=asked.steps + 1)
    accelerator = make_accelerator(config)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    _positions_in(dataset, decoder.card.shape.image_size)
    loaded = load_subject(subject, config, asked.evaluation, dataset, decoder)
    loaded.put_on(accelerator.device)
    decoder = decoder.to(accelerator.device)
    return CounterfactualSetup(asked, config, planning.limits, dataset, loaded, decoder, accelerator.autocast)


def _positions_in(dataset: Dataset, size: int, along_m: float = HAND_MIDDLE_M) -> HandPositions:
    """Return where a point of the hand is in images of a size, or refuse the data."""
    positions = hand_positions(dataset, size, along_m=along_m)
    if isinstance(positions, str) or dataset.config.is_cache:
        found = positions if isinstance(positions, str) else "latents of a cache, which has no frames"
        raise InputError(where=dataset.config.path, found=found, needed="a data set that `simulate record` made")
    return positions


@dataclass(frozen=True, eq=False)
class Counterfactual:
    """What happens from one start under a named action, and what is imagined: at the start and after each step."""

    episode_id: str
    start: int  # control step
    name: str  # of the action
    outcome: Outcome
    seen: Float[torch.Tensor, "time 3 size size"]  # the outcome's frames as the encoder sees them, 0 .. 1
    latents: Mapping[str, Float[torch.Tensor, "time tokens dim"]]  # source -> encoded truth, or a rollout
    decoded: Mapping[str, Float[torch.Tensor, "time 3 size size"]]  # source -> these as images, 0 .. 1


@dataclass(frozen=True, eq=False)
class CounterfactualSetup:
    """Models, a decoder and simulated data. Use `open_setup` to make one."""

    asked: SidesOptions
    config: Config
    limits: LimitsConfig
    dataset: Dataset
    subject: Subject
    decoder: TrainedDecoder
    autocast: Callable[[], AbstractContextManager[object]]  # to the run's precision

    @property
    def sources(self) -> tuple[str, ...]:
        """What is decoded: the truth, and the models' rollouts."""
        return (DECODED_TRUTH, *(one.name for one in self.subject.contenders))

    @property
    def image_size(self) -> int:
        """Height and width of the images, in pixels."""
        return self.decoder.card.shape.image_size

    def positions(self, along_m: float = HAND_MIDDLE_M) -> HandPositions:
        """Return where a point of the hand is in the images; `along_m` as of `hand_positions`."""
        return _positions_in(self.dataset, self.image_size, along_m)

    def counterfactuals(self, names: Sequence[str], reporter: Reporter = SILENT) -> Iterator[dict[str, Counterfactual]]:
        """Yield what happens from each start, by the name of the action.

        Raises:
            InputError: The split has no clips, or the simulator shows something else than was recorded.
        """
        windows = validation_windows(self.dataset, self.asked.split, clips=self.asked.starts)
        progress = reporter.task("actions that were not taken", "starts")
        for done, window in enumerate(windows, 1):
            with self.autocast():
                cases = self._from(window, names)
            yield cases
            progress(done, len(windows))

    def _from(self, window: tuple[int, int], names: Sequence[str]) -> dict[str, Counterfactual]:
        episode, first = window
        camera = self.config.data.cameras[0]
        arm = resimulate(self.config.data.path, self.dataset.source.read(episode, camera), first, camera)
        start, episode_id = self._start(window)
        cases, crop = {}, self.config.data.crop
        for name in names:
            actions = named_actions(name, self.asked.steps, size_m=self.asked.size_m, limits=self.limits)
            outcome = arm.under(actions, self.config.data.model_stride)
            encoded = encode_frames(
                self.subject.world_model, outcome.frames, crop, chunk=self.config.model.encode_chunk
            )
            latents = {DECODED_TRUTH: encoded}
            for each in self.subject.contenders:
                with each.switched():
                    imagined = imagined_latents(each.model, start, actions)
                latents[each.name] = torch.cat([start.latents[None], imagined.to(start.latents)])
            decoded = {source: self._decoded(one) for source, one in latents.items()}
            seen = torch.from_numpy(frames_as_seen(view(outcome.frames, crop), self.image_size)).permute(0, 3, 1, 2)
            cases[name] = Counterfactual(episode_id, first, name, outcome, as_images(seen), latents, decoded)
        return cases

    def _start(self, window: tuple[int, int]) -> tuple[Start, str]:
        (batch,) = batches_of(self.dataset, [window], batch_size=1)
        model, chunk = self.subject.world_model, self.config.model.encode_chunk
        latents = encode_batch(model, batch, device=model.device, chunk=chunk)
        return Start.of(latents, self.dataset.spaces.state), batch.episode_ids[0]

    def _decoded(self, latents: torch.Tensor) -> torch.Tensor:
        with torch.autocast(latents.device.type, enabled=False), torch.no_grad():
            return self.decoder.decoder.decode(latents.float())


def _cell(case: Counterfactual, positions: HandPositions, probe: HandProbe) -> Cell:
    """Return how far the hand moves in the images, along the true displacement."""
    true = positions(case.episode_id, case.outcome.states)
    moved = true[1:] - true[0]
    length = np.linalg.norm(moved, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = {source: _along(probe.read(images), moved / length[:, None]) for source, images in case.decoded.items()}
    return Cell(case.episode_id, case.start, case.name, np.nan_to_num(length), along)


def _along(read: Float[np.ndarray, "time 2"], direction: Float[np.ndarray, "steps 2"]) -> Float[np.ndarray, " steps"]:
    """Return the displacements since the start along directions."""
    return np.asarray(((read[1:] - read[0]) * direction).sum(axis=1))
