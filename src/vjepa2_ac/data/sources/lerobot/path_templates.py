"""File names of a LeRobot data set, from templates such as `chunk-{chunk_index:03d}`."""

from __future__ import annotations

import re

from vjepa2_ac import storage
from vjepa2_ac.data.sources.listing import in_parallel
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import FileInfo

_PLACE = re.compile(r"\{(\w+)(?::0(\d)d)?\}")
_NUMBERS = {"chunk_index", "file_index", "episode_chunk", "episode_index"}


def require_template(template: object, where: str) -> str:
    """Return a path template of meta/info.json.

    Raises:
        InputError: It is no template, leads out of the data set, or has placeholders unknown to LeRobot.
    """
    if isinstance(template, str) and template and not template.startswith("/") and ".." not in template.split("/"):
        rest = _PLACE.sub("", template)
        if (
            "{" not in rest
            and "}" not in rest
            and {place[1] for place in _PLACE.finditer(template)} <= _NUMBERS | {"video_key"}
        ):
            return template
    needed = "one within the data set, with places such as {chunk_index:03d}"
    raise InputError(where=where, found=f"the template {template!r}", needed=needed, fix="Get meta/info.json again")


def filled(template: str, chunk: int, file: int, key: str = "") -> str:
    """Return the path, within the data set, of a file: in v3.0 by chunk and file, in v2.1 by chunk and episode."""
    numbers = {"chunk_index": chunk, "episode_chunk": chunk, "file_index": file, "episode_index": file}

    def value(place: re.Match[str]) -> str:
        if place[1] == "video_key":
            return key
        return f"{numbers[place[1]]:0{int(place[2] or 1)}d}"

    return _PLACE.sub(value, template)


def list_by_template(root: str, template: str, key: str = "", *, connections: int = 1) -> dict[str, FileInfo]:
    """Return the files whose paths fit a template, sorted by path within the data set.

    Raises:
        OSError: A folder cannot be listed.
    """
    *folders, name = template.replace("{video_key}", key).split("/")
    found = [""]
    for part in folders:
        if _PLACE.search(part):
            names = {folder: storage.list_names(storage.join(root, folder)) for folder in found}
            found = [f"{folder}{inner}/" for folder in found for inner in names[folder] if _fits(inner, part)]
        else:
            found = [f"{folder}{part}/" for folder in found]
    listings = in_parallel(lambda folder: storage.list_files(storage.join(root, folder)), found, connections)
    files = [(folder, file) for folder, inside in zip(found, listings, strict=True) for file in inside]
    return dict(sorted((f"{folder}{file.name}", file) for folder, file in files if _fits(file.name, name)))


def _fits(name: str, part: str) -> bool:
    pieces = re.split(r"\{\w+(?::0\dd)?\}", part)
    # Possessive: otherwise a template of many placeholders would be matched in exponentially many ways.
    return re.fullmatch(r"\d++".join(re.escape(piece) for piece in pieces), name) is not None
