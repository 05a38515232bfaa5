"""The variants study: failing variants fail, the losses and metrics are correct, and the table follows its rule."""

import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from paths import ROOT
from vjepa2_ac.simulation.rollout import send_action
from vjepa2_ac.training.step import prediction_losses

MODULES = ("failing_variants", "variants", "variants_tables")


@pytest.fixture(scope="module")
def study() -> Iterator[Any]:
    """The modules of the study."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "evidence"))
        modules = SimpleNamespace(**{name: import_module(name) for name in MODULES})
        for name in ("DEMONSTRATIONS", "HELD_OUT", "SEGMENTS", "GROUPS"):  # one episode with one segment
            patch.setattr(modules.variants, name, 1)
        patch.setattr(modules.variants, "EPISODE_STEPS", 42)
        yield modules
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", "")).startswith(str(ROOT / "evidence")):
            sys.modules.pop(name)


@pytest.fixture(scope="module")
def recorded(study: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A folder with the recordings of one short episode for training, and of another one for the measurement."""
    folder = tmp_path_factory.mktemp("variants")
    study.variants.prepare_seed(study.variants.Seed(0), folder)
    return folder


@pytest.fixture
def recordings(study: Any, recorded: Path) -> Any:
    """The recordings for training."""
    return study.variants.load_recordings(study.variants.Seed(0).path(recorded))[0]


def test_failing_variants_start_like_the_demonstration_and_end_elsewhere(study: Any, recordings: Any) -> None:
    groups, (count, alternatives) = recordings.groups, recordings.groups.failed.shape
    assert (count, alternatives) == (1, 1 + len(study.failing_variants.VARIANTS))
    assert not groups.failed[:, 0].any()
    assert torch.equal(groups.states[:, :, 0], groups.states[:, :1, 0].expand(-1, alternatives, -1))
    assert torch.equal(groups.latents[:, :, 0], groups.latents[:, :1, 0].expand(-1, alternatives, -1, -1))
    change = (groups.states[:, :, -1] - groups.states[:, :1, -1]).numpy()
    is_far = (np.linalg.norm(change[..., :3], axis=-1) > 0.05) | (np.abs(change[..., 6]) > 0.5)
    assert np.array_equal(groups.failed.numpy(), is_far), "failure is measured after the execution"
    always = [family in {"offset at the end", "gripper"} for family, _ in study.failing_variants.VARIANTS]
    assert groups.failed[:, 1:][:, always].all()
    integrated = groups.states[:, :, 0, :3] + groups.actions[..., :3].sum(dim=2)
    assert torch.allclose(integrated, groups.states[:, :, -1, :3], atol=1e-5), "actions are measured differences"


def test_perturbations_change_what_their_family_names(study: Any) -> None:
    perturb, rng = study.failing_variants.perturb, np.random.default_rng(0)
    actions = np.full((4, 7), 0.05)
    actions[:, 0] = [0.01, 0.02, 0.03, 0.04]
    goal = np.zeros(7)
    assert np.array_equal(perturb(actions, "lag", 2, goal, rng)[:, 0], [0.0, 0.0, 0.01, 0.02])
    assert np.array_equal(perturb(actions, "wrong direction", 180.0, goal, rng)[:, :2].round(9), -actions[:, :2])
    assert np.allclose(perturb(actions, "scale", 0.5, goal, rng)[:, :3], actions[:, :3] / 2)
    assert np.array_equal(perturb(actions, "gripper", 1, goal, rng)[:, 6], [0.05, 0.05, 0.05, 1.0])
    assert (perturb(actions, "drop-out", 3, goal, rng) == 0.0).all(axis=1).sum() == 3
    offset = perturb(actions, "offset at the end", 0.08, goal, rng) - actions
    assert np.linalg.norm(offset, axis=1) == pytest.approx([0, 0, 0, 0.08])
    assert np.abs(perturb(actions, "noise", 0.04, goal, rng) - actions)[:, :3].min() > 0
    with pytest.raises(ValueError, match="not a family"):
        perturb(actions, "nothing", 1, goal, rng)
    assert actions[1, 0] == 0.02, "the demonstration is unchanged"


def test_executed_variant_is_the_motion_of_the_simulator(study: Any) -> None:
    variants = study.variants
    arm = study.failing_variants.make_arm(0, variants.Seed(0).spec)
    start, action = arm.joints, np.array([0.03, -0.02, 0.01, 0.0, 0.0, 0.0, 1.0])
    frames, states = study.failing_variants.execute(arm, np.stack([action, -action]))
    arm.set_joints(start, 0.0)
    send_action(arm, action, 4)
    assert np.array_equal(states[0], arm.state)
    assert frames.shape[0] == 2
    assert (frames[0] != frames[1]).any()


