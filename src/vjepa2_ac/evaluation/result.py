"""Evaluation results: records of plain arrays, and the rows that people and programs read. PyTorch is not imported.

Axes: clips in one fixed order; horizon 1 .. H model steps ahead (index h - 1; H is frames - 1). All errors compare
layer-normalised latents, by all metrics that are registered. What has intervals is computed from these by
`evaluation.estimates`; the rows by `evaluation.rows`, the summary by `evaluation.summary`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import BeforeValidator

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.model.distances import absolute_difference, squared_difference
from vjepa2_ac.registry import METRICS
from vjepa2_ac.spaces import ActionSpace

if TYPE_CHECKING:
    from torch import Tensor


_Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]  # null in JSON: NaN
PERSISTENCE = "persistence"  # the model of rows that stand where chance does


@dataclass(frozen=True)
class Row:
    """One number of an evaluation: console, report page, metrics.json and comparison show the same ones."""

    group: str  # the table that it stands in
    name: str  # its line
    key: str  # both, for programs, such as rollout.l1.over_persistence.3
    model: str  # its column: a model, persistence, or plans without a model
    value: _Number  # NaN: there is none
    low: _Number = math.nan  # 95 % interval over episodes; NaN: there is none
    high: _Number = math.nan
    form: str = ".3f"
    better: Literal["lower", "higher", ""] = "lower"
    chance: float | None = None  # what persistence has, or a model that ignores its actions
    note: str = ""
    unit: str = ""  # of the value, if it has one and `name` does not give it: cm
    detail: bool = False  # not for a screen

    @property
    def estimate(self) -> Estimate:
        """The number with its interval."""
        return Estimate(self.value, self.low, self.high)

    def __str__(self) -> str:
        text = "not measured" if math.isnan(self.value) else f"{self.estimate:{self.form}}"
        return f"{text} ({self.note})" if self.note else text


@dataclass(frozen=True)
class RowTable:
    """The rows of one group as a table."""

    title: str
    columns: tuple[str, ...]
    lines: tuple[tuple[str, str, tuple[str, ...]], ...]  # label, by chance or persistence, a cell for each column


def sections(rows: Sequence[Row]) -> list[RowTable]:
    """Return rows as tables: those of one key are a line, each in the column of its model."""
    by_key: dict[str, dict[str, Row]] = {}
    for row in rows:
        by_key.setdefault(row.key, {})[row.model] = row
    groups: dict[str, list[dict[str, Row]]] = {}
    for line in by_key.values():
        groups.setdefault(next(iter(line.values())).group, []).append(line)
    return [_section(title, lines) for title, lines in groups.items()]


def _section(title: str, lines: Sequence[Mapping[str, Row]]) -> RowTable:
    columns = tuple(dict.fromkeys(model for line in lines for model in line if model != PERSISTENCE))
    found = []
    for line in lines:
        first = next(iter(line.values()))
        chance = "" if first.chance is None else f"{first.chance:{first.form}}"
        chance = str(line.get(PERSISTENCE, chance))
        found.append((first.name, chance, tuple(str(line.get(model, "")) for model in columns)))
    return RowTable(title, columns, tuple(found))


class Measurement(Protocol):
    """What a measurement beside the core found of a model."""

    def rows(self, model: str) -> list[Row]:
        """Return its numbers."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain values, for metrics.json."""
        ...


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
class WrittenAbout:
    """What readers of metrics.json need of the description of an evaluation."""

    checkpoint: str  # which one, as text; "" for a model
    checkpoint_path: str  # likewise
    data: str  # data.path
    cameras: tuple[str, ...]
    split: str
    frames: int  # of a clip
    stride: int  # control steps per model step
    seconds_per_step: float
    is_base: bool = field(default=False, kw_only=True)  # the checkpoint has the weights of the base model


@dataclass(frozen=True)
class About(WrittenAbout):
    """The description of an evaluation: model, data and settings."""

    subject: str  # the run or model, as given
    source: str  # data.source
    space: ActionSpace  # of the actions
    seed: int
    version: str  # of this package
    time: str  # UTC


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
    distance: float  # between the two, in the units of the axes


@dataclass(frozen=True)
class Landscapes:
    """Landscapes of some clips of one model, and statistics over them."""

    axis_names: tuple[str, ...]  # three
    unit: str  # cm, or "" where the states are no poses
    maps: tuple[Landscape, ...]
    distance: Estimate  # mean over clips
    sharpness: Estimate  # mean over clips of (highest - lowest) / mean energy of a landscape; 0: flat
    chance_distance: float  # the same of a node drawn at random


