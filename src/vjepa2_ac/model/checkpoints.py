"""Load the base model of a config, and read and write all checkpoint formats.

The supported formats are Meta's `.pt` of V-JEPA 2 and 2.1, a transformers folder (local or on the Hub), and a folder of
this project. `EncoderSource` describes an encoder in any of these formats before its weights are read. Tensors that do
not match the network are errors.
"""

from __future__ import annotations

import json
import logging
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, Field
from torch import Tensor, nn

from vjepa2_ac import storage
from vjepa2_ac.config import EncoderSizes, ModelConfig, ModelSizes
from vjepa2_ac.config.model import Depth, EncoderConfig, Family, FramePath, Heads, Ratio, Width
from vjepa2_ac.episode import POSE_WIDTHS
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.blocks import find_mlp_ratio
from vjepa2_ac.model.model_files import (
    CONFIG,
    ENCODER_NEEDED,
    FORMAT,
    PUBLISHED_HEADS,
    EncoderOrigin,
    check_sizes,
    find_base,
    find_encoder_path,
    find_published_file,
    read_encoder_origin,
    read_sizes,
)
from vjepa2_ac.model.world_model import ENCODER, WorldModel, describe_model_widths, get_model_widths
from vjepa2_ac.storage.paths import BUILTIN
from vjepa2_ac.storage.structured import parse_record, read_json_object
from vjepa2_ac.storage.tensors import check_tensors, open_safetensors, require_finite, require_floats
from vjepa2_ac.storage.transfer import download_from_hub

logger = logging.getLogger(__name__)

ENCODER_KEYS = ("ema_encoder", "target_encoder", "encoder")
"""Keys of encoders in a file of Meta, in order of preference. The first two contain a moving average of the weights,
which Meta uses; `encoder` contains the weights that were trained by gradient descent."""
FIX = "`vjepa2-ac download --list` shows the published files; the Hub has facebook/vjepa2-vitl-fpc64-256"

Part = Family | Literal["predictor"]  # parts of a model that differ in the names of their tensors
Rename = Callable[[str], tuple[str, int | None]]
"""Maps this project's name of a tensor to its name in the file, and to its index in a fused q, k, v tensor of the file
(None: the tensor is not fused)."""

_PARTS = (
    'both parts, as written by torch.save({"encoder": ..., "predictor": ...}, FILE),'
    " or model.encoder.path for the encoder"
)
_NEEDED = "a checkpoint of V-JEPA 2, 2.1 or 2-AC as Meta publishes it"
_FUSED = ("q", "k", "v")  # order of the parts of a fused tensor
# Prefixes of DDP and of Meta's wrapper are at the start of a name; torch.compile's prefix can be inside.
_PREFIXES = re.compile(r"^(?:(?:module|backbone|_orig_mod)\.)+|_orig_mod\.")
_UNUSED = "pos_embed"  # may be in a file, but a network with rotary positions does not use it
_ENCODER = [
    (r"^vit\.embeddings\.patch_embeddings\.", "patch_embed."),
    (r"^vit\.layer\.", "blocks."),
    (r"\.attention\.(q|k|v)(?:uery|ey|alue)\.", r".attn.\1."),
    (r"\.attention\.proj\.", ".attn.proj."),
]
_NAMES: dict[Part, list[tuple[str, str]]] = {  # (pattern, replacement) from this project's names to Meta's, in order
    "v2": [(r"^vit\.layernorm\.", "norm."), *_ENCODER],
    "v2.1": [
        (r"^vit\.layernorm\.", "norms_block.3."),
        (r"^vit\.level_norms\.", "norms_block."),
        (r"^vit\.embeddings\.patch_embeddings\.proj\.of_images\.", "patch_embed_img.proj."),
        (r"^vit\.embeddings\.patch_embeddings\.proj\.video_kind$", "video_mod_embed"),
        (r"^vit\.embeddings\.patch_embeddings\.proj\.image_kind$", "img_mod_embed"),
        *_ENCODER,
    ],
    "predictor": [(r"^blocks\.", "predictor_blocks."), (r"\.attn\.o\.", ".attn.proj.")],
}
_HUB_PATTERNS = [CONFIG, "*.safetensors"]
_HUB_PREFIXES = ("vjepa2.encoder.", "encoder.")  # of a classification model and of a plain model
_BLOCK = re.compile(r"(?:^|\.)(?:blocks|layer)\.(\d+)\.")  # matches the names of Meta, transformers and this project
_V2_1_PREFIXES = ("norms_block.", "video_mod_embed", "img_mod_embed", "patch_embed_img.")
_NON_COMMERCIAL = "If they are from jepa-wms, their licence is CC-BY-NC 4.0: for non-commercial use only"