def test_losses_of_the_baseline_are_those_of_training(study: Any, recordings: Any) -> None:
    variants = study.variants
    model = variants._load_base_model()
    clips = variants.draw_clips(recordings, np.random.default_rng(0))
    short = replace(clips, latents=clips.latents[:, :4], states=clips.states[:, :4], actions=clips.actions[:, :3])
    losses = variants.clip_losses(model, clips, 2)
    expected = prediction_losses(model, short, 2)
    assert [float(loss) for loss in losses.values()] == pytest.approx([float(loss) for loss in expected], rel=1e-6)
    longer = variants.clip_losses(model, clips, 10)
    rolled = model.rollout(clips.latents[:, :1], clips.actions, clips.states[:, :-1])
    assert float(longer["rollout"]) == pytest.approx(float((rolled - clips.latents[:, 1:]).abs().mean()), rel=1e-5)
    assert float(longer["forced"]) == pytest.approx(float(losses["forced"]), rel=1e-6)


def test_variant_losses_of_a_perfect_and_of_an_action_blind_predictor(
    study: Any, recordings: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    variants, methods = study.variants, study.variants.METHODS
    groups = variants.draw_groups(recordings.groups, np.random.default_rng(1))
    assert groups.failed.tolist() == [[False, True, True, True]]
    true_latents = groups.latents[:, :, 1:]

    def losses(name: str, predicted: torch.Tensor) -> dict[str, float]:
        monkeypatch.setattr(type(groups), "predict", lambda *_: predicted)
        return {key: float(loss) for key, loss in variants.variant_losses(None, groups, methods[name]).items()}

    assert losses("contrast", true_latents) == {"variants": 0.0, "contrast": 0.0}
    blind = true_latents[:, :1].expand_as(true_latents)  # predicts the demonstration for all actions
    executed = (true_latents[:, 1:, -1] - true_latents[:, :1, -1]).abs().mean(dim=(2, 3))
    expected = variants.CONTRAST_WEIGHT * variants.MARGIN * float(executed.mean())
    assert losses("contrast", blind)["contrast"] == pytest.approx(expected, rel=1e-5)
    shift = true_latents + 0.5  # only a common error
    assert losses("action-relative error", shift)["variants"] == pytest.approx(0.5, rel=1e-4)
    common, relative = variants.split_error(blind - true_latents)
    assert losses("action-relative error", blind)["variants"] == pytest.approx(
        float((common + variants.RELATIVE_WEIGHT * relative).abs().mean()), rel=1e-5
    )


def test_common_and_relative_error_add_up(study: Any) -> None:
    error = torch.randn(3, 5, 4, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    common, relative = study.variants.split_error(error)
    assert torch.allclose(common + relative, error)
    assert torch.allclose(relative.mean(dim=1), torch.zeros(3, 4, 6, dtype=torch.float64)), "the mean over alternatives"
    total = common.square().mean() + relative.square().mean()
    assert float(total) == pytest.approx(float(error.square().mean()), rel=1e-12)
    same = torch.ones(2, 5, 4)
    assert [float(part.abs().max()) for part in study.variants.split_error(same)] == [1.0, 0.0]


def test_auroc_equals_worked_examples(study: Any) -> None:
    auroc = study.variants.compute_auroc
    assert auroc(np.array([1.0, 2.0]), np.array([3.0, 4.0, 5.0])) == 1.0
    assert auroc(np.array([3.0]), np.array([1.0, 2.0])) == 0.0
    assert auroc(np.array([2.0]), np.array([2.0, 2.0])) == 0.5
    assert auroc(np.array([1.0, 3.0]), np.array([2.0, 3.0])) == pytest.approx((1 + 1 + 0 + 0.5) / 4)
    assert np.isnan(auroc(np.array([1.0]), np.array([])))


def test_persistence_ignores_actions_and_does_not_detect_failures(
    study: Any, recordings: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    groups = recordings.groups
    monkeypatch.setattr(
        type(groups), "predict", lambda self, _: self.latents[:, :, :1].expand_as(self.latents[:, :, 1:])
    )
    measured = study.variants.measure_groups(None, groups)
    assert [measured["common_error"], measured["relative_error"], measured["auroc_same_start"]] == [1.0, 1.0, 0.5]
    monkeypatch.setattr(type(groups), "predict", lambda self, _: self.latents[:, :, 1:])
    perfect = study.variants.measure_groups(None, groups)
    assert [perfect["relative_error"], perfect["auroc"], perfect["auroc_same_start"]] == [0.0, 1.0, 1.0]


def test_cell_is_trained_and_measured(study: Any, recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variants = study.variants
    steps = {"steps": 2, "warmup_steps": 1, "decay_steps": 1}
    monkeypatch.setattr(variants, "SCHEDULE", variants.SCHEDULE.model_copy(update=steps))
    monkeypatch.setattr(variants, "PLANNING", variants.PLANNING.model_copy(update={"samples": 12, "iterations": 1}))
    monkeypatch.setattr(sys.modules["offline"], "MOVES", 2)
    result = json.loads(json.dumps(variants.measure(variants.Cell("contrast", 0), recorded, 1)))
    assert set(result["training"]) == {"forced", "rollout", "variants", "contrast"}
    assert len(result["rollout_over_persistence"]) == 10
    assert len(result["ends_cm"]) == 1
    assert all(measure.read(result) >= 0 for measure in (*study.variants_tables.MEASURES, study.variants_tables.SHARE))


def _result(method: str, seed: int, reached: int) -> dict[str, Any]:
    errors = {"common_error": 0.5, "relative_error": 0.5, "common_share": 0.6, "action_ranking_error": 0.2}
    return {
        "cell": {"method": method, "seed": seed},
        "ends_cm": [1.0] * reached + [9.0] * (20 - reached),
        "rollout_over_persistence": [0.7] * 10,
        "auroc": 0.8,
        "auroc_same_start": 0.9,
        "auroc_by_family": defaultdict(lambda: 0.7),
        **errors,
    }


@pytest.mark.parametrize(
    ("gains", "control_gains", "kept"),
    [
        ((2, 3, 2, 3, 2), (0, 0, 0, 0, 0), True),
        ((4, -2, 3, 0, 1), (0, 0, 0, 0, 0), False),  # the interval includes 0
        ((2, 3, 2, 3, 2), (2, 3, 2, 3, 2), False),  # the control explains the gain
        ((-2, -3, -2, -3, -2), (-4, -6, -4, -6, -4), False),
        ((2, 3, 2, 3), (0, 0, 0, 0), None),  # a seed is missing
    ],
)
def test_method_is_kept_only_if_it_gains_beyond_its_interval(
    study: Any, gains: tuple[int, ...], control_gains: tuple[int, ...], kept: bool | None
) -> None:
    tables, variants = study.variants_tables, study.variants
    reached = {"contrast": gains, "failing variants as data": control_gains}
    results = [
        _result(name, seed, 10 + reached.get(name, (0,) * 5)[seed])
        for name in (variants.BASE, *variants.METHODS)
        for seed in range(len(gains))
    ]
    methods = tables.group_by_method(results)
    assert tables.is_kept(methods, "contrast") is kept
    row = next(line for line in tables.decision_table(methods).splitlines() if line.startswith("| contrast |"))
    assert row.endswith({True: "| yes |", False: "| no |", None: "| undecided |"}[kept])


def test_tables_have_the_interval_of_students_t(study: Any, tmp_path: Path) -> None:
    tables, variants = study.variants_tables, study.variants
    results = [
        _result(name, seed, 10 + (seed if name == "contrast" else 0))
        for name in (variants.BASE, *variants.METHODS)
        for seed in range(5)
    ]
    methods = tables.group_by_method(results)
    difference = tables.estimate_difference(methods, tables.SUCCESS, "contrast", variants.BASELINE)
    half = 2.776445 * 5 * np.std(np.arange(5), ddof=1) / np.sqrt(5)  # t(0.975; 4); one goal is 5 points
    assert [difference.value, difference.low, difference.high] == pytest.approx([10.0, 10 - half, 10 + half], rel=1e-5)
    tables.write_tables(results, tmp_path / "variants.md", tmp_path)
    text = (tmp_path / "variants.md").read_text()
    assert "| contrast | success rate, % | +10.0 | +0.2 to +19.8 | yes |" in text
    assert "| contrast | +10.0 points | +0.2 to +19.8 | failing variants as data | yes |" in text
    assert tables.group_by_method(results[:-1])[variants.BASE].keys() == {0, 1, 2, 3}, "incomplete seeds are left out"
