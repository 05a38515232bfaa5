"""Paths from the user are resolved by the same rules in config keys, options and environment variables."""

from pathlib import Path
from typing import Any

import pytest

from made_pages import _find_commands
from vjepa2_ac.cli.options import as_config, as_local, as_model, as_path, as_path_or_url
from vjepa2_ac.cli.program import _make_parser, main
from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.config.loading import all_keys, config_as_flat_dict, parse_config
from vjepa2_ac.data.index import cache_folder
from vjepa2_ac.errors import InputError

LOCAL_PATH_KEYS = (
    "run_dir",
    "data.disk_cache.dir",
    "model.base",
    "model.encoder.path",
    "decoder.folder",
)
OTHER_PATH_KEYS = ("data.path", "data.cache_dir", "data.idle.ranges", "checkpoint.remote")
LOOK_LIKE_PATHS = ("dir", "path", "folder", "base", "remote", "ranges")  # last part of a key


def config_with(key: str, value: str) -> dict[str, Any]:
    values: dict[str, Any] = {"run_dir": "run", "data": {"path": "set"}, "model": {"base": "base"}}
    if key == "data.idle.ranges":
        values["data"]["idle"] = {"rule": "published"}
    *sections, name = key.split(".")
    section_values = values
    for section in sections:
        section_values = section_values.setdefault(section, {})
    section_values[name] = value
    return values


def read(key: str, value: str) -> str:
    return config_as_flat_dict(parse_config(config_with(key, value), where="test"))[key]


def test_all_path_keys_are_covered() -> None:
    keys = {key for key in all_keys() if not key.startswith("replay.data.")}  # the same keys as in data
    path_keys = {key for key in keys if key.split(".")[-1].endswith(LOOK_LIKE_PATHS)}
    path_keys.remove("training.allow_weak_base")
    assert path_keys == {*LOCAL_PATH_KEYS, *OTHER_PATH_KEYS}


@pytest.mark.parametrize("key", [*LOCAL_PATH_KEYS, *OTHER_PATH_KEYS])
def test_all_path_keys_expand_the_home_folder(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/of/mine")
    assert read(key, "~/x/") == "/home/of/mine/x"
    assert read(key, "./~/x") == "./~/x", "a folder may have the name ~"
    for wrong in ("~nobody-at-all/x", " ", "gs:/bucket/x"):
        with pytest.raises(InputError, match=rf"  {key}: "):
            read(key, wrong)


@pytest.mark.parametrize("key", LOCAL_PATH_KEYS)
@pytest.mark.parametrize("url", ["gs://bucket/run", "file:///x", "S3://x"])
def test_url_for_a_local_path_key_raises(key: str, url: str) -> None:
    with pytest.raises(InputError, match=rf"  {key}: is a URL .*{url}"):
        read(key, url)


@pytest.mark.parametrize("key", OTHER_PATH_KEYS)
def test_url_is_unchanged_for_other_path_keys(key: str) -> None:
    assert read(key, "gs://bucket/~x/") == "gs://bucket/~x"


def test_cache_environment_variable_is_resolved_like_a_path_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/of/mine")
    monkeypatch.setenv("VJEPA2_AC_CACHE", "~/cache")
    assert cache_folder(DiskCacheConfig()) == Path("/home/of/mine/cache")
    monkeypatch.setenv("VJEPA2_AC_CACHE", "gs://bucket/cache")
    with pytest.raises(InputError, match="VJEPA2_AC_CACHE: 'gs://bucket/cache' is a URL"):
        cache_folder(DiskCacheConfig())


def test_all_path_options_use_the_same_resolution() -> None:
    path_words = {"CONFIG", "FOLDER", "DIR", "PATH", "PNG", "IMAGE", "RUN", "MODEL", "RUN_OR_MODEL"}
    num_path_options = 0
    actions = ((words, action) for words, parser in _find_commands(_make_parser(), ()) for action in parser._actions)
    for command, action in actions:
        is_path = path_words & set(str(action.metavar).replace("|", " ").split())
        if is_path and action.dest != "overrides":
            num_path_options += 1
            readers = {as_config, as_path, as_local, as_model, as_path_or_url}
            assert action.type in readers, f"{command}: {action.dest}"
    assert num_path_options > 20


def test_path_option_expands_home_and_rejects_urls(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setenv("HOME", "/home/of/mine")
    options = _make_parser().parse_args(["data", "inspect", "~/c.yaml", "--out=~/x"])
    assert (options.config, options.out) == ("/home/of/mine/c.yaml", Path("/home/of/mine/x"))
    for arguments in (["export", "run", "gs://b/x"], ["evaluate", "run", "--out=gs:/b"], ["train", "s3://b/run"]):
        with pytest.raises(SystemExit, match="2"):
            main(arguments)
        assert "is a URL" in capsys.readouterr().err
    assert main(["simulate", "record", "gs://b/x"]) == 2
    assert "simulate record: 'gs://b/x' is a URL" in capsys.readouterr().err
