"""Action ranking and energy landscapes equal values that are computed by hand for predictors with known errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.action_use import (
    Transition,
    draw_alternatives,
    evaluate_actions,
    make_transition,
    measure_landscapes,
    rank_actions,
    select_moves,
)
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.result import ActionRanking, Landscapes, rank_difference
from vjepa2_ac.spaces import POSE_CHANGE, ActionSpace, make_vector_actions
from worlds import DIM, Copier, Halfway, Oracle, clips_batch, moved

CLIPS, MAX_LENGTH_M, FEW, SAMPLES = 12, 0.075, 8, 40


def forward_clips(step_m: float = 0.01, times: int = 6) -> LatentBatch:
    """Return clips of a robot that moves forwards by the same distance in each step."""
    actions = torch.zeros(CLIPS, times - 1, 7)
    actions[:, :, 0] = step_m
    return clips_of(actions)


def clips_of(actions: Tensor) -> LatentBatch:
    """Return clips of a robot that executes these actions, with the resulting states and frames."""
    batch = clips_batch(CLIPS)
    states = torch.cat([torch.zeros(CLIPS, 1, 7), actions.cumsum(dim=1)], dim=1)
    first = batch.latents[:, :1]
    latents = torch.cat([first, moved(first.expand(-1, actions.shape[1], -1, -1), actions.cumsum(dim=1))], dim=1)
    return replace(batch, latents=latents, states=states, actions=actions)


def moves_of(batch: LatentBatch, space: ActionSpace = POSE_CHANGE) -> list[Transition]:
    return [move for clip in range(CLIPS) for move in select_moves(batch, clip, space, MAX_LENGTH_M)]


def rank(model: Predictor, batch: LatentBatch, samples: int = 40) -> ActionRanking:
    probes = ProbeOptions(samples=samples, at_once=16)
    return rank_actions(model, moves_of(batch), POSE_CHANGE, probes, seed=0)


def alternatives_to(
    move: Transition, moves: list[Transition], space: ActionSpace, samples: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the alternatives from the box, and those from the shell."""
    largest = np.abs([candidate.true_action for candidate in moves]).max(axis=0)
    actions = draw_alternatives(move.true_action, largest, space, ProbeOptions(samples=samples), generator)
    return actions[:samples], actions[samples:]


def test_longest_moves_up_to_the_maximum_length_are_selected_in_both_directions() -> None:
    forwards, backwards = moves_of(forward_clips(times=10))[:2]
    assert float(forwards.action[0]) == pytest.approx(0.07), "7 steps of 1 cm; 8 steps exceed 7.5 cm"
    assert torch.equal(forwards.action, -backwards.action)
    assert torch.equal(forwards.frame, backwards.next_frame)
    assert torch.equal(forwards.next_frame, backwards.frame)
    assert float(backwards.state[0] - forwards.state[0]) == pytest.approx(0.07)
    assert forwards.episode_id == backwards.episode_id


def test_recorded_commands_are_used_unchanged_as_moves() -> None:
    batch = forward_clips()
    batch.actions[:, 2] *= 3
    moves = moves_of(batch, make_vector_actions(7, "target"))
    assert len(moves) == CLIPS
    assert all(torch.equal(move.action, batch.actions[clip, 2]) for clip, move in enumerate(moves))


def test_perfect_predictor_ranks_the_true_action_first() -> None:
    batch = clips_of(0.02 * torch.randn(CLIPS, 4, 7, generator=torch.Generator().manual_seed(0)))
    ranking = rank(Oracle(), batch)
    assert (ranking.rank.value, ranking.box.value, ranking.shell.value) == (0.0, 0.0, 0.0)
    assert ranking.spread.value > 0.1
    assert len(ranking.ranks) == 2 * CLIPS


def test_predictor_that_ignores_actions_ranks_at_chance_with_zero_spread() -> None:
    ranking = rank(Copier(), forward_clips())
    assert set(ranking.ranks) == {0.5}
    assert ranking.spread.value == 0.0


class _ShortForwardSteps(Oracle):
    """A predictor that is exact for forward steps of at most 1 cm, and limits all other actions to such steps."""

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        return super().predict(latents, actions.clamp(0.0, 0.01), states, extrinsics)


