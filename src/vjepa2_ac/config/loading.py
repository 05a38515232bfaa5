"""Config loading: strict YAML with dotted overrides; all errors are reported at once, with their paths."""

from __future__ import annotations

import difflib
import importlib.resources
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml  # to write: `storage.structured` reads
from pydantic import ValidationError

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.config.data import source_of
from vjepa2_ac.config.model import RANDOM
from vjepa2_ac.config.removed import drop_removed_keys, move_component_options, move_norm_limit, why_removed
from vjepa2_ac.config.run import ReplayConfig, with_complete_replay
from vjepa2_ac.config.section import key_of_data, marks_of
from vjepa2_ac.config.training import TrainingConfig, usual_warmup
from vjepa2_ac.errors import InputError, shell_command
from vjepa2_ac.registry import SOURCES, UNKNOWN_OPTION, import_plugins
from vjepa2_ac.storage import read_bounded
from vjepa2_ac.storage.places import BUILTIN, NO_DATA
from vjepa2_ac.storage.structured import message_of, parse_yaml

_MOST_BYTES = 1_000_000  # no config needs more, and PyYAML reads 20 MB in a minute
# A command reads the config of its run several times, and PyYAML needs 20 ms. `parse_config` copies the values.
_parse_document = lru_cache(maxsize=8)(parse_yaml)
_OF_A_RUN = ("run_id", "environment.json", "metrics.jsonl")  # next to the config of a run
_PACKAGED = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets" / "configs"


def load_config(config: str | Path | Mapping[str, Any], overrides: Iterable[str] = ()) -> Config:
    """Read a config, from a file or from plain values, and apply `key.sub=value` overrides.

    Plug-ins may be in the working directory, unless the file is in the folder of a run (`load_config_of_run`).

    Args:
        config: A file, `builtin:NAME` of the package, or plain values.
        overrides: Such as training.steps=100.

    Raises:
        InputError: The file cannot be read or is not a valid config; names every key that is wrong.

    Example:
        >>> config = load_config("builtin:demo", ["training.steps=100"])  # or a file, such as configs/demo.yaml
        >>> config = load_config({"run_dir": "run", "data": {"path": "data"}, "model": {"base": "builtin:sim-tiny"}})
    """
    if isinstance(config, Mapping):
        return parse_config(config, overrides, where="load_config")
    path = config_path(config)
    of_run = any((path.parent / name).exists() for name in _OF_A_RUN)
    return parse_config(_read_yaml(path), overrides, where=str(config), here=not of_run)


def config_of_model(base: str, overrides: Iterable[str] = (), *, where: str = "overrides", **model: Any) -> Config:
    """Return the config of a model without a config file: the defaults, without data.

    Args:
        base: The model, as in `model.base`.
        overrides: Such as planning.horizon=2.
        where: What the values come from, for messages.
        model: Further values of `model:`, such as dtype.

    Raises:
        InputError: As `parse_config`.
    """
    values = {"run_dir": "none", "data": {"path": NO_DATA}, "model": {"base": base, **model}}
    return parse_config(values, overrides, where=where)


def load_config_of_run(path: str | Path, overrides: Iterable[str] = ()) -> Config:
    """Read the config of a run, which may be a stranger's: its plug-ins are not looked for in the working directory."""
    return parse_config(_read_yaml(config_path(path)), overrides, where=str(path), here=False)


def packaged_configs() -> dict[str, str]:
    """Return the first sentence of each config that comes with the package, by name."""
    heads = {path.stem: path.read_text(encoding="utf-8").split("\n\n")[0] for path in _PACKAGED.glob("*.yaml")}
    return {name: re.sub(r"\n?# ?", " ", head).split(". ")[0].strip(" .:\n") for name, head in sorted(heads.items())}


def config_path(name: str | Path) -> Path:
    """Return the file of a config: of `builtin:NAME` that of the package, else the path itself.

    Raises:
        InputError: The package has no config of that name.
    """
    if not str(name).startswith(BUILTIN):
        return Path(name)
    if (known := str(name).removeprefix(BUILTIN)) not in packaged_configs():
        needed = f"one of {', '.join(f'{BUILTIN}{one}' for one in packaged_configs())}"
        raise InputError(where=str(name), found="no config of that name comes with the package", needed=needed)
    return _PACKAGED / f"{known}.yaml"


