"""Meta's checkpoint format: a `.pt` file mapped into memory, and its names of tensors, q, k and v fused."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from vjepa2_ac import storage
from vjepa2_ac.config.model import Family
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.pretrained_folder import check_tensors, require_finite, require_floats

ENCODER_KEYS = ("ema_encoder", "target_encoder", "encoder")
"""Where an encoder can be in a file. The first that is there is taken: an average of weights, which Meta's own use is
of; `encoder` is the one that was trained by gradient."""
FIX = "`vjepa2-ac download --list` shows those that are published; the Hub has facebook/vjepa2-vitl-fpc64-256"

Part = Literal["encoder", "encoder 2.1", "predictor"]
Rename = Callable[[str], tuple[str, int | None]]
"""Our name of a tensor -> the file's, and which third of a fused one it is (None: all of it)."""

_PARTS = 'both parts, as of torch.save({"encoder": ..., "predictor": ...}, FILE), or model.encoder.path for the encoder'
_NEEDED = "a checkpoint of V-JEPA 2, 2.1 or 2-AC as Meta publishes it"
_SPLIT = ("q", "k", "v")
_PREFIXES = re.compile(r"^(?:(?:module|backbone|_orig_mod)\.)+|_orig_mod\.")  # the last: of torch.compile, anywhere
_IGNORED = "pos_embed"  # may be in a file: a network with rotary positions does not use it
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


@dataclass(frozen=True)
class MetaFile:
    """A mapped checkpoint."""

    path: Path
    parts: Mapping[str, Any]  # by its keys

    @classmethod
    def open(cls, path: Path) -> MetaFile:
        """Map a file; reads no values, and executes nothing.

        Raises:
            InputError: There is no such file, or it is of another kind, truncated, a git-lfs pointer or a pipe.
            UnreachableError: It cannot be read.
        """
        with storage.user_can_read(path, needed=_NEEDED, fix=FIX):
            try:
                whole = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
            except Exception as error:  # a damaged pickle ends in any of them
                if storage.is_refusal(error):
                    raise
                found, fix = _problem_of(path, error)
                raise InputError(where=str(path), found=found, needed=_NEEDED, fix=fix) from None
        if not isinstance(whole, dict):
            raise InputError(where=str(path), found=f"a {type(whole).__name__}", needed=_NEEDED, fix=FIX)
        return cls(path, {str(key): value for key, value in whole.items()})

    def tensors(self, key: str) -> dict[str, Tensor]:
        """Return the tensors of a part by Meta's names without prefixes.

        Raises:
            InputError: There is no such part, it holds more than tensors, or nothing.
        """
        part = self.parts.get(key)
        if not isinstance(part, dict) or not part or not all(isinstance(value, Tensor) for value in part.values()):
            raise self.lacks(key if key not in self.parts else f"weights under {key!r}")
        named = {_PREFIXES.sub("", str(name)): value for name, value in part.items()}
        named.pop(_IGNORED, None)
        require_floats(named, where=f"{self.path}: {key}", fix=FIX)
        return named

    def lacks(self, what: str, fix: str = FIX, *, part: str | None = None) -> InputError:
        """Return the error of a file without a part, or of a part without a tensor, with the names that are there."""
        names = ", ".join(list(self.parts if part is None else self.tensors(part))[:8])
        found = f"no {what} (keys: {names})" if part is None else f"no {what} in {part} (its tensors: {names})"
        return InputError(where=str(self.path), found=found, needed=_PARTS, fix=fix)


def part_of(family: Family) -> Part:
    """Return the names of an encoder of a family."""
    return "encoder" if family == "v2" else "encoder 2.1"


def official_name(name: str, part: Part) -> tuple[str, int | None]:
    """Return Meta's name of one of our tensors, and which third of a fused one it is (None: all of it)."""
    for pattern, replacement in _NAMES[part]:
        name = re.sub(pattern, replacement, name)
    fused = re.sub(r"\.attn\.[qkv]\.", ".attn.qkv.", name)
    return fused, None if fused == name else _SPLIT.index(name.split(".attn.")[1][0])


def fill(
    network: nn.Module, weights: Mapping[str, Tensor], rename: Rename, dtype: torch.dtype, *, where: str, fix: str
) -> None:
    """Load mapped weights into a network on the meta device, each cast as it is read; none requires a gradient.

    Raises:
        InputError: A tensor is missing, unknown or of another shape, or a weight is not finite.
    """
    own = network.state_dict()
    names = {ours: rename(ours) for ours in own}
    needed = {
        theirs: own[ours].shape if third is None else (3 * len(own[ours]), *own[ours].shape[1:])
        for ours, (theirs, third) in names.items()
    }
    check_tensors({name: value.shape for name, value in weights.items()}, needed, where=where, fix=fix)
    require_floats(weights, where=where, fix=fix)
    for ours, (theirs, third) in names.items():
        value = weights[theirs] if third is None else weights[theirs].chunk(3)[third]
        own[ours] = value.to(dtype, copy=True)
    require_finite(own, where=where, fix=fix)
    network.load_state_dict(own, assign=True)
    network.requires_grad_(False)


def to_official_names(weights: Mapping[str, Tensor], part: Part) -> dict[str, Tensor]:
    """Return our weights by Meta's names, q, k and v fused."""
    pieces: dict[str, list[Tensor]] = {}
    for name, value in weights.items():  # q, k and v in this order, as everywhere
        pieces.setdefault(official_name(name, part)[0], []).append(value.detach())
    return {f"module.{name}": own[0] if len(own) == 1 else torch.cat(own) for name, own in pieces.items()}


def depth_of(names: Mapping[str, object], blocks: str) -> int:
    """Return the number of blocks whose tensors are there.

    Raises:
        KeyError: None is.
    """
    numbers = [int(name.split(".")[1]) for name in names if re.match(rf"{blocks}\.\d{{1,6}}\.", name)]
    if not numbers:
        raise KeyError(f"{blocks}.0")
    return 1 + max(numbers)


def _problem_of(path: Path, error: Exception) -> tuple[str, str]:
    """Return what a file is that torch did not load (its beginning shows a web page, for example), and the fix."""
    refused = re.search(r"GLOBAL ([\w.]+)", str(error))
    if refused:
        found = f"a pickle that would call {refused[1]}: it was refused, since loading it could run foreign code"
        old, new, keys = map(
            json.dumps, (str(path), str(path.with_suffix(".weights.pt")), [*ENCODER_KEYS, "predictor"])
        )
        code = f'import torch; old = torch.load({old}, map_location="cpu", weights_only=False)'
        code += f"; torch.save({{key: old[key] for key in {keys} if key in old}}, {new})"
        return found, f"If you trust the file, save its weights alone: `python -c {shlex.quote(code)}`"
    with path.open("rb") as file:
        head = file.read(24)
    reason = next(iter(str(error).splitlines()), type(error).__name__)[:120]
    size = path.stat().st_size / 1e9
    found = f"{size:.2f} GB, beginning with {head!r}, that torch cannot read ({reason}): truncated, or of another kind"
    return found, FIX
