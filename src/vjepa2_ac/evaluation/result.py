"""Evaluation results: records of arrays by clip, and estimates from them with intervals. PyTorch is not imported.

Axes: clips in one fixed order; horizon 1 .. H model steps ahead (index h - 1; H is frames - 1). All errors compare
layer-normalised latents, by all metrics that are registered. Estimates that compare two models are paired by clip. The
rows are made by `evaluation.rows`, the summary by `evaluation.summary`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from vjepa2_ac.intervals import Estimate, bootstrapped, mean_of, ratio, ratios
from vjepa2_ac.model.distances import absolute_difference, squared_difference
from vjepa2_ac.registry import METRICS

if TYPE_CHECKING:
    from torch import Tensor

SAME_ENERGY = 1e-6  # relative difference below which energies are equal: rounding decides no rank
PERSISTENCE = "persistence"  # in the column of models: a copy of frame 0


@dataclass(frozen=True)
class Metric:
    """A measure of predictions, of positive numbers: they are shown as ratios to those of persistence."""

    name: str  # in metrics.json
    label: str  # in tables and sentences
    explanation: str
    of: Callable[[Tensor, Tensor], Tensor]  # predicted and true [batch time tokens dim] -> [batch time]
    smaller_is_better: bool = True


def _l1(predicted: Tensor, true: Tensor) -> Tensor:
    return absolute_difference(predicted, true).mean(dim=(2, 3))


def _l2(predicted: Tensor, true: Tensor) -> Tensor:
    return squared_difference(predicted, true).mean(dim=(2, 3))


L1 = Metric("l1", "L1", "mean absolute difference", _l1)
L2 = Metric("l2", "L2", "mean squared difference", _l2)


def registered_metrics() -> tuple[Metric, ...]:
    """Return all metrics, other people's among them; L1, which models are trained on, comes first."""
    return tuple(METRICS.find(name) for name in METRICS.names())


Mode = Literal["teacher_forced", "rollout"]
Actions = Literal["true", "zero", "shuffled"]
Way = Literal["true", "zero", "shuffled", "persistence"]  # of predicting: with which actions, or by copying a frame
Role = Literal["base", "trained", "other"]

MODES: tuple[Mode, ...] = ("teacher_forced", "rollout")
ACTIONS: tuple[Actions, ...] = ("true", "zero", "shuffled")


@dataclass(frozen=True)
class About:
    """The description of an evaluation: model, data and settings."""

    subject: str  # the run or model, as given
    checkpoint: str  # which one, as text; "" for a model
    checkpoint_path: str  # likewise
    source: str  # data.source
    data: str  # data.path
    cameras: tuple[str, ...]
    split: str
    frames: int  # of a clip
    stride: int  # control steps per model step
    seconds_per_step: float
    seed: int
    version: str  # of this package
    time: str  # UTC
    is_base: bool = False  # the checkpoint has the weights of the base model


@dataclass(frozen=True)
class Clips:
    """The clips, and the size of their actions."""

    episode_ids: tuple[str, ...]
    starts: tuple[int, ...]  # first control step of each
    action_size: Float[np.ndarray, "clips horizon"]  # |dx, dy, dz| in cm; of vectors: the norm of the action
    moving: Bool[np.ndarray, "clips horizon"]  # of each step, by the rule in `moving_means`
    moving_means: str  # the rule, as text

    def __len__(self) -> int:
        return len(self.episode_ids)

    @property
    def episodes(self) -> int:
        """The number of episodes of the clips."""
        return len(set(self.episode_ids))


@dataclass(frozen=True)
class PredictionErrors:
    """The errors of one model and of persistence on some clips; row i of every array is clip i.

    Teacher-forced: frame h from the true frames before it. Rollout: from frame 0 alone, predictions fed back. Of
    persistence: copying frame h - 1, and frame 0. Horizon 1 is the same in both.
    """

    episode_ids: tuple[str, ...]
    arrays: Mapping[tuple[Way, Mode, str], Float[np.ndarray, "clips horizon"]]  # by way, mode and name of the metric

    def of(self, mode: Mode, metric: Metric = L1, way: Way = "true") -> Float[np.ndarray, "clips horizon"]:
        """Return the errors of one kind of prediction."""
        return self.arrays[way, mode, metric.name]


