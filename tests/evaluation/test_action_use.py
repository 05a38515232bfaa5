"""The true action among others: ranks are counted, ties are shared, an energy that is known is lowest there."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.action_use import (
    RolloutStart,
    draw_alternatives,
    evaluate_actions,
    measure_landscapes,
    rank_actions,
    rollout_start,
    select_moves,
)
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import ActionRanking, Landscapes, rank_difference
from vjepa2_ac.spaces import POSE_CHANGE, ActionSpace, make_vector_actions
from worlds import DIM, Copier, Halfway, Oracle, clips_batch, moved

CLIPS, REACH, FEW, SAMPLES = 12, 0.075, 8, 40


def line(step_m: float = 0.01, times: int = 6) -> LatentBatch:
    """Return clips of a robot that only ever moves to the front, by the same distance a step."""
    actions = torch.zeros(CLIPS, times - 1, 7)
    actions[:, :, 0] = step_m
    return walked(actions)


def walked(actions: Tensor) -> LatentBatch:
    """Return clips of these actions, with states that agree with them."""
    batch = clips_batch(CLIPS)
    states = torch.cat([torch.zeros(CLIPS, 1, 7), actions.cumsum(dim=1)], dim=1)
    first = batch.latents[:, :1]
    latents = torch.cat([first, moved(first.expand(-1, actions.shape[1], -1, -1), actions.cumsum(dim=1))], dim=1)
    return replace(batch, latents=latents, states=states, actions=actions)


def moves(batch: LatentBatch, space: ActionSpace = POSE_CHANGE, reach: float = REACH) -> list[RolloutStart]:
    return [move for clip in range(CLIPS) for move in select_moves(batch, clip, space, reach)]


def ranked(model: Predictor, batch: LatentBatch, samples: int = 40) -> ActionRanking:
    probes = ProbeOptions(samples=samples, at_once=16)
    return rank_actions(model, moves(batch), POSE_CHANGE, probes, seed=0)


def drawn_for(
    move: RolloutStart, moves: list[RolloutStart], space: ActionSpace, samples: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the alternatives in the box, and those on the shell."""
    largest = np.abs([one.true for one in moves]).max(axis=0)
    drawn = draw_alternatives(move.true, largest, space, ProbeOptions(samples=samples), generator)
    return drawn[:samples], drawn[samples:]


def test_moves_are_the_longest_within_reach_in_both_directions() -> None:
    there, back = moves(line(times=10))[:2]
    assert float(there.action[0]) == pytest.approx(0.07), "7 of its 9 steps: 8 are beyond 7.5 cm"
    assert torch.equal(there.action, -back.action)
    assert torch.equal(there.frame, back.following)
    assert torch.equal(there.following, back.frame)
    assert float(back.state[0] - there.state[0]) == pytest.approx(0.07)
    assert there.episode_id == back.episode_id


def test_recorded_commands_are_used_unchanged_as_moves() -> None:
    batch = line()
    batch.actions[:, 2] *= 3
    found = moves(batch, make_vector_actions(7, "target"))
    assert len(found) == CLIPS
    assert all(torch.equal(one.action, batch.actions[clip, 2]) for clip, one in enumerate(found))


def test_perfect_predictor_ranks_the_true_action_first() -> None:
    found = ranked(Oracle(), walked(0.02 * torch.randn(CLIPS, 4, 7, generator=torch.Generator().manual_seed(0))))
    assert (found.rank.value, found.box.value, found.shell.value) == (0.0, 0.0, 0.0)
    assert found.spread.value > 0.1
    assert len(found.ranks) == 2 * CLIPS


def test_predictor_that_ignores_actions_ranks_at_chance_with_zero_spread() -> None:
    found = ranked(Copier(), line())
    assert set(found.ranks) == {0.5}
    assert found.spread.value == 0.0


class _Taught(Oracle):
    """Knows what it was taught, steps to the front of 1 cm, and takes every action for one that is as short."""

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        return super().predict(latents, actions.clamp(0.0, 0.01), states, extrinsics)


