"""Metadata of a raw DROID episode: cameras, success and task."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from vjepa2_ac.config.sources import RAW_CAMERAS
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import json_object


@dataclass(frozen=True)
class DroidMetadata:
    """The content of a metadata_*.json."""

    values: dict[str, Any]
    where: str

    @classmethod
    def parse(cls, data: bytes, where: str) -> DroidMetadata:
        """Read the file's content.

        Raises:
            InputError: It is not a JSON object.
        """
        return cls(json_object(data, where=where, needed="the metadata of an episode"), where)

    def serial(self, camera: str) -> str:
        """Return the serial number of a camera: left, right, wrist, ext1, ext2, or a serial number itself.

        Raises:
            InputError: The metadata does not name that camera.
        """
        if camera not in RAW_CAMERAS:
            return camera
        key = f"{camera}_mp4_path"
        path = self.values.get(key)
        name = PurePosixPath(path).name if isinstance(path, str) else ""
        if not name.endswith(".mp4") or name == ".mp4":
            found, fix = f"{key}: {path!r}", "Set data.camera to one that every episode has"
            raise InputError(where=self.where, found=found, needed="the path of an MP4", fix=fix)
        return name.removesuffix(".mp4")

    @property
    def success(self) -> bool | None:
        """Whether the episode succeeded, if known."""
        value = self.values.get("success")
        return value if isinstance(value, bool) else None

    @property
    def labels(self) -> dict[str, str | None]:
        """The episode's labels, as far as known: scene, building, operator, task."""
        return {
            "scene": self._short("scene_id"),
            "building": self._short("building"),
            "operator": self._short("user_id") or self._short("user"),
            "task": self.language,
        }

    def _short(self, key: str) -> str | None:
        value = self.values.get(key)
        return str(value) if isinstance(value, str | int) and not isinstance(value, bool) else None

    @property
    def language(self) -> str | None:
        """The task as text, if known."""
        value = self.values.get("current_task")
        return value if isinstance(value, str) and value else None
