"""The agent: a model that is tested in closed loop, with its planning settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vjepa2_ac.config import PlanningConfig, RldsData
from vjepa2_ac.data.transforms import frame_of_seen, split_views
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller, Decision
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.policies import Oracle, RandomActions, ZeroActions
from vjepa2_ac.simulation.rollout import Action, Image, Observation, Trial

JOINT_FIELDS = ("steps/observation/joint_position", "steps/observation/gripper_position")
Imagine = Callable[[Decision], Image | None]


class Planning:
    """A policy: a world model that plans from the images and the measured state.

    Args:
        controller: Plans with the model; its last `decision` can be read after every action.
        name: Of the model, as shown in tables.
        imagine: Returns the frame that a decision predicts, as the encoder sees it; None: no decoder.
    """

    def __init__(self, controller: Controller, name: str = "model", imagine: Imagine | None = None) -> None:
        self.controller, self.name, self.why, self._imagine = controller, name, "", imagine
        self._size = (0, 0)  # of the last image

    def reset(self, trial: Trial, goal_image: Image) -> None:
        """Give the planner the goal image, or the sub-goals; without their gripper modes if it moves joints."""
        if not trial.goals:
            self.controller.reset(goal_image)
            return
        has_gripper = self.controller.spaces.state.is_pose
        self.controller.follow(trial.goals if has_gripper else [replace(goal, gripper=None) for goal in trial.goals])

    def act(self, observation: Observation) -> Action:
        """Return the first action of a plan; for joints as a change, even if the model's actions are targets.

        Raises:
            ValueError: The model moves joints, and they are not measured.
        """
        spaces, image = self.controller.spaces, observation.image
        state = observation.joints if spaces.state.position is None else observation.state
        if state is None:
            raise ValueError(f"{self.name} moves joints, which this environment does not measure")
        action = self.controller.act(image, state)
        self._size = image.shape[0], image.shape[1]
        self.why = self.controller.decision.why if self.controller.decision else ""
        return action - state if spaces.action.follows == "target" else action

    def imagined(self) -> Image | None:
        """Return the next camera image as predicted for the last action; white where the model receives no pixels.

        None: there is no decoder, or nothing was predicted, for example since the goal is reached.
        """
        decision = self.controller.decision
        predicted = None if self._imagine is None or decision is None else self._imagine(decision)
        if predicted is None:
            return None
        height, width, views = *self._size, self.controller.config.views
        parts = split_views(predicted[None], views)
        return np.hstack([frame_of_seen(part, height, width // views, self.controller.crop) for part in parts])


@dataclass(frozen=True)
class Agent:
    """A model that acts, and what videos show of it.

    Args:
        subject: The model and its settings, loaded for planning.
        imagine: As of `Planning`.
        decoder: Name of the decoder by which it imagines.

    Raises:
        InputError: It takes what the simulated arm does not measure, or its model step has no known length.
    """

    subject: Subject
    imagine: Imagine | None = None
    decoder: str | None = None

    def __post_init__(self) -> None:
        data = self.subject.config.data
        require_stride(data, to="act", fix="Say which, as data.stride=4")
        if data.pose_frame != "base":
            needed = "base: the simulated arm moves in the frame of its base"
            raise InputError(where="data.pose_frame", found=data.pose_frame, needed=needed)
        if data.states == "vector" and not (isinstance(data, RldsData) and data.fields.state == JOINT_FIELDS):
            found = "a model of other numbers than the simulated arm measures"
            needed = f"poses; or seven joint angles and the gripper: data.fields.state: [{', '.join(JOINT_FIELDS)}]"
            raise InputError(where="data.states: vector", found=found, needed=needed)

    @property
    def planning(self) -> PlanningConfig:
        """The planning settings, which the references share."""
        return self.subject.config.planning

    @property
    def stride(self) -> int:
        """Control steps of a model step."""
        return self.subject.config.data.model_stride

    def policy(self, arm: SimulatedArm | None) -> Planning:
        """Return the policy for an arm; None: for a third-party environment, whose camera's pose is not known.

        Raises:
            InputError: The model needs more than such an environment measures.
        """
        subject = self.subject
        uses_camera = subject.world_model.sizes.predictor.use_extrinsics
        if arm is None and (uses_camera or subject.config.data.states == "vector"):
            found = "a model that takes the pose of the camera" if uses_camera else "a model of joints"
            raise InputError(where="--world", found=found, needed="a model of poses: environments measure nothing else")
        name = Path(subject.name).name or subject.name
        if name in {ZeroActions.name, RandomActions.name, Oracle.name}:  # in tables these are the references
            name = f"model {name}"
        controller = Controller.of_subject(subject, extrinsics=arm.extrinsics() if arm and uses_camera else None)
        return Planning(controller, name, self.imagine)
