"""The scripts that come with the package and make a readable data set of another one."""

from __future__ import annotations

import ast
import importlib.resources
from pathlib import Path

from vjepa2_ac.errors import InputError

_FOLDER = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets" / "convert"


def converters() -> dict[str, str]:
    """Return what each converter makes of what, by its name."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(_FOLDER.glob("*.py"))}
    return {name: (ast.get_docstring(ast.parse(text)) or "").split("\n\n")[0] for name, text in texts.items()}


def converter_text(name: str) -> str:
    """Return a converter, whole.

    Raises:
        InputError: There is none of that name.
    """
    if name not in converters():
        needed = f"one of {', '.join(converters())}"
        raise InputError(where="command line", found=f"no converter {name}", needed=needed)
    return (_FOLDER / f"{name}.py").read_text(encoding="utf-8")


def way_by(name: str) -> str:
    """Return the line that begins with a converter."""
    return f"`vjepa2-ac data converter {name} > {name}.py`, then `python {name}.py --help`"
