"""Evaluate a run or a model on held-out episodes: load all models, and measure them on the same clips."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, frames_for_display, open_dataset
from vjepa2_ac.data.loader import read_batches, validation_windows
from vjepa2_ac.data.transforms import pixels_to_input, to_display_frames
from vjepa2_ac.decoding.decoder import TrainedDecoder, load_decoder, to_pixels
from vjepa2_ac.distributed import join_processes, own_share, run_first_per_machine, run_on_first, share_work
from vjepa2_ac.encoding.batch import encode_batch, require_widths
from vjepa2_ac.encoding.encode_dataset import use_finished_cache
from vjepa2_ac.episode import Batch, LatentBatch, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.decoded import BASELINES, TRUE_FRAMES, measure_decoded
from vjepa2_ac.evaluation.evaluate import ClipName, EvaluatedModel, FramesOfRow, RepeatableClips, evaluate
from vjepa2_ac.evaluation.measure import previous_clip_actions
from vjepa2_ac.evaluation.request import EvaluationOptions, resolve_config
from vjepa2_ac.evaluation.result import PERSISTENCE, About, Evaluation
from vjepa2_ac.model.lora import use_base_weights
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.runs.checkpoint import select_checkpoint
from vjepa2_ac.runs.folder import METRICS, is_run
from vjepa2_ac.runs.metrics_log import read_warnings
from vjepa2_ac.runs.subject import Subject, load_subject
from vjepa2_ac.storage import check_local_writable, translate_write_errors
from vjepa2_ac.storage.paths import BUILTIN
from vjepa2_ac.storage.structured import utc_now

BASE = "base"
_NO_BASE = "The base model is not compared: its states or actions have other widths than those of this robot."


@dataclass(frozen=True, eq=False)
class LoadedModels:
    """A run or a model under evaluation, and the models that it is compared with."""

    subject: Subject
    evaluated_models: tuple[EvaluatedModel, ...]  # all models: the base model first, the subject last
    notes: tuple[str, ...]  # notes on the models, as sentences

    @property
    def world_model(self) -> WorldModel:
        """The evaluated model."""
        return self.subject.world_model

    def move_to(self, device: torch.device) -> None:
        """Move all predictors, and the encoder that all models share, to a device, and set them to eval mode."""
        for each in self.evaluated_models:
            if isinstance(each.model, WorldModel):
                each.model.predictor.to(device).eval()
        self.world_model.to(device).eval()


def load_models(
    name: str, config: Config, options: EvaluationOptions, dataset: Dataset, decoder: TrainedDecoder | None = None
) -> LoadedModels:
    """Load a run or a model, and the models to compare it with, on the CPU.

    Args:
        name: The folder of a run, or a model as in `model.base`.
        config: The config that `resolve_config` returned.
        options: The options; `checkpoint` and `against` are used.
        dataset: The data of the evaluation.
        decoder: The decoder; None: latents are not decoded.

    Raises:
        InputError: A model cannot be loaded, or does not fit the data, the decoder, or the other models.
    """
    subject = load_subject(name, options.checkpoint, config=config)
    world_model, is_of_run, is_base = subject.world_model, subject.checkpoint is not None, subject.is_base
    require_widths(world_model, dataset.widths, where=name)
    notes = list(subject.warnings)
    if decoder is not None:
        notes += decoder.require_compatible(world_model, config.data, subject=name)
    against = options.against if options.against is not None else (BASE,) * is_of_run
    if is_base:  # the subject is the base model, which is measured only once
        against = tuple(other for other in against if other != BASE)
    evaluated_models: list[EvaluatedModel] = []
    if BASE in against and config.model.is_random:
        if options.against is not None:
            problem, needed = "a model without a base model (model.base: random)", "a base model"
            raise InputError(where="--against base", found=problem, needed=needed, fix="Leave out --against base")
    elif BASE in against and not is_of_run:
        base_model = _load_compatible(name, world_model, config.model.base, config, dataset.widths)
        evaluated_models.append(EvaluatedModel(BASE, "base", base_model))
    elif BASE in against and world_model.new_input_projections is not None:
        notes.append(_NO_BASE)
    elif BASE in against:
        evaluated_models.append(EvaluatedModel(BASE, "base", world_model, partial(use_base_weights, world_model)))
    is_adapter = world_model.adaptation is not None and world_model.adaptation.kind == "lora"
    subject_label = BASE if is_base else "adapter" if is_adapter else "model"
    for other in against:
        if other != BASE:
            used = {each.name for each in evaluated_models} | {
                subject_label,
                BASE,
                PERSISTENCE,
                TRUE_FRAMES,
                *BASELINES,
            }
            label = Path(other).name if Path(other).name not in used else other
            other_model = _load_compatible(name, world_model, other, config, dataset.widths)
            evaluated_models.append(EvaluatedModel(label, "other", other_model))
    return LoadedModels(
        subject, (*evaluated_models, EvaluatedModel(subject_label, "trained", world_model)), tuple(notes)
    )


def _load_compatible(subject: str, world_model: WorldModel, other: str, config: Config, widths: Widths) -> WorldModel:
    """Load another run or model, and check that it has the same encoder and fits states and actions of these widths.

    Raises:
        InputError: The model has another encoder, or its states or actions have other widths.
    """
    where = f"--against {other}"
    if not (other.startswith(BUILTIN) or Path(other).exists()):
        needed = "base, the folder of a run, or a model in a form that model.base accepts"
        raise InputError(where=where, found="no such file or folder", needed=needed)
    loaded = load_subject(other, config=None if is_run(other) else config).world_model
    has_same_size = loaded.image_size == world_model.image_size
    if not has_same_size or loaded.encoder_fingerprint() != world_model.encoder_fingerprint():
        problem = f"an encoder that differs from that of {subject}"
        needed = "the same encoder, since errors compare latents"
        fix = "Evaluate each run separately, and compare their errors relative to persistence with `vjepa2-ac compare`"
        raise InputError(where=where, found=problem, needed=needed, fix=fix)
    require_widths(loaded, widths, where=where)
    return loaded


def evaluate_subject(subject: str, options: EvaluationOptions, *, reporter: Reporter = SILENT) -> Evaluation:
    """Measure a run or a model on held-out episodes. Several processes share the work.

    Args:
        subject: The folder of a run, or a model as in `model.base`.
        options: The options.
        reporter: Shows the progress of each part of the work.

    Raises:
        InputError: The subject, the data, the decoder, or a model to compare with cannot be used, the split is empty,
            or the output folder cannot be written.
    """
    config = resolve_config(subject, options)
    with join_processes(config) as accelerator:
        run_on_first(accelerator, partial(_require_checkpoint_and_folder, subject, options))
        decoder = None if options.decoder is None else load_decoder(options.decoder)
        progress = reporter.task(INDEXING)
        dataset = run_first_per_machine(accelerator, lambda: open_dataset(config.data, progress=progress))
        windows = validation_windows(dataset, options.split, clips=options.clips)
        reporter.task(LOADING)
        loaded = load_models(subject, config, options, dataset, decoder)
        world_model, device = loaded.world_model, accelerator.device
        cached = use_finished_cache(config, dataset, world_model)  # the data set itself if there is no finished cache
        if cached.config.is_cache and decoder is None:
            world_model.remove_encoder()
        loaded.move_to(device)
        with accelerator.autocast(), share_work(accelerator):
            clips = _make_clips(cached, windows, config, world_model, device)
            about = _make_about(loaded.subject, config, dataset, options)
            evaluation = evaluate(loaded.evaluated_models, clips, about, probes=options.probes, reporter=reporter)
            decoded = None
            if decoder is not None:
                encode = partial(_encode_images, world_model)
                decoder.to(device)
                decoded = measure_decoded(
                    loaded.evaluated_models, clips, decoder, evaluation.examples, encode=encode, reporter=reporter
                )
    is_of_run = loaded.subject.checkpoint is not None
    warnings = [f"In training, {text}." for text in read_warnings(Path(subject) / METRICS)] if is_of_run else []
    return replace(evaluation, decoded=decoded, notes=(*loaded.notes, *warnings, *evaluation.notes))


def _encode_images(
    world_model: WorldModel, images: Float[Tensor, "batch time 3 size size"]
) -> Float[Tensor, "batch time tokens dim"]:
    """Return the latents of decoded images. The images are first rounded to 8 bits, like camera images."""
    pixels = torch.from_numpy(to_pixels(images)).to(images.device)
    return world_model.encode(pixels_to_input(pixels, world_model.image_size))


def _require_checkpoint_and_folder(subject: str, options: EvaluationOptions) -> None:
    """Check that a run has the requested checkpoint, and that the output folder can be written."""
    folder = options.out or Path(subject)
    if is_run(subject):
        select_checkpoint(Path(subject), options.checkpoint)
    with translate_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        check_local_writable(folder)


def _make_clips(
    dataset: Dataset,
    windows: Sequence[tuple[int, int]],
    config: Config,
    world_model: WorldModel,
    device: torch.device,
) -> RepeatableClips:
    """Return the clips at some windows, with the frames that the encoder receives; for a latent cache, small frames."""
    batch_size = config.validation.batch_size
    encode = partial(encode_batch, world_model, device=device)
    own_indices = own_share(len(windows), batch_size)
    by_name = {(dataset.table.identity(episode), start): (episode, start) for episode, start in windows}
    read_windows = partial(read_batches, dataset, allow_empty=True)

    def frames(batch: Batch, row: int) -> UInt8[np.ndarray, "time size size 3"]:
        return to_display_frames(frames_for_display(dataset, batch, row), world_model.image_size)

    def read(names: Sequence[ClipName] | None) -> Iterable[tuple[LatentBatch, FramesOfRow]]:
        selected = windows[own_indices.start : own_indices.stop] if names is None else [by_name[name] for name in names]
        for batch in read_windows(selected, batch_size=batch_size):
            yield encode(batch), partial(frames, batch)

    before = previous_clip_actions(own_indices, windows, partial(read_windows, batch_size=1))
    return RepeatableClips(tuple(by_name), read, dataset.spaces.action, not dataset.config.is_cache, before, device)


def _make_about(subject: Subject, config: Config, dataset: Dataset, options: EvaluationOptions) -> About:
    data = dataset.config
    return About(
        subject=subject.name,
        checkpoint=subject.checkpoint_label,
        checkpoint_path=str(subject.checkpoint or ""),
        source=data.source,
        data=data.path,
        cameras=tuple(data.cameras),
        split=options.split,
        frames=data.frames,
        stride=data.model_stride,
        seconds_per_step=data.model_stride / dataset.control_rate_hz,
        seed=config.seed,
        version=__version__,
        time=utc_now(),
        is_base=subject.is_base,
    )
