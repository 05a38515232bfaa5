"""The notebook: a real kernel runs it, with fewer steps, clips and samples."""

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
UNTRAINED = "The selected checkpoint is the base model: fine-tuning is not shown to improve action ranking."
SHORTER = {
    "steps=33, seed=4), episodes=12": "steps=17, seed=4), episodes=12",
    '"steps": 40': '"steps": 4',
    '"batch_size": 6': '"batch_size": 2',
    '"warmup_steps": 5': '"warmup_steps": 1',
    '"every": 20, "clips": 16, "batch_size": 16, "ranking_clips": 4': '"every": 4, "clips": 2, "ranking_clips": 1',
    'read_clips(dataset, "test", clips=16': 'read_clips(dataset, "test", clips=4',
    "nodes=11": "nodes=3",
    "samples=100, iterations=5": "samples=16, iterations=1",
    "clips=32, probes": "clips=4, probes",
}


def executed(folder: Path) -> tuple[str, int]:
    """Run the notebook where Jupyter would, in `examples` of a folder; return what it printed, and its images."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    for long, short in SHORTER.items():
        assert long in "".join(code()), long
        for cell in notebook.cells:
            cell.source = cell.source.replace(long, short)
    resources = {"metadata": {"path": str(folder / "examples")}}
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    stderr = "".join(output.text for output in outputs if output.get("name") == "stderr")
    assert set(stderr.splitlines()) <= {UNTRAINED}
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


def test_notebook_needs_one_changed_line_for_other_data() -> None:
    cells = nbformat.read(NOTEBOOK, as_version=4).cells
    assert code()[0] == LINE
    assert [text for text in code() if re.search(r"^\s*MODEL\s*=", text, flags=re.MULTILINE)] == [LINE]
    assert OTHER in cells[0].source
    official = yaml.safe_load((ROOT / "configs/debug.yaml").read_text())
    assert official["model"]["base"] in OTHER


@pytest.mark.usefixtures("quiet")
def test_notebook_runs_and_shows_its_figures(tmp_path: Path) -> None:
    (tmp_path / "examples").mkdir()
    printed, images = executed(tmp_path)
    assert images == 6, "clips, errors by patch, two energies, loss, evaluation"
    for words in (
        "12 episodes",
        "builtin:sim-tiny on cpu",
        "of persistence",
        "Validation at step 4",
        "sensitive to actions",
        "cm apart; the zero action would be",
    ):
        assert words in printed, words
