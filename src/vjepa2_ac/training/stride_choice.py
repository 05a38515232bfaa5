"""Stride choice of a run with `data.stride: auto`: the stride that its model chose before the first step."""

from __future__ import annotations

from dataclasses import replace

from accelerate import Accelerator

from vjepa2_ac.calibration.variants import Calibration, calibrate_model
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.measure import ClipSample
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import Reporter


def choose_stride(
    world_model: WorldModel, dataset: Dataset, config: Config, accelerator: Accelerator, reporter: Reporter
) -> Calibration:
    """Let the model of a run, before training, choose among the candidates at which the run's clips fit into episodes.

    Raises:
        InputError: There is none, or as `calibrate_model`.
    """
    reporter.note("data.stride is auto: measuring the model at each candidate stride")
    fitting, errors = [], []
    for stride in dataset.config.strides_to_try(dataset.control_rate_hz):
        view = dataset.with_stride(stride)
        try:
            view.windows("train"), view.windows("validation")
        except InputError as error:
            errors.append(error)
            reporter.note(f"  stride {stride}: not possible: no clip of {dataset.config.frames} frames fits")
        else:
            fitting.append(stride)
    if not fitting:
        raise errors[0]
    candidates = replace(dataset, config=dataset.config.model_copy(update={"stride_candidates": tuple(fitting)}))
    calibration = calibrate_model(
        world_model, candidates, config, accelerator, ClipSample(clips=config.validation.clips)
    )
    for row in calibration.rows(""):
        reporter.note(f"  {row.name}: error/persistence {row}")
    reporter.note(calibration.verdict())
    return calibration
