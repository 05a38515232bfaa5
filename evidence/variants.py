"""The variants study: does another training loss make better plans?

Each method changes the loss of LoRA fine-tuning: longer rollouts, failing variants of the demonstrations as data, a
contrastive term on them, or a larger weight of the action-relative part of the error. All methods have the same
demonstrations, order of clips, number of steps and learning rates. Seed 0 was used to choose `CONTRAST_WEIGHT` and
`RESTART`; seeds 1 to 5 are measured.

Ideas: rollouts of 10 steps in the decay phase (RoboJEPA, arXiv 2610.10515), executed failing variants (CureWM, arXiv
2610.09134), common and action-relative error (arXiv 2610.05550). The losses are ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import failing_variants
import numpy as np
import torch
from failing_variants import STRIDE, VARIANTS, Groups, Recordings
from jaxtyping import Float
from methods import IN_OUT, PLANNING, TRAINING
from offline import measure_offline
from prepare import BUILTIN
from torch import Tensor, nn
from work import Work

from vjepa2_ac.config import AdapterConfig, ModelConfig
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.predictor import KeyValueCache
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, Planning, run_task
from vjepa2_ac.simulation.domains import DomainRanges, sample_domain
from vjepa2_ac.simulation.record import RecordingSpec
from vjepa2_ac.spaces import POSE_CHANGE
from vjepa2_ac.training.optim import learning_rate_at, make_optimizer, trained_parameters

SEEDS, SEED, GOALS_SEED = 5, 6_400, 64_000
TARGETS = DomainRanges(azimuth_deg=(80.0, 130.0), base_yaw_deg=(45.0, 75.0), lag_s=(0.06, 0.14), textures=True)
"""Target domains: cameras on a side without a camera of the base model's data, and a mounting rotated by 45 to 75
degrees, so that the baseline reaches neither all goals nor none. Each seed has its own domain."""
DEMONSTRATIONS, HELD_OUT, SEGMENTS = 20, 12, 2  # episodes, and segments with failing variants of each
EPISODE_STEPS = 57  # control steps
STEPS = 400
SCHEDULE = TRAINING.model_copy(
    update={
        "steps": STEPS,
        "learning_rate": 3e-3,
        "schedule": "warmup_stable_decay",
        "decay_steps": STEPS // 3,
    }
)
ADAPTER = AdapterConfig(rank=32, alpha=64.0, dropout=0.0, modules_to_save=IN_OUT)
FRAMES, LONG = 4, 11  # frames of teacher forcing, and of a clip: a rollout of 10 steps has 11 frames
BATCH, GROUPS, FAILURES = 6, 2, 3  # clips; groups and failing variants of each group, in each step
MARGIN, CONTRAST_WEIGHT = 0.5, 0.1  # margin relative to the executed distance; weight of the contrastive loss
RELATIVE_WEIGHT = 3.0  # weight of the action-relative error
RESTART = 20  # steps in which the learning rate rises again after a change of the loss; without it, training diverges


@dataclass(frozen=True)
class Method:
    """A training loss."""

    name: str
    rollout: int = 2  # steps of the rollout loss on demonstrations
    decay_rollout: int = 2  # the same, in the decay phase
    has_variants: bool = False  # whether failing variants are training data
    relative_weight: float = 1.0  # weight of the action-relative part of the error on failing variants
    has_contrast: bool = False
    control: str | None = None  # a method with the same data, without the idea that is tested


METHODS = {
    method.name: method
    for method in (
        Method("baseline"),
        Method("rollout of 10 in the decay phase", decay_rollout=10),
        Method("rollout of 10 in all steps", rollout=10, decay_rollout=10),
        Method("failing variants as data", has_variants=True),
        Method("contrast", has_variants=True, has_contrast=True, control="failing variants as data"),
        Method("action-relative error", has_variants=True, relative_weight=RELATIVE_WEIGHT,
               control="failing variants as data"),
    )
}  # fmt: skip
BASE, BASELINE = "base model", "baseline"


@dataclass(frozen=True)
class Cell:
    """One training and its measurement. The seed determines domain, demonstrations, order of clips and goals."""

    method: str  # a key of METHODS, or BASE
    seed: int

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.method.replace(' ', '-')}-s{self.seed}"


@dataclass(frozen=True)
class Seed:
    """The target domain and the recordings of a seed."""

    number: int

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"recordings of seed {self.number}"

    @property
    def spec(self) -> RecordingSpec:
        """The options of the recordings."""
        rng = np.random.default_rng([SEED, self.number])
        domain = replace(sample_domain(rng, TARGETS), name=f"target-{self.number}")
        return RecordingSpec(domain, steps=EPISODE_STEPS, seed=SEED + self.number)

    def path(self, folder: Path) -> Path:
        """Return the file with the recordings."""
        return folder / f"recordings-{self.number}.pt"


def all_cells() -> Iterator[Cell]:
    """Yield all cells, seed by seed."""
    for seed in range(1, SEEDS + 1):
        for method in (BASE, *METHODS):
            yield Cell(method, seed)


def prepare(cells: Sequence[Cell], work: Work) -> int:
    """Make the recordings of the cells' seeds; return the number of seeds that failed."""
    return work.run(prepare_seed, [(Seed(number), work.folder) for number in sorted({cell.seed for cell in cells})])


