"""What the documentation shows works: configs, commands and loops; files, modules and keys that it names are there."""

import json
import pkgutil
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml

from guides import commands_of
from paths import ROOT
from vjepa2_ac.cli import main, program
from vjepa2_ac.config.loading import PRESET, all_keys, load_config, parse_config
from vjepa2_ac.media.images import read_image
from vjepa2_ac.registry import REGISTRIES

OF_DATA = [(ROOT / f"docs/{name}.md").read_text() for name in ("data", "data_reference")]
TEXTS = ("docs", "src", "examples", "scripts", "configs", "benchmarks", "evidence")
SUFFIXES = {".md", ".py", ".yaml", ".sh", ".txt", ".ipynb", ".jinja", ".html"}
BLOCKS = [text for page in OF_DATA for text in re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL)]


@pytest.mark.parametrize("text", BLOCKS, ids=lambda text: text.splitlines()[0])
def test_configs_in_the_data_pages_are_valid(text: str) -> None:
    parse_config(yaml.safe_load(text), where="docs/data.md")


# Names in docs and docstrings: files, modules, knobs.

DOCS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
TODAY = [*DOCS, *SOURCES]
PACKAGE = ROOT / "src/vjepa2_ac"
OURS = {path.name for root in (ROOT, PACKAGE, ROOT / "tests") for path in root.iterdir() if path.is_dir()}
OURS -= {"src", "demo"}  # the second is made by commands

FILES = ("json", "md", "npz", "png", "pt", "safetensors", "yaml")


def file_exists(path: str) -> bool:
    """Whether a file is in the project, named from its root, from the package, or from the tests."""
    return any((root / path).exists() for root in (ROOT, PACKAGE, ROOT / "tests"))


def is_module_or_part_of_one(dotted: str) -> bool:
    """Whether a dotted name within the package is public, a module, or what a module defines or imports."""
    try:
        pkgutil.resolve_name(f"vjepa2_ac.{dotted}")
    except (ImportError, AttributeError):
        return False
    return True


GROUPS = {registry.group for registry in REGISTRIES}  # entry points, which look like modules


def is_config_key(dotted: str) -> bool:
    return any(f"{key}.".startswith(f"{dotted}.") for key in all_keys())


def test_named_files_exist() -> None:
    """Files of ours: with a folder before them. Those of other projects stand beside their commit."""
    wrong = []
    for path in TODAY:
        text = re.sub(r"Source: .*?(?=\n\s*\n|\"\"\"|\Z)", "", path.read_text(), flags=re.DOTALL)
        paths = re.findall(r"(?<![\w./~-])((?:[a-z_]+/)+[A-Za-z_]+\.(?:py|md|yaml|png|sh|txt))\b", text)
        repository_files = [name for name in paths if name.split("/")[0] in OURS]
        wrong += [f"{path.relative_to(ROOT)}: {name}" for name in repository_files if not file_exists(name)]
    assert not wrong, "\n".join(wrong)


def test_named_modules_exist() -> None:
    """`vjepa2_ac.x.y` anywhere; and `x.y` where x is a room, unless that is a knob."""
    wrong = []
    for path in [*TODAY, *PACKAGE.rglob("*.jinja")]:
        text = path.read_text()
        qualified = re.findall(r"\bvjepa2_ac\.([a-z_]\w*(?:\.[A-Za-z_]\w*)*)", text)
        within = re.findall(r"`([a-z_]+(?:\.[A-Za-z_]\w*)+)`", text)
        within = [
            name for name in within if (PACKAGE / name.split(".", maxsplit=1)[0]).is_dir() and not is_config_key(name)
        ]
        modules = [
            name for name in qualified + within if not name.endswith(FILES) and f"vjepa2_ac.{name}" not in GROUPS
        ]
        wrong += [f"{path.relative_to(ROOT)}: {name}" for name in modules if not is_module_or_part_of_one(name)]
    assert not wrong, "\n".join(wrong)


SECTIONS = (
    "adapter", "checkpoint", "data", "decoder", "model", "planning", "replay", "tracking", "training", "validation",
)  # fmt: skip


