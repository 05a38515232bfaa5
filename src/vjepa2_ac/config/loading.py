"""Config loading: strict YAML with dotted overrides; all errors are reported at once, with their keys."""

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

import yaml  # for writing; `storage.structured` parses
from pydantic import ValidationError

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.config.data import source_of
from vjepa2_ac.config.model import RANDOM
from vjepa2_ac.config.planning import PRESETS
from vjepa2_ac.config.removed import drop_removed_keys, explain_removed_key, move_component_options, move_norm_limit
from vjepa2_ac.config.run import ReplayConfig, with_complete_replay
from vjepa2_ac.config.section import collect_effects, to_data_key
from vjepa2_ac.config.training import TrainingConfig, default_warmup_steps
from vjepa2_ac.errors import InputError, shell_command
from vjepa2_ac.registry import SOURCES, UNKNOWN_OPTION, import_plugins
from vjepa2_ac.storage import read_small_file
from vjepa2_ac.storage.paths import BUILTIN, NO_DATA
from vjepa2_ac.storage.structured import describe_validation_error, parse_yaml

_MAX_BYTES = 1_000_000  # size limit of a config file: PyYAML needs a minute for 20 MB
# Cached because a command reads the config of its run several times, which takes 20 ms each. `parse_config` copies the
# values, so that the cached ones do not change.
_parse_document = lru_cache(maxsize=8)(parse_yaml)
_RUN_FILES = ("run_id", "environment.json", "metrics.jsonl")  # a run folder contains at least one of these files
_PACKAGED = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets" / "configs"


def load_config(config: str | Path | Mapping[str, Any], overrides: Iterable[str] = ()) -> Config:
    """Load a config from a file or from plain values, and apply `key.sub=value` overrides.

    Plug-ins may be in the working directory, unless the file is in a run folder (`load_config_of_run`).

    Args:
        config: A file, `builtin:NAME` for a config of the package, or plain values.
        overrides: For example training.steps=100.

    Raises:
        InputError: The file cannot be read or is not a valid config; names every wrong key.

    Example:
        >>> config = load_config("builtin:demo", ["training.steps=100"])  # or a file, such as configs/demo.yaml
        >>> config = load_config({"run_dir": "run", "data": {"path": "data"}, "model": {"base": "builtin:sim-tiny"}})
    """
    if isinstance(config, Mapping):
        return parse_config(config, overrides, where="load_config")
    path = config_path(config)
    is_in_run_folder = any((path.parent / name).exists() for name in _RUN_FILES)
    return parse_config(_read_yaml(path), overrides, where=str(config), local_plugins=not is_in_run_folder)


def config_of_model(base: str, overrides: Iterable[str] = (), *, where: str = "overrides", **model: Any) -> Config:
    """Return a config with default values for using a model without a config file; its data set is a placeholder.

    Args:
        base: The model, as in `model.base`.
        overrides: For example planning.horizon=2.
        where: The origin of the values, for messages.
        model: Further values of the section `model`, such as dtype.

    Raises:
        InputError: A value is wrong; names every wrong key.
    """
    values = {"run_dir": "none", "data": {"path": NO_DATA}, "model": {"base": base, **model}}
    return parse_config(values, overrides, where=where)


def load_config_of_run(path: str | Path, overrides: Iterable[str] = ()) -> Config:
    """Load the config of a run. It may be untrusted, so its plug-ins are not imported from the working directory."""
    return parse_config(_read_yaml(config_path(path)), overrides, where=str(path), local_plugins=False)


def packaged_configs() -> dict[str, str]:
    """Return the configs of the package: name -> first sentence of the comment at its top."""
    heads = {path.stem: path.read_text(encoding="utf-8").split("\n\n")[0] for path in _PACKAGED.glob("*.yaml")}
    return {name: re.sub(r"\n?# ?", " ", head).split(". ")[0].strip(" .:\n") for name, head in sorted(heads.items())}


def config_path(name: str | Path) -> Path:
    """Return the file of a config: for `builtin:NAME` the file in the package, otherwise the path itself.

    Raises:
        InputError: The package has no config of that name.
    """
    if not str(name).startswith(BUILTIN):
        return Path(name)
    if (stem := str(name).removeprefix(BUILTIN)) not in packaged_configs():
        needed = f"one of {', '.join(f'{BUILTIN}{config}' for config in packaged_configs())}"
        raise InputError(where=str(name), found="the package has no config of this name", needed=needed)
    return _PACKAGED / f"{stem}.yaml"


