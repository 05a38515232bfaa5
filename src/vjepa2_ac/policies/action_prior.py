"""Action prior: predict the next action from the current latents, the goal's latents and the number of steps left.

Source of the idea: arXiv 2605.08732 (GC-IDM, goal-conditioned inverse dynamics): hindsight goals from demonstrations,
and adaptive layer norms conditioned on the remaining steps. Positions in an image are computed by a spatial softmax
(arXiv 1509.06113). A prior is trained on the latents of demonstrations; with cached latents this takes minutes on a
CPU. Training may start from the weights of another prior.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import gelu

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import training_loader, validation_batches
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.distributed import select_device
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.encoding.encode_dataset import use_finished_cache
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.intervals import Estimate, estimate_ratio
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import Fingerprints, WorldModel
from vjepa2_ac.planning.cameras import Cameras
from vjepa2_ac.planning.controller import PriorStart
from vjepa2_ac.planning.energy import WorldModelCost
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.planning.solvers import PlanStart
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.spaces import Spaces
from vjepa2_ac.storage import folder_writer
from vjepa2_ac.storage.structured import parse_record, read_json_object, utc_now
from vjepa2_ac.storage.tensors import read_tensors, save_tensors

CARD, WEIGHTS = "prior.json", "prior.safetensors"
POINTS, VALUES, WIDTH, BLOCKS = 16, 16, 256, 2  # points per image, features per point, width and depth of the network

_NEEDED = "the folder of a prior, as `vjepa2-ac prior` writes it"
_FIX = "Train it again: `vjepa2-ac prior RUN`"
Size = Annotated[int, Field(ge=1, le=65_536)]


@dataclass(frozen=True)
class PriorSizes:
    """Sizes of the inputs and outputs of a prior."""

    grid: Size  # patches along one side
    dim: Size  # dimension of a token
    state: Size
    action: Size
    ahead: Size  # largest number of model steps to a goal


@dataclass(frozen=True)
class PriorCard:
    """Description of a trained prior: its sizes, and how it was trained."""

    format: Literal["vjepa2-ac prior 1"]
    sizes: PriorSizes
    encoder: str  # WorldModel.encoder_fingerprint
    crop: str  # data.crop
    data: str  # data.path
    steps: int
    learning_rate: float | None = None  # None: not recorded, in priors before 2026-12-01
    held_out: Mapping[str, Any] = field(default_factory=dict)
    pretrained: str = ""  # the folder of the prior from whose weights the training started; empty: random weights
    version: str = __version__
    time: str = ""  # UTC


class ActionPrior(nn.Module):
    """The network of a prior, and the start of a search from its predictions."""

    grid: Tensor
    scale: Tensor

    def __init__(self, sizes: PriorSizes) -> None:
        super().__init__()
        self.sizes = sizes
        num_features = POINTS * (2 + VALUES)
        self.features = nn.Linear(sizes.dim, 4 * POINTS)
        self.places, self.values = nn.Linear(4 * POINTS, POINTS), nn.Linear(4 * POINTS, VALUES)
        self.inner = nn.Linear(3 * num_features + sizes.state, WIDTH)
        self.blocks = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(BLOCKS))
        self.norm = nn.LayerNorm(WIDTH, elementwise_affine=False)
        self.remaining = nn.Embedding(sizes.ahead + 1, BLOCKS * 2 * WIDTH)
        self.outer = nn.Linear(WIDTH, 2 * sizes.action)
        nn.init.zeros_(self.remaining.weight)
        line = torch.linspace(-1.0, 1.0, sizes.grid)
        self.register_buffer("grid", torch.cartesian_prod(line, line))
        self.register_buffer("scale", torch.ones(sizes.action))  # standard deviation of the actions in the data

    def forward(
        self,
        frame: Float[Tensor, "batch tokens dim"],
        goal: Float[Tensor, "batch tokens dim"],
        remaining: Int[Tensor, " batch"],
        state: Float[Tensor, "batch state_dim"],
    ) -> tuple[Float[Tensor, "batch action_dim"], Float[Tensor, "batch action_dim"]]:
        """Return mean and mean absolute deviation of the next action, in units of `scale`."""
        frame_features, goal_features = self._extract_features(frame), self._extract_features(goal)
        x = self.inner(torch.cat([frame_features, goal_features, goal_features - frame_features, state], dim=1))
        modulation = self.remaining(remaining.clamp(0, self.sizes.ahead)).unflatten(1, (BLOCKS, 2, WIDTH))
        for number, block in enumerate(self.blocks):
            x = x + gelu(block(self.norm(x) * (1 + modulation[:, number, 0]) + modulation[:, number, 1]))
        mean, log_deviation = self.outer(self.norm(x)).chunk(2, dim=1)
        return mean, log_deviation.clamp(-5.0, 3.0).exp()

    def _extract_features(self, latents: Float[Tensor, "batch tokens dim"]) -> Float[Tensor, "batch numbers"]:
        """Return the positions of `POINTS` points in an image (spatial softmax), and features at these points."""
        features = gelu(self.features(latents))
        weights = self.places(features).softmax(dim=1)
        points = torch.einsum("bnk,nc->bkc", weights, self.grid)
        values = torch.einsum("bnk,bnv->bkv", weights, self.values(features))
        return torch.cat([points, values], dim=2).flatten(1)

    @torch.no_grad()
    def predict_action(
        self,
        frame: Float[Tensor, "tokens dim"],
        state: Float[Tensor, " state_dim"],
        goal: Float[Tensor, "tokens dim"],
        remaining: int,
    ) -> tuple[Float[Tensor, " action_dim"], Float[Tensor, " action_dim"]]:
        """Return mean and standard deviation of the next action, on the CPU.

        Args:
            frame: Latents of the current frame.
            state: The measured state.
            goal: Latents of the goal.
            remaining: Estimated number of model steps to the goal.
        """
        steps_left = torch.tensor([max(1, remaining)], device=frame.device)
        mean, deviation = self(frame[None], goal[None], steps_left, state[None])
        std = math.sqrt(2) * deviation  # of a Laplace distribution
        return (mean * self.scale)[0].float().cpu(), (std * self.scale)[0].float().cpu()

    @torch.no_grad()
    def make_start(
        self, cost: WorldModelCost, goal: Float[Tensor, "tokens dim"], remaining: int, space: SearchSpace
    ) -> PlanStart:
        """Return the start of a search: actions that the prior predicts along a rollout of the world model.

        The first action is predicted from the current frame, each further action from the predicted frame before it.

        Args:
            cost: The cost of the current scene, whose model predicts the frames.
            goal: Latents of the goal.
            remaining: Estimated number of model steps to the goal.
            space: The allowed actions.
        """
        frame, state = cost.current
        decisions, spread = torch.zeros_like(space.lower), torch.zeros_like(space.lower)
        for number in range(space.decisions):
            step = number * space.repeat
            if step:
                predicted, states = cost.rollout(space.repeat_over_steps(space.clip(decisions))[None])
                frame, state = predicted[0, step - 1], states[0, step]
            decisions[number], spread[number] = self.predict_action(frame, state, goal, remaining - step)
        return PlanStart(decisions, decisions[None], spread)


def save_prior(folder: Path, card: PriorCard, prior: ActionPrior) -> None:
    """Write a prior into a folder, completely or not at all.

    Raises:
        InputError: The folder cannot be written.
    """
    with folder_writer(folder, CARD) as temporary_folder:
        save_tensors(prior.state_dict(), temporary_folder / WEIGHTS)
        (temporary_folder / CARD).write_text(json.dumps(asdict(card), indent=1) + "\n", encoding="utf-8")


def load_prior(folder: str | Path, *, where: str) -> tuple[PriorCard, ActionPrior]:
    """Read a prior and its card, on the CPU.

    Raises:
        InputError: There is no prior, or it is incomplete or damaged.
    """
    path = Path(folder)
    values = read_json_object(path / CARD, needed=_NEEDED, fix=_FIX)
    card = parse_record(PriorCard, values, where=f"{where}: {path / CARD}", needed=_NEEDED, fix=_FIX)
    prior = ActionPrior(card.sizes).eval().requires_grad_(False)
    prior.load_state_dict(read_tensors(path / WEIGHTS, prior.state_dict(), needed=_NEEDED, fix=_FIX))
    return card, prior


def load_prior_for_planning(path: str, known: Fingerprints, cameras: Cameras) -> PriorStart:
    """Load `planning.prior` on the device of the model, and return its function for the start of a search.

    Raises:
        InputError: The prior cannot be read, or was trained with another encoder or crop.
    """
    card, prior = load_prior(path, where="planning.prior")
    _require_same_inputs(card, known.encoder, cameras.crop, where=f"planning.prior: {path}", fix=_FIX)
    return prior.to(cameras.model.device).make_start


def _require_same_inputs(card: PriorCard, encoder: str, crop: str, *, where: str, fix: str) -> None:
    for name, trained, model in (("encoder", card.encoder, encoder), ("data.crop", card.crop, crop)):
        if trained != model:
            problem, needed = f"a prior for {name} {trained}; this model has {model}", "a prior trained for this model"
            raise InputError(where=where, found=problem, needed=needed, fix=fix)


_NUM_SCALE_BATCHES = 8  # number of batches from which the scale of the actions is computed
_WARM_UP, _MAX_GRADIENT_NORM, _NUM_HELD_OUT = 50, 1.0, 256  # optimizer steps, norm, clips


@dataclass(frozen=True)
class PriorOptions:
    """Options for the training of a prior."""

    steps: int = 2000
    ahead: int | None = None  # largest number of model steps from a frame to its goal; None: that of the run's clips
    batch_size: int = 32
    learning_rate: float = 1e-3
    pretrained: Path | None = None  # the folder of a prior; training starts from its weights. None: random weights


@dataclass(frozen=True)
class _Pairs:
    """Frames, each with a later frame of the same clip as its goal."""

    frame: Float[Tensor, "batch tokens dim"]
    goal: Float[Tensor, "batch tokens dim"]
    remaining: Int[Tensor, " batch"]
    states: Float[Tensor, "batch state_dim"]
    changes: Float[Tensor, "batch action_dim"]  # change of the state in the next model step


def train_prior(
    config: Config, folder: Path, options: PriorOptions | None = None, reporter: Reporter = SILENT
) -> PriorCard:
    """Train a prior for the encoder and the demonstrations of a config, and write it into a folder.

    Args:
        config: Data, model and seed. Cached latents are used if they exist; otherwise each clip is encoded when read.
        folder: The output folder.
        options: Options of the training.
        reporter: Shows the progress.

    Returns:
        The card of the prior. It contains the error of the predicted mean on held-out clips, relative to the zero
        action's, for true goals and for goals of other clips. If both errors are equal, the prior ignores the goal.

    Raises:
        InputError: The data, the model or the pre-trained prior cannot be used, or the loss is not finite.
    """
    options = options or PriorOptions()
    require_stride(config.data, to="train a prior")
    device = select_device(config.training)
    data, frames = config.data, open_dataset(config.data, progress=reporter.task(INDEXING))
    reporter.task(LOADING)
    model, spaces = load_base(config.model, seed=config.seed).to(device), frames.spaces  # only the encoder is used
    if spaces.action.effect == "unknown":
        problem = "actions whose effect on the state is unknown, so that a planner cannot use them"
        needed = "data.actions: difference, or data.join_actions: sum or last"
        raise InputError(where="data.actions: recorded", found=problem, needed=needed)
    dataset = use_finished_cache(config, frames, model)
    if options.ahead is not None:
        dataset = dataset.with_frames(options.ahead + 1)
    prior = _train(dataset, model, config, options, reporter)
    card = PriorCard(
        format="vjepa2-ac prior 1",
        sizes=prior.sizes,
        encoder=model.encoder_fingerprint(),
        crop=data.crop,
        data=data.path,
        steps=options.steps,
        learning_rate=options.learning_rate,
        held_out=_measure(dataset, model, prior, spaces),
        pretrained=str(options.pretrained or ""),
        time=utc_now(),
    )
    save_prior(folder, card, prior)
    return card


def _train(
    dataset: Dataset, model: WorldModel, config: Config, options: PriorOptions, reporter: Reporter
) -> ActionPrior:
    generator, spaces = torch.Generator().manual_seed(config.seed), dataset.spaces
    grid, widths, ahead = model.image_size // model.sizes.patch_size, spaces.widths, dataset.config.frames - 1
    sizes = PriorSizes(grid, model.latent_dim, widths.state, widths.action, ahead)
    prior = None
    if options.pretrained is not None:
        prior = _load_pretrained(options.pretrained, sizes, model.encoder_fingerprint(), config.data.crop)
    progress, steps = reporter.task("training the prior", "steps"), options.steps
    with closing(training_loader(dataset, seed=config.seed, batch_size=options.batch_size)) as batches:
        first_batches = [
            _draw_pairs(clips, spaces, generator)
            for clips in itertools.islice(_encode_batches(batches, model), _NUM_SCALE_BATCHES)
        ]
        if prior is None:
            prior = _make_prior(sizes, torch.cat([batch.changes for batch in first_batches]), config.seed)
        prior.to(model.device)
        optimizer = torch.optim.AdamW(prior.parameters(), lr=options.learning_rate, weight_decay=0.01)
        pairs = (_draw_pairs(clips, spaces, generator) for clips in _encode_batches(batches, model))
        for step, batch in enumerate(itertools.islice(itertools.chain(first_batches, pairs), steps), start=1):
            for group in optimizer.param_groups:
                factor = min(1.0, step / _WARM_UP) * 0.5 * (1 + math.cos(math.pi * (step - 1) / steps))
                group["lr"] = factor * options.learning_rate
            mean, deviation = prior(batch.frame, batch.goal, batch.remaining, batch.states)
            loss = prior_loss(mean, deviation, batch.changes / prior.scale)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]  # torch
            norm = torch.nn.utils.clip_grad_norm_(prior.parameters(), _MAX_GRADIENT_NORM)
            if not math.isfinite(float(norm)):
                problem = f"the loss of step {step} is not finite"
                raise InputError(
                    where="vjepa2-ac prior", found=problem, fix="Check the states with `vjepa2-ac data check`"
                )
            optimizer.step()
            progress(step, steps)
    return prior.eval().requires_grad_(False)


def _make_prior(sizes: PriorSizes, changes: Float[Tensor, "steps action_dim"], seed: int) -> ActionPrior:
    """Return a prior with random weights for actions of the scale of these changes."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        prior = ActionPrior(sizes)
    prior.scale.copy_(changes.std(dim=0).clamp(min=1e-6))
    return prior


