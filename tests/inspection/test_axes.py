"""Axis calibration recovers the angle of a rotated oracle, and reports a problem if a model ignores actions."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from vjepa2_ac.evaluation.action_use import Transition, make_transition
from vjepa2_ac.inspection.axes import AxisFit, infer_axes
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.planning.energy import AxesRotation
from worlds import TIME, Copier, Oracle, clips_batch

CLIPS = 16


class RotatedOracle(Oracle):
    """An oracle whose axes are rotated, and optionally scaled or mirrored, relative to those of the robot."""

    def __init__(self, degrees: float, gain: float = 1.0, *, mirrored: bool = False) -> None:
        self.back, self.gain, self.side = AxesRotation(-np.deg2rad(degrees)), gain, -1.0 if mirrored else 1.0

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        back = self.back.rotate_actions(actions) / torch.tensor([self.gain, self.side * self.gain, 1, 1, 1, 1, 1])
        return super().predict(latents, back, states, extrinsics)


def make_transitions(**changes: object) -> list[Transition]:
    batch = clips_batch(CLIPS, **changes)  # type: ignore[arg-type]
    return [make_transition(batch, clip, 1) for clip in range(CLIPS)]


def fitted(model: object, **changes: object) -> AxisFit:
    return infer_axes(model, make_transitions(**changes), at_once=64)  # type: ignore[arg-type]


@functools.cache
def fit_to_rotated_oracle(degrees: float) -> AxisFit:
    return fitted(RotatedOracle(degrees))


@pytest.mark.parametrize("degrees", [0.0, -60.0, 179.9])
def test_angle_of_a_rotated_oracle_is_recovered_within_half_a_degree(degrees: float) -> None:
    fit = fit_to_rotated_oracle(degrees)
    yaw = fit.yaw_degrees
    assert yaw.value == pytest.approx(degrees, abs=0.5)
    assert yaw.low <= yaw.value <= yaw.high < yaw.low + 3
    assert fit.error.value == (1.0 if degrees == 0.0 else pytest.approx(0.0, abs=0.02))
    assert fit.problem is None
    assert (fit.pairs, fit.episodes) == (CLIPS, CLIPS // 2)


def test_axes_of_a_model_that_ignores_actions_are_a_problem() -> None:
    assert (fitted(Copier()).problem or "").startswith("no significant improvement")


def test_insignificant_or_uncertain_angle_is_a_problem() -> None:
    fit = fit_to_rotated_oracle(-60.0)
    insignificant = replace(fit, error=Estimate(0.98, 0.95, 1.01))
    assert (insignificant.problem or "").startswith("no significant improvement")
    uncertain = replace(fit, yaw_degrees=Estimate(-60.0, -80.0, -30.0))
    assert (uncertain.problem or "").startswith("uncertain: yaw -60 degrees, 95 % interval -80 to -30")


def test_mirrored_axes_or_a_single_episode_are_a_problem() -> None:
    assert fitted(RotatedOracle(0.0, mirrored=True)).problem is not None
    batch = clips_batch(2)
    transitions = [make_transition(batch, clip, step) for clip in (0, 1) for step in range(TIME - 1)]
    single_episode = infer_axes(Oracle(), transitions, at_once=64)
    assert "found 1" in (single_episode.problem or "")


class PositionedOracle(RotatedOracle):
    """A rotated oracle whose error grows with the distance of the flange from one position."""

    def __init__(self, degrees: float, position: Tensor) -> None:
        super().__init__(degrees)
        self.position = position

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        distance = (states[..., :3] - self.position).norm(dim=-1)[..., None, None]
        return super().predict(latents, actions, states, extrinsics) + 5 * distance


@pytest.mark.parametrize("about", ["base", "middle"])
def test_centre_of_the_rotation_is_recovered(about: str) -> None:
    """A rotated mounting rotates positions about the base. A rotated camera does not move the point it looks at."""
    pose = torch.tensor([0.4, 0.1, 0.3, 0.0, 0.0, 0.0, 0.0])
    expected = pose if about == "middle" else AxesRotation(np.deg2rad(45.0)).rotate_poses(pose)
    transitions = [replace(transition, state=pose) for transition in make_transitions()]
    fit = infer_axes(PositionedOracle(45.0, expected[:3]), transitions, at_once=64)
    assert fit.yaw_degrees.value == pytest.approx(45.0, abs=0.5)
    assert fit.centre_m == pytest.approx((0.4, 0.1) if about == "middle" else (0.0, 0.0))
    assert ("about its base" in fit.words()) == (about == "base")
    assert fit.as_dict()["centre_m"] == list(fit.centre_m)
