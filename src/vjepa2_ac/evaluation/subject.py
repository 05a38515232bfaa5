"""What is evaluated: a run or a model, and the models that it is compared with, on the same latents."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder
from vjepa2_ac.encoding.batch import require_widths
from vjepa2_ac.episode import Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.decoded.record import NEIGHBOURS, TRUE_FRAMES
from vjepa2_ac.evaluation.evaluate import Contender
from vjepa2_ac.evaluation.request import EvaluationOptions
from vjepa2_ac.evaluation.result import Role
from vjepa2_ac.model.adapter.merging import base_only, unadapted_copy
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.input_heads import heads_to_replace, widths_as_text
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.places import BUILTIN
from vjepa2_ac.runs.folder import is_run
from vjepa2_ac.runs.loading import TrainedRun, load_run

BASE = "base"
_NO_BASE = "There is no base to compare with: it takes states or actions of other widths than this robot's."


@dataclass(frozen=True, eq=False)
class Subject:
    """A run or a model, loaded, and all that is measured with it."""

    run: TrainedRun | None  # None: a model
    world_model: WorldModel
    contenders: tuple[Contender, ...]  # the base first and the subject last
    notes: tuple[str, ...]  # on them

    def put_on(self, device: torch.device) -> None:
        """Move all models to a device, ready to be measured; the encoder of the subject is enough for all."""
        for each in self.contenders:
            if isinstance(each.model, WorldModel):
                each.model.predictor.to(device).eval()
        self.world_model.to(device).eval()


def load_subject(
    name: str, config: Config, asked: EvaluationOptions, dataset: Dataset, decoder: TrainedDecoder | None = None
) -> Subject:
    """Load a run or a model, and what it is compared with, on the CPU. Cheap failures first.

    Args:
        name: The folder of a run; or a model, as in `model.base`.
        config: As `settle` returned it.
        asked: Which checkpoint, and what to compare with.
        dataset: What it is measured on.
        decoder: If its latents are to be decoded.

    Raises:
        InputError: One of the models cannot be loaded; it does not fit the data, the decoder, or the others.
    """
    run = load_run(Path(name), asked.checkpoint) if is_run(name) else None
    world_model = run.world_model if run else load_model(name, config)
    require_widths(world_model, dataset.widths, where=name)
    if decoder is not None:
        decoder.require_fit(world_model, config.data.crop, subject=name)
    contenders, notes = _contenders_of(name, config, run, world_model, asked, dataset.widths)
    return Subject(run, world_model, tuple(contenders), notes)


def load_model(name: str, config: Config) -> WorldModel:
    """Load a model by its name, with the config's other settings of a model."""
    return load_base(config.model.with_base(name), seed=config.seed)


def _contenders_of(
    subject: str,
    config: Config,
    run: TrainedRun | None,
    world_model: WorldModel,
    asked: EvaluationOptions,
    widths: Widths,
) -> tuple[list[Contender], tuple[str, ...]]:
    """Return the models to measure, the base first and the subject last; and notes on them."""
    against = asked.against if asked.against is not None else (BASE,) * (run is not None)
    found: list[Contender] = []
    notes: tuple[str, ...] = ()
    if BASE in against and run is not None and config.model.base is not None:
        if world_model.fresh_heads is not None:
            notes = (_NO_BASE,)
        else:
            found.append(_contender(BASE, "base", world_model, partial(base_only, world_model)))
    elif BASE in against and run is None:
        if config.model.base is None:
            raise InputError(
                where="--against base", found="a config without model.base", needed="a base to compare with"
            )
        found.append(Contender(BASE, "base", _like(world_model, config.model.base, config, subject, widths)))
    name = "adapter" if world_model.adaptation is not None and world_model.adaptation.kind == "lora" else "model"
    for other in against:
        if other != BASE:
            taken = {each.name for each in found} | {name, BASE, "persistence", TRUE_FRAMES, *NEIGHBOURS}
            called = Path(other).name if Path(other).name not in taken else other
            found.append(_contender(called, "other", _like(world_model, other, config, subject, widths)))
    return [*found, _contender(name, "trained", world_model)], notes


def _contender(
    name: str, role: Role, model: WorldModel, switched: Callable[[], AbstractContextManager[object]] = nullcontext
) -> Contender:
    """Return a model to measure unmerged; a merged copy plans in its place (see `planning.model_setup`)."""
    adaptation = model.adaptation
    plans_as_it_is = adaptation is None or (role == "base" and adaptation.kind == "lora")  # whose adapter is off then
    return Contender(name, role, model, switched, None if plans_as_it_is else partial(unadapted_copy, model))


def _like(world_model: WorldModel, other: str, config: Config, subject: str, widths: Widths) -> WorldModel:
    """Load another run or model that can be measured on the same latents, and states and actions of these widths.

    Raises:
        InputError: It has another encoder, or takes other states or actions.
    """
    if not (other.startswith(BUILTIN) or Path(other).exists()):
        raise InputError(
            where=f"--against {other}",
            found="no such file or folder",
            needed="base, the folder of a run, or a model: what model.base takes",
        )
    loaded = load_run(Path(other)).world_model if is_run(other) else load_model(other, config)
    same = loaded.image_size == world_model.image_size
    if not same or loaded.encoder_fingerprint() != world_model.encoder_fingerprint():
        raise InputError(
            where=f"--against {other}",
            found=f"another encoder than that of {subject}",
            needed="the same one: errors are compared on the same latents",
            fix="Evaluate each by itself, and put their ratios to persistence side by side with `vjepa2-ac compare`",
        )
    if heads_to_replace(loaded.sizes, widths):
        raise InputError(
            where=f"--against {other}",
            found=f"a model of {widths_as_text(loaded.sizes)}",
            needed=f"{widths.state} and {widths.action}, as the data of {subject} has",
        )
    return loaded
