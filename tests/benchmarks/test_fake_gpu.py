"""What the fake GPU counts is what is there, and our code waits for a GPU only where it has to."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from paths import ROOT

pytestmark = pytest.mark.skipif(
    torch.version.cuda is not None, reason="a PyTorch with CUDA, beside which none is imagined"
)

FOLDER = ROOT / "benchmarks" / "fake_gpu"
MEBIBYTE = 2**20
STEP = [  # the lines where a training step waits for its losses, and for the norm of its gradients
    r"vjepa2_ac/training/step\.py:\d+ .*totals\.tolist\(\)",
    r"vjepa2_ac/training/step\.py:\d+ return float\(norm",
]
DECISION = {  # per iteration and for the answer: actions there, energies back; once: the frame and the state
    r"vjepa2_ac/planning/energy\.py:\d+ parts = actions\.to": 5,
    r"vjepa2_ac/planning/energy\.py:\d+ return torch\.cat\(energies\)\.to": 5,
    r"vjepa2_ac/planning/energy\.py:\d+ self\._frame, self\._state = ": 2,
}


def has_compiler() -> bool:
    return any(map(shutil.which, (os.environ.get("CXX", "g++").split()[0], "c++")))


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """All that is asked below, from one process: PyTorch must not have been used before it sees the GPU."""
    if not has_compiler():
        pytest.skip("no C++ compiler")
    out = tmp_path_factory.mktemp("imagined")
    runs = {
        "train": ["train", "--quick", "--source", "cache", "pixels", "--attention", "dense", "--top", "5", "--waits"],
        "augmented": ["train", "--quick", "--source", "pixels", "--attention", "dense", "--augment"],
        "encode": ["encode", "--quick"],
        "plan": ["plan", "--quick", "--adapter"],
        "wide": ["train", "--layers", "4", "--frames", "8", "--batch", "1", "--checkpointing", "off", "on"],
    }
    given = [[*arguments, "--json", str(out / name)] for name, arguments in runs.items()]
    command = [sys.executable, str(ROOT / "tests" / "support" / "fake_gpu_facts.py"), str(FOLDER), json.dumps(given)]
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
    )
    assert not done.returncode, done.stderr[-4000:]
    rows = {name: json.loads((out / name).read_text())["rows"] for name in runs}
    return {"rows": rows, "printed": done.stdout, "facts": json.loads(done.stdout.splitlines()[-1])}


def test_known_tensors_are_the_peak_to_the_byte(told: dict[str, Any]) -> None:
    facts = told["facts"]
    assert facts["live"] == facts["peak"] == MEBIBYTE + 1024
    assert facts["live, of a view"] == 1024


def test_what_autograd_keeps_lives_and_what_it_does_not_keep_is_let_go(told: dict[str, Any]) -> None:
    assert told["facts"]["kept for the backward pass"] == 2 * MEBIBYTE + 512  # weights, output of exp, and the loss


def test_a_number_of_a_tensor_is_a_wait_and_all_numbers_of_it_are_one(told: dict[str, Any]) -> None:
    facts = told["facts"]
    assert facts["waits for numbers"] == [1, 1]
    first, second = facts["places of waits"]
    assert re.fullmatch(r"fake_gpu_facts\.py:\d+ number\.tolist\(\)", first)
    assert re.fullmatch(r"fake_gpu_facts\.py:\d+ number\.add_\(1\)\.sum\(\)\.item\(\)", second)
    assert facts["waits in the backward pass"] == 1


def test_a_copy_is_a_wait_unless_it_is_told_not_to_block(told: dict[str, Any]) -> None:
    assert told["facts"]["waits that are none"] == 0
    assert told["facts"]["waits for copies"] == 4


def test_a_kernel_takes_what_it_computes_or_what_it_moves(told: dict[str, Any]) -> None:
    size = 4096
    product, added = told["facts"]["product"], told["facts"]["sum"]
    flops, moved = 2 * size**3, 3 * size**2 * 2
    assert product == {"kernels": 1, "flops": flops, "bytes": moved, "seconds": pytest.approx(flops / 85e12)}
    moved = (size + 2 * size**2) * 2  # what is repeated counts once
    assert added == {"kernels": 1, "flops": 0, "bytes": moved, "seconds": pytest.approx(moved / 1.8e12)}


def test_the_backward_pass_knows_the_lines_it_belongs_to(told: dict[str, Any]) -> None:
    places = told["facts"]["places in the backward pass"]
    assert any(re.fullmatch(r"backward of fake_gpu_facts\.py:\d+", place) for place in places)
    assert re.search(r"^ .* kernels .* TFLOP +aten\.\S+  backward of vjepa2_ac/\S+:\d+$", told["printed"], re.MULTILINE)


def test_a_training_step_waits_for_the_device_where_it_has_to(told: dict[str, Any]) -> None:
    rows = told["rows"]["train"]
    assert [row["source"] for row in rows] == ["cache", "pixels"]
    (augmented,) = told["rows"]["augmented"]
    assert augmented["kernels"] > rows[1]["kernels"]
    for row in (*rows, augmented):
        assert sorted(row["waits"].values()) == [1] * len(STEP), row["waits"]
        for line in STEP:
            assert [place for place in row["waits"] if re.match(line, place)], (line, row["waits"])


def test_a_decision_waits_twice_an_iteration_and_encoding_never(told: dict[str, Any]) -> None:
    for decision in told["rows"]["plan"]:  # of four iterations, without and with an adapter
        assert len(decision["waits"]) == len(DECISION)
        for line, times in DECISION.items():
            assert [count for place, count in decision["waits"].items() if re.match(line, place)] == [times]
    assert [row["waits"] for row in told["rows"]["encode"]] == [{}]


def test_a_decision_with_an_adapter_on_is_counted_beside_the_one_without(told: dict[str, Any]) -> None:
    plain, adapted = told["rows"]["plan"]
    assert [row["adapter"] for row in (plain, adapted)] == [False, True]
    assert adapted["kernels"] >= plain["kernels"]  # as many where the adapter was merged
    assert adapted["floor_ms"] == plain["floor_ms"]


def test_a_model_without_numbers_can_be_copied_and_merged(told: dict[str, Any]) -> None:
    adapted, merged = told["facts"]["kinds of weights with an adapter, and merged"]
    assert adapted == [["torch.bfloat16", "cuda:0"], ["torch.float32", "cuda:0"]]
    assert merged == [["torch.bfloat16", "cuda:0"]]


def test_doctor_says_what_a_step_takes_at_real_widths(told: dict[str, Any]) -> None:
    for row in told["rows"]["wide"]:
        assert row["doctor_gb"] == pytest.approx(row["peak_gb"], rel=0.15), row["work"]


def test_operations_are_the_model_flops_and_what_is_computed_again(told: dict[str, Any]) -> None:
    kept, again = told["rows"]["wide"]
    model = 0.755 * kept["floor_ms"]
    assert 1 < kept["tflop"] / model < 1.1  # flash's backward pass computes scores again
    assert 0.4 < (again["tflop"] - kept["tflop"]) / model < 0.5  # forward: nearly half, for most weights are frozen


def test_the_largest_batch_is_found_in_few_steps(told: dict[str, Any]) -> None:
    assert told["facts"]["largest batches"] == [0, 1, 2, 19, 100]


@pytest.mark.parametrize(
    ("environment", "said"),
    [({"CXX": "no-such-compiler"}, "no C++ compiler (no-such-compiler)"), ({"CXX": "false"}, "does not compile")],
)
def test_what_is_missing_is_told_in_one_line(environment: dict[str, str], said: str, tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER), "train", "--quick"]
    own = {"VJEPA2_AC_CACHE": str(tmp_path)}
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=os.environ | own | environment)
    assert done.returncode == 1
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_an_official_step_needs_a_checkout(tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER), "train", "--quick", "--official", str(tmp_path)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 2
    assert f"{tmp_path} is no checkout of facebookresearch/vjepa2" in done.stderr
