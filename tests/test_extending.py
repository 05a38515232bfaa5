"""A toy of each thing that people add, by the doors of docs/extending.md; data and metrics have their own files."""

from typing import get_args

import numpy as np
import pytest
import torch
from torch import Tensor

from solver_problems import parabola, space
from tiny_models import tiny_model
from vjepa2_ac.config.planning import CemConfig, LimitsConfig, PlanningConfig
from vjepa2_ac.config.training import TrainingConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.clips import clips_of
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.planner import SOLVERS, Planner
from vjepa2_ac.planning.solvers.base import EvaluatedPlans
from vjepa2_ac.spaces import ActionSpace, Spaces, StateSpace
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.loss import LOSSES


def test_every_name_of_a_config_has_something_behind_it_and_nothing_is_without_a_name() -> None:
    assert set(get_args(TrainingConfig.model_fields["loss"].annotation)) == set(LOSSES)
    assert set(get_args(PlanningConfig.model_fields["planner"].annotation)) == set(SOLVERS)


def _log_cosh(predicted: Tensor, true: Tensor) -> Tensor:
    return torch.log(torch.cosh(predicted.float() - true.float()))


def test_a_loss(make_config, reporter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LOSSES, "log_cosh", lambda _: _log_cosh)
    asked: list[int] = []
    monkeypatch.setitem(LOSSES, "counted", lambda _: lambda *given: asked.append(1) or _log_cosh(*given))
    config = make_config(training__steps=1)
    for name in ("log_cosh", "counted"):
        training = config.training.model_copy(update={"loss": name})
        changed = config.model_copy(update={"training": training, "run_dir": f"{config.run_dir}-{name}"})
        train(changed, reporter)
    assert asked


class RandomSearch:
    """Uniform samples; the best of all is taken."""

    elites, uses_gradients = 8, False

    def __init__(self, where, config, generator, start=None) -> None:
        del start
        self._space, self._samples, self._generator = where, config.samples, generator
        self.mean, self.std = torch.zeros_like(where.lower), where.first_std

    def sample(self) -> Tensor:
        share = torch.rand(self._samples, *self._space.lower.shape, generator=self._generator)
        return self._space.allowed(self._space.lower + share * (self._space.upper - self._space.lower))

    def update(self, evaluated: EvaluatedPlans) -> None:
        """Learn nothing."""

    def result(self) -> None:
        return None


def test_a_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SOLVERS, "random", RandomSearch)
    target = torch.tensor([[0.3, -0.2]])
    settings = PlanningConfig(samples=2000, iterations=5).model_copy(update={"planner": "random"})
    plan = Planner(settings, space()).plan(parabola(target), torch.Generator().manual_seed(0))
    torch.testing.assert_close(plan.actions, target, atol=0.05, rtol=0)
    assert (plan.planner, plan.stopped, len(plan.iterations)) == ("random", "finished", 5)
    far = Planner(settings, space()).plan(parabola(torch.tensor([[3.0, 0.0]])), torch.Generator().manual_seed(0))
    assert (far.actions.abs() <= 1).all()


def test_a_robot_whose_numbers_have_parts() -> None:
    """A mobile base: a place on the floor, and a heading that is one angle."""
    base = StateSpace(("x", "y", "heading"), ("m", "m", "rad"), position=slice(0, 2))
    drive = ActionSpace(("dx", "dy", "turn"), ("m", "m", "rad"), position=slice(0, 2))
    sizes = tiny_model().sizes
    predictor = sizes.predictor.model_copy(update={"state_dim": 3, "action_dim": 3})
    model = WorldModel.random(sizes.model_copy(update={"predictor": predictor}), seed=0)
    limits = LimitsConfig(axes=(0.1, 0.1, 0.5))
    settings = PlanningConfig(samples=8, iterations=2, cem=CemConfig(elites=3), limits=limits)
    controller = Controller(model, settings, spaces=Spaces(base, drive))
    image = np.zeros((48, 48, 3), np.uint8)
    controller.reset(image + 90)
    action = controller.act(image, np.array([0.2, 0.1, 3.0]))
    assert action.shape == (3,)
    assert (np.abs(action) <= [0.1, 0.1, 0.5]).all()
    with pytest.raises(InputError, match=r"state: .*look like millimetres"):
        controller.act(image, np.array([200.0, 0.1, 3.0]))
    clips = clips_of(np.array([[[0.03, 0.04, 2.0]]]), ("a",), (0,), space=drive, seconds_per_step=0.5)
    assert clips.action_size[0, 0] == pytest.approx(5.0), "centimetres, without the turn"
