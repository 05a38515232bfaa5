"""Tests run on a bare machine, and say what they do without; where all of it should be there they do not run."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from missing import SHAPES, STORAGE, WITHOUT, absent, is_installed
from paths import ROOT
from vjepa2_ac.simulation.motion import forward_kinematics

NOT_THERE = "import sys; sys.modules.update(dict.fromkeys({missing!r}))"  # importing them is an error then
A_TEST_OF_EACH = """
from gcs import Gcs
from vjepa2_ac.errors import InputError

def test_of_storage(gcs: Gcs) -> None:
    assert gcs.url

def test_of_something_else() -> None:
    assert InputError(where="here", found="this", fix="Change it")
"""


def run_without(*missing: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run two tests, with our conftest, on a machine without these libraries."""
    (folder / "sitecustomize.py").write_text(NOT_THERE.format(missing=missing))
    tests = folder / "tests"
    tests.mkdir()
    (tests / "test_each.py").write_text(A_TEST_OF_EACH)
    (tests / "conftest.py").symlink_to(ROOT / "tests" / "conftest.py")
    path = os.pathsep.join([str(folder), str(ROOT / "src"), str(ROOT / "tests" / "support")])
    inherited = {key: value for key, value in os.environ.items() if key not in {"CI", "PYTEST_CURRENT_TEST"}}
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-rs", "-p", "no:cacheprovider", "--import-mode=importlib", str(tests)],
        env=inherited | {"PYTHONPATH": path, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        cwd=folder, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


def test_a_bare_machine_tests_what_it_can_and_says_what_it_cannot(tmp_path: Path) -> None:
    done = run_without(SHAPES, STORAGE, "ruff", folder=tmp_path)
    printed = " ".join(done.stdout.split())
    assert done.returncode == 0
    assert "1 passed, 1 skipped" in printed
    assert [printed.count(WITHOUT[name]) for name in (SHAPES, STORAGE)] == [1, 2]  # in the header; and as a reason


@pytest.mark.parametrize("lacking", [(SHAPES,), (STORAGE,), (SHAPES, STORAGE)], ids=str)
def test_what_should_be_there_and_is_not_stops_all_tests(lacking: tuple[str, ...]) -> None:
    with pytest.raises(pytest.UsageError, match=f"{', '.join(lacking)}: not installed, though CI is set"):
        absent({"CI": "true"}, {"pytest"}.union({SHAPES, STORAGE} - set(lacking)).__contains__)
    with pytest.raises(pytest.UsageError, match="though the extra dev is installed"):
        absent({}, lambda name: name not in lacking)


@pytest.mark.skipif(not is_installed(SHAPES), reason=WITHOUT[SHAPES])
def test_shapes_of_public_functions_are_checked_in_tests() -> None:
    with pytest.raises(TypeCheckError):
        forward_kinematics(np.zeros(3))


def test_where_all_is_there_nothing_is_said() -> None:
    assert absent({"CI": "true"}, lambda _: True) == ()
    assert absent({}, lambda name: name != "ruff") == ()
    assert absent({}, {STORAGE}.__contains__) == (SHAPES,)
