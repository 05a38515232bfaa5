"""Consistency of the project files: version, pins, notices, make targets and workflows."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TARGETS = set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))

LIBRARIES = "bitsandbytes|Franka|PEFT|PEP 610|protobuf.dev|PyTorch|TFDS|torchmetrics|torchvision|WCAG"
SOURCE = re.compile(r"Source: (.*?)(?=\n\s*\n|\"\"\"|\Z)", flags=re.DOTALL)
REPOSITORY = r"[\w-]+/[\w-]+(?= @ )|^[\w-]+/[\w-]+"
AUTHOR = r"[A-Z]\w+(?= et al| \(\d{4}\))|^[A-Z]\w+(?=,| and )"
NAMED = re.compile(rf"{REPOSITORY}|\d{{4}}\.\d{{5}}|{AUTHOR}|\b(?:{LIBRARIES})\b")


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def loaded(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


# Version and pins.


def test_version_numbers_agree() -> None:
    cited = loaded(ROOT / "CITATION.cff")["version"]
    newest = re.search(r"^## \[([\d.]+)\] - ", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert newest
    assert {str(cited), newest[1]} == {PROJECT["version"]}
    assert '__version__ = version("vjepa2-ac")' in (ROOT / "src/vjepa2_ac/__init__.py").read_text()


def test_every_dependency_has_exactly_one_pin() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"]
    pins = [canonical(line.split("==")[0]) for line in lines]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in lines)
    assert len(pins) == len(set(pins))
    requirements = [
        *PROJECT["dependencies"],
        *(requirement for extra in PROJECT["optional-dependencies"].values() for requirement in extra),
    ]
    names = {canonical(re.split(r"[\[<>=]", requirement)[0]) for requirement in requirements} - {"vjepa2-ac"}
    assert not (names | {"pip-audit", "build", "twine"}) - set(pins)


# Notices.


def test_ported_sources_are_in_the_notice() -> None:
    notice, wrong = (ROOT / "NOTICE").read_text(), []
    for path in sorted((ROOT / "src").rglob("*.py")):
        for block in SOURCE.findall(path.read_text()):
            text = re.sub(r"\s+", " ", block)
            names = [match[0] for match in NAMED.finditer(text)]
            missing = [name for name in names if name not in notice] if names else ["names nobody"]
            wrong += [f"{path.relative_to(ROOT)}: {name}: {text}" for name in missing]
    assert not wrong, "\n".join(wrong)


# Pages, forms, workflows, hooks.


def test_named_make_targets_exist() -> None:
    pages = [ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", ROOT / "docs/releasing.md", *WORKFLOWS]
    for page in pages:
        lines = re.findall(r"(?:^|`|run: )make ([a-z][a-z -]*)", page.read_text(), flags=re.MULTILINE)
        assert {word for line in lines for word in line.split()} <= TARGETS, page.name


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_are_read_only_and_pin_their_actions(path: Path) -> None:
    text = path.read_text()
    if path.name in {"ci.yml", "weekly.yml"}:
        assert loaded(path)["permissions"] == {"contents": "read"}
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@v\d+", used) for used in re.findall(r"uses: (\S+)", text))
