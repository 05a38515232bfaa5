"""Meta's checkpoint format: a `.pt` file mapped into memory, and its names of tensors, q, k and v fused."""

from __future__ import annotations

import pickle
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from vjepa2_ac.config.model import Family
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.foreign_file import foreign_kind

GROUP_BYTES = 2**29  # of the file in memory at once, in addition to the weights
ENCODER_KEYS = ("ema_encoder", "target_encoder", "encoder")
"""Where an encoder can be in a file. The first that is there is taken: an average of weights, which Meta's own use is
of; `encoder` is the one that was trained by gradient."""

Part = Literal["encoder", "encoder 2.1", "predictor"]
Shapes = dict[str, tuple[int, ...]]

_SPLIT = ("q", "k", "v")
_PREFIXES = re.compile(r"^(?:(?:module|backbone)\.)+")
_DAMAGE = (  # errors of a damaged pickle, in addition to torch's own
    pickle.UnpicklingError, OSError, EOFError, RuntimeError, ValueError, LookupError, TypeError, AttributeError,
    AssertionError, ArithmeticError, MemoryError,
)  # fmt: skip
_ENCODER = [
    (r"^vit\.embeddings\.patch_embeddings\.", "patch_embed."),
    (r"^vit\.layer\.", "blocks."),
    (r"\.attention\.(q|k|v)(?:uery|ey|alue)\.", r".attn.\1."),
    (r"\.attention\.proj\.", ".attn.proj."),
]
_NAMES: dict[Part, list[tuple[str, str]]] = {  # ours -> Meta's, as (pattern, replacement), applied in turn
    "encoder": [(r"^vit\.layernorm\.", "norm."), *_ENCODER],
    "encoder 2.1": [
        (r"^vit\.layernorm\.", "norms_block.3."),
        (r"^vit\.level_norms\.", "norms_block."),
        (r"^vit\.embeddings\.patch_embeddings\.proj\.of_images\.", "patch_embed_img.proj."),
        (r"^vit\.embeddings\.patch_embeddings\.proj\.video_kind$", "video_mod_embed"),
        (r"^vit\.embeddings\.patch_embeddings\.proj\.image_kind$", "img_mod_embed"),
        *_ENCODER,
    ],
    "predictor": [(r"^blocks\.", "predictor_blocks."), (r"\.attn\.o\.", ".attn.proj.")],
}


def open_file(path: Path, *, needed: str, fix: str) -> dict[str, Any]:
    """Map a checkpoint and return its parts by their keys; reads no values, and executes nothing.

    Raises:
        InputError: There is no such file, or it is of another kind, or truncated.
    """
    if not path.is_file():
        raise InputError(where=str(path), found="no such file", needed=needed, fix=fix)
    try:
        whole = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except _DAMAGE as error:
        raise InputError(where=str(path), found=_foreign(path, error), needed=needed, fix=fix) from None
    if not isinstance(whole, dict):
        raise InputError(where=str(path), found=f"a {type(whole).__name__}", needed=needed, fix=fix)
    return {str(key): value for key, value in whole.items()}


def tensors_of(part: Any) -> dict[str, Tensor] | None:
    """Return the tensors of a part by Meta's names without prefixes; None: it is not only tensors, or has none."""
    if not isinstance(part, dict) or not part or not all(isinstance(value, Tensor) for value in part.values()):
        return None
    return {_PREFIXES.sub("", str(name)): value for name, value in part.items()}


def part_of(family: Family) -> Part:
    """Return the names of an encoder of a family."""
    return "encoder" if family == "v2" else "encoder 2.1"


def shapes_of(weights: Mapping[str, Tensor]) -> Shapes:
    """Return the shapes of tensors by their names."""
    return {name: tuple(value.shape) for name, value in weights.items()}


def official_name(name: str, part: Part) -> tuple[str, int | None]:
    """Return Meta's name of one of our tensors, and which third of a fused one it is (None: all of it)."""
    for pattern, replacement in _NAMES[part]:
        name = re.sub(pattern, replacement, name)
    fused = re.sub(r"\.attn\.[qkv]\.", ".attn.qkv.", name)
    return fused, None if fused == name else _SPLIT.index(name.split(".attn.")[1][0])


def official_shapes(ours: Mapping[str, tuple[int, ...]], part: Part) -> Shapes:
    """Return the tensors that a file must have for ours."""
    needed: Shapes = {}
    for name, shape in ours.items():
        official, third = official_name(name, part)
        needed[official] = shape if third is None else (3 * shape[0], *shape[1:])
    return needed


def take(official: Mapping[str, Tensor], name: str, part: Part) -> Tensor:
    """Return one of our tensors from Meta's."""
    fused, third = official_name(name, part)
    return official[fused] if third is None else official[fused].chunk(3)[third]


def to_official_names(weights: Mapping[str, Tensor], part: Part, *, prefix: str = "module.") -> dict[str, Tensor]:
    """Return our weights by Meta's names, q, k and v fused."""
    pieces: dict[str, dict[int | None, Tensor]] = {}
    for name, value in weights.items():
        fused, third = official_name(name, part)
        pieces.setdefault(fused, {})[third] = value.detach()
    return {
        f"{prefix}{name}": thirds[None] if None in thirds else torch.cat([thirds[index] for index in range(3)])
        for name, thirds in pieces.items()
    }


def depth_of(names: Mapping[str, object], blocks: str) -> int:
    """Return the number of blocks whose tensors are there.

    Raises:
        KeyError: None is.
    """
    numbers = [int(name.split(".")[1]) for name in names if re.match(rf"{blocks}\.\d+\.", name)]
    if not numbers:
        raise KeyError(f"{blocks}.0")
    return 1 + max(numbers)


def in_groups(weights: Mapping[str, Tensor]) -> Iterator[list[str]]:
    """Yield the names of tensors, as many at once as may be read before a mapped file is released."""
    group, size = list[str](), 0
    for name, value in weights.items():
        group.append(name)
        size += value.numel() * 4
        if size >= GROUP_BYTES:
            yield group
            group, size = [], 0
    if group:
        yield group


def _foreign(path: Path, error: Exception) -> str:
    if (kind := foreign_kind(path, error)) is not None:
        return kind
    size, reason = path.stat().st_size / 1e9, str(error).splitlines()[0][:120]
    return f"{size:.2f} GB that torch cannot read ({reason}): truncated, or of another kind"
