"""Every command that a guide shows is one that the program accepts."""

import re
import shlex

import pytest

from guides import commands_of
from paths import ROOT
from vjepa2_ac.cli import program
from vjepa2_ac.config.loading import load_config

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_program_accepts_every_command_of_a_guide(page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for line in commands_of(page.read_text()):
        for command in re.split(r"&&|;|\|", line.partition(" > ")[0]):
            words = re.sub(r"^\s*(\.venv/bin/)?", "", command)
            if not words.startswith("vjepa2-ac ") or "…" in words or "$" in words:
                continue
            options = program.parsed(program._parser(), shlex.split(words)[1:])
            config = str(getattr(options, "config", None))
            if config.startswith(("builtin:", "configs/")):
                load_config(config, getattr(options, "overrides", []))
