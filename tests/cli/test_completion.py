"""A shell completes commands, options, paths, models and config keys, and nothing heavy is imported for it."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """import sys
sys.modules.update(dict.fromkeys(["torch", "numpy", "transformers", "mujoco"]))
from vjepa2_ac.cli import main
main()
"""
SHELL = f"""
vjepa2-ac() {{ {sys.executable} -c '{PROGRAM}'; }}
eval "$({Path(sys.executable).parent}/register-python-argcomplete vjepa2-ac)"
COMP_LINE="vjepa2-ac $1" COMP_POINT=$((${{#1}} + 10)) COMP_TYPE=9
_python_argcomplete vjepa2-ac 2>/dev/null
echo "${{COMPREPLY[*]}}"
"""


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("tr", "train"),
        ("data c", "check calibrate convert converter"),
        ("evaluate run --cl", "--clips"),
        ("evaluate run --split ", "test validation"),
        ("train mi", "mine.yaml"),
        ("config show builtin:de", "debug default demo demo_base"),
        ("train mine.yaml training.lea", "training.learning_rate="),
        ("simulate run --task reach planning.hor", "planning.horizon="),
    ],
)
def test_bash_completes(line: str, offered: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").touch()
    command = ["bash", "--norc", "-c", SHELL, "bash", line]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.split() == offered.split(), done.stderr