def test_predictor_for_short_forward_steps_only_has_a_ranking_error() -> None:
    """The trap: on the steps of the data the model is perfect, and a planner has nothing to go by beyond them."""
    batch = line()
    own_steps = batch.latents[:, :-1], batch.actions, batch.states
    assert torch.equal(_Taught().predict(*own_steps), Oracle().predict(*own_steps))
    taught, oracle = ranked(_Taught(), batch), ranked(Oracle(), batch)
    assert oracle.rank.value == 0.0
    assert taught.rank.low > 0.03
    assert taught.spread.value < 0.5 * oracle.spread.value
    worse = rank_difference(taught, oracle)
    assert worse.low > 0.0
    assert rank_difference(oracle, taught).value == pytest.approx(-worse.value)


class _Broken(Oracle):
    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        return torch.nan * super().predict(latents, actions, states, extrinsics)


def test_non_finite_predictions_rank_last() -> None:
    assert ranked(_Broken(), walked(torch.full((CLIPS, 4, 7), 0.01))).rank.value == 1.0


class _Length(Oracle):
    """Sees how far an action goes, and believes that it goes to the front."""

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        seen = torch.zeros_like(actions)
        seen[..., 0] = actions[..., :3].norm(dim=-1)
        return super().predict(latents, seen, states, extrinsics)


def test_shell_alternatives_measure_sensitivity_to_direction() -> None:
    found = ranked(_Length(), line(), samples=200)
    assert found.shell.value == pytest.approx(0.5, abs=0.1), "all of one length are alike"
    assert found.box.value < 0.5


def test_shell_alternatives_have_the_true_length_and_all_directions() -> None:
    (move, _), samples = moves(line(times=10))[:2], 4000
    _, drawn = drawn_for(move, [move], POSE_CHANGE, samples, np.random.default_rng(0))
    assert np.linalg.norm(drawn[:, :3], axis=1) == pytest.approx(np.full(samples, 0.07))
    assert np.abs(drawn[:, :3].mean(axis=0)).max() < 0.005
    assert np.array_equal(drawn[:, 3:], np.zeros((samples, 4)))
    still = replace(move, action=torch.zeros(7))
    assert not drawn_for(still, [move], POSE_CHANGE, samples, np.random.default_rng(0))[1].any()


def test_vector_components_are_scaled_by_their_largest_change() -> None:
    space = make_vector_actions(3, "change")
    move = replace(moves(line())[0], action=torch.tensor([0.1, 0.0, 0.0]))
    others = replace(move, action=torch.tensor([0.0, 5.0, 0.0]))
    _, drawn = drawn_for(move, [move, others], space, 500, np.random.default_rng(0))
    assert np.linalg.norm(drawn[:, :2] / [0.1, 5.0], axis=1) == pytest.approx(np.ones(500))
    assert not drawn[:, 2].any(), "what never changes is not changed"


def test_alternatives_of_a_move_do_not_depend_on_other_moves() -> None:
    batch = walked(0.02 * torch.randn(CLIPS, 4, 7, generator=torch.Generator().manual_seed(0)))
    begun = moves(batch)
    probes = ProbeOptions(samples=20, at_once=7)
    whole, last = (rank_actions(Halfway(), some, POSE_CHANGE, probes, seed=3) for some in (begun, begun[-2:]))
    assert np.array_equal(whole.ranks[-2:], last.ranks)


# ---- energies --------------------------------------------------------------------------------------------------------


def starts(step: int = 0) -> list[RolloutStart]:
    batch = clips_batch(FEW)
    return [rollout_start(batch, clip, step) for clip in range(FEW)]


def test_energy_and_change_equal_analytic_distances() -> None:
    start = starts()[0]
    true = start.action.double().numpy()
    other = true + np.array([0.03, 0, 0, 0, 0, 0, 0])
    for found in evaluate_actions(Oracle(), start, np.stack([true, other]), at_once=1):
        assert found == pytest.approx([0.0, 3.0 / DIM], abs=1e-5), "3 cm in one of the numbers"
    energy, change = evaluate_actions(Halfway(), start, np.stack([2 * true, other]), at_once=7)
    assert energy[0] == pytest.approx(0.0, abs=1e-5)
    assert change[1] == pytest.approx(1.5 / DIM, abs=1e-5)


