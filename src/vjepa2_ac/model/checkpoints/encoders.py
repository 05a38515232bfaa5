"""The encoder that `model.encoder` names: its sizes, where it came from, and its weights by our names.

Meta's `.pt` of either family, a transformers folder, the same from the Hub, a folder of this project and Meta's own
V-JEPA 2-AC file all end in one record, `FoundEncoder`; a network is filled from it alone. Every tensor is matched or
refused.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field
from torch import Tensor

from vjepa2_ac.config import EncoderSizes, ModelSizes
from vjepa2_ac.config.model import Depth, EncoderConfig, Family, FramePath, Heads, Ratio, Width
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.base_model import (
    CONFIG,
    ENCODER_NEEDED,
    FORMAT,
    HEADS,
    EncoderOrigin,
    check_sizes,
    find_encoder_path,
    read_sizes,
)
from vjepa2_ac.model.checkpoints.meta_file import ENCODER_KEYS, FIX, MetaFile, Rename, depth_of, official_name, part_of
from vjepa2_ac.model.checkpoints.published import published_as
from vjepa2_ac.model.network.blocks import mlp_ratio_of
from vjepa2_ac.model.network.pretrained_folder import ENCODER, open_safetensors, read_encoder_origin
from vjepa2_ac.storage.structured import read_json_object, record_of
from vjepa2_ac.storage.transfer import from_hub

logger = logging.getLogger(__name__)

_ON_THE_HUB = [CONFIG, "*.safetensors"]
_PREFIXES = ("vjepa2.encoder.", "encoder.")  # in transformers: of a classification model, of a plain one
_BLOCK = re.compile(r"(?:^|\.)(?:blocks|layer)\.(\d+)\.")  # in the names of Meta's files, of transformers, and of ours
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
    is_cut: bool = False  # after a block before the last: the weights of the last norm are not its own

    def up_to(self, layer: int) -> FoundEncoder:
        """Return the same encoder without the blocks after a layer.

        Raises:
            InputError: It has fewer blocks.
        """
        depth = self.sizes.depth
        if layer > depth:
            needed = f"at most {depth}, its number of blocks"
            raise InputError(where="model.encoder.layer", found=f"{layer}, of {self.where}", needed=needed)
        if layer == depth:
            return self

        def weights() -> dict[str, Tensor]:
            blocks = {name: (tensor, _BLOCK.search(name)) for name, tensor in self.weights().items()}
            return {name: tensor for name, (tensor, block) in blocks.items() if not block or int(block[1]) < layer}

        return replace(self, sizes=self.sizes.model_copy(update={"depth": layer}), weights=weights, is_cut=True)


def find_encoder(config: EncoderConfig) -> FoundEncoder:
    """Return the encoder that a config names; of the Hub it is downloaded first. No weight is read.

    Raises:
        InputError: There is none, it is of another kind or damaged, or the config contradicts it.
        UnreachableError: The Hub cannot be reached, and the repository is not in its cache.
    """
    path = find_encoder_path(config.path)
    if path is not None and not path.is_dir():
        found = encoder_in_file(MetaFile.open(path), config.key, config.frame, config.heads)
    else:
        folder = path or from_hub(config.path, _ON_THE_HUB, where=f"model.encoder.path: {config.path}")
        found = _in_folder(folder, config, name=config.path if path is None else path.name)
    if config.heads not in {None, found.sizes.heads}:
        said = f"{found.sizes.heads} attention heads, and model.encoder.heads says {config.heads}"
        raise InputError(where=found.where, found=said, fix="Leave out model.encoder.heads")
    return found if config.layer is None else found.up_to(config.layer)


def sizes_with(found: FoundEncoder, given: ModelSizes) -> ModelSizes:
    """Return the sizes of a model with this encoder, at the given image size.

    Raises:
        InputError: The given sizes contradict those of the file, or do not fit its patches, frame path or heads.
    """
    own = {"encoder": found.sizes.model_dump(), "patch_size": found.patch_size}
    sizes = record_of(ModelSizes, given.model_dump() | own, where=found.where, needed=ENCODER_NEEDED)
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
    encoder = known.encoder.sizes(known.family, config.frame).model_dump()
    encoder["depth"] = min(encoder["depth"], config.layer or encoder["depth"])
    return record_of(ModelSizes, given.model_dump() | {"encoder": encoder}, where=f"model.encoder: {config.path}")


def encoder_in_file(file: MetaFile, key: str | None, frame: FramePath, heads: int | None) -> FoundEncoder:
    """Return the encoder in one of Meta's files.

    Args:
        file: The file.
        key: Which encoder; None: the first that is there.
        frame: How a frame enters.
        heads: Its attention heads, where it is not as wide as a published encoder.

    Raises:
        InputError: There is no such key, what is there is no encoder, or nobody knows the heads.
    """
    there = [name for name in ENCODER_KEYS if name in file.parts]
    if key is None and there:
        key = there[0]
        logger.info("%s: the encoder under %s (there are: %s)", file.path, key, ", ".join(there))
    if key not in there:
        fix = f"Set model.encoder.key to one of {', '.join(there)}, or leave it out" if there else FIX
        raise file.lacks(key or "encoder", fix)
    tensors = file.tensors(key)
    family: Family = "v2.1" if any(name.startswith(_ONLY_2_1) for name in tensors) else "v2"
    try:
        width, *_, patch_size = tensors["patch_embed.proj.weight"].shape
        hidden, depth = tensors["blocks.0.mlp.fc1.weight"].shape[0], depth_of(tensors, "blocks")
    except (KeyError, ValueError) as missing:
        raise file.lacks(f"tensor {missing}", part=key) from None
    heads = HEADS.get(width, heads)
    if heads is None:
        said = f"an encoder of width {width}, which is none of the published ones: the tensors do not show its heads"
        fix = "Set model.encoder.heads to those it was trained with: other ones give other latents without an error"
        raise InputError(where=str(file.path), found=said, fix=fix)
    known = published_as(file.path.name)
    return FoundEncoder(
        where=f"{file.path}: {key}",
        sizes=EncoderSizes(
            width=width,
            depth=depth,
            heads=heads,
            mlp_ratio=mlp_ratio_of(width, hidden, EncoderSizes().mlp_ratio),
            family=family,
            frame=frame,
        ),
        patch_size=patch_size,
        image_size=known.image_size if known else None,
        origin=EncoderOrigin(file.path.name, key, known.licence if known else ""),
        weights=lambda: tensors,
        rename=partial(official_name, part=part_of(family)),
    )


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
    """Return the encoder in a folder of transformers or of this project; `name` is what the user called it."""
    card = read_json_object(folder / CONFIG, needed=ENCODER_NEEDED, fix=FIX)
    if config.key is not None:
        found = f"{name}, a folder, which holds one encoder"
        raise InputError(where=f"model.encoder.key: {config.key}", found=found, fix="Leave the key out")
    if card.get("format") != FORMAT:
        return _of_transformers(folder, card, config.frame, name)
    model = read_sizes(folder)
    return FoundEncoder(
        where=str(folder / ENCODER),
        sizes=model.encoder.model_copy(update={"frame": config.frame}),
        patch_size=model.patch_size,
        image_size=model.image_size,
        origin=read_encoder_origin(folder) or EncoderOrigin(name, heads_are_told=False),  # so it stays the same encoder
        weights=partial(_mapped, [folder / ENCODER]),
        rename=lambda ours: (ours, None),
    )


def _of_transformers(folder: Path, card: Mapping[str, Any], frame: FramePath, name: str) -> FoundEncoder:
    """Return the encoder of a plain or a classification model; its masked predictor and its head are left alone."""
    told = record_of(_Told, card, where=str(folder / CONFIG), needed=ENCODER_NEEDED, fix=FIX)
    tensors = _mapped(sorted(folder.glob("*.safetensors")))
    prefix = next((one for one in _PREFIXES if any(tensor.startswith(one) for tensor in tensors)), None)
    if prefix is None:
        found = "no tensor of an encoder in *.safetensors"
        raise InputError(where=str(folder), found=found, needed=ENCODER_NEEDED, fix=FIX)
    return FoundEncoder(
        where=str(folder),
        sizes=EncoderSizes(
            width=told.hidden_size,
            depth=told.num_hidden_layers,
            heads=told.num_attention_heads,
            mlp_ratio=told.mlp_ratio,
            frame=frame,
        ),
        patch_size=told.patch_size,
        image_size=told.crop_size,
        origin=EncoderOrigin(name),
        weights=lambda: {one: value for one, value in tensors.items() if one.startswith(prefix)},
        rename=lambda ours: (prefix + ours.removeprefix("vit."), None),
    )


def _mapped(files: list[Path]) -> dict[str, Tensor]:
    """Return the tensors of safetensors files, mapped: their values are read when they are used."""
    found: dict[str, Tensor] = {}
    for path in files:
        with open_safetensors(path, needed=ENCODER_NEEDED) as file:
            found |= {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # no iterator
    return found
