"""The recipes of docs/extending.md work in a module outside of the package, with YAML and the commands."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from installing import leave_package
from killable import fork_server
from paths import ROOT
from run_fixtures import as_yaml

RECIPES = ("A loss", "A planner", "An energy", "A metric", "A tracker", "A transform", "A data source")
STATE = "0.4,0,0.4,3.1,0,0,0"
PAGE = (ROOT / "docs/extending.md").read_text()


def recipes(*headings: str) -> str:
    """Return the first Python block below each heading of the page."""
    return "\n".join(PAGE.split(f"## {heading}\n")[1].split("```python\n")[1].split("```")[0] for heading in headings)


@pytest.fixture
def plugin_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with a module of the user's."""
    folder = tmp_path / "home"
    folder.mkdir()
    monkeypatch.chdir(folder)
    (folder / "my_module.py").write_text(recipes(*RECIPES))
    return folder


def command(*words: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own, without the working directory on the path."""
    return fork_server().run("-m", "vjepa2_ac.cli", *words, folder=Path.cwd().parent)


def test_training_imports_core_packages_only() -> None:
    code = "import sys, vjepa2_ac.training.loop; print(*(name for name in sys.modules if name.startswith('vjepa2_ac')))"
    process = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert process.stderr == "", "libraries say nothing when they are imported"
    loaded = process.stdout.split()
    assert "vjepa2_ac.model.lora" in loaded
    packages = {name.split(".")[1] for name in loaded if "." in name}
    beside = "simulation init serving inspection calibration goals policies console cli export"
    assert not packages & set(beside.split())


def test_plugin_loss_planner_and_energy_work_from_yaml(plugin_folder: Path, make_config) -> None:
    values = yaml.safe_load(as_yaml(make_config(training__steps=1, run_dir=plugin_folder / "run")))
    values["plugins"] = ["my_module"]
    values["training"] |= {"loss": {"name": "log_cosh", "options": {"scale": 2.0}}}
    values["data"] |= {"workers": 1, "transforms": [{"name": "sensor_noise", "options": {"std": 5.0}}]}
    values["planning"] |= {"planner": "random", "samples": 16, "iterations": 2}
    values["planning"]["energy"] |= {"distance": "largest"}
    values["tracking"] = {"tensorboard": False, "others": {"lines": {"file": "curves.txt"}}}
    (plugin_folder / "own.yaml").write_text(yaml.safe_dump(values))
    trained = command("train", "own.yaml")
    assert trained.returncode == 0, trained.stderr
    assert yaml.safe_load((plugin_folder / "run/config.yaml").read_text())["plugins"] == ["my_module"]

    assert '"train/loss": ' in (plugin_folder / "run/curves.txt").read_text()

    for name, brightness in (("now", 90), ("goal", 160)):
        scene = Image.linear_gradient("L").resize((48, 48)).point(lambda value, more=brightness: (value + more) // 2)
        scene.convert("RGB").save(f"{name}.png")
    words = ["plan", "run", "--start", "now.png", "--goal", "goal.png", "--state", STATE, "--nodes", "0"]
    words += ["--out", "out", "planning.limits.xyz=[0.05,0.05,0.05]"]
    planned = command(*words, "--plugin", "my_module")
    assert planned.returncode in {0, 1}, planned.stderr  # 1: a plan that is predicted to be worse than staying
    assert json.loads((plugin_folder / "out/plan.json").read_text())["settings"]["planner"] == "random"

    # a run may be a stranger's: its config imports nothing that lies beside it
    refused = command(*words)
    assert refused.returncode == 2
    assert "no such module" in refused.stderr
    assert "--plugin my_module" in refused.stderr


def test_plugin_options_and_names_are_validated_with_the_config(plugin_folder: Path, make_config) -> None:
    (plugin_folder / "own.yaml").write_text(as_yaml(make_config()))
    wrong = (
        ("training.loss=log_cosch", "Did you mean log_cosh?"),
        ("training.loss.options={scale: much}", "scale"),
        ("planning.energy.distance=larges", "Did you mean largest?"),
        ("planning.planner.options={a: 1}", "available: start_std, elites"),
    )
    for override, message in wrong:
        words = ["config", "show", "own.yaml", "--plugin", "my_module", "training.loss=log_cosh", override]
        shown = command(*words)
        assert shown.returncode == 2, override
        assert message in shown.stderr, shown.stderr
    missing = command("config", "show", "own.yaml", "--plugin", "my_modul")
    assert (missing.returncode, "no such module" in missing.stderr) == (2, True)


@pytest.mark.usefixtures("plugin_folder")
def test_config_schema_contains_plugin_options() -> None:
    schema = json.loads(command("config", "schema", "--plugin", "my_module").stdout)
    training = schema["$defs"]["TrainingConfig"]["properties"]
    names, *with_options = training["loss"]["anyOf"]
    assert {"l1", "log_cosh"} <= set(names["enum"])
    assert "scale" in with_options[-1]["properties"]["options"]["properties"]


def installed(plugin_folder: Path, entry_points: str, code: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command where a package of the user's is installed: its metadata is what an installation leaves."""
    leave_package(plugin_folder / "site", "my_package", entry_points, code)
    program = plugin_folder.parent / "program.py"
    program.write_text("import sys; sys.path.append('site'); from vjepa2_ac.cli import main; sys.exit(main())")
    return fork_server().run(str(program), *words, folder=plugin_folder.parent)


def test_installed_plugin_is_found_by_its_entry_point(plugin_folder: Path, make_config) -> None:
    (plugin_folder / "own.yaml").write_text(as_yaml(make_config()))
    words = ["config", "show", "own.yaml", "training.loss=log_cosh", "training.loss.options={scale: 3}"]
    process = installed(plugin_folder, "[vjepa2_ac.losses]\nlog_cosh = my_package:LogCosh\n", recipes("A loss"), *words)
    assert process.returncode == 0, process.stderr
    assert yaml.safe_load(process.stdout)["training"]["loss"]["options"] == {"scale": 3}


def test_plugin_data_source_is_recognized_trained_and_evaluated(plugin_folder: Path, base_folder: Path) -> None:
    data = plugin_folder / "walls"
    data.mkdir()
    for number in range(6):
        states = np.zeros((24, 7))
        states[:, number % 3] = np.linspace(0.3, 0.5, 24)
        np.savetxt(data / f"{number}.wall", states)
    plugin = ["--plugin", "my_module"]
    process = command("init", "walls", "--model", str(base_folder), "--out", "own.yaml", *plugin)
    assert process.returncode == 0, process.stdout + process.stderr
    values = yaml.safe_load((plugin_folder / "own.yaml").read_text())
    assert (values["data"]["source"], values["data"]["camera"]) == ("wall", "front")

    overrides = [
        "data.wall.size=24",
        "data.frames=4",
        "data.stride=2",
        "data.workers=0",
        "data.cache=off",
        "run_dir=run",
    ]
    overrides += ["training.steps=1", "training.batch_size=2", "training.accumulation=1", "training.warmup_steps=0"]
    overrides += ["training.allow_weak_base=true", "validation.clips=2", "validation.ranking_clips=1"]
    trained = command("train", "own.yaml", *overrides, *plugin)
    assert trained.returncode == 0, trained.stderr
    measure_options = ["--clips", "2", "--ranking-clips", "0"]
    measured = command("evaluate", "run", *plugin, *measure_options)
    assert measured.returncode == 0, measured.stderr
    keys = {row["key"] for row in json.loads((plugin_folder / "run/metrics.json").read_text())["rows"]}
    assert any(key.startswith("rollout.largest.") for key in keys), sorted(keys)
