"""Plug-ins: distinct names, errors that name the plug-in, and what the config of a run may import."""

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import pytest

from installing import leave_package
from run_fixtures import as_yaml
from vjepa2_ac import registry as doors
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.loading import load_config, parse_config
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.settings import load_planning_config
from vjepa2_ac.registry import LOSSES, import_plugins

Write = Callable[..., str]
VALUES = {"run_dir": "run", "data": {"path": "none"}, "model": {"base": "builtin:sim-tiny"}}
REGISTERS = "from vjepa2_ac.registry import LOSSES\n\n@LOSSES.register({name!r})\ndef {function}(p, t): return p - t\n"


@pytest.fixture(autouse=True)
def _restored(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Forget what a test registers and imports."""
    modules, kinds, path = set(sys.modules), dict(DataConfig.kinds), sys.path[:]
    for registry in (LOSSES, doors.SOURCES):
        for attribute in ("_things", "_origins"):
            monkeypatch.setattr(registry, attribute, getattr(registry, attribute).copy())
    monkeypatch.setattr(doors, "_registered", doors._registered[:])
    monkeypatch.setattr(doors, "_plugins", set(doors._plugins))
    yield
    DataConfig.kinds.clear()
    DataConfig.kinds.update(kinds)
    sys.path[:] = path
    for name in set(sys.modules) - modules:
        if name.startswith("p_"):
            del sys.modules[name]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Write a module into the working directory, by default one that registers a loss; return its name."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def write(name: str, code: str | None = None, folder: str = ".") -> str:
        Path(folder).mkdir(exist_ok=True)
        Path(folder, f"{name}.py").write_text(REGISTERS.format(name=name, function=name) if code is None else code)
        importlib.invalidate_caches()
        return name

    return write


# Each name is registered once, whichever way.


def test_plugin_cannot_register_a_builtin_name(write: Write) -> None:
    write("p_same", REGISTERS.format(name="l1", function="zero"))
    with pytest.raises(InputError, match=r"'p_same' cannot.*'l1': already registered by vjepa2_ac\.model\.distances"):
        import_plugins(["p_same"], where="own.yaml: plugins")
    assert LOSSES.find("l1").__module__ == "vjepa2_ac.model.distances"


def test_plugins_cannot_register_a_name_twice(write: Write) -> None:
    import_plugins([write("p_first")], where="plugins")
    write("p_second", REGISTERS.format(name="p_first", function="p_first"))
    write("p_twice", REGISTERS.format(name="p_one", function="f") + REGISTERS.format(name="p_one", function="g"))
    for module, owner in (("p_second", "p_first"), ("p_twice", "p_twice")):
        with pytest.raises(InputError, match=f"already registered by {owner}"):
            import_plugins([module], where="plugins")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """The folder of installed packages."""
    sys.path.append(str(tmp_path / "site"))
    return tmp_path / "site"


def test_entry_points_with_duplicate_names_raise(site: Path) -> None:
    leave_package(site, "p_a", "[vjepa2_ac.losses]\nl1 = p_a:thing\np_new = p_a:thing\n")
    leave_package(site, "p_b", "[vjepa2_ac.losses]\np_new = p_b:thing\n")
    for name, owners in (("l1", r"vjepa2_ac\.model\.distances and by p_a"), ("p_new", "p_a and by p_b")):
        with pytest.raises(InputError, match=f"loss '{name}': registered by {owners}"):
            parse_config({**VALUES, "training": {"loss": name}}, where="own.yaml")


def test_builtin_source_cannot_be_defined_again(site: Path) -> None:
    with pytest.raises(InputError, match=r"data format 'npz': already registered by vjepa2_ac\.config\.sources"):

        class DuplicateNpz(DataConfig):
            source: Literal["npz"] = "npz"

    leave_package(site, "p_npz", "[vjepa2_ac.sources]\nnpz = p_npz:thing\n")
    with pytest.raises(InputError, match=r"'npz': registered by vjepa2_ac\.config\.sources and by p_npz"):
        parse_config({**VALUES, "data": {"source": "npz", "path": "none"}}, where="own.yaml")


# Plug-ins that fail give one error.


@pytest.mark.parametrize(
    ("code", "cause"),
    [
        ("x = 1\nraise RuntimeError('boom\\nmore')", r"RuntimeError: boom; .*p_fails\.py, line 2"),
        ("import sys; sys.exit(7)", r"SystemExit: 7; .*p_fails\.py, line 1"),
        ("def (", r"SyntaxError: .*p_fails\.py, line 1"),
        ("def f(): f()\nf()", r"RecursionError: .*line 2"),
        ("import no_such_library_x", r"ModuleNotFoundError: No module named 'no_such_library_x'; .*line 1"),
    ],
)
def test_failing_plugin_raises_one_error_with_its_line(write: Write, code: str, cause: str) -> None:
    write("p_fails", code)
    with pytest.raises(InputError, match=rf"^own.yaml: plugins: plugin 'p_fails' cannot be imported \({cause}\)"):
        parse_config({**VALUES, "plugins": ["p_fails"]}, where="own.yaml")


@pytest.mark.parametrize("name", ["../evil", "", "a-b", "a..b", "p_new.__main__", "vjepa2_ac.cli"])
def test_invalid_module_names_raise(name: str) -> None:
    with pytest.raises(InputError, match="the name of your module"):
        import_plugins([name], where="plugins")


@pytest.mark.usefixtures("write")
def test_module_without_registration_raises_each_time(write: Write) -> None:
    write("p_helper", "x = 1")
    write("p_outer", "import p_inner")
    write("p_inner")
    for _ in range(2):
        with pytest.raises(InputError, match="'p_helper' registers nothing"):
            import_plugins(["p_helper"], where="plugins")
        import_plugins(["p_outer"], where="plugins")
    import_plugins(["p_inner"], where="plugins")


# A run may be a third party's.


@pytest.fixture(params=["console script", "python -m", "PYTHONPATH=."])
def _started(request: pytest.FixtureRequest, write: Write) -> None:
    """The paths of imports, as they are after each way to start the program in the working directory."""
    first = {"console script": [], "python -m": [str(Path.cwd())], "PYTHONPATH=.": ["."]}[request.param]
    sys.path[:0] = first
    _ = write


PWNED = "open('PWNED', 'w')\n" + REGISTERS.format(name="p_evil", function="f")


@pytest.mark.usefixtures("_started")
def test_run_config_never_imports_from_the_working_directory(write: Write) -> None:
    write("p_evil", PWNED)
    leave_package(Path(), "p_dist", "[vjepa2_ac.losses]\np_dist = p_dist:thing\n", PWNED)
    Path("run").mkdir()
    config = Path("run/config.yaml")
    config.write_text(as_yaml(parse_config(VALUES, where="")).replace("plugins: []", "plugins: [p_evil]"))
    Path("run/run_id").write_text("a")
    loaders = (
        load_config,
        lambda path: load_planning_config(str(path.parent)),
        lambda path: load_planning_config("builtin:sim-tiny", config=path),
    )
    for load in loaders:
        with pytest.raises(InputError, match=r"plugin 'p_evil': no such module.*--plugin p_evil"):
            load(config)
    assert "p_dist" not in LOSSES.names()
    assert not Path("PWNED").exists()


def test_working_directory_does_not_shadow_installed_module(write: Write, site: Path) -> None:
    sys.path.insert(0, "")
    write("p_shadowed", PWNED)
    write("p_entry", PWNED)
    leave_package(site, "p_shadowed", "", REGISTERS.format(name="p_shadowed", function="f"))
    leave_package(site, "p_entry", "[vjepa2_ac.losses]\np_entry = p_entry:thing\n")
    import_plugins(["p_shadowed"], where="run/config.yaml", allow_local=False)
    assert LOSSES.find("p_shadowed").__module__ == "p_shadowed"
    assert LOSSES.find("p_entry") is print
    assert not Path("PWNED").exists()
    assert sys.path[0] == ""


def test_installed_module_without_plugin_is_not_imported_for_a_run(write: Write, site: Path) -> None:
    leave_package(site, "p_other", "", "open('PWNED', 'w')")
    _ = write
    for module in ("p_other", "antigravity"):
        sys.modules.pop("p_other", None)
        with pytest.raises(InputError, match=f"'{module}' registers nothing"):
            import_plugins([module], where="run/config.yaml", allow_local=False)
    assert not Path("PWNED").exists()
    assert "antigravity" not in sys.modules


@pytest.mark.parametrize("load", [load_config, lambda path: load_planning_config("builtin:sim-tiny", config=path)])
def test_user_config_imports_from_the_working_directory(write: Write, load: Callable[[Path], object]) -> None:
    config = Path("mine.yaml")
    write("p_mine")
    config.write_text(as_yaml(parse_config(VALUES, where="")).replace("plugins: []", "plugins: [p_mine]"))
    load(config)
    assert LOSSES.require_registered("p_mine")
