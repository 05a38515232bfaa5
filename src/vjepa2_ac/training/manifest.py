"""Is every file of a folder what it was when it was written? A manifest with the SHA-256 of each tells."""

from __future__ import annotations

import json
from collections.abc import Set
from pathlib import Path

from vjepa2_ac.storage import sha256_of_file, sync

MANIFEST = "manifest.json"


def seal(folder: Path) -> None:
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


def broken_seal(folder: Path, needed: Set[str]) -> str | None:
    """Return what is wrong with a sealed folder, or None when every file is what the manifest says.

    Args:
        folder: The folder. Files that the manifest does not name are nobody's matter.
        needed: Files that the manifest must name.
    """
    try:
        files = json.loads((folder / MANIFEST).read_text())["files"]
        if absent := needed - files.keys():
            return f"{MANIFEST} does not name {', '.join(sorted(absent))}"
        for name, digest in files.items():
            if not (folder / name).resolve().is_relative_to(folder.resolve()):
                return f"{MANIFEST} names {name}, which is outside"
            if not (folder / name).is_file():
                return f"{name} is missing"
            if sha256_of_file(folder / name) != digest:
                return f"{name} is damaged (its SHA-256 is not the manifest's)"
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        return f"no readable {MANIFEST} ({error})"
    return None
