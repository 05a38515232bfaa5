"""Loading the world model that a config starts from; and Meta's own checkpoint format, read and written.

A model is one that is there (Meta's `.pt`, or a folder of this project), or a fresh predictor on an encoder.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vjepa2_ac.config import ModelConfig, ModelSizes
from vjepa2_ac.config.model import EncoderWeights
from vjepa2_ac.episode import POSE_WIDTHS
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.base_model import check_sizes, find_base, read_sizes
from vjepa2_ac.model.checkpoints.encoders import FoundEncoder, encoder_in_file, expected_sizes, find_encoder, sizes_with
from vjepa2_ac.model.checkpoints.meta_file import (
    ENCODER_KEYS,
    FIX,
    MetaFile,
    depth_of,
    fill,
    official_name,
    part_of,
    to_official_names,
)
from vjepa2_ac.model.network.blocks import mlp_ratio_of
from vjepa2_ac.model.network.world_model import WorldModel, fingerprint, widths_as_text, widths_of_model
from vjepa2_ac.storage.places import BUILTIN
from vjepa2_ac.storage.structured import record_of

logger = logging.getLogger(__name__)

_NON_COMMERCIAL = "The weights that jepa-wms publishes so are CC-BY-NC 4.0: for non-commercial use only"
_COMPARED = 65_536  # values of a tensor
_KEYS: tuple[EncoderWeights, ...] = ("encoder", "target_encoder")  # one encoder twice, unless it was trained


def load_base(config: ModelConfig, *, seed: int) -> WorldModel:
    """Return the world model to start from, on the CPU.

    It is `model.base`; or a fresh predictor of the sizes `model.random`, on `model.encoder` or on a random encoder.

    Raises:
        InputError: There is no such model or encoder, it cannot be read, or contradicts the config.
    """
    dtype = torch.bfloat16 if config.dtype == "bfloat16" else torch.float32
    found = None if config.encoder is None else find_encoder(config.encoder)
    if config.random is not None:
        at_persistence = config.random_start == "persistence"
        if found is None:
            return WorldModel.random(config.random, seed, dtype, at_persistence=at_persistence)
        model = _on_encoder(found, sizes_with(found, config.random), dtype)
        model.draw_predictor(torch.Generator().manual_seed(seed), dtype, at_persistence=at_persistence)
        return model
    if config.base is None:
        raise ValueError("a ModelConfig has a base or random sizes")
    path = find_base(config.base)
    if not path.is_dir() and found is None:
        return load_official(path, config.sizes, dtype, config.encoder_weights)
    file = None if path.is_dir() else MetaFile.open(path)
    if found is not None and (file is None or any(key in file.parts for key in ENCODER_KEYS)):
        said = f"an encoder of its own, and model.encoder names another ({found.where}), on which it predicts noise"
        fix = "Leave out model.encoder; or train a fresh predictor on it, with model.random in place of model.base"
        raise InputError(where=f"model.base: {config.base}", found=said, fix=fix)
    if file is not None and found is not None:
        return _load_predictor(file, found, config.sizes, dtype)
    check_sizes(read_sizes(path), config.sizes, where=f"model.base: {config.base}")
    return WorldModel.from_pretrained(path, dtype=dtype)


def base_sizes(config: ModelConfig) -> ModelSizes:
    """Return the sizes of the model that `load_base` would give, without reading a weight.

    Of an official `.pt`, or where nothing is there yet, they are those of `model.sizes`.

    Raises:
        InputError: There is a folder, but it is not a world model; or `model.encoder` names none.
    """
    given = config.random or config.sizes
    if config.encoder is not None:
        return expected_sizes(config.encoder, given)
    if config.random is not None or config.base is None:
        return given
    is_there = config.base.startswith(BUILTIN) or Path(config.base).exists()
    path = find_base(config.base) if is_there else Path(config.base)
    return read_sizes(path) if path.is_dir() else config.sizes


def load_official(
    path: str | Path,
    sizes: ModelSizes | None = None,
    dtype: torch.dtype = torch.float32,
    encoder_weights: EncoderWeights = "target_encoder",
) -> WorldModel:
    """Read Meta's checkpoint. Every tensor is matched; only a `pos_embed` of the encoder may remain.

    The file is mapped: beside the weights in `dtype` there are only pages of the file, which the system takes back.

    Args:
        path: The `.pt` file.
        sizes: Sizes that tensors do not show: image size, heads, extrinsics. Any other size that differs from both the
            default and the tensors is a contradiction.
        dtype: Type of the weights in memory.
        encoder_weights: The encoder to use, where the file holds two.

    Raises:
        InputError: The file is missing, truncated, of another kind, contradicts the sizes, or a weight is not finite.
    """
    file, given = MetaFile.open(Path(path)), sizes or ModelSizes()
    there = [key for key in _KEYS if isinstance(file.parts.get(key), dict)]
    key = encoder_weights if encoder_weights in there else (there or _KEYS)[0]
    # Training changes every tensor, so the beginning of each shows it, and few pages of the file are read. Flattening
    # would copy a tensor that is not contiguous, and one of a few bytes may be expanded to any size.
    tensors = [{name: one for name, one in file.tensors(key).items() if one.is_contiguous()} for key in there]
    if len({fingerprint({name: one.flatten()[:_COMPARED] for name, one in part.items()}) for part in tensors}) > 1:
        text = "%s: encoder and target_encoder differ; %s is used. Set model.encoder_weights for the other one"
        logger.warning(text, path, key)
    found = encoder_in_file(file, key, given.encoder.frame, given.encoder.heads)
    return _with_predictor(file, found, given, dtype)


def to_official(model: WorldModel) -> dict[str, Any]:
    """Return the weights by Meta's names, q, k and v fused: `torch.save` of it is an official checkpoint.

    Raises:
        InputError: States and actions differ in width from Meta's code, which has no predictor without states either.
        ValueError: There is an adapter: merge it first.
    """
    if model.predictor is not model.base_predictor:
        raise ValueError("an adapter is on: merge_adapter first")
    if not model.sizes.predictor.use_states or widths_of_model(model.sizes) != POSE_WIDTHS:
        found = f"a model that takes {widths_as_text(model.sizes)}"
        needed = f"states and actions of {POSE_WIDTHS.state} numbers: Meta's code has no other predictor"
        fix = "Export it with --to merged (WorldModel.save_pretrained), which `model.base` takes"
        raise InputError(where="the official format", found=found, needed=needed, fix=fix)
    encoder = to_official_names(model.present_encoder.state_dict(), part_of(model.sizes.encoder.family))
    return {
        "encoder": encoder,
        "target_encoder": dict(encoder),
        "predictor": to_official_names(model.predictor.state_dict(), "predictor"),
        "epoch": 0,
    }


def _load_predictor(file: MetaFile, found: FoundEncoder, sizes: ModelSizes, dtype: torch.dtype) -> WorldModel:
    """Read a file that holds a predictor alone, and put an encoder from elsewhere under it."""
    model = _with_predictor(file, found, sizes, dtype)
    model.encoder_origin = found.origin
    if not model.sizes.predictor.use_states:
        logger.warning("%s: a predictor without states and without an encoder. %s", file.path, _NON_COMMERCIAL)
    logger.warning(
        "%s does not say which encoder its predictor was trained on: on any other than %s it predicts noise. The first"
        " validation shows it (its error beside that of persistence).",
        file.path,
        found.origin,
    )
    return model


def _with_predictor(file: MetaFile, found: FoundEncoder, given: ModelSizes, dtype: torch.dtype) -> WorldModel:
    """Return the model of the predictor in a file and an encoder."""
    predictor = file.tensors("predictor")
    if "mask_tokens" in {name.partition(".")[0] for name in predictor} and "action_encoder.weight" not in predictor:
        said = "a checkpoint of pretraining: its predictor fills in masked patches, and knows no actions"
        fix = "Its encoder can be used: set model.encoder.path to this file, and model.random in place of model.base"
        fix += " for a fresh predictor (configs/scratch_vitb.yaml)"
        raise InputError(where=f"model.base: {file.path}", found=said, fix=fix)
    model = _on_encoder(found, _sizes(file, predictor, found, given), dtype)
    model.encoder_origin = None  # the file is the model's own
    fill(
        model.predictor,
        predictor,
        partial(official_name, part="predictor"),
        dtype,
        where=f"{file.path}: predictor",
        fix="Check model.base, model.sizes, and model.encoder: the predictor's latents are of one encoder",
    )
    logger.info("read %s: %s", file.path, model.sizes.model_dump())
    return model


def _on_encoder(found: FoundEncoder, sizes: ModelSizes, dtype: torch.dtype) -> WorldModel:
    """Return a model with this encoder, and a predictor without weights."""
    model = WorldModel.empty(sizes)
    fix = f"Get the original file. {FIX}"
    fill(model.present_encoder, found.weights(), found.rename, dtype, where=found.where, fix=fix)
    if found.is_cut:
        model.present_encoder.reset_last_norm()
    model.encoder_origin = found.origin
    return model


def _sizes(file: MetaFile, predictor: Mapping[str, Tensor], encoder: FoundEncoder, given: ModelSizes) -> ModelSizes:
    """Return the sizes of the tensors; heads, image size and extrinsics are those given."""
    own = given.predictor
    try:
        width, hidden = len(predictor["action_encoder.weight"]), len(predictor["predictor_blocks.0.mlp.fc1.weight"])
        depth = depth_of(predictor, "predictor_blocks")
    except KeyError as missing:
        raise file.lacks(f"tensor {missing}", part="predictor") from None
    told = {
        "image_size": given.image_size,
        "patch_size": encoder.patch_size,
        "encoder": encoder.sizes.model_dump(),
        "predictor": {
            "width": width,
            "depth": depth,
            "heads": own.heads,
            "mlp_ratio": mlp_ratio_of(width, hidden, own.mlp_ratio),
            "use_extrinsics": own.use_extrinsics,
            "use_states": any(name.startswith("state_encoder.") for name in predictor),
        },
    }
    fix = "Set image size and heads in model.sizes: the tensors cannot tell"
    found = record_of(ModelSizes, told, where=str(file.path), needed="sizes that go with model.sizes", fix=fix)
    check_sizes(found, given, where=str(file.path))
    return found
