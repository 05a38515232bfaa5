"""Official weights in Meta's checkpoint format, read and written: its names and fused layers, in little memory."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from torch import Tensor, nn

from vjepa2_ac.config import ModelSizes, PredictorSizes
from vjepa2_ac.config.model import EncoderConfig, EncoderKey
from vjepa2_ac.episode import ACTION_DIM, POSE_WIDTHS
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.encoder_file import FoundEncoder, encoder_in_file
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
    to_official_names,
)
from vjepa2_ac.model.finite import require_finite
from vjepa2_ac.model.network.blocks import mlp_ratio_of
from vjepa2_ac.model.network.input_heads import widths_of_model
from vjepa2_ac.model.network.pretrained_folder import check_tensors
from vjepa2_ac.model.network.published_sizes import HEADS
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.model.sizes import check_sizes

logger = logging.getLogger(__name__)

_NEEDED = "a checkpoint of V-JEPA 2-AC as Meta publishes it (vjepa2-ac-vitg.pt)"
_NEEDED_WHOLE = f"{_NEEDED}, 11.7 GB"
_FIX = "`vjepa2-ac download` fetches it, and goes on with a part of it"
_NON_COMMERCIAL = "The weights that jepa-wms publishes so are CC-BY-NC 4.0: for non-commercial use only"
_KEYS: tuple[EncoderKey, ...] = ("encoder", "target_encoder")  # one encoder twice: it was frozen


def load_official(path: str | Path, sizes: ModelSizes | None = None, dtype: torch.dtype = torch.float32) -> WorldModel:
    """Read Meta's checkpoint. Every tensor is matched; only a `pos_embed` of the encoder may remain.

    The file is mapped and read in groups: the peak is the weights in `dtype` plus about 1 GB.

    Args:
        path: The `.pt` file.
        sizes: Sizes that tensors do not show: image size, heads, extrinsics. Any other size that differs from both the
            default and the tensors is a contradiction.
        dtype: Type of the weights in memory.

    Raises:
        InputError: The file is missing, truncated, of another kind, contradicts the sizes, or a weight is not finite.
    """
    path, given = Path(path), sizes or ModelSizes()
    whole = open_file(path, needed=_NEEDED_WHOLE, fix=_FIX)
    key = next((one for one in _KEYS if one in whole), _KEYS[0])
    encoder = _tensors(path, whole, key)
    predictor = shapes_of(_predictor_in(path, whole))
    found = encoder_in_file(path, whole, _asked(path, key, encoder, given))
    model = WorldModel.empty(_sizes(predictor, found, given, where=str(path)))
    del whole, encoder
    found.fill(model.present_encoder, dtype)
    _fill_predictor(model.predictor, path, dtype)
    logger.info("read %s: %s", path, model.sizes.model_dump())
    return model


def load_predictor(path: Path, found: FoundEncoder, sizes: ModelSizes, dtype: torch.dtype) -> WorldModel:
    """Read a file that holds a predictor alone, and put an encoder from elsewhere under it.

    Raises:
        InputError: As `load_official`; the file has an encoder of its own; or the predictor takes latents of another
            width than the encoder's.
    """
    whole = open_file(path, needed=_NEEDED_WHOLE, fix=_FIX)
    if any(key in whole for key in ENCODER_KEYS):
        raise own_encoder(str(path), found)
    predictor = shapes_of(_predictor_in(path, whole))
    latent = predictor.get("predictor_embed.weight", (0, 0))[-1]
    if latent != found.sizes.width:
        raise InputError(
            where=f"model.base: {path}",
            found=f"a predictor of latents of width {latent}",
            needed=f"one of width {found.sizes.width}, as {found.where} makes them",
            fix="Set model.encoder to the encoder that the predictor was trained on",
        )
    model = WorldModel.empty(_sizes(predictor, found, sizes, where=str(path)))
    del whole
    found.fill(model.present_encoder, dtype)
    _fill_predictor(model.predictor, path, dtype)
    model.encoder_origin = found.origin
    if not model.sizes.predictor.use_states:
        logger.warning("%s: a predictor without states and without an encoder. %s", path, _NON_COMMERCIAL)
    logger.warning(
        "%s does not say which encoder its predictor was trained on: on any other than %s it predicts noise. The first"
        " validation shows it (its error beside that of persistence).",
        path,
        found.origin,
    )
    return model


def own_encoder(base: str, found: FoundEncoder) -> InputError:
    """Return the error of a base that has an encoder, where the config names another."""
    return InputError(
        where=f"model.base: {base}",
        found=f"an encoder of its own, and model.encoder names another ({found.where})",
        needed="the encoder that the predictor was trained on: on other latents it predicts noise",
        fix="Leave out model.encoder; or train a fresh predictor on it, with model.random in place of model.base",
    )


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
    encoder = to_official_names(model.present_encoder.state_dict(), part_of(model.sizes.encoder.family))
    return {
        "encoder": encoder,
        "target_encoder": dict(encoder),
        "predictor": to_official_names(model.predictor.state_dict(), "predictor"),
        "epoch": 0,
    }


def _tensors(path: Path, whole: Mapping[str, Any], key: str) -> dict[str, Tensor]:
    tensors = tensors_of(whole.get(key))
    if tensors is None:
        raise _refused(path, f"no weights under {key!r} (keys: {', '.join(list(whole)[:8])})")
    return tensors


def _predictor_in(path: Path, whole: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the tensors of an action-conditioned predictor; of pretraining's masked one nothing can be used."""
    tensors = _tensors(path, whole, "predictor")
    if any(name.startswith("mask_tokens") for name in tensors) and "action_encoder.weight" not in tensors:
        raise InputError(
            where=f"model.base: {path}",
            found="a checkpoint of pretraining: its predictor fills in masked patches, and knows no actions",
            needed=_NEEDED,
            fix="Its encoder can be used: set model.encoder.path to this file, and model.random in place of model.base"
            " for a fresh predictor (configs/scratch_vitb.yaml)",
        )
    return tensors


