"""An oracle plans the demonstrated actions; a model that ignores actions is no better than no plan."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from planned import FEW, ONE_STEP, PROBES, QUICK, planned, small_actions, starts_of_a_world
from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.evaluation import action_score as measure
from vjepa2_ac.evaluation.action_score import (
    WindowCost,
    differences_of,
    measure_plans,
    metrics_of,
    planning_start,
    study_of,
)
from vjepa2_ac.evaluation.request import SCORED
from vjepa2_ac.evaluation.result import Evaluation, PlanningStudy, Plans
from vjepa2_ac.model.state_integration import states_along
from vjepa2_ac.planning.energy import EnergyFunction
from vjepa2_ac.planning.planner import Plan, Planner
from vjepa2_ac.reports.metrics_json import metrics_as_dict
from vjepa2_ac.spaces import vector_actions
from worlds import DIM, TIME, TOKENS, Copier, Oracle, actions_of, clips_batch, in_batches, moved, rows


@pytest.fixture(scope="module")
def oracle() -> Evaluation:
    return planned(Oracle(), Copier())


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plan three steps with a tenth of the samples, where the score itself does not matter."""
    fewer = SCORED.model_copy(update={"samples": 60, "iterations": 4})
    monkeypatch.setattr(measure, "SCORED", fewer)


def parts(evaluation: Evaluation, name: str = "adapter") -> tuple[PlanningStudy, Plans]:
    study, plans = evaluation.planning, evaluation.models[name].plans
    assert study is not None
    assert plans is not None
    return study, plans


def test_a_model_that_knows_the_world_gets_the_best_score_and_no_error(oracle: Evaluation) -> None:
    found = metrics_of(*parts(oracle))
    assert 79 < found["score"].value <= 80
    assert found["missed_cm"].value < 0.12
    assert found["step_cm"].value < 0.1
    assert found["angle_degrees"].value < 3
    assert [found[f"signs.{axis}"].value for axis in "xyz"] == [1.0, 1.0, 1.0]


def test_a_model_that_ignores_actions_plans_no_better_than_nothing(oracle: Evaluation) -> None:
    study, deaf = parts(oracle, "base")
    found, nothing = metrics_of(study, deaf), metrics_of(study, study.zero)
    assert found["missed_cm"].value > nothing["missed_cm"].value
    assert found["score"].value <= nothing["score"].value
    assert differences_of(study, deaf, study.zero)["missed_cm"].side(of=0.0) >= 0
    assert 50 < found["angle_degrees"].value < 130


def test_what_was_demonstrated_scores_eighty_within_the_limits(oracle: Evaluation) -> None:
    study, _ = parts(oracle)
    assert metrics_of(study, study.within_limits)["score"].value == pytest.approx(80.0, abs=1e-4)
    assert (study.one_step_beyond, study.three_steps_beyond) == (0.0, 0.0)


@pytest.mark.usefixtures("quick")
def test_demonstrations_beyond_the_limits_are_counted_and_cut() -> None:
    actions = small_actions()
    actions[0, :, 1] = -0.13  # metres: both limits
    actions[1, :, 0] = 0.08  # those of one step
    study, _ = parts(planned(Copier(), actions=actions, probes=replace(PROBES, planning=PlanningConfig(samples=20))))
    assert study.one_step_beyond == pytest.approx(2 / 4)
    assert study.three_steps_beyond == pytest.approx(1 / 4)
    cut = metrics_of(study, study.within_limits)
    assert cut["missed_cm"].value == pytest.approx(3 * 3 / 4, abs=1e-4)
    assert cut["score"].value == pytest.approx(80 - 800 * 0.0225, abs=1e-2)
    assert cut["step_cm"].value == pytest.approx((8 + 3) / 4, abs=1e-4)


