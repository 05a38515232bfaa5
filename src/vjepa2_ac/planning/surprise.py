"""Surprise: how far what is seen departs from what was predicted, by patch; and above which score that is an alarm."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.distances import absolute_difference
from vjepa2_ac.model.network.world_model import Fingerprints
from vjepa2_ac.storage.structured import read_json_object, record_of

MONITOR = "monitor.json"
_FIX = "Make it with `vjepa2-ac monitor RUN`"
Number = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


def error_by_patch(
    predicted: Float[Tensor, "*batch tokens dim"], seen: Float[Tensor, "*batch tokens dim"]
) -> Float[Tensor, "*batch tokens"]:
    """Return the mean absolute difference of each patch."""
    return absolute_difference(predicted, seen).mean(dim=-1)


def surprise_of(
    errors: Float[Tensor, "*batch tokens"], expected: Float[Tensor, "*batch tokens"] | Float[Tensor, " tokens"]
) -> Float[Tensor, "*batch"]:
    """Return the score of each step: by how much patches are farther off than is usual there, their mean."""
    return (errors - expected).clamp(min=0.0).mean(dim=-1)


@dataclass(frozen=True)
class Surprise:
    """What one step has shown."""

    score: float
    errors: Float[Tensor, " tokens"]  # of each patch, row by row
    is_alarm: bool  # the score is above the threshold

    @classmethod
    def of(cls, predicted: Float[Tensor, "tokens dim"], seen: Float[Tensor, "tokens dim"], by: Monitor) -> Surprise:
        """Compare a prediction with what is seen then."""
        errors = error_by_patch(predicted, seen).float().cpu()
        score = float(surprise_of(errors, torch.tensor(by.expected)))
        return cls(score, errors, not score <= by.threshold)  # NaN is an alarm, too


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
