"""A predictor without states, end to end: trained, resumed, evaluated, exported and planned with."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from run_fixtures import TINY
from same_run import metrics
from vjepa2_ac.config import Config, ModelConfig, ModelSizes, PlanningConfig
from vjepa2_ac.episode import STATE_DIM
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.export import export_run
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.model_setup import load_to_plan
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.training.loop import train

MakeConfig = Callable[..., Config]
SIZES = {**TINY, "predictor": {**TINY["predictor"], "use_states": False}}  # type: ignore[dict-item]
PROBES = ProbeOptions(ranking_clips=2, samples=4, landscape_clips=1, nodes=3, examples=1)
QUICK = EvaluationOptions(split="validation", clips=4, probes=PROBES, checkpoint="newest")
SEARCH = PlanningConfig(samples=6, iterations=2, planner={"name": "cem", "options": {"elites": 3}})
STATE = np.array([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2])


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("base") / "model"
    WorldModel.random(ModelSizes.model_validate(SIZES), seed=3).save_pretrained(folder)
    return folder


def image(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (36, 64, 3), dtype=np.uint8)


def drive(controller: Controller, state: np.ndarray) -> np.ndarray:
    """Return the actions of two steps, each seen in the state that the last one led to."""
    controller.reset(image(9))
    actions = []
    for step in range(2):
        actions.append(controller.act(image(step), state))
        assert controller.decision is not None
        assert controller.decision.why == "planned"
        state = state + np.resize(actions[-1], state.shape)
        if len(state) == STATE_DIM:
            state[-1] = np.clip(state[-1], 0, 1)  # a gripper opens no farther
    return np.stack(actions)


def test_from_training_to_a_plan(make_config: MakeConfig, reporter: Any, tmp_path: Path, base: Path) -> None:
    folder = train(make_config(model__base=str(base), adapter__modules_to_save=["action_encoder"]), reporter)
    losses = [row["loss"] for row in metrics(folder) if row["kind"] == "train"]
    assert len(losses) == 6
    assert np.isfinite(losses).all()
    run = load_subject(folder)
    assert not run.world_model.sizes.predictor.use_states

    evaluation = evaluate_subject(str(folder), QUICK)
    assert list(evaluation.models) == ["base", "adapter"]

    assert drive(Controller.of_run(run, SEARCH), STATE).shape == (2, 7)
    merged = export_run(folder, tmp_path / "merged").path
    loaded = load_base(ModelConfig(base=str(merged), dtype="float32"), seed=5)
    assert loaded.sizes == run.world_model.sizes
    generator = torch.Generator().manual_seed(1)
    latents, actions, states = (torch.randn(1, 2, *shape, generator=generator) for shape in ((4, 24), (7,), (7,)))
    with torch.no_grad():
        expected = run.world_model.eval().predict(latents, actions, states)
        torch.testing.assert_close(loaded.predict(latents, actions, states), expected, atol=1e-5, rtol=1e-5)
    planned = load_to_plan(str(merged), overrides=["planning.samples=6", "planning.planner.options.elites=3"])
    drive(Controller.of_subject(planned), STATE)
    with pytest.raises(InputError, match=r"Meta's code has no other.* --to merged"):
        export_run(folder, tmp_path / "official.pt", "official")
