"""Files of checkpoints: tensors, and the manifest by which a folder is known to be as it was written.

Neither trusts what it reads: a checkpoint may come from elsewhere.
"""

from __future__ import annotations

import json
import pickle
import zipfile
from collections.abc import Set
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import read_bounded, sha256_of_file, sync
from vjepa2_ac.storage.structured import MOST_BYTES, json_object, shown

MANIFEST = "manifest.json"


def write_manifest(folder: Path) -> None:
    """Flush every file of a folder to the disk, then write the manifest.

    Raises:
        OSError: The folder cannot be read or written.
    """
    manifest = folder / MANIFEST
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != manifest)
    digests = {}
    for path in files:
        sync(path)
        digests[str(path.relative_to(folder))] = sha256_of_file(path)
    for inner in {path.parent for path in files} - {folder}:
        sync(inner)
    manifest.write_text(json.dumps({"files": digests}, indent=1))
    sync(manifest)
    sync(folder)


def verify_manifest(folder: Path, needed: Set[str]) -> str | None:
    """Return what is wrong with a folder, or None if every file matches the manifest.

    Args:
        folder: The folder. Files that the manifest does not name are ignored.
        needed: Files that the manifest must name.
    """
    try:
        files = named_files(read_bounded(folder / MANIFEST, MOST_BYTES))
        if absent := needed - files.keys():
            return f"{MANIFEST} does not name {', '.join(sorted(absent))}"
        for name, digest in files.items():
            if not (folder / name).is_file():
                return f"{name} is missing"
            if sha256_of_file(folder / name) != digest:
                return f"{name} is damaged (its SHA-256 is not the manifest's)"
    except (InputError, OSError) as error:
        return f"no readable {MANIFEST} ({error})"
    return None


def named_files(manifest: bytes) -> dict[str, str]:
    """Return the files that a manifest names, in its own folder, with the SHA-256 of each.

    Raises:
        InputError: It is no manifest, or names a file elsewhere.
    """
    files = json_object(manifest, where=MANIFEST).get("files")
    if not isinstance(files, dict) or not all(isinstance(digest, str) for digest in files.values()):
        raise InputError(where=MANIFEST, found=f"files {shown(files)}", needed="the SHA-256 of each file, by its name")
    for name in files:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or not path.parts or str(path) != name:
            raise InputError(where=MANIFEST, found=f"it names {name}, which is outside", needed="files beside it")
    return files


def write_torch(value: object, file: BinaryIO) -> None:
    """Write tensors and plain values.

    Raises:
        OSError: The disk is full, or another system error, which torch itself would hide.
    """
    import torch  # checkpoints are listed without it

    try:
        torch.save(value, file)
    except RuntimeError as error:
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


def read_torch(path: Path) -> Any:
    """Return the tensors and plain values of a file, on the CPU. Nothing in it is executed.

    Raises:
        InputError: The file cannot be read, or contains more than tensors and plain values.
    """
    import torch

    try:
        _require_as_written(path)
        return torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # of a damaged file torch raises anything
        found = f"cannot be read ({error})"
        if isinstance(error, pickle.UnpicklingError):
            found = "more than tensors and plain values: such a file can run foreign code"
        raise InputError(where=str(path), found=found, needed="a file that this program wrote") from None


def _require_as_written(path: Path) -> None:
    """Refuse other formats that torch reads, too: a small file of these may take any memory.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no zip archive, or its parts are compressed.
    """
    with zipfile.ZipFile(path) as archive:
        if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
            raise ValueError("its parts are compressed")
