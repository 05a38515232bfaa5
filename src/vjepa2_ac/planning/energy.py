"""The planning energy: the distance between the latents predicted for an action sequence and those of the goal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, cosine_similarity
from torch.utils.checkpoint import checkpoint

from vjepa2_ac.config.planning import EnergyConfig
from vjepa2_ac.episode import Progress, no_progress
from vjepa2_ac.model.distances import absolute_difference, squared_difference
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.planner import Cost, report_progress
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.registry import ENERGIES
from vjepa2_ac.spaces import POSES, Spaces, euler_from_matrices, integrate_changes, matrices_from_euler

Latents = Float[Tensor, "*batch tokens dim"]
Target = Float[Tensor, "*target tokens dim"]
TokenDistances = Float[Tensor, "*batch tokens"]
Distances = Float[Tensor, "*batch"]
Weights = Float[Tensor, " tokens"]  # of each patch
_POSITION, _ROTATION = slice(0, 3), slice(3, 6)  # of a pose
SAME_ENERGY = 1e-6  # energies with a smaller relative difference are equal up to rounding


@dataclass(frozen=True)
class Goal:
    """Latents of one or more goals in order. Each goal applies for its duration, the last goal without a bound."""

    latents: Float[Tensor, "goals tokens dim"]
    durations: tuple[int, ...] = ()  # number of model steps of each goal except the last
    weights: Weights | None = None  # of the patches; None: equal weights

    def get_index(self, step: int) -> int:
        """Return the index of the goal that applies `step` model steps after the start."""
        for index, duration in enumerate(self.durations):
            step -= duration
            if step < 0:
                return index
        return len(self.latents) - 1

    def get_latents(self, elapsed_steps: int, steps: int) -> Float[Tensor, "steps tokens dim"]:
        """Return the latents of the goal that applies in each of the next `steps` steps, after `elapsed_steps` steps.

        The frame after a goal's last step is still compared with that goal.
        """
        indices = [self.get_index(elapsed_steps + step) for step in range(steps)]
        return torch.stack(
            [self.latents[index] for index in indices]
        )  # indexing with a list would synchronise with the GPU


def compute_patch_weights(
    mask: Bool[Tensor, "*views height width"] | Float[Tensor, "*views height width"], grid: int
) -> Weights:
    """Return the weight of each patch, row by row and view after view: the mean of a mask over the patch.

    Args:
        mask: Mask over the cropped image, at any resolution; 1 for pixels that count, else 0.
        grid: Patches along one side.

    Raises:
        ValueError: The mask is empty.
    """
    weights = adaptive_avg_pool2d(mask.float().reshape(-1, *mask.shape[-2:]), grid).flatten()
    if weights.sum() <= 1e-12:
        raise ValueError("the mask is empty")
    return weights


@dataclass(frozen=True)
class AxesRotation:
    """A rotation about a vertical axis, from the robot's axes to the model's.

    The search uses the robot's axes, so the limits apply to the executed actions. The model receives rotated actions
    and states.

    Source: arXiv 2506.09985, appendix B.4, which rotates inferred motions by a measured angle.
    """

    yaw: float  # radians, counterclockwise seen from above
    centre_m: tuple[float, float] = (0.0, 0.0)  # x, y of the rotation axis; default: the robot's base

    def rotate_poses(self, poses: Float[Tensor, "*batch numbers"]) -> Float[Tensor, "*batch numbers"]:
        """Return rotated poses: x, y, z and three angles; further numbers, such as the gripper, are unchanged."""
        with torch.autocast(poses.device.type, enabled=False):
            matrix, centre = self._get_matrix(poses), poses.new_tensor([*self.centre_m, 0.0])
            rotation = euler_from_matrices(matrix @ matrices_from_euler(poses[..., _ROTATION]))
            position = (poses[..., _POSITION] - centre) @ matrix.T + centre
            return torch.cat([position, rotation, poses[..., 6:]], dim=-1)

    def rotate_actions(self, actions: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 7"]:
        """Return rotated actions: the translation and the axis of the rotation are rotated."""
        with torch.autocast(actions.device.type, enabled=False):
            matrix = self._get_matrix(actions)
            rotation = euler_from_matrices(matrix @ matrices_from_euler(actions[..., _ROTATION]) @ matrix.T)
            return torch.cat([actions[..., _POSITION] @ matrix.T, rotation, actions[..., 6:]], dim=-1)

    def _get_matrix(self, like: Tensor) -> Float[Tensor, "3 3"]:
        matrix: Tensor = matrices_from_euler(like.new_tensor([0.0, 0.0, self.yaw]))
        return matrix


@dataclass(frozen=True)
class Scene:
    """The observation before the first action: latents of the frame (views concatenated), and the state."""

    latents: Float[Tensor, "tokens dim"]
    state: Float[Tensor, " state_dim"]
    extrinsics: Float[Tensor, " 6"] | None = None  # pose of the camera, which is fixed
    axes_rotation: AxesRotation | None = None  # None: the model's axes equal the robot's
    views: int = 1

    def to_model_axes(
        self, actions: Float[Tensor, "*batch action_dim"], states: Float[Tensor, "*batch state_dim"]
    ) -> tuple[Float[Tensor, "*batch action_dim"], Float[Tensor, "*batch state_dim"]]:
        """Return actions and states as the model receives them: in its axes."""
        if self.axes_rotation is None:
            return actions, states
        return self.axes_rotation.rotate_actions(actions), self.axes_rotation.rotate_poses(states)

    @property
    def camera(self) -> Float[Tensor, " 6"] | None:
        """Pose of the camera as the model receives it: in its axes."""
        if self.axes_rotation is None or self.extrinsics is None:
            return self.extrinsics
        return self.axes_rotation.rotate_poses(self.extrinsics)


@dataclass(frozen=True)
class EnergyFunction:
    """The distance between latents that a config names. If the registered energy is a class, it is constructed once."""

    config: EnergyConfig
    by_token: Callable[[Tensor, Tensor], Tensor]

    @classmethod
    def from_config(cls, energy: EnergyConfig | EnergyFunction) -> EnergyFunction:
        """Return the function that a config names; an `EnergyFunction` is returned unchanged."""
        if isinstance(energy, EnergyFunction):
            return energy
        return cls(energy, ENERGIES.create(energy.distance.name, energy.distance.options))


class WorldModelCost:
    """The energy of action sequences from a scene towards a goal."""

    def __init__(
        self,
        world_model: WorldModel,
        scene: Scene,
        goal: Goal,
        energy: EnergyConfig | EnergyFunction,
        *,
        elapsed_steps: int = 0,
        spaces: Spaces = POSES,
    ) -> None:
        """Move everything that all samples share to the model's device.

        Args:
            world_model: The model, in eval mode, because dropout would make energies differ from call to call.
            scene: The frame and state before the first action.
            goal: The goal latents.
            energy: The distance, and the number of samples per batch.
            elapsed_steps: Model steps since the first goal of `goal` began to apply.
            spaces: Meaning of the model's states and actions. The evaluated actions are changes of the state; if the
                model's actions are targets, the model receives the resulting states.

        Raises:
            ValueError: The model is in training mode.
        """
        if world_model.predictor.training:
            raise ValueError("the model is in training mode, so dropout would change the energies; call eval() first")
        device = world_model.device
        self._model, self._energy = world_model, EnergyFunction.from_config(energy)
        self._spaces, self._elapsed_steps = spaces, elapsed_steps
        weights = None if goal.weights is None else goal.weights.to(device)
        self._goal = Goal(goal.latents.to(device), goal.durations, weights)
        self._frame, self._state = scene.latents.to(device), scene.state.to(device)
        self._camera = None if scene.camera is None else scene.camera.to(device)
        self._to_model_axes, self.views = scene.to_model_axes, scene.views
        self.progress: Progress = no_progress  # called after each batch, which the device may not have finished yet

    def __call__(self, actions: Float[Tensor, "samples steps action_dim"]) -> Float[Tensor, " samples"]:
        """Return energies on the device of the actions; gradients flow to the actions if gradients are enabled.

        With gradients and more than one batch, the predictions are recomputed in the backward pass to save memory.
        """
        batches = actions.to(self._model.device).split(self._energy.config.samples_at_once)  # type: ignore[no-untyped-call]
        recompute = torch.is_grad_enabled() and len(batches) > 1
        energies: list[Tensor] = []
        num_evaluated = 0
        for batch in batches:
            if recompute:
                energies.append(checkpoint(self._compute_energies, batch, use_reentrant=False))
            else:
                energies.append(self._compute_energies(batch))
            num_evaluated += len(batch)
            self.progress(num_evaluated, len(actions))
        return torch.cat(energies).to(actions.device)

    @property
    def current(self) -> tuple[Float[Tensor, "tokens dim"], Float[Tensor, " state_dim"]]:
        """Latents of the frame before the first action, and the state, on the model's device."""
        return self._frame, self._state

    def rollout(
        self, actions: Float[Tensor, "samples steps action_dim"]
    ) -> tuple[Float[Tensor, "samples steps tokens dim"], Float[Tensor, "samples steps+1 state_dim"]]:
        """Return the predicted latents after each action and the states before and after each action, in one batch."""
        samples, steps = actions.shape[:2]
        actions = actions.to(self._state)
        states = integrate_changes(self._state, actions, self._spaces.state)
        inputs = states[:, 1:] if self._spaces.action.effect == "target" else actions
        camera = None if self._camera is None else self._camera.expand(samples, steps, -1)
        dim = self._frame.shape[-1]
        views = self._frame.reshape(1, self.views, -1, dim)
        frame = views.expand(samples, -1, -1, -1).flatten(0, 1)[:, None]
        inputs, states_before = (
            values.repeat_interleave(self.views, dim=0) for values in self._to_model_axes(inputs, states[:, :-1])
        )
        predicted = self._model.rollout(frame, inputs, states_before, camera)
        return predicted.reshape(samples, self.views, steps, -1, dim).transpose(1, 2).flatten(2, 3), states

    def _compute_energies(self, actions: Float[Tensor, "samples steps action_dim"]) -> Float[Tensor, " samples"]:
        predicted, _ = self.rollout(actions)
        target = self._goal.get_latents(self._elapsed_steps, actions.shape[1])
        if self._energy.config.steps == "last":
            predicted, target = predicted[:, -1:], target[-1:]
        distances = distance(predicted, target, self._energy, self._goal.weights)
        return distances.sum(dim=1)