def parse_config(values: Mapping[str, Any], overrides: Iterable[str] = (), *, where: str, here: bool = True) -> Config:
    """Validate plain values, as YAML or JSON gives them, with `key.sub=value` overrides.

    Args:
        values: The values; a Path is text.
        overrides: Such as training.steps=100.
        where: Their file, for messages.
        here: Whether plug-ins may lie in the working directory: not those of a run, which may be a stranger's.

    Raises:
        InputError: Names every key that is wrong, all at once.
    """
    given = json.loads(_as_json(values, where))
    _keep_drawn_splits(given)
    if not here:
        drop_removed_keys(given, where)
        move_norm_limit(given, where)
        move_component_options(given, where)
    for override in overrides:
        key, separator, text = override.partition("=")
        if not separator or not key:
            raise InputError(where="overrides", found=f"{override!r}", needed="key=value, such as training.steps=100")
        _set(given, key.split("."), parse_yaml(text, where=f"override {key}"), override)
    _replace_older_keys(given)
    if isinstance(given.get("model"), dict):
        _replace_keys_of_model(given["model"])
    try:
        given = with_plugins(given, where=where, here=here)
        return Config.model_validate_json(_as_json(with_complete_replay(given), where))
    except ValidationError as error:
        lines = _wrong_values(error)
    found = "\n  ".join([f"{len(lines)} value{'s are' if len(lines) > 1 else ' is'} wrong", *lines]) + "\n"
    raise InputError(where=where, found=found, fix="`vjepa2-ac config schema` lists every key with its range")


def config_as_dict(config: Config) -> dict[str, Any]:
    """Return the resolved config as plain values, defaults included."""
    return dict(config.model_dump(mode="json"))


def config_as_flat_dict(config: Config) -> dict[str, Any]:
    """Return the resolved config by dotted keys, which is what trackers take."""
    return flat(config_as_dict(config))


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested values by their dotted keys."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return found


def config_as_yaml(config: Config) -> str:
    """Return the resolved config as YAML that `load_config` reads back to an equal config."""
    return str(yaml.dump(config_as_dict(config), Dumper=_Dumper, sort_keys=False, width=_NO_BREAKS))


def yaml_line(key: str, value: Any) -> str:
    """Return a key and its value as one line of YAML, which reads back as they are."""
    text = yaml.dump([{key: value}], Dumper=_Dumper, sort_keys=False, default_flow_style=True, width=_NO_BREAKS)
    return str(text).removeprefix("[{").removesuffix("}]\n")


def config_schema() -> dict[str, Any]:
    """Return the JSON schema of a config file, for editors."""
    admit_forms_of_data(all_installed=True)
    return Config.model_json_schema()


def changed_keys(old: Config, new: Config) -> list[str]:
    """Return the dotted keys in which two configs differ."""
    flat_old, flat_new = config_as_flat_dict(old), config_as_flat_dict(new)
    return sorted(key for key in flat_old.keys() | flat_new.keys() if flat_old.get(key) != flat_new.get(key))


_NO_BREAKS = 10**6  # characters of a line


class _Dumper(yaml.SafeDumper):
    """Quotes text that would be read as another type, and escapes what is not printable."""


_Dumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, None if text.isprintable() else '"'),
)


_Dumper.add_implicit_resolver("!number", re.compile(r"^[-+]?[\d_]*\.?[\d_]*[eE][-+]?\d+$"), list("-+.0123456789"))


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        text = read_bounded(path, _MOST_BYTES).decode()
    except FileNotFoundError:
        fix = "`vjepa2-ac init` writes one for your data; `vjepa2-ac config list` shows those of the package"
        raise InputError(where=str(path), found="no such file", needed="a config", fix=fix) from None
    except IsADirectoryError:
        fix = f"If it holds data, run `{shell_command('init', path)}`, which writes a config"
        if (path / "config.yaml").is_file():
            fix = f"The config of the run in it is {path / 'config.yaml'}"
        raise InputError(where=str(path), found="a folder", needed="a config, which is a YAML file", fix=fix) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", needed="a YAML file") from None
    values = _parse_document(text, where=str(path))
    if not isinstance(values, dict):
        found = "nothing" if values is None else f"a {type(values).__name__}"
        raise InputError(where=str(path), found=found, needed="a mapping of keys to values")
    return values


