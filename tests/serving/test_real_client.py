"""The unmodified openpi-client from PyPI drives the server from a separate environment."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from installing import install
from served import STATE, image, make_controller, serving, session
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.access import Access

CLIENT = "openpi-client==0.1.2"
KEY = "correct-horse-battery-staple"
SCRIPT = Path(__file__).with_name("openpi_dialogue.py")
CUP = {"cup": (SubGoal(image(50), "cup"),)}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of a separate environment with the client and its dependencies."""
    folder = tmp_path_factory.mktemp("robot")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True, capture_output=True)
    python = folder / "bin/python"
    install(python, CLIENT, "typing_extensions")  # the client imports typing_extensions without declaring it
    return python


def test_openpi_client_receives_actions_errors_and_a_new_episode(robot: Path) -> None:
    controller = make_controller()
    controller.reset(image(100))
    expected = []
    for seed in range(3):
        controller.act(image(seed), STATE)
        expected.append(controller.decision.plan.actions.double().tolist())

    with serving(lambda: session(goals=CUP), Access("127.0.0.1", KEY), metadata={"policy": "vjepa2-ac"}) as running:
        host, port = running.url.removeprefix("ws://").split(":")
        process = subprocess.run([robot, SCRIPT, host, port, KEY], capture_output=True, text=True, timeout=120, cwd="/")
    assert process.returncode == 0, process.stderr
    results = json.loads(process.stdout)
    assert results["metadata"] == "vjepa2-ac"
    assert results["actions"] == [*expected, expected[0]]
    assert results["why"] == ["planned"] * 4
    assert results["error"].startswith("Error in inference server:\nstate: 3 numbers")
    controller.reset(image(50))
    controller.act(image(3), STATE)
    assert results["one_by_one"] == controller.decision.plan.actions.double().tolist()
