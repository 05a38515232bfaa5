"""Wrong words are told before PyTorch is imported, which takes seconds; its threads sleep soon."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT
from vjepa2_ac.cli import main

WRONG = """
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
    found = {"torch", "transformers", "matplotlib", "mujoco"} & set(sys.modules)
    if status != 2 or found:
        sys.exit(f"{line}: status {status}, imported {found}")
"""


def test_wrong_words_are_told_before_pytorch_is_imported(tmp_path: Path) -> None:
    words = WRONG.format(demo=ROOT / "configs" / "demo.yaml")
    done = subprocess.run([sys.executable, "-c", CODE, words], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr.count("error: ") == len(words.strip().splitlines())


def test_published_checkpoints_are_listed_without_pytorch() -> None:
    listing = """
import sys
from vjepa2_ac.cli import main
sys.exit(main(["download", "--list"]) or len({"torch", "transformers", "matplotlib", "mujoco"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", listing], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "vjepa2.1-vitG-2b-384" in done.stdout


def test_threads_of_pytorch_sleep_soon_where_they_have_nothing_to_do_unless_the_user_says_otherwise() -> None:
    command_line = "from vjepa2_ac.cli import main; main(['config', 'list']); "
    program = command_line + "import torch; torch.ones(64, 64) @ torch.ones(64, 64)"
    for given, expected in (({}, "1000"), ({"GOMP_SPINCOUNT": "7"}, "7")):
        environment = {name: value for name, value in os.environ.items() if name != "GOMP_SPINCOUNT"}
        environment |= {"OMP_DISPLAY_ENV": "verbose", **given}  # libgomp says what it has read
        command = [sys.executable, "-c", program]
        said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr
        assert f"GOMP_SPINCOUNT = '{expected}'" in said


def test_a_bug_report_names_this_machine_and_no_secret_or_path(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setenv("HF_TOKEN", "hidden")
    monkeypatch.setenv("VJEPA2_AC_CACHE", "/home/hidden/cache")
    assert main(["doctor"]) == 0
    printed = capsys.readouterr().out
    for told in ("vjepa2-ac 0.", f"Python {sys.version.split()[0]}", "torch 2.", "peft 0.", "CPU: ", "GPU: ", "CUDA"):
        assert told in printed
    assert "VJEPA2_AC_CACHE=(a path)" in printed
    assert not [word for word in ("hidden", str(Path.home()), str(ROOT)) if word in printed]
