"""Versions and storage formats of LeRobot that are not read, and the way from each to one that is."""

from __future__ import annotations

import re

FILES = "parquet"  # what a data set is stored as that does not say

_STEPS = {
    "v1": "lerobot 0.3.3's lerobot/datasets/v2/convert_dataset_v1_to_v2.py makes v2.0 of it",
    "v2": "lerobot 0.3.3's lerobot/datasets/v21/convert_dataset_v20_to_v21.py makes v2.1 of it",
}
_NEWER = re.compile(r"v(\d+)\.\d+")
_NEWEST_MAJOR = 3


def way_from_version(version: object) -> str:
    """Return what to do with a data set of another version."""
    found = _NEWER.fullmatch(str(version))
    if found and int(found[1]) >= _NEWEST_MAJOR:
        return "It is newer than this program: update vjepa2-ac, or convert the data set with lerobot"
    if found and (step := _STEPS.get(f"v{found[1]}")):
        return step
    return "Convert the data set with the lerobot package, which has a script for each step from older versions"


def way_from_storage(stored_as: object) -> str:
    """Return what to do with a data set that is stored as something else than files."""
    if stored_as == "lance":
        return "`vjepa2-ac data converter lance_to_files` prints a script that writes the files they were made of"
    return "Convert the data set with the lerobot package"
