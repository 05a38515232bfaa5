"""What the documentation shows as a complete config is one; files, modules and knobs that it names are there."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest
import yaml

import vjepa2_ac
from paths import ROOT
from vjepa2_ac.config.loading import all_keys, parse_config
from vjepa2_ac.registry import REGISTRIES

OF_DATA = [(ROOT / f"docs/{name}.md").read_text() for name in ("data", "data_reference")]
TEXTS = ("docs", "src", "examples", "scripts", "configs", "benchmarks", "evidence")
SUFFIXES = {".md", ".py", ".yaml", ".sh", ".txt", ".ipynb", ".jinja", ".html"}
BLOCKS = [text for page in OF_DATA for text in re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL)]


@pytest.mark.parametrize("text", BLOCKS, ids=lambda text: text.splitlines()[0])
def test_every_config_of_the_data_pages_is_complete(text: str) -> None:
    parse_config(yaml.safe_load(text), where="docs/data.md")


# Names in docs and docstrings: files, modules, knobs.

DOCS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
TODAY = [*DOCS, *SOURCES]
PACKAGE = ROOT / "src/vjepa2_ac"
OURS = {path.name for root in (ROOT, PACKAGE, ROOT / "tests") for path in root.iterdir() if path.is_dir()}
OURS -= {"src", "demo"}  # the second is made by commands

FILES = ("json", "md", "npz", "png", "pt", "safetensors", "yaml")


def is_there(path: str) -> bool:
    """Whether a file is in the project, named from its root, from the package, or from the tests."""
    return any((root / path).exists() for root in (ROOT, PACKAGE, ROOT / "tests"))


def is_module_or_part_of_one(dotted: str) -> bool:
    """Whether a dotted name within the package is public, a module, or what a module defines or imports."""
    parts = dotted.split(".")
    if parts[0] in vjepa2_ac.__all__:
        return True
    for length in range(len(parts), 0, -1):
        place = PACKAGE.joinpath(*parts[:length])
        file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        if file.is_file():
            rest = parts[length:]
            return not rest or rest[0] in names_in(file)
    return False


GROUPS = {one.group for one in REGISTRIES} | {"vjepa2_ac.commands"}  # entry points, which look like modules


@cache
def names_in(file: Path) -> frozenset[str]:
    tree = ast.parse(file.read_text())
    defined = {node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    assigned = {
        name.id for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)
        for name in ast.walk(node) if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
    }  # fmt: skip
    imported = {
        alias.asname or alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    return frozenset(defined | assigned | imported)


def is_knob(dotted: str) -> bool:
    return any(f"{key}.".startswith(f"{dotted}.") for key in all_keys())


def test_files_that_are_named_are_there() -> None:
    """Files of ours: with a folder before them. Those of other projects stand beside their commit."""
    wrong = []
    for path in TODAY:
        text = re.sub(r"Source: .*?(?=\n\s*\n|\"\"\"|\Z)", "", path.read_text(), flags=re.DOTALL)
        named = re.findall(r"(?<![\w./~-])((?:[a-z_]+/)+[A-Za-z_]+\.(?:py|md|yaml|png|sh|txt))\b", text)
        ours = [name for name in named if name.split("/")[0] in OURS]
        wrong += [f"{path.relative_to(ROOT)}: {name}" for name in ours if not is_there(name)]
    assert not wrong, "\n".join(wrong)


def test_modules_that_are_named_are_there() -> None:
    """`vjepa2_ac.x.y` anywhere; and `x.y` where x is a room, unless that is a knob."""
    wrong = []
    for path in [*TODAY, *PACKAGE.rglob("*.jinja")]:
        text = path.read_text()
        whole = re.findall(r"\bvjepa2_ac\.([a-z_]\w*(?:\.[A-Za-z_]\w*)*)", text)
        within = re.findall(r"`([a-z_]+(?:\.[A-Za-z_]\w*)+)`", text)
        within = [name for name in within if (PACKAGE / name.split(".", maxsplit=1)[0]).is_dir() and not is_knob(name)]
        named = [name for name in whole + within if not name.endswith(FILES) and f"vjepa2_ac.{name}" not in GROUPS]
        wrong += [f"{path.relative_to(ROOT)}: {name}" for name in named if not is_module_or_part_of_one(name)]
    assert not wrong, "\n".join(wrong)


SECTIONS = (
    "adapter", "checkpoint", "data", "decoder", "model", "planning", "replay", "tracking", "training", "validation",
)  # fmt: skip


def test_knobs_that_are_named_are_there() -> None:
    wrong = []
    for path in [path for path in DOCS if path.name not in ("decisions.md", "IMPLEMENTATION_NOTES.md")]:
        named = re.findall(rf"`((?:{'|'.join(SECTIONS)})\.[a-z_]+(?:\.[a-z_]+)*)(?:[:=][^`]*)?`", path.read_text())
        wrong += [
            f"{path.name}: {name}" for name in named
            if not name.endswith(FILES) and not is_knob(name) and not is_module_or_part_of_one(name)
        ]  # fmt: skip
    assert not wrong, "\n".join(wrong)


def test_no_text_installs_the_bare_name() -> None:
    """Whoever registers the name on an index could run code on the machine of every reader."""
    names = [*ROOT.glob("*.md"), *(path for folder in TEXTS for path in (ROOT / folder).rglob("*"))]
    texts = {path: path.read_text() for path in names if path.suffix in SUFFIXES}
    bare = re.compile(r"""pip\S* install[^\n`#]*[\s"']vjepa2[-_]ac(?:\[[\w,]+\])?["'`\s](?!@)""")
    assert not {path.name: found for path, text in texts.items() if (found := bare.findall(text))}
    assert bare.search('pip install "vjepa2-ac[sim]"')
    assert bare.search("pip install -U vjepa2-ac\n")
    assert not bare.search('pip install "vjepa2-ac[sim] @ file:///x.whl"')
