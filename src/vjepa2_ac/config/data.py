"""Config keys of the data: format of the data set, splits, clips and caches."""

from __future__ import annotations

import re
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, GetCoreSchemaHandler, model_validator
from pydantic_core import CoreSchema, core_schema

from vjepa2_ac.config.section import (
    OFF,
    Affects,
    Component,
    ComponentOf,
    Count,
    LocalPath,
    NonNegative,
    PathOrUrl,
    Positive,
    PositiveInt,
    Section,
    Share,
)
from vjepa2_ac.errors import did_you_mean
from vjepa2_ac.registry import SOURCES, TRANSFORMS

# YAML parses the serial number of a camera as an integer, so that it is converted to text.
_CameraName = Annotated[str, BeforeValidator(lambda name: str(name) if type(name) is int else name)]

Split = Literal["train", "validation", "test"]
RotationFormat = Literal["euler_xyz", "euler_xyz_degrees", "rotation_vector", "quaternion_wxyz", "quaternion_xyzw"]
_JOIN_OPTIONS = "to sum (deltas), mean (velocities) or last (absolute targets)"


def _validate_split_by(text: str) -> str:
    """Validate `data.split_by`: the name of a field, or a regular expression with one group.

    The names of fields depend on the data set and are checked later.
    """
    if re.fullmatch(r"[A-Za-z_]+", text):
        return text
    try:
        groups = re.compile(text).groups
    except (re.error, OverflowError, RecursionError) as error:
        raise ValueError(f"{text!r} is not a regular expression ({error})") from None
    if groups != 1:
        raise ValueError(
            f"{text!r} has {groups} groups; set a field, or a regular expression with exactly one group: (...)"
        )
    return text


class IdleConfig(Section):
    """Which control steps are excluded because the robot does not move."""

    rule: Literal["none", "published", "commands", "motion"] = "none"
    """none: keep all steps. published: ranges from a file. commands: openpi's rule on commanded joint velocities.
    motion: the same rule on the measured poses, for data sets without joint velocities."""
    ranges: PathOrUrl | None = None
    """For rule published: path or URL of a JSON file with the ranges to keep, {"recording_folderpath--file_path":
    [[start, end), ...]}; all other steps are idle."""
    velocity_change_rad_s: Positive = 1e-3
    """For rule commands: a step is idle if no commanded joint velocity changes by this many radians per second."""
    translation_m: Positive = 1e-3
    """For rule motion: a step is idle if its translation in metres is below this, its rotation below rotation_rad and
    its gripper change below gripper."""
    rotation_rad: Positive = 5e-3
    """For rule motion: the limit of the rotation in radians."""
    gripper: Positive = 1e-2
    """For rule motion: the limit of the change of the gripper position (0 to 1)."""
    shortest_idle_steps: PositiveInt = 7
    """Idle ranges with fewer steps are kept."""
    shortest_kept_steps: PositiveInt = 16
    """Moving ranges with fewer steps are removed as well."""
    cut_last_steps: Count = 10
    """Number of steps cut from the end of each remaining range."""

    @model_validator(mode="after")
    def _published_ranges_are_named(self) -> IdleConfig:
        is_broken = (self.rule == "published") != (self.ranges is not None)
        return self.check_rules(
            (is_broken, "rule: published needs ranges (a file or URL), and no other rule uses them")
        )


class DiskCacheConfig(Section):
    """The cache on this machine for remote data and for the indexes of data sets."""

    dir: LocalPath | None = None
    """Folder of the cache; null: $VJEPA2_AC_CACHE, or vjepa2-ac in the user's cache folder."""
    limit_gb: NonNegative = 50.0
    """Size limit of the downloaded data in GB, over all processes; the least recently used data are removed first. 0:
    nothing is cached and nothing is removed. Indexes do not count."""


class PoseFields(Section):
    """How the numbers of a data set form a pose: selection, units and rotation format."""

    select: tuple[Count, ...] | None = None
    """Indices of the numbers of `state` to use, in this order: x, y, z, rotation (3 or 4 numbers), gripper; for vectors
    any numbers. null: all."""
    rotation: RotationFormat = "euler_xyz"
    """Rotation format: extrinsic xyz Euler angles in radians or degrees; a rotation vector (axis times angle in
    radians); or a unit quaternion with w first or last."""
    position_unit: Literal["m", "cm", "mm"] = "m"
    """Unit of the position. The model's states and actions are in metres."""
    gripper_open: float = 0.0
    """The gripper's value when it is open."""
    gripper_closed: float = 1.0
    """The gripper's value when it is closed; smaller than gripper_open if the sign is inverted."""

    @model_validator(mode="after")
    def _gripper_moves(self) -> Self:
        is_broken = self.gripper_open == self.gripper_closed
        return self.check_rules((is_broken, "gripper_open and gripper_closed are the same number"))

    @property
    def pose_keys(self) -> list[str]:
        """The keys that only apply to poses and differ from their defaults."""
        keys = ("rotation", "position_unit", "gripper_open", "gripper_closed")
        return [key for key in keys if getattr(self, key) != type(self).model_fields[key].default]