def test_predictor_for_short_forward_steps_only_has_a_ranking_error() -> None:
    """A model can have no error on the steps of the data although it cannot distinguish other actions."""
    batch = forward_clips()
    steps = batch.latents[:, :-1], batch.actions, batch.states
    assert torch.equal(_ShortForwardSteps().predict(*steps), Oracle().predict(*steps))
    limited, oracle = rank(_ShortForwardSteps(), batch), rank(Oracle(), batch)
    assert oracle.rank.value == 0.0
    assert limited.rank.low > 0.03
    assert limited.spread.value < 0.5 * oracle.spread.value
    difference = rank_difference(limited, oracle)
    assert difference.low > 0.0
    assert rank_difference(oracle, limited).value == pytest.approx(-difference.value)


class _Broken(Oracle):
    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        return torch.nan * super().predict(latents, actions, states, extrinsics)


def test_non_finite_predictions_rank_last() -> None:
    assert rank(_Broken(), clips_of(torch.full((CLIPS, 4, 7), 0.01))).rank.value == 1.0


class _LengthOnly(Oracle):
    """A predictor that uses the length of an action, and always predicts forward motion."""

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        forwards = torch.zeros_like(actions)
        forwards[..., 0] = actions[..., :3].norm(dim=-1)
        return super().predict(latents, forwards, states, extrinsics)


def test_shell_alternatives_measure_sensitivity_to_direction() -> None:
    ranking = rank(_LengthOnly(), forward_clips(), samples=200)
    assert ranking.shell.value == pytest.approx(0.5, abs=0.1), "actions of equal length have equal energies"
    assert ranking.box.value < 0.5


def test_shell_alternatives_have_the_true_length_and_all_directions() -> None:
    (move, _), samples = moves_of(forward_clips(times=10))[:2], 4000
    _, shell = alternatives_to(move, [move], POSE_CHANGE, samples, np.random.default_rng(0))
    assert np.linalg.norm(shell[:, :3], axis=1) == pytest.approx(np.full(samples, 0.07))
    assert np.abs(shell[:, :3].mean(axis=0)).max() < 0.005
    assert np.array_equal(shell[:, 3:], np.zeros((samples, 4)))
    zero_move = replace(move, action=torch.zeros(7))
    assert not alternatives_to(zero_move, [move], POSE_CHANGE, samples, np.random.default_rng(0))[1].any()


def test_vector_components_are_scaled_by_their_largest_change() -> None:
    space = make_vector_actions(3, "change")
    move = replace(moves_of(forward_clips())[0], action=torch.tensor([0.1, 0.0, 0.0]))
    other = replace(move, action=torch.tensor([0.0, 5.0, 0.0]))
    _, shell = alternatives_to(move, [move, other], space, 500, np.random.default_rng(0))
    assert np.linalg.norm(shell[:, :2] / [0.1, 5.0], axis=1) == pytest.approx(np.ones(500))
    assert not shell[:, 2].any(), "a component that is zero in all moves stays zero"


def test_alternatives_of_a_move_do_not_depend_on_other_moves() -> None:
    batch = clips_of(0.02 * torch.randn(CLIPS, 4, 7, generator=torch.Generator().manual_seed(0)))
    moves = moves_of(batch)
    probes = ProbeOptions(samples=20, at_once=7)
    all_ranks, last_ranks = (
        rank_actions(Halfway(), subset, POSE_CHANGE, probes, seed=3) for subset in (moves, moves[-2:])
    )
    assert np.array_equal(all_ranks.ranks[-2:], last_ranks.ranks)


# ---- energies ----


def transitions(step: int = 0) -> list[Transition]:
    batch = clips_batch(FEW)
    return [make_transition(batch, clip, step) for clip in range(FEW)]


def test_energy_and_change_equal_analytic_distances() -> None:
    transition = transitions()[0]
    true = transition.action.double().numpy()
    other = true + np.array([0.03, 0, 0, 0, 0, 0, 0])
    for distances in evaluate_actions(Oracle(), transition, np.stack([true, other]), at_once=1):
        assert distances == pytest.approx([0.0, 3.0 / DIM], abs=1e-5), "3 cm in one of the numbers"
    energy, change = evaluate_actions(Halfway(), transition, np.stack([2 * true, other]), at_once=7)
    assert energy[0] == pytest.approx(0.0, abs=1e-5)
    assert change[1] == pytest.approx(1.5 / DIM, abs=1e-5)


