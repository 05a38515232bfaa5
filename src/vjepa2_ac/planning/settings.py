"""Settings for planning (from a run, a config or the defaults), and calibrated axes. PyTorch is not imported."""

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
from vjepa2_ac.config.section import Affects, get_effect
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.folder import CHANGES, MOVABLE_PATHS, is_run, read_run_config, sets_movable_path
from vjepa2_ac.spaces import MAX_POSITION_M, POSE, make_vector_states
from vjepa2_ac.storage.structured import parse_record, read_json_object

logger = logging.getLogger(__name__)

USED_KEYS = (
    "planning.…", "seed", "data.stride", "data.crop", "model.sizes.…", "model.dtype",
    "training.device", *MOVABLE_PATHS,
)  # fmt: skip
_ANY_DTYPE = "training.precision=bf16"  # with it any model.dtype is valid; planning does not use the precision
_SLACK = 1.1  # limits may exceed the 99th percentile by 10 %, since it is below the maximum and inexact


def load_planning_config(
    subject: str, *, config: str | Path | None = None, overrides: Sequence[str] = (), dtype: str = "float32"
) -> Config:
    """Return the config for planning: that of the run, or for a model the given config or the defaults.

    Args:
        subject: The folder of a run; or a model, as in `model.base`.
        config: A config file, for a model.
        overrides: For example planning.horizon=2.
        dtype: dtype of a model's weights if no config is given.

    Raises:
        InputError: A setting is invalid, or is not used for planning.
    """
    _require_relevant(subject, overrides)
    if is_run(subject):
        if config is not None:
            problem = f"{subject} is a run, and the config of a run is used"
            fix = "Leave --config out, and override single settings with key=value"
            raise InputError(where=f"--config {config}", found=problem, fix=fix)
        folder = Path(subject)
        settings = resolve_data_limits(read_run_config(folder, [*overrides, _ANY_DTYPE]), folder)
    elif config is None:
        settings = config_of_model(subject, overrides, dtype=dtype)
    else:
        settings = load_config(config, [*overrides, _ANY_DTYPE])
        settings = settings.model_copy(update={"model": settings.model.with_base(subject)})
    require_limits(settings)
    if (axes := settings.planning.axes) is not None:
        read_axes(axes)
        require_base_frame(f"planning.axes: {axes}", is_base=_is_base_pose(settings.data))
    return settings


# ---- calibrated axes ----

AXES_FILE, AXES_FORMAT = "axes.json", 1  # the format is incremented when readers of the file must change
_FIX = "Fit them with `vjepa2-ac data calibrate CONFIG --axes MODEL`, and name the axes.json that it writes"


class AxesFile(BaseModel):
    """The part of axes.json (written by `data calibrate --axes`) that planning needs."""

    format: Literal[1]
    # Rotation about z, counterclockwise seen from above, from executed actions to the actions that the model infers.
    yaw_degrees: float = Field(validation_alias=AliasPath("yaw_degrees", "value"), allow_inf_nan=False)
    subject: str = Field(validation_alias=AliasPath("model", "subject"))  # run or model, as on the command line
    encoder: str = Field(validation_alias=AliasPath("model", "encoder"))  # hash of the weights
    predictor: str = Field(validation_alias=AliasPath("model", "predictor"))  # hash of the weights
    problem: str | None  # why planning cannot use these axes; None: no problem
    centre_m: tuple[float, float] = (0.0, 0.0)  # x, y of the rotation axis


def read_axes(path: str | Path) -> AxesFile:
    """Read calibrated axes, and refuse those that planning cannot use.

    Raises:
        InputError: There is no such file, it does not contain calibrated axes, or the fit is not good enough.
    """
    where, needed = f"planning.axes: {path}", f"calibrated axes of format {AXES_FORMAT}"
    values = read_json_object(path, needed=needed, fix=_FIX)
    axes = parse_record(AxesFile, values, where=where, needed=needed, fix=_FIX)
    if axes.problem is not None:
        fix = "Record more diverse motions and use more pairs (--limit). If this does not help, fine-tune the model"
        raise InputError(where=where, found=f"axes that cannot be used: {axes.problem}", fix=fix)
    return axes


def require_base_frame(where: str, *, is_base: bool) -> None:
    """Refuse states that are not poses in the robot's base frame; calibrated axes rotate about its vertical axis.

    Raises:
        InputError: The states are not poses in this frame.
    """
    if not is_base:
        needed = "data.states: pose and data.pose_frame: base"
        raise InputError(where=where, found="states that are not poses in the robot's base frame", needed=needed)


def require_calibratable(data: DataConfig) -> None:
    """Refuse data whose axes cannot be calibrated, before a model is loaded.

    Raises:
        InputError: The states are not poses in the base frame, or the stride is not chosen yet.
    """
    require_base_frame("data calibrate --axes", is_base=_is_base_pose(data))
    require_stride(data, to="calibrate axes")


def _is_base_pose(data: DataConfig) -> bool:
    return data.states == "pose" and data.pose_frame == "base"


# ---- settings and limits ----


def _require_relevant(subject: str, overrides: Sequence[str]) -> None:
    for override in overrides:
        key = override.partition("=")[0]
        try:
            is_relevant = Affects.PLAN in get_effect(key, Config)
        except KeyError:  # an unknown key; loading the config reports it
            continue
        if sets_movable_path(override) and not is_run(subject):
            problem = f"{subject} is not the folder of a run"
            raise InputError(
                where=f"override {override}", found=problem, needed="the folder of a run, to change this path"
            )
        if not is_relevant:
            problem = "a setting that planning does not use"
            raise InputError(where=f"override {override}", found=problem, needed=f"one of {', '.join(USED_KEYS)}")


