"""Ranks are counted, ties are shared, and samples come from the stated distribution."""

import numpy as np
import pytest
import torch

from vjepa2_ac.evaluation.action_use import ActionPool, evaluate_actions, measure_sensitivity, start_of
from vjepa2_ac.spaces import POSE_CHANGE, ActionSpace, vector_actions
from worlds import DIM, TIME, Copier, Halfway, Oracle, clips_batch

CLIPS, SAMPLES = 8, 40


def starts(**changes: object) -> list:
    batch = clips_batch(CLIPS, **changes)  # type: ignore[arg-type]
    return [start_of(batch, clip, 0, clip) for clip in range(CLIPS)]


def pool(
    *, space: ActionSpace = POSE_CHANGE, reach: float = 0.075, samples: int = SAMPLES, seed: int = 0
) -> ActionPool:
    batch = clips_batch(CLIPS)
    ids = tuple(name for name in batch.episode_ids for _ in range(TIME - 1))
    return ActionPool(batch.actions.flatten(0, 1).double().numpy(), ids, space, reach, samples, seed)


def test_energy_and_change_are_the_distances_of_the_world() -> None:
    start = starts()[0]
    true = start.action.double().numpy()
    other = true + np.array([0.03, 0, 0, 0, 0, 0, 0])
    tried = evaluate_actions(Oracle(), start, np.stack([true, other]), at_once=1)
    assert tried.energy == pytest.approx([0.0, 3.0 / DIM], abs=1e-5), "3 cm in one of the numbers"
    assert tried.change == pytest.approx([0.0, 3.0 / DIM], abs=1e-5)
    half = evaluate_actions(Halfway(), start, np.stack([2 * true, other]), at_once=7)
    assert half.energy[0] == pytest.approx(0.0, abs=1e-5)
    assert half.change[1] == pytest.approx(1.5 / DIM, abs=1e-5)


def test_ranks_are_counted_by_hand() -> None:
    """A model that sees the third of what an action does prefers others that are larger: as many as are drawn there."""

    class Third(Oracle):
        def predict(self, latents, actions, states, extrinsics=None):  # type: ignore[no-untyped-def]
            return super().predict(latents, actions / 3, states, extrinsics)

    begun = starts()
    found = measure_sensitivity(Third(), begun, pool(seed=4), at_once=16)
    for number, start in enumerate(begun):
        generator = start.generator(4)
        drawn = [pool().of_others(start, generator), pool().in_box(start, generator)]
        for ranking, others in zip(found.rankings, drawn, strict=True):
            true = start.action[:DIM].double().numpy()
            energies = np.abs(others[:, :DIM] / 3 - true).mean(axis=1)
            if ranking is found.rankings[0]:  # what the box holds may be nothing that a robot does
                changes = np.abs(others[:, :DIM] / 3 - true / 3).mean(axis=1) * 100
                assert found.change_by_clip[number] * start.persistence == pytest.approx(changes.mean(), rel=1e-4)
            assert ranking.rank[number] == pytest.approx((energies < np.abs(true / 3 - true).mean()).mean())
    assert found.rankings[0].samples == SAMPLES
    assert found.rankings[0].clips == tuple(range(CLIPS))


def test_equal_energies_share_their_places() -> None:
    found = measure_sensitivity(Copier(), starts(), pool(), at_once=16)
    for ranking in found.rankings:
        assert set(ranking.rank) == {0.5}
        assert ranking.top[1].value == pytest.approx(1 / (SAMPLES + 1))
        assert ranking.top[10].value == pytest.approx(10 / (SAMPLES + 1))


def test_others_are_of_other_episodes_and_the_box_moves_only_the_hand() -> None:
    start, drawing = starts()[0], pool(samples=500)
    others = drawing.of_others(start, np.random.default_rng(0))
    own = drawing.actions[np.array(drawing.episode_ids) == start.episode_id]
    assert not (others[:, None] == own[None]).all(axis=2).any()
    boxed = drawing.in_box(start, np.random.default_rng(0))
    assert np.array_equal(boxed[:, 3:], np.tile(start.action[3:].double().numpy(), (500, 1)))
    assert 0.07 < np.abs(boxed[:, :3]).max() <= 0.075
    assert abs(boxed[:, :3].mean()) < 0.005
    vectors = pool(space=vector_actions(7, "change"), samples=500).in_box(start, np.random.default_rng(0))
    assert (np.abs(vectors).max(axis=0) <= np.abs(drawing.actions).max(axis=0)).all()
    assert np.abs(vectors[:, 3:]).max() > 0.05


def test_a_start_draws_the_same_whatever_is_measured_beside_it() -> None:
    all_of_them = measure_sensitivity(Oracle(), starts(), pool(), at_once=16)
    last = measure_sensitivity(Oracle(), starts()[-1:], pool(), at_once=3)
    assert last.change_by_clip[0] == pytest.approx(all_of_them.change_by_clip[-1], rel=1e-5)


def test_the_change_is_relative_to_what_there_is_to_predict() -> None:
    begun = starts()
    found = measure_sensitivity(Oracle(), begun, pool(), at_once=16)
    changes = found.change_by_clip * np.array([start.persistence for start in begun])
    assert found.change.value == pytest.approx(changes.sum() / sum(start.persistence for start in begun))
    assert begun[0].persistence == pytest.approx(float(begun[0].action[:DIM].abs().mean()) * 100, rel=1e-4)
    assert torch.is_grad_enabled()
