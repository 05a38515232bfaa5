"""Two contracts that others wait for, each fulfilled in the real package, in an environment of its own."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from installing import install
from paths import ROOT
from served import STATE, controller, image, serving, session
from vjepa2_ac.policies.score import changes_of_chunks
from vjepa2_ac.serving.session import SessionOptions

HERE = Path(__file__).parent
EXAMPLES = ROOT / "examples/judge"


def ran(python: str | Path, script: str, folder: Path, **environment: str) -> dict:
    """Run a script of this folder, which writes found.json into a folder."""
    done = subprocess.run(
        [python, HERE / script, folder], capture_output=True, text=True, env={**os.environ, **environment}, timeout=120
    )
    assert done.returncode == 0, done.stderr
    found: dict = json.loads((folder / "found.json").read_text())
    return found


def test_the_solver_of_stable_worldmodel_searches_by_our_model(tmp_path: Path) -> None:
    """Without its dependency torchvision: of the package only the solvers are imported."""
    install(sys.executable, "--no-deps", "--target", str(tmp_path / "site"), "stable-worldmodel==0.1.1")
    install(
        sys.executable, "--target", str(tmp_path / "site"), "--no-deps", "gymnasium", "loguru", "farama-notifications"
    )
    own = controller()
    own.reset(image(100))
    chunks = np.random.default_rng(0).normal(0, 0.02, (5, 2, 7))
    np.savez(tmp_path / "given.npz", image=image(0), goal=image(100), state=STATE, chunks=chunks)
    paths = os.pathsep.join([str(tmp_path / "site"), str(EXAMPLES), str(ROOT / "tests/support"), str(ROOT / "src")])
    found = ran(sys.executable, "in_stable_worldmodel.py", tmp_path, PYTHONPATH=paths)
    np.testing.assert_allclose(found["costs"][1], own.score(image(0), STATE, chunks).energies, rtol=1e-5)
    assert found["shape"] == [2, 5]
    assert found["is_costable"]
    assert found["solved"] < found["nothing"]


def python_3_13() -> str:
    """Return a Python that WorldForge takes, or skip aloud."""
    places = [shutil.which("python3.13"), *map(str, Path.home().glob(".pyenv/versions/3.13*/bin/python3"))]
    for place in filter(None, places):
        if subprocess.run([place, "--version"], capture_output=True, check=False).returncode == 0:
            return place
    pytest.skip("WorldForge needs Python 3.13, which is not here")


def test_worldforge_ranks_candidates_by_our_server(tmp_path: Path) -> None:
    subprocess.run([python_3_13(), "-m", "venv", "--without-pip", tmp_path / "forge"], check=True, capture_output=True)
    python = tmp_path / "forge/bin/python"
    install(python, "worldforge-ai==0.5.0", "msgpack", "websockets", "numpy")
    own = controller()
    own.reset(image(100))
    chunks = STATE + np.random.default_rng(0).normal(0, 0.01, (4, 8, 7)) * [1, 1, 1, 1, 1, 1, 0]
    np.savez(tmp_path / "given.npz", image=image(0), goal=image(100), state=STATE, chunks=chunks)
    expected = own.score(image(0), STATE, changes_of_chunks(chunks, STATE, form="targets", control_steps=4))
    with serving(session) as running:
        found = ran(python, "in_worldforge.py", tmp_path, PYTHONPATH=str(EXAMPLES), SERVER=running.url)
    np.testing.assert_allclose(found["scores"], expected.energies, rtol=1e-12)
    assert (found["best"], found["lower_is_better"]) == (expected.best, True)
    assert "2 control steps" in found["refused"]
    with serving(lambda: session(SessionOptions(is_blind=True))) as running:
        found = ran(python, "in_worldforge.py", tmp_path, PYTHONPATH=str(EXAMPLES), SERVER=running.url)
    assert "no better than chance" in found["scores"]