def _load_pretrained(folder: Path, sizes: PriorSizes, encoder: str, crop: str) -> ActionPrior:
    """Load a prior for further training. The scale of its actions stays, because its weights predict in this unit.

    The longest distance to a goal may differ. The pre-trained prior uses its last embedding for longer distances, so
    this embedding is the start for them.

    Raises:
        InputError: The prior cannot be read, or was trained for another encoder, crop or width of states or actions.
    """
    card, pretrained = load_prior(folder, where="--pretrained")
    where, fix = f"--pretrained: {folder}", "Train a prior on a config with this encoder and data, or omit --pretrained"
    _require_same_inputs(card, encoder, crop, where=where, fix=fix)
    for name, size in asdict(card.sizes).items():
        if name != "ahead" and size != getattr(sizes, name):
            problem, needed = f"a prior with the size {name} {size}", f"{name} {getattr(sizes, name)}"
            raise InputError(where=where, found=problem, needed=needed, fix=fix)
    weights = pretrained.state_dict()
    rows = torch.arange(sizes.ahead + 1).clamp(max=card.sizes.ahead)
    prior = ActionPrior(sizes)
    prior.load_state_dict(weights | {"remaining.weight": weights["remaining.weight"][rows]})
    return prior


def prior_loss(mean: Tensor, deviation: Tensor, changes: Tensor) -> Tensor:
    """Return the mean absolute error, plus the negative log-likelihood of a Laplace distribution for the deviation.

    The error is detached in the second part: a large predicted deviation does not weaken the gradient of the mean.
    """
    error = (mean - changes).abs()
    return (error + error.detach() / deviation + deviation.log()).mean()


