"""The anomaly monitor: errors of predictions by patch, and the threshold that undisturbed held-out episodes give."""

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
from vjepa2_ac.data.loader import batches_of
from vjepa2_ac.data.windows import require_frames, require_stride
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.world_model import Fingerprints, WorldModel
from vjepa2_ac.planning.cameras import Cameras
from vjepa2_ac.planning.controller import Compare, Surprise
from vjepa2_ac.planning.energy import mean_difference
from vjepa2_ac.storage.structured import read_json_object, record_of

MONITOR = "monitor.json"
_FIX = "Make it with `vjepa2-ac monitor RUN`"
Number = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
MOST_EPISODES = 200  # that a threshold is of
_AT_ONCE = 16


def surprise_of(
    errors: Float[Tensor, "*batch tokens"], expected: Float[Tensor, "*batch tokens"] | Float[Tensor, " tokens"]
) -> Float[Tensor, "*batch"]:
    """Return the score of each step: by how much patches are farther off than is usual there, their mean."""
    return (errors - expected).clamp(min=0.0).mean(dim=-1)


@dataclass(frozen=True)
class Monitor:
    """A threshold that held-out episodes gave."""

    format: Literal["vjepa2-ac monitor 1"]
    threshold: Number
    false_alarms: Number  # promised share of undisturbed episodes with an alarm, as long as those
    steps: int  # model steps of the longest of them
    scores: tuple[Number, ...]  # highest of each episode
    expected: tuple[Number, ...]  # error of each patch, mean of all steps: the camera does not move
    encoder: str
    predictor: str

    def compare(self, predicted: Float[Tensor, "tokens dim"], seen: Float[Tensor, "tokens dim"]) -> Surprise:
        """Return the difference between a predicted frame and the frame."""
        errors = mean_difference(predicted, seen).float().cpu()
        score = float(surprise_of(errors, torch.tensor(self.expected)))
        return Surprise(score, errors, not score <= self.threshold)  # NaN is an alarm, too

    @classmethod
    def read(cls, path: str | Path, known: Fingerprints, *, tokens: int, where: str) -> Monitor:
        """Read a monitor.json, or that of a folder.

        Args:
            path: Of either.
            known: Of the model that is to be watched.
            tokens: Of a frame, to it.
            where: What names the file, for messages.

        Raises:
            InputError: There is none, or it is another model's.
        """
        file = Path(path) / MONITOR if Path(path).is_dir() else Path(path)
        values = read_json_object(file, needed="a monitor.json", fix=_FIX)
        found = record_of(cls, values, where=f"{where}: {file}", needed="a monitor.json", fix=_FIX)
        is_its = (found.encoder, found.predictor) == (known.encoder, known.predictor)
        if not is_its or len(found.expected) != tokens:
            raise InputError(where=f"{where}: {file}", found="the threshold of another model", fix=_FIX)
        return found


def read_for_planning(path: str, known: Fingerprints, cameras: Cameras) -> Compare:
    """Return the comparison of the monitor of `planning.monitor`.

    Raises:
        InputError: As `Monitor.read`.
    """
    return Monitor.read(path, known, tokens=cameras.model.num_tokens, where="planning.monitor").compare