@dataclass(frozen=True)
class ActionRanking:
    """The action-ranking error: the fraction of alternative actions with a lower energy than the true action.

    It is measured on moves (`action_use.moves_of`) that are as large as planned ones, forwards and backwards in time.
    Chance: 0.5; a perfect model: 0. The errors of two models on the same moves may be compared pair by pair.
    """

    samples: int  # alternatives per move, in the box and on the shell
    reach: float  # half the width of the box along each of x, y, z, in metres
    episode_ids: tuple[str, ...]  # of each move
    ranks: Float[np.ndarray, " moves"]  # error of each move: mean of box and shell
    rank: Estimate  # their mean
    box: Estimate  # among actions that are uniform in the box
    shell: Estimate  # among actions as long as the true one, in any direction: tells direction from "nothing moves"
    spread: Estimate  # standard deviation of the energy over the box, over the error of persistence; 0: flat
    change: Estimate  # change of the prediction with actions of the box, over the same; 0: the action is ignored


@dataclass(frozen=True)
class Validation:
    """What a validation of a run measures."""

    errors: PredictionErrors
    ranking: ActionRanking | None  # None: not asked for


@dataclass(frozen=True)
class Landscape:
    """The L1 energy of one clip's first step over a grid of (dx, dy, dz); the rest of the action is the true one.

    The grid spans about the same on both sides of *zero* and has a node exactly at the true action, so a minimum at the
    true action is no artefact of the grid's centre.
    """

    episode_id: str
    start: int
    axes: Float[np.ndarray, "3 grid"]  # the evaluated actions along each axis, ascending; cm, or plain numbers
    energy: Float[np.ndarray, "grid grid grid"]  # indices: first, second, third axis
    true: Float[np.ndarray, " 3"]
    minimum: Float[np.ndarray, " 3"]  # where the energy is lowest (the mean if there are several)

    @property
    def distance(self) -> float:
        """The distance of the minimum to the true action, in the units of the axes."""
        return float(np.linalg.norm(self.minimum - self.true))

    @property
    def rank(self) -> float:
        """The fraction of the other nodes whose energy is below that of the true action; equal energies count half."""
        node = tuple(np.abs(self.axes - self.true[:, None]).argmin(axis=1))
        difference = self.energy - self.energy[node]
        is_equal = np.abs(difference) <= SAME_ENERGY * abs(self.energy[node])
        below = (difference < 0) & ~is_equal
        return float((below.sum() + (is_equal.sum() - 1) / 2) / (self.energy.size - 1))

    @property
    def sharpness(self) -> float:
        """The range of the energy over its mean; 0: flat."""
        return float(np.ptp(self.energy) / self.energy.mean())


LandscapeMeasure = Literal["distance", "rank", "sharpness"]


@dataclass(frozen=True)
class Landscapes:
    """Landscapes of some clips of one model."""

    axis_names: tuple[str, ...]  # three
    unit: str  # cm, or "" where the states are no poses
    maps: tuple[Landscape, ...]
    chance_distance: float  # mean distance of a node drawn at random to the true action

    @property
    def episode_ids(self) -> tuple[str, ...]:
        """The episode of each clip."""
        return tuple(one.episode_id for one in self.maps)

    def mean(self, measure: LandscapeMeasure) -> Estimate:
        """Return the mean of a measure over the clips."""
        return mean_of(self._values(measure), self.episode_ids)

    def difference(self, other: Landscapes, measure: LandscapeMeasure) -> Estimate:
        """Return the mean of a measure minus that of another model on the same clips, paired."""
        return mean_of(self._values(measure) - other._values(measure), self.episode_ids)

    def _values(self, measure: LandscapeMeasure) -> Float[np.ndarray, " clips"]:
        return np.array([getattr(one, measure) for one in self.maps])