def test_ranks_and_change_equal_manual_computation() -> None:
    """A model that predicts a third of an action's effect ranks larger actions first: as many as are drawn there."""

    class Third(Oracle):
        def predict(self, latents, actions, states, extrinsics=None):  # type: ignore[no-untyped-def]
            return super().predict(latents, actions / 3, states, extrinsics)

    begun, probes = starts(), ProbeOptions(samples=SAMPLES, at_once=16)
    found = rank_actions(Third(), begun, POSE_CHANGE, probes, seed=4)
    changes, persistence = [], []
    for number, start in enumerate(begun):
        errors = []
        for drawn in drawn_for(start, begun, POSE_CHANGE, SAMPLES, start.generator(4)):
            true = start.action[:DIM].double().numpy()
            energies = np.abs(drawn[:, :DIM] / 3 - true).mean(axis=1)
            errors.append((energies < np.abs(true / 3 - true).mean()).mean())
            changes.append(np.abs(drawn[:, :DIM] / 3 - true / 3).mean() * 100)
        persistence.append(start.persistence)
        assert found.ranks[number] == pytest.approx(np.mean(errors))
    assert found.change.value == pytest.approx(np.mean(changes[::2]) / np.mean(persistence), rel=1e-4), "in the box"
    assert (found.samples, found.episode_ids) == (SAMPLES, tuple(start.episode_id for start in begun))


def test_box_alternatives_change_only_the_position() -> None:
    begun = starts()
    start = begun[0]
    boxed, _ = drawn_for(start, begun, POSE_CHANGE, 500, np.random.default_rng(0))
    assert np.array_equal(boxed[:, 3:], np.tile(start.action[3:].double().numpy(), (500, 1)))
    assert 0.07 < np.abs(boxed[:, :3]).max() <= 0.075
    assert abs(boxed[:, :3].mean()) < 0.005
    drawn, _ = drawn_for(start, begun, make_vector_actions(7, "change"), 500, np.random.default_rng(0))
    assert (np.abs(drawn).max(axis=0) <= np.abs([one.true for one in begun]).max(axis=0)).all()
    assert np.abs(drawn[:, 3:]).max() > 0.05


def landscapes(model: Predictor, nodes: int = 7) -> Landscapes:
    return measure_landscapes(model, starts(1), POSE_CHANGE, ProbeOptions(nodes=nodes, at_once=50))


def test_the_minimum_of_an_analytic_energy_is_at_the_true_action() -> None:
    found = landscapes(Oracle())
    assert (found.unit, found.axis_names) == ("cm", ("dx", "dy", "dz"))
    for one, start in zip(found.maps, starts(1), strict=True):
        np.testing.assert_allclose(one.true, start.action[:3] * 100, rtol=1e-5)
        np.testing.assert_allclose(one.minimum, one.true, rtol=1e-6)
        assert one.energy.min() == pytest.approx(0.0, abs=1e-4)
        assert one.distance == 0.0
    assert found.mean("distance").value == 0.0
    assert found.chance_distance > 5.0


def test_energy_at_a_grid_point_equals_the_energy_of_its_action() -> None:
    one = landscapes(Oracle()).maps[0]
    i, j, k = 2, 5, 1
    tried = np.array([one.axes[0, i], one.axes[1, j], one.axes[2, k]])
    assert one.energy[i, j, k] == pytest.approx(np.abs(tried - one.true).sum() / 6, rel=1e-4), "3 of 6 numbers differ"


def test_the_landscape_of_a_model_that_ignores_actions_is_flat() -> None:
    found = landscapes(Copier())
    assert found.mean("distance").value > 1.0
    assert found.mean("sharpness").value == pytest.approx(0.0, abs=1e-6)
