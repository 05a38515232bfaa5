"""Data knobs: the form of the data set, and the clips that are made of it."""

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
    Local,
    NonNegative,
    Place,
    Positive,
    PositiveInt,
    Section,
    Share,
)
from vjepa2_ac.registry import SOURCES, TRANSFORMS

# A serial number is a name, also where YAML takes it for a number.
_CameraName = Annotated[str, BeforeValidator(lambda name: str(name) if type(name) is int else name)]

Split = Literal["train", "validation", "test"]
RotationFormat = Literal["euler_xyz", "euler_xyz_degrees", "rotation_vector", "quaternion_wxyz", "quaternion_xyzw"]
_JOINED = "to sum (deltas), mean (velocities) or last (absolute targets)"


def _split_by(text: str) -> str:
    """Accept the name of a field, or a pattern with one group; the fields depend on the data set."""
    if re.fullmatch(r"[A-Za-z_]+", text):
        return text
    try:
        groups = re.compile(text).groups
    except (re.error, OverflowError, RecursionError) as error:
        raise ValueError(f"{text!r} is no regular expression ({error})") from None
    if groups != 1:
        raise ValueError(f"{text!r} has {groups} groups; name a field, or put what episodes share in one group: (...)")
    return text


class IdleConfig(Section):
    """Which control steps are excluded because the robot stands still."""

    rule: Literal["none", "published", "commands", "motion"] = "none"
    """none: keep all. published: ranges from a file. commands: openpi's rule on commanded joint velocities. motion: the
    same runs, found in the measured poses, for data sets without joint velocities."""
    ranges: Place | None = None
    """For published: a JSON file or URL of {"recording_folderpath--file_path": [[start, end), ...]}; others: idle."""
    velocity_change_rad_s: Positive = 1e-3
    """For commands: a step is idle if no commanded joint velocity changes by this much."""
    translation_m: Positive = 1e-3
    """For motion: a step is idle if translation, rotation and gripper change less than these three."""
    rotation_rad: Positive = 5e-3
    """See translation_m."""
    gripper: Positive = 1e-2
    """See translation_m."""
    shortest_idle_steps: PositiveInt = 7
    """Shorter idle runs stay."""
    shortest_kept_steps: PositiveInt = 16
    """Ranges between idle runs are removed, too, if they are shorter."""
    cut_last_steps: Count = 10
    """Steps cut from the end of each remaining range."""

    @model_validator(mode="after")
    def _published_ranges_are_named(self) -> IdleConfig:
        is_broken = (self.rule == "published") != (self.ranges is not None)
        return self.refused((is_broken, "rule published and ranges (a file or URL) belong together"))


class DiskCacheConfig(Section):
    """The cache on this machine: remote data, and indexes of data sets."""

    dir: Local | None = None
    """Folder; null: $VJEPA2_AC_CACHE, or vjepa2-ac in the user's cache folder."""
    limit_gb: NonNegative = 50.0
    """Most that fetched data take, in GB, of all processes together; the least recently used are removed first. 0: none
    are cached, and none are removed. Indexes do not count."""


class PoseFields(Section):
    """How the numbers of a data set form a pose: which of them, in which units, and with which rotation."""

    select: tuple[Count, ...] | None = None
    """Which numbers of `state`, in this order, are x, y, z, rotation (3 or 4), gripper; or the vector; null: all."""
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
        return self.refused((is_broken, "gripper_open and gripper_closed are the same number"))

    @property
    def pose_keys(self) -> list[str]:
        """The keys that have a meaning for poses only and differ from their defaults."""
        keys = ("rotation", "position_unit", "gripper_open", "gripper_closed")
        return [key for key in keys if getattr(self, key) != type(self).model_fields[key].default]


def source_of(values: Any) -> str:
    """Return the form of the data of a config, or of the values of one: RLDS unless it says another."""
    found = values.get("source", "rlds") if isinstance(values, dict) else getattr(values, "source", "")
    return str(found)