def source_of(values: Any) -> str:
    """Return the `source` of a data section, given as config or as plain values; rlds by default."""
    source = values.get("source", "rlds") if isinstance(values, dict) else getattr(values, "source", "")
    return str(source)


class DataConfig(Section):
    """The data set and the clips made from it. There is one subclass per data format, selected by `source`.

    A subclass defines the default of `source`, a section for options of its format if there are any, and the class
    variables below.
    """

    affects: ClassVar[Affects] = Affects.CLIPS
    kinds: ClassVar[dict[str, type[DataConfig]]] = {}  # all registered data formats: source -> subclass
    reader: ClassVar[str]  # the class that reads the episodes, as module:class; imported when the data are opened
    is_cache: ClassVar[bool] = False  # whether it is a latent cache, without frames and with one stride
    has_camera_poses: ClassVar[bool] = True
    has_vectors: ClassVar[bool] = True  # whether `states: vector` is possible
    same_identity_fix: ClassVar[str] = ""  # the fix in the error about two episodes with the same identity
    constants: ClassVar[dict[str, dict[str, Any]]] = {}  # removed options of version 0.1 that are part of cache keys

    source: str
    """Format of the data set."""
    path: Annotated[PathOrUrl, Affects.NOTHING]
    """Folder of the data set: a local path, or a URL such as gs://bucket/folder or hf://datasets/owner/name. A run can
    resume after the folder was moved, because its content is compared, not its path."""
    camera: _CameraName | tuple[_CameraName, ...] | None = None
    """Camera whose frames the model receives; with a list of cameras, one is drawn for each clip. null: the source's
    first camera, for DROID the left exterior camera, with which the released weights were trained. rlds, lerobot: a
    name in `cameras`. droid_raw: left, right, wrist, ext1, ext2 or a serial number. npz: an array with frames."""
    states: Literal["pose", "vector"] = "pose"
    """Kind of state. pose: 7 numbers (position, rotation, gripper), as in the released weights. vector: the numbers
    of the data set, unchanged and of any width, for other robots: two arms, joints, a mobile base."""
    actions: Literal["difference", "recorded"] = "difference"
    """difference: the change from each state to the next. recorded: the commands in the data set, of any width; for
    `states: vector`."""
    join_actions: Annotated[Literal["sum", "mean", "last"] | None, Affects.MEASURED | Affects.RUN] = None
    """How the recorded commands of the control steps in a model step are combined into one action. sum: for deltas.
    mean: for velocities. last: for absolute targets. Required unless `stride` is 1."""
    frames: Annotated[int, Field(ge=2, le=256)] = 16
    """Number of frames per clip, one per model step."""
    stride: Annotated[PositiveInt | Literal["auto"], Affects.CLIPS | Affects.PLAN] = 4
    """Control steps per model step. The stride of the released weights is not known for certain: 4, 8 and 15 are
    candidates. auto: before the first step, the one with the model's lowest error relative to persistence is chosen
    from 4, 8 and 15 at 15 control steps per second, scaled to other rates."""
    start_every: PositiveInt = 1
    """Number of control steps between possible starts of clips, counted from the first step of the episode that
    `data.idle` keeps. If it equals `stride`, only every stride-th frame is needed, and a latent cache is smaller."""
    validation_share: Annotated[Share, Affects.RUN] = 0.05
    """Share of the episodes held out for validation, by a hash of their identity; with three episodes or more at least
    one, unless the share is 0."""
    test_share: Annotated[Share, Affects.RUN] = 0.05
    """Share of the episodes held out for `evaluate`, drawn as for validation; not used in training or validation."""
    splits: Annotated[Literal["dataset", "hash"], Affects.RUN] = "dataset"
    """How the splits defined by the data set are used, if there are several (RLDS, LeRobot). dataset: train, val (or
    valid, validation) and test are used as such; a missing split is drawn from train by its share, and splits
    with other names belong to train. hash: all episodes are pooled, and the splits are drawn by the shares."""
    split_by: Annotated[
        Annotated[str, Field(max_length=500), AfterValidator(_validate_split_by)] | None, Affects.RUN
    ] = None
    """Keeps related episodes in one split, to avoid leakage between splits: a field (lab, day or folder from the
    identity; task, scene, building, operator or day from the data set), or a regular expression with one group, which
    is searched in the identity. null: each episode is drawn independently."""
    outcome: Annotated[Literal["all", "success", "failure"], Affects.RUN] = "all"
    """Which demonstrations are used, if the data set records success and failure."""
    idle: IdleConfig = IdleConfig()
    """Which steps are excluded because the robot does not move."""
    broken_episodes: Annotated[Literal["error", "skip"], Affects.NOTHING] = "error"
    """What to do with an episode that cannot be read. error: stop and name it. skip: skip its clips, and report and
    count the episode. The run stops if more than 3 episodes or 1 % are broken, whichever is larger; with fewer than 6
    episodes, if more than half are broken."""
    exclude: Annotated[tuple[str, ...], Affects.NOTHING] = ()
    """Identities of episodes to exclude, as printed in error messages."""
    pose_frame: Literal["base", "camera"] = "base"
    """Frame of the poses: the robot's base (the released recipe), or the camera, if its extrinsics are known."""
    crop: Annotated[Literal["released", "square", "letterbox"], Affects.CLIPS | Affects.PLAN] = "released"
    """How a frame that is not square is made square. released: crop the centre to an aspect ratio of at most 1.35, then
    resize to a square. square: crop the central square (upstream's evaluation). letterbox: add black bars."""
    transforms: Annotated[tuple[Annotated[Component, ComponentOf(TRANSFORMS)], ...], Affects.RUN] = ()
    """Your transforms of training clips, applied in this order (docs/extending.md). Each receives a random generator
    that depends on the seed and the position of the clip in the run."""
    cache: Annotated[Literal["off", "auto", "require"], OFF, Affects.RUN] = "off"
    """Whether the frozen encoder's latents are cached on disk, so that each frame is encoded once. off: no cache. auto:
    missing latents are encoded before the first step. require: refuse to start if latents are missing."""
    cache_dtype: Literal["bf16", "fp32", "int8"] = "bf16"
    """Storage type of cached latents. bf16: 2 bytes per number. fp32: twice the size of bf16. int8: about half the size
    of bf16, with a scale per token."""
    cache_dir: Annotated[PathOrUrl | None, Affects.NOTHING] = None
    """Folder that contains the latent caches: a local path, or a URL such as gs://bucket/folder. null: `latents` in the
    folder of `disk_cache`."""
    disk_cache: Annotated[DiskCacheConfig, Affects.NOTHING] = DiskCacheConfig()
    """The cache on this machine for remote data and for the indexes of data sets."""
    workers: Annotated[int, Field(ge=0, le=256), Affects.NOTHING] = 4
    """Number of loader processes; 0 loads in the training process. The clips do not depend on it."""

    def __new__(cls, **values: Any) -> DataConfig:
        """Create the subclass that `source` selects, RLDS by default."""
        return super().__new__(cls.kinds.get(source_of(values), cls) if cls is DataConfig else cls)

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Register the subclass as a data format.

        Raises:
            InputError: Another class has this source.
            TypeError: A section has the name of a key or attribute of all data formats.
        """
        for name, field in cls.model_fields.items():
            section, common = field.annotation, DataConfig.model_fields.get(name)
            base = Section if common is None else common.annotation
            if not (isinstance(section, type) and issubclass(section, Section)):
                continue
            if hasattr(DataConfig, name) or not (isinstance(base, type) and issubclass(section, base)):
                raise TypeError(f"{cls.__name__}.{name}: all data formats have a key of this name. Choose another")
        name = cls.model_fields["source"].default
        DataConfig.kinds[name] = SOURCES.register(name)(cls)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the union of all data formats for `DataConfig`, and the ordinary schema for a subclass."""
        if Section not in cls.__bases__ or not cls.kinds:
            return handler(source)
        kinds = {name: handler.generate_schema(kind) for name, kind in cls.kinds.items()}
        return core_schema.tagged_union_schema(kinds, source_of)

    @model_validator(mode="after")
    def _parts_fit(self) -> DataConfig:
        known_cameras, cameras = self.known_cameras, self.cameras
        unknown = [camera for camera in cameras if known_cameras is not None and camera not in known_cameras]
        names = known_cameras or ()
        available = f"{did_you_mean(unknown[0], names)}Available: {', '.join(names)}" if unknown else ""
        held_out_share, is_camera_frame = self.validation_share + self.test_share, self.pose_frame == "camera"
        return self.check_rules(
            (
                not cameras,
                "camera: the list is empty. Set one or more names, or null for the first camera of the source",
            ),
            (unknown, f"camera: source {self.source} has no camera {', '.join(unknown)}. {available}"),
            (
                self.is_cache and self.stride == "auto",
                "stride: auto is not possible with a latent cache. Set the stride of the cache",
            ),
            (
                self.is_cache and self.cache != "off",
                f"cache: source {self.source} is a latent cache itself. Set cache: off",
            ),
            (
                self.transforms and self.uses_cached_latents,
                "transforms change frames, but not cached latents. Remove transforms, or set cache: off",
            ),
            (held_out_share >= 1.0, "validation_share and test_share leave nothing to train on"),
            (
                is_camera_frame and not self.has_camera_poses,
                f"pose_frame: source {self.source} has no camera poses. Set pose_frame: base",
            ),
        )

    @model_validator(mode="after")
    def _vectors_fit(self) -> DataConfig:
        pose_options = {
            f"source {self.source}": not self.has_vectors,
            "pose_frame camera": self.pose_frame == "camera",
            "idle.rule motion": self.idle.rule == "motion",
        }
        section, fields = self.pose_fields
        formats = fields.pose_keys if fields else ()
        used = [*(name for name, is_used in pose_options.items() if is_used), *(f"{section}.{key}" for key in formats)]
        is_vector, is_recorded = self.states == "vector", self.actions == "recorded"
        needs_join = is_recorded and self.stride != 1 and self.join_actions is None
        return self.check_rules(
            (is_vector and used, f"{', '.join(used)}: only for poses, and states is vector"),
            (
                is_recorded and not is_vector,
                "actions: recorded needs states: vector, because the action of poses is their difference",
            ),
            (needs_join, f"actions: recorded at stride {self.stride} needs join_actions. Set it {_JOIN_OPTIONS}"),
            (not is_recorded and self.join_actions is not None, "join_actions is only for actions: recorded"),
        )

    @classmethod
    def detect(cls, path: str) -> dict[str, Any] | None:  # noqa: ARG003 - used by subclasses
        """Return the values that `vjepa2-ac init` writes for a folder of this data format; None for other folders.

        They are the keys of this section without source and path, and `control_rate_hz`, the control steps per second.
        """
        return None

    @property
    def known_cameras(self) -> tuple[str, ...] | None:
        """The cameras known from the config, or None if only the data set knows them."""
        return tuple(getattr(self.pose_fields[1], "cameras", ())) or None

    @property
    def offered_cameras(self) -> tuple[str, ...]:
        """The known cameras from which a user can choose."""
        return self.known_cameras or self.cameras

    @property
    def first_camera(self) -> str:
        """The camera that is used if `camera` is null."""
        return self.offered_cameras[0]

    @property
    def pose_fields(self) -> tuple[str, PoseFields | None]:
        """The name and the values of the section that describes how poses are stored; ("", None) if there is none."""
        sections = ((name, getattr(self, name)) for name in self.format_sections())
        return next(((name, fields) for name, fields in sections if isinstance(fields, PoseFields)), ("", None))

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras from which clips are drawn, one or more."""
        if self.camera is None:
            return (self.first_camera,)
        return (self.camera,) if isinstance(self.camera, str) else self.camera

    def with_source(self, source: str, **changes: Any) -> DataConfig:
        """Return a config of another data format with the common keys of this one and `changes`, without validation."""
        common = {name: getattr(self, name) for name in DataConfig.model_fields}
        return self.kinds[source].model_construct(**{**common, "source": source, **changes})

    @classmethod
    def format_sections(cls) -> dict[str, type[Section]]:
        """Return the sections that only this data format has."""
        names = cls.model_fields.keys() - DataConfig.model_fields.keys()
        kinds = {name: field.annotation for name, field in cls.model_fields.items() if name in names}
        return {name: kind for name, kind in kinds.items() if isinstance(kind, type) and issubclass(kind, Section)}

    @property
    def format_values(self) -> dict[str, dict[str, Any]]:
        """The values of the sections that only this data format has, as in the keys of indexes and caches."""
        values = self.model_dump(mode="json", include=set(self.format_sections()))
        return {name: values.get(name, {}) | self.constants.get(name, {}) for name in {**values, **self.constants}}

    @property
    def uses_cached_latents(self) -> bool:
        """Whether clips come from a latent cache, so that training does not need the encoder."""
        return self.is_cache or self.cache != "off"

    @property
    def clip_steps(self) -> int:
        """The number of control steps in a clip, from the first to the last frame inclusive.

        Raises:
            ValueError: The stride is not yet calibrated.
        """
        return (self.frames - 1) * self.model_stride + 1

    @property
    def model_stride(self) -> int:
        """The stride as a number.

        Raises:
            ValueError: The stride is not yet calibrated.
        """
        if self.stride == "auto":
            raise ValueError("data.stride is auto: calibrate first")
        return self.stride

    def with_stride(self, stride: int) -> DataConfig:
        """Return the config with a calibrated stride."""
        return self.model_copy(update={"stride": stride})
