"""Stride calibration from a config, outside of a run."""

from __future__ import annotations

from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.distributed.processes import make_accelerator
from vjepa2_ac.encoding.batch import require_same_encoder, require_widths
from vjepa2_ac.evaluation.measure import ClipSample
from vjepa2_ac.evaluation.stride_calibration.measure import Calibration, calibrate_model, require_learned
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
from vjepa2_ac.runs.folder import is_run
from vjepa2_ac.runs.loading import load_run


def calibrate_config(
    config: Config,
    sample: ClipSample,
    *,
    model: str | None = None,
    reporter: Reporter = SILENT,
) -> Calibration:
    """Calibrate the model of a config, or another one, on the config's data.

    A latent cache has the frames of one stride's clips only, so frames are encoded on the fly.

    Args:
        config: The data, the model, the device and the precision.
        sample: The clips at each stride.
        model: Another model: what `model.base` takes, or the folder of a run.
        reporter: Shows the progress of indexing and measuring.

    Raises:
        InputError: The data or the model cannot be used.
    """
    accelerator = make_accelerator(config)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    world_model = load_named(config, model)
    require_widths(world_model, dataset.widths, where=model or f"model.base: {config.model.base}")
    require_same_encoder(world_model, dataset, config)
    world_model.to(accelerator.device)
    return calibrate_model(world_model, dataset, config, accelerator, sample, reporter.task("measuring clips"))


def load_named(config: Config, model: str | None) -> WorldModel:
    """Return the model of a run's folder, or of what `model.base` takes; None: the config's own.

    Raises:
        InputError: There is none, it cannot be read, or it is randomly initialized.
    """
    if model is not None and is_run(model):
        return load_run(Path(model)).world_model
    chosen = config.model if model is None else config.model.with_base(model)
    require_learned(chosen)
    return load_base(chosen, seed=config.seed)
