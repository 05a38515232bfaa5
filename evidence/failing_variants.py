"""Failing variants of demonstrations: perturb the actions of a segment, and execute them in the simulator.

The idea, families of perturbations times severities, is from CureWM (arXiv 2610.09134). The families, their sizes and
the criterion of failure are ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor

from vjepa2_ac import encode
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.media.images import decode_images, encode_jpeg
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.motion import Motion
from vjepa2_ac.simulation.record import JPEG_QUALITY, RecordingSpec, execute_episode, make_arm
from vjepa2_ac.simulation.rollout import send_action
from vjepa2_ac.spaces import POSE

STRIDE, STEPS = 4, 4  # control steps per model step; model steps of a segment
FAILED_M, FAILED_GRIPPER = 0.05, 0.5  # a variant fails if flange or gripper end further from those of the demonstration

Actions = Float[np.ndarray, "steps 7"]
States = Float[np.ndarray, "time 7"]
Frames = UInt8[np.ndarray, "time height width 3"]


FAMILIES = {
    "offset at the end": (0.08, 0.14),  # metres, added to the last action
    "wrong direction": (90.0, 180.0),  # degrees about the vertical
    "lag": (1, 2),  # model steps
    "scale": (0.5, 0.1),  # factor of the translation
    "gripper": (1, STEPS),  # number of last actions with the opposite gripper command
    "drop-out": (2, 3),  # number of actions that are replaced by the zero action
    "noise": (0.04, 0.07),  # standard deviation of each axis and model step, in metres
}
"""Family of perturbations -> a mild and a severe value of its parameter."""

VARIANTS = tuple((family, severity) for family, severities in FAMILIES.items() for severity in severities)
"""Family and parameter of each variant of a segment."""


def perturb(
    actions: Actions, family: str, severity: float, goal: Float[np.ndarray, " 7"], rng: np.random.Generator
) -> Actions:
    """Return the actions of a variant.

    Args:
        actions: The actions of the demonstration.
        family: A key of `FAMILIES`.
        severity: The parameter of the family.
        goal: The state at the end of the demonstration's segment.
        rng: Random generator.

    Raises:
        ValueError: There is no such family.
    """
    changed, count = actions.copy(), int(severity)
    match family:
        case "offset at the end":
            direction = rng.normal(size=3)
            changed[-1, :3] += severity * direction / np.linalg.norm(direction)
        case "wrong direction":
            turn = Rotation.from_euler("z", rng.choice([-1.0, 1.0]) * severity, degrees=True)
            changed[:, :3] = turn.apply(actions[:, :3])
        case "lag":
            changed[:count], changed[count:] = 0.0, actions[:-count]
        case "scale":
            changed[:, :3] *= severity
        case "gripper":
            changed[-count:, 6] = -1.0 if goal[6] > 0.5 else 1.0
        case "drop-out":
            changed[rng.permutation(len(actions))[:count]] = 0.0
        case "noise":
            changed[:, :3] += rng.normal(0.0, severity, size=(len(actions), 3))
        case _:
            raise ValueError(f"{family!r} is not a family of perturbations")
    return changed


def is_failure(end: Float[np.ndarray, " 7"], goal: Float[np.ndarray, " 7"]) -> bool:
    """Return whether flange or gripper are further from the goal than `FAILED_M` or `FAILED_GRIPPER`."""
    is_far = np.linalg.norm(end[:3] - goal[:3]) > FAILED_M
    return bool(is_far or abs(end[6] - goal[6]) > FAILED_GRIPPER)


@dataclass(frozen=True)
class Groups:
    """Segments with their executed variants. All alternatives of a group start at the same frame.

    Alternative 0 is the demonstration, alternative 1 + n is variant n (`VARIANTS`). States are measured, and actions
    are the differences of measured states, as for a recorded episode.
    """

    latents: Float[Tensor, "groups alternatives time tokens dim"]
    states: Float[Tensor, "groups alternatives time 7"]
    actions: Float[Tensor, "groups alternatives time-1 7"]
    failed: Bool[Tensor, "groups alternatives"]  # False for the demonstration

    def select(self, groups: Tensor, alternatives: Tensor) -> Groups:
        """Return some groups, each with some of its alternatives.

        Args:
            groups: Indices of the groups [groups].
            alternatives: Indices of the alternatives of each of these groups [groups, alternatives].
        """
        chosen = groups[:, None], alternatives
        return Groups(self.latents[chosen], self.states[chosen], self.actions[chosen], self.failed[chosen])

    def predict(self, model: WorldModel) -> Float[Tensor, "groups alternatives steps tokens dim"]:
        """Return the rollout of each alternative from the first frame."""
        latents, states, actions = (values.flatten(0, 1) for values in (self.latents, self.states, self.actions))
        predicted = model.rollout(latents[:, :1], actions, states[:, :-1])
        return predicted.unflatten(0, self.failed.shape)


@dataclass(frozen=True)
class Recordings:
    """Demonstrations at every control step, and their segments with executed variants."""

    latents: Float[Tensor, "episodes steps tokens dim"]
    states: Float[Tensor, "episodes steps 7"]
    groups: Groups

    def clip(self, episode: int, start: int, frames: int) -> LatentBatch:
        """Return a clip of a demonstration, as a batch."""
        steps = slice(start, start + STRIDE * (frames - 1) + 1, STRIDE)
        states = self.states[episode, steps]
        actions = torch.from_numpy(POSE.compute_differences(states.double().numpy())).float()
        latents = self.latents[episode, steps]
        return LatentBatch(latents[None], states[None], actions[None], None, (str(episode),), (start,))


def record(model: WorldModel, spec: RecordingSpec, episodes: range, segments: int) -> Recordings:
    """Record demonstrations and their variants, and encode them.

    Args:
        model: The model whose encoder is used.
        spec: The options of the recording.
        episodes: Numbers of the episodes.
        segments: Number of segments of each episode, each in another part of the episode.
    """
    latents, states, groups = [], [], []
    for index in episodes:
        arm, rng = make_arm(index, spec), np.random.default_rng([spec.seed, index, 64])
        images: list[bytes] = []
        motion = execute_episode(arm, index, spec, on_step=lambda arm, images=images: images.append(_jpeg(arm)))  # type: ignore[misc]
        frames = decode_images(images, range(len(images)), "a simulated frame")
        measured = np.column_stack([motion.poses, motion.gripper])
        latents.append(encode(model, frames, chunk=64))
        states.append(torch.from_numpy(measured).float())
        part = (spec.steps - 1 - STRIDE * STEPS) // segments
        for segment in range(segments):
            start = part * segment + int(rng.integers(part + 1))
            steps = slice(start, start + STRIDE * STEPS + 1, STRIDE)
            groups.append(_make_group(model, arm, motion, start, (frames[steps], measured[steps]), rng))
    stacked = (torch.stack(values) for values in zip(*groups, strict=True))
    return Recordings(torch.stack(latents), torch.stack(states), Groups(*stacked))


def _make_group(
    model: WorldModel,
    arm: SimulatedArm,
    motion: Motion,
    start: int,
    demonstration: tuple[Frames, States],
    rng: np.random.Generator,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return latents, states, actions and failures of a segment and its variants."""
    true_frames, true_states = demonstration
    true_actions, goal = POSE.compute_differences(true_states), true_states[-1]
    frames, states = [true_frames], [true_states]
    for family, severity in VARIANTS:
        arm.set_joints(motion.joints[start], float(motion.gripper[start]))
        ran = execute(arm, perturb(true_actions, family, severity, goal, rng))
        frames.append(np.concatenate([true_frames[:1], ran[0]]))
        states.append(np.concatenate([true_states[:1], ran[1]]))
    failed = [False, *(is_failure(each[-1], goal) for each in states[1:])]
    actions = np.stack([POSE.compute_differences(each) for each in states])
    poses, differences = (torch.from_numpy(values).float() for values in (np.stack(states), actions))
    return encode(model, np.stack(frames), chunk=64), poses, differences, torch.tensor(failed)


def execute(arm: SimulatedArm, actions: Actions) -> tuple[Frames, States]:
    """Carry out actions from the arm's current state; return frame and measured state after each of them."""
    images, states = [], []
    for action in actions:
        send_action(arm, action, STRIDE)
        images.append(_jpeg(arm))
        states.append(arm.state)
    return decode_images(images, range(len(images)), "a simulated frame"), np.stack(states)


def _jpeg(arm: SimulatedArm) -> bytes:
    """Return the image of the first camera, compressed as in a data set."""
    return encode_jpeg(arm.image("exterior_1"), quality=JPEG_QUALITY)
