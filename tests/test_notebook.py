"""The notebook: a real kernel runs it as it is, and with its first line changed to a file of official form."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import nbformat
import pytest
import yaml
from nbclient import NotebookClient

from paths import GOLDEN, ROOT

NOTEBOOK = ROOT / "examples/first_hour.ipynb"
LINE = 'MODEL = "builtin:sim-tiny"'
OTHER = 'MODEL = "checkpoints/vjepa2-ac-vitg.pt"'
SIZES = {"image_size": 64, "encoder": {"heads": 4}, "predictor": {"heads": 4}}  # tests/golden/model/tiny.json


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


def test_it_is_stored_without_outputs() -> None:
    stored = json.loads(NOTEBOOK.read_text())
    code = [cell for cell in stored["cells"] if cell["cell_type"] == "code"]
    assert not [cell for cell in code if cell["outputs"] or cell["execution_count"]]
    assert set(stored["metadata"]) == {"kernelspec", "language_info"}


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


@pytest.mark.filterwarnings("ignore:__array__ implementation")  # of a tensor that is drawn
def test_it_runs_with_a_file_of_official_form(
    tmp_path: Path, simulated: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The config of real data, with an address and sizes that a test can have, stands where the notebook looks.

    Without a kernel, which has to import everything anew.
    """
    shutil.copyfile(GOLDEN / "model/tiny.pt", tmp_path / "official.pt")
    config: dict[str, Any] = yaml.safe_load((ROOT / "configs/debug.yaml").read_text())
    config["data"] |= {"path": str(simulated), "frames": 3, "validation_share": 0.3, "test_share": 0.3}
    config["data"] |= {"workers": 0, "idle": {"rule": "none"}}  # its commands are not recorded
    config["model"] |= {"sizes": SIZES, "dtype": "float32"}
    config["training"] |= {"steps": 2, "warmup_steps": 0, "precision": "fp32", "device": "cpu"}
    config["training"] |= {"allow_weak_base": True}  # random weights
    config["validation"] = {"every": 2, "clips": 4, "batch_size": 2}
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs/debug.yaml").write_text(yaml.safe_dump(config))

    (tmp_path / "examples").mkdir()
    monkeypatch.chdir(tmp_path / "examples")
    images: list[object] = []
    for shows in ("matplotlib.pyplot.show", "IPython.display.display"):
        monkeypatch.setattr(shows, lambda *shown: images.append(shown))
    scope: dict[str, Any] = {}
    for source in ['MODEL = "official.pt"', *code()[1:]]:
        exec(source, scope)  # noqa: S102
    plt.close("all")
    printed = capsys.readouterr().out
    assert len(images) == 6
    assert "official.pt on cpu: 16 tokens of 48 numbers" in printed
    assert (tmp_path / "demo/first_hour/official/run/report.html").is_file()