def load_base(config: ModelConfig, *, seed: int) -> WorldModel:
    """Return the base model on the CPU.

    The model is read from `model.base`. With `model.base: random` it has a new predictor with the sizes in
    `model.sizes`, and the encoder in `model.encoder`; without `model.encoder` the encoder is random, too.

    Raises:
        InputError: The model or the encoder does not exist, cannot be read, or contradicts the config.
    """
    dtype = torch.bfloat16 if config.dtype == "bfloat16" else torch.float32
    encoder = None if config.encoder is None else find_encoder(config.encoder)
    if config.is_random:
        if encoder is None:
            return WorldModel.random(config.sizes.model_sizes, seed, dtype, near_persistence=True)
        model = _build_with_encoder(encoder, get_sizes_with_encoder(encoder, config.sizes.model_sizes), dtype)
        model.draw_predictor(torch.Generator().manual_seed(seed), dtype, near_persistence=True)
        return model
    path = find_base(config.base)
    file = None if path.is_dir() else MetaFile.open(path)
    if encoder is not None and (file is None or any(key in file.parts for key in ENCODER_KEYS)):
        problem = f"a model with an encoder, but model.encoder sets another encoder ({encoder.where})"
        fix = "Remove model.encoder; or train a new predictor on that encoder, with model.base: random"
        raise InputError(where=f"model.base: {config.base}", found=problem, fix=fix)
    if file is not None:
        return _load_meta_file(file, encoder, config.sizes.model_sizes, dtype)
    check_sizes(read_sizes(path), config.sizes.model_sizes, where=f"model.base: {config.base}")
    return WorldModel.from_pretrained(path, dtype=dtype)


def base_sizes(config: ModelConfig) -> ModelSizes:
    """Return the sizes of the model that `load_base` would return, without reading weights.

    For an official `.pt`, or if the model does not exist yet, the sizes are those in `model.sizes`.

    Raises:
        InputError: The folder is not a world model; or `model.encoder` is not an encoder.
    """
    if config.encoder is not None:
        return get_expected_sizes(config.encoder, config.sizes.model_sizes)
    if config.is_random:
        return config.sizes.model_sizes
    exists = config.base.startswith(BUILTIN) or Path(config.base).exists()
    path = find_base(config.base) if exists else Path(config.base)
    return read_sizes(path) if path.is_dir() else config.sizes.model_sizes


def load_official(path: str | Path, sizes: ModelSizes | None = None, dtype: torch.dtype = torch.float32) -> WorldModel:
    """Load a world model from Meta's checkpoint. Every tensor must match, except a `pos_embed` of the encoder.

    The file is memory-mapped: in addition to the weights in `dtype`, memory contains only pages of the file, which the
    system can free. If the file contains several encoders, the first of `ENCODER_KEYS` is used, because Meta's code
    trains the predictor on `target_encoder`.

    Args:
        path: The `.pt` file.
        sizes: Sizes that the tensors do not determine: image size, heads, extrinsics. Every other size must be the
            default or equal the size of the tensors.
        dtype: Data type of the weights in memory.

    Raises:
        InputError: The file is missing, is truncated, has another format or contradicts the sizes, or a weight is not
            finite.
    """
    return _load_meta_file(MetaFile.open(Path(path)), None, sizes or ModelSizes(), dtype)


