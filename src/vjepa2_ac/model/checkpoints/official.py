"""Official weights in Meta's checkpoint format, read and written: its names and fused layers, in little memory."""

from __future__ import annotations

import logging
import pickle
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from torch import Tensor, nn

from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.episode import ACTION_DIM, POSE_WIDTHS
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.foreign_file import foreign_kind
from vjepa2_ac.model.finite import require_finite
from vjepa2_ac.model.network.blocks import mlp_ratio_of
from vjepa2_ac.model.network.input_heads import widths_of_model
from vjepa2_ac.model.network.pretrained_folder import check_tensors
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.model.sizes import check_sizes

logger = logging.getLogger(__name__)

GROUP_BYTES = 2**29  # of the file in memory at once, in addition to the weights
IGNORED = {"encoder": ("pos_embed",), "predictor": ()}  # may exist: a network with rotary positions does not use it

_NEEDED = "a checkpoint of V-JEPA 2-AC as Meta publishes it (vjepa2-ac-vitg.pt)"
_FIX = "`vjepa2-ac download` fetches it, and goes on with a part of it"
_NON_COMMERCIAL = "The weights that jepa-wms publishes so are CC-BY-NC 4.0: for non-commercial use only"
_SPLIT = ("q", "k", "v")
_DAMAGE = (  # errors of a damaged pickle, in addition to torch's own
    pickle.UnpicklingError, OSError, EOFError, RuntimeError, ValueError, LookupError, TypeError, AttributeError,
    AssertionError, ArithmeticError, MemoryError,
)  # fmt: skip


def load_official(path: str | Path, sizes: ModelSizes | None = None, dtype: torch.dtype = torch.float32) -> WorldModel:
    """Read Meta's checkpoint. Every tensor is matched; only those in `IGNORED` may remain.

    The file is mapped and read in groups: the peak is the weights in `dtype` plus about 1 GB.

    Args:
        path: The `.pt` file.
        sizes: Sizes that tensors do not show: image size, heads, extrinsics. Any other size that differs from both the
            default and the tensors is a contradiction.
        dtype: Type of the weights in memory.

    Raises:
        InputError: The file is missing, truncated, of another kind, contradicts the sizes, or a weight is not finite.
    """
    path = Path(path)
    parts = {part: _shapes(weights) for part, weights in _open(path).items()}
    model = WorldModel.empty(_sizes(parts, sizes or ModelSizes(), where=str(path)))
    for part, network in (("encoder", model.encoder), ("predictor", model.predictor)):
        _fill(network, path, part, dtype)
    logger.info("read %s: %s", path, model.sizes.model_dump())
    return model


def fill_predictor(network: nn.Module, path: str | Path, dtype: torch.dtype = torch.float32) -> None:
    """Load the weights of a predictor from a checkpoint, which may hold nothing else.

    Every tensor is matched. A warning is logged where a predictor without states stands alone, as jepa-wms publishes
    its own: those weights must not be used commercially.

    Args:
        network: The predictor, on the meta device, of the sizes that `predictor_sizes` gives.
        path: The `.pt` or `.pth.tar` file.
        dtype: Type of the weights in memory.

    Raises:
        InputError: The file is missing, damaged, of another kind or another predictor's, or a weight is not finite.
    """
    path = Path(path)
    _fill(network, path, "predictor", dtype)
    if not has_states(network.state_dict()) and "encoder" not in _load(path):
        logger.warning("%s: a predictor without states and without an encoder. %s", path, _NON_COMMERCIAL)


