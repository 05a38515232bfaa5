"""Manifest of a folder: the SHA-256 of every file, to verify that none has changed since it was written."""

from __future__ import annotations

import json
from collections.abc import Set
from pathlib import Path, PurePosixPath

from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import read_bounded, sha256_of_file, sync
from vjepa2_ac.storage.structured import MOST_BYTES as _MOST_BYTES
from vjepa2_ac.storage.structured import json_object, shown

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
    """Return what is wrong with a sealed folder, or None if every file matches the manifest.

    Args:
        folder: The folder. Files that the manifest does not name are ignored.
        needed: Files that the manifest must name.
    """
    try:
        files = named_files(read_bounded(folder / MANIFEST, _MOST_BYTES))
        if absent := needed - files.keys():
            return f"{MANIFEST} does not name {', '.join(sorted(absent))}"
        for name, digest in files.items():
            if not (folder / name).resolve().is_relative_to(folder.resolve()):
                return f"{MANIFEST} names {name}, which is outside"
            if not (folder / name).is_file():
                return f"{name} is missing"
            if sha256_of_file(folder / name) != digest:
                return f"{name} is damaged (its SHA-256 is not the manifest's)"
    except InputError as error:
        return f"no readable {MANIFEST} ({error.found})"
    except OSError as error:
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