def _as_json(values: Mapping[str, Any], where: str) -> str:
    """Return values as a file would hold them: a Path is text."""
    try:
        return json.dumps(dict(values), default=os.fspath)
    except (TypeError, ValueError) as error:
        raise InputError(where=where, found=f"a value that a config cannot hold ({error})") from None


_KEYS_OF_A_RUN = {"check_crc", "connections", "prefetch", "short_episodes"}


def _keep_drawn_splits(values: Mapping[str, Any]) -> None:
    """Set `data.splits` to hash in the config of a run that is older than this key, when all splits were drawn.

    The config of a run is recognised by keys that are seldom written by hand: it has every key of its version.
    """
    replay = values.get("replay")
    for data in (values.get("data"), replay.get("data") if isinstance(replay, dict) else None):
        if isinstance(data, dict) and data.keys() >= _KEYS_OF_A_RUN:
            data.setdefault("splits", "hash")


def _set(values: dict[str, Any], keys: list[str], value: Any, override: str) -> None:
    for depth, key in enumerate(keys[:-1]):
        if values.get(key) is None:
            values[key] = {}
        if isinstance(values[key], str) and keys[depth + 1] == "options":
            values[key] = {"name": values[key]}  # of a component
        inner = values[key]
        if not isinstance(inner, dict):
            found = f"{'.'.join(keys[: depth + 1])} is a value"
            raise InputError(where=f"override {override}", found=found, needed="a section")
        values = inner
    if keys[-2:] == ["data", "source"] and value != values.get("source", "rlds"):
        others = [kind for name, kind in DataConfig.kinds.items() if name != value]
        for section in {section for kind in others for section in kind.own_sections()}:
            values.pop(section, None)  # of the form of data that it replaces
    values[keys[-1]] = value


_OLDER_GRIPPERS = {"closedness": {}, "openness": {"gripper_open": 1.0, "gripper_closed": 0.0}}


def _replace_keys_of_model(model: dict[str, Any]) -> None:
    """Replace the key `random` of 0.1, the sizes of a fresh predictor, by `base: random` and `sizes`."""
    if (sizes := model.pop("random", None)) is not None:
        model.update(base=RANDOM, sizes=sizes)


def _replace_older_keys(values: dict[str, Any]) -> None:
    """Replace, in configs of older runs, the key gripper of `data.fields` and two schedules by what means the same."""
    for section, inner in values.items():
        if section == "training" and isinstance(inner, dict) and inner.get("schedule") in ("constant", "linear"):
            decay_steps = _steps_after_warmup(inner) if inner["schedule"] == "linear" else 0
            inner |= {"schedule": "warmup_stable_decay", "decay_steps": decay_steps}
        gripper = inner.get("gripper") if section == "fields" and isinstance(inner, dict) else None
        if isinstance(gripper, str) and gripper in _OLDER_GRIPPERS:
            del inner["gripper"]
            inner.update(_OLDER_GRIPPERS[gripper])
        elif isinstance(inner, dict):
            _replace_older_keys(inner)


def _steps_after_warmup(training: Mapping[str, Any]) -> int:
    """Return the steps after the warm-up; 0 for values of another type, which the check of the config refuses."""
    steps = training.get("steps", TrainingConfig.model_fields["steps"].default)
    warmup_steps = training.get("warmup_steps")
    if not isinstance(steps, int) or not isinstance(warmup_steps, int | None):
        return 0
    return max(0, steps - (usual_warmup({"steps": steps}) if warmup_steps is None else warmup_steps))


# ---- plug-ins: modules that are imported before a config is checked; what they register may be named in it ----

_named: list[str] = []  # by `--plugin`


def name_plugins(modules: list[str]) -> None:
    """Import the modules of `--plugin`; every config that is read from now on names them, too.

    Raises:
        InputError: One is not there.
    """
    import_plugins(modules, where="--plugin")
    _named.extend(modules)


