"""Which stride does a run take where `data.stride` is auto? The one that its model chose before the first step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from accelerate import Accelerator

from vjepa2_ac.config import Config, ModelConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.streams import copies_for
from vjepa2_ac.data.windows import Split
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.calibration import Calibration, calibrate
from vjepa2_ac.latents import encode_batch
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.run_folder import CONFIG, read_run_config


def with_settled_stride(config: Config) -> Config:
    """Return a config whose stride is a number where the run in its folder has chosen one: it is chosen once."""
    folder = Path(config.run_dir)
    if config.data.stride != "auto" or not (folder / CONFIG).is_file():
        return config
    stride = read_run_config(folder).data.stride
    return config if stride == "auto" else with_stride(config, stride)


def with_stride(config: Config, stride: int) -> Config:
    """Return the config with a stride that was found out."""
    return config.model_copy(update={"data": config.data.with_stride(stride)})


def choose_stride(
    world_model: WorldModel, dataset: Dataset, config: Config, accelerator: Accelerator, note: Callable[[str], None]
) -> Calibration:
    """Let the model of a run, before it is changed, choose among the candidates on the validation episodes.

    Raises:
        InputError: As `calibrate`.
    """
    note("data.stride is auto: measuring the model at each candidate stride")
    strides = strides_that_fit(dataset)
    for stride in set(dataset.config.strides_to_try(dataset.control_rate_hz)).difference(strides):
        note(f"  stride {stride}: not possible: no clip of {dataset.config.frames} frames fits")
    calibration = calibrate_model(
        world_model, dataset, config, accelerator, clips=config.validation.clips, strides=strides
    )
    for line in calibration.lines():
        note(line)
    return calibration


def strides_that_fit(dataset: Dataset) -> list[int]:
    """Return the candidates at which a run's own clips, which may be longer than a calibration's, fit into episodes.

    Raises:
        InputError: There is none.
    """
    fitting, first_error = [], None
    for stride in dataset.config.strides_to_try(dataset.control_rate_hz):
        view = dataset.with_stride(stride)
        try:
            view.windows("train")
            view.windows("validation")
        except InputError as error:
            first_error = first_error or error
        else:
            fitting.append(stride)
    if not fitting and first_error is not None:
        raise first_error
    return fitting


def require_learned(model: ModelConfig) -> None:
    """Refuse to ask a model that is drawn at random.

    Raises:
        InputError: It is.
    """
    if model.base is None:
        raise InputError(
            where="model.random",
            found="a model that has learned nothing",
            needed="one that can say which stride it was trained at",
            fix="Set data.stride to a number, or name another model with model.base (data calibrate: --model)",
        )


def calibrate_model(
    world_model: WorldModel,
    dataset: Dataset,
    config: Config,
    accelerator: Accelerator,
    *,
    clips: int,
    split: Split = "validation",
    strides: Sequence[int] = (),
    frames: int | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate a model that is on the accelerator's device, in the run's precision.

    Raises:
        InputError: As `calibrate`; or the data is a latent cache.
    """
    if dataset.config.source == "latents":
        raise InputError(
            where=f"data.path: {dataset.config.path}",
            found=f"latents that were encoded for clips at stride {dataset.config.stride}",
            needed="frames at every stride that is tried",
            fix="Calibrate on the data set itself, with data.cache: off",
        )
    world_model.eval()

    encode = partial(encode_batch, world_model, device=accelerator.device, chunk=config.model.encode_chunk)
    with accelerator.autocast(), torch.no_grad():
        return calibrate(
            world_model,
            encode,
            dataset,
            split=split,
            strides=strides,
            frames=frames,
            clips=clips,
            batch_size=config.validation.batch_size,
            copies=copies_for(accelerator.device),
            progress=progress,
        )
