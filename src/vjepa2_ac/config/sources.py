"""Source knobs: where each form of data stores what the model needs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from vjepa2_ac.config.effects import Affects
from vjepa2_ac.config.section import Section

RAW_CAMERAS = ("left", "right", "wrist", "ext1", "ext2")

_Names = Annotated[tuple[str, ...], Field(min_length=1)]


class RldsFields(Section):
    """Where an RLDS data set stores what the model needs; the defaults are DROID's."""

    state: Annotated[_Names, Affects.EPISODES] = (
        "steps/observation/cartesian_position",
        "steps/observation/gripper_position",
    )
    """Features that form, concatenated, the 7 numbers of the *measured* state (legend: episode.py); for `states:
    vector` any numbers."""
    action: Annotated[_Names, Affects.INDEX | Affects.CLIPS] = ("steps/action",)
    """For `actions: recorded`: features that form, concatenated, the *commanded* action of each control step."""
    gripper: Annotated[Literal["closedness", "openness"], Affects.IDLE | Affects.CLIPS] = "closedness"
    """Meaning of the state's last number: 0 open .. 1 closed (DROID), or 0 closed .. 1 open (BridgeData)."""
    identity: Annotated[_Names, Affects.EPISODES] = (
        "episode_metadata/recording_folderpath",
        "episode_metadata/file_path",
    )
    """Features that name an episode; the split into train, validation and test is a hash of them."""
    cameras: Annotated[dict[str, str], Field(min_length=1), Affects.EPISODES] = {
        "exterior_1_left": "steps/observation/exterior_image_1_left",
        "exterior_2_left": "steps/observation/exterior_image_2_left",
        "wrist_left": "steps/observation/wrist_image_left",
    }
    """Camera name -> feature with its frames."""
    language: Annotated[str | None, Affects.IDLE | Affects.CLIPS] = "steps/language_instruction"
    """Feature stored in the episode's metadata; the model does not use it."""
    joint_velocity: Annotated[str | None, Affects.IDLE | Affects.CLIPS] = "steps/action_dict/joint_velocity"
    """Feature with the *commanded* joint velocities, read by the idle filter; null: there is none."""
    control_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0), Affects.IDLE | Affects.CLIPS] = 15.0
    """Control steps per second (RLDS does not say)."""


class RawDroidOptions(Section):
    """How raw DROID (trajectory.h5, metadata_*.json, recordings/MP4) is read."""

    skip_action: Annotated[Literal["drop", "keep"], Affects.EPISODES] = "drop"
    """Steps at which the operator was not in control: drop them, as DROID's own loader does, or keep them."""
    control_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0), Affects.EPISODES] = 15.0
    """Control steps per second; the MP4 holds one frame for each, whatever its header says."""


class LeRobotFields(Section):
    """Where a LeRobot data set stores what the model needs; the defaults are those of DROID's ports."""

    state: Annotated[_Names, Affects.EPISODES] = (
        "observation.state.cartesian_position",
        "observation.state.gripper_position",
    )
    """Columns whose values, concatenated, hold position, rotation and gripper of the *measured* state; for `states:
    vector` any numbers."""
    action: Annotated[_Names, Affects.INDEX | Affects.CLIPS] = ("action",)
    """For `actions: recorded`: columns that form, concatenated, the *commanded* action of each control step."""
    select: Annotated[tuple[Annotated[int, Field(ge=0)], ...] | None, Affects.EPISODES] = None
    """Which of the concatenated numbers, in this order, are x, y, z, the rotation's 3 or 4, the gripper; for `states:
    vector` which are the state; null: all."""
    rotation: Annotated[Literal["euler_xyz", "quaternion_wxyz", "quaternion_xyzw"], Affects.EPISODES] = "euler_xyz"
    """How the rotation is written: extrinsic xyz Euler angles in radians, or a unit quaternion, w first or last."""
    gripper_open: Annotated[float, Affects.EPISODES] = 0.0
    """The gripper's value when it is open."""
    gripper_closed: Annotated[float, Affects.EPISODES] = 1.0
    """The gripper's value when it is closed; smaller than gripper_open if the sign is inverted."""
    cameras: Annotated[dict[str, str], Field(min_length=1), Affects.EPISODES] = {
        "exterior_1_left": "observation.images.exterior_1_left",
        "exterior_2_left": "observation.images.exterior_2_left",
        "wrist_left": "observation.images.wrist_left",
    }
    """Camera name -> video feature."""
    joint_velocity: Annotated[str | None, Affects.EPISODES] = "action.joint_velocity"
    """Column with the *commanded* joint velocities, read by the idle filter if there is one."""
    success: Annotated[str | None, Affects.EPISODES] = "is_episode_successful"
    """Column with the episode's success, used if there is one."""
    fps: Annotated[Annotated[float, Field(gt=0.0, le=1000.0)] | None, Affects.EPISODES] = None
    """Control steps per second; null: what meta/info.json says."""

    @model_validator(mode="after")
    def _gripper_moves(self) -> LeRobotFields:
        if self.gripper_open == self.gripper_closed:
            raise ValueError("gripper_open and gripper_closed are the same number")
        return self