def to_official(model: WorldModel) -> dict[str, Any]:
    """Return the weights of a model in the format of Meta's checkpoint: with Meta's names, and q, k and v fused.

    Raises:
        InputError: Meta's code does not support the model's widths of states and actions, or a model without states.
        ValueError: The model has an adapter, which must be merged first.
    """
    if model.predictor is not model.base_predictor:
        raise ValueError("the model has an adapter: call merge_adapter first")
    if not model.sizes.predictor.use_states or get_model_widths(model.sizes) != POSE_WIDTHS:
        problem = f"a model with {describe_model_widths(model.sizes)}"
        needed = f"states and actions of {POSE_WIDTHS.state} numbers, the only widths that Meta's code supports"
        fix = "Export it with --to merged (WorldModel.save_pretrained); `model.base` accepts this format"
        raise InputError(where="the official format", found=problem, needed=needed, fix=fix)
    encoder = to_official_names(model.loaded_encoder.state_dict(), model.sizes.encoder.family)
    return {
        "encoder": encoder,
        "target_encoder": dict(encoder),
        "predictor": to_official_names(model.predictor.state_dict(), "predictor"),
        "epoch": 0,
    }


def _load_meta_file(
    file: MetaFile, encoder: EncoderSource | None, configured: ModelSizes, dtype: torch.dtype
) -> WorldModel:
    """Return a model with the predictor in a file, and with `encoder` or (if None) the encoder in the same file."""
    source = encoder or find_encoder_in_file(file, None, configured.encoder.frame, configured.encoder.heads)
    predictor = file.tensors("predictor")
    if "mask_tokens" in {name.partition(".")[0] for name in predictor} and "action_encoder.weight" not in predictor:
        problem = "a checkpoint of pre-training, whose predictor has no action input"
        fix = "Its encoder can be used: set model.encoder.path to this file, and model.base: random for a new"
        fix += " predictor (configs/scratch_vitb.yaml)"
        raise InputError(where=f"model.base: {file.path}", found=problem, fix=fix)
    model = _build_with_encoder(source, _merge_sizes(file, predictor, source, configured), dtype)
    load_weights(
        model.predictor,
        predictor,
        partial(to_official_name, part="predictor"),
        dtype,
        where=f"{file.path}: predictor",
        fix="Check model.base, model.sizes and model.encoder: a predictor belongs to one encoder",
    )
    logger.info("read %s: %s", file.path, model.sizes.model_dump())
    if encoder is None:
        model.encoder_origin = None  # the encoder and the predictor are from the same file
        return model
    if not model.sizes.predictor.use_states:
        logger.warning("%s: weights of a predictor without states. %s", file.path, _NON_COMMERCIAL)
    logger.warning(
        "%s does not record the encoder on which its predictor was trained. If it was not %s, the predictions are"
        " noise: compare the error of the first validation with persistence.",
        file.path,
        encoder.origin,
    )
    return model


def _build_with_encoder(source: EncoderSource, sizes: ModelSizes, dtype: torch.dtype) -> WorldModel:
    """Return a model with this encoder and with a predictor on the meta device, which has no weights yet."""
    model = WorldModel.empty(sizes)
    fix = f"Get the original file. {FIX}"
    load_weights(model.loaded_encoder, source.weights(), source.rename, dtype, where=source.where, fix=fix)
    if source.is_truncated:
        model.loaded_encoder.reset_last_norm()
    model.encoder_origin = source.origin
    return model


