"""The properties of a data set that `init` reads from its description files, and the selection of a camera."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from vjepa2_ac.config.data import Split
from vjepa2_ac.errors import InputError
from vjepa2_ac.init.draft_values import DraftValue, DraftValues
from vjepa2_ac.training.config_warnings import is_wrist_camera


@dataclass(frozen=True)
class DatasetProperties:
    """The properties of a data set that were read from its description files."""

    source: str  # value of data.source
    path: str
    config_values: DraftValues  # further keys of the section `data`: cameras, names of columns
    rate_hz: DraftValue  # control steps per second
    states: Literal["pose", "vector"] = "pose"
    episodes: int | None = None
    steps: int | None = None  # control steps of all episodes
    median_steps: int | None = None  # median number of control steps per episode
    p10_steps: int | None = None  # 10th percentile of the number of control steps per episode
    predefined_splits: tuple[Split, ...] = ()  # the splits among validation and test that the data set defines itself
    idle: DraftValues | None = None  # section `data.idle`; None: no rule
    descriptions: tuple[str, ...] = ()  # descriptions for the user


def make_idle_section(*, has_velocities: bool) -> DraftValues:
    """Return the section `data.idle`, with the rule for commanded velocities if the data set has them."""
    return {
        "rule": DraftValue(
            "commands" if has_velocities else "motion", "steps without motion carry no information about actions"
        )
    }


# ---- selection of a camera by its name ----

_EXTERIOR = re.compile(r"ext|front|side|third|agent|base|scene|top|over|left|image_0|primary", re.I)
_NON_CAMERA = re.compile(r"depth|disparity|segment|mask|gelsight|tactile", re.I)


def is_not_camera(feature: str) -> bool:
    """Return whether a feature's name suggests a depth map, a segmentation or a tactile sensor instead of a camera."""
    return _NON_CAMERA.search(feature) is not None


def pick_camera(cameras: Sequence[str]) -> str:
    """Return an exterior camera if there is one, because the released model was trained on exterior cameras."""
    exterior = [name for name in cameras if not is_wrist_camera(name)]
    return next((name for name in exterior if _EXTERIOR.search(name)), (exterior or list(cameras))[0])


def make_camera_values(
    features: Sequence[str], non_cameras: Sequence[str], where: str
) -> tuple[DraftValue, DraftValue]:
    """Return the config keys `camera` (the selected camera) and `cameras` (the feature of each camera).

    Raises:
        InputError: There is no feature with images of a camera.
    """
    if not features:
        problem = f"no camera, only depth maps ({', '.join(non_cameras)})" if non_cameras else "no camera"
        raise InputError(where=where, found=problem, needed="videos, or one image of the robot per step")
    names = make_camera_names(features)
    reason = f"cameras: {', '.join(names.values())}; the released model was trained on DROID's camera exterior_1_left"
    selected, is_guess = pick_camera(features), len(names) > 1
    if not is_guess:
        reason = "" if _EXTERIOR.search(selected) and not is_wrist_camera(selected) else _describe_view(selected)
    camera = DraftValue(names[selected], reason, is_guess)
    return camera, DraftValue({name: feature for feature, name in names.items()})


def _describe_view(camera: str) -> str:
    """Return the comment for a data set whose only camera is not recognised as an exterior camera."""
    view = "a camera on the hand" if is_wrist_camera(camera) else "the name does not show the view"
    return f"{view}; the released model was trained on an exterior camera"


def make_camera_names(features: Sequence[str]) -> dict[str, str]:
    """Return a unique, short camera name for each feature: the last parts of the feature's name."""
    parts = {name: [re.sub(r"\W+", "_", part) for part in re.split(r"[./]", name)] for name in features}
    for count in range(1, 1 + max(map(len, parts.values()), default=0)):
        short_names = {name: "_".join(words[-count:]) or "camera" for name, words in parts.items()}
        if len(set(short_names.values())) == len(short_names):
            return short_names
    return {name: name for name in features}
