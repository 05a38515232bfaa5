"""An exported model predicts like the run, and its card describes it."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import peft
import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file
from torch import Tensor

from run_fixtures import TINY_CONFIG, SilentReporter, one_thread, tiny_config
from vjepa2_ac import export
from vjepa2_ac.cli import main
from vjepa2_ac.config import ModelSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.export import CARD, Exported, export_run
from vjepa2_ac.model.checkpoints import load_official
from vjepa2_ac.model.lora import use_base_weights
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.reports.metrics_json import METRICS_FILE
from vjepa2_ac.reports.write import PLOT
from vjepa2_ac.runs.checkpoint import select_checkpoint, write_manifest
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.training.loop import train

Trained = Callable[..., Path]
QUICK = ["--clips=4", "--ranking-clips=2", "--samples=4", "--landscapes=1", "--nodes=3", "--examples=1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, data_folder: Path, base_folder: Path) -> Trained:
    """Train for two steps at a rate that moves the weights; return the folder of the run, to be read only.

    Who asks for the same settings again gets the same folder.
    """
    runs: dict[str, Path] = {}

    def make(**changes: object) -> Path:
        settings = {"training__steps": 2, "training__accumulation": 1, "training__learning_rate": 0.05}
        settings |= {"validation__every": 2, "checkpoint__keep_best": False, **changes}  # the base must not be selected
        if (name := json.dumps(settings, sort_keys=True)) not in runs:
            config = tiny_config(tmp_path_factory.mktemp("trained") / "run", data_folder, base_folder, **settings)
            with one_thread():
                runs[name] = train(config, SilentReporter())
        return runs[name]

    return make


@pytest.fixture
def copied(trained: Trained, tmp_path: Path) -> Trained:
    """As `trained`, but a copy, which a test may change."""
    return lambda **changes: shutil.copytree(trained(**changes), tmp_path / "run")


def predictions(model: WorldModel) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    frames, actions, states = (torch.randn(2, 3, *shape, generator=generator) for shape in ((3, 32, 32), (7,), (7,)))
    with torch.no_grad():
        latents = model.encode(frames)
        return model.rollout(latents[:, :1], actions, states)


def assert_predicts_as(world_model: WorldModel, run: Path) -> None:
    model = load_subject(run).world_model
    expected = predictions(model)
    assert (predictions(world_model) - expected).abs().max() <= 1e-5 * expected.abs().max()
    with use_base_weights(model):
        assert (predictions(model) - expected).abs().max() > 1e-3, "training changed nothing: this compares nothing"


def sizes_of(run: Path) -> ModelSizes:
    return load_subject(run).world_model.sizes


@pytest.mark.parametrize("kind", ["lora", "none"])
def test_official_export_predicts_as_the_run(trained, tmp_path: Path, kind: str) -> None:
    run = trained(adapter__kind=kind)
    exported_path = export_run(run, tmp_path / "out.pt", "official").path
    assert exported_path == tmp_path / "out.pt"
    assert_predicts_as(load_official(exported_path, sizes_of(run)), run)


def test_merged_export_predicts_as_the_run(trained, tmp_path: Path) -> None:
    run = trained()
    assert export_run(run, tmp_path / "merged") == Exported(tmp_path / "merged", str(select_checkpoint(run)))
    assert_predicts_as(WorldModel.from_pretrained(tmp_path / "merged"), run)


def rewrite_adapter(run: Path, **changes: object) -> None:
    """Change the newest checkpoint's adapter_config.json, and write its manifest anew."""
    checkpoint = load_subject(run).checkpoint
    path = checkpoint / "adapter" / "adapter_config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))
    write_manifest(checkpoint)


def store_nan(path: Path) -> str:
    """Put one NaN into a file of tensors; return the name of the tensor."""
    tensors = load_file(path)
    name = sorted(tensors)[-1]
    tensors[name].flatten()[-1] = float("nan")
    save_file(tensors, path)
    return name


