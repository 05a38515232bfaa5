"""Config loading: strict YAML with dotted overrides; all errors are reported at once, with their paths."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml  # to write: `storage.structured` reads
from pydantic import ValidationError

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import without_sections_of_others
from vjepa2_ac.config.diagnostics import wrong_values
from vjepa2_ac.config.gone import GONE, take_gone
from vjepa2_ac.config.packaged import config_path
from vjepa2_ac.config.plugins import admit_forms_of_data, with_plugins
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import parse_yaml, require_shallow

_MOST_BYTES = 4 << 20  # of a config: data.exclude may name thousands of episodes


def load_config(config: str | Path | Mapping[str, Any], overrides: Iterable[str] = ()) -> Config:
    """Read a config, from a file or from plain values, and apply `key.sub=value` overrides.

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
        return config_from(config, overrides, where="load_config")
    return parse_config(_overridden(_read_yaml(config_path(config)), overrides), where=str(config))


def load_config_of_run(path: Path, overrides: Iterable[str] = ()) -> Config:
    """Read the config of a run that was made: knobs that are gone since then are passed over, in use or not.

    It may be one of the package, as for `load_config`.

    Raises:
        InputError: As `load_config`.
    """
    values = _read_yaml(config_path(path))
    take_gone(values)
    return parse_config(_overridden(values, overrides), where=str(path), here=False)


def gone_in_use(path: Path) -> dict[str, Any]:
    """Return the knobs that are gone and that the run of a config was made with, by dotted key.

    Raises:
        InputError: The file cannot be read.
    """
    return take_gone(_read_yaml(path))


def config_from(values: Mapping[str, Any], overrides: Iterable[str] = (), *, where: str) -> Config:
    """Return a config of plain values with `key.sub=value` overrides, without a file.

    Raises:
        InputError: Names every key that is wrong.
    """
    return parse_config(_overridden(json.loads(_as_json(values, where)), overrides), where=where)


def parse_config(values: Mapping[str, Any], *, where: str, here: bool = True) -> Config:
    """Validate plain values, as YAML or JSON gives them; a knob that is gone may stand there where it is off.

    Args:
        values: The values.
        where: Their file, for messages.
        here: Whether plug-ins may lie in the working directory: not those of a run, which may be a stranger's.

    Raises:
        InputError: Names every key that is wrong, all at once.
    """
    plain = with_plugins(json.loads(_as_json(values, where)), where=where, here=here)
    if "data" in plain:
        plain["data"] = without_sections_of_others(plain["data"])
    lines = [f"{key}: {GONE[key]}; leave it out" for key in take_gone(plain)]
    try:
        config = Config.model_validate_json(json.dumps(plain))
    except ValidationError as error:
        lines += wrong_values(plain, error)
    else:
        if not lines:
            return config
    found = f"{len(lines)} value{'s are' if len(lines) > 1 else ' is'} wrong\n  " + "\n  ".join(lines) + "\n"
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
    return str(yaml.dump(config_as_dict(config), Dumper=_Dumper, sort_keys=False))


def yaml_line(key: str, value: Any) -> str:
    """Return a key and its value as one line of YAML, which reads back as they are."""
    style = None if isinstance(value, dict | list) else False  # None: what has nothing nested within is on one line
    text = yaml.dump({key: value}, Dumper=_Dumper, sort_keys=False, default_flow_style=style, width=10**6)
    return str(text).rstrip("\n")


def config_schema() -> dict[str, Any]:
    """Return the JSON schema of a config file, for editors."""
    admit_forms_of_data(all_installed=True)
    return Config.model_json_schema()


def changed_keys(old: Config, new: Config) -> list[str]:
    """Return the dotted keys in which two configs differ."""
    flat_old, flat_new = config_as_flat_dict(old), config_as_flat_dict(new)
    return sorted(key for key in flat_old.keys() | flat_new.keys() if flat_old.get(key) != flat_new.get(key))


class _Dumper(yaml.SafeDumper):
    """Quotes text that would be read as another type."""


_Dumper.add_implicit_resolver("!number", re.compile(r"^[-+]?[\d_]*\.?[\d_]*[eE][-+]?\d+$"), list("-+.0123456789"))


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:  # which may be a pipe
            data = file.read(_MOST_BYTES + 1)
        text = data.decode()
    except FileNotFoundError:
        fix = "`vjepa2-ac init` writes one for your data; `vjepa2-ac config list` shows those of the package"
        raise InputError(where=str(path), found="no such file", needed="a config", fix=fix) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", needed="a YAML file") from None
    if len(data) > _MOST_BYTES:
        raise InputError(where=str(path), found=f"more than {_MOST_BYTES:,} bytes", needed="a config")
    values = parse_yaml(text, where=str(path))
    if not isinstance(values, dict):
        found = "nothing" if values is None else f"a {type(values).__name__}"
        raise InputError(where=str(path), found=found, needed="a mapping of keys to values")
    return values


def _as_json(values: Mapping[str, Any], where: str) -> str:
    """Return values as a file would hold them: a Path is text."""
    require_shallow(dict(values), where=where)
    try:
        return json.dumps(dict(values), default=os.fspath)
    except (TypeError, ValueError) as error:
        raise InputError(where=where, found=f"a value that a config cannot hold ({error})") from None


def _overridden(values: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    for override in overrides:
        key, separator, text = override.partition("=")
        if not separator or not key:
            raise InputError(where="overrides", found=f"{override!r}", needed="key=value, such as training.steps=100")
        _set(values, key.split("."), parse_yaml(text, where=f"override {key}"), override)
    return values


def _set(values: dict[str, Any], keys: list[str], value: Any, override: str) -> None:
    for depth, key in enumerate(keys[:-1]):
        if values.get(key) is None:
            values[key] = {}
        inner = values[key]
        if not isinstance(inner, dict):
            found = f"{'.'.join(keys[: depth + 1])} is a value"
            raise InputError(where=f"override {override}", found=found, needed="a section")
        values = inner
    values[keys[-1]] = value