def _merge_sizes(
    file: MetaFile, predictor: Mapping[str, Tensor], encoder: EncoderSource, configured: ModelSizes
) -> ModelSizes:
    """Return the model sizes that the tensors determine; heads, image size and extrinsics are from `configured`."""
    predictor_config = configured.predictor
    try:
        width, hidden = len(predictor["action_encoder.weight"]), len(predictor["predictor_blocks.0.mlp.fc1.weight"])
        depth = count_blocks(predictor, "predictor_blocks")
    except KeyError as missing:
        raise file.missing_error(f"tensor {missing}", part="predictor") from None
    fields = {
        "image_size": configured.image_size,
        "patch_size": encoder.patch_size,
        "encoder": encoder.sizes.model_dump(),
        "predictor": {
            "width": width,
            "depth": depth,
            "heads": predictor_config.heads,
            "mlp_ratio": find_mlp_ratio(width, hidden, predictor_config.mlp_ratio),
            "use_extrinsics": predictor_config.use_extrinsics,
            "use_states": any(name.startswith("state_encoder.") for name in predictor),
        },
    }
    fix = "Set image size and heads in model.sizes: the tensors do not determine them"
    sizes = parse_record(ModelSizes, fields, where=str(file.path), needed="sizes that fit model.sizes", fix=fix)
    check_sizes(sizes, configured, where=str(file.path))
    return sizes


# ---- encoders ----


@dataclass(frozen=True, eq=False)
class EncoderSource:
    """An encoder in a file or folder, whose weights are not read yet."""

    where: str  # the file and key, for messages
    sizes: EncoderSizes
    patch_size: int
    image_size: int | None  # in the last phase of training; None if it is unknown
    origin: EncoderOrigin
    weights: Callable[[], Mapping[str, Tensor]]  # returns memory-mapped tensors by their names in the file
    rename: Rename
    is_truncated: bool = False  # whether the last blocks are removed; then the last norm has no trained weights

    def truncate(self, layer: int) -> EncoderSource:
        """Return the same encoder without the blocks after a layer.

        Raises:
            InputError: The encoder has fewer blocks than `layer`.
        """
        depth = self.sizes.depth
        if layer > depth:
            needed = f"at most {depth}, the number of blocks"
            raise InputError(where="model.encoder.layer", found=f"{layer}, for {self.where}", needed=needed)
        if layer == depth:
            return self

        def weights() -> dict[str, Tensor]:
            blocks = {name: (tensor, _BLOCK.search(name)) for name, tensor in self.weights().items()}
            return {name: tensor for name, (tensor, block) in blocks.items() if not block or int(block[1]) < layer}

        return replace(self, sizes=self.sizes.model_copy(update={"depth": layer}), weights=weights, is_truncated=True)


def find_encoder(config: EncoderConfig) -> EncoderSource:
    """Find the encoder of a config without reading the weights; an encoder on the Hub is downloaded first.

    Raises:
        InputError: The encoder does not exist, has another format, is damaged, or contradicts the config.
        UnreachableError: The Hub cannot be reached, and the repository is not in the local cache.
    """
    path = find_encoder_path(config.path)
    if path is not None and not path.is_dir():
        source = find_encoder_in_file(MetaFile.open(path), config.key, config.frame, config.heads)
    else:
        folder = path or download_from_hub(config.path, _HUB_PATTERNS, where=f"model.encoder.path: {config.path}")
        name = config.path if path is None else path.name
        source = _find_encoder_in_folder(folder, config, name=name)
    if config.heads not in {None, source.sizes.heads}:
        problem = f"{source.sizes.heads} attention heads, but model.encoder.heads is {config.heads}"
        raise InputError(where=source.where, found=problem, fix="Remove model.encoder.heads")
    return source if config.layer is None else source.truncate(config.layer)


def get_sizes_with_encoder(source: EncoderSource, configured: ModelSizes) -> ModelSizes:
    """Return the sizes of a model with this encoder, at the configured image size.

    Raises:
        InputError: The configured sizes contradict those of the file, or do not fit its patches, frame path or heads.
    """
    encoder_values = {"encoder": source.sizes.model_dump(), "patch_size": source.patch_size}
    sizes = parse_record(
        ModelSizes, configured.model_dump() | encoder_values, where=source.where, needed=ENCODER_NEEDED
    )
    check_sizes(sizes, configured, where=source.where)
    if source.image_size not in {None, configured.image_size}:
        logger.warning(
            "%s was trained with frames of %d px, but frames are encoded at %d px (image_size), where positions are"
            " untrained",
            source.origin, source.image_size, configured.image_size,
        )  # fmt: skip
    return sizes


