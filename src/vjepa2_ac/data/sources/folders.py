"""Which files lie in a folder and the folders below it, here or behind a URL?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from vjepa2_ac import storage
from vjepa2_ac.storage import FileInfo

DEEPEST = 8  # folders below the data set's: a link that leads back up is not followed for ever

Item = TypeVar("Item")
Result = TypeVar("Result")


def walk(root: str, connections: int) -> Iterator[tuple[str, FileInfo]]:
    """Yield all files, with their folder relative to `root`; names that begin with a dot are left out.

    Raises:
        OSError: A folder cannot be listed.
    """
    folders = [""]
    for _ in range(DEEPEST):
        below: list[str] = []
        for folder, (files, names) in zip(
            folders, in_parallel(lambda folder: list_folder(root, folder), folders, connections), strict=True
        ):
            yield from ((folder, file) for file in files if not file.name.startswith("."))
            below += [within(folder, name) for name in names]
        folders = below


def list_folder(root: str, folder: str) -> tuple[list[FileInfo], list[str]]:
    """Return the files of a folder, and the names of the folders in it but for hidden ones.

    Raises:
        OSError: It cannot be listed.
    """
    place = storage.join(root, folder) if folder else root
    files = storage.list_files(place)
    known = {file.name for file in files}
    return files, [name for name in storage.list_names(place) if name not in known and not name.startswith(".")]


def within(folder: str, name: str) -> str:
    """Return the path of what lies in a folder, relative to what the folder's path is relative to."""
    return f"{folder}/{name}" if folder else name


def in_parallel(function: Callable[[Item], Result], items: Sequence[Item], connections: int) -> list[Result]:
    """Return the function of every item, in order, computed in several threads; the first error is raised."""
    if connections == 1 or len(items) < 2:
        return [function(item) for item in items]
    with ThreadPoolExecutor(max_workers=connections) as pool:
        return list(pool.map(function, items))
