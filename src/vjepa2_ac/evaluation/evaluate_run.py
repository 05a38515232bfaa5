"""Evaluation of a run or a model on held-out episodes: load it and its references, measure, write the results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from vjepa2_ac import __version__
from vjepa2_ac.config import Config, PlanningConfig
from vjepa2_ac.data.clips import frames_of
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import batches_of, validation_windows
from vjepa2_ac.data.transforms import frames_as_seen
from vjepa2_ac.decoding.decoder_folder import load_decoder
from vjepa2_ac.distributed.processes import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.encoding.training_cache import with_latents_if_there
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.evaluation.decoded_rollouts.measure import measure_decoded
from vjepa2_ac.evaluation.decoded_rollouts.metric_networks import load_metric_networks
from vjepa2_ac.evaluation.decoded_rollouts.setup import HandsOf, decoding_of
from vjepa2_ac.evaluation.evaluate import ClipName, FramesOfRow, RepeatableClips, evaluate
from vjepa2_ac.evaluation.measure import ClipSample
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions, settle
from vjepa2_ac.evaluation.result import About, Evaluation, TrainingCurve
from vjepa2_ac.evaluation.stride_calibration.measure import calibrate_model
from vjepa2_ac.evaluation.subject import load_subject
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.runs.checkpoint import select_checkpoint
from vjepa2_ac.runs.folder import METRICS, is_run
from vjepa2_ac.runs.loading import TrainedRun
from vjepa2_ac.runs.metrics_log import read_metrics_log, warnings_of
from vjepa2_ac.storage import try_writing_at, user_can_write
from vjepa2_ac.storage.structured import utc_now


@dataclass(frozen=True)
class Measured:
    """The result of an evaluation."""

    evaluation: Evaluation
    checkpoint: str  # which one, as text; "" of a model
    folder: Path  # of the output


def measure_subject(
    subject: str,
    asked: EvaluationOptions | None = None,
    *,
    reporter: Reporter = SILENT,
    hands: HandsOf | None = None,
) -> Measured:
    """Measure a run or a model on held-out episodes. Cheap failures first.

    Args:
        subject: The folder of a run; or a model, as in `model.base`.
        asked: The options.
        reporter: Shows the progress of each part of the work.
        hands: Returns where the hand is in the images of a data set, if its data say so; with a decoder only.

    Raises:
        InputError: The subject, the data, the decoder, a file of a metric, or a model to compare with cannot be used;
            the split is empty.
    """
    asked = asked or EvaluationOptions()
    config, planning, folder = settle(subject, asked)
    if is_run(subject):
        select_checkpoint(Path(subject), asked.checkpoint)
    _make_writable(folder)
    decoder = None if asked.decoder is None else load_decoder(asked.decoder)
    networks = load_metric_networks(asked)
    accelerator = make_accelerator(config)
    dataset = open_dataset(config.data, progress=reporter.task("looking through the data"))
    chosen = validation_windows(dataset, asked.split, clips=asked.clips)
    loaded = load_subject(subject, config, asked, dataset, decoder)
    run, world_model, contenders = loaded.run, loaded.world_model, loaded.contenders
    through_cache = with_latents_if_there(config, dataset, world_model)
    if through_cache.config.is_cache and not asked.calibrate:
        world_model.set_encoder_aside()
    loaded.put_on(accelerator.device)
    calibration = None
    if asked.calibrate:
        sample, progress = ClipSample(asked.split, asked.clips), reporter.task("calibrating strides")
        calibration = calibrate_model(world_model, dataset, config, accelerator, sample, progress).as_dict()
    encode = partial(encode_batch, world_model, device=accelerator.device, chunk=config.model.encode_chunk)
    read = partial(batches_of, batch_size=config.validation.batch_size)
    clips = _clips(through_cache, chosen, read, encode, world_model.image_size)
    with accelerator.autocast():
        evaluation = evaluate(
            contenders,
            clips,
            _about(subject, run, config, dataset, asked),
            probes=_probes(asked, planning, dataset),
            reporter=reporter,
        )
        decoded = None
        if decoder is not None:
            decoding = decoding_of(decoder.to(accelerator.device), world_model, through_cache, hands)
            decoding = replace(decoding, networks=networks.to(accelerator.device))
            decoded = measure_decoded(contenders, clips, decoding, evaluation.examples, reporter=reporter)
    evaluation = replace(
        evaluation,
        decoded=decoded,
        training=training_curves(Path(subject)) if run else (),
        calibration=calibration,
        notes=(*loaded.notes, *(_warnings(Path(subject)) if run else ()), *evaluation.notes),
    )
    return Measured(evaluation, run.chosen if run else "", folder)


def _make_writable(folder: Path) -> None:
    """Make the folder of the output, and write in it once, before anything takes long."""
    with user_can_write(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try_writing_at(folder)


def _probes(asked: EvaluationOptions, planning: PlanningConfig, dataset: Dataset) -> ProbeOptions:
    """Return the probes that these data allow: axes are those of poses in the robot base frame."""
    axis_clips = asked.probes.axis_clips if dataset.spaces.state.is_base_pose else 0
    return replace(asked.probes, planning=planning, axis_clips=axis_clips)


def _warnings(folder: Path) -> list[str]:
    """Return the warnings of the training, as sentences."""
    return [f"In training, {text}." for text in warnings_of(folder / METRICS)]


def training_curves(folder: Path) -> tuple[TrainingCurve, ...]:
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
    batches: Callable[[Dataset, Sequence[tuple[int, int]]], Iterable[Batch]],
    encode: Callable[[Batch], LatentBatch],
    image_size: int,
) -> RepeatableClips:
    """Return the clips at these windows, which can be read repeatedly."""
    by_name = {(dataset.table.identity(episode), start): (episode, start) for episode, start in windows}

    def read(names: Sequence[ClipName] | None) -> Iterable[tuple[LatentBatch, FramesOfRow]]:
        wanted = windows if names is None else [by_name[name] for name in names]
        for batch in batches(dataset, wanted):
            yield encode(batch), partial(_frames_of_row, dataset, batch, image_size)

    return RepeatableClips(len(windows), read)


def _frames_of_row(dataset: Dataset, batch: Batch, size: int, row: int) -> UInt8[np.ndarray, "time size size 3"]:
    """Return the frames of a clip as the encoder sees them; of cached latents, enlarged small frames."""
    return frames_as_seen(frames_of(dataset, batch, row), size)


def _about(subject: str, run: TrainedRun | None, config: Config, dataset: Dataset, asked: EvaluationOptions) -> About:
    data = dataset.config
    return About(
        subject=subject,
        checkpoint=run.chosen if run else "",
        checkpoint_path=str(run.checkpoint) if run else "",
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
    )
