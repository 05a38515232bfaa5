"""Axis calibration from a config: infer the moves of recorded pairs of frames, fit the model's axes, write them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from vjepa2_ac import __version__
from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.distributed.processes import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch, require_same_encoder, require_widths
from vjepa2_ac.evaluation.action_use.inferred_moves import infer_axes
from vjepa2_ac.evaluation.action_use.one_step import RolloutStart, start_of
from vjepa2_ac.evaluation.axis_fit import AxisFit
from vjepa2_ac.evaluation.stride_calibration.from_config import load_named
from vjepa2_ac.model.adapter.merging import merge_adapter
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.axes.axes_file import FORMAT, require_axes_in
from vjepa2_ac.planning.model_setup import Fingerprints
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.storage.structured import json_text, utc_now


@dataclass(frozen=True)
class AxisCalibration:
    """The axes of a model on some data."""

    fit: AxisFit
    subject: str  # the model, as given
    known: Fingerprints
    data: DataConfig
    split: Split

    def verdict(self) -> str:
        """Return as text where the model's axes lie, and whether they can be planned by."""
        return self.fit.words()

    def as_dict(self) -> dict[str, Any]:
        """Return the content of axes.json, by the schema in docs/planning.md."""
        return {
            "format": FORMAT,
            "verdict": self.verdict(),
            **self.fit.as_dict(),
            "model": {"subject": self.subject, **self.known._asdict()},
            "data": {
                "path": self.data.path,
                "cameras": list(self.data.cameras),
                "stride": self.data.model_stride,
                "split": self.split,
            },
            "version": __version__,
            "time": utc_now(),
        }

    def write(self, path: Path) -> Path:
        """Write axes.json; the file is written atomically."""
        write_atomically(path, json_text(self.as_dict()))
        return path


def calibrate_axes(
    config: Config, model: str, *, pairs: int, split: Split = "validation", reporter: Reporter = SILENT
) -> AxisCalibration:
    """Fit the axes of a model to recorded pairs of frames, one model step apart.

    The model infers moves as it plans: with trained weights merged, in the base's type, without autocast.

    Args:
        config: The data, the device and the precision.
        model: What `model.base` takes, or the folder of a run.
        pairs: At most, spread over the episodes.
        split: Of the data.
        reporter: Shows the progress of indexing, encoding and inferring.

    Raises:
        InputError: The data or the model cannot be used; or the states have no axes.
    """
    require_axes_in(config.data)
    accelerator = make_accelerator(config)
    settings = config.data.model_copy(update={"frames": 2, "short_episodes": "skip"})
    dataset = open_dataset(settings, progress=reporter.task(INDEXING))
    world_model = load_named(config, model)
    require_widths(world_model, dataset.widths, where=model)
    require_same_encoder(world_model, dataset, config)
    known = Fingerprints.of(world_model)
    if world_model.adaptation is not None:
        merge_adapter(world_model)
    world_model.to(accelerator.device).eval()
    starts = _starts(world_model, dataset, config, split, pairs)
    fit = infer_axes(
        world_model, starts, at_once=config.planning.energy.samples_at_once, progress=reporter.task("inferring moves")
    )
    return AxisCalibration(fit, model, known, config.data, split)


def _starts(model: WorldModel, dataset: Dataset, config: Config, split: Split, pairs: int) -> list[RolloutStart]:
    device, size = model.device, config.validation.batch_size
    batches = validation_batches(dataset, split, clips=pairs, batch_size=size)
    found: list[RolloutStart] = []
    with torch.no_grad():
        for batch in batches:
            latents = encode_batch(model, batch, device=device, chunk=config.model.encode_chunk)
            found += [start_of(latents, row, 0, len(found) + row) for row in range(len(batch.starts))]
    return found
