"""Recursive listing of a folder's files, local or behind a URL."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import FileInfo

DEEPEST = 8  # folders below the data set's

Item = TypeVar("Item")
Result = TypeVar("Result")


def walk(root: str, connections: int) -> Iterator[tuple[str, FileInfo]]:
    """Yield all files, with their folder relative to `root`; names that begin with a dot are skipped.

    A folder with several links to it is visited once: its files would be episodes under several names.

    Raises:
        OSError: A folder cannot be listed.
        InputError: A name is not UTF-8.
    """
    folders, known = [""], {storage.absolute(root)}
    for _ in range(DEEPEST):
        below: list[str] = []
        for folder, (files, names) in zip(
            folders, in_parallel(lambda folder: list_folder(root, folder), folders, connections), strict=True
        ):
            yield from ((folder, file) for file in files if not file.name.startswith("."))
            below += [within(folder, name) for name in names]
        places = {storage.absolute(storage.join(root, folder)): folder for folder in reversed(below)}
        folders = sorted(folder for place, folder in places.items() if place not in known)
        known |= places.keys()


def list_folder(root: str, folder: str) -> tuple[list[FileInfo], list[str]]:
    """Return the files of a folder, and the names of its folders except hidden ones.

    Raises:
        OSError: It cannot be listed.
        InputError: A name is not UTF-8.
    """
    place = storage.join(root, folder) if folder else root
    files, names = storage.list_files(place), storage.list_names(place)
    for name in names:  # the identity of an episode must be text that can be encoded
        if not name.isascii() and any("\ud800" <= letter <= "\udfff" for letter in name):
            raise InputError(where=place, found=f"the name {name!r}", needed="names in UTF-8", fix="Rename it")
    known = {file.name for file in files}
    return files, [name for name in names if name not in known and not name.startswith(".")]


def within(folder: str, name: str) -> str:
    """Return the path of an entry of a folder, with the same base as the folder's path."""
    return f"{folder}/{name}" if folder else name


def in_parallel(function: Callable[[Item], Result], items: Sequence[Item], connections: int) -> Iterator[Result]:
    """Yield the result of a function for every item, in order, from several threads; or raise the first error."""
    if connections == 1 or len(items) < 2:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(min(connections, len(items)))
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(cancel_futures=True)
