"""Evaluation of a run or a model on held-out episodes: load it and what it is compared with, measure on the clips."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from accelerate import Accelerator
from jaxtyping import UInt8

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, frames_of, open_dataset
from vjepa2_ac.data.loader import batches_of, validation_windows
from vjepa2_ac.data.transforms import frames_as_seen
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder, load_decoder
from vjepa2_ac.distributed import first_of_machine, first_only, own_part, sharing
from vjepa2_ac.encoding.batch import encode_batch, require_widths
from vjepa2_ac.encoding.encode_dataset import with_latents_if_there
from vjepa2_ac.episode import Batch, LatentBatch, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.calibration.variants import calibrate_model
from vjepa2_ac.evaluation.decoded import NEIGHBOURS, TRUE_FRAMES, load_lpips, measure_decoded
from vjepa2_ac.evaluation.evaluate import ClipName, Contender, FramesOfRow, RepeatableClips, evaluate
from vjepa2_ac.evaluation.measure import ClipSample, actions_before
from vjepa2_ac.evaluation.request import EvaluationOptions, settle
from vjepa2_ac.evaluation.result import PERSISTENCE, About, Evaluation, Measurement, Role, TrainingCurve
from vjepa2_ac.model.adapter.lora import base_only, unadapted_copy
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.policies.action_prior import load_prior
from vjepa2_ac.reporter import LOADING, SILENT, Reporter
from vjepa2_ac.runs.checkpoint import select_checkpoint
from vjepa2_ac.runs.folder import METRICS, is_run
from vjepa2_ac.runs.metrics_log import read_metrics_log, warnings_of
from vjepa2_ac.runs.subject import Subject, load_subject
from vjepa2_ac.storage import try_writing_at, user_can_write
from vjepa2_ac.storage.places import BUILTIN
from vjepa2_ac.storage.structured import utc_now

BASE = "base"
_NO_BASE = "There is no base to compare with: it takes states or actions of other widths than this robot's."


@dataclass(frozen=True, eq=False)
class Models:
    """A run or a model, and what it is compared with."""

    subject: Subject
    contenders: tuple[Contender, ...]  # the base first and the subject last
    notes: tuple[str, ...]  # on them

    @property
    def world_model(self) -> WorldModel:
        """The model of the subject."""
        return self.subject.world_model

    def put_on(self, device: torch.device) -> None:
        """Move all models to a device, ready to be measured; the encoder of the subject is enough for all."""
        for each in self.contenders:
            if isinstance(each.model, WorldModel):
                each.model.predictor.to(device).eval()
        self.world_model.to(device).eval()


def load_models(
    name: str, config: Config, asked: EvaluationOptions, dataset: Dataset, decoder: TrainedDecoder | None = None
) -> Models:
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
    subject = load_subject(name, asked.checkpoint, config=config)
    world_model, is_of_run, is_base = subject.world_model, subject.checkpoint is not None, subject.is_base
    require_widths(world_model, dataset.widths, where=name)
    notes = list(subject.warnings)
    if decoder is not None:
        notes += decoder.require_fit(world_model, config.data, subject=name)
    against = asked.against if asked.against is not None else (BASE,) * is_of_run
    against = tuple(other for other in against if other != BASE) if is_base else against  # it is measured once
    found: list[Contender] = []
    if BASE in against and config.model.is_random:
        if asked.against is not None:
            absent, needed = "a model without a base (model.base: random)", "a base to compare with"
            raise InputError(where="--against base", found=absent, needed=needed, fix="Leave out --against base")
    elif BASE in against and not is_of_run:
        found.append(_contender(BASE, "base", _like(name, world_model, config.model.base, config, dataset.widths)))
    elif BASE in against and world_model.fresh_heads is not None:
        notes.append(_NO_BASE)
    elif BASE in against:
        found.append(_contender(BASE, "base", world_model, partial(base_only, world_model)))
    is_adapter = world_model.adaptation is not None and world_model.adaptation.kind == "lora"
    own = BASE if is_base else "adapter" if is_adapter else "model"
    for other in against:
        if other != BASE:
            taken = {each.name for each in found} | {own, BASE, PERSISTENCE, TRUE_FRAMES, *NEIGHBOURS}
            called = Path(other).name if Path(other).name not in taken else other
            found.append(_contender(called, "other", _like(name, world_model, other, config, dataset.widths)))
    return Models(subject, (*found, _contender(own, "trained", world_model)), tuple(notes))


def _contender(
    name: str, role: Role, model: WorldModel, switched: Callable[[], AbstractContextManager[object]] = nullcontext
) -> Contender:
    """Return a model to measure unmerged; a merged copy plans in its place (see `planning.model_setup`)."""
    adaptation = model.adaptation
    plans_as_it_is = adaptation is None or (role == "base" and adaptation.kind == "lora")  # whose adapter is off then
    return Contender(name, role, model, switched, None if plans_as_it_is else partial(unadapted_copy, model))


def _like(subject: str, world_model: WorldModel, other: str, config: Config, widths: Widths) -> WorldModel:
    """Load another run or model that can be measured on the same latents, and states and actions of these widths.

    Raises:
        InputError: It has another encoder, or takes other states or actions.
    """
    where = f"--against {other}"
    if not (other.startswith(BUILTIN) or Path(other).exists()):
        needed = "base, the folder of a run, or a model: what model.base takes"
        raise InputError(where=where, found="no such file or folder", needed=needed)
    loaded = load_subject(other, config=None if is_run(other) else config).world_model
    same = loaded.image_size == world_model.image_size
    if not same or loaded.encoder_fingerprint() != world_model.encoder_fingerprint():
        found, needed = f"another encoder than that of {subject}", "the same one: errors are of the same latents"
        fix = "Evaluate each by itself, and put their ratios to persistence side by side with `vjepa2-ac compare`"
        raise InputError(where=where, found=found, needed=needed, fix=fix)
    require_widths(loaded, widths, where=where)
    return loaded


def measure_subject(
    subject: str, asked: EvaluationOptions, accelerator: Accelerator, *, reporter: Reporter = SILENT
) -> Evaluation:
    """Measure a run or a model on held-out episodes. Cheap failures first.

    Args:
        subject: The folder of a run; or a model, as in `model.base`.
        asked: The options.
        accelerator: Of the processes that share the work: `joined` by the settled config.
        reporter: Shows the progress of each part of the work.

    Raises:
        InputError: The subject, the data, the decoder, a file of a metric, or a model to compare with cannot be used;
            the split is empty; the folder of the output cannot be written.
    """
    config = settle(subject, asked)
    first_only(accelerator, partial(_require_places, subject, asked))
    decoder = None if asked.decoder is None else load_decoder(asked.decoder)
    lpips = load_lpips(asked.lpips, asked.lpips_heads) if asked.lpips and asked.lpips_heads else None
    plans_from_prior = asked.probes.planning_clips and config.planning.prior is not None
    trained = load_prior(str(config.planning.prior), where="planning.prior") if plans_from_prior else None
    progress = reporter.task("looking through the data")
    dataset = first_of_machine(accelerator, lambda: open_dataset(config.data, progress=progress))
    chosen = validation_windows(dataset, asked.split, clips=asked.clips)
    reporter.task(LOADING)
    loaded = load_models(subject, config, asked, dataset, decoder)
    world_model, contenders, is_of_run = loaded.world_model, loaded.contenders, loaded.subject.checkpoint is not None
    prior = (
        None
        if trained is None
        else trained.of(world_model.encoder_fingerprint(), config.data.crop).to(accelerator.device)
    )
    through_cache = with_latents_if_there(config, dataset, world_model)
    if through_cache.config.is_cache and not asked.calibrate:
        world_model.set_encoder_aside()
    loaded.put_on(accelerator.device)
    beside: dict[str, Measurement] = {}
    if asked.calibrate:
        sample, progress = ClipSample(asked.split, asked.clips), reporter.task("calibrating strides")
        beside["strides"] = calibrate_model(world_model, dataset, config, accelerator, sample, progress)
    encode = partial(encode_batch, world_model, device=accelerator.device, chunk=config.model.encode_chunk)
    axis_clips = asked.probes.axis_clips if dataset.spaces.state.is_base_pose else 0
    with accelerator.autocast(), sharing(accelerator):
        size, device = config.validation.batch_size, accelerator.device
        clips = _clips(through_cache, chosen, size, encode, device, world_model.image_size)
        evaluation = evaluate(
            contenders,
            clips,
            _about(loaded.subject, config, dataset, asked),
            probes=replace(asked.probes, planning=config.planning, prior=prior, axis_clips=axis_clips),
            reporter=reporter,
        )
        decoded = None
        if decoder is not None:
            decoder.to(accelerator.device)
            lpips = None if lpips is None else lpips.to(accelerator.device)
            decoded = measure_decoded(contenders, clips, decoder, evaluation.examples, lpips=lpips, reporter=reporter)
    warned = [f"In training, {text}." for text in warnings_of(Path(subject) / METRICS)] if is_of_run else []
    return replace(
        evaluation,
        decoded=decoded,
        training=_training_curves(Path(subject)) if is_of_run else (),
        beside=beside,
        notes=(*loaded.notes, *warned, *evaluation.notes),
    )


def _require_places(subject: str, asked: EvaluationOptions) -> None:
    """Check that a run has the checkpoint, and that the folder of the output can be written."""
    folder = asked.out or Path(subject)
    if is_run(subject):
        select_checkpoint(Path(subject), asked.checkpoint)
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try_writing_at(folder)


def _training_curves(folder: Path) -> tuple[TrainingCurve, ...]:
    """Return all scalar metrics of a run's metrics.jsonl, over optimizer steps."""
    points: dict[str, list[tuple[int, float]]] = {}
    for row in read_metrics_log(folder / METRICS):
        for name, value in row.items():
            if name != "step" and isinstance(value, int | float):
                points.setdefault(f"{row['kind']}/{name}", []).append((row["step"], float(value)))
    return tuple(
        TrainingCurve(name, tuple(step for step, _ in found), tuple(value for _, value in found))
        for name, found in points.items()
    )