@dataclass(frozen=True)
class LatentDistribution:
    """How the latents of one kind of prediction are distributed, compared with the true ones of the same clips.

    By horizon (index h - 1), but for `fvd`, which has one feature vector for each clip: see `evaluation.distribution`.
    """

    spread: tuple[Estimate, ...]  # 1: as varied as the truth
    mmd: tuple[Estimate, ...]  # squared, times 100; unbiased; no interval from one episode
    fvd: float  # Fréchet distance; biased upwards, the more the fewer clips
    variance: tuple[float, ...]  # trace of the covariance over clips, of these latents
    true_variance: tuple[float, ...]  # the same of the true latents: `spread` is the ratio


@dataclass(frozen=True, eq=False)
class DecodedStrip:
    """The images of one example clip."""

    why: str
    episode_id: str
    start: int
    rows: Mapping[str, UInt8[np.ndarray, "time size size 3"]]  # truth, decoded_truth, base, adapter; the first is given


@dataclass(frozen=True)
class DecodedRollouts:
    """What was measured of decoded rollouts. Frame 0 is given: horizons begin at 1.

    A *source* is a model's rollout under the true actions, or one of its neighbours: decoded truth (the ceiling of the
    decoder), decoded persistence (the floor), and raw persistence, a copy of the pixels of frame 0, which beats any
    decoder in PSNR where little moves.
    """

    decoder: Mapping[str, Any]  # what is known of it: folder, size, encoder, data, frames, steps, held_out
    sources: tuple[str, ...]  # the neighbours, then the models
    curves: Mapping[tuple[str, str], tuple[Estimate, ...]]  # by source and metric, such as psnr_db.moving.truth
    strips: tuple[DecodedStrip, ...] = ()
    notes: tuple[str, ...] = ()  # what is absent, and why; how many clips were left out
    # By source: Fréchet distance of the re-encoded images to the true latents; empty: the encoder was not loaded.
    fvd: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ModelResult:
    """The results of one model."""

    name: str  # base, adapter, model, or the name of another run
    role: Role
    errors: PredictionErrors  # those of persistence are the same for all models, which share the encoder
    landscapes: Landscapes | None = None
    ranking: ActionRanking | None = None
    distribution: LatentDistribution | None = None  # of the rollout with the true actions


@dataclass(frozen=True)
class Example:
    """One clip with its frames, and each model's prediction of it in a rollout from its first frame."""

    why: str  # reason of the choice: best, worst, median, most motion
    episode_id: str
    start: int
    frames: UInt8[np.ndarray, "time height width 3"] | None  # as the encoder sees them; None: no frames (a cache)
    errors: Mapping[str, Float[np.ndarray, "horizon grid grid"]]  # model or persistence -> L1 error of each patch


