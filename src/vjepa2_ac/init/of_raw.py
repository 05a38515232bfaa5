"""DROID's own folders."""

from __future__ import annotations

from vjepa2_ac import storage
from vjepa2_ac.data.sources.droid_raw.episode_folders import find_episodes
from vjepa2_ac.errors import InputError
from vjepa2_ac.init.found import FoundData
from vjepa2_ac.init.knob import Knob

RAW_DROID = "gs://gresearch/robotics/droid_raw/1.0.1"
_CONNECTIONS = 16


def look_at_raw(path: str) -> FoundData:
    """Look at raw DROID; behind a URL its folders are not counted, for that takes long.

    Raises:
        InputError: There are no episodes.
    """
    is_remote = storage.is_url(path)
    episodes = None if is_remote else len(find_episodes(path, _CONNECTIONS))
    if episodes == 0:
        found, needed = "no episode", "folders with trajectory.h5 and metadata_*.json below it"
        raise InputError(where=path, found=found, needed=needed)
    return FoundData(
        source="droid_raw",
        path=path,
        knobs={"camera": Knob("left", "what the released weights saw; or right, wrist, a serial number")},
        rate_hz=Knob(15.0, "DROID's"),
        episodes=episodes,
        idle={"rule": Knob("commands", "openpi's rule, on the commanded joint velocities")},
        about=(f"raw DROID, {'behind a URL' if is_remote else f'{episodes:,} episodes'}, 15 steps a second",),
        extra="gcs,raw" if is_remote else "raw",
    )