@pytest.mark.usefixtures("quick")
def test_the_same_seed_gives_the_same_plans_and_another_seed_others() -> None:
    first, again, other = (planned(Oracle(), probes=QUICK, **changes) for changes in ({}, {"size": 1}, {"seed": 1}))
    assert metrics_as_dict(again)["planning"] == metrics_as_dict(first)["planning"]
    same_frame = np.array(parts(first)[0].places) == parts(other)[0].places
    assert same_frame.any()
    for name in ("one_step", "three_steps"):
        one, same, others = (getattr(parts(found)[1], name) for found in (first, again, other))
        np.testing.assert_array_equal(one, same)
        assert (one[:, same_frame] != others[:, same_frame]).any(axis=-1).all()
        one, others = (getattr(parts(found)[0].random, name)[:, same_frame] for found in (first, other))
        assert (one != others).any(axis=-1).all()


@pytest.mark.usefixtures("quick")
def test_a_clips_plans_depend_on_neither_the_batch_nor_the_order_nor_on_the_clips_beside_it() -> None:
    batch = clips_batch(4, actions=small_actions())
    expected = measure_plans(Oracle(), starts_of_a_world(), FEW)
    for order in ([3, 2, 0], [1]):
        some = rows(batch, order)
        starts = [planning_start(part, 0, seed=0) for part in in_batches(some, 1)]
        found = measure_plans(Oracle(), starts, FEW)
        np.testing.assert_array_equal(found.one_step, expected.one_step[:, order])
        np.testing.assert_array_equal(found.three_steps, expected.three_steps[:, order])
        random = study_of(starts, ONE_STEP).random.three_steps
        np.testing.assert_array_equal(random, study_of(starts_of_a_world(), ONE_STEP).random.three_steps[:, order])


class Witness(Oracle):
    """An oracle that records its calls."""

    def __init__(self) -> None:
        self.asked: list[tuple[Tensor, Tensor, Tensor, Tensor | None]] = []

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return true frames, and note the question."""
        self.asked.append((latents, actions, states, extrinsics))
        return super().predict(latents, actions, states)

    def rollout(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return true frames, and note the question."""
        self.asked.append((latents, actions, states, extrinsics))
        return Oracle().rollout(latents, actions, states)


def test_the_model_sees_the_last_two_frames_with_their_actions_poses_and_camera() -> None:
    start = starts_of_a_world()[0]
    start = type(start)(**{**vars(start), "extrinsics": torch.arange(6.0)})
    model = Witness()
    tried = actions_of(5)[:, :3]
    energies = WindowCost(model, start, start.goal, EnergyConfig(distance="l2", samples_at_once=3))(tried)
    (first, predicted, _, later) = (model.asked[place] for place in range(4))
    assert [len(one[0]) for one in (first, predicted, later)] == [3, 3, 2]
    frame = start.frame.expand(3, 1, TOKENS, DIM)
    torch.testing.assert_close(first[0], frame)
    torch.testing.assert_close(first[1], tried[:3, :2])
    torch.testing.assert_close(predicted[1], tried[:3, 1:])
    one = moved(frame, tried[:3, :1])
    torch.testing.assert_close(predicted[0], torch.cat([one, moved(one, tried[:3, 1:2])], dim=1))
    poses = start.state[:3] + torch.nn.functional.pad(tried[:3, :, :3].cumsum(1), (0, 0, 1, 0))
    torch.testing.assert_close(first[2][..., :3], poses[:, :2])
    torch.testing.assert_close(predicted[2][..., :3], poses[:, 1:3])
    assert first[3] is not None
    torch.testing.assert_close(first[3], torch.arange(6.0).expand(3, 2, 6))
    reached = start.frame[None] + 100 * tried.sum(1)[:, None, :DIM]
    torch.testing.assert_close(energies, (reached - start.goal).square().mean(dim=(1, 2)), rtol=1e-4, atol=1e-4)


@pytest.mark.usefixtures("quick")
def test_one_step_is_planned_by_the_configs_settings_but_from_one_frame_and_without_a_clock() -> None:
    limits = LimitsConfig(xyz=(0.01, 0.0, 0.02))
    config = PlanningConfig(
        horizon=4, action_repeat=2, context=3, budget_s=1e-9, samples=40, iterations=8, limits=limits
    )
    model = Witness()
    plans = measure_plans(model, starts_of_a_world()[:2], config)
    assert np.abs(plans.one_step[..., 0]).max() == pytest.approx(0.01, rel=1e-2)
    assert not plans.one_step[..., [1, 3, 4, 5]].any()
    assert np.abs(plans.three_steps[..., 1]).max() > 0.015, "the score's limits are its own"
    one_step = [asked for asked in model.asked if asked[1].shape[1] == 1]
    assert sum(len(asked[0]) for asked in one_step) == 2 * (8 * 40 + 1)


