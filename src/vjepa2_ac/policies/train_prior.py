"""Training of a prior on the latents of a run's demonstrations: minutes on a CPU where they are cached."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import training_loader, validation_batches
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.distributed import computing_device
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.encoding.encode_dataset import with_latents_if_there
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.intervals import Estimate, ratio
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.policies.action_prior import ActionPrior, PriorCard, PriorSizes, save_prior
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.spaces import Spaces
from vjepa2_ac.storage.structured import utc_now

_FIRST = 8  # batches whose actions tell how large actions are
_WARM_UP, _CLIP, _HELD_OUT = 50, 1.0, 256


@dataclass(frozen=True)
class PriorOptions:
    """How a prior is trained."""

    steps: int = 2000
    ahead: int | None = None  # most model steps from a frame to its goal; None: as many as the run's clips have
    batch_size: int = 32
    learning_rate: float = 1e-3


@dataclass(frozen=True)
class _Pairs:
    """Frames with a later one of the same clip as the goal."""

    seen: Float[Tensor, "batch tokens dim"]
    wanted: Float[Tensor, "batch tokens dim"]
    remaining: Int[Tensor, " batch"]
    states: Float[Tensor, "batch state_dim"]
    changes: Float[Tensor, "batch action_dim"]  # of the next model step


def train_prior(
    config: Config, folder: Path, options: PriorOptions | None = None, reporter: Reporter = SILENT
) -> PriorCard:
    """Train the prior of a config's encoder and demonstrations, and write it into a folder.

    Args:
        config: Data, model and seed. Cached latents are used where they are; else every clip is encoded as it comes.
        folder: Where it goes.
        options: How it is trained.
        reporter: Shows the progress.

    Returns:
        What is known of it: of held-out clips the error of its mean, over that of the zero action, for true goals and
        for goals of other clips. A prior whose two numbers are the same does not look at the goal.

    Raises:
        InputError: The data or the model cannot be used, or the loss is not finite.
    """
    options = options or PriorOptions()
    require_stride(config.data, to="know how long a model step is")
    device = computing_device(config.training)
    data, frames = config.data, open_dataset(config.data, progress=reporter.task(INDEXING))
    reporter.task(LOADING)
    model, spaces = load_base(config.model, seed=config.seed).to(device), frames.spaces  # its encoder alone counts
    if spaces.action.follows == "unknown":
        found = "commands of which nobody knows what they do to the state"
        raise InputError(where="data.actions: recorded", found=found, needed="actions that a planner can search among")
    dataset = with_latents_if_there(config, frames, model)
    if options.ahead is not None:
        dataset = dataset.with_frames(options.ahead + 1)
    prior = _trained(dataset, model, config, options, reporter)
    card = PriorCard(
        format="vjepa2-ac prior 1",
        sizes=prior.sizes,
        encoder=model.encoder_fingerprint(),
        crop=data.crop,
        data=data.path,
        steps=options.steps,
        held_out=_measured(dataset, model, prior, spaces),
        time=utc_now(),
    )
    save_prior(folder, card, prior)
    return card


def _trained(
    dataset: Dataset, model: WorldModel, config: Config, options: PriorOptions, reporter: Reporter
) -> ActionPrior:
    drawn, spaces = torch.Generator().manual_seed(config.seed), dataset.spaces
    progress, steps = reporter.task("training the prior", "steps"), options.steps
    with closing(training_loader(dataset, seed=config.seed, batch_size=options.batch_size)) as batches:
        first = [_pairs(one, spaces, drawn) for one in itertools.islice(_encoded(batches, model), _FIRST)]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            grid, widths = model.image_size // model.sizes.patch_size, dataset.spaces.widths
            ahead = dataset.config.frames - 1
            sizes = PriorSizes(grid, model.latent_dim, widths.state, widths.action, ahead)
            prior = ActionPrior(sizes).to(model.device)
        prior.scale.copy_(torch.cat([one.changes for one in first]).std(dim=0).clamp(min=1e-6))
        optimizer = torch.optim.AdamW(prior.parameters(), lr=options.learning_rate, weight_decay=0.01)
        pairs = (_pairs(one, spaces, drawn) for one in _encoded(batches, model))
        for step, some in enumerate(itertools.islice(itertools.chain(first, pairs), steps), start=1):
            for group in optimizer.param_groups:
                share = min(1.0, step / _WARM_UP) * 0.5 * (1 + math.cos(math.pi * (step - 1) / steps))
                group["lr"] = share * options.learning_rate
            mean, deviation = prior(some.seen, some.wanted, some.remaining, some.states)
            loss = prior_loss(mean, deviation, some.changes / prior.scale)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]  # torch
            norm = torch.nn.utils.clip_grad_norm_(prior.parameters(), _CLIP)
            if not math.isfinite(float(norm)):
                found = f"a loss of step {step} that is not finite"
                raise InputError(where="vjepa2-ac prior", found=found, fix="`vjepa2-ac data check` finds broken states")
            optimizer.step()
            progress(step, steps)
    return prior.eval().requires_grad_(False)


def prior_loss(mean: Tensor, deviation: Tensor, changes: Tensor) -> Tensor:
    """Return the mean absolute error, plus the negative log-likelihood of a Laplace distribution for the deviation.

    The error is detached in the second part: a large predicted deviation does not weaken the gradient of the mean.
    """
    off = (mean - changes).abs()
    return (off + off.detach() / deviation + deviation.log()).mean()


def _encoded(batches: Iterator[Batch], model: WorldModel) -> Iterator[LatentBatch]:
    """Yield clips as latents; batches of which no clip could be read are left out."""
    for batch in batches:
        if len(batch.episode_ids):
            yield encode_batch(model, batch, device=model.device)


def _pairs(clips: LatentBatch, spaces: Spaces, drawn: torch.Generator) -> _Pairs:
    """Draw a frame of each clip, and as its goal a later one."""
    count, steps = clips.actions.shape[:2]
    rows, at = torch.arange(count), torch.randint(steps, (count,), generator=drawn)
    gap = 1 + (torch.rand(count, generator=drawn) * (steps - at)).long()
    states, changes = clips.states[rows, at], clips.actions[rows, at]
    if spaces.action.follows == "target":
        changes = changes - states
    wanted = clips.latents[rows, at + gap]
    return _Pairs(clips.latents[rows, at], wanted, gap.to(wanted.device), states, changes)


@torch.no_grad()
def _measured(dataset: Dataset, model: WorldModel, prior: ActionPrior, spaces: Spaces) -> dict[str, Any]:
    """Return the error of the mean over that of the zero action on held-out clips: with true and with others' goals."""
    drawn, size = torch.Generator().manual_seed(0), spaces.action.sized
    errors: dict[str, list[Tensor]] = {"true_goals": [], "goals_of_others": [], "nothing": []}
    ids: list[str] = []
    if dataset.members("test").any():
        for clips in _encoded(validation_batches(dataset, "test", clips=_HELD_OUT, batch_size=32), model):
            one = _pairs(clips, spaces, drawn)
            for name, wanted in (("true_goals", one.wanted), ("goals_of_others", one.wanted.roll(1, dims=0))):
                mean, _ = prior(one.seen, wanted, one.remaining, one.states)
                errors[name].append((mean * prior.scale - one.changes)[:, size].norm(dim=1))
            errors["nothing"].append(one.changes[:, size].norm(dim=1))
            ids += clips.episode_ids
    if not ids:
        return {}
    joined = {name: torch.cat(parts).double().cpu().numpy() for name, parts in errors.items()}
    over: dict[str, Estimate] = {
        name: ratio(joined[name], joined["nothing"], ids) for name in ("true_goals", "goals_of_others")
    }
    return {"clips": len(ids), **{name: one.as_dict() for name, one in over.items()}}
