"""The commands of docs/QUICKSTART.md run in their order; commands that need a robot or a download are only parsed."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

import guides
from paths import ROOT
from vjepa2_ac.cli import main

PAGE = (ROOT / "docs/QUICKSTART.md").read_text()
SECTIONS = {
    int(number): text for number, text in re.findall(r"^## (\d)\. .*?\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.M)
}
TESTED_SECTIONS = (2, 3, 4)


def commands_of(section: int) -> list[list[str]]:
    """Return the words of every line of a section that is run."""
    return [shlex.split(line) for line in guides.commands_of(SECTIONS[section])]


def test_quickstart_has_its_sections() -> None:
    assert list(SECTIONS) == [1, 2, 3, 4, 5, 6]
    assert all(words[0] == "vjepa2-ac" for section in (*TESTED_SECTIONS, 5) for words in commands_of(section))


def test_quickstart_commands_run_from_data_to_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    printed: dict[str, str] = {}
    for words in [words for section in TESTED_SECTIONS for words in commands_of(section)]:
        assert main([*words[1:], *guides.shorter(" ".join(words))]) == 0, words
        printed[" ".join(words)] = capsys.readouterr().out
    init_output = printed["vjepa2-ac init data/my_robot --model builtin:sim-tiny"]
    page_commands = {" ".join(words) for words in commands_of(3)}
    for line in re.findall(r"^  (vjepa2-ac .*?)   #", init_output, re.M):
        assert line in page_commands, "init prints the page's commands"
    shown = " ".join(printed["vjepa2-ac evaluate runs/my_robot"].split())
    assert re.search("error [0-9.]+ % (lower|higher) than (the base model's|that of persistence)", shown)
    for name in ("my_robot.yaml", "inspection", "runs/my_robot/report.html", "runs/my_robot/metrics.json", "merged"):
        assert (tmp_path / name).exists(), name


def test_extras_named_in_quickstart_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named_extras = [name for group in re.findall(r"\[([\w,]+)\]\"", SECTIONS[1]) for name in group.split(",")]
    assert named_extras
    assert set(named_extras) <= set(extras)
