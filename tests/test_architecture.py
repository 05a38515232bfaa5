"""The layers of the package, and the modules that may import heavy libraries; each test lists all violations."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import vjepa2_ac
from paths import ROOT

PACKAGE = Path(vjepa2_ac.__file__).parent

# A package or module imports only lower layers. Names in one line, or between two "<", do not import each other.
LAYERS = [  # from the lowest layer up
    "__init__ errors episode intervals process",
    "registry reporter spaces storage",
    "config media",
    "data model distributed",
    "encoding runs",
    "decoding planning",
    "evaluation goals policies",
    "serving simulation",
    "inspection",
    "reports training",
    "api export init explore",
    "cli",
]
LAYERS_WITHIN = """
data: poses < index < selection files transforms < idle windows < sources < clips < dataset < loader convert
data.sources: tfrecord parquet latent_files indexed_source < rlds_shards lerobot_meta < rlds_episode < rlds \
    droid_raw lerobot npz latents
serving: wire access < client request recording < session < metadata server
model: model_files distances compilation low_rank < attention < blocks < encoder predictor < world_model < lora \
    checkpoints < adapter_folder
evaluation: request result < measure distribution rows < action_use summary < evaluate < decoded < evaluate_run \
    < imagined
explore: messages < explorer < search < views < server
decoding: decoder < frame_pairs imagine < training
reports: metrics_json < comparison < evaluation_figures planning_figures < write
cli: waiting < progress < options tables < train < data < evaluate explore plan policies closed_loop setup < \
    program < __main__
simulation: domains droid_writer < motion camera < arm < tasks < rollout < policies < record < benchmark \
    counterfactual < worlds < manifest
"""
ORDERS = {"": LAYERS}
for line in LAYERS_WITHIN.strip().splitlines():
    package, _, order = line.partition(": ")
    ORDERS[package] = order.split("<")

ALLOWED_IMPORTERS = {
    "PIL": ["media/"],
    "accelerate": [
        "distributed.py",
        "runs/metrics_log.py",
        "training/",
        "encoding/encode_dataset.py",
        "inspection/variants.py",
    ],
    "av": ["media/"],
    "decord": [],
    "fsspec": ["storage/remote.py"],
    "google": [],
    "google_crc32c": ["data/sources/tfrecord.py"],
    "h5py": ["data/sources/droid_raw.py"],
    "huggingface_hub": ["export.py", "storage/transfer.py"],
    "jinja2": ["export.py", "reports/"],
    "markupsafe": ["reports/"],
    "matplotlib": ["inspection/sheet.py", "media/", "reports/"],
    "msgpack": ["serving/wire.py"],
    "mujoco": ["simulation/domains.py"],
    "peft": ["model/adapter_folder.py", "model/lora.py"],
    "pyarrow": ["data/sources/parquet.py"],
    "ray": ["encoding/ray_engine.py"],
    "rich": ["cli/progress.py", "cli/tables.py"],
    "simplejpeg": ["media/", "simulation/droid_writer.py"],
    "tensorflow": [],
    "torchvision": [],
    "transformers": ["model/encoder.py", "model/predictor.py"],
    "websockets": ["explore/", "serving/"],
}  # fmt: skip

MAX_FILES = 16  # in one folder, `__init__` included


@cache
def modules() -> dict[str, Path]:
    """Every module by its name within the package; the package itself is `__init__`."""
    paths = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        paths[name if name == "__init__" else name.removesuffix(".__init__")] = path
    return paths


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Every module or name that a file imports, dotted."""
    imports = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            imports |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            imports |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "require_library":
            imports |= {word.value for word in node.args if isinstance(word, ast.Constant)}
    return frozenset(imports)


def own_imports(path: Path) -> set[str]:
    """The modules of this package that a file imports; the package itself names its public ones for type checkers."""
    imported: set[str] = set()
    if path == PACKAGE / "__init__.py":
        return imported
    for name in imports_of(path):
        package, _, rest = name.partition(".")
        if package == "vjepa2_ac":
            imported.add(rest if rest in modules() else rest.rpartition(".")[0] or "__init__")
    return imported


def package_within(folder: str, module: str) -> str | None:
    """The part of a folder, a package or a module, that contains a module; None: the module is not in the folder."""
    if not folder:
        return module.split(".", maxsplit=1)[0]
    return module[len(folder) + 1 :].split(".", maxsplit=1)[0] if module.startswith(folder + ".") else None


