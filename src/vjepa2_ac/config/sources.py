"""Source knobs: where each form of data stores what the model needs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from vjepa2_ac.config.section import Section

RAW_CAMERAS = ("left", "right", "wrist", "ext1", "ext2")

_Names = Annotated[tuple[str, ...], Field(min_length=1)]


class RldsFields(Section):
    """Where an RLDS data set stores what the model needs; the defaults are DROID's."""

    state: _Names = (
        "steps/observation/cartesian_position",
        "steps/observation/gripper_position",
    )
    """Features that form, concatenated, the 7 numbers of the *measured* state (legend: episode.py); for `states:
    vector` any numbers."""
    action: _Names = ("steps/action",)
    """For `actions: recorded`: features that form, concatenated, the *commanded* action of each control step."""
    gripper: Literal["closedness", "openness"] = "closedness"
    """Meaning of the state's last number: 0 open .. 1 closed (DROID), or 0 closed .. 1 open (BridgeData)."""
    identity: _Names = ("episode_metadata/recording_folderpath", "episode_metadata/file_path")
    """Features that name an episode; the split into train, validation and test is a hash of them."""
    cameras: Annotated[dict[str, str], Field(min_length=1)] = {
        "exterior_1_left": "steps/observation/exterior_image_1_left",
        "exterior_2_left": "steps/observation/exterior_image_2_left",
        "wrist_left": "steps/observation/wrist_image_left",
    }
    """Camera name -> feature with its frames."""
    language: str | None = "steps/language_instruction"
    """Feature stored in the episode's metadata; the model does not use it."""
    joint_velocity: str | None = "steps/action_dict/joint_velocity"
    """Feature with the *commanded* joint velocities, read by the idle filter; null: there is none."""
    control_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 15.0
    """Control steps per second (RLDS does not say)."""


class RawDroidOptions(Section):
    """How raw DROID (trajectory.h5, metadata_*.json, recordings/MP4) is read."""

    skip_action: Literal["drop", "keep"] = "drop"
    """Steps at which the operator was not in control: drop them, as DROID's own loader does, or keep them."""
    control_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 15.0
    """Control steps per second; the MP4 holds one frame for each, whatever its header says."""


class LeRobotFields(Section):
    """Where a LeRobot data set stores what the model needs; the defaults are those of DROID's ports."""

    state: _Names = ("observation.state.cartesian_position", "observation.state.gripper_position")
    """Columns whose values, concatenated, hold position, rotation and gripper of the *measured* state; for `states:
    vector` any numbers."""
    action: _Names = ("action",)
    """For `actions: recorded`: columns that form, concatenated, the *commanded* action of each control step."""
    select: tuple[Annotated[int, Field(ge=0)], ...] | None = None
    """Which of the concatenated numbers, in this order, are x, y, z, the rotation's 3 or 4, the gripper; for `states:
    vector` which are the state; null: all."""
    rotation: Literal["euler_xyz", "quaternion_wxyz", "quaternion_xyzw"] = "euler_xyz"
    """How the rotation is written: extrinsic xyz Euler angles in radians, or a unit quaternion, w first or last."""
    gripper_open: float = 0.0
    """The gripper's value when it is open."""
    gripper_closed: float = 1.0
    """The gripper's value when it is closed; smaller than gripper_open if the sign is inverted."""
    cameras: Annotated[dict[str, str], Field(min_length=1)] = {
        "exterior_1_left": "observation.images.exterior_1_left",
        "exterior_2_left": "observation.images.exterior_2_left",
        "wrist_left": "observation.images.wrist_left",
    }
    """Camera name -> video feature."""
    joint_velocity: str | None = "action.joint_velocity"
    """Column with the *commanded* joint velocities, read by the idle filter if there is one."""
    success: str | None = "is_episode_successful"
    """Column with the episode's success, used if there is one."""
    fps: Annotated[float, Field(gt=0.0, le=1000.0)] | None = None
    """Control steps per second; null: what meta/info.json says."""

    @model_validator(mode="after")
    def _gripper_moves(self) -> LeRobotFields:
        if self.gripper_open == self.gripper_closed:
            raise ValueError("gripper_open and gripper_closed are the same number")
        return self