def test_named_config_keys_exist() -> None:
    wrong = []
    for path in [path for path in DOCS if path.name not in ("decisions.md", "IMPLEMENTATION_NOTES.md")]:
        keys = re.findall(rf"`((?:{'|'.join(SECTIONS)})\.[a-z_]+(?:\.[a-z_]+)*)(?:[:=][^`]*)?`", path.read_text())
        wrong += [
            f"{path.name}: {name}" for name in keys
            if not name.endswith(FILES) and name != PRESET and not is_config_key(name)
            and not is_module_or_part_of_one(name)
        ]  # fmt: skip
    assert not wrong, "\n".join(wrong)


def test_no_text_installs_the_package_by_name_alone() -> None:
    """Whoever registers the name on an index could run code on the machine of every reader."""
    names = [*ROOT.glob("*.md"), *(path for folder in TEXTS for path in (ROOT / folder).rglob("*"))]
    texts = {path: path.read_text() for path in names if path.suffix in SUFFIXES}
    bare = re.compile(r"""pip\S* install[^\n`#]*[\s"']vjepa2[-_]ac(?:\[[\w,]+\])?["'`\s](?!@)""")
    assert not {path.name: commands for path, text in texts.items() if (commands := bare.findall(text))}
    assert bare.search('pip install "vjepa2-ac[sim]"')
    assert bare.search("pip install -U vjepa2-ac\n")
    assert not bare.search('pip install "vjepa2-ac[sim] @ file:///x.whl"')


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_guides_are_accepted(page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for line in commands_of(page.read_text()):
        for command in re.split(r"&&|;|\|", line.partition(" > ")[0]):
            words = re.sub(r"^\s*(\.venv/bin/)?", "", command)
            if not words.startswith("vjepa2-ac ") or "…" in words or "$" in words:
                continue
            options = program.parse_arguments(program._make_parser(), shlex.split(words)[1:])
            config = str(getattr(options, "config", None))
            if config.startswith(("builtin:", "configs/")):
                load_config(config, getattr(options, "overrides", []))


PLANNING = (ROOT / "docs/planning.md").read_text()
PLANNING_REFERENCE = (ROOT / "docs/planning_reference.md").read_text()
START = [0.498, -0.111, 0.211, 3.142, 0.0, -1.175, 0.0]


class Robot:
    """Stands still, and sees the goal after two commands."""

    def __init__(self) -> None:
        self.targets: list[np.ndarray] = []

    def state(self) -> np.ndarray:
        return np.array(START)

    def image(self) -> np.ndarray:
        return read_image(ROOT / f"docs/plan_{'start' if len(self.targets) < 2 else 'goal'}.png")

    def move_to(self, target: np.ndarray) -> None:
        self.targets.append(target)


def test_robot_loop_of_the_planning_page_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (loop,) = re.findall(r"```python\n(.*?)```", PLANNING, flags=re.DOTALL)
    robot = Robot()
    monkeypatch.chdir(ROOT)
    loop = loop.replace("samples=100", "samples=24").replace("iterations=4", "iterations=2")
    exec(loop, {"robot": robot})  # noqa: S102 - our own page
    assert len(robot.targets) == 2
    moved = np.stack(robot.targets)[:, :3] - START[:3]
    assert (np.abs(moved) <= 0.05 + 1e-9).all()
    assert moved[0, 2] > 0  # up, where the goal is
    assert capsys.readouterr().out.splitlines()[-1].startswith("at the goal")


def test_plan_command_writes_the_documented_keys(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = PLANNING.split("```sh\n")[1].split("```")[0].replace("\\\n", " ")
    shown = shown.replace("samples=200", "samples=12").replace("iterations=5", "iterations=1")
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("vjepa2_ac.reports.planning_figures.plot_plan", lambda _, path, *__: path)
    words = shlex.split(shown)
    assert words[0] == "vjepa2-ac"
    assert main([*words[1:], "--out", str(tmp_path), "--nodes", "3"]) == 0
    assert "Plan of 1 model step" in capsys.readouterr().out
    table = PLANNING_REFERENCE.split("## plan.json")[1].split("##")[0]
    documented = set(
        re.findall(r"`([a-z_]+)`", "\n".join(row.split("|")[1] for row in table.splitlines() if "|" in row))
    )
    file = json.loads((tmp_path / "plan.json").read_text())
    assert set(file) == documented
    for section in ("model", "energy", "seconds"):
        (row,) = (row for row in table.splitlines() if row.startswith(f"| `{section}`"))
        assert set(file[section]) <= set(re.findall(r"`([a-z_]+)`", row)), section
