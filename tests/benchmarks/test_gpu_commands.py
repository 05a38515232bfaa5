"""The commands for a real GPU that the notes tell can be given, end in time, and write down what they find."""

import re
import shlex
import sys
from collections.abc import Iterator
from importlib.util import module_from_spec, spec_from_file_location
from string import Template
from typing import Any, get_args

import pytest

from benches import imported
from paths import ROOT
from vjepa2_ac.model.network.attention import AttentionKind

SECTION = (ROOT / "docs/IMPLEMENTATION_NOTES.md").read_text().split("\n## On a GPU\n")[1].split("\n## ")[0]
(PRELUDE,) = re.findall(r"```bash\n(.*?)```", SECTION, re.DOTALL)
VARIABLES = dict(re.findall(r'^(\w+)="?([^"\n]*)"?$', PRELUDE, re.MULTILINE))
ROWS = re.findall(r"^\| (\w*) ?\| `([^`]+)` \|", SECTION, re.MULTILINE)
COMMANDS = [(block, Template(command).substitute(VARIABLES)) for block, command in ROWS]
MOST_S = 540


def benchmark(name: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Yield a benchmark's module; that of a folder is its `__main__`."""
    path = ROOT / name
    if path.is_file():
        monkeypatch.delitem(sys.modules, path.stem, raising=False)  # planning is a folder of tests, too
        yield from imported(path.stem, monkeypatch)
        return
    monkeypatch.syspath_prepend(str(path))
    spec = spec_from_file_location("benchmark", path / "__main__.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules["device"]


@pytest.mark.parametrize(
    "command", re.findall(r"python benchmarks/[^`|]*", Template(SECTION).safe_substitute(VARIABLES))
)
def test_every_command_of_a_benchmark_can_be_given(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    _, script, *given = shlex.split(command)
    for module in benchmark(script, monkeypatch):
        options = module.parse(given)
        attention = [*getattr(options, "attention", []), *getattr(options, "ways", [])]
        assert set(attention) <= set(get_args(AttentionKind))


def test_tests_that_are_named_are_there() -> None:
    named = [word for _, command in COMMANDS for word in command.split() if word.startswith("tests/")]
    assert named
    assert all((ROOT / file).is_file() for file in named)
