"""Import of benchmarks, which import each other without a package name."""

import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import pytest
import torch

from paths import ROOT


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Any]]:
    """A function that imports a benchmark by its name. Imported modules are removed after the test."""
    threads, before = torch.get_num_threads(), set(sys.modules)
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    monkeypatch.delitem(sys.modules, "planning", raising=False)  # a folder of tests has the same name
    yield import_module
    torch.set_num_threads(threads)
    local_modules = {path.stem for path in (ROOT / "benchmarks").glob("*.py")} | {"src", "notebooks"}
    for module in set(sys.modules) - before:
        if module.split(".")[0] in local_modules:
            del sys.modules[module]