def get_expected_sizes(config: EncoderConfig, configured: ModelSizes) -> ModelSizes:
    """Return the sizes of a model with this encoder, which may be a published file that is not downloaded yet.

    Raises:
        InputError: See `find_encoder`.
    """
    published = find_published_file(Path(config.path).name)
    if published is None or Path(config.path).exists():
        return get_sizes_with_encoder(find_encoder(config), configured)
    encoder = published.encoder.sizes(published.family, config.frame).model_dump()
    encoder["depth"] = min(encoder["depth"], config.layer or encoder["depth"])
    return parse_record(
        ModelSizes, configured.model_dump() | {"encoder": encoder}, where=f"model.encoder: {config.path}"
    )


def find_encoder_in_file(file: MetaFile, key: str | None, frame: FramePath, heads: int | None) -> EncoderSource:
    """Return the encoder in one of Meta's files.

    Args:
        file: The file.
        key: The key of the encoder; None: the first of `ENCODER_KEYS` in the file.
        frame: How a frame is encoded.
        heads: Number of attention heads; used only if no published encoder has the width of this encoder.

    Raises:
        InputError: The file has no such key, the value is not an encoder, or the number of heads is unknown.
    """
    available = [name for name in ENCODER_KEYS if name in file.parts]
    if key is None and available:
        key = available[0]
        logger.info("%s: using the encoder %s (available: %s)", file.path, key, ", ".join(available))
    if key not in available:
        fix = f"Set model.encoder.key to one of {', '.join(available)}, or remove it" if available else FIX
        raise file.missing_error(key or "encoder", fix)
    tensors = file.tensors(key)
    family: Family = "v2.1" if any(name.startswith(_V2_1_PREFIXES) for name in tensors) else "v2"
    try:
        width, *_, patch_size = tensors["patch_embed.proj.weight"].shape
        hidden, depth = tensors["blocks.0.mlp.fc1.weight"].shape[0], count_blocks(tensors, "blocks")
    except (KeyError, ValueError) as missing:
        raise file.missing_error(f"tensor {missing}", part=key) from None
    heads = PUBLISHED_HEADS.get(width, heads)
    if heads is None:
        problem = f"an encoder of width {width}, which no published encoder has: its number of heads is unknown"
        fix = "Set model.encoder.heads to the number used in training; a wrong number gives wrong latents, not an error"
        raise InputError(where=str(file.path), found=problem, fix=fix)
    published = find_published_file(file.path.name)
    return EncoderSource(
        where=f"{file.path}: {key}",
        sizes=EncoderSizes(
            width=width,
            depth=depth,
            heads=heads,
            mlp_ratio=find_mlp_ratio(width, hidden, EncoderSizes().mlp_ratio),
            family=family,
            frame=frame,
        ),
        patch_size=patch_size,
        image_size=published.image_size if published else None,
        origin=EncoderOrigin(file.path.name, key, published.licence if published else ""),
        weights=lambda: tensors,
        rename=partial(to_official_name, part=family),
    )


class _TransformersConfig(BaseModel):
    """The config.json of a V-JEPA 2 model of transformers: the fields that are read, with the supported values."""

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


def _find_encoder_in_folder(folder: Path, config: EncoderConfig, *, name: str) -> EncoderSource:
    """Return the encoder in a folder of transformers or of this project; `name` is stored as its origin."""
    card = read_json_object(folder / CONFIG, needed=ENCODER_NEEDED, fix=FIX)
    if config.key is not None:
        problem = f"{name} is a folder, which contains only one encoder"
        raise InputError(where=f"model.encoder.key: {config.key}", found=problem, fix="Remove model.encoder.key")
    if card.get("format") != FORMAT:
        return _find_transformers_encoder(folder, card, config.frame, name)
    model = read_sizes(folder)
    return EncoderSource(
        where=str(folder / ENCODER),
        sizes=model.encoder.model_copy(update={"frame": config.frame}),
        patch_size=model.patch_size,
        image_size=model.image_size,
        origin=read_encoder_origin(folder)
        or EncoderOrigin(name, has_heads_in_fingerprint=False),  # keeps the fingerprint of the model in the folder
        weights=partial(_map_safetensors, [folder / ENCODER]),
        rename=lambda ours: (ours, None),
    )


