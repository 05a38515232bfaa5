"""What is measured on a GPU can be given, ends in time, and leaves what was found."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from typing import Any, get_args

import pytest

from benches import imported
from paths import ROOT
from vjepa2_ac.model.attention import AttentionKind

SECTION = (ROOT / "docs/IMPLEMENTATION_NOTES.md").read_text().split("\n## On a GPU\n")[1].split("\n## ")[0]


@pytest.fixture
def on_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark."""
    yield from imported("on_gpu", monkeypatch)


def test_every_part_is_a_command_of_its_benchmark(on_gpu: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len({part.name for part in on_gpu.PARTS}) == len(on_gpu.PARTS)
    for part in on_gpu.PARTS:
        for module in imported(part.benchmark, monkeypatch):
            if not hasattr(module, "parse"):
                continue
            options = module.parse(part.arguments.split())
            named = [*getattr(options, "attention", [])]
            assert {way.split("+")[0] for way in named} <= set(get_args(AttentionKind))


def test_a_part_that_fails_is_named(tmp_path: Any) -> None:
    command = [sys.executable, str(ROOT / "benchmarks/on_gpu.py"), "--quick", "--out", str(tmp_path), "--only"]
    (tmp_path / "chunk.json").mkdir()  # which cannot be written
    done = subprocess.run([*command, "chunk"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert re.search(r"== chunk: exit 1.*ViT-B", done.stdout, re.DOTALL)
    assert done.stderr.strip() == "failed or out of time: chunk"


def test_commands_of_the_notes_can_be_given(monkeypatch: pytest.MonkeyPatch) -> None:
    commands = re.findall(r"python (benchmarks/\w+\.py[^`]*)`", SECTION)
    assert len(commands) > 1
    for script, *given in map(shlex.split, commands):
        for module in imported(script.removeprefix("benchmarks/").removesuffix(".py"), monkeypatch):
            module.parse(given)
