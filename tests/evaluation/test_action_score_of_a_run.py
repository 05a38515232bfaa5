"""Plans are measured with a config's planning section, and clips that are too short are refused at once."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from adapted_run import write_adapted_run
from run_fixtures import SilentReporter, tiny_config
from vjepa2_ac.api import load_model
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation import action_score as measure
from vjepa2_ac.evaluation import evaluate
from vjepa2_ac.evaluation.request import SCORED, EvaluationOptions, ProbeOptions
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.policies.action_prior import ActionPrior, PriorCard, PriorSizes, save_prior
from vjepa2_ac.reports.write import evaluate_subject

QUICK = {"ranking_clips": 0, "examples": 0}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plan three steps with few samples."""
    monkeypatch.setattr(measure, "SCORED", SCORED.model_copy(update={"samples": 20, "iterations": 2}))


def asked(folder: Path, data: Path, base: Path, frames: int = 5) -> EvaluationOptions:
    """Return options with data and planning by a config."""
    config = tiny_config(
        folder / "run", data, base,
        data__frames=frames, data__test_share=0.4, data__cache_dir=str(folder / "caches"), validation__batch_size=3,
        planning={"samples": 12, "iterations": 2, "limits": {"xyz": [0.0, 0.03, 0.03]}},
    )  # fmt: skip
    probes = ProbeOptions(**QUICK, planning_clips=3)
    return EvaluationOptions(clips=5, data=config, against=("base",), out=folder / "out", probes=probes)


@pytest.mark.usefixtures("quick")
def test_plans_are_measured_on_held_out_clips_with_the_configs_settings(
    tmp_path: Path, data_folder: Path, base_folder: Path
) -> None:
    reporter = SilentReporter()
    several = replace(
        asked(tmp_path, data_folder, base_folder),
        planning=("planning.iterations=2", "planning.planner.options.elites=3"),
    )
    evaluation = evaluate_subject(str(base_folder), several, reporter).evaluation
    assert {"planning, base", "planning, model"} <= set(reporter.tasks)
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert len(metrics["planning"]["clips"]) == 3
    settings = metrics["planning"]["settings"]
    assert (settings["samples"], settings["iterations"], settings["cem"]["elites"]) == (12, 2, 3)
    assert set(metrics["planning"]["places"]) <= {0, 1}
    assert {row["key"] for row in metrics["rows"]} >= {"plans.missed_cm", "plans.score"}
    one, other = (evaluation.models[name].plans for name in ("base", "model"))
    assert one is not None
    assert other is not None
    assert not one.one_step[..., 0].any(), "planning.limits.xyz holds x"
    assert one.one_step[..., 1].any()
    assert (one.three_steps == other.three_steps).all(), "the same weights plan the same"
    (difference,) = (row for row in metrics["rows"] if row["key"] == "plans_minus_base.missed_cm")
    assert (difference["value"], difference["low"], difference["high"]) == (0.0, 0.0, 0.0)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    "adapter", [{"rank": 4}, {"rank": 4, "dora": True}, {"kind": "none"}], ids=["lora", "dora", "none"]
)
def test_a_trained_model_plans_merged_and_its_errors_are_measured_unmerged(
    make_config, adapter: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = {"samples": 12, "iterations": 2, "planner": {"name": "cem", "options": {"elites": 4}}}
    run = write_adapted_run(make_config(run_dir=str(tmp_path / "a run"), adapter=adapter, planning=small))
    planned: list[bool] = []
    measure = evaluate.measure_plans

    def noting(model: WorldModel, starts: Any, *more: Any, **others: Any) -> Any:
        planned.append(model.adaptation is None)
        return measure(model, starts, *more, **others)

    monkeypatch.setattr(evaluate, "measure_plans", noting)
    asking = EvaluationOptions(
        clips=3, split="validation", out=tmp_path / "out", probes=ProbeOptions(**QUICK, planning_clips=2)
    )
    found = evaluate_subject(str(run), asking).evaluation.models
    assert planned == [adapter.get("kind") == "none", True]  # a base whose adapter is switched off plans as it is
    monkeypatch.setattr("vjepa2_ac.evaluation.evaluate_run.unadapted_copy", lambda model: model)
    as_it_is = evaluate_subject(str(run), replace(asking, out=tmp_path / "other")).evaluation.models
    for name, result in found.items():
        plans, others = result.plans, as_it_is[name].plans
        assert plans is not None
        assert others is not None
        np.testing.assert_allclose(plans.one_step, others.one_step, rtol=0, atol=1e-5)
        np.testing.assert_allclose(plans.three_steps, others.three_steps, rtol=0, atol=1e-5)
        assert (result.errors.of("rollout") == as_it_is[name].errors.of("rollout")).all()
    trained, base = (found[name].plans for name in found if name != "base"), found["base"].plans
    assert base is not None
    assert all(plans is not None and (plans.one_step != base.one_step).any() for plans in trained)


@pytest.mark.parametrize("setting", ["seed=3", "planning.sample=3", "planning.samples=1"])
def test_settings_that_are_none_of_planning_are_refused_before_any_data_are_read(tmp_path: Path, setting: str) -> None:
    options = replace(asked(tmp_path, Path("no such data"), Path("no such model")), planning=(setting,))
    with pytest.raises(InputError, match=setting.partition("=")[0].replace(".", r"\.")):
        evaluate_subject("no such model", options)


def test_clips_too_short_to_plan_on_are_refused_before_any_data_are_read(tmp_path: Path) -> None:
    options = asked(tmp_path, Path("no such data"), Path("no such model"), frames=3)
    with pytest.raises(InputError, match=r"--planning: clips of 3 frames \(data\.frames\).*4 or more"):
        evaluate_subject("model", options)
    assert not (tmp_path / "out").exists()


def test_a_prior_that_is_not_there_is_refused_before_any_data_are_read(tmp_path: Path) -> None:
    setting = f"planning.prior={tmp_path / 'nowhere'}"
    options = replace(asked(tmp_path, Path("no such data"), Path("no such model")), planning=(setting,))
    with pytest.raises(InputError, match=r"nowhere/prior\.json"):
        evaluate_subject("no such model", options)


@pytest.mark.usefixtures("quick")
def test_one_step_plans_of_a_run_start_from_the_prior_of_its_encoder(
    tmp_path: Path, data_folder: Path, base_folder: Path
) -> None:
    model = load_model(base_folder, device="cpu")
    sizes = PriorSizes(model.image_size // model.sizes.patch_size, model.latent_dim, 7, 7, 4)
    prior = ActionPrior(sizes)
    with torch.no_grad():
        prior.outer.weight.zero_()
        prior.outer.bias.copy_(torch.tensor([0.0, 0.01, -0.02, *[0.0] * 4, *[-3.0] * 7]))
    card = PriorCard("vjepa2-ac prior 1", sizes, model.encoder_fingerprint(), "released", "nowhere", 0)
    save_prior(tmp_path / "prior", card, prior)
    settings = f"planning.prior={tmp_path / 'prior'}", "planning.planner=prior"
    options = replace(asked(tmp_path, data_folder, base_folder), planning=settings)
    plans = evaluate_subject(str(base_folder), options).evaluation.models["model"].plans
    assert plans is not None
    np.testing.assert_allclose(plans.one_step[..., :3], np.broadcast_to([0.0, 0.01, -0.02], (1, 3, 3)), atol=1e-6)