def test_package_imports_only_lower_packages() -> None:
    wrong = []
    for folder, order in ORDERS.items():
        rank = {package: level for level, line in enumerate(order) for package in line.split()}
        for module, path in modules().items():
            package = package_within(folder, module)
            if package is None:
                continue
            if package not in rank:
                wrong.append(f"{module}: not in the order of {folder or 'the package'}")
                continue
            for other_module in own_imports(path):
                other = package_within(folder, other_module)
                if other is not None and other != package and rank.get(other, -1) >= rank[package]:
                    wrong.append(f"{module} imports {other_module}")
    assert not wrong, "\n".join(sorted(wrong))


def test_imports_between_packages_have_no_cycle() -> None:
    """At every level, the imports between the parts of a folder form no cycle."""
    for folder in {""} | {name.rpartition(".")[0] for name in modules() if "." in name}:
        arrows: defaultdict[str, set[str]] = defaultdict(set)
        for module, path in modules().items():
            if package := package_within(folder, module):
                arrows[package] |= {
                    other for imported in own_imports(path) if (other := package_within(folder, imported))
                } - {package}
        TopologicalSorter(arrows).prepare()  # its error names the circle


def test_folders_have_at_most_sixteen_modules() -> None:
    count = defaultdict(int)
    for path in modules().values():
        count[path.parent.relative_to(PACKAGE).as_posix()] += 1
    assert not {folder: files for folder, files in count.items() if files > MAX_FILES}


def test_layer_diagram_in_the_docs_equals_the_layers() -> None:
    notes = (ROOT / "docs/IMPLEMENTATION_NOTES.md").read_text().split("\n## Package layers\n")[1].split("\n## ")[0]
    drawn = re.findall(r"^[ \d]\d  (.{37})", notes, re.MULTILINE)
    assert [set(line.split()) for line in drawn[::-1]] == [set(line.split()) - {"__init__"} for line in ORDERS[""]]


def test_heavy_libraries_are_imported_in_allowed_modules_only() -> None:
    wrong = []
    for path in modules().values():
        name = path.relative_to(PACKAGE).as_posix()
        for module in imports_of(path):
            homes = ALLOWED_IMPORTERS.get(module.split(".")[0])
            if homes is not None and not any(name.startswith(home) for home in homes):
                wrong.append(f"{name} imports {module}")
    assert not wrong, "\n".join(sorted(wrong))


EXTRAS: dict[str, list[str]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
LIBRARIES_OF_EXTRAS = {  # the libraries that each extra of the program brings, by name
    extra: {re.split(r"[\[<>=]", requirement)[0] for requirement in needed}
    for extra, needed in EXTRAS.items() if extra not in {"data", "dev", "docs"}
}  # fmt: skip


def test_modules_can_be_imported_without_extras() -> None:
    code = (
        "import sys, importlib\n"
        f"sys.modules.update(dict.fromkeys({sorted(set().union(*LIBRARIES_OF_EXTRAS.values()))}))\n"
        f"for name in {sorted(set(modules()) - {'__init__', 'cli.__main__'})}:\n"
        "    importlib.import_module(f'vjepa2_ac.{name}')\n"
    )
    process = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr[-600:]


def test_install_hint_names_an_extra_with_the_library() -> None:
    num_checked, wrong = 0, []
    for module, path in modules().items():
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "require_library":
                keywords = {
                    word.arg: word.value.value for word in node.keywords if isinstance(word.value, ast.Constant)
                }
                library = node.args[0].value if isinstance(node.args[0], ast.Constant) else "websockets"  # serve's loop
                num_checked += 1
                if str(library).split(".")[0] not in {
                    requirement.replace("-", "_") for requirement in LIBRARIES_OF_EXTRAS.get(str(keywords["extra"]), ())
                }:
                    wrong.append(f"{module}: {library}: {keywords['extra']}")
    assert num_checked > 5
    assert not wrong


def test_modules_do_not_import_the_public_names() -> None:
    """Otherwise the test of the layers would miss these imports."""
    public = {f"vjepa2_ac.{name}" for name in vjepa2_ac.__all__}
    assert not {module: imported for module, path in modules().items() if (imported := imports_of(path) & public)}