def with_plugins(values: Mapping[str, Any], *, where: str, here: bool) -> dict[str, Any]:
    """Import the plug-ins of a config, and the installed form of data that it names; return it with all plug-ins.

    Args:
        values: The plain values, which may be wrong.
        where: Its file.
        here: As for `registry.import_plugins`.

    Raises:
        InputError: One is not there.
    """
    given = values.get("plugins")
    if given is not None and not (isinstance(given, list) and all(isinstance(one, str) for one in given)):
        return dict(values)  # an error, which the check names
    plugins = list(dict.fromkeys([*(given or ()), *_named]))
    import_plugins([one for one in plugins if one not in _named], where=f"{where}: plugins", here=here)
    replay = values.get("replay")
    for data in (values.get("data"), replay.get("data") if isinstance(replay, dict) else None):
        if (source := source_of(data)) in SOURCES.names():
            SOURCES.find(source)
    admit_forms_of_data()
    return {**values, "plugins": plugins} if plugins else dict(values)


def admit_forms_of_data(*, all_installed: bool = False) -> None:
    """Let configs hold the forms of data that were defined since the last time.

    Args:
        all_installed: Import those of all installed packages first.
    """
    for name in SOURCES.names() if all_installed else ():
        SOURCES.find(name)
    if _admitted != DataConfig.kinds:
        for section in (DataConfig, ReplayConfig, Config):
            section.model_rebuild(force=True)
        marks_of.cache_clear()
        _admitted.update(DataConfig.kinds)


_admitted = dict(DataConfig.kinds)


# ---- what is wrong ----

_TYPE_OF_A_UNION = re.compile(r"int|float|str|bool|.*[\[(-].*")  # as pydantic names it in the location of an error


def _wrong_values(error: ValidationError) -> list[str]:
    """Return a line for every wrong value; a knob that may be of several types gets one line, not one per type."""
    found: dict[str, list[str]] = {}
    for detail in error.errors(include_url=False):
        if detail["type"] != "default_factory_not_called":  # a default that follows from another value, which is wrong
            key = _key_of(detail["loc"]) + ".source" * (detail["type"] == "union_tag_invalid")
            *others, last = dict.fromkeys([*found.get(key, ()), _explain(key, detail)])
            found[key] = [*(line.split(" (found ")[0] for line in others), last]  # all of the same value
    inherited = {
        key for key, lines in found.items() if key_of_data(key) != key and found.get(key_of_data(key)) == lines
    }
    return [f"{key}: {', or '.join(lines)}".removeprefix(": ") for key, lines in found.items() if key not in inherited]


def all_keys() -> list[str]:
    """Return the dotted keys of all sections and knobs."""
    paths = [key.split(".") for key in marks_of(Config)]
    return list(dict.fromkeys(".".join(path[:depth]) for path in paths for depth in range(1, len(path) + 1)))


def _key_of(location: Sequence[Any]) -> str:
    """Return the dotted key of pydantic's location, without its names for forms of data and types of a union."""
    parts: list[str] = []
    for before, part in zip(["", *location], map(str, location), strict=False):
        is_form = before == "data" and part in DataConfig.kinds
        if not is_form and not (_TYPE_OF_A_UNION.fullmatch(part) and key_of_data(".".join(parts)) in all_keys()):
            parts.append(part)
    return ".".join(parts)


def _explain(key: str, detail: Any) -> str:
    if detail["type"] == "missing":
        return "missing; it has no default"
    if detail["type"] == "union_tag_invalid":
        return f"Input should be {' or '.join(map(repr, DataConfig.kinds))} (found {detail['ctx']['tag']!r})"
    if detail["type"] == UNKNOWN_OPTION:
        return str(detail["msg"])
    if detail["type"] != "extra_forbidden":
        return message_of(detail)
    key = key_of_data(key)
    section, dot, name = key.rpartition(".")
    if (why := why_removed(key)) is not None:
        return why
    if key in all_keys():
        owners = [source for source, kind in DataConfig.kinds.items() if name in kind.model_fields]
        return f"a section of source {' or '.join(owners)}, and this is source {detail['loc'][-2]}"
    prefix = section + dot
    siblings = [one.removeprefix(prefix) for one in all_keys() if one.rpartition(".")[0] == section]
    close = difflib.get_close_matches(name, siblings, n=1)
    elsewhere = [one for one in all_keys() if one.endswith(f".{name}")]
    if meant := [*close, *elsewhere]:
        return f"unknown key; did you mean {meant[0]}?"
    return f"unknown key; known here: {', '.join(siblings)}"
