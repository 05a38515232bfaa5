"""The command `serve`: a robot connects to the process, and invalid options raise before the server listens."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from served import STATE, image, start_server, stop_server
from tiny_models import tiny_model
from vjepa2_ac.cli import main
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.serving.client import PlanningClient

QUICK = ["planning.samples=8", "planning.iterations=2", "planning.horizon=2", "planning.planner.options.elites=4"]
KEY = "correct-horse-battery-staple"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model, goal images and a key file."""
    folder = tmp_path_factory.mktemp("folder")
    tiny_model().save_pretrained(folder / "model")
    (folder / "goals").mkdir()
    Image.fromarray(image(50)).save(folder / "goals/cup.png")
    (folder / "key").write_text(KEY)
    (folder / "key").chmod(0o600)
    return folder


def test_serve_replies_to_a_robot_and_records_every_decision(folder: Path, tmp_path: Path) -> None:
    record = tmp_path / "record"
    arguments = [str(folder / "model"), "--goals", str(folder / "goals"), "--key-file", str(folder / "key")]
    process, url = start_server(*arguments, "--record", str(record), *QUICK)
    with pytest.raises(UnreachableError, match="401"):
        PlanningClient(url)
    replies = []
    with PlanningClient(url, KEY) as client:
        assert client.metadata["goals"] == ["cup"]
        assert client.metadata["limits"]["workspace"] is None
        assert str(folder) not in json.dumps({**client.metadata})
        for step in range(3):
            message = {"observation/image": image(step), "observation/state": STATE + 0.01 * step, "prompt": "cup"}
            replies.append(client.infer(message))
    assert "robot disconnected" in stop_server(process)
    lines = [json.loads(line) for line in (record / "decisions.jsonl").read_text().splitlines()]
    assert [line["answer"]["actions"] for line in lines] == [reply["actions"].tolist() for reply in replies]


def test_dry_run_with_poses_replies_to_roboarena_messages(folder: Path) -> None:
    arguments = ["--dry-run", "--actions", "pose", *QUICK, "data.stride=5"]
    process, url = start_server(str(folder / "model"), *arguments)
    with PlanningClient(url) as client:
        assert client.metadata["action_space"] == "cartesian_position"
        reply = client.infer({
            "endpoint": "infer", "session_id": "one", "observation/exterior_image_0_left": image(0),
            "observation/cartesian_position": STATE[:6], "observation/gripper_position": STATE[6:],
            "goal/image": image(1), "prompt": "put it there",
        })  # fmt: skip
        np.testing.assert_allclose(reply["actions"], np.tile(STATE, (5, 1)), atol=1e-9)
        assert client.infer({"endpoint": "reset", "session_id": "two"}) == {"status": "reset"}
    assert "dry run: every action is zero" in stop_server(process)


INVALID_OPTIONS = {
    "--host 0.0.0.0: other machines can reach this address": ["--host", "0.0.0.0"],  # noqa: S104 - refused
    "--key-file": ["--key-file", "none"],
    "--extrinsics": ["--extrinsics", "1,2"],
    "planning.limits: workspace: the corner": ["planning.limits.workspace=[[0,0,0],[0,1,1]]"],
}


@pytest.mark.parametrize("error", INVALID_OPTIONS)
def test_invalid_option_raises_before_the_server_listens(
    error: str, folder: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["serve", str(folder / "model"), *INVALID_OPTIONS[error]]) == 2
    printed = capsys.readouterr()
    assert error in printed.err.replace("\n", " ")
    assert "listening" not in printed.out


def test_serving_a_model_that_needs_extrinsics_without_them_raises(folder: Path, capsys) -> None:
    tiny_model(extrinsics=True).save_pretrained(folder / "camera")
    assert main(["serve", str(folder / "camera"), "--port", "0"]) == 2
    assert "predictor.use_extrinsics" in capsys.readouterr().err


def test_folder_without_a_model_raises_before_loading(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "vjepa2_ac.serving.server", None)  # an import of the server would raise
    assert main(["serve", str(tmp_path)]) == 2
    assert "config.json: cannot be read: No such file or directory. Expected a folder written by" in (
        capsys.readouterr().err
    )
