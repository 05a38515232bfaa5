"""Config loading: strict YAML with dotted overrides; all errors are reported at once, with their paths."""

from __future__ import annotations

import importlib.resources
import json
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml  # to write: `storage.structured` reads
from pydantic import ValidationError

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.config.diagnostics import wrong_values
from vjepa2_ac.errors import InputError
from vjepa2_ac.places import BUILTIN
from vjepa2_ac.storage.structured import parse_yaml

_PACKAGED = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets" / "configs"


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


def config_from(values: Mapping[str, Any], overrides: Iterable[str] = (), *, where: str) -> Config:
    """Return a config of plain values with `key.sub=value` overrides, without a file.

    Raises:
        InputError: Names every key that is wrong.
    """
    return parse_config(_overridden(json.loads(_as_json(values, where)), overrides), where=where)


def parse_config(values: Mapping[str, Any], *, where: str) -> Config:
    """Validate plain values, as YAML or JSON gives them.

    Raises:
        InputError: Names every key that is wrong, all at once.
    """
    try:
        return Config.model_validate_json(_as_json(values, where))
    except ValidationError as error:
        lines = wrong_values(error)
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
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        fix = "`vjepa2-ac init` writes one for your data; `vjepa2-ac config list` shows those of the package"
        raise InputError(where=str(path), found="no such file", needed="a config", fix=fix) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(where=str(path), found=f"cannot be read ({error})", needed="a YAML file") from None
    values = parse_yaml(text, where=str(path))
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
    if keys[-2:] == ["data", "source"] and value != values.get("source", "rlds"):
        others = [kind for name, kind in DataConfig.kinds.items() if name != value]
        for section in {section for kind in others for section in kind.own_sections()}:
            values.pop(section, None)  # of the form of data that it replaces
    values[keys[-1]] = value
