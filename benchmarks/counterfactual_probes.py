"""Counterfactuals of simulated data: what models imagine under actions that were not taken, read by linear probes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import batches_of, validation_windows
from vjepa2_ac.data.transforms import Crop, crop_box, frames_as_seen, input_to_pixels, pixels_to_input, view
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder, load_decoder
from vjepa2_ac.decoding.imagine import Start, imagined_latents
from vjepa2_ac.decoding.network import as_images
from vjepa2_ac.distributed.processes import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch, encode_frames
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import Subject, load_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, settle
from vjepa2_ac.intervals import Estimate, ratio, share_of
from vjepa2_ac.planning.counterfactual import STEP_M, named_actions
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
from vjepa2_ac.simulation.counterfactual import RECORDED_CAMERAS, Outcome, camera_of, resimulate
from vjepa2_ac.simulation.recording.simulation_file import SIMULATION_FILE, read_simulation
from vjepa2_ac.simulation.world.camera import FINGERS_MIDDLE_M, FRAME_SIZE, HAND_MIDDLE_M, hand_pixels

_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # over the mean squared norm of the features
_FOLDS = 4  # of episodes, among which the ridge is chosen


@dataclass(frozen=True, eq=False)
class LinearReader:
    """Reads numbers from features."""

    mean: Float[Tensor, " features"]
    weights: Float[Tensor, "features targets"]
    offset: Float[Tensor, " targets"]  # the mean of the targets
    fitted_on: tuple[int, int]  # frames, episodes

    def of(self, features: Float[Tensor, "frames features"]) -> Float[np.ndarray, "frames targets"]:
        """Return what the features say."""
        return np.asarray(((features.to(self.mean) - self.mean) @ self.weights + self.offset).numpy())


def fit_ridge(
    features: Float[Tensor, "frames features"],
    targets: Float[np.ndarray, "frames targets"],
    episode_ids: Sequence[str],
) -> LinearReader:
    """Fit targets to features; frames with a target of NaN do not count.

    Args:
        features: In any float type; computed with in float64.
        targets: What is to be read.
        episode_ids: Of each frame.

    Raises:
        InputError: Fewer than two episodes have targets.
    """
    known = np.isfinite(targets).all(axis=1)
    names, fold = np.unique(np.array(episode_ids)[known], return_inverse=True)
    if len(names) < 2:
        raise InputError(
            where="a probe of the hand",
            found=f"{len(names)} episodes of the training split with a hand in the image",
            needed="two, to choose the ridge",
        )
    features = features[torch.from_numpy(known)].double()
    true = torch.from_numpy(targets[known]).double()
    of_fold = torch.from_numpy(fold % min(_FOLDS, len(names)))
    errors = [0.0] * len(_RIDGES)
    for left_out in range(int(of_fold.max()) + 1):
        rest = of_fold != left_out
        for place, (mean, weights, offset) in enumerate(_fits(features[rest], true[rest])):
            read = (features[~rest] - mean) @ weights + offset
            errors[place] += float((read - true[~rest]).norm(dim=1).sum())
    mean, weights, offset = _fits(features, true)[int(np.argmin(errors))]
    return LinearReader(mean, weights, offset, (len(features), len(names)))


def _fits(features: Tensor, true: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return mean, weights and offset for every ridge, from one decomposition."""
    mean, offset = features.mean(dim=0), true.mean(dim=0)
    centred = features - mean
    values, vectors = torch.linalg.eigh(centred @ centred.T)
    inside = vectors.T @ (true - offset)
    scale = values.mean()
    return [
        (mean, centred.T @ (vectors @ (inside / (values.clamp(min=0) + ridge * scale)[:, None])), offset)
        for ridge in _RIDGES
    ]


HandPositions = Callable[[str, Float[np.ndarray, "time 7"]], Float[np.ndarray, "time 2"]]
"""From the id of an episode and its states to positions in the image; NaN: behind the camera."""

_SIDE = 32  # pixels, to which images are shrunk


class HandProbe(LinearReader):
    """Reads the position of the hand from images of one size."""

    def read(self, images: Float[Tensor, "*batch 3 size size"]) -> Float[np.ndarray, "*batch 2"]:
        """Return x and y in pixels."""
        found = self.of(_features(images.reshape(-1, *images.shape[-3:])))
        return found.reshape(*images.shape[:-3], 2)


