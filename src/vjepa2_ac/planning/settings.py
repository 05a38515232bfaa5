"""The settings of a decision: those of a run, of a config, or the defaults. PyTorch is not imported."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.config.effects import Affects, mark_of, names_that_affect
from vjepa2_ac.config.loading import config_from, load_config
from vjepa2_ac.errors import InputError
from vjepa2_ac.places import literal
from vjepa2_ac.planning.axes.axes_file import require_axes
from vjepa2_ac.runs.folder import CHANGES, CONFIG, is_run
from vjepa2_ac.storage.structured import read_json_object, shown

_ANY_TYPE = "training.precision=bf16"  # of autocast, which planning does without: weights may be of any type beside it


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
    require_axes(its)
    return its


def with_taught_limits(config: Config, folder: Path) -> Config:
    """Return the config of a run with the limits that `planning.limits.axes: data` means, if the run knows them.

    Raises:
        InputError: What the run noted are no limits.
    """
    if config.data.states == "pose" or config.planning.limits.axes != "data" or not (folder / CHANGES).is_file():
        return config
    limits = config.planning.limits.model_copy(update={"axes": _taught(folder / CHANGES)})
    return config.model_copy(update={"planning": config.planning.model_copy(update={"limits": limits})})


def _taught(path: Path) -> tuple[float, ...]:
    """Return how far each number of a vector changed in a model step of the data, as the run noted it."""
    changes = read_json_object(path).get("changes")
    if not isinstance(changes, list) or not all(isinstance(one, float) and 0 <= one < math.inf for one in changes):
        raise InputError(where=str(path), found=shown(changes), needed="a number of 0 or more for each of the state's")
    return tuple(changes)


def _of_run(subject: str, config: str | Path | None, overrides: Sequence[str]) -> Config:
    if config is not None:
        raise InputError(
            where=f"--config {config}",
            found=f"{subject}, a run, which has a config of its own",
            needed="one config",
            fix="Change single settings behind the run's name, such as planning.horizon=2",
        )
    return load_config(Path(subject) / CONFIG, [*overrides, f"run_dir={json.dumps(literal(Path(subject)))}", _ANY_TYPE])


def _of_model(subject: str, config: str | Path | None, overrides: Sequence[str], dtype: str) -> Config:
    if config is None:
        plain = {"run_dir": "none", "data": {"path": "none"}, "model": {"base": subject, "dtype": dtype}}
        return config_from(plain, overrides, where="overrides")
    its = load_config(config, [*overrides, _ANY_TYPE])
    return its.model_copy(update={"model": its.model.model_copy(update={"base": subject, "random": None})})


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