def parse_config(
    values: Mapping[str, Any], overrides: Iterable[str] = (), *, where: str, local_plugins: bool = True
) -> Config:
    """Validate plain values, as from YAML or JSON, with `key.sub=value` overrides.

    Args:
        values: The values; a Path is converted to text.
        overrides: For example training.steps=100.
        where: The file of the values, for messages.
        local_plugins: Whether plug-ins may be imported from the working directory; False for the config of a run, which
            may be untrusted.

    Raises:
        InputError: A value is wrong; names every wrong key.
    """
    plain = json.loads(_as_json(values, where))
    _keep_drawn_splits(plain)
    if not local_plugins:
        drop_removed_keys(plain, where)
        move_norm_limit(plain, where)
        move_component_options(plain, where)
    for override in expand_presets(overrides):
        key, separator, text = override.partition("=")
        if not separator or not key:
            raise InputError(where="overrides", found=f"{override!r}", needed="key=value, such as training.steps=100")
        _set_value(plain, key.split("."), parse_yaml(text, where=f"override {key}"), override)
    _replace_older_keys(plain)
    if isinstance(plain.get("model"), dict):
        _replace_keys_of_model(plain["model"])
    try:
        plain = with_plugins(plain, where=where, local_plugins=local_plugins)
        return Config.model_validate_json(_as_json(with_complete_replay(plain), where))
    except ValidationError as error:
        lines = _describe_wrong_values(error)
    problem = "\n  ".join([f"{len(lines)} value{'s are' if len(lines) > 1 else ' is'} wrong", *lines]) + "\n"
    raise InputError(where=where, found=problem, fix="`vjepa2-ac config schema` lists every key with its range")


def expand_presets(overrides: Iterable[str]) -> list[str]:
    """Return overrides in which the keys of the preset replace `planning.preset=NAME`.

    Raises:
        InputError: There is no preset of that name.
    """
    expanded = list[str]()
    for override in overrides:
        key, _, name = override.partition("=")
        if key != PRESET:
            expanded.append(override)
        elif name in PRESETS:
            expanded += [f"planning.{size}={value}" for size, value in PRESETS[name].items()]
        else:
            raise InputError(where=f"override {override}", found="no preset", needed=f"one of {', '.join(PRESETS)}")
    return expanded


def config_as_dict(config: Config) -> dict[str, Any]:
    """Return the resolved config as plain values, defaults included."""
    return dict(config.model_dump(mode="json"))


