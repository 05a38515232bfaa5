"""Steering: the model that is tested in closed loop, in this process or behind a server, and its settings."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac import __version__
from vjepa2_ac.config import RldsData
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.goals import GoalFolder, SubGoal
from vjepa2_ac.planning.session import PlanningSession
from vjepa2_ac.serving.client import PlanningClient, goal_keys
from vjepa2_ac.simulation.closed_loop.policies import (
    DoNothing,
    GoalsOf,
    Moves,
    Oracle,
    Planning,
    Policy,
    RandomActions,
)
from vjepa2_ac.simulation.closed_loop.tasks import TaskProblem
from vjepa2_ac.simulation.world.arm import SimulatedArm

JOINT_FIELDS = ("steps/observation/joint_position", "steps/observation/gripper_position")


@dataclass(frozen=True)
class Steering:
    """Who steers, and the settings that its references share."""

    subject: str
    checkpoint: str  # which one, as text; "" of a model
    planning: PlanningConfig
    seed: int  # of its decisions
    stride: int  # control steps of a model step
    warnings: tuple[str, ...]
    policy: Callable[[SimulatedArm, GoalsOf | None], Policy]
    goals_of: Callable[[GoalFolder], tuple[SubGoal, ...]]  # of a folder, for this model
    decoder: str | None = None  # by which videos show what was imagined

    @property
    def limits(self) -> LimitsConfig:
        """The allowed actions."""
        return self.planning.limits


class Client(Protocol):
    """A client that is connected to a server: ours, or openpi's."""

    def infer(self, request: dict[str, Any], /) -> dict[str, Any]:
        """Return the answer to a request."""
        ...


class ServedPlanner:
    """A planner behind a server: images and measured states go through its socket.

    Args:
        client: Connected to it.
        name: As shown in tables.
        goals_of: As of `Planning`.
    """

    moves = Moves.FLANGE

    def __init__(self, client: Client, name: str, goals_of: GoalsOf | None = None) -> None:
        self.client, self.name, self.why, self._goals_of = client, name, "", goals_of
        self._goal: dict[str, Any] = {}

    def reset(self, problem: TaskProblem, goal_image: UInt8[np.ndarray, "height width 3"]) -> None:
        """Begin an episode with a goal image, or with the goals on the way."""
        self.client.infer({"endpoint": "reset"})
        self._goal = {"goal/image": goal_image} if self._goals_of is None else goal_keys(self._goals_of(problem))

    def act(
        self, image: UInt8[np.ndarray, "height width 3"], state: Float[np.ndarray, " dim"]
    ) -> Float[np.ndarray, " dim"]:
        """Return the first action of the server's plan."""
        answer = self.client.infer({"observation/image": image, "observation/state": state, **self._goal})
        self._goal, self.why = {}, answer["why"]
        return np.asarray(answer["actions"][0])


def of_session(session: PlanningSession, decoder: TrainedDecoder | None = None) -> Steering:
    """Return a model of this process.

    Raises:
        InputError: It takes what the simulated arm does not measure, its model step has no known length, or the decoder
            is of another encoder.
    """
    stride = _require_steerable(session)
    if decoder is not None:
        decoder.require_fit(session.world_model, session.config.data.crop, subject=session.subject)
    uses_camera = session.world_model.sizes.predictor.use_extrinsics

    def policy(arm: SimulatedArm, goals_of: GoalsOf | None) -> Policy:
        controller = session.controller(extrinsics=arm.extrinsics() if uses_camera else None)
        return Planning(controller, _shown(session.subject), decoder, goals_of)

    return Steering(
        session.subject,
        session.checkpoint,
        session.config.planning,
        session.config.seed,
        stride,
        session.warnings,
        policy,
        session.goals_of,
        None if decoder is None else decoder.name,
    )


def of_server(client: PlanningClient) -> Steering:
    """Return a model behind a server, with the settings that it tells.

    Raises:
        InputError: It tells none, sends something else than changes of a pose in the base frame, or sends zeros only.
    """
    told = client.metadata
    if told.get("action_space") != "cartesian_delta" or told.get("frame_of_states") != "base" or told.get("dry_run"):
        found = ", ".join(f"{key}: {told.get(key)}" for key in ("action_space", "frame_of_states", "dry_run"))
        needed = "changes of a pose in the frame of the base: --actions delta, --metadata full, no --dry-run"
        raise InputError(where=client.url, found=found, needed=needed)
    try:
        planning = PlanningConfig.model_validate_json(json.dumps(told["planning"]))
        seed, steps = int(told["seed"]), int(told["control_steps"])
    except (KeyError, TypeError, ValueError):
        needed = f"the settings of a server of this version, {__version__}"
        raise InputError(where=client.url, found=f"those of {told.get('version')}", needed=needed) from None
    return Steering(
        client.url,
        str(told.get("checkpoint", "")),
        planning,
        seed,
        steps,
        tuple(map(str, told.get("warnings", ()))),
        lambda _, goals_of: ServedPlanner(client, client.url, goals_of),
        lambda folder: folder.for_model(str(told.get("encoder", "")), planning.energy.distance),
    )


def _shown(subject: str) -> str:
    """Return the name of a model in tables, none of a reference."""
    name = Path(subject).name or subject
    return f"model {name}" if name in {DoNothing.name, RandomActions.name, Oracle.name} else name


def _require_steerable(session: PlanningSession) -> int:
    """Return the control steps of a model step; refuse a model of what the simulated arm does not measure."""
    data = session.config.data
    stride = require_stride(data, to="steer", fix="Say which, as data.stride=4")
    if data.pose_frame != "base":
        raise InputError(
            where=f"data.pose_frame: {data.pose_frame}",
            found="a model of states in another frame",
            needed="base: the simulated arm is steered in the frame of its base",
        )
    if data.states == "vector" and not (isinstance(data, RldsData) and data.fields.state == JOINT_FIELDS):
        raise InputError(
            where="data.states: vector",
            found="a model of other numbers than the simulated arm measures",
            needed=f"poses; or seven joint angles and the gripper: data.fields.state: [{', '.join(JOINT_FIELDS)}]",
        )
    return stride
