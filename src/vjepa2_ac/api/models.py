"""Models by name: a base, an adapter on it, or the model of a trained run; on its device, ready to predict."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from pydantic import ValidationError

from vjepa2_ac import places
from vjepa2_ac.config import EncoderConfig, ModelConfig, ModelSizes
from vjepa2_ac.distributed.device import has_bf16, no_cuda, require_type_of_weights
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.adapter_folder import ADAPTER_FILE
from vjepa2_ac.model.adapter.lora import load_trained
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.runs import loading
from vjepa2_ac.runs.folder import is_run
from vjepa2_ac.storage.structured import message_of

Device = str | torch.device
WeightType = Literal["auto", "float32", "bfloat16"]

_AUTO = "auto"
_TYPES = ("float32", "bfloat16")


def load_model(
    name: str | Path,
    *,
    adapter: str | Path | None = None,
    device: Device = _AUTO,
    dtype: WeightType = "auto",
    sizes: ModelSizes | None = None,
    encoder: str | Path | EncoderConfig | None = None,
) -> WorldModel:
    """Load a world model, in eval mode; no weight requires a gradient.

    Args:
        name: What `model.base` takes: the official `.pt`, a folder from `vjepa2-ac export`, or `builtin:sim-tiny`.
        adapter: A folder from `vjepa2-ac export --to hub`, whose adapter is put on this model.
        device: Such as cpu or cuda:1; auto: CUDA where there is one.
        dtype: Type of the weights; auto: bfloat16 on a GPU that computes in it, else float32. Trained weights of an
            adapter are float32, and so are latents.
        sizes: Of an official `.pt`, whose file has no image size and heads; None: the released ones.
        encoder: Of a file that holds a predictor alone: what `model.encoder` or its path takes; None: the model's own.

    Raises:
        InputError: There is no such model, adapter or device, it cannot be read, or the adapter is of another base.

    Example:
        >>> model = load_model("builtin:sim-tiny")
        >>> model.image_size, model.num_tokens, model.latent_dim  # pixels, tokens of a frame, width of a token
        (96, 36, 128)
    """
    place = _device(device)
    try:
        base = places.of_a_model(str(name))
    except ValueError as error:
        needed = "a model: a .pt, a folder or builtin:sim-tiny"
        raise InputError(where="load_model", found=f"{str(name)!r} {error}", needed=needed) from None
    config = _config(base, dtype, sizes or ModelSizes(), place)
    if encoder is not None:
        config = config.model_copy(update={"encoder": _encoder(encoder)})
    model = load_base(config, seed=0)
    if adapter is not None:
        load_trained(model, adapter, trainable=False)
    return model.to(place).eval()


def load_run(folder: str | Path, checkpoint: str | int = "selected", *, device: Device = _AUTO) -> loading.TrainedRun:
    """Load the model of a trained run, in eval mode: its base with the adapter of a complete checkpoint.

    Args:
        folder: The run, as `train` returns it.
        checkpoint: selected (the best by validation, else the newest), newest, best, or a number of optimizer steps.
        device: As of `load_model`. The type of the base's weights is the run's `model.dtype`.

    Returns:
        `world_model`, with the adapter beside its base; `config` of the run; `checkpoint`, the folder it is from.

    Raises:
        InputError: Not a run, no such checkpoint or device, or its base cannot be loaded.

    Example:
        >>> run = load_run("runs/droid-lora", "best")
        >>> controller = Controller.of_run(run)
    """
    place, folder = _device(device), Path(folder)
    if not is_run(str(folder)) and (folder / ADAPTER_FILE).is_file():
        found, fix = "an adapter without its run", "Name its base, too: load_model(BASE, adapter=FOLDER)"
        raise InputError(where=str(folder), found=found, needed="the folder of a run", fix=fix)
    run = loading.load_run(folder, str(checkpoint))
    run.world_model.to(place).eval()
    return run


def _config(name: str, dtype: str, sizes: ModelSizes, device: torch.device) -> ModelConfig:
    if dtype == _AUTO:
        dtype = "bfloat16" if device.type == "cuda" and has_bf16() else "float32"
    if dtype not in _TYPES:
        raise InputError(where="load_model", found=f"dtype {dtype!r}", needed=", ".join([_AUTO, *_TYPES]))
    config = ModelConfig.model_validate({"base": name, "dtype": dtype, "sizes": sizes})
    require_type_of_weights(config, device)
    return config


def _encoder(encoder: str | Path | EncoderConfig) -> EncoderConfig:
    if isinstance(encoder, EncoderConfig):
        return encoder
    try:
        return EncoderConfig(path=str(encoder))
    except ValidationError as error:
        found, needed = (
            f"encoder {str(encoder)!r}: {message_of(error.errors()[0])}",
            "a file, a folder or hf://owner/name",
        )
        raise InputError(where="load_model", found=found, needed=needed) from None


def _device(device: Device) -> torch.device:
    has_cuda = torch.cuda.is_available()
    if device == _AUTO:
        return torch.device("cuda" if has_cuda else "cpu")
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError):
        raise InputError(where="device", found=repr(device), needed="auto, cpu, cuda, or one such as cuda:1") from None
    if found.type == "cuda" and not has_cuda:
        raise no_cuda(where="device", asked=str(device), instead="Take device='cpu'")
    return found