def _clips(
    dataset: Dataset,
    windows: Sequence[tuple[int, int]],
    batch_size: int,
    encode: Callable[[Batch], LatentBatch],
    device: torch.device,
    image_size: int,
) -> RepeatableClips:
    """Return the clips at these windows, with the frames as the encoder sees them; of cached latents, small ones."""
    own = own_part(len(windows), batch_size)
    by_name = {(dataset.table.identity(episode), start): (episode, start) for episode, start in windows}
    some = partial(batches_of, dataset, may_be_none=True)

    def frames(batch: Batch, row: int) -> UInt8[np.ndarray, "time size size 3"]:
        return frames_as_seen(frames_of(dataset, batch, row), image_size)

    def read(names: Sequence[ClipName] | None) -> Iterable[tuple[LatentBatch, FramesOfRow]]:
        wanted = windows[own.start : own.stop] if names is None else [by_name[name] for name in names]
        for batch in some(wanted, batch_size=batch_size):
            yield encode(batch), partial(frames, batch)

    before = actions_before(own, windows, partial(some, batch_size=1))
    return RepeatableClips(tuple(by_name), read, not dataset.config.is_cache, before, device)


def _about(subject: Subject, config: Config, dataset: Dataset, asked: EvaluationOptions) -> About:
    data = dataset.config
    return About(
        subject=subject.name,
        checkpoint=subject.chosen,
        checkpoint_path=str(subject.checkpoint or ""),
        source=data.source,
        data=data.path,
        cameras=tuple(data.cameras),
        split=asked.split,
        frames=data.frames,
        stride=data.model_stride,
        seconds_per_step=data.model_stride / dataset.control_rate_hz,
        space=dataset.spaces.action,
        seed=config.seed,
        version=__version__,
        time=utc_now(),
        is_base=subject.is_base,
    )
