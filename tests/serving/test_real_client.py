"""The real, unmodified openpi-client of PyPI drives the server, from an environment of its own."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from installing import install
from served import STATE, controller, image, serving, session
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.access import Access

CLIENT = "openpi-client==0.1.2"
KEY = "correct-horse-battery-staple"
SCRIPT = Path(__file__).with_name("openpi_dialogue.py")
CUP = {"cup": (SubGoal(image(50), "cup"),)}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of an environment with the client and what it asks for, which is not ours."""
    here = tmp_path_factory.mktemp("robot")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", here], check=True, capture_output=True)
    python = here / "bin/python"
    install(python, CLIENT, "typing_extensions")  # which the client imports and does not ask for
    return python


def test_it_gets_the_controllers_actions_errors_and_a_new_episode(robot: Path) -> None:
    own = controller()
    own.reset(image(100))
    expected = []
    for seed in range(3):
        own.act(image(seed), STATE)
        expected.append(own.decision.plan.actions.double().tolist())

    with serving(lambda: session(goals=CUP), Access("127.0.0.1", KEY), told={"policy": "vjepa2-ac"}) as running:
        host, port = running.url.removeprefix("ws://").split(":")
        done = subprocess.run([robot, SCRIPT, host, port, KEY], capture_output=True, text=True, timeout=120, cwd="/")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["metadata"] == "vjepa2-ac"
    assert found["actions"] == [*expected, expected[0]]
    assert found["why"] == ["planned"] * 4
    assert found["error"].startswith("Error in inference server:\nstate: 3 numbers")
    own.reset(image(50))
    own.act(image(3), STATE)
    assert found["one_by_one"] == own.decision.plan.actions.double().tolist()
