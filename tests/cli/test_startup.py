"""Invalid arguments are reported before slow imports and loading; threads of PyTorch do not spin."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT
from vjepa2_ac.cli import main

INVALID = """
train nope.yaml
train {demo} training.stepz=3
train {demo}
train nope --resume
doctor nope.yaml
encode nope.yaml
encode {demo}
evaluate nope
evaluate builtin:sim-tiny
evaluate nope --data {demo} --out out
imagine nope --decoder builtin:sim-tiny
imagine builtin:sim-tiny --decoder builtin:sim-tiny
compare a b
data check nope.yaml
data check {demo}
data check {demo} data.path=. --model nope
data inspect nope.yaml
data convert nope.yaml out
data convert {demo} out
data convert {demo} data.path=. /proc/nope/out
data calibrate nope.yaml
data calibrate {demo} data.path=. --model nope
data calibrate {demo} data.path=. --axes nope
data calibrate {demo} data.path=. --axes builtin:sim-tiny --model nope
plan nope --start a.png --goal b.png --state 0.4,0,.3,3,0,0,0
plan builtin:nope --start a.png --goal b.png --state 0.4,0,.3,3,0,0,0
plan builtin:sim-tiny --start a.png --goal b.png --state 0.4,0,.3,3,0,0,0
plan builtin:sim-tiny --start a.png --goals nope --state 0.4,0,.3,3,0,0,0
plan builtin:sim-tiny planning.horizonn=2 --start a.png --goal b.png --state 0.4,0,.3,3,0,0,0
export nope out
config show nope.yaml
serve nope
serve builtin:sim-tiny planning.horizonn=2
serve builtin:sim-tiny --host 0.0.0.0
serve builtin:sim-tiny --goals nope
simulate nope
simulate builtin:sim-tiny --domain Q
simulate builtin:sim-tiny planning.horizonn=2
simulate record /proc/x --episodes 2
download --url foo --to x.pt
download x.pt
download vjepa3
init
init nowhere
init nowhere somewhere
init .
init sim --model nope
init sim --out /proc/nope/x.yaml
goals nope.yaml --out out
config show builtin:nope
config list builtin:demo
"""
CODE = """
import sys
from vjepa2_ac.cli import main
for line in sys.argv[1].strip().splitlines():
    try:
        status = main(line.split())
    except SystemExit as end:
        status = end.code
    imported = {"torch", "transformers", "matplotlib", "mujoco"} & set(sys.modules)
    if status != 2 or imported:
        sys.exit(f"{line}: status {status}, imported {imported}")
"""


def test_invalid_arguments_are_reported_before_pytorch_is_imported(tmp_path: Path) -> None:
    lines = INVALID.format(demo=ROOT / "configs" / "demo.yaml")
    process = subprocess.run([sys.executable, "-c", CODE, lines], cwd=tmp_path, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr[-2000:]
    assert process.stderr.count("error: ") == len(lines.strip().splitlines())


def test_unknown_action_is_reported_before_a_decoder_or_model_is_loaded(
    whole_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vjepa2_ac.evaluation.imagined.load_decoder", lambda *_: pytest.fail("too late"))
    assert main(["imagine", str(whole_run), "--decoder", "builtin:sim-tiny", "--actions", "true,sideways"]) == 2
    assert "'sideways'. Expected true" in capsys.readouterr().err


def test_published_checkpoints_are_listed_without_pytorch() -> None:
    listing = """
import sys
from vjepa2_ac.cli import main
sys.exit(main(["download", "--list"]) or len({"torch", "transformers", "matplotlib", "mujoco"} & set(sys.modules)))
"""
    process = subprocess.run([sys.executable, "-c", listing], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr[-2000:]
    assert "vjepa2.1-vitG-2b-384" in process.stdout


def test_openmp_spin_count_is_set_unless_the_user_sets_it() -> None:
    command_line = "from vjepa2_ac.cli import main; main(['config', 'list']); "
    program = command_line + "import torch; torch.ones(64, 64) @ torch.ones(64, 64)"
    for variables, expected in (({}, "1000"), ({"GOMP_SPINCOUNT": "7"}, "7")):
        environment = {name: value for name, value in os.environ.items() if name != "GOMP_SPINCOUNT"}
        environment |= {"OMP_DISPLAY_ENV": "verbose", **variables}  # libgomp then prints its settings
        command = [sys.executable, "-c", program]
        printed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr
        assert f"GOMP_SPINCOUNT = '{expected}'" in printed


def test_bug_report_describes_the_machine_without_secrets_and_paths(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setenv("HF_TOKEN", "hidden")
    monkeypatch.setenv("VJEPA2_AC_CACHE", "/home/hidden/cache")
    assert main(["doctor"]) == 0
    printed = capsys.readouterr().out
    for text in ("vjepa2-ac 0.", f"Python {sys.version.split()[0]}", "torch 2.", "peft 0.", "CPU: ", "GPU: ", "CUDA"):
        assert text in printed
    assert "VJEPA2_AC_CACHE=(a path)" in printed
    assert not [word for word in ("hidden", str(Path.home()), str(ROOT)) if word in printed]