def require_limits(config: Config) -> None:
    """Refuse `planning.limits.xyz: data` for poses if no recorded motions replaced it (`resolve_data_limits`).

    `make_search_space` checks the limits of vectors.

    Raises:
        InputError: As for `LimitsConfig.xyz_m`.
    """
    if config.data.states == "pose":
        _ = config.planning.limits.xyz_m


@dataclass(frozen=True)
class DataLimits:
    """Statistics of the motions in a run's training data."""

    # 99th percentile of the absolute change of each number in a model step
    changes: tuple[Annotated[float, Field(ge=0.0, allow_inf_nan=False)], ...]
    # why the diversity of the data is low; empty: it is not low, or it is unknown
    low_diversity: str = ""


def read_data_limits(folder: Path, *, is_pose: bool) -> DataLimits | None:
    """Read the statistics of the motions in a run's training data; None: an older version wrote the run without them.

    Raises:
        InputError: The file is invalid.
    """
    path = folder / CHANGES
    if not path.is_file():
        return None
    fields = {"changes": "changes", "narrow": "low_diversity"}  # by key of the file
    values = {fields[key]: value for key, value in read_json_object(path).items() if key in fields}
    data_limits = parse_record(
        DataLimits, values, where=str(path), needed="one number of 0 or more per component of a state"
    )
    if is_pose and (len(data_limits.changes) != len(POSE) or max(data_limits.changes[:3]) > MAX_POSITION_M):
        needed = f"{len(POSE)} numbers: {', '.join(POSE.change_names)}, positions in metres"
        raise InputError(where=str(path), found=str(data_limits.changes), needed=needed)
    return data_limits


def resolve_data_limits(config: Config, folder: Path) -> Config:
    """Return the config of a run with `data` in `planning.limits` replaced by the recorded limits, if there are any.

    Raises:
        InputError: As `read_data_limits`.
    """
    limits, is_pose = config.planning.limits, config.data.states == "pose"
    if (limits.xyz if is_pose else limits.axes) != "data" or (
        data_limits := read_data_limits(folder, is_pose=is_pose)
    ) is None:
        return config
    # Rounded down to 0.1 mm, so that a component that contains only measurement noise is fixed.
    metres = tuple(math.floor(1e4 * change) / 1e4 for change in data_limits.changes[:3])
    numbers = {"xyz": metres} if is_pose else {"axes": data_limits.changes}
    planning = config.planning.model_copy(update={"limits": limits.model_copy(update=numbers)})
    return config.model_copy(update={"planning": planning})


def warn_if_limits_exceed_data(config: Config, folder: Path) -> tuple[str, ...]:
    """Log and return warnings if a run was trained on low-diversity data, or if the limits exceed the data's motions.

    Each limit may exceed the 99th percentile of the recorded changes by 10 %.

    Args:
        config: The config of the run, with the limits for planning.
        folder: The folder of the run.

    Raises:
        InputError: As `read_data_limits`.
    """
    is_pose = config.data.states == "pose"
    if (data_limits := read_data_limits(folder, is_pose=is_pose)) is None:
        return ()
    warnings = (
        [f"{folder} was trained on low-diversity data: {data_limits.low_diversity}"]
        if data_limits.low_diversity
        else []
    )
    names = POSE.change_names if is_pose else make_vector_states(len(data_limits.changes)).names
    limits = _largest_changes(config.planning.limits, data_limits, is_pose=is_pose)
    for key, (unit, factor, numbers) in (_POSE_LIMITS if is_pose else _VECTOR_LIMITS).items():
        exceeded = [
            f"{name} {factor * limit:.3g} ({factor * change:.3g}){unit}"
            for name, limit, change in list(zip(names, limits, data_limits.changes, strict=False))[numbers]
            if limit > _SLACK * change
        ]
        if exceeded:
            name, listing = f"planning.limits.{key}", ", ".join(exceeded)
            fix = f"Set {name}=data" if key in {"xyz", "axes"} else f"Lower {name}"
            warnings.append(
                f"{name} exceeds the motions in the training data of {folder}: {listing} (99th percentile of"
                f" the data in parentheses). Predictions for larger motions are unreliable. {fix}"
            )
    for text in warnings:
        logger.warning(text)
    return tuple(warnings)


_POSE_LIMITS = {  # config key: displayed unit, its factor, and the numbers of a state that the key limits
    "xyz": (" cm", 100.0, slice(0, 3)),
    "rotation": (" degrees", 180 / math.pi, slice(3, 6)),
    "gripper": ("", 1.0, slice(6, 7)),
}
_VECTOR_LIMITS = {"axes": ("", 1.0, slice(None))}


def _largest_changes(limits: LimitsConfig, data_limits: DataLimits, *, is_pose: bool) -> Sequence[float]:
    """Return the limit of each number's change in a model step; empty if the number of limits is wrong."""
    if not is_pose:
        largest = limits.axes if isinstance(limits.axes, tuple) else data_limits.changes
        largest = largest * len(data_limits.changes) if len(largest) == 1 else largest
        return largest if len(largest) == len(data_limits.changes) else ()
    gripper = limits.gripper if limits.gripper_mode in {"rounded", "free"} else 0.0
    return [*limits.xyz_m, *[limits.rotation] * 3, gripper]
