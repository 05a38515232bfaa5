"""The fake GPU counts memory and waits, and the estimate of `doctor` agrees with the count."""

import json
import os
import shutil
import subprocess
import sys
from typing import Any

import pytest
import torch

from paths import ROOT

pytestmark = pytest.mark.skipif(
    torch.version.cuda is not None, reason="PyTorch has CUDA: the fake GPU needs one without"
)

FOLDER = ROOT / "benchmarks" / "fake_gpu"
MEBIBYTE = 2**20


@pytest.fixture(scope="module")
def counted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Rows and counts from one process; the fake GPU must be loaded before PyTorch is imported."""
    if not any(map(shutil.which, (os.environ.get("CXX", "g++").split()[0], "c++"))):
        pytest.skip("no C++ compiler")
    out = tmp_path_factory.mktemp("fake_gpu")
    runs = {
        "quick": "--quick --source cache pixels --attention dense",
        "wide": "--layers 2 --encoder-layers 4 --frames 8 --batch 1 --checkpointing off on",
    }
    arguments = [[*words.split(), "--json", str(out / name)] for name, words in runs.items()]
    command = [sys.executable, str(ROOT / "tests/support/fake_gpu_facts.py"), str(FOLDER), json.dumps(arguments)]
    process = subprocess.run(
        command, check=False, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
    )
    assert not process.returncode, process.stderr[-4000:]
    rows = {name: json.loads((out / name).read_text()) for name in runs}
    return {"rows": rows, "counts": json.loads(process.stdout.splitlines()[-1])}


def test_bytes_and_synchronizations_of_known_tensors_are_exact(counted: dict[str, Any]) -> None:
    assert counted["counts"] == {
        "live": MEBIBYTE + 1024, "peak": MEBIBYTE + 1024, "live, with a view": 1024,
        "kept for the backward pass": 2 * MEBIBYTE + 512,  # weights, output of exp, and the loss
        "waits for numbers": 2,  # reading all numbers of a tensor is one wait
        "waits for non-blocking copies": 0, "waits for copies": 3,
    }  # fmt: skip


def test_training_step_synchronizes_only_for_losses_and_gradient_norm(counted: dict[str, Any]) -> None:
    assert [(row["source"], row["waits"]) for row in counted["rows"]["quick"]] == [("cache", 2), ("pixels", 2)]


def test_doctor_estimates_the_memory_of_a_step_at_real_widths(counted: dict[str, Any]) -> None:
    for row in counted["rows"]["wide"]:
        assert row["doctor_gb"] == pytest.approx(row["peak_gb"], rel=0.15), row["work"]