def prepare_seed(seed: Seed, folder: Path) -> None:
    """Record and encode the demonstrations of a seed, its held-out episodes, and the failing variants of both."""
    path = seed.path(folder)
    if not path.exists():
        model, last = _load_base_model(), DEMONSTRATIONS + HELD_OUT
        parts = [range(DEMONSTRATIONS), range(DEMONSTRATIONS, last)]
        recorded = [failing_variants.record(model, seed.spec, part, SEGMENTS) for part in parts]
        torch.save([asdict(part) for part in recorded], path.with_suffix(".part"))
        path.with_suffix(".part").rename(path)


def load_recordings(path: Path) -> tuple[Recordings, Recordings]:
    """Return the recordings for training, and the held-out ones."""
    parts = torch.load(path)
    first, second = (Recordings(part["latents"], part["states"], Groups(**part["groups"])) for part in parts)
    return first, second


def measure(cell: Cell, folder: Path, goals: int) -> dict[str, Any]:
    """Train and measure a cell on one thread."""
    seed = Seed(cell.seed)
    recordings, held_out = load_recordings(seed.path(folder))
    model = _load_base_model()
    result: dict[str, Any] = {}
    if cell.method != BASE:
        result["training"] = train(model, METHODS[cell.method], recordings, cell.seed)
    model.eval()
    result |= measure_predictions(model, held_out)
    problems = BenchmarkOptions("reach", seed.spec.worlds, goals, GOALS_SEED + 100 * cell.seed, films=0)  # type: ignore[arg-type]
    run = run_task(problems, Planning(Controller(model, PLANNING)))
    return result | {"ends_cm": run.distance_cm[:, -1].tolist()}


def _load_base_model() -> WorldModel:
    return load_base(ModelConfig(base=BUILTIN, dtype="float32"), seed=0).eval()


# ---- training ----