def distance(
    predicted: Latents, target: Target, energy: EnergyConfig | EnergyFunction, weights: Weights | None = None
) -> Distances:
    """Return the distance that a config names between latents, as the weighted mean over patches.

    For several calls pass an `EnergyFunction`, so that an energy that is a class is constructed once.
    """
    by_token = EnergyFunction.from_config(energy).by_token(predicted, target)
    return by_token.mean(dim=-1) if weights is None else (by_token * (weights / weights.sum())).sum(dim=-1)


def mean_difference(predicted: Latents, target: Target) -> TokenDistances:
    """Return the mean absolute difference of each token.

    Source: facebookresearch/vjepa2 @ c2963a4, notebooks/utils/mpc_utils.py, l1.
    """
    return absolute_difference(predicted, target).mean(dim=-1)


def mean_square(predicted: Latents, target: Target) -> TokenDistances:
    """Return the mean squared difference of each token."""
    return squared_difference(predicted, target).mean(dim=-1)


def cosine_distance(predicted: Latents, target: Target) -> TokenDistances:
    """Return 1 - cosine of each token."""
    return 1 - cosine_similarity(predicted, target, dim=-1)


@dataclass(frozen=True)
class ChunkScores:
    """Energies of action chunks towards a goal; lower is better."""

    energies: Float[np.ndarray, " chunks"]  # predicted energy of each chunk
    zero_action_energy: float  # predicted energy of the zero action for the same number of steps
    current_energy: float  # energy of the current image
    goal: int  # index of the goal that applies

    @property
    def order(self) -> Int[np.ndarray, " chunks"]:
        """Indices of the chunks, lowest energy first; chunks of equal energy keep their order."""
        return np.argsort(self.energies, kind="stable")

    @property
    def best(self) -> int:
        """Index of the chunk with the lowest energy."""
        return int(self.order[0])

    @property
    def tied(self) -> int:
        """Number of chunks that share the lowest energy, up to rounding."""
        lowest = self.energies.min()
        return int((self.energies <= lowest + SAME_ENERGY * abs(lowest)).sum())

    @property
    def spread(self) -> float:
        """Standard deviation of the energies, divided by the current energy; 0: the model predicts no difference."""
        return float(self.energies.std() / max(self.current_energy, 1e-12))

    def as_dict(self, *, is_blind: bool) -> dict[str, Any]:
        """Return plain values for JSON; `best` is None for a model that cannot rank actions (`is_blind`)."""
        return {
            "energies": self.energies,
            "doing_nothing": self.zero_action_energy,
            "now": self.current_energy,
            "spread": self.spread,
            "tied": self.tied,
            "best": None if is_blind else self.best,
            "is_blind": is_blind,
        }


