"""The agent: the model that is tested in closed loop, in this process or behind a server, and its settings."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vjepa2_ac import __version__
from vjepa2_ac.config import RldsData
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.decoding.decoder_folder import SIMULATED, TrainedDecoder
from vjepa2_ac.errors import InputError
from vjepa2_ac.goals.nearest import StartAndGoal, goals_alike
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import GoalFolder, SubGoal
from vjepa2_ac.planning.model_setup import goals_of
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.serving.client import PlanningClient, goal_keys
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.policies import (
    GoalsOf,
    Image,
    Moves,
    Oracle,
    Planning,
    Policy,
    RandomActions,
    ZeroActions,
)
from vjepa2_ac.simulation.tasks import Problem

JOINT_FIELDS = ("steps/observation/joint_position", "steps/observation/gripper_position")


@dataclass(frozen=True)
class Agent:
    """A model that acts, and the settings that its references share."""

    subject: str
    checkpoint: str  # which one, as text; "" of a model
    planning: PlanningConfig
    seed: int  # of its decisions
    stride: int  # control steps of a model step
    warnings: tuple[str, ...]
    policy: Callable[[SimulatedArm | None, GoalsOf | None], Policy]  # None: in another world, which tells no cameras
    goals_of: Callable[[GoalFolder], tuple[SubGoal, ...]]  # of a folder, for this model
    goals_alike: Callable[[Sequence[StartAndGoal], Reporter], Sequence[Sequence[SubGoal]]] | None = None
    """Of demonstrations that are alike; None: it is behind a server, which has none."""
    decoder: str | None = None  # by which videos show what was imagined


class ServedPlanner:
    """A planner behind a server: images and measured states go through its socket.

    Args:
        client: Connected to it; openpi's will do.
        name: As shown in tables.
        goals_of: As of `Planning`.
    """

    moves = Moves.FLANGE

    def __init__(self, client: PlanningClient, name: str, goals_of: GoalsOf | None = None) -> None:
        self.client, self.name, self.why, self._goals_of = client, name, "", goals_of
        self._goal: dict[str, Any] = {}

    def reset(self, problem: Problem, goal_image: Image) -> None:
        """Begin an episode with a goal image, or with the goals on the way."""
        self.client.infer({"endpoint": "reset"})
        self._goal = {"goal/image": goal_image} if self._goals_of is None else goal_keys(self._goals_of(problem))

    def act(self, image: Image, state: Float[np.ndarray, " dim"]) -> Float[np.ndarray, " dim"]:
        """Return the first action of the server's plan."""
        answer = self.client.infer({"observation/image": image, "observation/state": state, **self._goal})
        self._goal, self.why = {}, answer["why"]
        return np.asarray(answer["actions"][0])


def agent_of_session(
    session: Subject, decoder: TrainedDecoder | None = None, *, shown: str | None = SIMULATED
) -> Agent:
    """Return a model of this process.

    Args:
        session: The model.
        decoder: Shows what was imagined.
        shown: What the frames show, as of `TrainedDecoder.require_fit`.

    Raises:
        InputError: It takes what the simulated arm does not measure, its model step has no known length, or the decoder
            is of another encoder.
    """
    config = session.config
    stride = require_stride(config.data, to="act", fix="Say which, as data.stride=4")
    if config.data.pose_frame != "base":
        needed = "base: the simulated arm moves in the frame of its base"
        raise InputError(where="data.pose_frame", found=config.data.pose_frame, needed=needed)
    is_of_joints = isinstance(config.data, RldsData) and config.data.fields.state == JOINT_FIELDS
    if config.data.states == "vector" and not is_of_joints:
        found = "a model of other numbers than the simulated arm measures"
        needed = f"poses; or seven joint angles and the gripper: data.fields.state: [{', '.join(JOINT_FIELDS)}]"
        raise InputError(where="data.states: vector", found=found, needed=needed)
    if decoder is not None:
        decoder.require_fit(session.world_model, config.data, subject=session.name, shown=shown)
    uses_camera = session.world_model.sizes.predictor.use_extrinsics
    name = Path(session.name).name or session.name
    if name in {ZeroActions.name, RandomActions.name, Oracle.name}:  # in tables the names of references are theirs
        name = f"model {name}"

    def policy(arm: SimulatedArm | None, goals_of: GoalsOf | None) -> Policy:
        if arm is None and (uses_camera or config.data.states == "vector"):
            found = "a model that takes the pose of the camera" if uses_camera else "a model of joints"
            raise InputError(where="--world", found=found, needed="a model of poses: worlds tell nothing else")
        controller = Controller.of_subject(session, extrinsics=arm.extrinsics() if arm and uses_camera else None)
        return Planning(controller, name, decoder, goals_of)

    return Agent(
        subject=session.name,
        checkpoint=session.chosen,
        planning=config.planning,
        seed=config.seed,
        stride=stride,
        warnings=session.warnings,
        policy=policy,
        goals_of=partial(goals_of, subject=session),
        goals_alike=partial(goals_alike, session),
        decoder=None if decoder is None else decoder.name,
    )


def agent_of_server(client: PlanningClient) -> Agent:
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
        seed, stride = int(told["seed"]), int(told["control_steps"])
    except (KeyError, TypeError, ValueError):
        needed = f"the settings of a server of this version, {__version__}"
        raise InputError(where=client.url, found=f"those of {told.get('version')}", needed=needed) from None
    return Agent(
        subject=client.url,
        checkpoint=str(told.get("checkpoint", "")),
        planning=planning,
        seed=seed,
        stride=stride,
        warnings=tuple(map(str, told.get("warnings", ()))),
        policy=lambda _, goals_of: ServedPlanner(client, client.url, goals_of),
        goals_of=lambda folder: folder.for_model(str(told.get("encoder", "")), planning.energy.distance.name),
    )
