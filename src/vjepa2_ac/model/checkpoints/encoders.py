"""The encoder that `model.encoder` names: its sizes, where it came from, and its weights by our names.

Meta's `.pt` of either family, a transformers folder, the same from the Hub, a folder of this project and Meta's own
V-JEPA 2-AC file all end in one record, `FoundEncoder`; a network is filled from it alone. Every tensor is matched or
refused.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, Field, ValidationError
from torch import Tensor

from vjepa2_ac.config import EncoderSizes, ModelSizes
from vjepa2_ac.config.model import Depth, EncoderConfig, Family, Heads, Ratio, Width
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.base_model import CONFIG, FORMAT, check_sizes, find_encoder_path, read_model_config, read_sizes
from vjepa2_ac.model.checkpoints.meta_file import (
    ENCODER_KEYS,
    Rename,
    depth_of,
    fill,
    official_name,
    open_file,
    part_of,
    tensors_of,
)
from vjepa2_ac.model.checkpoints.published import published_as
from vjepa2_ac.model.network.blocks import mlp_ratio_of
from vjepa2_ac.model.network.encoder import Encoder
from vjepa2_ac.model.network.encoder_origin import HEADS, EncoderOrigin
from vjepa2_ac.model.network.pretrained_folder import ENCODER, open_safetensors, read_encoder_origin
from vjepa2_ac.storage.hub import from_hub
from vjepa2_ac.storage.structured import message_of, read_json_object

logger = logging.getLogger(__name__)

WEIGHTS, INDEX = "model.safetensors", "model.safetensors.index.json"

_NEEDED = "an encoder of V-JEPA 2 or 2.1: Meta's .pt, a transformers folder, or a model of this project"
_FIX = "`vjepa2-ac download --list` shows those that are published; the Hub has facebook/vjepa2-vitl-fpc64-256"
_ON_THE_HUB = [CONFIG, "*.safetensors", "*.safetensors.index.json"]
_PREFIXES = ("vjepa2.encoder.", "encoder.")  # in transformers: of a classification model, of a plain one
_ONLY_2_1 = ("norms_block.", "video_mod_embed", "img_mod_embed", "patch_embed_img.")


@dataclass(frozen=True, eq=False)
class FoundEncoder:
    """An encoder whose values are not read yet."""

    where: str  # for messages
    sizes: EncoderSizes
    patch_size: int
    image_size: int | None  # that it was trained at last, if somebody says so
    origin: EncoderOrigin
    weights: Callable[[], Mapping[str, Tensor]]  # mapped, by the file's names
    rename: Rename

    def fill(self, network: Encoder, dtype: torch.dtype) -> None:
        """Load the weights into an encoder on the meta device.

        Raises:
            InputError: A tensor is missing, unknown or of another shape, or a weight is not finite.
        """
        fill(network, self.weights(), self.rename, dtype, where=self.where, fix=f"Get the original file. {_FIX}")


def find_encoder(config: EncoderConfig) -> FoundEncoder:
    """Return the encoder that a config names; of the Hub it is downloaded first. No weight is read.

    Raises:
        InputError: There is none, it is of another kind or damaged, or the config contradicts it.
        UnreachableError: The Hub cannot be reached, and the repository is not in its cache.
    """
    path = find_encoder_path(config.path)
    if path is None:
        folder = from_hub(config.path, _ON_THE_HUB, where=f"model.encoder.path: {config.path}")
        return _in_folder(folder, config, name=config.path)
    if path.is_dir():
        return _in_folder(path, config, name=path.name)
    return encoder_in_file(path, open_file(path, needed=_NEEDED, fix=_FIX), config)


def sizes_with(found: FoundEncoder, given: ModelSizes) -> ModelSizes:
    """Return the sizes of a model with this encoder, at the given image size.

    Raises:
        InputError: The given sizes contradict those of the file, or do not fit its patches, frame path or heads.
    """
    own = {"encoder": found.sizes.model_dump(), "patch_size": found.patch_size}
    try:
        sizes = ModelSizes.model_validate(given.model_dump() | own)
    except ValidationError as error:
        raise InputError(where=found.where, found=message_of(error.errors()[0]), needed=_NEEDED) from None
    check_sizes(sizes, given, where=found.where)
    if found.image_size not in {None, given.image_size}:
        logger.warning(
            "%s was trained at %d px, and frames are encoded at %d px (image_size): other positions than it knows",
            found.origin, found.image_size, given.image_size,
        )  # fmt: skip
    return sizes


def expected_sizes(config: EncoderConfig, given: ModelSizes) -> ModelSizes:
    """Return the sizes of a model with this encoder; of a published file that is not here yet, from its name.

    Raises:
        InputError: As `find_encoder`.
    """
    known = published_as(Path(config.path).name)
    if known is None or Path(config.path).exists():
        return sizes_with(find_encoder(config), given)
    encoder = known.encoder.sizes(known.family, config.frame)
    try:
        return ModelSizes.model_validate(given.model_dump() | {"encoder": encoder.model_dump()})
    except ValidationError as error:
        raise InputError(where=f"model.encoder: {config.path}", found=message_of(error.errors()[0])) from None


def encoder_in_file(path: Path, whole: Mapping[str, Any], config: EncoderConfig) -> FoundEncoder:
    """Return the encoder in one of Meta's files.

    Args:
        path: The file.
        whole: What is in it: its parts by their keys.
        config: Which key, frame path and heads.

    Raises:
        InputError: There is no such key, what is there is no encoder, or the heads are unknown or contradict the width.
    """
    key = _key_of(path, whole, config.key)
    where = f"{path}: {key}"
    tensors = tensors_of(whole, key, where=where, needed=_NEEDED, fix=_FIX)
    family: Family = "v2.1" if any(name.startswith(_ONLY_2_1) for name in tensors) else "v2"
    try:
        width, *_, patch_size = tensors["patch_embed.proj.weight"].shape
        hidden, depth = tensors["blocks.0.mlp.fc1.weight"].shape[0], depth_of(tensors, "blocks")
    except (KeyError, ValueError) as missing:
        raise InputError(where=where, found=f"no tensor {missing} in it", needed=_NEEDED, fix=_FIX) from None
    known = published_as(path.name)
    return FoundEncoder(
        where=where,
        sizes=EncoderSizes(
            width=width,
            depth=depth,
            heads=_heads_of(width, config.heads, where=where),
            mlp_ratio=mlp_ratio_of(width, hidden, EncoderSizes().mlp_ratio),
            family=family,
            frame=config.frame,
        ),
        patch_size=patch_size,
        image_size=None if known is None else known.image_size,
        origin=EncoderOrigin(path.name, key, "" if known is None else known.licence),
        weights=lambda: tensors,
        rename=partial(official_name, part=part_of(family)),
    )


def _key_of(path: Path, whole: Mapping[str, Any], key: str | None) -> str:
    there = [name for name in ENCODER_KEYS if name in whole]
    if key is None and there:
        others = f" (also there: {', '.join(there[1:])})" if len(there) > 1 else ""
        logger.info("%s: the encoder under %s%s", path, there[0], others)
        return there[0]
    if key is not None and key in there:
        return key
    found = f"no {key or 'encoder'} (keys: {', '.join(list(whole)[:8])})"
    fix = f"Set model.encoder.key to one of {', '.join(there)}, or leave it out" if there else _FIX
    raise InputError(where=str(path), found=found, needed=_NEEDED, fix=fix)


def _heads_of(width: int, heads: int | None, *, where: str) -> int:
    """Return the attention heads of an encoder, which its tensors do not show.

    Args:
        width: Of the encoder.
        heads: As the user or the file says; None: nobody says.
        where: The file.

    Raises:
        InputError: Nobody knows them; or they are not those of the published encoder of this width.
    """
    known = HEADS.get(width, heads)
    if known is None:
        raise InputError(
            where=where,
            found=f"an encoder of width {width}, whose attention heads the tensors do not show",
            needed=f"a published width ({', '.join(map(str, HEADS))}), or the heads",
            fix="Set model.encoder.heads to those it was trained with: other ones give other latents without an error",
        )
    if heads not in {None, known}:
        raise InputError(
            where=where,
            found=f"{heads} attention heads for an encoder of width {width}",
            needed=f"{known}, as every published encoder of this width has",
            fix="Leave out model.encoder.heads (of an AC file model.sizes.encoder.heads)",
        )
    return known


class _Told(BaseModel):
    """What the config.json of a V-JEPA 2 model of transformers says; only what this project computes is taken."""

    model_type: Literal["vjepa2"]
    hidden_size: Width
    num_hidden_layers: Depth
    num_attention_heads: Heads
    mlp_ratio: Ratio
    crop_size: Annotated[int, Field(ge=1, le=8_192)] = 256
    patch_size: Annotated[int, Field(ge=1, le=1_024)] = 16
    tubelet_size: Literal[2] = 2
    in_chans: Literal[3] = 3
    qkv_bias: Literal[True] = True
    hidden_act: Literal["gelu"] = "gelu"
    layer_norm_eps: Annotated[float, Field(ge=0.99e-6, le=1.01e-6)] = 1e-6


def _in_folder(folder: Path, config: EncoderConfig, *, name: str) -> FoundEncoder:
    """Return the encoder in a folder of transformers or of this project.

    Args:
        folder: The folder.
        config: Frame path and heads.
        name: What the user called it.

    Raises:
        InputError: It is no such folder, is incomplete, or its config contradicts its tensors or the user's.
    """
    card = read_model_config(folder, needed=_NEEDED, fix=_FIX)
    if config.key is not None:
        raise InputError(
            where=f"model.encoder.key: {config.key}",
            found=f"{name}, a folder, which holds one encoder",
            needed="no key: keys are of Meta's .pt files",
            fix="Leave it out",
        )
    is_own = card.get("format") == FORMAT
    found = _of_this_project(folder, config, name) if is_own else _of_transformers(folder, card, config, name)
    if config.heads not in {None, found.sizes.heads}:
        raise InputError(
            where=str(folder / CONFIG),
            found=f"{found.sizes.heads} attention heads",
            needed=f"{config.heads}, as model.encoder.heads says",
            fix="Leave out model.encoder.heads: the folder tells",
        )
    return found


def _of_this_project(folder: Path, config: EncoderConfig, name: str) -> FoundEncoder:
    model = read_sizes(folder)
    return FoundEncoder(
        where=str(folder / ENCODER),
        sizes=model.encoder.model_copy(update={"frame": config.frame}),
        patch_size=model.patch_size,
        image_size=model.image_size,
        origin=read_encoder_origin(folder) or EncoderOrigin(name, heads_are_told=False),  # so it stays the same encoder
        weights=lambda: _mapped([folder / ENCODER]),
        rename=lambda ours: (ours, None),
    )


def _of_transformers(folder: Path, card: Mapping[str, Any], config: EncoderConfig, name: str) -> FoundEncoder:
    """Return the encoder of a plain or a classification model; its masked predictor and its head are left alone."""
    try:
        told = _Told.model_validate(dict(card))
    except ValidationError as error:
        said = "; ".join(f"{'.'.join(map(str, one['loc']))}: {message_of(one)}" for one in error.errors()[:4])
        raise InputError(where=str(folder / CONFIG), found=said, needed=_NEEDED, fix=_FIX) from None
    tensors = _mapped(_weight_files(folder))
    prefix = next((one for one in _PREFIXES if any(tensor.startswith(one) for tensor in tensors)), None)
    if prefix is None:
        raise InputError(where=str(folder), found="no tensor of an encoder", needed=_NEEDED, fix=_FIX)
    return FoundEncoder(
        where=str(folder),
        sizes=EncoderSizes(
            width=told.hidden_size,
            depth=told.num_hidden_layers,
            heads=_heads_of(told.hidden_size, told.num_attention_heads, where=str(folder / CONFIG)),
            mlp_ratio=told.mlp_ratio,
            frame=config.frame,
        ),
        patch_size=told.patch_size,
        image_size=told.crop_size,
        origin=EncoderOrigin(name),
        weights=lambda: {one: value for one, value in tensors.items() if one.startswith(prefix)},
        rename=lambda ours: (prefix + ours.removeprefix("vit."), None),
    )


def _weight_files(folder: Path) -> list[Path]:
    """Return the files with weights, all of them in the folder."""
    if not (folder / INDEX).is_file():
        return [folder / WEIGHTS]
    listed = read_json_object(folder / INDEX, needed=_NEEDED, fix=_FIX).get("weight_map")
    names = dict.fromkeys(map(str, listed.values())) if isinstance(listed, dict) else {}
    if not names or not all(Path(one).name == one for one in names):
        raise InputError(where=str(folder / INDEX), found="no list of files beside it", needed=_NEEDED, fix=_FIX)
    return [folder / one for one in names]


def _mapped(files: list[Path]) -> dict[str, Tensor]:
    """Return the tensors of safetensors files, mapped: their values are read when they are used."""
    found: dict[str, Tensor] = {}
    for path in files:
        with open_safetensors(path, needed=_NEEDED) as file:
            found |= {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # no iterator
    return found