def config_as_flat_dict(config: Config) -> dict[str, Any]:
    """Return the resolved config by dotted keys, the format that trackers accept."""
    return flatten(config_as_dict(config))


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested values by their dotted keys."""
    by_key: dict[str, Any] = {}
    for key, value in values.items():
        by_key |= flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return by_key


def config_as_yaml(config: Config) -> str:
    """Return the resolved config as YAML, from which `load_config` reads an equal config."""
    return str(yaml.dump(config_as_dict(config), Dumper=_Dumper, sort_keys=False, width=_NO_BREAKS))


def yaml_line(key: str, value: Any) -> str:
    """Return a key and its value as one line of YAML."""
    text = yaml.dump([{key: value}], Dumper=_Dumper, sort_keys=False, default_flow_style=True, width=_NO_BREAKS)
    return str(text).removeprefix("[{").removesuffix("}]\n")


def config_schema() -> dict[str, Any]:
    """Return the JSON schema of a config file, for editors."""
    accept_new_data_formats(all_installed=True)
    return Config.model_json_schema()


def changed_keys(old: Config, new: Config) -> list[str]:
    """Return the dotted keys whose values differ between two configs."""
    flat_old, flat_new = config_as_flat_dict(old), config_as_flat_dict(new)
    return sorted(key for key in flat_old.keys() | flat_new.keys() if flat_old.get(key) != flat_new.get(key))


PRESET = "planning.preset"  # an override that sets several keys
_NO_BREAKS = 10**6  # characters per line, so that YAML breaks no line


class _Dumper(yaml.SafeDumper):
    """A YAML dumper that quotes text which YAML would parse as another type, and escapes unprintable characters."""


_Dumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, None if text.isprintable() else '"'),
)


_Dumper.add_implicit_resolver("!number", re.compile(r"^[-+]?[\d_]*\.?[\d_]*[eE][-+]?\d+$"), list("-+.0123456789"))


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        text = read_small_file(path, _MAX_BYTES).decode()
    except FileNotFoundError:
        fix = "`vjepa2-ac init` writes one for your data; `vjepa2-ac config list` shows those of the package"
        raise InputError(where=str(path), found="no such file", needed="a config", fix=fix) from None
    except IsADirectoryError:
        fix = f"If it contains data, run `{shell_command('init', path)}`, which writes a config"
        if (path / "config.yaml").is_file():
            fix = f"The config of the run in it is {path / 'config.yaml'}"
        raise InputError(where=str(path), found="a folder", needed="a config, which is a YAML file", fix=fix) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", needed="a YAML file") from None
    values = _parse_document(text, where=str(path))
    if not isinstance(values, dict):
        description = "nothing" if values is None else f"a {type(values).__name__}"
        raise InputError(where=str(path), found=description, needed="a mapping of keys to values")
    return values


def _as_json(values: Mapping[str, Any], where: str) -> str:
    """Return values as JSON; a Path becomes text."""
    try:
        return json.dumps(dict(values), default=os.fspath)
    except (TypeError, ValueError) as error:
        raise InputError(where=where, found=f"a value that a config cannot contain ({error})") from None


_RARELY_WRITTEN_KEYS = {"check_crc", "connections", "prefetch", "short_episodes"}


def _keep_drawn_splits(values: Mapping[str, Any]) -> None:
    """Set `data.splits` to hash in the config of an older run without this key, because all its splits were drawn.

    The config of a run contains all keys of its version. It is recognised by removed keys that users rarely wrote.
    """
    replay = values.get("replay")
    for data in (values.get("data"), replay.get("data") if isinstance(replay, dict) else None):
        if isinstance(data, dict) and data.keys() >= _RARELY_WRITTEN_KEYS:
            data.setdefault("splits", "hash")


def _set_value(values: dict[str, Any], keys: list[str], value: Any, override: str) -> None:
    for depth, key in enumerate(keys[:-1]):
        if values.get(key) is None:
            values[key] = {}
        if isinstance(values[key], str) and keys[depth + 1] == "options":
            values[key] = {"name": values[key]}  # a component that was set by its name only
        inner = values[key]
        if not isinstance(inner, dict):
            problem = f"{'.'.join(keys[: depth + 1])} is a value"
            raise InputError(where=f"override {override}", found=problem, needed="a section")
        values = inner
    if keys[-2:] == ["data", "source"] and value != values.get("source", "rlds"):
        former_formats = [kind for name, kind in DataConfig.kinds.items() if name != value]
        for section in {section for kind in former_formats for section in kind.format_sections()}:
            values.pop(section, None)  # options of the former data format would be unknown keys
    values[keys[-1]] = value


_OLDER_GRIPPER_VALUES = {"closedness": {}, "openness": {"gripper_open": 1.0, "gripper_closed": 0.0}}


def _replace_keys_of_model(model: dict[str, Any]) -> None:
    """Replace the key `random` of version 0.1 (the sizes of a new predictor) by `base: random` and `sizes`."""
    if (sizes := model.pop("random", None)) is not None:
        model.update(base=RANDOM, sizes=sizes)


def _replace_older_keys(values: dict[str, Any]) -> None:
    """Replace keys of older runs (`gripper` in `data.fields`, and two schedules) by the equivalent keys of today."""
    for section, inner in values.items():
        if section == "training" and isinstance(inner, dict) and inner.get("schedule") in ("constant", "linear"):
            decay_steps = _steps_after_warmup(inner) if inner["schedule"] == "linear" else 0
            inner |= {"schedule": "warmup_stable_decay", "decay_steps": decay_steps}
        gripper = inner.get("gripper") if section == "fields" and isinstance(inner, dict) else None
        if isinstance(gripper, str) and gripper in _OLDER_GRIPPER_VALUES:
            del inner["gripper"]
            inner.update(_OLDER_GRIPPER_VALUES[gripper])
        elif isinstance(inner, dict):
            _replace_older_keys(inner)


def _steps_after_warmup(training: Mapping[str, Any]) -> int:
    """Return the number of steps after the warm-up.

    If a value has a wrong type, return 0, because validation reports this error later.
    """
    steps = training.get("steps", TrainingConfig.model_fields["steps"].default)
    warmup_steps = training.get("warmup_steps")
    if not isinstance(steps, int) or not isinstance(warmup_steps, int | None):
        return 0
    return max(0, steps - (default_warmup_steps({"steps": steps}) if warmup_steps is None else warmup_steps))


# ---- plug-ins: modules that are imported before a config is validated, because it may use their components ----

_command_line_plugins: list[str] = []  # modules of `--plugin`


def register_plugins(modules: list[str]) -> None:
    """Import the modules of `--plugin`, and add them to the plug-ins of every config that is read later.

    Raises:
        InputError: A module does not exist.
    """
    import_plugins(modules, where="--plugin")
    _command_line_plugins.extend(modules)


def with_plugins(values: Mapping[str, Any], *, where: str, local_plugins: bool) -> dict[str, Any]:
    """Import the plug-ins and the data format of a config; return the values with the plug-ins of --plugin added.

    Args:
        values: The plain values, not validated yet.
        where: The file of the config.
        local_plugins: See `registry.import_plugins`.

    Raises:
        InputError: A plug-in does not exist.
    """
    configured = values.get("plugins")
    if configured is not None and not (
        isinstance(configured, list) and all(isinstance(module, str) for module in configured)
    ):
        return dict(values)  # validation reports this error later
    plugins = list(dict.fromkeys([*(configured or ()), *_command_line_plugins]))
    import_plugins(
        [module for module in plugins if module not in _command_line_plugins],
        where=f"{where}: plugins",
        allow_local=local_plugins,
    )
    replay = values.get("replay")
    for data in (values.get("data"), replay.get("data") if isinstance(replay, dict) else None):
        if (source := source_of(data)) in SOURCES.names():
            SOURCES.find(source)
    accept_new_data_formats()
    return {**values, "plugins": plugins} if plugins else dict(values)


def accept_new_data_formats(*, all_installed: bool = False) -> None:
    """Rebuild the config classes, so that they accept data formats that were registered since the last call.

    Args:
        all_installed: Import the data formats of all installed packages first.
    """
    for name in SOURCES.names() if all_installed else ():
        SOURCES.find(name)
    if _accepted_formats != DataConfig.kinds:
        for section in (DataConfig, ReplayConfig, Config):
            section.model_rebuild(force=True)
        collect_effects.cache_clear()
        _accepted_formats.update(DataConfig.kinds)


_accepted_formats = dict(DataConfig.kinds)


# ---- error messages ----

_TYPE_OF_A_UNION = re.compile(r"int|float|str|bool|.*[\[(-].*")  # pydantic's names of types in error locations


def _describe_wrong_values(error: ValidationError) -> list[str]:
    """Return a line for every wrong value; a key that allows several types gets one line, not one per type."""
    lines_by_key: dict[str, list[str]] = {}
    for detail in error.errors(include_url=False):
        if detail["type"] != "default_factory_not_called":  # its cause, another wrong value, has its own line
            key = _key_of(detail["loc"]) + ".source" * (detail["type"] == "union_tag_invalid")
            *earlier, last = dict.fromkeys([*lines_by_key.get(key, ()), _explain(key, detail)])
            lines_by_key[key] = [*(line.split(" (found ")[0] for line in earlier), last]  # print the value only once
    inherited = {
        key
        for key, lines in lines_by_key.items()
        if to_data_key(key) != key and lines_by_key.get(to_data_key(key)) == lines
    }
    return [
        f"{key}: {', or '.join(lines)}".removeprefix(": ")
        for key, lines in lines_by_key.items()
        if key not in inherited
    ]


def all_keys() -> list[str]:
    """Return the dotted names of all sections and keys."""
    paths = [key.split(".") for key in collect_effects(Config)]
    return list(dict.fromkeys(".".join(path[:depth]) for path in paths for depth in range(1, len(path) + 1)))


def _key_of(location: Sequence[Any]) -> str:
    """Return the dotted key for an error location of pydantic, without pydantic's names of data formats and types."""
    parts: list[str] = []
    for previous, part in zip(["", *location], map(str, location), strict=False):
        is_format = previous == "data" and part in DataConfig.kinds
        if not is_format and not (_TYPE_OF_A_UNION.fullmatch(part) and to_data_key(".".join(parts)) in all_keys()):
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
        return describe_validation_error(detail)
    key = to_data_key(key)
    section, dot, name = key.rpartition(".")
    if (explanation := explain_removed_key(key)) is not None:
        return explanation
    if key in all_keys():
        owners = [source for source, kind in DataConfig.kinds.items() if name in kind.model_fields]
        return f"only for source {' or '.join(owners)}, and this is source {detail['loc'][-2]}"
    prefix = section + dot
    siblings = [other.removeprefix(prefix) for other in all_keys() if other.rpartition(".")[0] == section]
    close_siblings = difflib.get_close_matches(name, siblings, n=1)
    same_name = [other for other in all_keys() if other.endswith(f".{name}")]
    if suggestions := [*close_siblings, *same_name]:
        return f"unknown key; did you mean {suggestions[0]}?"
    return f"unknown key; available: {', '.join(siblings)}"
