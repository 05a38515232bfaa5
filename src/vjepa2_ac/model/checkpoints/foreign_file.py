"""Identification of files that are no checkpoints, by their first bytes; nothing in them is executed."""

from __future__ import annotations

import io
import pickletools
import re
from pathlib import Path

_HEAD_BYTES = 1 << 16
_FROM_GLOBAL = re.compile(r"GLOBAL ([\w.]+)")
_KNOWN = ("torch", "collections", "numpy", "_codecs")  # what plain tensors name
_HEADS = (
    (b"\x1f\x8b", "a gzip archive"),
    (b"version https://git-lfs", "a pointer of Git LFS, in place of the file itself"),
    (b"\x89HDF", "an HDF5 file"),
    (b"<", "a web page, or XML"),
)


def foreign_kind(path: Path, error: Exception) -> str | None:
    """Return the kind of a file that torch could not read; None if it may be a damaged checkpoint.

    Args:
        path: The file.
        error: torch's error.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        return "an empty file"
    name = _FROM_GLOBAL.search(str(error))
    if name is None and head[:1] == b"\x80":
        return _kind_of_pickle(head)
    if name is not None:
        return _refused(name[1])
    if head[8:10] == b'{"':
        return "a safetensors file"
    known = next((kind for start, kind in _HEADS if head.startswith(start)), None)
    return known or _kind_of_text(path, head)


def _kind_of_pickle(head: bytes) -> str:
    """Inspect the names in a pickle without loading it."""
    names = [name for name in _names_in(head) if name.split(".")[0] not in _KNOWN]
    return _refused(names[0]) if names else "a pickle, or a file of an old version of torch.save"


def _names_in(pickles: bytes) -> list[str]:
    """Return the imports of consecutive pickles, up to the first that cannot be read."""
    names, texts, file = [], [""], io.BytesIO(pickles)
    try:
        while file.tell() < len(pickles):
            for opcode, argument, _ in pickletools.genops(file):
                if opcode.name in {"GLOBAL", "INST"}:
                    names.append(str(argument).replace(" ", "."))
                elif opcode.name == "STACK_GLOBAL":
                    names.append(".".join(texts[-2:]))
                elif isinstance(argument, str):
                    texts.append(argument)
    except Exception:  # noqa: S110 - it is cut off, or no pickle
        pass
    return names


def _refused(name: str) -> str:
    return f"a pickle that would call {name}: it was refused, since loading it could run foreign code"


def _kind_of_text(path: Path, head: bytes) -> str | None:
    try:
        head[: _HEAD_BYTES - 4].decode()
    except UnicodeDecodeError:
        return None
    if b"\0" in head:
        return None
    is_yaml = path.suffix in {".yaml", ".yml"}
    return "a YAML file, such as a config" if is_yaml else "a text file"
