"""The command demo: everything once on the simulated arm, each command as a user would give it."""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from pathlib import Path

from vjepa2_ac.cli.options import Commands, command
from vjepa2_ac.places import BUILTIN

_DATA, _RUN = Path("demo/data"), "demo/run"
_RECORD = ("simulate", "record", str(_DATA), "--domain", "B", "--episodes", "60", "--seed", "5")


def add_to(commands: Commands) -> None:
    """Add `demo` to a parser."""
    text = (
        "A simulated arm, a tiny world model, LoRA, whether it helped, and a film of what the model imagines: into the"
        " folder demo, in 4 to 6 minutes on 2 cores, without a download. The same command goes on after a stop."
    )
    command(commands, "demo", _demo, text)


def _demo(_options: argparse.Namespace) -> int:
    from vjepa2_ac.simulation.world.scene import load_mujoco

    load_mujoco()
    config = f"{BUILTIN}demo"
    commands = [
        *([] if _DATA.exists() else [_RECORD]),
        ("train", config),
        ("decoder", config),
        ("evaluate", _RUN),
        ("imagine", _RUN, "--decoder", "demo/decoder", "--actions", "true,left,close"),
    ]
    for words in commands:
        print(f"$ vjepa2-ac {shlex.join(words)}", flush=True)
        if status := subprocess.call([sys.executable, "-m", "vjepa2_ac.cli", *words]):  # noqa: S603 - our own command
            return status
    return 0
