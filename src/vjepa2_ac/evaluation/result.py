"""Evaluation results: arrays by clip, and estimates with intervals computed from them. PyTorch is not imported.

The clip axis of every array has the same order. The horizon axis is 1 .. H model steps ahead: index h - 1, with H =
frames - 1. All errors compare layer-normalised latents. Estimates that compare two models are paired by clip.
`evaluation.rows` makes the rows of the tables, `evaluation.summary` the summary.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from vjepa2_ac.intervals import Estimate, bootstrap, estimate_mean, estimate_ratio, estimate_ratios
from vjepa2_ac.model.distances import absolute_difference, squared_difference
from vjepa2_ac.registry import METRICS

if TYPE_CHECKING:
    from torch import Tensor

SAME_ENERGY = 1e-6  # energies with a smaller relative difference count as equal, because it may be rounding
PERSISTENCE = "persistence"  # its name where models are listed


@dataclass(frozen=True)
class Metric:
    """A metric of predictions. Its values are positive, and are shown relative to the value of persistence."""

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
    """Return all metrics, third-party metrics included; L1, the training loss, comes first."""
    return tuple(METRICS.find(name) for name in METRICS.names())


Mode = Literal["teacher_forced", "rollout"]
Actions = Literal["true", "zero", "shuffled"]
ActionMode = Literal["true", "zero", "shuffled", "persistence"]  # actions of a prediction; persistence predicts a copy
Role = Literal["base", "trained", "other"]

MODES: tuple[Mode, ...] = ("teacher_forced", "rollout")
ACTIONS: tuple[Actions, ...] = ("true", "zero", "shuffled")


@dataclass(frozen=True)
class About:
    """The description of an evaluation: model, data and settings."""

    subject: str  # the run or model, as given by the user
    checkpoint: str  # description of the checkpoint; "" for a model
    checkpoint_path: str  # "" for a model
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
    is_base: bool = False  # whether the checkpoint has the weights of the base model


@dataclass(frozen=True)
class Clips:
    """The clips of an evaluation, and the size of their actions."""

    episode_ids: tuple[str, ...]
    starts: tuple[int, ...]  # first control step of each clip
    action_size: Float[np.ndarray, "clips horizon"]  # |dx, dy, dz| in cm; for vectors: the norm of the action
    moving: Bool[np.ndarray, "clips horizon"]  # whether the robot moves in each step, by the rule in `moving_rule`
    moving_rule: str  # the rule, as text

    def __len__(self) -> int:
        return len(self.episode_ids)

    @property
    def episodes(self) -> int:
        """Number of different episodes."""
        return len(set(self.episode_ids))


@dataclass(frozen=True)
class PredictionErrors:
    """The errors of one model and of persistence on the same clips. Row i of every array belongs to clip i.

    Teacher forcing: frame h is predicted from the true frames before it. Rollout: all frames are predicted from frame 0
    alone. Persistence copies frame h - 1 with teacher forcing, and frame 0 in a rollout. At horizon 1 both modes are
    equal.
    """

    episode_ids: tuple[str, ...]
    # Key: actions, mode, name of the metric.
    arrays: Mapping[tuple[ActionMode, Mode, str], Float[np.ndarray, "clips horizon"]]

    def of(self, mode: Mode, metric: Metric = L1, actions: ActionMode = "true") -> Float[np.ndarray, "clips horizon"]:
        """Return the errors for a mode, a metric, and the actions of the prediction."""
        return self.arrays[actions, mode, metric.name]


@dataclass(frozen=True)
class ActionRanking:
    """The action-ranking error: the fraction of alternative actions with a lower energy than the true action.

    It is measured on moves as large as planned actions (`action_use.select_moves`), forwards and backwards in time.
    Chance is 0.5, and a perfect model has 0. Two models on the same moves are compared in pairs.
    """

    samples: int  # alternatives per move from the box, and the same number from the shell
    reach: float  # half-width of the box along each of x, y, z, in metres
    episode_ids: tuple[str, ...]  # episode of each move
    ranks: Float[np.ndarray, " moves"]  # error of each move: mean of box and shell
    rank: Estimate  # mean of `ranks`
    box: Estimate  # error for alternatives from the box (`action_use.draw_alternatives`)
    shell: Estimate  # error for alternatives from the shell, which measures the sensitivity to direction
    spread: Estimate  # standard deviation of the energy in the box, relative to persistence's error; 0: flat
    change: (
        Estimate  # change of the prediction with the action, relative to persistence's error; 0: actions are ignored
    )


@dataclass(frozen=True)
class Validation:
    """The measurements of a validation during training."""

    errors: PredictionErrors
    ranking: ActionRanking | None  # None: not measured


@dataclass(frozen=True)
class Landscape:
    """The L1 energy of one step of a clip, over a grid of the action's first three components.

    The other components are those of the true action. The grid is approximately centred at zero and has a node exactly
    at the true action: a minimum at the true action is therefore not an artefact of the grid's centre.
    """

    episode_id: str
    start: int  # first control step of the clip
    axes: Float[np.ndarray, "3 grid"]  # values of each component, ascending; positions in cm
    energy: Float[np.ndarray, "grid grid grid"]  # indices: first, second, third axis
    true: Float[np.ndarray, " 3"]
    minimum: Float[np.ndarray, " 3"]  # node with the lowest energy; the mean of several such nodes

    @property
    def distance(self) -> float:
        """Distance between the minimum and the true action, in the unit of the axes."""
        return float(np.linalg.norm(self.minimum - self.true))

    @property
    def rank(self) -> float:
        """Fraction of the other nodes whose energy is below that of the true action; equal energies count half."""
        true_node = tuple(np.abs(self.axes - self.true[:, None]).argmin(axis=1))
        difference = self.energy - self.energy[true_node]
        is_equal = np.abs(difference) <= SAME_ENERGY * abs(self.energy[true_node])
        is_below = (difference < 0) & ~is_equal
        return float((is_below.sum() + (is_equal.sum() - 1) / 2) / (self.energy.size - 1))

    @property
    def sharpness(self) -> float:
        """Sharpness: (highest - lowest) / mean energy; 0: flat."""
        return float(np.ptp(self.energy) / self.energy.mean())


LandscapeMeasure = Literal["distance", "rank", "sharpness"]


@dataclass(frozen=True)
class Landscapes:
    """Energy landscapes of several clips for one model."""

    axis_names: tuple[str, ...]  # three names
    unit: str  # cm; "" if the states are not poses
    maps: tuple[Landscape, ...]
    chance_distance: float  # mean distance between a random node and the true action

    @property
    def episode_ids(self) -> tuple[str, ...]:
        """The episode of each clip."""
        return tuple(landscape.episode_id for landscape in self.maps)

    def mean(self, measure: LandscapeMeasure) -> Estimate:
        """Return the mean of a measure over the clips."""
        return estimate_mean(self._values(measure), self.episode_ids)

    def difference(self, other: Landscapes, measure: LandscapeMeasure) -> Estimate:
        """Return the mean difference of a measure from that of another model on the same clips."""
        return estimate_mean(self._values(measure) - other._values(measure), self.episode_ids)

    def _values(self, measure: LandscapeMeasure) -> Float[np.ndarray, " clips"]:
        return np.array([getattr(landscape, measure) for landscape in self.maps])


@dataclass(frozen=True)
class LatentDistribution:
    """Comparison of the distributions of predicted and true latents over clips (see `evaluation.distribution`).

    Each tuple has one value per horizon (index h - 1).
    """

    spread: tuple[Estimate, ...]  # 1: as varied as the true latents
    mmd: tuple[Estimate, ...]  # squared, times 100; unbiased; no interval from one episode
    fvd: float  # Fréchet distance with one feature vector per clip; biased upwards, more so with fewer clips
    variance: tuple[float, ...]  # trace of the covariance of the predicted latents over clips
    true_variance: tuple[float, ...]  # trace of the covariance of the true latents; `spread` is the ratio


@dataclass(frozen=True, eq=False)
class DecodedStrip:
    """The images of one example clip."""

    why: str  # reason of the choice, as in `Example`
    episode_id: str
    start: int  # first control step of the clip
    # truth, decoded_truth, base, adapter -> images; the first image of a row is frame 0, which is not predicted
    rows: Mapping[str, UInt8[np.ndarray, "time size size 3"]]


@dataclass(frozen=True)
class DecodedRollouts:
    """Metrics of decoded rollouts. Frame 0 is given, so horizons begin at 1.

    A *source* is a model's rollout with the true actions, or one of three baselines: decoded truth (the best result
    that the decoder can reach), decoded persistence, and raw persistence. Raw persistence copies the pixels of frame 0.
    If little moves, it has a better PSNR than any decoder.
    """

    decoder: Mapping[str, Any]  # description of the decoder: folder, size, encoder, data, frames, steps, held_out
    sources: tuple[str, ...]  # the baselines, then the models
    curves: Mapping[tuple[str, str], tuple[Estimate, ...]]  # key: source, metric such as psnr_db.moving.truth
    strips: tuple[DecodedStrip, ...] = ()
    notes: tuple[str, ...] = ()  # missing measurements with reasons; numbers of clips that were left out
    # By source: Fréchet distance between re-encoded images and true latents. Empty: the encoder was not loaded.
    fvd: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ModelResult:
    """The results of one model."""

    name: str  # base, adapter, model, or the name of another run
    role: Role
    errors: PredictionErrors  # persistence's errors are equal for all models, since they share the encoder
    landscapes: Landscapes | None = None
    ranking: ActionRanking | None = None
    distribution: LatentDistribution | None = None  # for rollouts with the true actions


@dataclass(frozen=True)
class Example:
    """One clip with its frames, and the errors of each model in a rollout from the first frame."""

    why: str  # reason of the choice: best, worst, median, most motion
    episode_id: str
    start: int  # first control step of the clip
    frames: UInt8[np.ndarray, "time height width 3"] | None  # the encoder's input; None for cached latents
    errors: Mapping[str, Float[np.ndarray, "horizon grid grid"]]  # model or persistence -> L1 error of each patch


@dataclass(frozen=True)
class Evaluation:
    """All results of an evaluation. The models are in the order of the table: base, others, the trained model last."""

    about: About
    clips: Clips
    models: Mapping[str, ModelResult]
    examples: tuple[Example, ...] = ()
    notes: tuple[str, ...] = ()  # notes for the user, such as why there is no base model or no landscape
    metrics: tuple[Metric, ...] = (L1, L2)  # metrics of the errors
    copies: LatentDistribution | None = None  # distribution of copies of frame 0 (persistence)
    fvd_of_halves: float = math.nan  # Fréchet distance between two halves of the true clips: the value by chance
    decoded: DecodedRollouts | None = None  # None: no decoder was used

    @property
    def title(self) -> str:
        """Title of the evaluation: the name of a run with its step, or of a model."""
        step = self.about.checkpoint_path.rpartition("-")[2]
        base = " (the base model)" if self.about.is_base else ""
        return f"{self.about.subject}, step {int(step)}{base}" if step.isdecimal() else self.about.subject

    @property
    def trained(self) -> str:
        """Name of the evaluated model in `models`, such as adapter."""
        return next(name for name, model in self.models.items() if model.role == "trained")

    @property
    def base(self) -> str | None:
        """Name of the base model in `models`; None: there is none."""
        return next((name for name, model in self.models.items() if model.role == "base"), None)

    @property
    def ranked(self) -> str | None:
        """Settings of the action ranking as text, equal for comparable evaluations. None: actions were not ranked."""
        ranking = self.models[self.trained].ranking
        if ranking is None:
            return None
        # The seed is left out: the interval includes the variation between draws of the alternatives.
        return f"{len(ranking.ranks)} moves, 2 x {ranking.samples} alternatives within {100 * ranking.reach:g} cm"

    @property
    def errors(self) -> PredictionErrors:
        """The errors of the evaluated model."""
        return self.models[self.trained].errors

    @property
    def horizon(self) -> int:
        """Longest horizon, in model steps."""
        return self.about.frames - 1

    @property
    def seconds_ahead(self) -> float:
        """Longest horizon, in seconds."""
        return self.horizon * self.about.seconds_per_step


# ---- estimates ----

Curve = tuple[Estimate, ...]  # at horizon 1, 2, ...; index h - 1
Steps = Bool[np.ndarray, "clips horizon"]  # True for steps to include


def over_persistence(errors: PredictionErrors, mode: Mode, metric: Metric = L1, actions: ActionMode = "true") -> Curve:
    """Return the mean error relative to that of persistence at each horizon: 1 is as good as persistence, 0 perfect."""
    return estimate_ratios(errors.of(mode, metric, actions), errors.of(mode, metric, "persistence"), errors.episode_ids)


def one_step_over_persistence(
    errors: PredictionErrors, actions: Actions = "true", steps: Steps | None = None
) -> Estimate:
    """Return the teacher-forced error relative to persistence, over some steps (None: all); NaN without steps."""
    return estimate_ratio(
        _one_step(errors, actions, steps), _one_step(errors, "persistence", steps), errors.episode_ids
    )


def gain_over(
    errors: PredictionErrors, reference: PredictionErrors, mode: Mode = "rollout", metric: Metric = L1
) -> Curve:
    """Return the relative gain over another model at each horizon, paired by clip: 0.18 is 18 % better."""
    pair = [each.of(mode, metric) for each in (errors, reference)]
    sign = 1 if metric.smaller_is_better else -1
    return bootstrap(lambda sums: sign * (1 - sums[0] / sums[1]), np.stack(pair), errors.episode_ids)


def cost_of_actions(errors: PredictionErrors, actions: Actions) -> Estimate:
    """Return the relative increase of the teacher-forced error with zero or shuffled actions, paired by clip."""
    ratio = estimate_ratio(_one_step(errors, actions), _one_step(errors, "true"), errors.episode_ids)
    return Estimate(ratio.value - 1, ratio.low - 1, ratio.high - 1)


def gap_of_actions(errors: PredictionErrors, actions: Actions) -> Estimate:
    """Return the increase of the teacher-forced error with zero or shuffled actions, divided by persistence's error."""
    changed, true = (errors.of("teacher_forced", L1, each) for each in (actions, "true"))
    return estimate_ratio((changed - true).mean(axis=1), _one_step(errors, "persistence"), errors.episode_ids)


def rank_difference(ranking: ActionRanking, reference: ActionRanking) -> Estimate:
    """Return the action-ranking error minus that of another model on the same moves, paired: below 0 is better."""
    return estimate_mean(ranking.ranks - reference.ranks, ranking.episode_ids)


def _one_step(errors: PredictionErrors, actions: ActionMode, steps: Steps | None = None) -> np.ndarray:
    """Return the mean teacher-forced L1 error of each clip, or the sum over the selected steps."""
    values = errors.of("teacher_forced", L1, actions)
    return np.asarray(values.mean(axis=1) if steps is None else (values * steps).sum(axis=1))
