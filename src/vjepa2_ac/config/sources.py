"""Config keys of the data formats: RLDS, LeRobot, raw DROID, npz and latent caches."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from vjepa2_ac.config.data import DataConfig, PoseFields

RAW_CAMERAS = ("left", "right", "wrist", "ext1", "ext2")
# Control steps per second of raw DROID. Its MP4s have one frame per step, also if their header has another rate.
RAW_RATE_HZ = 15.0
JOINT_VELOCITY = "action.joint_velocity"  # LeRobot's column of commanded joint velocities, read by the idle filter

RECORD: Literal["record"] = "record"  # a value of `identity`

_Names = Annotated[tuple[str, ...], Field(min_length=1)]


class RldsFields(PoseFields):
    """Features of an RLDS data set; the defaults are DROID's."""

    state: _Names = (
        "steps/observation/cartesian_position",
        "steps/observation/gripper_position",
    )
    """Features whose concatenated numbers are position, rotation and gripper of the *measured* state; with
    `states: vector` any numbers."""
    action: _Names = ("steps/action",)
    """For `actions: recorded`: features whose concatenated numbers are the *commanded* action of each control step."""
    identity: _Names | Literal["record"] = (
        "episode_metadata/recording_folderpath",
        "episode_metadata/file_path",
    )
    """Features that identify an episode; the split into train, validation and test is a hash of them. record: split,
    file and index of the record, for data sets without such features; the split then changes if the data set is written
    again."""
    cameras: Annotated[dict[str, str], Field(min_length=1)] = {
        "exterior_1_left": "steps/observation/exterior_image_1_left",
        "exterior_2_left": "steps/observation/exterior_image_2_left",
        "wrist_left": "steps/observation/wrist_image_left",
    }
    """Camera name -> feature with its frames."""
    language: str | None = "steps/language_instruction"
    """Feature with the language instruction, kept in the episode's metadata; the model does not use it."""
    joint_velocity: str | None = "steps/action_dict/joint_velocity"
    """Feature with the *commanded* joint velocities, read by the idle filter; null: there is no such feature."""
    control_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 15.0
    """Control steps per second, which RLDS files do not contain."""

    @property
    def identity_features(self) -> tuple[str, ...]:
        """The features that identify an episode; empty with `identity: record`."""
        return () if self.identity == RECORD else self.identity


class LeRobotFields(PoseFields):
    """Columns of a LeRobot data set; the defaults are those of DROID's ports."""

    state: _Names = (
        "observation.state.cartesian_position",
        "observation.state.gripper_position",
    )
    """Columns with position, rotation and gripper of the *measured* state; with `states: vector` any numbers."""
    action: _Names = ("action",)
    """For `actions: recorded`: columns whose concatenated numbers are the *commanded* action of each control step."""
    cameras: Annotated[dict[str, str], Field(min_length=1)] = {
        "exterior_1_left": "observation.images.exterior_1_left",
        "exterior_2_left": "observation.images.exterior_2_left",
        "wrist_left": "observation.images.wrist_left",
    }
    """Camera name -> video feature."""
    success: str | None = "is_episode_successful"
    """Column with the success of the episode; ignored if the data set has no such column."""


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
    """DROID's raw recordings."""

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
        """The camera names by mounting position, the left exterior camera first. Serial numbers are also allowed."""
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
        """The array `frames`."""
        return "frames"


class LatentsData(DataConfig):
    """A latent cache without the data set it was made from."""

    reader: ClassVar[str] = "vjepa2_ac.data.sources.latents:LatentSource"
    is_cache: ClassVar[bool] = True

    source: Literal["latents"] = "latents"
    """latents: a latent cache, without the data set it was made from."""

    @property
    def first_camera(self) -> str:
        """All encoded cameras."""
        return "all"


DataConfig.model_rebuild(force=True)  # builds the union of these classes
