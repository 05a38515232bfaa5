"""The folder of a world model: config.json, encoder.safetensors and predictor/ as transformers writes it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from vjepa2_ac import storage
from vjepa2_ac.config import ModelSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.finite import require_finite
from vjepa2_ac.storage.structured import message_of, read_json_object

FORMAT = "vjepa2-ac world model 1"
CONFIG, ENCODER, PREDICTOR = "config.json", "encoder.safetensors", "predictor/model.safetensors"


def write_folder(folder: Path, sizes: ModelSizes, encoder: nn.Module, predictor: Any) -> None:
    """Write a model to a temporary folder, then move it, config.json last: a folder that has one is complete.

    Args:
        folder: Where the model goes; an existing one is replaced.
        sizes: Sizes of the model.
        encoder: The encoder.
        predictor: The predictor: a transformers model.

    Raises:
        InputError: The folder cannot be created or written, or the disk is full.
    """
    with storage.folder_writer(folder, CONFIG) as fresh:
        (fresh / PREDICTOR).parent.mkdir()
        try:
            save_file(_whole(encoder), fresh / ENCODER, metadata={"format": "pt"})
            save_file(_whole(predictor), fresh / PREDICTOR, metadata={"format": "pt"})
        except SafetensorError as error:  # which is no OSError, even if the disk is full
            raise InputError(where=str(folder), found=f"cannot be written: {error}") from None
        predictor.config.architectures = [type(predictor).__name__]
        predictor.config.save_pretrained(fresh / "predictor")
        card = {"format": FORMAT, "sizes": sizes.model_dump(mode="json")}
        (fresh / CONFIG).write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def read_sizes(folder: Path) -> ModelSizes:
    """Read the sizes of the model in a folder.

    Raises:
        InputError: The folder is not a world model.
    """
    where = str(folder / CONFIG)
    needed = "a folder written by `vjepa2-ac export` or WorldModel.save_pretrained"
    fix = "Of a run, `vjepa2-ac export RUN FOLDER` makes one"
    try:
        card = read_json_object(folder / CONFIG, needed=needed, fix=fix)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(where=where, found="no such file", needed=needed, fix=fix) from None
    except OSError as error:
        raise InputError(where=where, found=f"cannot be read ({error})", needed=needed, fix=fix) from None
    if card.get("format") != FORMAT:
        raise InputError(where=where, found="not the config of a world model", needed=needed, fix=fix)
    try:
        return ModelSizes.model_validate_json(json.dumps(card.get("sizes")))
    except ValidationError as error:
        said = [f"{'.'.join(map(str, ('sizes', *one['loc'])))}: {message_of(one)}" for one in error.errors()[:4]]
        raise InputError(where=where, found="; ".join(said), needed=needed, fix=fix) from None


def load_safetensors(module: nn.Module, path: Path, dtype: torch.dtype | None) -> None:
    """Fill a module (which may be on the meta device) from a file, every name and shape matched.

    Raises:
        InputError: The file is missing or damaged, its tensors are not those of the module, or one is not finite.
    """
    needed = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    with opened_safetensors(path, needed="the weights of a world model") as file:
        check_tensors(shapes_of(file), needed, where=str(path))
        weights = {name: _cast(file.get_tensor(name), dtype) for name in needed}
    require_finite(weights, where=str(path), fix="Copy or write the folder again")
    frozen = {name: value.requires_grad for name, value in module.named_parameters()}
    module.load_state_dict(weights, strict=True, assign=True)
    for name, value in module.named_parameters():
        value.requires_grad_(frozen[name])


@contextmanager
def opened_safetensors(path: Path, *, needed: str) -> Iterator[Any]:
    """Open a safetensors file; its header is checked against its size, and its tensors are mapped, not read.

    Raises:
        InputError: The file is missing, truncated, or of another format.
    """
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except FileNotFoundError:
        fix = "Copy or write the folder again"
        raise InputError(where=str(path), found="no such file", needed=needed, fix=fix) from None
    except (SafetensorError, OSError, TypeError) as error:  # the last: of a type that torch does not have
        found = f"not a whole safetensors file ({error})"
        raise InputError(where=str(path), found=found, fix="Copy or write it again") from None


def shapes_of(file: Any) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the tensors in an open safetensors file."""
    return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118  # no iterator


def check_tensors(found: dict[str, tuple[int, ...]], needed: dict[str, tuple[int, ...]], *, where: str) -> None:
    """Refuse tensors that are missing, unknown or of another shape, and name some of them.

    Raises:
        InputError: Any of these.
    """
    problems = [f"missing: {name}" for name in needed.keys() - found.keys()]
    problems += [f"unknown: {name}" for name in found.keys() - needed.keys()]
    problems += [
        f"{name} is {list(found[name])}, not {list(needed[name])}"
        for name in needed.keys() & found.keys()
        if found[name] != needed[name]
    ]
    if problems:
        shown = "; ".join(sorted(problems)[:4]) + (f"; and {len(problems) - 4} more" if len(problems) > 4 else "")
        raise InputError(
            where=where,
            found=f"{len(problems)} tensors do not fit ({shown})",
            needed="every tensor of the model, and no other",
            fix="Check model.base and model.sizes",
        )


def check_sizes(found: ModelSizes, given: ModelSizes, *, where: str) -> None:
    """Refuse given sizes that differ from the model's.

    Only those other than the default count as given: a run's own config spells out every default.

    Raises:
        InputError: Names what differs.
    """
    actual, wanted, standard = _flat(found), _flat(given), _flat(ModelSizes())
    wrong = [key for key in actual if wanted[key] not in (actual[key], standard[key])]
    if wrong:
        raise InputError(
            where=where,
            found=", ".join(f"{key} {actual[key]}" for key in wrong),
            needed=", ".join(f"{key} {wanted[key]}" for key in wrong) + ", as model.sizes says",
            fix="Leave them out of model.sizes: the model tells",
        )


def _flat(sizes: ModelSizes) -> dict[str, Any]:
    nested = sizes.model_dump()
    flat = {f"{part}.{key}": value for part in ("encoder", "predictor") for key, value in nested.pop(part).items()}
    return nested | flat


def _whole(module: nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.detach().contiguous() for name, value in module.state_dict().items()}


def _cast(tensor: torch.Tensor, dtype: torch.dtype | None) -> torch.Tensor:
    # A copy in memory: the file may be replaced while the model is in use.
    return tensor.to(dtype or tensor.dtype, copy=True)
