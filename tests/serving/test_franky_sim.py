"""The franky client on a simulated Franka (franky-sim speaks libfranka's protocol). Asked for by VJEPA2_AC_FRANKA=1."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from paths import ROOT
from served import controller, image, serving
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.session import Session, SessionOptions

ARM = ["franky-control==2.0.0", "franky-sim==1.0.4", "scipy"]
BESIDE = ["typing_extensions", "msgpack", "websockets", "dm-tree"]
CLIENT = ["--no-deps", "openpi-client==0.1.2"]  # it asks for numpy<2, with which franky-sim does not work
BOX = ((0.2, -0.3, 0.1), (0.8, 0.3, 0.9))

pytestmark = pytest.mark.skipif(
    not os.environ.get("VJEPA2_AC_FRANKA"), reason="VJEPA2_AC_FRANKA=1 installs a simulated Franka (300 MB)"
)


def test_the_arm_is_where_the_server_wanted_it(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", tmp_path], check=True, capture_output=True)
    for packages in (ARM, BESIDE, CLIENT):
        install = [tmp_path / "bin/python", "-m", "pip", "install", "--quiet", *packages]
        done = subprocess.run(install, capture_output=True, text=True)
        if done.returncode:
            pytest.skip(f"they cannot be installed here: {done.stderr.strip().splitlines()[-1:]}")
    limits = LimitsConfig(xyz=(0.02, 0.02, 0.02), workspace=BOX, gripper_mode="held")
    goals = {"cup": (SubGoal(image(50), "cup"),)}
    with serving(lambda: Session(controller(limits=limits), goals, SessionOptions("pose"))) as running:
        script, example = Path(__file__).with_name("franky_dialogue.py"), ROOT / "examples/serve/franky_client.py"
        words = [tmp_path / "bin/python", script, example, running.url]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert len(found["answers"]) == 4
    np.testing.assert_allclose(found["end"], found["answers"][-1][:3], atol=2e-3)
    steps = np.diff([found["start"], *(answer[:3] for answer in found["answers"])], axis=0)
    assert abs(steps).max() <= 0.02 + 2e-3
    assert abs(steps).max() > 0.005