class DataConfig(Section):
    """The data set, and the clips made of it: one subclass for each form of data, told apart by `source`.

    A subclass has the default of its `source`, a section for its own knobs where it has some, and its abilities.
    """

    affects: ClassVar[Affects] = Affects.CLIPS
    kinds: ClassVar[dict[str, type[DataConfig]]] = {}  # of the forms that there are, by the name of their source
    reader: ClassVar[str]  # the class that reads the episodes, as module:class; imported when the data are opened
    is_cache: ClassVar[bool] = False  # of latents, by a LatentSource; no frames, one stride
    has_camera_poses: ClassVar[bool] = True
    has_vectors: ClassVar[bool] = True  # states may be other numbers than a pose
    same_identity_fix: ClassVar[str] = ""  # the way out where two episodes are named alike
    constants: ClassVar[dict[str, dict[str, Any]]] = {}  # options of its sections in 0.1: part of keys of caches

    source: str
    """Form of the data set."""
    path: Annotated[Place, Affects.NOTHING]
    """Folder of the data set: on this machine, or a URL such as gs://bucket/folder or hf://datasets/owner/name. A run
    goes on with a folder that was moved, for it is known by what it holds."""
    camera: _CameraName | tuple[_CameraName, ...] | None = None
    """Which camera the model sees; of several, one is drawn for each clip. null: the source's first, for DROID the left
    exterior camera, which the released weights saw. rlds, lerobot: a name in `cameras`. droid_raw: left, right, wrist,
    ext1, ext2 or a serial number. npz: the name of an array of frames."""
    states: Literal["pose", "vector"] = "pose"
    """Kind of state. pose: 7 numbers, position, rotation and gripper, which the released weights know. vector: the
    source's own numbers, unchanged, of any width, for other robots: two arms, joints, a mobile base."""
    actions: Literal["difference", "recorded"] = "difference"
    """difference: the change from a state to the next. recorded: the source's commands, of any width; for vectors."""
    join_actions: Annotated[Literal["sum", "mean", "last"] | None, Affects.MEASURED | Affects.RUN] = None
    """How the recorded commands of a model step's control steps become one action. sum: deltas. mean: velocities. last:
    absolute targets. Must be given unless `stride` is 1."""
    frames: Annotated[int, Field(ge=2, le=256)] = 16
    """Frames of a clip, one per model step."""
    stride: Annotated[PositiveInt | Literal["auto"], Affects.CLIPS | Affects.PLAN] = 4
    """Control steps per model step. Unsettled for the released weights: 4, 8 and 15 are candidates. auto: before the
    first step the model chooses among 4, 8 and 15 at 15 control steps per
    second, scaled to other rates, by its prediction error over persistence."""
    start_every: PositiveInt = 1
    """Clips start at multiples of this many control steps, counted from the first step of their episode that
    `data.idle` keeps. With the stride's own number, only every stride-th frame is ever needed: a small latent cache."""
    validation_share: Annotated[Share, Affects.RUN] = 0.05
    """Share of the episodes held out for validation, by a hash of their identity; at least one of three, unless 0."""
    test_share: Annotated[Share, Affects.RUN] = 0.05
    """Share of the episodes held out for `evaluate`, likewise; never seen in training nor in validation."""
    splits: Annotated[Literal["dataset", "hash"], Affects.RUN] = "dataset"
    """How the data set's own splits are used, if it has several (RLDS, LeRobot). dataset: train, val (or valid,
    validation) and test are used as such; a missing one is drawn from train by its share, and other names count as
    train. hash: all episodes are pooled, and the splits are drawn from them by the shares."""
    split_by: Annotated[Annotated[str, Field(max_length=500), AfterValidator(_split_by)] | None, Affects.RUN] = None
    """What keeps related episodes in one split, so that training reveals nothing about held-out ones: a field (lab, day
    or folder, as the identity says; task, scene, building, operator or day where the data set does), or a regular
    expression with one group, which is searched in the identity. null: each episode is drawn independently."""
    outcome: Annotated[Literal["all", "success", "failure"], Affects.RUN] = "all"
    """Which demonstrations are used, if the data set records success and failure."""
    idle: IdleConfig = IdleConfig()
    """Which steps are excluded because the robot stands still."""
    broken_episodes: Annotated[Literal["error", "skip"], Affects.NOTHING] = "error"
    """What to do with an episode that cannot be read. error: stop and name it. skip: leave its clips out, name and
    count it. The run stops where more are broken than 3 episodes or 1 %, whichever is larger; or, of fewer than 6
    episodes, more than half."""
    exclude: Annotated[tuple[str, ...], Affects.NOTHING] = ()
    """Identities of episodes to leave out, as errors name them."""
    pose_frame: Literal["base", "camera"] = "base"
    """Frame of the poses: the robot's base (the released recipe), or the camera, where its extrinsics are known."""
    crop: Annotated[Literal["released", "square", "letterbox"], Affects.CLIPS | Affects.PLAN] = "released"
    """How a frame that is not square is cropped. released: its centre, 1.35 times as wide as high at most, squashed.
    square: its central square (upstream's evaluation). letterbox: all of it, with black bars."""
    transforms: Annotated[tuple[Annotated[Component, ComponentOf(TRANSFORMS)], ...], Affects.RUN] = ()
    """Changes of training clips by code of your own, in this order (docs/extending.md). Each is given a random
    generator that depends on the seed and the position of the clip in the run."""
    cache: Annotated[Literal["off", "auto", "require"], OFF, Affects.RUN] = "off"
    """Whether the frozen encoder's latents are cached on disk, so that each frame is encoded once. off: no. auto: those
    that are not there yet are encoded before the first step. require: refuse to start where they are not there."""
    cache_dtype: Literal["bf16", "fp32", "int8"] = "bf16"
    """Storage type of latents: bf16; fp32, which takes twice as much room; int8 with a scale per token, half."""
    cache_dir: Annotated[Place | None, Affects.NOTHING] = None
    """Folder for latent caches, on this machine or a URL such as gs://bucket/folder, one folder in it for each; null:
    `latents` in the folder of `disk_cache`."""
    disk_cache: Annotated[DiskCacheConfig, Affects.NOTHING] = DiskCacheConfig()
    """The cache on this machine."""
    workers: Annotated[int, Field(ge=0, le=256), Affects.NOTHING] = 4
    """Loader processes; 0 loads in the training process. The data does not depend on it."""

    def __new__(cls, **values: Any) -> DataConfig:
        """Make the config of the form of data that `source` names; of RLDS where it is not given."""
        return super().__new__(cls.kinds.get(source_of(values), cls) if cls is DataConfig else cls)

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Take part in the union.

        Raises:
            InputError: Another class has this source.
            TypeError: A section has the name of something else that all forms of data have.
        """
        for name, field in cls.model_fields.items():
            section, common = field.annotation, DataConfig.model_fields.get(name)
            base = Section if common is None else common.annotation
            if not (isinstance(section, type) and issubclass(section, Section)):
                continue
            if hasattr(DataConfig, name) or not (isinstance(base, type) and issubclass(section, base)):
                raise TypeError(f"{cls.__name__}.{name}: all forms of data have a key of this name. Choose another")
        name = cls.model_fields["source"].default
        DataConfig.kinds[name] = SOURCES.register(name)(cls)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Be the union of all forms of data where any is allowed."""
        if Section not in cls.__bases__ or not cls.kinds:
            return handler(source)
        kinds = {name: handler.generate_schema(kind) for name, kind in cls.kinds.items()}
        return core_schema.tagged_union_schema(kinds, source_of)

    @model_validator(mode="after")
    def _parts_fit(self) -> DataConfig:
        known, cameras = self.known_cameras, self.cameras
        unknown = [camera for camera in cameras if known is not None and camera not in known]
        splits, of_camera = self.validation_share + self.test_share, self.pose_frame == "camera"
        return self.refused(
            (not cameras, "camera: an empty list; name one or more, or null for the source's first"),
            (unknown, f"camera: source {self.source} has no {unknown[:1]}; it has {', '.join(known or ())}"),
            (self.is_cache and self.stride == "auto", "stride auto: a latent cache has one stride; give its number"),
            (self.is_cache and self.cache != "off", f"source {self.source} is itself a cache: set cache: off"),
            (self.transforms and self.takes_latents, "transforms change frames, latents in a cache stay: choose one"),
            (splits >= 1.0, "validation_share and test_share leave nothing to train on"),
            (
                of_camera and not self.has_camera_poses,
                f"pose_frame camera: a source of {self.source} has no camera poses",
            ),
        )

    @model_validator(mode="after")
    def _vectors_fit(self) -> DataConfig:
        of_poses = {
            f"source {self.source}": not self.has_vectors,
            "pose_frame camera": self.pose_frame == "camera",
            "idle.rule motion": self.idle.rule == "motion",
        }
        section, fields = self.pose_fields
        formats = fields.pose_keys if fields else ()
        asked = [*(name for name, is_asked in of_poses.items() if is_asked), *(f"{section}.{key}" for key in formats)]
        is_vector, is_recorded = self.states == "vector", self.actions == "recorded"
        has_many = is_recorded and self.stride != 1 and self.join_actions is None
        return self.refused(
            (is_vector and asked, f"{', '.join(asked)}: a matter of poses, and states is vector"),
            (is_recorded and not is_vector, "actions recorded needs states vector: that of a pose is its difference"),
            (has_many, f"actions recorded at stride {self.stride}: set join_actions {_JOINED}"),
            (not is_recorded and self.join_actions is not None, "join_actions belongs to actions recorded"),
        )

    @classmethod
    def look(cls, path: str) -> dict[str, Any] | None:  # noqa: ARG003 - of a form that is looked for
        """Return what `vjepa2-ac init` writes for a folder of this form, beside source and path; None: it is none.

        The values of this section; `control_rate_hz`, beside them, is the number of control steps per second.
        """
        return None

    @property
    def known_cameras(self) -> tuple[str, ...] | None:
        """The cameras known from the config, or None if only the data set knows them."""
        return tuple(getattr(self.pose_fields[1], "cameras", ())) or None

    @property
    def offered_cameras(self) -> tuple[str, ...]:
        """The cameras that a person may choose from, as far as they are known."""
        return self.known_cameras or self.cameras

    @property
    def first_camera(self) -> str:
        """The camera that the model sees unless `camera` names others; of the form of data, where none are known."""
        return self.offered_cameras[0]

    @property
    def pose_fields(self) -> tuple[str, PoseFields | None]:
        """The name and the values of the section that says where a pose is stored; None for a form without one."""
        sections = ((name, getattr(self, name)) for name in self.own_sections())
        return next(((name, fields) for name, fields in sections if isinstance(fields, PoseFields)), ("", None))

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that clips are drawn from, one or more."""
        if self.camera is None:
            return (self.first_camera,)
        return (self.camera,) if isinstance(self.camera, str) else self.camera

    def as_kind(self, source: str, **changes: Any) -> DataConfig:
        """Return the config of another form of data with these knobs, as far as it has them, and changes; unchecked."""
        same = {name: getattr(self, name) for name in DataConfig.model_fields}
        return self.kinds[source].model_construct(**{**same, "source": source, **changes})

    @classmethod
    def own_sections(cls) -> dict[str, type[Section]]:
        """Return the sections that this form of data has and others have not."""
        own = [(name, one.annotation) for name, one in cls.model_fields.items() if name not in DataConfig.model_fields]
        return {name: kind for name, kind in own if isinstance(kind, type) and issubclass(kind, Section)}

    @property
    def own_values(self) -> dict[str, dict[str, Any]]:
        """The values of its own sections, as the keys of indexes and caches have them."""
        values = self.model_dump(mode="json", include=set(self.own_sections()))
        return {name: values.get(name, {}) | self.constants.get(name, {}) for name in {**values, **self.constants}}

    @property
    def takes_latents(self) -> bool:
        """Whether clips come from a latent cache, so that the encoder is not needed beside the predictor."""
        return self.is_cache or self.cache != "off"

    @property
    def clip_steps(self) -> int:
        """Control steps that a clip spans, first and last frame included.

        Raises:
            ValueError: The stride is not yet calibrated.
        """
        return (self.frames - 1) * self.model_stride + 1

    @property
    def model_stride(self) -> int:
        """The stride as a number.

        Raises:
            ValueError: It is not yet calibrated.
        """
        if self.stride == "auto":
            raise ValueError("data.stride is auto: calibrate first")
        return self.stride

    def with_stride(self, stride: int) -> DataConfig:
        """Return the config with a calibrated stride."""
        return self.model_copy(update={"stride": stride})