@dataclass(frozen=True)
class Plans:
    """The plans of one method from each start; several draws of it, if it is random."""

    one_step: Float[np.ndarray, "draws starts 7"]  # towards the next frame; an action as in `vjepa2_ac.episode`
    three_steps: Float[np.ndarray, "draws starts 3 7"]  # towards the frame three steps later
    empty: int = 0  # plans without a finite energy, which do nothing


@dataclass(frozen=True)
class PlanningStudy:
    """The starts of the plans, the demonstrated actions, and model-free plans. Of poses only."""

    clips: tuple[int, ...]  # indices into Clips
    places: tuple[int, ...]  # frame of each clip at which planning begins
    episode_ids: tuple[str, ...]
    demonstrated: Float[np.ndarray, "starts 3 7"]
    zero: Plans
    random: Plans  # every number uniform within its limits
    within_limits: Plans  # the demonstration clipped to the limits: no plan can be closer
    one_step_beyond: float  # share of the demonstrated steps that exceed the limits along x, y or z
    three_steps_beyond: float
    settings: PlanningConfig  # of the one-step plans


@dataclass(frozen=True)
class LatentDistribution:
    """How the latents of one kind of prediction are distributed, by horizon (index h - 1), against the truth."""

    spread: tuple[Estimate, ...]  # 1: as varied as the truth
    mmd: tuple[Estimate, ...]  # squared, times 100, of latents averaged over tokens; NaN of one episode
    p_values: tuple[float, ...]  # of no difference, by sign flips; NaN of one episode
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


@dataclass(frozen=True)
class ModelResult:
    """The results of one model."""

    name: str  # base, adapter, model, or the name of another run
    role: Role
    errors: PredictionErrors  # those of persistence are the same for all models, which share the encoder
    landscapes: Landscapes | None = None
    plans: Plans | None = None
    ranking: ActionRanking | None = None
    distribution: LatentDistribution | None = None  # of the rollout with the true actions
    beside: Mapping[str, Measurement] = field(default_factory=dict)  # by measurements that the core does not know


@dataclass(frozen=True)
class Stratum:
    """A group of steps; `steps` selects [clip, horizon] of the *teacher-forced* errors."""

    key: str  # motion.moving, motion.idle, action_size.small, .medium or .large: the same for all data
    label: str  # such as "moving", "small: 0 to 1.2 cm"
    steps: Bool[np.ndarray, "clips horizon"]


@dataclass(frozen=True)
class Example:
    """One clip with its frames, and each model's prediction of it in a rollout from its first frame."""

    why: str  # reason of the choice: best, worst, median, most motion
    episode_id: str
    start: int
    frames: UInt8[np.ndarray, "time height width 3"] | None  # as the encoder sees them; None: no frames (a cache)
    errors: Mapping[str, Float[np.ndarray, "horizon grid grid"]]  # model or persistence -> L1 error of each patch
    true_colours: UInt8[np.ndarray, "time grid grid 3"]  # three principal components of the true latents, as RGB
    predicted_colours: Mapping[str, UInt8[np.ndarray, "horizon grid grid 3"]]  # model -> in the same basis and scale


@dataclass(frozen=True)
class EpisodeScore:
    """The score of the trained model on one episode, at the last horizon of the rollout (L1)."""

    episode_id: str
    clips: int
    over_persistence: float
    gain_over_base: float | None  # relative reduction of the base's error; None: no base


@dataclass(frozen=True)
class TrainingCurve:
    """One metric of a run's metrics.jsonl over optimizer steps."""

    name: str  # loss, learning_rate, validation/rollout_over_persistence ...
    steps: tuple[int, ...]
    values: tuple[float, ...]


@dataclass(frozen=True)
class Evaluation:
    """All results; models are in the order of the table: base, others, and the trained one last."""

    about: About
    clips: Clips
    models: Mapping[str, ModelResult]
    strata: tuple[Stratum, ...]
    episodes: tuple[EpisodeScore, ...] = ()  # best first
    examples: tuple[Example, ...] = ()
    training: tuple[TrainingCurve, ...] = ()
    beside: Mapping[str, Measurement] = field(default_factory=dict)  # as of a model: of the one that is evaluated
    notes: tuple[str, ...] = ()  # for the reader: why there is no base, no landscape ...
    planning: PlanningStudy | None = None
    metrics: tuple[Metric, ...] = (L1, L2)  # of the errors
    copies: LatentDistribution | None = None  # of frame 0
    noise_floor: tuple[float, ...] = ()  # of the MMD: what chance makes of the truth, by horizon
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
    def base_errors(self) -> PredictionErrors | None:
        """The errors of the base; None: there is none."""
        return None if self.base is None else self.models[self.base].errors

    @property
    def horizon(self) -> int:
        """The number of model steps of the longest horizon."""
        return self.about.frames - 1

    @property
    def seconds_ahead(self) -> float:
        """The same in seconds."""
        return self.horizon * self.about.seconds_per_step