def _find_transformers_encoder(folder: Path, card: Mapping[str, Any], frame: FramePath, name: str) -> EncoderSource:
    """Return the encoder of a plain or a classification model of transformers; other parts are ignored."""
    fields = parse_record(_TransformersConfig, card, where=str(folder / CONFIG), needed=ENCODER_NEEDED, fix=FIX)
    tensors = _map_safetensors(sorted(folder.glob("*.safetensors")))
    prefix = next((text for text in _HUB_PREFIXES if any(name.startswith(text) for name in tensors)), None)
    if prefix is None:
        problem = "no tensor of an encoder in *.safetensors"
        raise InputError(where=str(folder), found=problem, needed=ENCODER_NEEDED, fix=FIX)
    return EncoderSource(
        where=str(folder),
        sizes=EncoderSizes(
            width=fields.hidden_size,
            depth=fields.num_hidden_layers,
            heads=fields.num_attention_heads,
            mlp_ratio=fields.mlp_ratio,
            frame=frame,
        ),
        patch_size=fields.patch_size,
        image_size=fields.crop_size,
        origin=EncoderOrigin(name),
        weights=lambda: {key: value for key, value in tensors.items() if key.startswith(prefix)},
        rename=lambda ours: (prefix + ours.removeprefix("vit."), None),
    )


