"""The wheel, built as described in docs/releasing.md, is complete and works outside of the checkout."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from copied_sets import write_npz
from paths import ROOT

NEEDED = ("pyproject.toml", "README.md", "LICENSE", "NOTICE", "src/vjepa2_ac", "examples/convert")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build from a copy: building leaves folders beside the sources."""
    copy = tmp_path_factory.mktemp("checkout")
    for name in NEEDED:
        source, target = ROOT / name, copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, target)
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", at=copy)
    (built,) = (copy / "dist").glob("*.whl")
    run(sys.executable, "-m", "twine", "check", "--strict", built, at=copy)
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("installed")
    run(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", folder, wheel, at=folder)
    return folder


def run(*words: object, at: Path, path: Path | None = None) -> str:
    environment = os.environ | {
        "PYTHONPATH": str(path or ""),
        "PYTHONSAFEPATH": "1",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }
    process = subprocess.run(
        list(map(str, words)), cwd=at, env=environment, text=True, capture_output=True, check=False
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def test_wheel_has_exactly_the_files_of_the_package(wheel: Path) -> None:
    package = ROOT / "src/vjepa2_ac"
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    files = [Path(folder) / name for folder, _, names in os.walk(package, followlinks=True) for name in names]
    expected = {path.relative_to(package.parent).as_posix() for path in files if path.suffix != ".pyc"}
    assert inside == expected
    assert {"vjepa2_ac/assets/configs/demo.yaml", "vjepa2_ac/assets/convert/ros2_bag.py"} < inside
    assert any(name.endswith("licenses/NOTICE") for name in zipfile.ZipFile(wheel).namelist())


COMMANDS = """
import contextlib, io, json, sys
import vjepa2_ac
from vjepa2_ac.cli import main
printed = [vjepa2_ac.__file__]
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(words) == 0, words
    printed.append(out.getvalue())
print(json.dumps(printed))
"""


def test_installed_wheel_works_outside_of_the_checkout(installed: Path, tmp_path: Path) -> None:
    write_npz(tmp_path / "own", range(8))
    commands = (
        "init own --model builtin:sim-tiny --out own.yaml", "config list", "data converter ros2_bag",
        "train own.yaml --check training.allow_weak_base=true",
    )  # fmt: skip
    words = json.dumps([command.split() for command in commands])
    package_path, init_output, config_list, converter, _ = json.loads(
        run(sys.executable, "-c", COMMANDS, words, at=tmp_path, path=installed)
    )
    assert Path(package_path).is_relative_to(installed)
    assert "vjepa2-ac train own.yaml --check" in init_output
    assert "builtin:demo" in config_list
    assert converter == (ROOT / "examples/convert/ros2_bag.py").read_text()