def fit_hand_probe(
    images: Float[Tensor, "frames 3 size size"],
    positions: Float[np.ndarray, "frames 2"],
    episode_ids: Sequence[str],
) -> HandProbe:
    """Fit a probe to true frames; the ridge is that of the smallest error on left-out episodes.

    Args:
        images: In 0 .. 1, as the encoder sees them.
        positions: Of the hand; frames with NaN do not count.
        episode_ids: Of each frame.

    Raises:
        InputError: Fewer than two episodes show a hand.
    """
    fit = fit_ridge(_features(images), positions, episode_ids)
    return HandProbe(fit.mean, fit.weights, fit.offset, fit.fitted_on)


def _features(images: Float[Tensor, "frames 3 size size"]) -> Float[Tensor, "frames features"]:
    small = torch.nn.functional.interpolate(images.float().cpu(), size=(_SIDE, _SIDE), mode="area")
    return small.flatten(1)


_GRIPPER_SIDE = 96  # pixels, to which images are resized
_PATCH = 20  # pixels of these


class GripperProbe(LinearReader):
    """Reads the closedness of the gripper (0 open, 1 closed) from images of one size."""

    def read(
        self, images: Float[Tensor, "frames 3 size size"], centres: Float[np.ndarray, "frames 2"]
    ) -> Float[np.ndarray, " frames"]:
        """Return closedness; what is read may be beyond 0 .. 1.

        Args:
            images: In 0 .. 1, as the encoder sees them.
            centres: Where the fingers are: x, y in pixels; beyond the image its edge goes on.
        """
        return self.of(_patches(images, centres))[:, 0]


def fit_gripper_probe(
    images: Float[Tensor, "frames 3 size size"],
    centres: Float[np.ndarray, "frames 2"],
    closedness: Float[np.ndarray, " frames"],
    episode_ids: Sequence[str],
) -> GripperProbe:
    """Fit a probe to true frames; frames where a centre is NaN do not count.

    Args:
        images: In 0 .. 1, as the encoder sees them.
        centres: Where the fingers are: x, y in pixels.
        closedness: Of the gripper, as measured.
        episode_ids: Of each frame.

    Raises:
        InputError: Fewer than two episodes show a gripper.
    """
    seen = np.isfinite(centres).all(axis=1)
    targets = np.where(seen, closedness, np.nan)[:, None]
    fit = fit_ridge(_patches(images, np.nan_to_num(centres)), targets, episode_ids)
    return GripperProbe(fit.mean, fit.weights, fit.offset, fit.fitted_on)


def _patches(
    images: Float[Tensor, "frames 3 size size"], centres: Float[np.ndarray, "frames 2"]
) -> Float[Tensor, "frames features"]:
    """Return the colours around the centres, between pixels by bilinear interpolation."""
    middles = torch.from_numpy(np.asarray(centres, dtype=np.float32)) / images.shape[-1] * 2 - 1  # -1 .. 1: the edges
    small = torch.nn.functional.interpolate(images.float().cpu(), size=(_GRIPPER_SIDE, _GRIPPER_SIDE), mode="area")
    offsets = (torch.arange(_PATCH) - (_PATCH - 1) / 2) / _GRIPPER_SIDE * 2
    x = (middles[:, 0, None] + offsets)[:, None, :].expand(-1, _PATCH, -1)
    y = (middles[:, 1, None] + offsets)[:, :, None].expand(-1, -1, _PATCH)
    grid = torch.stack([x, y], dim=-1)
    return torch.nn.functional.grid_sample(small, grid, padding_mode="border", align_corners=False).flatten(1)


_BATCH = 16
MOST_CLIPS = 255  # of the training split, for the probe: so few are read without worker processes


def fitted_probe(dataset: Dataset, positions: HandPositions, size: int) -> HandProbe:
    """Return a probe fitted on true frames of the training split, as the encoder sees them.

    Raises:
        InputError: The split has no clips, or fewer than two episodes that show the hand.
    """
    images, found, ids = [], [], []
    for seen, states, name in frames_of_training(dataset, size):
        images.append(seen)
        found.append(positions(name, states))
        ids += [name] * len(seen)
    return fit_hand_probe(torch.cat(images), np.concatenate(found), ids)