def _map_safetensors(files: list[Path]) -> dict[str, Tensor]:
    """Return the memory-mapped tensors of safetensors files; values are read on use."""
    tensors: dict[str, Tensor] = {}
    for path in files:
        with open_safetensors(path, needed=ENCODER_NEEDED) as file:
            tensors |= {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # safetensors' file has no iterator
    return tensors


# ---- Meta's files ----


@dataclass(frozen=True)
class MetaFile:
    """A memory-mapped checkpoint of Meta."""

    path: Path
    parts: Mapping[str, Any]  # the values in the file (weights, optimizer state, epoch) by their keys

    @classmethod
    def open(cls, path: Path) -> MetaFile:
        """Memory-map a file, without reading tensor values or executing code.

        Raises:
            InputError: The file does not exist, has another format, is truncated, or is a git-lfs pointer or a pipe.
            UnreachableError: The file cannot be read.
        """
        with storage.translate_read_errors(path, needed=_NEEDED, fix=FIX):
            try:
                content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
            except Exception as error:  # a damaged pickle can raise any type of error
                if storage.is_os_read_error(error):
                    raise
                problem, fix = _describe_unreadable_file(path, error)
                raise InputError(where=str(path), found=problem, needed=_NEEDED, fix=fix) from None
        if not isinstance(content, dict):
            raise InputError(where=str(path), found=f"a {type(content).__name__}", needed=_NEEDED, fix=FIX)
        return cls(path, {str(key): value for key, value in content.items()})

    def tensors(self, key: str) -> dict[str, Tensor]:
        """Return the tensors of a part by Meta's names, without the prefixes of wrappers.

        Raises:
            InputError: The part does not exist, is empty, or contains other values than tensors.
        """
        part = self.parts.get(key)
        if not isinstance(part, dict) or not part or not all(isinstance(value, Tensor) for value in part.values()):
            raise self.missing_error(key if key not in self.parts else f"weights under {key!r}")
        tensors = {_PREFIXES.sub("", str(name)): value for name, value in part.items()}
        tensors.pop(_UNUSED, None)
        require_floats(tensors, where=f"{self.path}: {key}", fix=FIX)
        return tensors

    def missing_error(self, name: str, fix: str = FIX, *, part: str | None = None) -> InputError:
        """Return the error for a missing part, or a missing tensor in `part`; its message lists existing names."""
        names = ", ".join(list(self.parts if part is None else self.tensors(part))[:8])
        problem = f"no {name} (keys: {names})" if part is None else f"no {name} in {part} (its tensors: {names})"
        return InputError(where=str(self.path), found=problem, needed=_PARTS, fix=fix)


def to_official_name(name: str, part: Part) -> tuple[str, int | None]:
    """Return Meta's name of one of this project's tensors, and its index in a fused tensor; see `Rename`."""
    for pattern, replacement in _NAMES[part]:
        name = re.sub(pattern, replacement, name)
    fused = re.sub(r"\.attn\.[qkv]\.", ".attn.qkv.", name)
    return fused, None if fused == name else _FUSED.index(name.split(".attn.")[1][0])


def load_weights(
    network: nn.Module, weights: Mapping[str, Tensor], rename: Rename, dtype: torch.dtype, *, where: str, fix: str
) -> None:
    """Load memory-mapped weights into a network on the meta device, cast each tensor when it is read, and freeze it.

    Raises:
        InputError: A tensor is missing or unknown or has another shape, or a weight is not finite.
    """
    state = network.state_dict()
    names = {name: rename(name) for name in state}
    expected_shapes = {
        file_name: state[name].shape if index is None else (3 * len(state[name]), *state[name].shape[1:])
        for name, (file_name, index) in names.items()
    }
    check_tensors({name: value.shape for name, value in weights.items()}, expected_shapes, where=where, fix=fix)
    require_floats(weights, where=where, fix=fix)
    for name, (file_name, index) in names.items():
        value = weights[file_name] if index is None else weights[file_name].chunk(3)[index]
        state[name] = value.to(dtype, copy=True)
    require_finite(state, where=where, fix=fix)
    network.load_state_dict(state, assign=True)
    network.requires_grad_(False)


def to_official_names(weights: Mapping[str, Tensor], part: Part) -> dict[str, Tensor]:
    """Return weights of this project with Meta's names, and with q, k and v fused."""
    parts_by_name: dict[str, list[Tensor]] = {}
    for name, value in weights.items():  # every state_dict of this project has q, k and v of a layer in this order
        parts_by_name.setdefault(to_official_name(name, part)[0], []).append(value.detach())
    return {
        f"module.{name}": parts[0] if len(parts) == 1 else torch.cat(parts) for name, parts in parts_by_name.items()
    }


def count_blocks(names: Mapping[str, object], blocks: str) -> int:
    """Return the number of blocks that have tensors.

    Raises:
        KeyError: No block has tensors.
    """
    numbers = [int(name.split(".")[1]) for name in names if re.match(rf"{blocks}\.\d{{1,6}}\.", name)]
    if not numbers:
        raise KeyError(f"{blocks}.0")
    return 1 + max(numbers)


def _describe_unreadable_file(path: Path, error: Exception) -> tuple[str, str]:
    """Return a description (with the first bytes) of a file that torch could not load, and the fix."""
    blocked = re.search(r"GLOBAL ([\w.]+)", str(error))
    if blocked:
        problem = f"a pickle that would call {blocked[1]}, which could execute code; it was not loaded"
        old, new, keys = map(
            json.dumps, (str(path), str(path.with_suffix(".weights.pt")), [*ENCODER_KEYS, "predictor"])
        )
        code = f'import torch; old = torch.load({old}, map_location="cpu", weights_only=False)'
        code += f"; torch.save({{key: old[key] for key in {keys} if key in old}}, {new})"
        return problem, f"If you trust the file, extract its weights: `python -c {shlex.quote(code)}`"
    with path.open("rb") as file:
        first_bytes = file.read(24)
    reason = next(iter(str(error).splitlines()), type(error).__name__)[:120]
    size = path.stat().st_size / 1e9
    problem = f"{size:.2f} GB, beginning with {first_bytes!r}, that torch cannot read ({reason})"
    return f"{problem}: truncated, or another format", FIX
