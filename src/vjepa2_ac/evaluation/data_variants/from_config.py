"""Measurement of data variants from a config. See `evaluation.data_variants.measure`."""

from __future__ import annotations

from functools import partial

import torch

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.distributed.processes import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch, require_same_encoder, require_widths
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.data_variants.measure import VariantProbe, probe_variants
from vjepa2_ac.evaluation.measure import ClipSample
from vjepa2_ac.evaluation.stride_calibration.from_config import load_named


def probe_config(
    config: Config, dataset: Dataset, *, model: str, clips: int = 64, progress: Progress = no_progress
) -> VariantProbe:
    """Probe the data of a config, opened at a fixed stride, with a model.

    Args:
        config: The device and the precision.
        dataset: The data.
        model: What `model.base` takes, or the folder of a run.
        clips: Number of clips, of the validation episodes; of training episodes if there are no others.
        progress: Called with the number of measured clips.

    Raises:
        InputError: The data or the model cannot be used.
    """
    accelerator = make_accelerator(config)
    world_model = load_named(config, model)
    require_widths(world_model, dataset.widths, where=model)
    require_same_encoder(world_model, dataset, config)
    world_model.to(accelerator.device)
    world_model.eval()

    encode = partial(encode_batch, world_model, device=accelerator.device, chunk=config.model.encode_chunk)
    split: Split = "validation"
    try:
        dataset.windows(split)
    except InputError:
        split = "train"
    with accelerator.autocast(), torch.no_grad():
        sample = ClipSample(split, clips, batch_size=config.validation.batch_size)
        return probe_variants(world_model, encode, dataset, sample, progress)