def train(model: WorldModel, method: Method, recordings: Recordings, seed: int) -> dict[str, float]:
    """Add an adapter to a model and train it; return the losses of the last step.

    Clips of demonstrations and groups of variants are drawn by separate generators, so that all methods have the same
    clips, and all methods with variants have the same groups.
    """
    add_adapter(model, ADAPTER, seed)
    optimizer, trained = make_optimizer(model, SCHEDULE), list(trained_parameters(model))
    clip_rng, group_rng = (np.random.default_rng([SEED, seed, purpose]) for purpose in (1, 2))
    model.train()
    for step in range(1, SCHEDULE.steps + 1):
        decaying = step - (SCHEDULE.steps - SCHEDULE.decay_steps)  # number of steps in the decay phase
        rollout = method.decay_rollout if decaying > 0 else method.rollout
        is_new = decaying > 0 and method.decay_rollout != method.rollout
        for group in optimizer.param_groups:
            group["lr"] = learning_rate_at(step, SCHEDULE) * (min(1.0, decaying / RESTART) if is_new else 1.0)
        losses = clip_losses(model, draw_clips(recordings, clip_rng), rollout)
        if method.has_variants:
            losses |= variant_losses(model, draw_groups(recordings.groups, group_rng), method)
        torch.autograd.backward(torch.stack(list(losses.values())).sum())
        nn.utils.clip_grad_norm_(trained, 1.0)
        optimizer.step()
        optimizer.zero_grad()
    return {name: loss.item() for name, loss in losses.items()}


def draw_clips(recordings: Recordings, rng: np.random.Generator) -> LatentBatch:
    """Return random clips of demonstrations. All have `LONG` frames, also for methods that use fewer."""
    episodes, steps = recordings.states.shape[:2]
    starts = steps - STRIDE * (LONG - 1)
    clips = [recordings.clip(int(rng.integers(episodes)), int(rng.integers(starts)), LONG) for _ in range(BATCH)]
    return join_clips(clips)


def join_clips(clips: Sequence[LatentBatch]) -> LatentBatch:
    """Return clips as one batch."""
    latents, states, actions = (
        torch.cat([getattr(clip, name) for clip in clips]) for name in ("latents", "states", "actions")
    )
    ids, starts = tuple(clip.episode_ids[0] for clip in clips), tuple(clip.starts[0] for clip in clips)
    return LatentBatch(latents, states, actions, None, ids, starts)


def draw_groups(groups: Groups, rng: np.random.Generator) -> Groups:
    """Return random groups: each has its demonstration first, then random failing variants."""
    chosen = torch.from_numpy(rng.choice(len(groups.failed), GROUPS, replace=False))
    failing = [rng.choice(np.flatnonzero(groups.failed[group].numpy()), FAILURES, replace=False) for group in chosen]
    alternatives = np.concatenate([np.zeros((GROUPS, 1), int), np.stack(failing)], axis=1)
    return groups.select(chosen, torch.from_numpy(alternatives))


def clip_losses(model: WorldModel, clips: LatentBatch, rollout: int) -> dict[str, Float[Tensor, ""]]:
    """Return the losses of teacher forcing over the first `FRAMES` frames, and of a rollout from the first frame.

    With clips of `FRAMES` frames both are those of `vjepa2_ac.training.step.prediction_losses`. A longer rollout
    changes only the second loss.
    """
    states, cache = clips.states[:, :-1], KeyValueCache()
    forcing, rest = slice(FRAMES - 1), slice(1, rollout)
    forced = model.predict(
        clips.latents[:, forcing], clips.actions[:, forcing], states[:, forcing], cache=cache, keep=1
    )
    further = model.rollout(forced[:, :1], clips.actions[:, rest], states[:, rest], cache=cache)
    rolled = torch.cat([forced[:, :1], further], dim=1)
    return {
        "forced": (forced - clips.latents[:, 1:FRAMES]).abs().mean(),
        "rollout": (rolled - clips.latents[:, 1 : rollout + 1]).abs().mean(),
    }


def variant_losses(model: WorldModel, groups: Groups, method: Method) -> dict[str, Float[Tensor, ""]]:
    """Return the losses on groups of a demonstration and failing variants.

    variants: the mean absolute error of the rollout, with its action-relative part times `relative_weight`.
    contrast: a hinge on predicted energies of the demonstration's goal. The energy of each failing variant should
    exceed that of the demonstration by `MARGIN` times the distance of the *executed* end from the goal. For a perfect
    predictor this loss is 0.
    """
    predicted = groups.predict(model)
    true_latents = groups.latents[:, :, 1:]
    common, relative = split_error(predicted - true_latents)
    losses = {"variants": (common + method.relative_weight * relative).abs().mean()}
    if method.has_contrast:
        goal = true_latents[:, :1, -1]
        energies, executed = (
            (ends - goal).abs().mean(dim=(2, 3)) for ends in (predicted[:, :, -1], true_latents[:, :, -1])
        )
        hinge = (MARGIN * executed[:, 1:] + energies[:, :1] - energies[:, 1:]).clamp(min=0).mean()
        losses["contrast"] = CONTRAST_WEIGHT * hinge
    return losses