def conformal_threshold(scores: Float[Tensor, " episodes"], false_alarms: float) -> float:
    """Return the score that a further undisturbed episode exceeds with at most this probability.

    Split conformal prediction: the k-th smallest of n scores, k = ceil((n + 1) (1 - false_alarms)), if episodes are
    exchangeable. Source: Angelopoulos and Bates, arXiv 2107.07511, section 1.

    Raises:
        InputError: There are too few episodes for this.
    """
    count = len(scores)
    place = -int(-(count + 1) * (1.0 - false_alarms) // 1)
    if not 1 <= place <= count:
        needed = f"{int(-(-1 // false_alarms)) - 1} at least" if false_alarms > 0 else "a share above 0"
        found = f"{counted(count, 'held-out episode')} for false alarms in {false_alarms:.1%}"
        fix = "Record more, raise data.test_share, or --false-alarms"
        raise InputError(where="--false-alarms", found=found, needed=needed, fix=fix)
    return float(torch.sort(scores).values[place - 1])


@dataclass(frozen=True, eq=False)
class WatchedEpisode:
    """The surprise of each model step of an episode."""

    name: str
    steps: Int[np.ndarray, " time"]  # control step of the frame that was predicted
    errors: Float[np.ndarray, "time tokens"]

    def scores(self, expected: Sequence[float] | np.ndarray) -> Float[np.ndarray, " time"]:
        """Return the surprise of each step, by what is usual of each patch."""
        return surprise_of(torch.from_numpy(self.errors), torch.tensor(np.asarray(expected))).numpy()

    def first_alarm(self, by: Monitor) -> int | None:
        """Return the first step of which the surprise is above the threshold; None: there is none."""
        above = np.flatnonzero(~(self.scores(by.expected) <= by.threshold))
        return int(above[0]) if len(above) else None


@torch.no_grad()
def watch_episodes(
    model: WorldModel, dataset: Dataset, episodes: Iterable[int], progress: Progress = no_progress
) -> Iterator[WatchedEpisode]:
    """Yield the surprise of episodes: each frame is predicted from the one before it, as a planner does.

    Args:
        model: Merged, in eval mode.
        dataset: Has the episodes, with their frames.
        episodes: Their indices; those of one frame are left out.
        progress: Called with (done, total) in episodes.

    Raises:
        InputError: An episode cannot be read.
    """
    config, chosen = dataset.config, list(episodes)
    pairs = replace(dataset, config=config.model_copy(update={"camera": config.cameras[0]})).with_frames(2)
    stride = config.model_stride
    for done, index in enumerate(chosen, start=1):
        length = len(dataset.source.read(index).states)
        starts = range(0, length - stride, stride)
        errors = []
        for batch in batches_of(pairs, [(index, start) for start in starts], batch_size=_AT_ONCE):
            seen = encode_batch(model, batch, device=model.device, chunk=_AT_ONCE)
            camera = None if seen.extrinsics is None else seen.extrinsics[:, :1]
            predicted = model.predict(seen.latents[:, :1], seen.actions, seen.states[:, :1], camera)
            errors.append(mean_difference(predicted[:, 0].float(), seen.latents[:, 1]).cpu())
        if errors:
            found = torch.cat(errors)
            yield WatchedEpisode(dataset.table.identity(index), np.array(starts) + stride, found.double().numpy())
        progress(done, len(chosen))


def calibrate_monitor(
    model: WorldModel, dataset: Dataset, false_alarms: float, progress: Progress = no_progress
) -> Monitor:
    """Return the threshold that at most a share of undisturbed episodes exceeds, from those that no training saw.

    Args:
        model: Merged, in eval mode.
        dataset: Whose validation and test episodes count, 200 at most.
        false_alarms: The share.
        progress: Called with (done, total) in episodes.

    Raises:
        InputError: There are too few, or one cannot be read.
    """
    require_frames(dataset.config, to="watch")
    require_stride(dataset.config, to="know how long a model step is")
    held_out = np.flatnonzero(dataset.members("validation") | dataset.members("test"))
    chosen = held_out[np.linspace(0, len(held_out), min(MOST_EPISODES, len(held_out)), endpoint=False).astype(int)]
    if not len(chosen):
        needed = "validation or test episodes, which the threshold is of"
        raise InputError(where=f"data.path: {dataset.config.path}", found="no held-out episodes", needed=needed)
    watched = list(watch_episodes(model, dataset, chosen.tolist(), progress))
    if len(watched) < 2:
        raise InputError(where=f"data.path: {dataset.config.path}", found="one held-out episode", needed="two or more")
    sums, steps = np.stack([one.errors.sum(axis=0) for one in watched]), np.array([len(one.errors) for one in watched])
    highest = [  # what is usual, by the other episodes: else an episode would seem calmer than a new one
        one.scores((sums.sum(axis=0) - sums[place]) / (steps.sum() - steps[place])).max()
        for place, one in enumerate(watched)
    ]
    known = model.fingerprints()
    return Monitor(
        format="vjepa2-ac monitor 1",
        threshold=conformal_threshold(torch.tensor(highest), false_alarms),
        false_alarms=false_alarms,
        steps=int(steps.max()),
        scores=tuple(map(float, highest)),
        expected=tuple((sums.sum(axis=0) / steps.sum()).tolist()),
        encoder=known.encoder,
        predictor=known.predictor,
    )
