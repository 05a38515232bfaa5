"""Episode folders of a raw DROID tree, and the episodes' names.

The tree is LAB/success|failure/DATE/TIME/{trajectory.h5, metadata_*.json, recordings/MP4/*.mp4}.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac import storage
from vjepa2_ac.data.files import DEEPEST, in_parallel, list_folder, within
from vjepa2_ac.storage import FileInfo

TRAJECTORY = "trajectory.h5"
VIDEOS = "recordings/MP4"

_OUTCOMES = ("success", "failure")


@dataclass(frozen=True)
class EpisodeFolder:
    """The listing of an episode's folder."""

    path: str  # relative to the data set's; "" is the data set's folder itself
    files: tuple[FileInfo, ...]
    videos: tuple[FileInfo, ...]

    @property
    def metadata(self) -> str | None:
        """The name of its metadata file, or None; DROID's uploaders wrote it last, for complete episodes only."""
        return next((file.name for file in self.files if _is_metadata(file.name)), None)

    @property
    def has_trajectory(self) -> bool:
        """Whether it has a trajectory."""
        return any(file.name == TRAJECTORY for file in self.files)


def find_episodes(root: str, connections: int) -> list[str]:
    """Return the folders of all episodes, relative to `root`, sorted; "" if `root` is an episode's.

    Raises:
        OSError: A folder cannot be listed.
    """
    if _is_episode(storage.list_names(root)):
        return [""]
    found: list[str] = []
    folders = [""]
    for _ in range(DEEPEST):
        children = in_parallel(lambda folder: _children(root, folder), folders, connections)
        together = [child for group in children for child in group]
        found += [path for path, is_episode in together if is_episode]
        folders = [path for path, is_episode in together if not is_episode]
    return sorted(found)


def list_episode(root: str, folder: str) -> EpisodeFolder:
    """List the files of one episode.

    Raises:
        OSError: A folder cannot be listed.
    """
    path = storage.join(root, folder) if folder else root
    videos = storage.list_files(storage.join(path, VIDEOS))
    return EpisodeFolder(folder, tuple(storage.list_files(path)), tuple(videos))


def identity_of(root: str, folder: str) -> str:
    """Return LAB/outcome/DATE/TIME if the path ends so, for any part of the tree as `root`.

    Otherwise it is the path relative to `root`: it depends on `root`.
    """
    base = root.split("://", 1)[1] if storage.is_url(root) else str(Path(root).resolve())
    parts = [part for part in f"{base}/{folder}".split("/") if part]
    return "/".join(parts[-4:]) if _ends_as_in_droid(parts) else folder or parts[-1]


def success_of(identity: str) -> bool | None:
    """Return the outcome in an identity, or None."""
    parts = identity.split("/")
    return parts[-3] == "success" if _ends_as_in_droid(parts) else None


def _children(root: str, folder: str) -> list[tuple[str, bool]]:
    """Return the folders in a folder, and whether each is an episode.

    In DROID's own layout the depth shows that, without listing every episode.
    """
    children = [within(folder, name) for name in list_folder(root, folder)[1]]
    return [
        (path, _is_droid(root, path) or _is_episode(storage.list_names(storage.join(root, path)))) for path in children
    ]


def _is_droid(root: str, path: str) -> bool:
    return _ends_as_in_droid(identity_of(root, path).split("/"))


def _ends_as_in_droid(parts: Sequence[str]) -> bool:
    return len(parts) >= 4 and parts[-3] in _OUTCOMES


def _is_episode(names: Sequence[str]) -> bool:
    return any(name == TRAJECTORY or _is_metadata(name) for name in names)


def _is_metadata(name: str) -> bool:
    return name.startswith("metadata") and name.endswith(".json")
