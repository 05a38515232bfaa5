"""The settings of a decision: of a run, of a config, or the defaults; calibrated axes. PyTorch is not imported."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AliasPath, BaseModel, Field

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.config.loading import config_of_model, load_config
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.config.section import Affects, mark_of
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.folder import CHANGES, MOVABLE, is_of_moved, is_run, read_run_config
from vjepa2_ac.spaces import POSE, REACH_M, vector_states
from vjepa2_ac.storage.structured import read_json_object, record_of

logger = logging.getLogger(__name__)

USED = (
    "planning.…", "seed", "data.stride", "data.crop", "model.sizes.…", "model.dtype",
    "training.device", *MOVABLE,
)  # fmt: skip
_ANY_TYPE = "training.precision=bf16"  # of autocast, which planning does without: weights may be of any type beside it
_SLACK = 1.1  # uniform motion has its 99th percentile below its limit, and that of some episodes is not exact


def planning_settings(
    subject: str, *, config: str | Path | None = None, overrides: Sequence[str] = (), dtype: str = "float32"
) -> Config:
    """Return the config to plan with: that of a run; for a model the given one, or the defaults.

    Args:
        subject: The folder of a run; or a model: what `model.base` takes.
        config: A config file, for a model.
        overrides: Such as planning.horizon=2.
        dtype: Of the weights of a model, where no config says it.

    Raises:
        InputError: A setting is wrong or does not matter.
    """
    _require_relevant(subject, overrides)
    if is_run(subject):
        if config is not None:
            found, fix = f"{subject}, a run, which has a config of its own", "Change single settings by key=value"
            raise InputError(where=f"--config {config}", found=found, fix=fix)
        folder = Path(subject)
        its = with_taught_limits(read_run_config(folder, [*overrides, _ANY_TYPE]), folder)
    elif config is None:
        its = config_of_model(subject, overrides, dtype=dtype)
    else:
        its = load_config(config, [*overrides, _ANY_TYPE])
        its = its.model_copy(update={"model": its.model.with_base(subject)})
    require_limits(its)
    if (axes := its.planning.axes) is not None:
        read_axes(axes)
        require_base_frame(f"planning.axes: {axes}", is_base=_is_base_pose(its.data))
    return its


# ---- calibrated axes ----

AXES_FILE, AXES_FORMAT = "axes.json", 1  # the format is incremented when a reader of the file would have to change
_FIX = "Fit them with `vjepa2-ac data calibrate CONFIG --axes MODEL`, and name the axes.json that it writes"


class AxesFile(BaseModel):
    """What planning needs of axes.json, which `data calibrate --axes` writes."""

    format: Literal[1]
    # About z, counterclockwise from above: what the model infers, from what was executed.
    yaw_degrees: float = Field(validation_alias=AliasPath("yaw_degrees", "value"), allow_inf_nan=False)
    subject: str = Field(validation_alias=AliasPath("model", "subject"))  # the model, as given
    encoder: str = Field(validation_alias=AliasPath("model", "encoder"))  # hashes of its weights
    predictor: str = Field(validation_alias=AliasPath("model", "predictor"))
    problem: str | None  # why nothing can be planned by it
    centre_m: tuple[float, float] = (0.0, 0.0)  # x, y about which is turned


def read_axes(path: str | Path) -> AxesFile:
    """Return calibrated axes that can be planned by.

    Raises:
        InputError: There is no such file, it is none of calibrated axes, or the fit is not good enough.
    """
    where, needed = f"planning.axes: {path}", f"calibrated axes of format {AXES_FORMAT}"
    values = read_json_object(path, needed=needed, fix=_FIX)
    axes = record_of(AxesFile, values, where=where, needed=needed, fix=_FIX)
    if axes.problem is not None:
        fix = "Record varied moves and fit to more pairs (--limit); or the model does not see the actions: adapt it"
        raise InputError(where=where, found=f"axes that are {axes.problem}", fix=fix)
    return axes


def require_base_frame(where: str, *, is_base: bool) -> None:
    """Refuse states that have no vertical axis to turn about.

    Raises:
        InputError: They are no poses in the robot's base frame.
    """
    if not is_base:
        found = "states that are no poses in the robot's base frame"
        needed = "data.states: pose and data.pose_frame: base, whose vertical axis moves are turned about"
        raise InputError(where=where, found=found, needed=needed)


def require_axes_in(data: DataConfig) -> None:
    """Refuse data in which there are no axes to calibrate, before a model is loaded.

    Raises:
        InputError: The states are no poses in the base frame, or the stride is still to be chosen.
    """
    require_base_frame("data calibrate --axes", is_base=_is_base_pose(data))
    require_stride(data, to="calibrate axes, for axes are those of a model step")


def _is_base_pose(data: DataConfig) -> bool:
    return data.states == "pose" and data.pose_frame == "base"


# ---- settings and limits ----


def _require_relevant(subject: str, overrides: Sequence[str]) -> None:
    for override in overrides:
        key = override.partition("=")[0]
        try:
            is_relevant = Affects.PLAN in mark_of(key, Config)
        except KeyError:  # the config says what is wrong
            continue
        if is_of_moved(override) and not is_run(subject):
            found = f"{subject}, which is not the folder of a run"
            raise InputError(where=f"override {override}", found=found, needed="a run, whose base was moved")
        if not is_relevant:
            found = "a setting that planning does not use"
            raise InputError(where=f"override {override}", found=found, needed=f"one of {', '.join(USED)}")


def require_limits(config: Config) -> None:
    """Refuse limits of poses that are those of the data, where no run has said which (vectors: `search_space`).

    Raises:
        InputError: As `LimitsConfig.xyz_m`.
    """
    if config.data.states == "pose":
        _ = config.planning.limits.xyz_m


@dataclass(frozen=True)
class Taught:
    """What a run noted of the actions in its data."""

    # 99th percentile of the size of each number's change in a model step
    changes: tuple[Annotated[float, Field(ge=0.0, allow_inf_nan=False)], ...]
    narrow: str = ""  # why the data are narrow; empty: they are not, or that is not known


def taught_in(folder: Path, *, poses: bool) -> Taught | None:
    """Return what a run noted of the actions in its data; None: nothing, as older runs of poses.

    Raises:
        InputError: The file does not say it.
    """
    path = folder / CHANGES
    if not path.is_file():
        return None
    noted = {name: one for name, one in read_json_object(path).items() if name in {"changes", "narrow"}}
    taught = record_of(Taught, noted, where=str(path), needed="a number of 0 or more for each of the state's")
    if poses and (len(taught.changes) != len(POSE) or max(taught.changes[:3]) > REACH_M):
        needed = f"{len(POSE)} numbers: {', '.join(POSE.change_names)}, positions in metres"
        raise InputError(where=str(path), found=str(taught.changes), needed=needed)
    return taught


def with_taught_limits(config: Config, folder: Path) -> Config:
    """Return the config of a run with the limits that `data` means in `planning.limits`, if the run knows them.

    Raises:
        InputError: What the run noted are no limits.
    """
    limits, poses = config.planning.limits, config.data.states == "pose"
    if (limits.xyz if poses else limits.axes) != "data" or (taught := taught_in(folder, poses=poses)) is None:
        return config
    # Down to tenths of a millimetre: an axis that only measurement moves is held.
    metres = tuple(math.floor(1e4 * one) / 1e4 for one in taught.changes[:3])
    numbers = {"xyz": metres} if poses else {"axes": taught.changes}
    planning = config.planning.model_copy(update={"limits": limits.model_copy(update=numbers)})
    return config.model_copy(update={"planning": planning})


def warn_beyond_taught(config: Config, folder: Path) -> tuple[str, ...]:
    """Log and return why plans may leave what a run was taught, a sentence each: narrow data, or limits beyond them.

    Limits are compared with the 99th percentile of each number's change, which they may exceed by a tenth.

    Args:
        config: Of the run, with the limits to plan with.
        folder: Of the run.

    Raises:
        InputError: As `taught_in`.
    """
    poses = config.data.states == "pose"
    if (taught := taught_in(folder, poses=poses)) is None:
        return ()
    found = [f"{folder} learned from narrow data: {taught.narrow}"] if taught.narrow else []
    names = POSE.change_names if poses else vector_states(len(taught.changes)).names
    reach = _reach(config.planning.limits, taught, poses=poses)
    for knob, (unit, factor, numbers) in (_OF_POSES if poses else _OF_VECTORS).items():
        beyond = [
            f"{name} {factor * most:.3g} ({factor * far:.3g}){unit}"
            for name, most, far in list(zip(names, reach, taught.changes, strict=False))[numbers]
            if most > _SLACK * far
        ]
        if beyond:
            name = f"planning.limits.{knob}"
            way_out = f"{name}=data stays within" if knob in {"xyz", "axes"} else f"lower {name}"
            found.append(
                f"{name} exceeds the motions in the training data of {folder}: {', '.join(beyond)} (99th percentile of"
                f" the data in parentheses). Predictions beyond it are unreliable; {way_out}"
            )
    for text in found:
        logger.warning(text)
    return tuple(found)


_OF_POSES = {  # which numbers a knob limits, and in which unit people read them
    "xyz": (" cm", 100.0, slice(0, 3)),
    "rotation": (" degrees", 180 / math.pi, slice(3, 6)),
    "gripper": ("", 1.0, slice(6, 7)),
}
_OF_VECTORS = {"axes": ("", 1.0, slice(None))}


def _reach(limits: LimitsConfig, taught: Taught, *, poses: bool) -> Sequence[float]:
    """Return how far limits let each number go in a model step; nothing where they do not say it for each."""
    if not poses:
        axes = limits.axes if isinstance(limits.axes, tuple) else taught.changes
        axes = axes * len(taught.changes) if len(axes) == 1 else axes
        return axes if len(axes) == len(taught.changes) else ()
    gripper = limits.gripper if limits.gripper_mode in {"rounded", "free"} else 0.0
    return [*limits.xyz_m, *[limits.rotation] * 3, gripper]
