"""A base that was moved is recognised by its fingerprint, wherever a run is used; another base is refused."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from adapted_run import write_adapted_run
from run_fixtures import TINY
from same_run import assert_same_run
from vjepa2_ac.api import load_run
from vjepa2_ac.cli import main
from vjepa2_ac.config import ModelSizes
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import load_models
from vjepa2_ac.evaluation.request import EvaluationOptions, settle
from vjepa2_ac.export import export_run
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.model_setup import load_to_plan
from vjepa2_ac.runs.folder import read_run_config
from vjepa2_ac.training import setup


@pytest.fixture
def run(make_config, base_folder: Path, tmp_path: Path) -> str:
    """Return a run whose base is gone from its path."""
    folder = write_adapted_run(make_config(base_folder=shutil.copytree(base_folder, tmp_path / "gone")))
    shutil.rmtree(tmp_path / "gone")
    return str(folder)


@pytest.fixture(scope="module")
def another(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a base of the same sizes with other weights."""
    folder = tmp_path_factory.mktemp("another") / "base"
    WorldModel.random(ModelSizes.model_validate(TINY), seed=4).save_pretrained(folder)
    return str(folder)


@torch.no_grad()
def prediction(model: WorldModel) -> torch.Tensor:
    latents = torch.randn(1, 1, model.num_tokens, model.latent_dim, generator=torch.Generator().manual_seed(0))
    return model.predict(latents, torch.full((1, 1, 7), 0.1), torch.full((1, 1, 7), 0.2))


def exported(run: str, overrides: list[str]) -> WorldModel:
    target = Path(run).parent / "exported"
    return WorldModel.from_pretrained(export_run(Path(run), target, overrides=overrides).path)


def evaluated(run: str, overrides: list[str]) -> WorldModel:
    asked = EvaluationOptions(overrides=tuple(overrides))
    config = settle(run, asked)
    return load_models(run, config, asked, open_dataset(config.data)).world_model


@pytest.mark.parametrize(
    "load",
    [
        lambda run, overrides: load_run(run, overrides=overrides).world_model,
        lambda run, overrides: load_to_plan(run, overrides=overrides).world_model,
        exported,
        evaluated,
    ],
    ids=["load_run", "plan", "export", "evaluate"],
)
def test_a_run_is_used_with_its_moved_base_and_with_no_other(
    run: str, base_folder: Path, another: str, load: Callable[[str, list[str]], WorldModel]
) -> None:
    with pytest.raises(InputError, match=rf"gone: no such .* run `vjepa2-ac train {run} --resume model\.base=PATH`"):
        load(run, [])
    with pytest.raises(InputError, match="an adapter trained on another predictor"):
        load(run, [f"model.base={another}"])
    found = prediction(load(run, [f"model.base={base_folder}"]))
    base = prediction(WorldModel.from_pretrained(base_folder))
    assert not torch.allclose(found, base, atol=1e-4), "the adapter is on it"


def test_nothing_else_is_changed_on_the_way(run: str, base_folder: Path) -> None:
    with pytest.raises(InputError, match=r"adapter\.rank=8: a setting that loading does not use"):
        load_run(run, overrides=["adapter.rank=8"])
    with pytest.raises(InputError, match="not the folder of a run"):
        load_to_plan(str(base_folder), overrides=["model.base=elsewhere"])
    asked = EvaluationOptions(overrides=(f"model.base={base_folder}", "planning.samples=30"))
    config = settle(run, asked)
    assert (config.model.base, config.planning.samples) == (str(base_folder), 30)
    with pytest.raises(InputError, match=r"override: model\.dtype"):
        settle(run, EvaluationOptions(overrides=("model.dtype=bfloat16",)))


STATE = "0.4,0,0.3,3.1,0,0.1,0.2"


@pytest.mark.parametrize(
    "command",
    [
        "evaluate RUN --clips 4",
        "export RUN exported",
        "plan RUN --start a.png --goal a.png --state STATE",
        "train RUN --resume",
    ],
)
def test_the_error_shows_the_command_with_the_new_path(
    run: str, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    words = command.replace("RUN", run).replace("STATE", STATE)
    assert main(words.split()) == 2
    assert f"run `vjepa2-ac {words} model.base=PATH`" in capsys.readouterr().err


def test_a_run_resumes_on_its_moved_base_and_keeps_the_path(
    whole_run: Path, base_folder: Path, another: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    run, moved = shutil.copytree(whole_run, tmp_path / "run"), shutil.copytree(base_folder, tmp_path / "moved")
    shutil.rmtree(run / "checkpoints/step-00000006")
    with monkeypatch.context() as patched:
        patched.setattr(setup, "with_latents", lambda *_, **__: pytest.fail("encodes with another encoder"))
        assert main(["train", str(run), "--resume", f"model.base={another}"]) == 2
    assert "an adapter trained on another predictor" in capsys.readouterr().err
    assert read_run_config(run).model.base == str(base_folder)
    assert main(["train", str(run), "--resume", f"model.base={moved}"]) == 0
    assert read_run_config(run).model.base == str(moved)
    assert_same_run(whole_run, run)
    assert main(["train", str(run), "--resume", "run_dir=elsewhere"]) == 2
