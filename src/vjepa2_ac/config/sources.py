"""Source options: the forms of data, where each stores what the model needs, and what each can."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from vjepa2_ac.config.data import DataConfig, PoseFields

RAW_CAMERAS = ("left", "right", "wrist", "ext1", "ext2")
RAW_RATE_HZ = 15.0  # control steps of raw DROID; an MP4 holds one frame for each, whatever its header says
JOINT_VELOCITY = "action.joint_velocity"  # LeRobot's column of commanded joint velocities, which the idle filter reads

RECORD: Literal["record"] = "record"  # as an identity

_Names = Annotated[tuple[str, ...], Field(min_length=1)]


class RldsFields(PoseFields):
    """Where an RLDS data set stores what the model needs; the defaults are DROID's."""

    state: _Names = (
        "steps/observation/cartesian_position",
        "steps/observation/gripper_position",
    )
    """Features whose numbers, concatenated, hold position, rotation and gripper of the *measured* state; for
    `states: vector` any numbers."""
    action: _Names = ("steps/action",)
    """For `actions: recorded`: features that form, concatenated, the *commanded* action of each control step."""
    identity: _Names | Literal["record"] = (
        "episode_metadata/recording_folderpath",
        "episode_metadata/file_path",
    )
    """Features that name an episode; the split into train, validation and test is a hash of them. record: split, file
    and number of the record, for sets without such features; the split then changes if the set is written again."""
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

    @property
    def identity_features(self) -> tuple[str, ...]:
        """The features that name an episode; none if the record does."""
        return () if self.identity == RECORD else self.identity


class LeRobotFields(PoseFields):
    """Where a LeRobot data set stores what the model needs; the defaults are those of DROID's ports."""

    state: _Names = (
        "observation.state.cartesian_position",
        "observation.state.gripper_position",
    )
    """Columns that hold position, rotation and gripper of the *measured* state; for `states: vector` any numbers."""
    action: _Names = ("action",)
    """For `actions: recorded`: columns that form, concatenated, the *commanded* action of each control step."""
    cameras: Annotated[dict[str, str], Field(min_length=1)] = {
        "exterior_1_left": "observation.images.exterior_1_left",
        "exterior_2_left": "observation.images.exterior_2_left",
        "wrist_left": "observation.images.wrist_left",
    }
    """Camera name -> video feature."""
    success: str | None = "is_episode_successful"
    """Column with the episode's success, used if there is one."""


class RldsData(DataConfig):
    """TFRecord shards with a dataset_info.json, as TFDS writes them."""

    reader: ClassVar[str] = "vjepa2_ac.data.sources.rlds:RldsSource"
    has_camera_poses: ClassVar[bool] = False
    same_identity_fix: ClassVar[str] = (
        "Add a feature to data.fields.identity that differs between them, or set data.fields.identity: record"
    )

    source: Literal["rlds"] = "rlds"
    """rlds: TFRecord shards with a dataset_info.json, as TFDS writes them."""
    fields: RldsFields = RldsFields()
    """Names of the features."""


class RawDroidData(DataConfig):
    """DROID's own folders."""

    reader: ClassVar[str] = "vjepa2_ac.data.sources.droid_raw:RawDroidSource"
    has_vectors: ClassVar[bool] = False
    same_identity_fix: ClassVar[str] = "Name a smaller folder in data.path"
    constants: ClassVar[dict[str, dict[str, Any]]] = {
        "droid_raw": {"skip_action": "drop", "control_rate_hz": RAW_RATE_HZ}
    }

    source: Literal["droid_raw"] = "droid_raw"
    """droid_raw: DROID's folders with trajectory.h5 and MP4."""

    @property
    def offered_cameras(self) -> tuple[str, ...]:
        """By their place on the robot, the left exterior one first; or by a serial number."""
        return RAW_CAMERAS


class LeRobotData(DataConfig):
    """A LeRobotDataset v2.1 or v3.0."""

    reader: ClassVar[str] = "vjepa2_ac.data.sources.lerobot:LeRobotSource"
    constants: ClassVar[dict[str, dict[str, Any]]] = {"lerobot": {"joint_velocity": JOINT_VELOCITY, "fps": None}}
    has_camera_poses: ClassVar[bool] = False

    source: Literal["lerobot"] = "lerobot"
    """lerobot: LeRobotDataset v2.1 or v3.0."""
    lerobot: LeRobotFields = LeRobotFields()
    """Names and conventions of the columns."""


class NpzData(DataConfig):
    """A folder of .npz episodes."""

    reader: ClassVar[str] = "vjepa2_ac.data.sources.npz:NpzSource"

    source: Literal["npz"] = "npz"
    """npz: a folder of .npz episodes."""

    @property
    def first_camera(self) -> str:
        """The array of that name."""
        return "frames"


class LatentsData(DataConfig):
    """A latent cache alone."""

    reader: ClassVar[str] = "vjepa2_ac.data.sources.latents:LatentSource"
    is_cache: ClassVar[bool] = True

    source: Literal["latents"] = "latents"
    """latents: a latent cache alone, without the data set that it was made from."""

    @property
    def first_camera(self) -> str:
        """All that were encoded."""
        return "all"


DataConfig.model_rebuild(force=True)  # the union of these
