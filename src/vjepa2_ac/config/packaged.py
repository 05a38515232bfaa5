"""The configs that come with the package, by name: `builtin:demo`."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

from vjepa2_ac.errors import InputError
from vjepa2_ac.places import BUILTIN

_FOLDER = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets" / "configs"


def packaged_configs() -> dict[str, str]:
    """Return the first sentence of each config that comes with the package, by name."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(_FOLDER.glob("*.yaml"))}
    heads = {name: _comment_at_the_top(text) for name, text in texts.items()}
    return {name: head.split(". ")[0].rstrip(".:") for name, head in heads.items()}


def config_path(name: str | Path) -> Path:
    """Return the file of a config: of `builtin:NAME` that of the package, else the path itself.

    Raises:
        InputError: The package has no config of that name.
    """
    if not str(name).startswith(BUILTIN):
        return Path(name)
    path = _FOLDER / f"{str(name).removeprefix(BUILTIN)}.yaml"
    if path.parent != _FOLDER or not path.is_file():
        known = ", ".join(f"{BUILTIN}{one}" for one in packaged_configs())
        raise InputError(
            where=str(name), found="no config of that name comes with the package", needed=f"one of {known}"
        )
    return path


def _comment_at_the_top(text: str) -> str:
    lines = text.splitlines()
    end = next((place for place, line in enumerate(lines) if not line.startswith("#")), len(lines))
    return " ".join(line.removeprefix("#").strip() for line in lines[:end])