def test_ranks_and_change_equal_manual_computation() -> None:
    """A model that predicts a third of an action's effect has lower energies for actions that are larger."""

    class Third(Oracle):
        def predict(self, latents, actions, states, extrinsics=None):  # type: ignore[no-untyped-def]
            return super().predict(latents, actions / 3, states, extrinsics)

    moves, probes = transitions(), ProbeOptions(samples=SAMPLES, at_once=16)
    ranking = rank_actions(Third(), moves, POSE_CHANGE, probes, seed=4)
    changes, persistence = [], []
    for number, move in enumerate(moves):
        errors = []
        for actions in alternatives_to(move, moves, POSE_CHANGE, SAMPLES, move.make_generator(4)):
            true = move.action[:DIM].double().numpy()
            energies = np.abs(actions[:, :DIM] / 3 - true).mean(axis=1)
            errors.append((energies < np.abs(true / 3 - true).mean()).mean())
            changes.append(np.abs(actions[:, :DIM] / 3 - true / 3).mean() * 100)
        persistence.append(move.persistence)
        assert ranking.ranks[number] == pytest.approx(np.mean(errors))
    assert ranking.change.value == pytest.approx(np.mean(changes[::2]) / np.mean(persistence), rel=1e-4), "in the box"
    assert (ranking.samples, ranking.episode_ids) == (SAMPLES, tuple(move.episode_id for move in moves))


def test_box_alternatives_change_the_position_of_poses_and_all_components_of_vectors() -> None:
    moves = transitions()
    box, _ = alternatives_to(moves[0], moves, POSE_CHANGE, 500, np.random.default_rng(0))
    assert np.array_equal(box[:, 3:], np.tile(moves[0].action[3:].double().numpy(), (500, 1)))
    assert 0.07 < np.abs(box[:, :3]).max() <= 0.075
    assert abs(box[:, :3].mean()) < 0.005
    box, _ = alternatives_to(moves[0], moves, make_vector_actions(7, "change"), 500, np.random.default_rng(0))
    assert (np.abs(box).max(axis=0) <= np.abs([candidate.true_action for candidate in moves]).max(axis=0)).all()
    assert np.abs(box[:, 3:]).max() > 0.05


def landscapes(model: Predictor, nodes: int = 7) -> Landscapes:
    return measure_landscapes(model, transitions(1), POSE_CHANGE, ProbeOptions(nodes=nodes, at_once=50))


def test_the_minimum_of_an_analytic_energy_is_at_the_true_action() -> None:
    measured = landscapes(Oracle())
    assert (measured.unit, measured.axis_names) == ("cm", ("dx", "dy", "dz"))
    for landscape, transition in zip(measured.maps, transitions(1), strict=True):
        np.testing.assert_allclose(landscape.true, transition.action[:3] * 100, rtol=1e-5)
        np.testing.assert_allclose(landscape.minimum, landscape.true, rtol=1e-6)
        assert landscape.energy.min() == pytest.approx(0.0, abs=1e-4)
        assert landscape.distance == 0.0
    assert measured.mean("distance").value == 0.0
    assert measured.chance_distance > 5.0


def test_energy_at_a_grid_point_equals_the_energy_of_its_action() -> None:
    landscape = landscapes(Oracle()).maps[0]
    i, j, k = 2, 5, 1
    action = np.array([landscape.axes[0, i], landscape.axes[1, j], landscape.axes[2, k]])
    energy = np.abs(action - landscape.true).sum() / 6  # 3 of 6 numbers differ
    assert landscape.energy[i, j, k] == pytest.approx(energy, rel=1e-4)


def test_the_landscape_of_a_model_that_ignores_actions_is_flat() -> None:
    measured = landscapes(Copier())
    assert measured.mean("distance").value > 1.0
    assert measured.mean("sharpness").value == pytest.approx(0.0, abs=1e-6)
