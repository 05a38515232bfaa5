"""The notebook: a real kernel runs it as it is."""

import re
from pathlib import Path

import nbformat
import pytest
import yaml
from nbclient import NotebookClient

from paths import ROOT

NOTEBOOK = ROOT / "examples/first_hour.ipynb"
LINE = 'MODEL = "builtin:sim-tiny"'
OTHER = 'MODEL = "checkpoints/vjepa2-ac-vitg.pt"'


def executed(folder: Path) -> tuple[str, int]:
    """Run the notebook where Jupyter would, in `examples` of a folder; return what it printed, and its images."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    resources = {"metadata": {"path": str(folder / "examples")}}
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output.text for output in outputs if output.get("name") == "stderr"]
    images = sum("image/png" in output.get("data", {}) for output in outputs)
    return "".join(output.get("text", "") for output in outputs), images


@pytest.fixture
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the kernel find the program as the tests do, without the stack of a debugger."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "src"))
    monkeypatch.setenv("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # other tests have the other cores


def code() -> list[str]:
    return [cell.source for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]


def test_one_line_is_all_that_changes() -> None:
    cells = nbformat.read(NOTEBOOK, as_version=4).cells
    assert code()[0] == LINE
    assert [text for text in code() if re.search(r"^\s*MODEL\s*=", text, flags=re.MULTILINE)] == [LINE]
    assert OTHER in cells[0].source
    official = yaml.safe_load((ROOT / "configs/debug.yaml").read_text())
    assert official["model"]["base"] in OTHER


@pytest.mark.usefixtures("quiet")
def test_it_runs_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "examples").mkdir()
    printed, images = executed(tmp_path)
    assert images == 6, "clips, errors by patch, two energies, loss, evaluation"
    for words in (
        "12 episodes",
        "builtin:sim-tiny on cpu",
        "of persistence",
        "Validation at step 40",
        "lower than with the base model",
    ):
        assert words in printed, words
    apart, still = printed.split("On average ")[-1].split(" cm apart; not moving at all would be ")
    assert float(apart) < float(still.split(" cm")[0]), "with LoRA, planning is better than standing still"