def test_three_steps_keep_to_the_protocol_whatever_the_config_says(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[PlanningConfig, EnergyConfig]] = []

    class Noted(Planner):
        def plan(self, cost: WindowCost, *more: object) -> Plan:  # type: ignore[override]
            asked.append((self.config, EnergyFunction.of(cost.energy).config))
            return Planner(self.config.model_copy(update={"iterations": 1, "samples": 10})).plan(cost, *more)  # type: ignore[arg-type]

    monkeypatch.setattr(measure, "Planner", Noted)
    config = PlanningConfig(planner="icem", energy=EnergyConfig(distance="cosine", steps="sum", samples_at_once=5))
    measure_plans(Oracle(), starts_of_a_world()[:1], config)
    (one, near), (scored, far) = asked
    assert (one.planner, near) == ("icem", config.energy)
    assert scored.model_copy(update={"energy": SCORED.energy}) == SCORED
    assert far == SCORED.energy.model_copy(update={"samples_at_once": 5})


def test_poses_stay_exact_where_the_model_computes_in_bfloat16() -> None:
    start = starts_of_a_world()[0]
    start = type(start)(**{**vars(start), "state": torch.tensor([0.4, 0.1, 0.3, 3.1, 0.05, -0.4, 0.2])})
    tried = actions_of(4)[:, :3]
    expected = states_along(start.state, tried)[:, :2]
    model = Witness()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        WindowCost(model, start, start.goal, EnergyConfig())(tried)
    assert torch.equal(model.asked[0][2], expected)


def test_planning_begins_anywhere_in_a_clip_and_aims_three_steps_on() -> None:
    batch = clips_batch(24)
    starts = [planning_start(batch, row, seed=3) for row in range(24)]
    assert {start.place for start in starts} == set(range(TIME - 3))
    for row, start in enumerate(starts):
        frames = batch.latents[row, start.place :]
        for found, expected in zip((start.frame, start.following, start.goal), frames[[0, 1, 3]], strict=True):
            assert torch.equal(found, expected)
        np.testing.assert_array_equal(start.demonstrated, batch.actions[row, start.place : start.place + 3].numpy())


def test_random_plans_are_uniform_within_the_limits() -> None:
    drawn = study_of(starts_of_a_world(), ONE_STEP).random
    limits = torch.tensor([0.1] * 6 + [0.75]).numpy()
    for values, most in ((drawn.three_steps, limits), (drawn.one_step, limits * [0.5, 0.5, 0.5, 1, 1, 1, 1])):
        assert (np.abs(values) <= most).all()
        flat = (values / most).reshape(-1, 7)
        np.testing.assert_allclose(flat.mean(axis=0), 0.0, atol=0.15)
        np.testing.assert_allclose(flat.std(axis=0), 1 / np.sqrt(3), atol=0.06)


@pytest.mark.usefixtures("quick")
def test_plans_without_a_finite_energy_do_nothing_and_are_counted() -> None:
    class Broken(Oracle):
        def rollout(self, *question: Tensor | None) -> Tensor:  # type: ignore[override]
            return super().rollout(*question) * torch.nan  # type: ignore[arg-type]

    plans = measure_plans(Broken(), starts_of_a_world()[:2], FEW)
    assert plans.empty == 4
    assert not plans.one_step.any()
    assert not plans.three_steps.any()


def test_there_are_no_plans_of_vectors_and_the_reason_is_given() -> None:
    found = planned(Copier(), space=vector_actions(7, "change"))
    assert found.planning is None
    assert found.models["adapter"].plans is None
    assert any("No plans" in note for note in found.notes)
