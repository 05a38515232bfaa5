"""The energy of a known world is lowest at the true action; a flat one has no direction."""

import numpy as np
import pytest
from torch import Tensor

from vjepa2_ac.evaluation.action_use import RolloutStart, grid_axes, measure_landscapes, start_of
from vjepa2_ac.evaluation.result import Landscapes
from vjepa2_ac.spaces import POSE_CHANGE
from worlds import Copier, Oracle, clips_batch

CLIPS = 6


def starts(**changes: object) -> list[RolloutStart]:
    batch = clips_batch(CLIPS, **changes)  # type: ignore[arg-type]
    return [start_of(batch, clip, 1, clip) for clip in range(CLIPS)]


def landscapes(model: object, **changes: object) -> Landscapes:
    grid: dict[str, object] = {"nodes": 7, "reach": 0.075} | changes
    return measure_landscapes(model, starts(), POSE_CHANGE, at_once=50, **grid)  # type: ignore[arg-type]


def test_the_minimum_of_an_analytic_energy_is_at_the_true_action() -> None:
    found = landscapes(Oracle())
    assert (found.unit, found.axis_names) == ("cm", ("dx", "dy", "dz"))
    for one, start in zip(found.maps, starts(), strict=True):
        np.testing.assert_allclose(one.true, start.action[:3] * 100, rtol=1e-5)
        np.testing.assert_allclose(one.minimum, one.true, rtol=1e-6)
        assert one.energy.min() == pytest.approx(0.0, abs=1e-4)
        assert one.distance == 0.0
    assert found.distance.value == 0.0
    assert found.chance_distance > 5.0
    assert all(agreement.value == 1.0 for agreement, n in zip(found.sign_agreement, found.sign_clips, strict=True) if n)


def test_the_energy_at_a_node_is_that_of_its_action() -> None:
    one = landscapes(Oracle()).maps[0]
    i, j, k = 2, 5, 1
    tried = np.array([one.axes[0, i], one.axes[1, j], one.axes[2, k]])
    assert one.energy[i, j, k] == pytest.approx(np.abs(tried - one.true).sum() / 6, rel=1e-4), "3 of 6 numbers differ"


def test_a_mirrored_model_has_no_sign_right() -> None:
    class Mirrored(Oracle):
        def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
            return super().predict(latents, -actions, states, extrinsics)

    found = landscapes(Mirrored(), nodes=21)
    assert all(agreement.value == 0.0 for agreement, n in zip(found.sign_agreement, found.sign_clips, strict=True) if n)
    assert found.distance.value > 3.0


def test_a_model_that_ignores_actions_agrees_as_often_as_chance_and_is_as_far_as_the_middle() -> None:
    found = landscapes(Copier())
    for agreement, chance, clips in zip(found.sign_agreement, found.sign_chance, found.sign_clips, strict=True):
        if clips:
            assert agreement.value == pytest.approx(chance)
            assert 0.35 < chance < 0.65
    assert found.distance.value > 1.0


@pytest.mark.parametrize("true", [[0.0, 0.07, -0.07], [0.031, -0.002, 0.05]])
def test_the_true_action_is_a_node_and_the_grid_spans_zero_whatever_it_is(true: list[float]) -> None:
    axes = grid_axes(np.array(true), 0.075, 9)
    assert axes.shape == (3, 9)
    for value, axis in zip(true, axes, strict=True):
        assert value in axis
        np.testing.assert_allclose(np.diff(axis), 0.15 / 8)
        assert abs(axis[0] + axis[-1]) / 2 <= 0.15 / 16 + 1e-12, "centred on zero to half a node"


def test_clips_that_hardly_move_along_an_axis_have_no_sign_to_agree_with() -> None:
    batch = clips_batch(CLIPS)
    actions = batch.actions.clone()
    actions[..., 2] = 0.0
    still = clips_batch(CLIPS, actions=actions)
    begun = [start_of(still, clip, 0, clip) for clip in range(CLIPS)]
    found = measure_landscapes(Oracle(), begun, POSE_CHANGE, nodes=5, reach=0.075, at_once=99)
    assert found.sign_clips[2] == 0
    assert np.isnan(found.sign_agreement[2].value)