_SLICE_FACTOR = 1.25  # half-width of a slice, relative to the limit
_MIN_HALF_WIDTH_M = 0.05  # metres; smallest half-width of a slice along a fixed component


@dataclass(frozen=True)
class EnergySlice:
    """Energies over two components of the first action; all other components of the plan are unchanged."""

    components: tuple[int, int]  # their indices
    across: Float[np.ndarray, " nodes"]  # values of the first component
    up: Float[np.ndarray, " nodes"]  # values of the second component
    energy: Float[np.ndarray, "nodes nodes"]  # [up, across]; NaN where the prediction is not finite


def compute_energy_slices(
    cost: Cost,
    actions: Float[Tensor, "steps dim"],
    space: SearchSpace,
    components: Sequence[int] = (0, 1, 2),
    *,
    nodes: int,
    progress: Progress = no_progress,
) -> tuple[EnergySlice, ...]:
    """Return the energy around a plan's first action, over each pair of the given components, such as dx and dy.

    The slices extend beyond the limits. If the first action is repeated, all repetitions change together.

    Args:
        cost: The energy of action sequences.
        actions: The plan.
        space: The search space, whose limits set the width of the slices.
        components: Indices of two or more components of an action.
        nodes: Number of values of each component, three or more.
        progress: Called with the number of evaluated action sequences.
    """
    total, slices = comb(len(components), 2) * nodes**2, []
    progress(0, total)
    for number, pair in enumerate(combinations(components, 2)):
        with report_progress(cost, progress, num_before=number * nodes**2, num_added=nodes**2, total=total):
            slices.append(_compute_slice(cost, actions, space, pair, nodes))
    return tuple(slices)


@torch.no_grad()
def _compute_slice(cost: Cost, actions: Tensor, space: SearchSpace, pair: tuple[int, int], nodes: int) -> EnergySlice:
    across, up = (
        _SLICE_FACTOR * _half_width(space, component, pair) * torch.linspace(-1, 1, nodes) for component in pair
    )
    evaluated = actions.repeat(nodes * nodes, 1, 1)
    evaluated[:, : space.repeat, pair[0]] = across.repeat(nodes)[:, None]
    evaluated[:, : space.repeat, pair[1]] = up.repeat_interleave(nodes)[:, None]
    energy = cost(evaluated).float().cpu().reshape(nodes, nodes)
    return EnergySlice(pair, across.double().numpy(), up.double().numpy(), energy.double().numpy())


def _half_width(space: SearchSpace, component: int, pair: Sequence[int]) -> float:
    """Return the limit of a component; for a component that is fixed at zero, the larger limit of the pair."""
    limit = float(torch.maximum(space.upper[0, component].abs(), space.lower[0, component].abs()))
    return limit or max(*(float(space.upper[0, number]) for number in pair), _MIN_HALF_WIDTH_M)
