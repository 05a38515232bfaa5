"""An encoder from a file: its sizes, where it came from, and its weights by our names, read in little memory.

Meta's `.pt` of either family, a transformers folder, a folder of this project and Meta's own V-JEPA 2-AC file all end
in one record, `FoundEncoder`; a network is filled from it alone. Every tensor is matched or refused.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from vjepa2_ac.config import EncoderSizes
from vjepa2_ac.config.model import EncoderConfig, Family, FramePath
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.meta_file import (
    ENCODER_KEYS,
    Shapes,
    depth_of,
    in_groups,
    official_shapes,
    open_file,
    part_of,
    shapes_of,
    take,
    tensors_of,
)
from vjepa2_ac.model.checkpoints.published import PUBLISHED, published_as
from vjepa2_ac.model.finite import require_finite
from vjepa2_ac.model.network.blocks import mlp_ratio_of
from vjepa2_ac.model.network.encoder import Encoder
from vjepa2_ac.model.network.encoder_origin import EncoderOrigin
from vjepa2_ac.model.network.pretrained_folder import check_tensors
from vjepa2_ac.model.network.published_sizes import HEADS

logger = logging.getLogger(__name__)

IGNORED = ("pos_embed",)  # may be in a file: a network with rotary positions does not use it

_NEEDED = "an encoder of V-JEPA 2 or 2.1: Meta's .pt, a transformers folder, or a model of this project"
_FIX = "`vjepa2-ac download --list` shows those that are published"
_ONLY_2_1 = ("norms_block.", "video_mod_embed", "img_mod_embed", "patch_embed_img.")
_LAST_NORM = "norms_block.3.weight"


@dataclass(frozen=True, eq=False)
class FoundEncoder:
    """An encoder whose values are not read yet."""

    where: str  # for messages
    sizes: EncoderSizes
    patch_size: int
    image_size: int | None  # that it was trained at last, if somebody says so
    origin: EncoderOrigin
    shapes: Shapes  # of the file's tensors, by the file's names
    needed: Callable[[Shapes], Shapes]  # our shapes -> those that the file must have
    read: Callable[[Sequence[str]], dict[str, Tensor]]  # by our names, in the file's type

    def fill(self, network: Encoder, dtype: torch.dtype) -> None:
        """Load the weights into an encoder on the meta device, a part of the file after the other.

        Raises:
            InputError: A tensor is missing, unknown or of another shape, or a weight is not finite.
        """
        ours = network.state_dict()
        used = {name: shape for name, shape in self.shapes.items() if name not in IGNORED}
        check_tensors(used, self.needed(shapes_of(ours)), where=self.where, fix=_FIX)
        for names in in_groups(ours):
            group = {name: value.to(dtype, copy=True) for name, value in self.read(names).items()}
            require_finite(group, where=self.where, fix="Get the file again")
            network.load_state_dict(group, strict=False, assign=True)
        network.requires_grad_(False)


def encoder_in_file(path: Path, whole: Mapping[str, Any], config: EncoderConfig) -> FoundEncoder:
    """Return the encoder in one of Meta's files.

    Args:
        path: The file.
        whole: What is in it: its parts by their keys.
        config: Which key, frame path and heads.

    Raises:
        InputError: There is no such key, or what is there is no encoder, is of both families or lacks its last norm;
            the heads are unknown or contradict the width; or the file's name is that of another encoder.
    """
    key = _key_of(path, whole, config.key)
    tensors = tensors_of(whole[key])
    if tensors is None:
        raise InputError(where=f"{path}: {key}", found="no weights", needed=_NEEDED, fix=_FIX)
    shapes, where = shapes_of(tensors), f"{path}: {key}"
    family = _family_of(shapes, where)
    part = part_of(family)

    def read(names: Sequence[str]) -> dict[str, Tensor]:
        mapped = tensors_of(open_file(path, needed=_NEEDED, fix=_FIX)[key]) or {}  # again: the pages are released after
        return {name: take(mapped, name, part) for name in names}

    sizes, patch_size = _sizes_of(shapes, family, config, where)
    known = published_as(path.name)
    _require_own_name(path, sizes)
    return FoundEncoder(
        where=where,
        sizes=sizes,
        patch_size=patch_size,
        image_size=None if known is None else known.image_size,
        origin=EncoderOrigin(path.name, key, "" if known is None else known.licence),
        shapes=shapes,
        needed=lambda ours: official_shapes(ours, part),
        read=read,
    )


def require_heads(width: int, heads: int | None, *, where: str) -> int:
    """Return the attention heads of an encoder, which its tensors do not show.

    Args:
        width: Of the encoder.
        heads: As the user or the file says; None: nobody says.
        where: The file.

    Raises:
        InputError: Nobody knows them; or they are not those of the published encoder of this width.
    """
    published = HEADS.get(width)
    if heads is None and published is None:
        known = ", ".join(map(str, HEADS))
        raise InputError(
            where=where,
            found=f"an encoder of width {width}, whose attention heads the tensors do not show",
            needed=f"a published width ({known}), or the heads",
            fix="Set model.encoder.heads to those it was trained with: other ones give other latents without an error",
        )
    if heads is not None and published not in {None, heads}:
        raise InputError(
            where=where,
            found=f"{heads} attention heads for an encoder of width {width}",
            needed=f"{published}, as every published encoder of this width has",
            fix="Leave out model.encoder.heads (of an AC file model.sizes.encoder.heads)",
        )
    return cast(int, heads if published is None else published)


def _key_of(path: Path, whole: Mapping[str, Any], key: str | None) -> str:
    there = [name for name in ENCODER_KEYS if name in whole]
    if key is None and there:
        others = f" (also there: {', '.join(there[1:])})" if len(there) > 1 else ""
        logger.info("%s: the encoder under %s%s", path, there[0], others)
        return there[0]
    if key is not None and key in there:
        return key
    found = f"no {key} (encoders: {', '.join(there)})" if key and there else f"no encoder (keys: {_some(whole)})"
    fix = f"Set model.encoder.key to one of {', '.join(there)}, or leave it out" if there else _FIX
    raise InputError(where=str(path), found=found, needed=_NEEDED, fix=fix)


def _some(names: Mapping[str, Any]) -> str:
    return ", ".join(list(names)[:8])


def _family_of(shapes: Shapes, where: str) -> Family:
    """Return which family the tensors are of."""
    newer = sorted(name for name in shapes if name.startswith(_ONLY_2_1))
    older = sorted(name for name in shapes if name.startswith("norm."))
    if newer and older:
        raise InputError(
            where=where,
            found=f"tensors of V-JEPA 2.1 ({newer[0]}) and of V-JEPA 2 ({older[0]}) together",
            needed="those of one family",
            fix=f"The file was put together from two: get the original. {_FIX}",
        )
    if newer and _LAST_NORM not in shapes:
        raise InputError(
            where=where,
            found="tensors of V-JEPA 2.1 without norms_block.3, its last norm",
            needed="every tensor of the encoder: without this one the latents would be wrong without an error",
            fix=f"The file was loaded into another network and saved again: get the original. {_FIX}",
        )
    if not newer and not older:
        raise InputError(where=where, found=f"no last norm (tensors: {_some(shapes)})", needed=_NEEDED, fix=_FIX)
    return "v2.1" if newer else "v2"


def _sizes_of(shapes: Shapes, family: Family, config: EncoderConfig, where: str) -> tuple[EncoderSizes, int]:
    """Return the sizes of the tensors, and the side of a patch."""
    try:
        width, *_, patch_size = shapes["patch_embed.proj.weight"]
        hidden, depth = shapes["blocks.0.mlp.fc1.weight"][0], depth_of(shapes, "blocks")
    except (KeyError, ValueError) as missing:
        raise InputError(where=where, found=f"no tensor {missing} in it", needed=_NEEDED, fix=_FIX) from None
    heads = require_heads(width, config.heads, where=where)
    ratio = mlp_ratio_of(width, hidden, EncoderSizes().mlp_ratio)
    sizes = EncoderSizes(width=width, depth=depth, heads=heads, mlp_ratio=ratio, family=family)
    return with_frame_path(sizes, config.frame, where=where), patch_size


def with_frame_path(sizes: EncoderSizes, frame: FramePath, *, where: str) -> EncoderSizes:
    """Return the sizes of an encoder that takes frames so.

    Raises:
        InputError: V-JEPA 2 has no such frame path, or the heads are not those of this width.
    """
    if frame == "image" and sizes.family == "v2":
        raise InputError(
            where=f"model.encoder.frame: {frame}",
            found=f"{where}, an encoder of V-JEPA 2",
            needed="one of V-JEPA 2.1: only it has a path for single images",
            fix="Set model.encoder.frame: tubelet, or take an encoder of V-JEPA 2.1",
        )
    require_heads(sizes.width, sizes.heads, where=where)
    return sizes.model_copy(update={"frame": frame})


def _require_own_name(path: Path, sizes: EncoderSizes) -> None:
    """Refuse a published name on the weights of another encoder: vitg and vitG differ by the case of a letter."""
    known = published_as(path.name)
    if known is None or (known.encoder.width, known.family) == (sizes.width, sizes.family):
        return
    right = next((one for one in PUBLISHED if (one.encoder.width, one.family) == (sizes.width, sizes.family)), None)
    raise InputError(
        where=str(path),
        found=f"an encoder of {'V-JEPA ' + sizes.family[1:]}, width {sizes.width}, depth {sizes.depth}",
        needed=f"{known.encoder.name} of V-JEPA {known.family[1:]}, width {known.encoder.width}, as the name says",
        fix=f"Rename it to {right.file}, or get the other again with `vjepa2-ac download {known.name}`"
        if right is not None
        else f"Get it again with `vjepa2-ac download {known.name}`, or give this file another name",
    )