def frames_of_training(
    dataset: Dataset, size: int
) -> Iterator[tuple[Float[Tensor, "time 3 size size"], Float[np.ndarray, "time state_dim"], str]]:
    """Yield true frames of the training split as the encoder sees them, their states and the id of their episode.

    Raises:
        InputError: The split has no clips.
    """
    for batch in batches_of(dataset, validation_windows(dataset, "train", clips=MOST_CLIPS), batch_size=_BATCH):
        if batch.frames is None:
            raise ValueError("a batch without frames")
        seen = as_images(input_to_pixels(pixels_to_input(batch.frames, size)))
        for row, name in enumerate(batch.episode_ids):
            yield seen[row], batch.states[row].double().numpy(), name


_FIXED = "exterior"


def hand_positions(dataset: Dataset, size: int, *, along_m: float = HAND_MIDDLE_M) -> HandPositions | str:
    """Return where the hand is in images of the encoder's size; or why nobody knows.

    Args:
        dataset: Its clips are of the config's first camera.
        size: Height and width of an image, in pixels.
        along_m: Distance of the point from the flange, towards the fingers; the middle of the hand by default.
    """
    config = dataset.config
    if not (Path(config.path) / SIMULATION_FILE).is_file():
        return f"the data were not simulated: no {SIMULATION_FILE} beside them"
    if not dataset.spaces.state.is_base_pose:
        return "the states are not poses in the robot base frame"
    if (camera := config.cameras[0]) not in RECORDED_CAMERAS:
        return f"the simulator has no camera {camera}"
    try:
        simulation = read_simulation(config.path)
    except InputError as error:
        return str(error)
    seen_by = camera_of(simulation, camera)
    if not seen_by.startswith(_FIXED):
        return f"{camera} moves with the hand"

    def positions(episode_id: str, states: Float[np.ndarray, "time 7"]) -> Float[np.ndarray, "time 2"]:
        world = simulation.world_of(episode_id)
        found = hand_pixels(np.asarray(states, np.float64), world, seen_by, along_m=along_m)
        return as_seen(found, config.crop, size)

    return positions


