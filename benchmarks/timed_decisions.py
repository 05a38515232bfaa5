"""What is timed by `planning.py`? A decision: ours, the same without what makes it fast, and the official one."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple
from unittest import mock

import torch
from official import PREDICTOR
from official_planner import PLANNER, OfficialPlanner
from torch import Tensor
from torch.nn.functional import layer_norm

from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.config.planning import CemConfig, EnergyConfig, PlanningConfig
from vjepa2_ac.geometry import apply_action
from vjepa2_ac.model.weights import to_official
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.energy import Scene, WorldModelCost, distance
from vjepa2_ac.planning.goal import Goal
from vjepa2_ac.planning.plan import Cost, Plan
from vjepa2_ac.planning.planner import Planner
from vjepa2_ac.planning.ready import make_ready
from vjepa2_ac.training.cost.flops import plan_flops

PLAIN, OFFICIAL, COMPILED = "plain", "official", "+compiled"
POSE = (0.45, 0.10, 0.35, 3.0, 0.1, -0.4, 0.3)  # of an arm that points down
WANTED = (0.03, -0.02, 0.04, 0.0, 0.0, 0.0, 0.3)  # the action of each step that leads to the goal
_OURS = "ours/"
_COMPARED_SAMPLES, _COMPARED_ITERATIONS = 8, 2
_SAME_ACTIONS = 1e-5  # metres, and of the gripper
_SAME_ENERGIES = 1e-4  # of the largest


class Way(NamedTuple):
    """How a decision is made: plain, official, or ours with so many samples at once."""

    name: str
    at_once: int

    @classmethod
    def ours(cls, at_once: int, *, compiled: bool = False, quantize: str = "off") -> Way:
        """Return ours, perhaps with compiled blocks or in 8 bits."""
        kind = "" if quantize == "off" else f"+{quantize}"
        return cls(f"{_OURS}{at_once}{kind}{COMPILED * compiled}", at_once)

    @property
    def settings(self) -> dict[str, str]:
        """What `planning` says of it."""
        quantize = next((kind for kind in ("int8", "fp8") if f"+{kind}" in self.name), "off")
        return {"compile": "blocks" if self.name.endswith(COMPILED) else "off", "quantize": quantize}


@dataclass(frozen=True)
class Difference:
    """How far two plans are apart."""

    actions: float  # the largest of a number of them
    energies: float | None  # of elites, the largest as a share of the largest energy; None where they are not known

    @classmethod
    def between(cls, ours: Plan, other: Plan | Tensor) -> Difference:
        """Compare with a plan, or with mere actions."""
        if isinstance(other, Tensor):
            return cls(float((ours.actions - other).abs().max()), None)
        energies, others = (torch.cat([one.elite_energies for one in plan.iterations]) for plan in (ours, other))
        return cls(
            float((ours.actions - other.actions).abs().max()), float((energies - others).abs().max() / energies.max())
        )

    def __str__(self) -> str:
        energies = "" if self.energies is None else f", energies by {self.energies:.1g} of the largest"
        return f"actions differ by {self.actions:.1g} at most{energies}"

    @property
    def is_none(self) -> bool:
        """Whether it is rounding."""
        return self.actions <= _SAME_ACTIONS and (self.energies or 0.0) <= _SAME_ENERGIES


class PlainCost:
    """The energy as upstream computes it: everything again for each step, and the pose of one sample after the other.

    In the parts that ours takes, with the predictor and the attention that ours has.
    """

    def __init__(self, model: WorldModel, scene: Scene, goal: Goal, config: EnergyConfig) -> None:
        self._model, self._config = model, config
        self._frame, self._state = scene.latents.to(model.device), scene.states[-1].numpy()
        self._goal = goal.latents[-1].to(model.device)

    def __call__(self, actions: Tensor) -> Tensor:
        """Return the energy of each action sequence."""
        parts = actions.split(self._config.samples_at_once)  # type: ignore[no-untyped-call]  # torch
        return torch.cat([self._energies(part) for part in parts]).to(actions.device)

    def _energies(self, actions: Tensor) -> Tensor:
        latents = self._frame.expand(len(actions), 1, -1, -1)
        states = torch.tensor(self._state).expand(len(actions), 1, -1)
        tried = actions.to(self._model.device)
        for end in range(1, actions.shape[1] + 1):
            following = self._model.predict(latents, tried[:, :end], states.to(self._model.device))[:, -1:]
            latents = torch.cat([latents, following], dim=1)
            states = torch.cat([states, _poses_one_by_one(states[:, -1], actions[:, end - 1])[:, None]], dim=1)
        return distance(latents[:, -1], self._goal, self._config.distance)


class Bench:
    """Our model and the official one in one precision, with the same weights."""

    def __init__(self, options: argparse.Namespace, dtype: str) -> None:
        self.options, self.dtype, self.device = options, getattr(torch, dtype), torch.device(options.device)
        self.sizes = ModelSizes(
            image_size=options.image_size,
            encoder=EncoderSizes(width=options.latent_dim, heads=options.latent_dim // 64, depth=1),  # never used
            predictor=PredictorSizes(width=options.width, heads=options.width // 64, depth=options.layers),
        )
        self.model = self._model().eval()
        drawn = torch.randn(1, self.model.num_tokens, self.model.latent_dim, generator=torch.Generator().manual_seed(1))
        self._scene = Scene(layer_norm(drawn, drawn.shape[-1:]), torch.tensor([POSE]), torch.zeros(0, 7))
        self._goals = self._reachable()
        self._in_8_bits: dict[tuple[str, torch.dtype], WorldModel] = {}
        self.has_official = all((options.official / path).is_file() for path in (PREDICTOR, PLANNER))

    @cached_property
    def official(self) -> OfficialPlanner:
        """The official planner; to be asked for before ours takes its own type."""
        weights = to_official(self.model)["predictor"]
        return OfficialPlanner(
            self.options.official, weights, self.sizes, steps=max(self.options.horizon), device=self.device
        )

    def differences(self, ways: Sequence[Way], horizon: int) -> dict[Way, Difference]:
        """Return how the decisions of each way differ from those of ours, in float32 and with few samples."""
        few = partial(self.config, horizon, samples=_COMPARED_SAMPLES, iterations=_COMPARED_ITERATIONS)
        with mock.patch("torch.randn", _drawn_on_the_cpu(torch.randn)):
            plans = {way: self._decide(way, few(at_once=way.at_once), torch.float32) for way in ways}
        ours = next(plan for way, plan in plans.items() if way.name.startswith(_OURS))
        assert isinstance(ours, Plan)
        return {way: Difference.between(ours, plan) for way, plan in plans.items()}

    @torch.no_grad()
    def added_energy(self, way: Way, horizon: int) -> float:
        """Return by what share the energy of its plan is more than that of ours, both as the plain model sees them."""
        options, plain = self.options, Way.ours(way.at_once)
        config = self.config(horizon, at_once=way.at_once, samples=options.samples, iterations=options.iterations)
        cost = WorldModelCost(make_ready(self.model, config), self._scene, self._goal(horizon), config.energy)
        found, ours = (self._decide(one, config, self.dtype) for one in (way, plain))
        assert isinstance(found, Plan)
        assert isinstance(ours, Plan)
        energy, least = cost(torch.stack([found.actions, ours.actions])).tolist()
        return energy / least - 1  # type: ignore[no-any-return]  # of a tensor's list

    def config(self, horizon: int, *, at_once: int, samples: int, iterations: int) -> PlanningConfig:
        """Return upstream's planner with so much to try."""
        return PlanningConfig(
            horizon=horizon, samples=samples, iterations=iterations, energy=EnergyConfig(samples_at_once=at_once),
            cem=CemConfig(elites=min(10, max(2, samples // 4))),
        )  # fmt: skip

    def decision(self, way: Way, horizon: int) -> Callable[[], object]:
        """Return what makes one decision, with the weights in the type that is timed (official: by autocast)."""
        if way.name != OFFICIAL:
            self.model.predictor.to(self.dtype)
        options = self.options
        config = self.config(horizon, at_once=way.at_once, samples=options.samples, iterations=options.iterations)
        return partial(self._decide, way, config, self.dtype)

    @property
    def sequences(self) -> int:
        """Action sequences that are tried in a decision of ours; the last is the answer."""
        return self.options.samples * self.options.iterations + 1  # type: ignore[no-any-return]  # a command line's

    def flops(self, horizon: int) -> int:
        """Return the model FLOPs of a decision."""
        return self.sequences * plan_flops(self.sizes, horizon)

    @torch.no_grad()
    def _reachable(self) -> Tensor:
        """Return what the model predicts after each of some actions: [steps, tokens, dim].

        Seen from a goal that has nothing to do with a random model's predictions, all of them would be equally far.
        """
        cost = WorldModelCost(self.model, self._scene, Goal(self._scene.latents), EnergyConfig())
        return cost.imagine(torch.tensor(WANTED).expand(1, max(self.options.horizon), -1))[0][0]

    def _goal(self, horizon: int) -> Goal:
        return Goal(self._goals[horizon - 1 : horizon])

    def keep_official_only(self) -> None:
        """Let go of our model."""
        _ = self.official
        self.model.predictor = torch.nn.Identity()

    def _decide(self, way: Way, config: PlanningConfig, dtype: torch.dtype) -> Plan | Tensor:
        goal = self._goal(config.horizon)
        if way.name == OFFICIAL:
            return self.official.decide(self._scene, goal, config, dtype, seed=0)
        build = PlainCost if way.name == PLAIN else WorldModelCost
        cost: Cost = build(self._ready(way, config, dtype), self._scene, goal, config.energy)
        return self._plan(config, cost)

    def _plan(self, config: PlanningConfig, cost: Cost) -> Plan:
        return Planner(config).plan(cost, torch.Generator().manual_seed(0))

    def _model(self) -> WorldModel:
        # Values that either type can hold, so that both have the same; float32 until they have been compared.
        model = WorldModel.random(self.sizes, seed=0, dtype=self.dtype).float()
        model.predictor.to(self.device)
        return model

    def _ready(self, way: Way, config: PlanningConfig, dtype: torch.dtype) -> WorldModel:
        """Return the model as a way plans with it; what is quantized is made once."""
        model, kind = self.model, way.settings["quantize"]
        if kind != "off":
            if (kind, dtype) not in self._in_8_bits:
                self._in_8_bits[kind, dtype] = make_ready(model, config.model_copy(update={"quantize": kind}))
            model = self._in_8_bits[kind, dtype]
        return make_ready(model, config.model_copy(update={"compile": way.settings["compile"]}))


def _poses_one_by_one(states: Tensor, actions: Tensor) -> Tensor:
    after = []
    for state, action in zip(states.double().numpy(), actions.double().numpy(), strict=True):
        pose = apply_action(state, action)
        pose[6] = min(max(pose[6], 0.0), 1.0)
        after.append(torch.from_numpy(pose).float())
    return torch.stack(after)


def _drawn_on_the_cpu(draw: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Return a `randn` that gives the same numbers on every device, for the official planner draws on its own."""

    def drawn(*shape: int, device: torch.device | str = "cpu", **more: object) -> Tensor:
        return draw(*shape, **more).to(device)

    return drawn
