"""The decisions that `planning.py` times: this package, an unoptimised variant, and the official notebook."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from functools import cached_property, partial
from unittest import mock

import torch
from decision_variants import OFFICIAL, PLAIN, Difference, Variant
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

POSE = (0.45, 0.10, 0.35, 3.0, 0.1, -0.4, 0.3)  # start pose, with the gripper pointing down
GOAL_ACTION = (0.03, -0.02, 0.04, 0.0, 0.0, 0.0, 0.3)  # the goal is predicted with this action in each step
_COMPARED_SAMPLES, _COMPARED_ITERATIONS = 8, 2


class PlainCost:
    """The energy as computed upstream: all steps are computed again for each step, and poses sample by sample.

    Batches of samples, predictor and attention are those of this package.
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
        device_actions = actions.to(self._model.device)
        for end in range(1, actions.shape[1] + 1):
            predicted = self._model.predict(latents, device_actions[:, :end], states.to(self._model.device))[:, -1:]
            latents = torch.cat([latents, predicted], dim=1)
            states = torch.cat([states, _poses_one_by_one(states[:, -1], actions[:, end - 1])[:, None]], dim=1)
        return distance(latents[:, -1], self._goal, self._config)


class Bench:
    """The models of this package and of the official code in one precision, with the same weights."""

    def __init__(self, options: argparse.Namespace, dtype: str) -> None:
        self.options, self.dtype, self.device = options, getattr(torch, dtype), torch.device(options.device)
        self.sizes = ModelSizes(
            image_size=options.image_size,
            encoder=EncoderSizes(width=options.latent_dim, heads=options.latent_dim // 64, depth=1),  # never used
            predictor=PredictorSizes(width=options.width, heads=options.width // 64, depth=options.layers),
        )
        self.model = self._model().eval()
        tokens, width = self.model.num_tokens, self.model.latent_dim
        numbers = torch.randn(tokens, width, generator=torch.Generator().manual_seed(1))
        self._scene = Scene(layer_norm(numbers, numbers.shape[-1:]), torch.tensor(POSE))
        self._goals = self._predict_goals()
        self._prepared: dict[torch.dtype, WorldModel] = {}
        self._plans: dict[int, Plan] = {}  # plans of this package in float32, by horizon
        self.has_official = all((options.official / path).is_file() for path in (PREDICTOR, PLANNER))

    @cached_property
    def official(self) -> OfficialPlanner:
        """The official planner; must be built before the first decision of this package, which casts the weights."""
        weights = to_official(self.model)["predictor"]
        return OfficialPlanner(
            self.options.official, weights, self.sizes, steps=max(self.options.horizon), device=self.device
        )

    @cached_property
    def adapted(self) -> WorldModel:
        """The model with a frozen LoRA in float32, as in a trained run. Its predictions are those of the model.

        The weights of the adapter are subtracted from the base weights. Must be built before the first decision of
        this package, which casts the weights.
        """
        return self._adapted()

    def difference(self, variant: Variant, horizon: int) -> Difference:
        """Return how the decision of a variant differs from that of this package, in float32 and with few samples.

        Args:
            variant: The variant.
            horizon: Model steps of the plan.
        """
        return Difference.between(self._reference_plan(horizon), self._decided_in_float32(variant, horizon))

    def _reference_plan(self, horizon: int) -> Plan:
        if horizon not in self._plans:
            plan = self._decided_in_float32(Variant.ours(self.options.at_once[0]), horizon)
            assert isinstance(plan, Plan)
            self._plans[horizon] = plan
        return self._plans[horizon]

    def _decided_in_float32(self, variant: Variant, horizon: int) -> Plan | Tensor:
        config = self.config(
            horizon, at_once=variant.at_once, samples=_COMPARED_SAMPLES, iterations=_COMPARED_ITERATIONS
        )
        with mock.patch("torch.randn", _draw_on_cpu(torch.randn)):
            return self._decide(variant, config, torch.float32)

    def config(self, horizon: int, *, at_once: int, samples: int, iterations: int) -> PlanningConfig:
        """Return a planning config with the planner of the official notebook."""
        return PlanningConfig(
            horizon=horizon, samples=samples, iterations=iterations, energy=EnergyConfig(samples_at_once=at_once),
            planner=Component("cem", {"elites": min(10, max(2, samples // 4))}),
        )  # fmt: skip

    def make_decision(self, variant: Variant, horizon: int) -> Callable[[], object]:
        """Cast the weights to the timed type (official: autocast), and return a function that makes one decision."""
        if variant.has_adapter:
            _cast_frozen(self.adapted, self.dtype)
        elif variant.name != OFFICIAL:
            self.model.predictor.to(self.dtype)
        options = self.options
        config = self.config(horizon, at_once=variant.at_once, samples=options.samples, iterations=options.iterations)
        return partial(self._decide, variant, config, self.dtype)

    @property
    def sequences(self) -> int:
        """Number of action sequences that a decision evaluates, including the returned plan."""
        return self.options.samples * self.options.iterations + 1

    def flops(self, horizon: int) -> int:
        """Return the model FLOPs of a decision, from the FLOPs of one sequence that PyTorch counts."""
        cost = WorldModelCost(self.model, self._scene, self._goal(horizon), EnergyConfig())
        with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
            cost.rollout(torch.tensor(GOAL_ACTION).expand(1, horizon, -1))
        return self.sequences * int(counter.get_total_flops())

    @torch.no_grad()
    def _predict_goals(self) -> Tensor:
        """Return the predicted frame after each of several equal actions, [steps, tokens, dim], as goals.

        An arbitrary goal would have the same distance from all predictions of a random model.
        """
        cost = WorldModelCost(self.model, self._scene, Goal(self._scene.latents[None]), EnergyConfig())
        return cost.rollout(torch.tensor(GOAL_ACTION).expand(1, max(self.options.horizon), -1))[0][0]

    def _goal(self, horizon: int) -> Goal:
        return Goal(self._goals[horizon - 1 : horizon])

    def keep_only(self, variant: Variant) -> None:
        """Delete the models that a variant does not need; its decision must have been created."""
        _ = self.official if variant.name == OFFICIAL else None  # must be built before the predictor is deleted
        if variant.name == OFFICIAL or variant.has_adapter:
            self.model.predictor = nn.Identity()

    def _decide(self, variant: Variant, config: PlanningConfig, dtype: torch.dtype) -> Plan | Tensor:
        goal = self._goal(config.horizon)
        if variant.name == OFFICIAL:
            return self.official.decide(self._scene, goal, config, dtype, seed=0)
        build = PlainCost if variant.name == PLAIN else WorldModelCost
        cost: Cost = build(self._prepare_model(variant, config, dtype), self._scene, goal, config.energy)
        return self._plan(config, cost)

    def _plan(self, config: PlanningConfig, cost: Cost) -> Plan:
        return Planner(config).plan(cost, torch.Generator().manual_seed(0))

    def _model(self) -> WorldModel:
        model = random_model(self.sizes, self.dtype, self.device)
        model.encoder.cpu()  # the encoder is not used
        return model

    @torch.no_grad()
    def _adapted(self) -> WorldModel:
        model = _copy_model(self.model)
        add_random_adapter(model)
        for layer in lora_layers(model).values():
            layer.base_layer.weight -= layer.get_delta_weight("default")
        model.predictor.requires_grad_(False)
        return model.eval()

    def _prepare_model(self, variant: Variant, config: PlanningConfig, dtype: torch.dtype) -> WorldModel:
        """Return the model, prepared for planning with a variant. A model with an adapter is prepared once per type."""
        model = self.model
        if variant.has_adapter:
            if dtype not in self._prepared:
                with no_fingerprints():
                    self._prepared[dtype] = prepare_for_planning(self.adapted, config)
            model = self._prepared[dtype]
        return prepare_for_planning(model, config.model_copy(update={"compile": variant.settings["compile"]}))


def _copy_model(model: WorldModel) -> WorldModel:
    """Return a copy of a model that shares the encoder."""
    model_copy = WorldModel.empty(model.sizes)
    model_copy.encoder, model_copy.predictor = model.encoder, copy.deepcopy(model.predictor)
    model_copy.adaptation = model.adaptation
    return model_copy


def _cast_frozen(model: WorldModel, dtype: torch.dtype) -> None:
    """Cast all weights of the predictor except the adapter."""
    for name, parameter in model.predictor.named_parameters():
        if ".lora_" not in name:
            parameter.data = parameter.data.to(dtype)


def _poses_one_by_one(states: Tensor, actions: Tensor) -> Tensor:
    poses = []
    for state, action in zip(states.double().numpy(), actions.double().numpy(), strict=True):
        pose = apply_action(state, action)
        pose[6] = min(max(pose[6], 0.0), 1.0)
        poses.append(torch.from_numpy(pose).float())
    return torch.stack(poses)


def _draw_on_cpu(draw: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Return a `randn` that gives the same numbers on every device; the official planner draws on its own device."""

    def draw_and_move(*shape: int, device: torch.device | str = "cpu", **more: object) -> Tensor:
        return draw(*shape, **more).to(device)

    return draw_and_move