def as_seen(positions: Float[np.ndarray, "time 2"], crop: Crop, size: int) -> Float[np.ndarray, "time 2"]:
    """Return positions in a recorded frame as positions in what the encoder sees of it: cropped, then squashed."""
    height, width = FRAME_SIZE
    if crop == "letterbox":
        side = max(height, width)
        left, top = -((side - width) // 2), -((side - height) // 2)
        seen = side, side
    else:
        box = crop_box(height, width, crop)
        left, top, seen = box.left, box.top, (box.width, box.height)
    return np.asarray((positions - (left, top)) * size / np.array(seen, dtype=np.float64))


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


ACTIONS = ("open", "close")
TRUE_FRAMES = "true_frames"
LEAST_CLOSEDNESS = 0.25
_NONE, _GRIPPER = "none", 6


@dataclass(frozen=True)
class GripperCell:
    """One start under `open` or `close`, after each model step: differences of closedness to `none`."""

    episode_id: str
    start: int  # control step
    name: str  # of the action
    true: Float[np.ndarray, " steps"]  # measured by the simulator
    read: Mapping[str, Float[np.ndarray, " steps"]]  # source -> read from its images
    latent: Mapping[str, Float[np.ndarray, " steps"]]  # source -> inner product of its latents' difference and the true


@dataclass(frozen=True)
class Reading:
    """How well the probe reads a source whose closedness is known: of all true outcomes, start included."""

    error: float  # mean absolute, of closedness
    error_of_mean: float  # of always saying the mean of the frames on which the probe was fitted


@dataclass(frozen=True)
class GripperSides:
    """The cells of all starts, and what they were read with."""

    cells: tuple[GripperCell, ...]
    sources: tuple[str, ...]  # true frames: what the probe can do; decoded truth: what the decoder shows; models
    image_px: int
    probe_fitted_on: tuple[int, int]  # frames, episodes
    readings: Mapping[str, Reading]  # of true frames and decoded truth

    def of(self, source: str, action: str | None = None, step: int = -1) -> Side:
        """Return the count for one source, under an action (None: both), after a model step (-1: last)."""
        counted = self._counted(action, step)
        right = sum(bool(cell.read[source][step] * cell.true[step] > 0) for cell in counted)
        cells = sum(action in {None, cell.name} for cell in self.cells)
        return Side(right, len(counted), cells - len(counted))

    def extent(self, source: str, action: str | None = None, step: int = -1) -> Estimate | None:
        """Return the mean difference that is read over the true one, with an interval over episodes.

        1: as far as in truth; 0: not at all; below 0: the other way. None: no cell counts.
        """
        counted = self._counted(action, step)
        if not counted:
            return None
        true = np.array([cell.true[step] for cell in counted])
        read = np.array([cell.read[source][step] for cell in counted])
        return ratio(read * np.sign(true), np.abs(true), [cell.episode_id for cell in counted])

    def extent_in_latents(self, source: str, action: str | None = None, step: int = -1) -> Estimate | None:
        """Return how far the difference of latents goes along the true one: the same without decoder and probe.

        1: as far as in truth; 0: not at all. None: no cell counts, or the source has no latents.
        """
        counted = self._counted(action, step)
        if not counted or source not in counted[0].latent:
            return None
        along, whole = (np.array([cell.latent[one][step] for cell in counted]) for one in (source, DECODED_TRUTH))
        return ratio(along, whole, [cell.episode_id for cell in counted])

    def _counted(self, action: str | None, step: int) -> list[GripperCell]:
        return [cell for cell in self.cells if action in {None, cell.name} and _counts(cell, step)]


def measure_gripper(subject: str, asked: SidesOptions, *, reporter: Reporter = SILENT) -> GripperSides:
    """Measure a run, or a model with `asked.evaluation.data`, on held-out starts of simulated data.

    Raises:
        InputError: Subject, data or decoder cannot be used; the data were not simulated; or `planning.limits.gripper`
            is 0.
    """
    setup = open_setup(subject, asked, reporter)
    fingers = setup.positions(FINGERS_MIDDLE_M)
    probe = _fitted(setup, fingers)
    cells: list[GripperCell] = []
    states: list[Float[np.ndarray, "time 7"]] = []
    readings: list[Mapping[str, Float[np.ndarray, " time"]]] = []
    for cases in setup.counterfactuals((_NONE, *ACTIONS), reporter):
        read = {name: _read(case, fingers, probe) for name, case in cases.items()}
        cells += [_gripper_cell(cases, read, name) for name in ACTIONS]
        states += [case.outcome.states for case in cases.values()]
        readings += read.values()
    sources = (TRUE_FRAMES, *setup.sources)
    known = {
        source: _reading(np.concatenate([read[source] for read in readings]), np.concatenate(states), probe)
        for source in (TRUE_FRAMES, DECODED_TRUTH)
    }
    return GripperSides(tuple(cells), sources, setup.image_size, probe.fitted_on, known)


def _gripper_cell(
    cases: Mapping[str, Counterfactual], read: Mapping[str, Mapping[str, Float[np.ndarray, " time"]]], name: str
) -> GripperCell:
    """Return the differences between an action and none."""
    case, unmoved = cases[name], cases[_NONE]
    true = (case.outcome.states - unmoved.outcome.states)[1:, _GRIPPER]
    differences = {source: (values - read[_NONE][source])[1:] for source, values in read[name].items()}
    moved = {source: (latents - unmoved.latents[source])[1:].double() for source, latents in case.latents.items()}
    along = {source: (one * moved[DECODED_TRUTH]).sum(dim=(1, 2)).cpu().numpy() for source, one in moved.items()}
    return GripperCell(case.episode_id, case.start, name, true, differences, along)


def _reading(read: Float[np.ndarray, " frames"], states: Float[np.ndarray, "frames 7"], probe: GripperProbe) -> Reading:
    off = [float(np.abs(guess - states[:, _GRIPPER]).mean()) for guess in (read, probe.offset.numpy())]
    return Reading(*off)


def _fitted(setup: CounterfactualSetup, fingers: HandPositions) -> GripperProbe:
    images, centres, closedness, ids = [], [], [], []
    for seen, states, name in frames_of_training(setup.dataset, setup.image_size):
        images.append(seen)
        centres.append(fingers(name, states))
        closedness.append(states[:, _GRIPPER])
        ids += [name] * len(seen)
    return fit_gripper_probe(torch.cat(images), np.concatenate(centres), np.concatenate(closedness), ids)


def _read(case: Counterfactual, fingers: HandPositions, probe: GripperProbe) -> dict[str, Float[np.ndarray, " time"]]:
    """Return the closedness in the images of each source, where the fingers are at the start: the hand stays there."""
    centre = fingers(case.episode_id, case.outcome.states[:1])
    images = {TRUE_FRAMES: case.seen, **case.decoded}
    return {source: probe.read(shown, np.repeat(centre, len(shown), axis=0)) for source, shown in images.items()}


def _counts(cell: GripperCell, step: int) -> bool:
    return bool(abs(cell.true[step]) >= LEAST_CLOSEDNESS)
