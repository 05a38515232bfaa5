"""A predictor without states, end to end: trained, evaluated and exported."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from run_fixtures import TINY
from same_run import metrics
from vjepa2_ac.config import Config, ModelConfig, ModelSizes
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.export import export_run
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.training.loop import train

MakeConfig = Callable[..., Config]
SIZES = {**TINY, "predictor": {**TINY["predictor"], "use_states": False}}  # type: ignore[dict-item]
PROBES = ProbeOptions(ranking_clips=2, samples=4, landscape_clips=1, nodes=3, examples=1)
QUICK = EvaluationOptions(split="validation", clips=4, probes=PROBES, checkpoint="newest")


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("base") / "model"
    WorldModel.random(ModelSizes.model_validate(SIZES), seed=3).save_pretrained(folder)
    return folder


def test_model_without_states_from_training_to_export(
    make_config: MakeConfig, reporter: Any, tmp_path: Path, base: Path
) -> None:
    folder = train(make_config(model__base=str(base), adapter__modules_to_save=["action_encoder"]), reporter)
    losses = [row["loss"] for row in metrics(folder) if row["kind"] == "train"]
    assert len(losses) == 6
    assert np.isfinite(losses).all()
    run = load_subject(folder)
    assert not run.world_model.sizes.predictor.use_states

    evaluation = evaluate_subject(str(folder), QUICK)
    assert list(evaluation.models) == ["base", "adapter"]

    merged = export_run(folder, tmp_path / "merged").path
    loaded = load_base(ModelConfig(base=str(merged), dtype="float32"), seed=5)
    assert loaded.sizes == run.world_model.sizes
    generator = torch.Generator().manual_seed(1)
    latents, actions, states = (torch.randn(1, 2, *shape, generator=generator) for shape in ((4, 24), (7,), (7,)))
    with torch.no_grad():
        expected = run.world_model.eval().predict(latents, actions, states)
        torch.testing.assert_close(loaded.predict(latents, actions, states), expected, atol=1e-5, rtol=1e-5)
    with pytest.raises(InputError, match=r"the only widths that Meta's code supports.* --to merged"):
        export_run(folder, tmp_path / "official.pt", "official")
