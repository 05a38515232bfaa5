"""The order of rooms and the homes of heavy libraries, held by a machine."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import vjepa2_ac

PACKAGE = Path(vjepa2_ac.__file__).parent

# A room imports only rooms of a lower rank; rooms of one rank do not know each other.
RANK = {
    "__init__": 0, "errors": 0, "output": 0, "ending": 0, "places": 0, "remote": 0.5,
    "config": 1, "structured": 1.2, "config_errors": 1.4, "config_file": 1.5, "episode": 1, "geometry": 1,
    "storage": 1, "data": 2, "model": 2, "latents": 3, "encoding": 3.5, "planning": 4, "evaluation": 5,
    "training": 6, "simulation": 7,
    "console": 8, "console_data": 8.2, "console_doctor": 8.2, "cli_parts": 8.4, "cli_data": 8.5, "cli_doctor": 8.5,
    "cli_encode": 8.5, "console_evaluation": 8.2, "cli_evaluate": 8.7, "console_planning": 8.2, "cli_plan": 8.8,
    "console_simulation": 8.2, "cli_simulate": 8.8, "cli": 9,
}  # fmt: skip

HOMES = {
    "peft": {"model/lora.py", "model/lora_linear.py"},
    "transformers": {"model/encoder.py", "model/predictor.py"},
    "accelerate": {"training/"},
    "google": {"data/sources/rlds/tfrecord.py"},
    "google_crc32c": {"data/sources/rlds/tfrecord.py"},
    "simplejpeg": {"data/"},
    "PIL": {"data/picture_file.py"},
    "mujoco": {"simulation/"},
    "matplotlib": {
        "evaluation/plots.py",
        "evaluation/contact_sheet.py",
        "evaluation/clip_picture.py",
        "evaluation/plan_picture.py",
        "evaluation/captioned.py",
    },
    "fsspec": {"remote/"},
    "av": {"data/video.py", "data/video_writing.py"},
    "h5py": {"data/sources/droid_raw/trajectory.py"},
    "pyarrow": {"data/sources/lerobot/"},
    "torchao": {"model/quantization.py"},
    "rich": {"console.py", "console_data.py", "console_evaluation.py", "console_planning.py", "console_simulation.py"},
    "tensorflow": set(),
    "torchvision": set(),
    "decord": set(),
}


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else "__init__"


FILES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_room_imports_only_rooms_that_stand_before_it(path: Path) -> None:
    room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    for module in imports_of(path):
        if not module.startswith("vjepa2_ac"):
            continue
        other = room_of(module)
        if other in RANK and other != room:
            assert RANK[other] < RANK[room], f"{path.name} ({room}) imports {module}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_heavy_libraries_stay_in_their_homes(path: Path) -> None:
    name = path.relative_to(PACKAGE).as_posix()
    for module in imports_of(path):
        homes = HOMES.get(module.split(".")[0])
        assert homes is None or any(name.startswith(home) for home in homes), f"{name} imports {module}"


def test_every_room_has_a_rank() -> None:
    rooms = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in FILES}
    assert rooms <= set(RANK)


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_file_opens_with_a_line_that_says_what_it_is_for(path: Path) -> None:
    docstring = ast.get_docstring(ast.parse(path.read_text()))
    assert docstring, f"{path}: no docstring"
    assert len(docstring.splitlines()[0]) <= 118


def test_importing_the_package_and_asking_for_help_do_not_import_torch() -> None:
    code = (
        "import sys, contextlib, io, vjepa2_ac, vjepa2_ac.cli\n"
        "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):\n"
        "    vjepa2_ac.cli.main(['--help'])\n"
        "assert not {'torch', 'transformers', 'numpy', 'mujoco'} & set(sys.modules), sorted(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_only_the_command_line_prints() -> None:
    for path in FILES:
        if path.name in {"cli.py", "console.py"}:
            continue
        calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
        assert not [c for c in calls if isinstance(c.func, ast.Name) and c.func.id == "print"], path