@dataclass(frozen=True)
class Evaluation:
    """All results; models are in the order of the table: base, others, and the trained one last."""

    about: About
    clips: Clips
    models: Mapping[str, ModelResult]
    examples: tuple[Example, ...] = ()
    notes: tuple[str, ...] = ()  # for the reader: why there is no base, no landscape ...
    metrics: tuple[Metric, ...] = (L1, L2)  # of the errors
    copies: LatentDistribution | None = None  # of frame 0
    fvd_of_halves: float = math.nan  # between two halves of the true clips: what chance makes of equal distributions
    decoded: DecodedRollouts | None = None  # None: no decoder was given

    @property
    def title(self) -> str:
        """What was evaluated, for people: the name of a run with its step, or of a model."""
        step = self.about.checkpoint_path.rpartition("-")[2]
        base = " (the base model)" if self.about.is_base else ""
        return f"{self.about.subject}, step {int(step)}{base}" if step.isdecimal() else self.about.subject

    @property
    def trained(self) -> str:
        """The name of the evaluated model: adapter, or model."""
        return next(name for name, model in self.models.items() if model.role == "trained")

    @property
    def base(self) -> str | None:
        """The name of the base in `models`; None: there is none."""
        return next((name for name, model in self.models.items() if model.role == "base"), None)

    @property
    def ranked(self) -> str | None:
        """How actions were ranked, as text: two evaluations with the same text compare; None: they were not ranked."""
        ranking = self.models[self.trained].ranking
        if ranking is None:
            return None
        # Without the seed: other draws of the alternatives are within the interval.
        return f"{len(ranking.ranks)} moves, 2 x {ranking.samples} alternatives within {100 * ranking.reach:g} cm"

    @property
    def errors(self) -> PredictionErrors:
        """The errors of the evaluated model."""
        return self.models[self.trained].errors

    @property
    def horizon(self) -> int:
        """The number of model steps of the longest horizon."""
        return self.about.frames - 1

    @property
    def seconds_ahead(self) -> float:
        """The same in seconds."""
        return self.horizon * self.about.seconds_per_step


# ---- estimates ----

Curve = tuple[Estimate, ...]  # at horizon 1, 2, ...; index h - 1
Steps = Bool[np.ndarray, "clips horizon"]  # which steps count


def over_persistence(errors: PredictionErrors, mode: Mode, metric: Metric = L1, way: Way = "true") -> Curve:
    """Return mean error over mean persistence error by horizon: 1 as good as persistence; of L1, 0 is perfect."""
    return ratios(errors.of(mode, metric, way), errors.of(mode, metric, "persistence"), errors.episode_ids)


def one_step_over_persistence(
    errors: PredictionErrors, actions: Actions = "true", steps: Steps | None = None
) -> Estimate:
    """Return teacher-forced error over persistence, over all steps of the clips or the chosen ones; NaN of none."""
    return ratio(_one_step(errors, actions, steps), _one_step(errors, "persistence", steps), errors.episode_ids)


def gain_over(errors: PredictionErrors, others: PredictionErrors, mode: Mode = "rollout", metric: Metric = L1) -> Curve:
    """Return the share by which a model is better than another, by horizon, paired by clip: 0.18 is 18 % better."""
    pair = [each.of(mode, metric) for each in (errors, others)]
    better = 1 if metric.smaller_is_better else -1
    return bootstrapped(lambda sums: better * (1 - sums[0] / sums[1]), np.stack(pair), errors.episode_ids)


def cost_of_actions(errors: PredictionErrors, actions: Actions) -> Estimate:
    """Return the share by which the teacher-forced error grows with zero or shuffled actions, paired; 0: unused."""
    grown = ratio(_one_step(errors, actions), _one_step(errors, "true"), errors.episode_ids)
    return Estimate(grown.value - 1, grown.low - 1, grown.high - 1)


def gap_of_actions(errors: PredictionErrors, actions: Actions) -> Estimate:
    """Return how much higher the teacher-forced error over persistence is with zero or shuffled actions, paired."""
    given, true = (errors.of("teacher_forced", L1, each) for each in (actions, "true"))
    return ratio((given - true).mean(axis=1), _one_step(errors, "persistence"), errors.episode_ids)


def rank_difference(one: ActionRanking, other: ActionRanking) -> Estimate:
    """Return the mean rank of one model minus that of another on the same moves, paired: below 0 is better."""
    return mean_of(one.ranks - other.ranks, one.episode_ids)


def _one_step(errors: PredictionErrors, way: Way, steps: Steps | None = None) -> np.ndarray:
    """Return the mean teacher-forced L1 error of each clip, or the sum over the chosen steps."""
    found = errors.of("teacher_forced", L1, way)
    return np.asarray(found.mean(axis=1) if steps is None else (found * steps).sum(axis=1))