def split_error(
    error: Float[Tensor, "groups alternatives *rest"],
) -> tuple[Float[Tensor, "groups 1 *rest"], Float[Tensor, "groups alternatives *rest"]]:
    """Return the part of an error that is common to all alternatives of a group, and the action-relative part.

    Their sum is the error. The mean square of the error is the sum of the mean squares of both parts.
    """
    common = error.mean(dim=1, keepdim=True)
    return common, error - common


# ---- measurement ----


@torch.no_grad()
def measure_predictions(model: WorldModel, held_out: Recordings) -> dict[str, Any]:
    """Return the offline metrics on held-out episodes and the failing variants of their segments."""
    episodes, steps = held_out.states.shape[:2]
    starts = range(0, steps - STRIDE * (LONG - 1), STRIDE)
    clips = join_clips([held_out.clip(episode, start, LONG) for episode in range(episodes) for start in starts])
    rolled = model.rollout(clips.latents[:, :1], clips.actions, clips.states[:, :-1])
    error, persistence = (
        (predicted - clips.latents[:, 1:]).abs().mean(dim=(0, 2, 3)) for predicted in (rolled, clips.latents[:, :1])
    )
    short = replace(
        clips,
        latents=clips.latents[:, :FRAMES],
        states=clips.states[:, :FRAMES],
        actions=clips.actions[:, : FRAMES - 1],
    )
    offline = measure_offline(model, POSE_CHANGE, [short])
    return {
        "rollout_over_persistence": (error / persistence).tolist(),
        "action_ranking_error": offline["action-ranking error"],
        **measure_groups(model, held_out.groups),
    }


@torch.no_grad()
def measure_groups(model: WorldModel, groups: Groups) -> dict[str, Any]:
    """Return the parts of the error at the end of the segments, and how well predicted energies detect failures.

    The parts are mean squares, relative to those of persistence. An action-relative error of 1 is that of a model that
    ignores the actions.
    """
    predicted, true_ends = groups.predict(model)[:, :, -1], groups.latents[:, :, -1]
    start = groups.latents[:, :, 0]
    parts, references = (
        [float(part.square().mean()) for part in split_error(ends - true_ends)] for ends in (predicted, start)
    )
    energies = (predicted - true_ends[:, :1]).abs().mean(dim=(2, 3)).double().numpy()
    failed = groups.failed.numpy()
    families = np.array([None, *(family for family, _ in VARIANTS)])
    return {
        "common_error": parts[0] / references[0],
        "relative_error": parts[1] / references[1],
        "common_share": parts[0] / max(sum(parts), 1e-12),
        "auroc": compute_auroc(energies[:, 0], energies[failed]),
        "auroc_same_start": float(
            np.mean([compute_auroc(row[:1], row[1:][mask[1:]]) for row, mask in zip(energies, failed, strict=True)])
        ),
        "auroc_by_family": {
            family: compute_auroc(energies[:, 0], energies[:, families == family][failed[:, families == family]])
            for family in failing_variants.FAMILIES
        },
    }


def compute_auroc(successes: Float[np.ndarray, " successes"], failures: Float[np.ndarray, " failures"]) -> float:
    """Return the probability that a success has a lower energy than a failure; equal energies count as one half.

    This is the area under the ROC curve (AUROC): 1 is perfect, 0.5 is chance. NaN without successes or failures.
    """
    if not len(successes) or not len(failures):
        return float("nan")
    difference = failures[None] - successes[:, None]
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))