def test_non_finite_merge_raises_and_writes_nothing(copied, tmp_path: Path) -> None:
    run = copied()
    rewrite_adapter(run, lora_alpha=1e300)
    with pytest.raises(InputError, match=r"alpha: .*less than or equal"):
        export_run(run, tmp_path / "out", "hub")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("kind", "file"),
    [("lora", "adapter_model.safetensors"), ("none", "predictor.safetensors")],
)
def test_non_finite_weight_raises_with_its_name(copied, tmp_path: Path, kind: str, file: str) -> None:
    run = copied(adapter__kind=kind)
    checkpoint = load_subject(run).checkpoint
    name = store_nan(checkpoint / "adapter" / file)
    write_manifest(checkpoint)
    with pytest.raises(InputError, match=rf"{file}: {re.escape(name)} contains NaN or infinity"):
        export_run(run, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_model_card_describes_base_data_and_training(
    trained, base_folder: Path, data_folder: Path, tmp_path: Path
) -> None:
    run = trained()
    export_run(run, tmp_path / "hub", "hub")
    card = (tmp_path / "hub" / CARD).read_text()
    front = yaml.safe_load(card.split("---")[1])
    assert front["library_name"] == "peft"
    base = WorldModel.from_pretrained(base_folder)
    for words in (
        str(base_folder), base.predictor_fingerprint(), base.encoder_fingerprint(), f"rlds, `{data_folder}`",
        "`exterior_1_left`", "4 frames, one every 2 control steps", "2 of 2 planned", "rank 4, alpha 8",
        "batch 2 x accumulation 1", "0.05", "rollout of 2 steps", "parameters are trained",
        "**Not measured**: the run had no",
    ):  # fmt: skip
        assert words in card, words
    weights = peft.PeftModel.from_pretrained(base.predictor, str(tmp_path / "hub")).state_dict()
    assert f"{sum(value.numel() for name, value in weights.items() if '.lora_' in name):,} parameters" in card


def test_names_are_escaped_in_the_model_card(trained, tmp_path: Path) -> None:
    run = shutil.copytree(trained(), tmp_path / "<svg onload=a()>\n```\n# x: y`")
    export_run(run, tmp_path / "hub", "hub")
    card = (tmp_path / "hub" / CARD).read_text()
    name = r"<svg onload=a()>\n```\n# x: y`"
    assert f"\n# `{name.replace('`', '_')}`: a LoRA adapter" in card
    outside = re.sub(r"^```\w*\n.*?^```$|`[^`\n]*`", "", card.partition("\n---\n")[2], flags=re.DOTALL | re.MULTILINE)
    assert "<svg" not in outside
    assert "# x" not in outside


def test_code_of_the_model_card_runs(trained, tmp_path: Path) -> None:
    run = trained(model__sizes=TINY_CONFIG)
    export_run(run, tmp_path / "hub", "hub")
    blocks = re.findall(r"```python\n(.*?)```", (tmp_path / "hub" / CARD).read_text(), flags=re.DOTALL)
    assert len(blocks) == 2
    names: dict[str, Any] = {}
    for block in blocks:
        exec(block.replace("FOLDER", str(tmp_path / "hub")), names)  # noqa: S102 - it is our own code, as a reader runs it
    assert_predicts_as(names["model"], run)
    assert isinstance(names["predictor"], peft.PeftModel)


def test_model_card_contains_metrics_with_their_checkpoint(copied, tmp_path: Path) -> None:
    run = copied(checkpoint__every=1)
    assert main(["evaluate", str(run), *QUICK]) == 0
    measured = json.loads((run / METRICS_FILE).read_text())
    about = measured["about"]
    old = about["checkpoint_path"].replace("step-00000002", "step-00000001")
    (run / METRICS_FILE).write_text(json.dumps({**measured, "about": {**about, "checkpoint_path": old}}))
    assert main(["export", str(run), str(tmp_path / "hub"), "--to", "hub"]) == 0
    card = (tmp_path / "hub" / CARD).read_text()
    assert measured["summary"]["predicts"]["statement"] in " ".join(card.split())
    assert f"]({PLOT})" in card
    assert (tmp_path / "hub" / PLOT).read_bytes() == (run / PLOT).read_bytes()
    assert str(run.parent) not in (tmp_path / "hub" / METRICS_FILE).read_text(), "a path of this machine"
    assert "another checkpoint**: `step-00000001`, not `step-00000002`" in card


def test_damaged_metrics_raise_before_export_writes(copied, tmp_path: Path) -> None:
    run = copied()
    (run / METRICS_FILE).write_text("{")
    with pytest.raises(InputError, match=r"metrics\.json.*vjepa2-ac evaluate"):
        export_run(run, tmp_path / "hub", "hub")
    assert not (tmp_path / "hub").exists()


def test_hub_export_without_adapter_raises(trained, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"without an adapter.*--to merged or --to official"):
        export_run(trained(adapter__kind="none"), tmp_path / "hub", "hub")


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is loaded."""

    def refuse(folder: Path, checkpoint: str, **_: object) -> None:
        del checkpoint
        pytest.fail(f"{folder} was loaded")

    monkeypatch.setattr(export, "load_subject", refuse)


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize("form", ["merged", "official", "hub"])
def test_unusable_destination_raises_before_the_export(tmp_path: Path, form: Any) -> None:
    (tmp_path / "there.pt").write_text("precious")
    for destination in (tmp_path, tmp_path / "there.pt"):
        with pytest.raises(InputError, match=r"a file with this name exists|not empty|ends in \.pt"):
            export_run(tmp_path / "run", destination, form)
    assert (tmp_path / "there.pt").read_text() == "precious"
    with pytest.raises(InputError, match="cannot be written"):
        export_run(tmp_path / "run", tmp_path / "there.pt" / "below", form)
