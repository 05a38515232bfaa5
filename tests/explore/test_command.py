"""The command `explore`: it simulates episodes for the package's model, prints the URL, and exits on SIGTERM."""

import os
import re
import signal
from pathlib import Path

import pytest
from websockets.sync.client import connect

from ranks import Rank, wait_until
from vjepa2_ac.cli import main
from windows import header


def test_explore_without_arguments_shows_the_packages_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    process = Rank(["-m", "vjepa2_ac.cli", "explore", "--port", "0"], dict(os.environ))
    (url,) = wait_until(lambda: re.findall(r"The page: (\S+)\s", process.read_outputs()[0]), [process])
    with connect(url.replace("http", "ws") + "socket", origin=url.rstrip("/"), max_size=None) as page:  # type: ignore[arg-type]
        content = header(page.recv(timeout=60))
    assert (content["subject"], content["truth"]) == ("builtin:sim-tiny", "simulated")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere/run"], "nowhere/run"),
        (["builtin:sim-tiny", "--decoder", "nowhere"], "nowhere"),
    ],
)
def test_invalid_argument_raises_before_loading(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["explore", *arguments]) == 2
    assert message in capsys.readouterr().err
