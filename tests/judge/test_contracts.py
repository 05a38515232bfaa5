"""The solver of stable-worldmodel plans with our model as its cost."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from installing import install
from paths import ROOT
from served import STATE, image, make_controller

FOLDER = Path(__file__).parent
EXAMPLES = ROOT / "examples/judge"


def run_script(python: str | Path, script: str, folder: Path, **environment: str) -> dict:
    """Run a script of this folder, which writes found.json into a folder."""
    process = subprocess.run(
        [python, FOLDER / script, folder],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        timeout=120,
    )
    assert process.returncode == 0, process.stderr
    results: dict = json.loads((folder / "found.json").read_text())
    return results


def test_stable_worldmodel_solver_plans_with_this_model(tmp_path: Path) -> None:
    """Without its dependency torchvision: of the package only the solvers are imported."""
    install(sys.executable, "--no-deps", "--target", str(tmp_path / "site"), "stable-worldmodel==0.1.1")
    install(
        sys.executable, "--target", str(tmp_path / "site"), "--no-deps", "gymnasium", "loguru", "farama-notifications"
    )
    controller = make_controller()
    controller.reset(image(100))
    chunks = np.random.default_rng(0).normal(0, 0.02, (5, 2, 7))
    np.savez(tmp_path / "given.npz", image=image(0), goal=image(100), state=STATE, chunks=chunks)
    paths = os.pathsep.join([str(tmp_path / "site"), str(EXAMPLES), str(ROOT / "tests/support"), str(ROOT / "src")])
    results = run_script(sys.executable, "in_stable_worldmodel.py", tmp_path, PYTHONPATH=paths)
    np.testing.assert_allclose(results["costs"][1], controller.score(image(0), STATE, chunks).energies, rtol=1e-5)
    assert results["shape"] == [2, 5]
    assert results["is_costable"]
    assert results["solved"] < results["nothing"]
