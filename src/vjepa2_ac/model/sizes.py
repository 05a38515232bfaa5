"""The sizes of a world model: as its folder says, without reading a weight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vjepa2_ac.config import ModelSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import message_of, read_json_object

FORMAT = "vjepa2-ac world model 1"
CONFIG = "config.json"


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
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        found = "no such file" if is_missing else f"cannot be read ({error})"
        raise InputError(where=where, found=found, needed=needed, fix=fix) from None
    if card.get("format") != FORMAT:
        raise InputError(where=where, found="not the config of a world model", needed=needed, fix=fix)
    try:
        return ModelSizes.model_validate_json(json.dumps(card.get("sizes")))
    except ValidationError as error:
        said = [f"{'.'.join(map(str, ('sizes', *one['loc'])))}: {message_of(one)}" for one in error.errors()[:4]]
        raise InputError(where=where, found="; ".join(said), needed=needed, fix=fix) from None


def check_sizes(found: ModelSizes, given: ModelSizes, *, where: str) -> None:
    """Refuse sizes that were given, and are not those of the model.

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
