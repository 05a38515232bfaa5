"""Model setup for planning: merged, in eval mode, compiled on request; and its axes where they are calibrated."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.lora import unadapted_copy
from vjepa2_ac.model.network.compilation import require_compiler
from vjepa2_ac.model.network.world_model import WorldModel, fingerprint
from vjepa2_ac.model.state_integration import euler_from_matrices, matrices_from_euler
from vjepa2_ac.planning.settings import read_axes

_POSITION, _ROTATION = slice(0, 3), slice(3, 6)


class Fingerprints(NamedTuple):
    """Hashes of a model's weights."""

    encoder: str
    base: str  # of the predictor before it was adapted
    predictor: str  # with the trained weights

    @classmethod
    def of(cls, model: WorldModel) -> Fingerprints:
        """Hash a model, with its adapter separate from its base; of one that was merged, what it was before."""
        if model.merged_from is not None:
            return cls(*model.merged_from)
        known, whole = model.adaptation, fingerprint(model.predictor.state_dict())
        if known is not None:
            return cls(known.encoder, known.base, whole)
        return cls(model.encoder_fingerprint(), model.predictor_fingerprint(), whole)


def prepare_for_planning(world_model: WorldModel, config: PlanningConfig) -> WorldModel:
    """Return the model for planning: the same, or a copy that shares its encoder, for an adapted one.

    Trained weights are float32, and planning does not use autocast as training does: unmerged, PEFT computes an
    adapter in float32, and a predictor that was trained whole takes float32 throughout. So it is merged and computes in
    the base's type. On a fake GPU a decision at the released sizes in bfloat16 takes 7.5 s unmerged, 3.7 s with
    adapters in bfloat16 beside their layers, and 3.0 s merged. Merging costs no accuracy: after 200 steps of the demo
    predictions are off by 2.5 % of the adapter's effect, by 2.7 % without merging, and the base's by 2.4 %. The updates
    lost to rounding (below 0.2 % of a weight) are below bfloat16's noise in the output of a layer.

    Raises:
        InputError: Its blocks are to be compiled, and there is no compiler.
    """
    if world_model.adaptation is not None:
        world_model = unadapted_copy(world_model)
    if config.compile == "blocks":
        require_compiler(world_model.device.type, where="planning.compile")
    world_model.set_compiled("always" if config.compile == "blocks" else "never")
    return world_model.eval()


@dataclass(frozen=True)
class Axes:
    """A turn about a vertical axis, from the robot's axes into the model's.

    Plans are searched among the robot's own actions, so limits hold for what is executed; the model is given each
    action and state turned.

    Source: arXiv 2506.09985, appendix B.4, which rotates inferred moves by a measured angle.
    """

    yaw: float  # radians, counterclockwise from above
    centre_m: tuple[float, float] = (0.0, 0.0)  # x, y that stay where they are; the robot's base

    @classmethod
    def read(cls, path: str, known: Fingerprints) -> Axes:
        """Return the axes of a file that were fitted for a model.

        Raises:
            InputError: They cannot be planned by, or are another model's.
        """
        axes = read_axes(path)
        if (axes.model.encoder, axes.model.predictor) != (known.encoder, known.predictor):
            found = f"axes that were fitted for another model, {axes.model.subject}"
            fix = "Fit them anew: `vjepa2-ac data calibrate CONFIG --axes MODEL`"
            raise InputError(where=f"planning.axes: {path}", found=found, fix=fix)
        return cls(math.radians(axes.yaw_degrees.value), axes.centre_m)

    def poses(self, poses: Float[Tensor, "*batch numbers"]) -> Float[Tensor, "*batch numbers"]:
        """Return poses as the model sees them: x, y, z, three angles, and what does not turn (a gripper)."""
        with torch.autocast(poses.device.type, enabled=False):
            turn, centre = self._turn(poses), poses.new_tensor([*self.centre_m, 0.0])
            rotation = euler_from_matrices(turn @ matrices_from_euler(poses[..., _ROTATION]))
            position = (poses[..., _POSITION] - centre) @ turn.T + centre
            return torch.cat([position, rotation, poses[..., 6:]], dim=-1)

    def actions(self, actions: Float[Tensor, "*batch 7"]) -> Float[Tensor, "*batch 7"]:
        """Return actions as the model sees them: the move and the axis of the rotation are turned."""
        with torch.autocast(actions.device.type, enabled=False):
            turn = self._turn(actions)
            rotation = euler_from_matrices(turn @ matrices_from_euler(actions[..., _ROTATION]) @ turn.T)
            return torch.cat([actions[..., _POSITION] @ turn.T, rotation, actions[..., 6:]], dim=-1)

    def _turn(self, like: Tensor) -> Float[Tensor, "3 3"]:
        return matrices_from_euler(like.new_tensor([0.0, 0.0, self.yaw]))
