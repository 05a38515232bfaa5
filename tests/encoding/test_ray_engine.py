"""Encoding with Ray gives the same files and errors as encoding in one process, also if actors die."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import psutil
import pytest

from latent_sets import contents
from ranks import wait_until
from run_fixtures import MakeConfig, Popen, as_yaml
from vjepa2_ac.cli import main
from vjepa2_ac.config.loading import config_as_dict
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.encoding import encode_dataset
from vjepa2_ac.encoding.encode_dataset import encode_config
from vjepa2_ac.encoding.latent_cache import needed_frames
from vjepa2_ac.encoding.ray_engine import _Actor, _Task
from vjepa2_ac.errors import InputError

needs_ray = pytest.mark.skipif(
    find_spec("ray") is None, reason='Ray is not tested: pip install -c constraints.txt -e ".[cluster]"'
)

# A plug-in, which actors import, too. After two files the encoder waits for the file `go`. If the file `fail` exists,
# the encoder raises an error.
PLUGIN = """
import time
from pathlib import Path
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.registry import TRACKERS

TRACKERS.register("unused")(object)  # a plug-in registers something
folder, original_encode = Path(__file__).parent, WorldModel.encode

def encode(*args, **kwargs):
    while len(list(folder.rglob("*.safetensors"))) >= 2 and not (folder / "go").exists():
        time.sleep(0.02)
    if (folder / "fail").exists():
        raise InputError(where="a frame", found="it is damaged")
    return original_encode(*args, **kwargs)

WorldModel.encode = encode
"""


@pytest.fixture
def start(make_config: MakeConfig, tmp_path: Path, popen: Popen) -> Callable[[str], "subprocess.Popen[str]"]:
    """Return a function that starts the command with an engine for 8 episodes; the encoder waits after two files."""
    (tmp_path / "waiting_plugin.py").write_text(PLUGIN)
    (tmp_path / "config.yaml").write_text(
        as_yaml(make_config(data__start_every=2)).replace("plugins: []", "plugins: [waiting_plugin]")
    )
    path = os.pathsep.join([str(tmp_path), *sys.path])

    def start_command(engine: str) -> "subprocess.Popen[str]":
        return popen(
            [sys.executable, "-m", "vjepa2_ac.cli", "encode", "config.yaml", "--out", "out", "--engine", engine],
            cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, start_new_session=True, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    return start_command


def find_actors(process: psutil.Process) -> list[psutil.Process]:
    children = process.children(recursive=True)
    return [child for child in children if child.cmdline()[:1] and "MapWorker" in child.cmdline()[0]]


def assert_finished(job: "subprocess.Popen[str]", folder: Path, config: MakeConfig) -> None:
    output, errors = job.communicate(timeout=120)
    assert job.returncode == 0, errors
    assert "8 of 8 episodes, 96 frames" in output
    encode_config(config(data__start_every=2), out=folder / "whole")
    assert contents(folder / "out") == contents(folder / "whole")


@needs_ray
@pytest.mark.usefixtures("default_signals")
def test_interrupted_ray_command_cleans_up_and_killed_actor_loses_no_file(
    start: Callable, make_config: MakeConfig, tmp_path: Path
) -> None:
    job = start("ray")
    wait_until(lambda: len(list(tmp_path.rglob("*.safetensors"))) >= 2, [job])
    children = psutil.Process(job.pid).children(recursive=True)
    assert len(children) > 2
    os.killpg(job.pid, signal.SIGINT)  # Ctrl-C
    _, errors = job.communicate(timeout=60)
    assert job.returncode == 130
    assert "Traceback" not in errors
    assert not psutil.wait_procs(children, timeout=60)[1]
    job = start("ray")
    wait_until(lambda: find_actors(psutil.Process(job.pid)), [job])
    find_actors(psutil.Process(job.pid))[0].kill()
    (tmp_path / "go").touch()
    assert_finished(job, tmp_path, make_config)


@needs_ray
def test_actor_error_equals_the_single_process_error(start: Callable, tmp_path: Path) -> None:
    for name in ("go", "fail"):
        (tmp_path / name).touch()
    job = start("ray")
    output, errors = job.communicate(timeout=120)
    assert job.returncode == 2, output + errors
    assert "error: a frame: it is damaged" in errors
    assert "data.exclude" in errors
    assert "Traceback" not in errors


def test_actor_without_the_cache_folder_raises(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encode_dataset, "_VISIBILITY_TIMEOUT_S", 0.0)
    config = make_config()
    task = _Task(list(needed_frames(open_dataset(config.data))))
    encode_config(make_config(data__crop="square"), out=tmp_path / "other")
    for folder, message in (("none", "are not visible to another process"), ("other", "data.crop: square, not")):
        result = _Actor(config_as_dict(config), tmp_path / folder, Path.cwd())({"task": task})["result"]
        assert isinstance(result.error, InputError)
        assert message in str(result.error)


@pytest.mark.parametrize(
    ("engine", "message"),
    [("dask", "neither ray nor ray=ADDRESS"), ("ray=", "neither ray nor"), ("ray", r"Ray.*is not installed.*cluster")],
)
def test_missing_ray_or_unknown_engine_raises_one_error(
    engine: str, message: str, make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, "ray", None)
    (tmp_path / "config.yaml").write_text(as_yaml(make_config()))
    try:
        status = main(["encode", str(tmp_path / "config.yaml"), "--engine", engine])
    except SystemExit as ended:
        status = ended.code
    assert status == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert re.search(message, line)