def _asked(path: Path, key: EncoderKey, encoder: Mapping[str, Tensor], given: ModelSizes) -> EncoderConfig:
    """Return what model.sizes says of the encoder; heads only of a width that nobody has published."""
    patches = encoder.get("patch_embed.proj.weight")
    heads = None if patches is not None and patches.shape[0] in HEADS else given.encoder.heads
    return EncoderConfig(path=str(path), key=key, frame=given.encoder.frame, heads=heads)


def _refused(where: str | Path, found: str) -> InputError:
    return InputError(where=str(where), found=found, needed=_NEEDED, fix=_FIX)


def _sizes(predictor: Shapes, encoder: FoundEncoder, given: ModelSizes, *, where: str) -> ModelSizes:
    """Return the sizes of the tensors; heads, image size and extrinsics are those given."""
    try:
        found = ModelSizes(
            image_size=given.image_size,
            patch_size=encoder.patch_size,
            encoder=encoder.sizes,
            predictor=_predictor_sizes(predictor, given.predictor),
        )
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


def _predictor_sizes(predictor: Shapes, given: PredictorSizes) -> PredictorSizes:
    width, action_width = predictor["action_encoder.weight"]
    if action_width != ACTION_DIM:
        raise KeyError(f"action_encoder.weight of {ACTION_DIM} columns (it has {action_width})")
    hidden = predictor["predictor_blocks.0.mlp.fc1.weight"][0]
    return PredictorSizes(
        width=width,
        depth=depth_of(predictor, "predictor_blocks"),
        heads=given.heads,
        mlp_ratio=mlp_ratio_of(width, hidden, given.mlp_ratio),
        use_extrinsics=given.use_extrinsics,
        use_states=_has_states(predictor),
    )


def _has_states(names: Iterable[str]) -> bool:
    """Return whether a predictor with tensors of these names takes states."""
    return any(name.startswith("state_encoder.") for name in names)


def _fill_predictor(network: nn.Module, path: Path, dtype: torch.dtype) -> None:
    """Load the weights of a predictor on the meta device in groups of tensors, releasing the mapped file in between."""
    needed, part = network.state_dict(), "predictor"
    whole = open_file(path, needed=_NEEDED_WHOLE, fix=_FIX)
    check_tensors(
        shapes_of(_tensors(path, whole, part)), official_shapes(shapes_of(needed), "predictor"), where=f"{path}: {part}"
    )
    del whole
    for names in in_groups(needed):
        mapped = _tensors(path, open_file(path, needed=_NEEDED_WHOLE, fix=_FIX), part)
        group = {name: take(mapped, name, "predictor").to(dtype, copy=True) for name in names}
        require_finite(group, where=f"{path}: {part}", fix=_FIX)
        network.load_state_dict(group, strict=False, assign=True)
        del mapped
    network.requires_grad_(False)
