"""The command itself: it simulates what a model of the package lacks, says where the page is, and ends when asked."""

import os
import re
import signal
from pathlib import Path

import pytest
from websockets.sync.client import connect

from ranks import Rank, wait_until
from vjepa2_ac.cli import main
from windows import header


def test_without_arguments_the_model_of_the_package_is_explored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    process = Rank(["-m", "vjepa2_ac.cli", "explore", "--port", "0"], dict(os.environ))
    (url,) = wait_until(lambda: re.findall(r"The page: (\S+)\s", process.written()[0]), [process])
    with connect(url.replace("http", "ws") + "socket", origin=url.rstrip("/"), max_size=None) as page:  # type: ignore[arg-type]
        told = header(page.recv(timeout=60))
    assert (told["subject"], told["truth"]) == ("builtin:sim-tiny", "simulated")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nowhere/run"], "nowhere/run"),
        (["builtin:sim-tiny", "--decoder", "nowhere"], "nowhere"),
    ],
)
def test_what_cannot_be_explored_is_said_at_once(
    words: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["explore", *words]) == 2
    assert says in capsys.readouterr().err
