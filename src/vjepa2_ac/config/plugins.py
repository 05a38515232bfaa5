"""Plug-ins: modules that a config names are imported before it is checked; what they register may be named in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vjepa2_ac.config.data import DataConfig, source_of
from vjepa2_ac.config.replay import ReplayConfig
from vjepa2_ac.config.run import Config
from vjepa2_ac.registry import SOURCES, import_plugins

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
        if (source := source_of(data)) not in DataConfig.kinds and source in SOURCES.names():
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
    if (count := len(DataConfig.kinds)) != _admitted[0]:
        for section in (DataConfig, ReplayConfig, Config):
            section.model_rebuild(force=True)
        _admitted[0] = count


_admitted = [len(DataConfig.kinds)]
