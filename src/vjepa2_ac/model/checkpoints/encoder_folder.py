"""An encoder from a folder: of transformers, as the Hub has them, or of a model of this project."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError
from safetensors import SafetensorError, safe_open
from torch import Tensor

from vjepa2_ac.config import EncoderSizes
from vjepa2_ac.config.model import Depth, EncoderConfig, Heads, Ratio, Width
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.encoder_file import FoundEncoder, with_frame_path
from vjepa2_ac.model.checkpoints.meta_file import Shapes
from vjepa2_ac.model.network.encoder_origin import EncoderOrigin
from vjepa2_ac.model.network.pretrained_folder import ENCODER, read_encoder_origin
from vjepa2_ac.model.sizes import CONFIG, FORMAT, read_sizes
from vjepa2_ac.storage.structured import message_of, read_json_object

_PREFIXES = ("vjepa2.encoder.", "encoder.")  # of a classification model, of a plain one

WEIGHTS, INDEX = "model.safetensors", "model.safetensors.index.json"

_NEEDED = "a V-JEPA 2 model as transformers saves it, or a model of this project"
_FIX = "Get the folder again; the Hub has them as hf://facebook/vjepa2-vitl-fpc64-256, for example"


def encoder_in_folder(folder: Path, config: EncoderConfig, *, name: str) -> FoundEncoder:
    """Return the encoder in a folder.

    Args:
        folder: The folder.
        config: Frame path and heads.
        name: What the user called it.

    Raises:
        InputError: It is no such folder, is incomplete, or its config contradicts its tensors or the user's.
    """
    card = _config_of(folder)
    _refuse_key(config, name)
    if card.get("format") == FORMAT:
        return _of_this_project(folder, config, name)
    if card.get("model_type") != "vjepa2":
        found = f"a model of type {card.get('model_type')!r}"
        raise InputError(where=str(folder / CONFIG), found=found, needed=_NEEDED, fix=_FIX)
    return _of_transformers(folder, card, config, name)


def _config_of(folder: Path) -> dict[str, Any]:
    try:
        return read_json_object(folder / CONFIG, needed=_NEEDED, fix=_FIX)
    except OSError as error:
        found = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error})"
        raise InputError(where=str(folder / CONFIG), found=found, needed=_NEEDED, fix=_FIX) from None


def _refuse_key(config: EncoderConfig, name: str) -> None:
    if config.key is not None:
        raise InputError(
            where=f"model.encoder.key: {config.key}",
            found=f"{name}, a folder, which holds one encoder",
            needed="no key: keys are of Meta's .pt files",
            fix="Leave it out",
        )


def _of_this_project(folder: Path, config: EncoderConfig, name: str) -> FoundEncoder:
    model, where = read_sizes(folder), str(folder / ENCODER)
    _require_heads(config, model.encoder.heads, where=str(folder / CONFIG))
    stored = _Stored.of({folder / ENCODER: None})
    return FoundEncoder(
        where=where,
        sizes=with_frame_path(model.encoder, config.frame, where=where),
        patch_size=model.patch_size,
        image_size=model.image_size,
        origin=read_encoder_origin(folder) or EncoderOrigin(name, heads_are_told=False),  # so it stays the same encoder
        shapes=stored.shapes,
        needed=dict,
        read=lambda names: stored.read({one: one for one in names}),
    )


def _of_transformers(folder: Path, card: Mapping[str, Any], config: EncoderConfig, name: str) -> FoundEncoder:
    """Return the encoder of a plain or a classification model; its masked predictor and its head are left alone."""
    told, where = _told_by(card, where=str(folder / CONFIG)), str(folder)
    _require_heads(config, told.num_attention_heads, where=str(folder / CONFIG))
    stored = _Stored.of(_weight_files(folder))
    prefix = next((one for one in _PREFIXES if any(tensor.startswith(one) for tensor in stored.shapes)), None)
    if prefix is None:
        raise InputError(where=where, found="no tensor of an encoder", needed=_NEEDED, fix=_FIX)
    sizes = EncoderSizes(
        width=told.hidden_size,
        depth=told.num_hidden_layers,
        heads=told.num_attention_heads,
        mlp_ratio=told.mlp_ratio,
    )
    return FoundEncoder(
        where=where,
        sizes=with_frame_path(sizes, config.frame, where=where),
        patch_size=told.patch_size,
        image_size=told.crop_size,
        origin=EncoderOrigin(name),
        shapes={one: shape for one, shape in stored.shapes.items() if one.startswith(prefix)},
        needed=lambda ours: {_in_transformers(one, prefix): shape for one, shape in ours.items()},
        read=lambda names: stored.read({one: _in_transformers(one, prefix) for one in names}),
    )


def _in_transformers(name: str, prefix: str) -> str:
    return prefix + name.removeprefix("vit.")


def _require_heads(config: EncoderConfig, heads: int, *, where: str) -> None:
    if config.heads not in {None, heads}:
        needed = f"{config.heads}, as model.encoder.heads says"
        fix = "Leave out model.encoder.heads: the folder tells"
        raise InputError(where=where, found=f"{heads} attention heads", needed=needed, fix=fix)


class _Told(BaseModel):
    """What the config.json of a V-JEPA 2 model says; only what this project computes is taken."""

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


def _told_by(card: Mapping[str, Any], *, where: str) -> _Told:
    try:
        return _Told.model_validate(dict(card))
    except ValidationError as error:
        said = "; ".join(f"{'.'.join(map(str, one['loc']))}: {message_of(one)}" for one in error.errors()[:4])
        raise InputError(where=where, found=said, needed=_NEEDED, fix=_FIX) from None


def _weight_files(folder: Path) -> dict[Path, list[str] | None]:
    """Return the files with weights, and which tensors are read from each (None: all)."""
    if not (folder / INDEX).is_file():
        return {folder / WEIGHTS: None}
    listed = read_json_object(folder / INDEX, needed=_NEEDED, fix=_FIX).get("weight_map")
    if not isinstance(listed, dict) or not all(
        isinstance(one, str) and Path(one).name == one for one in listed.values()
    ):
        raise InputError(where=str(folder / INDEX), found="no list of files beside it", needed=_NEEDED, fix=_FIX)
    files: dict[Path, list[str] | None] = {}
    for tensor, file in listed.items():
        files.setdefault(folder / file, []).append(tensor)  # type: ignore[union-attr]  # lists only
    return files


@dataclass(frozen=True, eq=False)
class _Stored:
    """The tensors of some safetensors files."""

    file_of: Mapping[str, Path]
    shapes: Shapes

    @classmethod
    def of(cls, files: Mapping[Path, list[str] | None]) -> _Stored:
        """Read the headers.

        Raises:
            InputError: A file is missing or damaged, or lacks a tensor.
        """
        file_of: dict[str, Path] = {}
        shapes: Shapes = {}
        for path, wanted in files.items():
            with _opened(path) as file:
                for name in wanted if wanted is not None else file.keys():
                    file_of[name], shapes[name] = path, tuple(file.get_slice(name).get_shape())
        return cls(file_of, shapes)

    def read(self, names: Mapping[str, str]) -> dict[str, Tensor]:
        """Return tensors by our names.

        Args:
            names: Ours -> the file's.
        """
        found: dict[str, Tensor] = {}
        for path in dict.fromkeys(self.file_of[name] for name in names.values()):
            with _opened(path) as file:
                found |= {ours: file.get_tensor(name) for ours, name in names.items() if self.file_of[name] == path}
        return {ours: found[ours] for ours in names}


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except FileNotFoundError:
        raise InputError(where=str(path), found="no such file", needed=_NEEDED, fix=_FIX) from None
    except (SafetensorError, OSError, TypeError) as error:  # the last: of a type that torch does not have
        raise InputError(where=str(path), found=f"not a whole safetensors file ({error})", fix=_FIX) from None
