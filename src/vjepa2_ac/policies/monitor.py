"""The anomaly monitor: prediction errors by patch, and a threshold calibrated on undisturbed held-out episodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import read_batches
from vjepa2_ac.data.windows import require_frames, require_stride
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.world_model import Fingerprints, WorldModel
from vjepa2_ac.planning.cameras import Cameras
from vjepa2_ac.planning.controller import Compare, Surprise
from vjepa2_ac.planning.energy import mean_difference
from vjepa2_ac.storage.structured import parse_record, read_json_object

MONITOR = "monitor.json"
_FIX = "Calibrate a monitor with `vjepa2-ac monitor RUN`"
Number = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
MAX_EPISODES = 200  # largest number of episodes for a calibration
_BATCH_SIZE = 16


def compute_surprise(
    errors: Float[Tensor, "*batch tokens"], expected: Float[Tensor, "*batch tokens"] | Float[Tensor, " tokens"]
) -> Float[Tensor, "*batch"]:
    """Return the surprise of each step: the mean over patches of the error's excess over the patch's usual error."""
    return (errors - expected).clamp(min=0.0).mean(dim=-1)


@dataclass(frozen=True)
class Monitor:
    """The threshold of an anomaly monitor, and the held-out episodes that it was calibrated on."""

    format: Literal["vjepa2-ac monitor 1"]
    threshold: Number
    false_alarms: Number  # guaranteed upper bound on the share of undisturbed episodes of the same length with an alarm
    steps: int  # model steps of the longest calibration episode
    scores: tuple[Number, ...]  # highest surprise of each calibration episode
    expected: tuple[Number, ...]  # usual error of each patch (mean over all steps); valid for a fixed camera
    encoder: str
    predictor: str

    def compare(self, predicted: Float[Tensor, "tokens dim"], observed: Float[Tensor, "tokens dim"]) -> Surprise:
        """Return the surprise of a frame, given its prediction."""
        errors = mean_difference(predicted, observed).float().cpu()
        score = float(compute_surprise(errors, torch.tensor(self.expected)))
        return Surprise(score, errors, not score <= self.threshold)  # NaN is also an alarm

    @classmethod
    def read(cls, path: str | Path, known: Fingerprints, *, tokens: int, where: str) -> Monitor:
        """Read a monitor.json, and check that it was calibrated for a model.

        Args:
            path: The file, or its folder.
            known: Fingerprints of the model.
            tokens: Number of tokens of a frame.
            where: The config key or option that names the path, for messages.

        Raises:
            InputError: There is no such file, or it was calibrated for another model.
        """
        file = Path(path) / MONITOR if Path(path).is_dir() else Path(path)
        values = read_json_object(file, needed="a valid monitor.json", fix=_FIX)
        monitor = parse_record(cls, values, where=f"{where}: {file}", needed="a valid monitor.json", fix=_FIX)
        is_same_model = (monitor.encoder, monitor.predictor) == (known.encoder, known.predictor)
        if not is_same_model or len(monitor.expected) != tokens:
            raise InputError(
                where=f"{where}: {file}", found="a monitor that was calibrated for another model", fix=_FIX
            )
        return monitor


def load_monitor_for_planning(path: str, known: Fingerprints, cameras: Cameras) -> Compare:
    """Read `planning.monitor`, and return its function that compares a frame with its prediction.

    Raises:
        InputError: The file cannot be read, or was calibrated for another model.
    """
    return Monitor.read(path, known, tokens=cameras.model.num_tokens, where="planning.monitor").compare


def compute_conformal_threshold(scores: Float[Tensor, " episodes"], false_alarms: float) -> float:
    """Return the score that a new undisturbed episode exceeds with a probability of at most `false_alarms`.

    Split conformal prediction: the k-th smallest of n scores with k = ceil((n + 1) (1 - false_alarms)). It assumes that
    the episodes are exchangeable. Source: Angelopoulos and Bates, arXiv 2107.07511, section 1.

    Raises:
        InputError: There are too few episodes for this probability.
    """
    count = len(scores)
    rank = -int(-(count + 1) * (1.0 - false_alarms) // 1)
    if not 1 <= rank <= count:
        needed = f"at least {int(-(-1 // false_alarms)) - 1} episodes" if false_alarms > 0 else "a share above 0"
        problem = f"{counted(count, 'held-out episode')} for a false alarm rate of {false_alarms:.1%}"
        fix = "Record more episodes, or raise data.test_share or --false-alarms"
        raise InputError(where="--false-alarms", found=problem, needed=needed, fix=fix)
    return float(torch.sort(scores).values[rank - 1])


@dataclass(frozen=True, eq=False)
class EpisodeErrors:
    """The prediction errors of each model step of an episode."""

    name: str
    steps: Int[np.ndarray, " time"]  # control step of each predicted frame
    errors: Float[np.ndarray, "time tokens"]

    def compute_scores(self, expected: Sequence[float] | np.ndarray) -> Float[np.ndarray, " time"]:
        """Return the surprise of each step, given the usual error of each patch."""
        return compute_surprise(torch.from_numpy(self.errors), torch.tensor(np.asarray(expected))).numpy()

    def find_first_alarm(self, monitor: Monitor) -> int | None:
        """Return the index of the first step whose surprise is above the threshold; None: there is none."""
        alarms = np.flatnonzero(~(self.compute_scores(monitor.expected) <= monitor.threshold))
        return int(alarms[0]) if len(alarms) else None


@torch.no_grad()
def measure_episodes(
    model: WorldModel, dataset: Dataset, episodes: Iterable[int], progress: Progress = no_progress
) -> Iterator[EpisodeErrors]:
    """Yield the prediction errors of episodes: each frame is predicted from the previous frame, as in planning.

    Args:
        model: The model, merged and in eval mode.
        dataset: The data set with the episodes and their frames.
        episodes: Indices of the episodes; episodes with a single frame are left out.
        progress: Called with (done, total) in episodes.

    Raises:
        InputError: An episode cannot be read.
    """
    config, indices = dataset.config, list(episodes)
    pairs = replace(dataset, config=config.model_copy(update={"camera": config.cameras[0]})).with_frames(2)
    stride = config.model_stride
    for done, index in enumerate(indices, start=1):
        length = len(dataset.source.read(index).states)
        starts = range(0, length - stride, stride)
        errors = []
        for batch in read_batches(pairs, [(index, start) for start in starts], batch_size=_BATCH_SIZE):
            observed = encode_batch(model, batch, device=model.device, chunk=_BATCH_SIZE)
            camera = None if observed.extrinsics is None else observed.extrinsics[:, :1]
            predicted = model.predict(observed.latents[:, :1], observed.actions, observed.states[:, :1], camera)
            errors.append(mean_difference(predicted[:, 0].float(), observed.latents[:, 1]).cpu())
        if errors:
            all_errors = torch.cat(errors).double().numpy()
            yield EpisodeErrors(dataset.table.identity(index), np.array(starts) + stride, all_errors)
        progress(done, len(indices))


def calibrate_monitor(
    model: WorldModel, dataset: Dataset, false_alarms: float, progress: Progress = no_progress
) -> Monitor:
    """Calibrate a monitor on held-out episodes, so that false alarms do not exceed a given rate.

    Args:
        model: The model, merged and in eval mode.
        dataset: The data set. At most 200 validation and test episodes are used.
        false_alarms: Maximum fraction of undisturbed episodes with an alarm.
        progress: Called with (done, total) in episodes.

    Raises:
        InputError: There are too few episodes, or an episode cannot be read.
    """
    require_frames(dataset.config, to="calibrate a monitor")
    require_stride(dataset.config, to="calibrate a monitor")
    held_out = np.flatnonzero(dataset.split_mask("validation") | dataset.split_mask("test"))
    chosen = held_out[np.linspace(0, len(held_out), min(MAX_EPISODES, len(held_out)), endpoint=False).astype(int)]
    if not len(chosen):
        needed = "validation or test episodes, on which the threshold is calibrated"
        raise InputError(where=f"data.path: {dataset.config.path}", found="no held-out episodes", needed=needed)
    episode_errors = list(measure_episodes(model, dataset, chosen.tolist(), progress))
    if len(episode_errors) < 2:
        raise InputError(where=f"data.path: {dataset.config.path}", found="one held-out episode", needed="at least two")
    sums = np.stack([episode.errors.sum(axis=0) for episode in episode_errors])
    steps = np.array([len(episode.errors) for episode in episode_errors])
    # Leave-one-out mean as the usual error, so that an episode does not lower its own scores.
    highest = [
        episode.compute_scores((sums.sum(axis=0) - sums[index]) / (steps.sum() - steps[index])).max()
        for index, episode in enumerate(episode_errors)
    ]
    known = model.fingerprints()
    return Monitor(
        format="vjepa2-ac monitor 1",
        threshold=compute_conformal_threshold(torch.tensor(highest), false_alarms),
        false_alarms=false_alarms,
        steps=int(steps.max()),
        scores=tuple(map(float, highest)),
        expected=tuple((sums.sum(axis=0) / steps.sum()).tolist()),
        encoder=known.encoder,
        predictor=known.predictor,
    )
