"""Data by its folder: open it, read clips of it, and encode clips or frames as a model sees them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, overload

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.loading import config_as_dict, config_from
from vjepa2_ac.data import dataset as datasets
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.data.transforms import Crop
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.encoding.batch import encode_batch, encode_frames
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.world_model import WorldModel

_REST = {"run_dir": "none", "model": {"base": "builtin:sim-tiny"}, "training": {"rollout_steps": 1}}  # of a config


def open_dataset(data: str | Path | Config, **knobs: Any) -> Dataset:
    """Open a data set, and select the episodes and steps that clips come from.

    Args:
        data: A folder or URL, of DROID's RLDS form unless `source` says another; or a config, whose `data:` is used.
        knobs: Knobs of `data:` in a config, such as `frames` and `stride`; `vjepa2-ac config schema` lists them.

    Returns:
        The data set. `len(dataset.table)` episodes, `dataset.control_rate_hz` control steps a second,
        `len(dataset.windows("train"))` clips; `dataset.source.read(0)` is an episode with its states, steps x 7.

    Raises:
        InputError: There is no such data set, it is damaged, a knob is wrong, or no episode is left.

    Example:
        >>> dataset = open_dataset("demo/data", frames=4, stride=4)  # clips of 4 frames, 4 control steps apart
        >>> dataset = open_dataset(load_config("configs/lerobot.yaml"))
    """
    if isinstance(data, Config):
        values = config_as_dict(data)
        config = config_from(values | {"data": values["data"] | knobs}, where="open_dataset") if knobs else data
        return datasets.open_dataset(config.data)
    if str(data).endswith((".yaml", ".yml")):
        fix = "Read it first: open_dataset(load_config(PATH))"
        raise InputError(where=str(data), found="a config", needed="the folder of a data set", fix=fix)
    return datasets.open_dataset(config_from(_REST | {"data": {"path": str(data)} | knobs}, where="open_dataset").data)


def read_clips(dataset: Dataset, split: Split = "train", *, clips: int = 16, batch_size: int = 8) -> Iterator[Batch]:
    """Yield a fixed set of clips, spread evenly over a split, in batches; the same at each call.

    Args:
        dataset: The data set.
        split: train, validation or test: whole episodes, by a hash of their names and `validation_share`, `test_share`.
        clips: How many, at most.
        batch_size: Clips of a batch; the last one may have fewer.

    Yields:
        Batches of `frames` (clips x time x height x width x 3, uint8, RGB, cropped; None of a latent cache), `states`
        (clips x time x 7: metres, radians, closedness), `actions` (clips x time-1 x 7: the changes), `episode_ids` and
        `starts` (control steps). Axes, units and coordinate frames: `vjepa2_ac.episode`.

    Raises:
        InputError: The split has no clips, `data.stride` is auto, or a clip cannot be read.

    Example:
        >>> batch = next(read_clips(dataset, clips=8))
        >>> tuple(batch.frames.shape)
        (8, 4, 180, 243, 3)
    """
    if split not in get_args(Split):
        raise InputError(where="read_clips", found=f"split {split!r}", needed=", ".join(get_args(Split)))
    require_stride(dataset.config, to="read clips", fix="Give one: open_dataset(config, stride=4)")
    return validation_batches(dataset, split, clips=clips, batch_size=batch_size)


@overload
def encode(model: WorldModel, seen: Batch, *, chunk: int = 16) -> LatentBatch: ...


@overload
def encode(
    model: WorldModel, seen: UInt8[np.ndarray, "*axes height width 3"], *, crop: Crop = "released", chunk: int = 16
) -> Float[Tensor, "*axes tokens dim"]: ...


def encode(
    model: WorldModel, seen: Batch | np.ndarray, *, crop: Crop = "released", chunk: int = 16
) -> LatentBatch | Tensor:
    """Return the latents of clips or frames, on the model's device; each frame is encoded independently.

    Args:
        model: The model whose encoder is used.
        seen: A batch of `read_clips`; or RGB frames with any axes before height x width x 3, uint8.
        crop: Part of a frame that the model sees, as `data.crop`; a batch is already cropped.
        chunk: Frames that go through the encoder at once: bounds the memory.

    Returns:
        Of frames: latents, the axes before height x tokens x dim, float32, layer-normalised. Of a batch: a record of
        its `latents` (clips x time x tokens x dim), `states` and `actions`, all on the device.

    Raises:
        InputError: These are no such frames, or the model needs camera poses that the batch does not have.

    Example:
        >>> seen = encode(model, batch)
        >>> future = model.rollout(seen.latents[:, :1], seen.actions, seen.states[:, :-1])  # clips x time-1 x ...
        >>> encode(model, image).shape  # of one image: tokens x dim
        torch.Size([36, 128])
    """
    if isinstance(seen, Batch):
        return encode_batch(model, seen, device=model.device, chunk=chunk)
    frames = np.asarray(seen)
    if frames.dtype != np.uint8 or frames.ndim < 3 or frames.shape[-1] != 3 or 0 in frames.shape:
        found = f"{frames.dtype} of the shape {' x '.join(map(str, frames.shape))}"
        raise InputError(where="encode", found=found, needed="RGB frames: uint8, ... x height x width x 3")
    latents = encode_frames(model, frames.reshape(-1, *frames.shape[-3:]), crop, chunk=chunk)
    return latents.reshape(*frames.shape[:-3], *latents.shape[-2:])