def predictor_shapes(path: str | Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the predictor in a checkpoint, by Meta's names; reads no values.

    Raises:
        InputError: The file is missing, damaged, or holds no predictor.
    """
    return _shapes(_open(Path(path), ("predictor",))["predictor"])


def predictor_sizes(shapes: Mapping[str, tuple[int, ...]], given: PredictorSizes) -> PredictorSizes:
    """Return the sizes of a predictor; heads and extrinsics are those given.

    Args:
        shapes: Of its tensors, by Meta's names. Without a state encoder it is a predictor without states.
        given: What tensors do not show.

    Raises:
        KeyError: A tensor is missing, or actions are of another width than Meta's.
        ValidationError: The tensors do not go with the given heads.
    """
    width, action_width = shapes["action_encoder.weight"]
    if action_width != ACTION_DIM:
        raise KeyError(f"action_encoder.weight of {ACTION_DIM} columns (it has {action_width})")
    return PredictorSizes(
        width=width,
        depth=_depth(shapes, "predictor_blocks"),
        heads=given.heads,
        mlp_ratio=mlp_ratio_of(width, shapes["predictor_blocks.0.mlp.fc1.weight"][0], given.mlp_ratio),
        use_extrinsics=given.use_extrinsics,
        use_states=has_states(shapes),
    )


def has_states(names: Iterable[str]) -> bool:
    """Return whether the predictor with tensors of these names takes states."""
    return any(name.startswith("state_encoder.") for name in names)


def to_official(model: WorldModel) -> dict[str, Any]:
    """Return the weights by Meta's names, q, k and v fused: `torch.save` of it is an official checkpoint.

    Raises:
        ValueError: There is an adapter: merge it first. Or states and actions differ in width from Meta's code, which
            has no predictor without states either.
    """
    if model.predictor is not model.base_predictor:
        raise ValueError("an adapter is on: merge_adapter first")
    if not model.sizes.predictor.use_states:
        raise ValueError("Meta's code has no predictor without states: save_pretrained writes it")
    if widths_of_model(model.sizes) != POSE_WIDTHS:
        raise ValueError(f"Meta's code takes {POSE_WIDTHS}, not {widths_of_model(model.sizes)}")
    encoder = _to_official(model.present_encoder.state_dict(), "encoder")
    return {
        "encoder": encoder,
        "target_encoder": dict(encoder),
        "predictor": _to_official(model.predictor.state_dict(), "predictor"),
        "epoch": 0,
    }


# Ours -> Meta's, as (pattern, replacement), applied in turn.
_NAMES: dict[str, list[tuple[str, str]]] = {
    "encoder": [
        (r"^vit\.embeddings\.patch_embeddings\.", "patch_embed."),
        (r"^vit\.layernorm\.", "norm."),
        (r"^vit\.layer\.", "blocks."),
        (r"\.attention\.(q|k|v)(?:uery|ey|alue)\.", r".attn.\1."),
        (r"\.attention\.proj\.", ".attn.proj."),
    ],
    "predictor": [(r"^blocks\.", "predictor_blocks."), (r"\.attn\.o\.", ".attn.proj.")],
}


def official_name(name: str, part: str) -> tuple[str, int | None]:
    """Return Meta's name of one of our tensors, and which third of a fused one it is (None: all of it)."""
    for pattern, replacement in _NAMES[part]:
        name = re.sub(pattern, replacement, name)
    fused = re.sub(r"\.attn\.[qkv]\.", ".attn.qkv.", name)
    return fused, None if fused == name else _SPLIT.index(name.split(".attn.")[1][0])


def _open(path: Path, parts: Iterable[str] = ("encoder", "predictor")) -> dict[str, dict[str, Tensor]]:
    """Map a checkpoint and return its parts by Meta's names without prefixes; reads no values."""
    whole = _load(path)
    found: dict[str, Any] = {
        "encoder": whole.get("encoder", whole.get("target_encoder")),
        "predictor": whole.get("predictor"),
    }
    for part in parts:
        if not isinstance(found[part], dict) or not all(isinstance(value, Tensor) for value in found[part].values()):
            raise _refused(path, f"no weights under {part!r} (keys: {', '.join(map(str, list(whole)[:8]))})")
    prefixes = re.compile(r"^(?:(?:module|backbone)\.)+")
    return {part: {prefixes.sub("", name): one for name, one in found[part].items()} for part in parts}


def _load(path: Path) -> dict[str, Any]:
    """Map a checkpoint; reads no values."""
    if not path.is_file():
        raise _refused(path, "no such file")
    try:
        whole = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except _DAMAGE as error:
        raise InputError(where=str(path), found=_foreign(path, error), needed=f"{_NEEDED}, 11.7 GB", fix=_FIX) from None
    if not isinstance(whole, dict):
        raise _refused(path, f"a {type(whole).__name__}")
    return whole


def _refused(where: str | Path, found: str) -> InputError:
    return InputError(where=str(where), found=found, needed=_NEEDED, fix=_FIX)


def _foreign(path: Path, error: Exception) -> str:
    if (kind := foreign_kind(path, error)) is not None:
        return kind
    size, reason = path.stat().st_size / 1e9, str(error).splitlines()[0][:120]
    return f"{size:.2f} GB that torch cannot read ({reason}): truncated, or of another kind"


def _shapes(weights: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(value.shape) for name, value in weights.items()}


def _sizes(parts: dict[str, dict[str, tuple[int, ...]]], given: ModelSizes, *, where: str) -> ModelSizes:
    """Return the sizes of the tensors; heads, image size and extrinsics are those given."""
    try:
        found = _sizes_of_tensors(parts, given)
    except KeyError as missing:
        raise _refused(where, f"no tensor {missing} in it") from None
    except ValidationError as error:
        raise InputError(
            where=where,
            found=f"sizes that do not go with model.sizes ({error.errors()[0]['msg']})",
            needed="image size and heads of the checkpoint",
            fix="Set them in model.sizes: the tensors cannot tell",
        ) from None
    check_sizes(found, given, where=where)
    return found


def _sizes_of_tensors(parts: dict[str, dict[str, tuple[int, ...]]], given: ModelSizes) -> ModelSizes:
    encoder, predictor = parts["encoder"], parts["predictor"]
    width, *_, patch_size = encoder["patch_embed.proj.weight"]
    hidden = encoder["blocks.0.mlp.fc1.weight"][0]
    return ModelSizes(
        image_size=given.image_size,
        patch_size=patch_size,
        encoder=EncoderSizes(
            width=width,
            depth=_depth(encoder, "blocks"),
            heads=given.encoder.heads,
            mlp_ratio=mlp_ratio_of(width, hidden, given.encoder.mlp_ratio),
        ),
        predictor=predictor_sizes(predictor, given.predictor),
    )


def _depth(names: Mapping[str, object], blocks: str) -> int:
    return 1 + max(int(name.split(".")[1]) for name in names if name.startswith(f"{blocks}."))


def _fill(network: nn.Module, path: Path, part: str, dtype: torch.dtype) -> None:
    """Load the weights of a network on the meta device in groups of tensors, releasing the mapped file in between."""
    needed = network.state_dict()
    _check(_shapes(_open(path, (part,))[part]), _shapes(needed), part, where=str(path))
    for names in _groups(needed):
        mapped = _open(path, (part,))[part]
        group = {name: _take(mapped, name, part).to(dtype, copy=True) for name in names}
        require_finite(group, where=f"{path}: {part}", fix=_FIX)
        network.load_state_dict(group, strict=False, assign=True)
        del mapped
    network.requires_grad_(False)


def _check(found: dict[str, tuple[int, ...]], ours: dict[str, tuple[int, ...]], part: str, *, where: str) -> None:
    needed: dict[str, tuple[int, ...]] = {}
    for name, shape in ours.items():
        official, third = official_name(name, part)
        needed[official] = shape if third is None else (3 * shape[0], *shape[1:])
    used = {name: shape for name, shape in found.items() if name not in IGNORED[part]}
    check_tensors(used, needed, where=f"{where}: {part}")


def _take(official: Mapping[str, Tensor], name: str, part: str) -> Tensor:
    fused, third = official_name(name, part)
    return official[fused] if third is None else official[fused].chunk(3)[third]


def _groups(weights: Mapping[str, Tensor]) -> Iterator[list[str]]:
    group, size = list[str](), 0
    for name, value in weights.items():
        group.append(name)
        size += value.numel() * 4
        if size >= GROUP_BYTES:
            yield group
            group, size = [], 0
    yield group


def _to_official(weights: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    pieces: dict[str, dict[int | None, Tensor]] = {}
    for name, value in weights.items():
        fused, third = official_name(name, part)
        pieces.setdefault(fused, {})[third] = value.detach()
    return {
        f"module.{name}": thirds[None] if None in thirds else torch.cat([thirds[index] for index in range(3)])
        for name, thirds in pieces.items()
    }
