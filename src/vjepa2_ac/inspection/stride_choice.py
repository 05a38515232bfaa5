"""The choice of the stride of a run by its model, where `data.stride` is auto: a hook of training."""

from __future__ import annotations

from dataclasses import replace

from accelerate import Accelerator

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.distributed import broadcast_object
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.measure import ClipSample
from vjepa2_ac.inspection.variants import Calibration, calibrate_model, require_learned
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import Reporter


class StrideChoice:
    """Chooses, before training, among the candidate strides at which the run's clips fit into episodes.

    Args:
        config: The run.

    Raises:
        InputError: The run has no base that could choose.
    """

    def __init__(self, config: Config) -> None:
        require_learned(config.model)
        self._config = config

    def __call__(
        self, world_model: WorldModel, dataset: Dataset, accelerator: Accelerator, reporter: Reporter
    ) -> Calibration:
        """Return the calibration of the base, the same in all processes.

        Raises:
            InputError: No candidate fits, or as `calibrate_model`.
        """
        config = self._config
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
        sample = ClipSample(clips=config.validation.clips)
        calibration = calibrate_model(world_model, candidates, config, accelerator, sample)
        for one in calibration.results.values():
            reporter.note(f"  {one.name}: error/persistence {one.ratio:.3f}")
        reporter.note(calibration.verdict())
        return broadcast_object(accelerator, calibration)