def _encode_batches(batches: Iterator[Batch], model: WorldModel) -> Iterator[LatentBatch]:
    """Yield batches of clips as latents. Batches without any readable clip are left out."""
    for batch in batches:
        if len(batch.episode_ids):
            yield encode_batch(model, batch, device=model.device)


def _draw_pairs(clips: LatentBatch, spaces: Spaces, generator: torch.Generator) -> _Pairs:
    """Draw a frame of each clip, and a later frame as its goal."""
    count, steps = clips.actions.shape[:2]
    rows, positions = torch.arange(count), torch.randint(steps, (count,), generator=generator)
    gap = 1 + (torch.rand(count, generator=generator) * (steps - positions)).long()
    states, changes = clips.states[rows, positions], clips.actions[rows, positions]
    if spaces.action.effect == "target":
        changes = changes - states
    goal = clips.latents[rows, positions + gap]
    return _Pairs(clips.latents[rows, positions], goal, gap.to(goal.device), states, changes)


@torch.no_grad()
def _measure(dataset: Dataset, model: WorldModel, prior: ActionPrior, spaces: Spaces) -> dict[str, Any]:
    """Measure the error of the predicted mean on held-out clips, relative to the zero action's.

    The error is measured with true goals and with goals of other clips. Without held-out clips the result is empty.
    """
    generator, size = torch.Generator().manual_seed(0), spaces.action.size_axes
    errors: dict[str, list[Tensor]] = {"true_goals": [], "goals_of_others": [], "zero_action": []}
    ids: list[str] = []
    if dataset.split_mask("test").any():
        for clips in _encode_batches(validation_batches(dataset, "test", clips=_NUM_HELD_OUT, batch_size=32), model):
            pairs = _draw_pairs(clips, spaces, generator)
            for name, goals in (("true_goals", pairs.goal), ("goals_of_others", pairs.goal.roll(1, dims=0))):
                mean, _ = prior(pairs.frame, goals, pairs.remaining, pairs.states)
                errors[name].append((mean * prior.scale - pairs.changes)[:, size].norm(dim=1))
            errors["zero_action"].append(pairs.changes[:, size].norm(dim=1))
            ids += clips.episode_ids
    if not ids:
        return {}
    joined = {name: torch.cat(parts).double().cpu().numpy() for name, parts in errors.items()}
    ratios: dict[str, Estimate] = {
        name: estimate_ratio(joined[name], joined["zero_action"], ids) for name in ("true_goals", "goals_of_others")
    }
    return {"clips": len(ids), **{name: estimate.as_dict() for name, estimate in ratios.items()}}
