"""The decisions that `planning.py` times: this package, an unoptimised variant, and the official notebook."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from functools import cached_property, partial
from unittest import mock

import torch
from decision_ways import OFFICIAL, PLAIN, Difference, Way
from official_planner import PLANNER, OfficialPlanner
from official_predictor import PREDICTOR
from random_models import add_random_adapter, no_fingerprints, random_model
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.functional import layer_norm
from torch.utils.flop_counter import FlopCounterMode

from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.config.planning import EnergyConfig, PlanningConfig
from vjepa2_ac.config.section import Component
from vjepa2_ac.model.checkpoints import to_official
from vjepa2_ac.model.lora import lora_layers
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.energy import Goal, Scene, WorldModelCost, distance
from vjepa2_ac.planning.model_setup import prepare_for_planning
from vjepa2_ac.planning.planner import Cost, Plan, Planner
from vjepa2_ac.spaces import apply_action

POSE = (0.45, 0.10, 0.35, 3.0, 0.1, -0.4, 0.3)  # of an arm that points down
WANTED = (0.03, -0.02, 0.04, 0.0, 0.0, 0.0, 0.3)  # the action of each step that leads to the goal
_COMPARED_SAMPLES, _COMPARED_ITERATIONS = 8, 2


class PlainCost:
    """The energy as upstream computes it: everything again for each step, and the pose of one sample after the other.

    In the parts that ours takes, with the predictor and the attention that ours has.
    """

    def __init__(self, model: WorldModel, scene: Scene, goal: Goal, config: EnergyConfig) -> None:
        self._model, self._config = model, config
        self._frame, self._state = scene.latents[None].to(model.device), scene.state.numpy()
        self._goal = goal.latents[-1].to(model.device)

    def __call__(self, actions: Tensor) -> Tensor:
        """Return the energy of each action sequence."""
        parts = actions.split(self._config.samples_at_once)
        return torch.cat([self._energies(part) for part in parts]).to(actions.device)

    def _energies(self, actions: Tensor) -> Tensor:
        latents = self._frame.expand(len(actions), 1, -1, -1)
        states = torch.tensor(self._state).expand(len(actions), 1, -1)
        tried = actions.to(self._model.device)
        for end in range(1, actions.shape[1] + 1):
            following = self._model.predict(latents, tried[:, :end], states.to(self._model.device))[:, -1:]
            latents = torch.cat([latents, following], dim=1)
            states = torch.cat([states, _poses_one_by_one(states[:, -1], actions[:, end - 1])[:, None]], dim=1)
        return distance(latents[:, -1], self._goal, self._config)


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
        tokens, width = self.model.num_tokens, self.model.latent_dim
        drawn = torch.randn(tokens, width, generator=torch.Generator().manual_seed(1))
        self._scene = Scene(layer_norm(drawn, drawn.shape[-1:]), torch.tensor(POSE))
        self._goals = self._reachable()
        self._made_ready: dict[torch.dtype, WorldModel] = {}
        self._plans: dict[int, Plan] = {}  # of ours in float32, by their horizon
        self.has_official = all((options.official / path).is_file() for path in (PREDICTOR, PLANNER))

    @cached_property
    def official(self) -> OfficialPlanner:
        """The official planner; to be asked for before ours takes its own type."""
        weights = to_official(self.model)["predictor"]
        return OfficialPlanner(
            self.options.official, weights, self.sizes, steps=max(self.options.horizon), device=self.device
        )

    @cached_property
    def adapted(self) -> WorldModel:
        """Ours as a trained run has it: a LoRA in float32, frozen; with it the same predictions as without.

        To be asked for before ours takes its own type. The base is less what the adapter adds, which is not zero.
        """
        return self._adapted()

    def difference(self, way: Way, horizon: int) -> Difference:
        """Return how the decision of a way differs from that of ours, in float32 and with few samples.

        Args:
            way: Any.
            horizon: Model steps of the plan.
        """
        return Difference.between(self._expected(horizon), self._decided_in_float32(way, horizon))

    def _expected(self, horizon: int) -> Plan:
        if horizon not in self._plans:
            plan = self._decided_in_float32(Way.ours(self.options.at_once[0]), horizon)
            assert isinstance(plan, Plan)
            self._plans[horizon] = plan
        return self._plans[horizon]

    def _decided_in_float32(self, way: Way, horizon: int) -> Plan | Tensor:
        config = self.config(horizon, at_once=way.at_once, samples=_COMPARED_SAMPLES, iterations=_COMPARED_ITERATIONS)
        with mock.patch("torch.randn", _drawn_on_the_cpu(torch.randn)):
            return self._decide(way, config, torch.float32)

    def config(self, horizon: int, *, at_once: int, samples: int, iterations: int) -> PlanningConfig:
        """Return upstream's planner with so much to try."""
        return PlanningConfig(
            horizon=horizon, samples=samples, iterations=iterations, energy=EnergyConfig(samples_at_once=at_once),
            planner=Component("cem", {"elites": min(10, max(2, samples // 4))}),
        )  # fmt: skip

    def decision(self, way: Way, horizon: int) -> Callable[[], object]:
        """Return what makes one decision, with the weights in the type that is timed (official: by autocast)."""
        if way.has_adapter:
            _cast_frozen(self.adapted, self.dtype)
        elif way.name != OFFICIAL:
            self.model.predictor.to(self.dtype)
        options = self.options
        config = self.config(horizon, at_once=way.at_once, samples=options.samples, iterations=options.iterations)
        return partial(self._decide, way, config, self.dtype)

    @property
    def sequences(self) -> int:
        """Action sequences that are tried in a decision of ours; the last is the answer."""
        return self.options.samples * self.options.iterations + 1

    def flops(self, horizon: int) -> int:
        """Return the model FLOPs of a decision: PyTorch counts those of one sequence."""
        cost = WorldModelCost(self.model, self._scene, self._goal(horizon), EnergyConfig())
        with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
            cost.rollout(torch.tensor(WANTED).expand(1, horizon, -1))
        return self.sequences * int(counter.get_total_flops())

    @torch.no_grad()
    def _reachable(self) -> Tensor:
        """Return what the model predicts after each of some actions: [steps, tokens, dim].

        Seen from a goal that has nothing to do with a random model's predictions, all of them would be equally far.
        """
        cost = WorldModelCost(self.model, self._scene, Goal(self._scene.latents[None]), EnergyConfig())
        return cost.rollout(torch.tensor(WANTED).expand(1, max(self.options.horizon), -1))[0][0]

    def _goal(self, horizon: int) -> Goal:
        return Goal(self._goals[horizon - 1 : horizon])

    def keep_only(self, way: Way) -> None:
        """Let go of what a way does not need, once its decision is there."""
        _ = self.official if way.name == OFFICIAL else None
        if way.name == OFFICIAL or way.has_adapter:
            self.model.predictor = nn.Identity()

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
        model = random_model(self.sizes, self.dtype, self.device)
        model.encoder.cpu()  # nobody looks
        return model

    @torch.no_grad()
    def _adapted(self) -> WorldModel:
        model = _copy(self.model)
        add_random_adapter(model)
        for layer in lora_layers(model).values():
            layer.base_layer.weight -= layer.get_delta_weight("default")
        model.predictor.requires_grad_(False)
        return model.eval()

    def _ready(self, way: Way, config: PlanningConfig, dtype: torch.dtype) -> WorldModel:
        """Return the model as a way plans with it; what becomes of an adapter is made once."""
        model = self.model
        if way.has_adapter:
            if dtype not in self._made_ready:
                with no_fingerprints():
                    self._made_ready[dtype] = prepare_for_planning(self.adapted, config)
            model = self._made_ready[dtype]
        return prepare_for_planning(model, config.model_copy(update={"compile": way.settings["compile"]}))


def _copy(model: WorldModel) -> WorldModel:
    """Return a model with a predictor of its own."""
    other = WorldModel.empty(model.sizes)
    other.encoder, other.predictor = model.encoder, copy.deepcopy(model.predictor)
    other.adaptation = model.adaptation
    return other


def _cast_frozen(model: WorldModel, dtype: torch.dtype) -> None:
    """Cast all but the adapter."""
    for name, parameter in model.predictor.named_parameters():
        if ".lora_" not in name:
            parameter.data = parameter.data.to(dtype)


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
