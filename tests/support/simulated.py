"""A few short episodes of the simulated arm, for tests of examples and guides."""

import shutil
from pathlib import Path

import pytest

from paths import ROOT

IN_EXAMPLES = Path("demo/examples/data")  # where examples and docs/python.md expect them


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

    return record_dataset(tmp_path_factory.mktemp("simulated") / "data", RecordingSpec("B", 14, seed=4), episodes=8)


@pytest.fixture
def clone(simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory like the root of a clone, in which the episodes were recorded before."""
    shutil.copytree(simulated, tmp_path / IN_EXAMPLES)
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    return tmp_path
