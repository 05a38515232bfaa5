"""The settings of a decision: those of a run, of a config, or the defaults. PyTorch is not imported."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_from, load_config_of_run
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.config.section import Affects, mark_of, names_that_affect
from vjepa2_ac.errors import InputError
from vjepa2_ac.places import literal
from vjepa2_ac.planning.axes.axes_file import require_axes
from vjepa2_ac.runs.folder import CHANGES, CONFIG, is_run
from vjepa2_ac.spaces import POSE, REACH_M, vector_states
from vjepa2_ac.storage.structured import read_json_object, shown

logger = logging.getLogger(__name__)

_ANY_TYPE = "training.precision=bf16"  # of autocast, which planning does without: weights may be of any type beside it
_SLACK = 1.1  # uniform motion has its 99th percentile below its limit, and that of some episodes is not exact

_Compared = tuple[str, str, tuple[str, ...], Sequence[float], Sequence[float]]


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
    _require_relevant(overrides)
    if is_run(subject):
        its = with_taught_limits(_of_run(subject, config, overrides), Path(subject))
    else:
        its = _of_model(subject, config, overrides, dtype)
    require_limits(its)
    require_axes(its)
    return its


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

    changes: tuple[float, ...]  # 99th percentile of the size of each number's change in a model step
    narrow: str  # why the data are narrow; empty: they are not, or that is not known


def taught_in(folder: Path, *, poses: bool) -> Taught | None:
    """Return what a run noted of the actions in its data; None: nothing, as older runs of poses.

    Raises:
        InputError: The file does not say it.
    """
    path = folder / CHANGES
    if not path.is_file():
        return None
    noted = read_json_object(path)
    changes, narrow = noted.get("changes"), noted.get("narrow", "")
    if not isinstance(changes, list) or not all(isinstance(one, float) and 0 <= one < math.inf for one in changes):
        raise InputError(where=str(path), found=shown(changes), needed="a number of 0 or more for each of the state's")
    if poses and (len(changes) != len(POSE) or max(changes[:3]) > REACH_M):
        needed = f"{len(POSE)} numbers: {', '.join(POSE.change_names)}, positions in metres"
        raise InputError(where=str(path), found=shown(changes), needed=needed)
    return Taught(tuple(changes), narrow if isinstance(narrow, str) else "")


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


def beyond_taught(config: Config, folder: Path) -> tuple[str, ...]:
    """Return why plans may leave what a run was taught, a sentence each: its data are narrow, or limits go beyond them.

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
    for knob, unit, names, reach, usual in _compared(config.planning.limits, taught.changes, poses=poses):
        beyond = [
            f"{name} {most:.3g} ({far:.3g}){unit}"
            for name, most, far in zip(names, reach, usual, strict=True)
            if most > _SLACK * far
        ]
        if beyond:
            name = f"planning.limits.{knob}"
            way_out = f"{name}=data stays within" if knob in {"xyz", "axes"} else f"lower {name}"
            found.append(
                f"{name} leaves what {folder} was taught: {', '.join(beyond)}. In brackets: how far 99 % of its steps"
                f" go. Beyond that the model guesses; {way_out}"
            )
    return tuple(found)


def warn_beyond_taught(config: Config, folder: Path) -> tuple[str, ...]:
    """Log what `beyond_taught` returns as warnings, and return it."""
    found = beyond_taught(config, folder)
    for text in found:
        logger.warning(text)
    return found


def _compared(limits: LimitsConfig, taught: tuple[float, ...], *, poses: bool) -> list[_Compared]:
    """Return what is compared: a knob, a unit, the numbers it limits, how far it lets them go, how far they went."""
    if not poses:
        axes = limits.axes if isinstance(limits.axes, tuple) else taught
        reach = axes * len(taught) if len(axes) == 1 else axes
        return [("axes", "", vector_states(len(taught)).names, reach, taught)] if len(reach) == len(taught) else []
    names, ball = POSE.change_names, math.inf if limits.ball == "none" else limits.radius
    gripper = limits.gripper if limits.gripper_mode in {"rounded", "free"} else 0.0
    moved, moved_data = ([100 * one for one in metres] for metres in (limits.xyz_m, taught[:3]))
    turned, turned_data = (list(map(math.degrees, radians)) for radians in ([limits.rotation] * 3, taught[3:6]))
    return [
        ("xyz", " cm", names[:3], [min(one, 100 * ball) for one in moved], moved_data),
        ("rotation", " degrees", names[3:6], turned, turned_data),
        ("gripper", "", names[6:], (gripper,), taught[6:]),
    ]


def _of_run(subject: str, config: str | Path | None, overrides: Sequence[str]) -> Config:
    if config is not None:
        raise InputError(
            where=f"--config {config}",
            found=f"{subject}, a run, which has a config of its own",
            needed="one config",
            fix="Change single settings behind the run's name, such as planning.horizon=2",
        )
    return load_config_of_run(
        Path(subject) / CONFIG, [*overrides, f"run_dir={json.dumps(literal(Path(subject)))}", _ANY_TYPE]
    )


def _of_model(subject: str, config: str | Path | None, overrides: Sequence[str], dtype: str) -> Config:
    if config is None:
        plain = {"run_dir": "none", "data": {"path": "none"}, "model": {"base": subject, "dtype": dtype}}
        return config_from(plain, overrides, where="overrides")
    its = load_config_of_run(Path(config), [*overrides, _ANY_TYPE])
    return its.model_copy(update={"model": its.model.with_base(subject)})


def _require_relevant(overrides: Sequence[str]) -> None:
    for override in overrides:
        try:
            is_relevant = Affects.PLAN in mark_of(override.partition("=")[0], Config)
        except KeyError:  # the config says what is wrong
            continue
        if not is_relevant:
            raise InputError(
                where=f"override {override}",
                found="a setting that planning does not use",
                needed=f"one of {', '.join(names_that_affect(Affects.PLAN, Config))}",
            )
