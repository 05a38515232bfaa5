"""The errors of docs/troubleshooting.md are those that the program prints."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
import torch

from guides import FEW_STEPS
from paths import ROOT
from vjepa2_ac.cli import main

PAGE = (ROOT / "docs/troubleshooting.md").read_text()
SHOWN = re.findall(r"```console\n\$ vjepa2-ac (.*?)\n(.*?)```", PAGE, flags=re.DOTALL)
NOT_MADE = {
    "simulate builtin:sim-tiny": "MuJoCo is there",
    "data check builtin:demo data.path=gs://": "needs a network",
}
OF_A_RUN = ("data.test_share=0.3", *FEW_STEPS.split())


@pytest.fixture(scope="module")
def working_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make what the commands of the page find."""
    folder = tmp_path_factory.mktemp("troubles")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, episodes in (("three", "3"), ("ten", "10")):
            assert main(["simulate", "record", name, "--episodes", episodes, "--steps", "33"]) == 0
        assert main(["train", "builtin:demo", "data.path=ten", "run_dir=runs/ten", *OF_A_RUN]) == 0
    (folder / "recordings").mkdir()
    for name in ("a.mp4", "a.csv"):
        (folder / "recordings" / name).touch()
    torch.save({"model": {"conv.weight": torch.zeros(3, 3)}}, folder / "other.pt")
    for name in ("now.png", "goal.png"):
        shutil.copy(ROOT / "docs/plan_start.png", folder / name)
    return folder


@pytest.mark.parametrize(("command", "message"), SHOWN, ids=[command for command, _ in SHOWN])
def test_troubleshooting_page_shows_the_printed_errors(
    command: str,
    message: str,
    working_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if any(command.startswith(start) for start in NOT_MADE):
        assert message.startswith("error: ")
        return
    monkeypatch.chdir(working_folder)
    assert main([*shlex.split(command), *(OF_A_RUN if "run_dir=runs/ten" in command else ())]) == 2
    printed = " ".join(capsys.readouterr().err.split())
    expected = re.escape(" ".join(message.split())).replace("…", ".*?")
    assert re.search(expected, printed), printed


def test_troubleshooting_page_has_ten_sections() -> None:
    assert re.findall(r"^## (\d+)\.", PAGE, flags=re.MULTILINE) == [str(number) for number in range(1, 11)]
    assert all(any(command.startswith(start) for command, _ in SHOWN) for start in NOT_MADE)
