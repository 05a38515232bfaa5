"""Data knobs: the form of the data set, and the clips that are made of it."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from vjepa2_ac.config.effects import Affects
from vjepa2_ac.config.section import OFF, Local, Place, PositiveInt, Section, Share
from vjepa2_ac.config.sources import RAW_CAMERAS, LeRobotFields, RawDroidOptions, RldsFields
from vjepa2_ac.places import is_url

# A serial number is a name, also where YAML takes it for a number.
_CameraName = Annotated[str, BeforeValidator(lambda name: str(name) if type(name) is int else name)]

Split = Literal["train", "validation", "test"]
_STRIDES_AT_15_HZ = (4, 8, 15)


def _split_by(text: str) -> str:
    """Accept the name of a field, or a pattern with one group; the fields depend on the data set."""
    if re.fullmatch(r"[A-Za-z_]+", text):
        return text
    try:
        groups = re.compile(text).groups
    except (re.error, OverflowError, RecursionError) as error:
        raise ValueError(f"{text!r} is no regular expression ({error})") from None
    if groups != 1:
        raise ValueError(
            f"{text!r} has {groups} groups; name a field, or put the part of the identity that episodes share in the"
            " one group of a regular expression: (...)"
        )
    return text


class IdleConfig(Section):
    """Which control steps are excluded because the robot stands still."""

    rule: Literal["none", "published", "commands", "motion"] = "none"
    """none: keep all. published: ranges from a file. commands: openpi's rule on commanded joint velocities. motion: the
    same runs, found in the measured poses, for data sets without joint velocities."""
    ranges: Place | None = None
    """For published: a JSON file, local or a URL, of {"recording_folderpath--file_path": [[start, end), ...]}. Episodes
    that it does not name count as idle."""
    keep_share: Annotated[float, Field(ge=0.0, le=1.0), Affects.LATENTS | Affects.RUN] = 0.0
    """Share of the idle windows that are kept: a world model should see stillness too."""
    velocity_change_rad_s: Annotated[float, Field(gt=0.0)] = 1e-3
    """For commands: a step is idle if no commanded joint velocity changes by this much."""
    translation_m: Annotated[float, Field(gt=0.0)] = 1e-3
    """For motion: a step is idle if translation, rotation and gripper change less than these three."""
    rotation_rad: Annotated[float, Field(gt=0.0)] = 5e-3
    """See translation_m."""
    gripper: Annotated[float, Field(gt=0.0)] = 1e-2
    """See translation_m."""
    shortest_idle_steps: PositiveInt = 7
    """Shorter idle runs stay."""
    shortest_kept_steps: PositiveInt = 16
    """Ranges between idle runs are removed, too, if they are shorter."""
    cut_last_steps: Annotated[int, Field(ge=0)] = 10
    """Steps cut from the end of each remaining range."""

    @model_validator(mode="after")
    def _published_ranges_are_named(self) -> IdleConfig:
        if (self.rule == "published") != (self.ranges is not None):
            raise ValueError("rule published and ranges (a file or URL) belong together")
        return self


class AugmentConfig(Section):
    """Random changes of training clips, the same for all frames of a clip. The released recipe has none."""

    crop_scale: tuple[Annotated[float, Field(gt=0.0, le=1.0)], Annotated[float, Field(gt=0.0, le=1.0)]] | None = None
    """Random resized crop: least and greatest share of the frame's area; null: no random crop."""
    crop_aspect: tuple[Annotated[float, Field(gt=0.0)], Annotated[float, Field(gt=0.0)]] = (0.75, 1.35)
    """Random resized crop: narrowest and widest width over height."""
    brightness: Share = 0.0
    """Colour jitter: brightness is multiplied by 1 - this .. 1 + this."""
    contrast: Share = 0.0
    """Colour jitter: contrast likewise."""
    saturation: Share = 0.0
    """Colour jitter: saturation likewise."""

    @property
    def is_on(self) -> bool:
        """Whether anything is changed."""
        return self.crop_scale is not None or max(self.brightness, self.contrast, self.saturation) > 0

    @model_validator(mode="after")
    def _pairs_are_ordered(self) -> AugmentConfig:
        for name, pair in (("crop_scale", self.crop_scale), ("crop_aspect", self.crop_aspect)):
            if pair is not None and pair[0] > pair[1]:
                raise ValueError(f"{name}: {pair[0]} is more than {pair[1]}")
        return self


class DiskCacheConfig(Section):
    """The cache on this machine: remote data, and indexes of data sets."""

    dir: Local | None = None
    """Folder; null: $VJEPA2_AC_CACHE, or vjepa2-ac in the user's cache folder."""
    limit_gb: Annotated[float, Field(ge=0.0)] = 50.0
    """Frames beyond this size are removed, least recently used first; 0: none are cached. Indexes do not count."""


class DataConfig(Section):
    """The data set, and the clips made of it."""

    source: Annotated[
        Literal["rlds", "droid_raw", "lerobot", "npz", "latents"],
        Affects.INDEX | Affects.IDLE | Affects.LATENTS | Affects.RUN,
    ] = "rlds"
    """Form of the data set. rlds: TFRecord shards with a dataset_info.json, as TFDS writes them. droid_raw: DROID's
    folders with trajectory.h5 and MP4. lerobot: LeRobotDataset v2.1 or v3.0. npz: a folder of .npz episodes. latents: a
    latent cache alone, without the data set that it was made from."""
    path: Annotated[Place, Affects.NOTHING]
    """Folder of the data set: on this machine, or a URL such as gs://bucket/folder or hf://datasets/owner/name. A run
    goes on with a folder that was moved, for it is known by what it holds."""
    fields: RldsFields = RldsFields()
    """For rlds: names of the features."""
    droid_raw: RawDroidOptions = RawDroidOptions()
    """For droid_raw: which steps are used."""
    lerobot: LeRobotFields = LeRobotFields()
    """For lerobot: names and conventions of the columns."""
    camera: Annotated[_CameraName | tuple[_CameraName, ...] | None, Affects.INDEX | Affects.CLIPS] = None
    """Which camera the model sees; of several, one is drawn for each clip. null: the source's first, for DROID the left
    exterior camera, which the released weights saw. rlds, lerobot: a name in `cameras`. droid_raw: left, right, wrist,
    ext1, ext2 or a serial number. npz: the name of an array of frames."""
    states: Annotated[Literal["pose", "vector"], Affects.INDEX | Affects.CLIPS] = "pose"
    """Kind of state. pose: 7 numbers, position, rotation and gripper, which the released weights know. vector: the
    source's own numbers, unchanged, of any width, for other robots: two arms, joints, a mobile base."""
    actions: Annotated[Literal["difference", "recorded"], Affects.INDEX | Affects.CLIPS] = "difference"
    """difference: the change from a state to the next one; of vectors, the plain difference. recorded: the commands in
    the source, of any width; for vectors only."""
    join_actions: Annotated[Literal["sum", "mean", "last"] | None, Affects.MEASURED | Affects.RUN] = None
    """How the recorded commands of a model step's control steps become one action. sum: deltas. mean: velocities. last:
    absolute targets. Must be given unless `stride` is 1."""
    frames: Annotated[int, Field(ge=2, le=256), Affects.CLIPS] = 16
    """Frames of a clip, one per model step."""
    stride: Annotated[PositiveInt | Literal["auto"], Affects.CLIPS | Affects.PLAN] = 4
    """Control steps per model step. Unsettled for the released weights: 4, 8 and 15 are candidates. auto: before the
    first step the model chooses among `stride_candidates` by its prediction error over persistence."""
    start_every: Annotated[PositiveInt, Affects.LATENTS | Affects.RUN] = 1
    """Clips start at multiples of this many control steps, counted from the first step of their episode that
    `data.idle` keeps. With the stride's own number, only every stride-th frame is ever needed: a small latent cache."""
    stride_candidates: Annotated[Annotated[tuple[PositiveInt, ...], Field(min_length=1)] | None, Affects.RUN] = None
    """Strides that `auto` and `data calibrate` evaluate; null: 4, 8, 15 at 15 control steps per second, scaled to
    others."""
    validation_share: Annotated[Share, Affects.RUN] = 0.05
    """Share of the episodes held out for validation, chosen by a hash of the episode's identity."""
    test_share: Annotated[Share, Affects.RUN] = 0.05
    """Share of the episodes held out for `evaluate`, likewise; never seen in training nor in validation."""
    split_by: Annotated[Annotated[str, Field(max_length=500), AfterValidator(_split_by)] | None, Affects.RUN] = None
    """What keeps related episodes in one split, so that training reveals nothing about held-out ones: a field (lab, day
    or folder, as the identity says; task, scene, building, operator or day where the data set does), or a regular
    expression with one group, which is searched in the identity. null: each episode is drawn independently."""
    outcome: Annotated[Literal["all", "success", "failure"], Affects.INDEX | Affects.RUN] = "all"
    """Which demonstrations are used, if the data set records success and failure."""
    idle: Annotated[IdleConfig, Affects.IDLE | Affects.LATENTS | Affects.RUN] = IdleConfig()
    """Which steps are excluded because the robot stands still."""
    short_episodes: Annotated[Literal["skip", "error"], Affects.RUN] = "skip"
    """What to do with episodes shorter than a clip: skip them and report how many, or stop."""
    broken_episodes: Annotated[Literal["error", "skip"], Affects.NOTHING] = "error"
    """What to do with an episode that cannot be read: stop and name it, or leave its clips out, name and count it, and
    stop when more than 1 % of the episodes are broken."""
    exclude: Annotated[tuple[str, ...], Affects.NOTHING] = ()
    """Identities of episodes to leave out, as errors name them."""
    pose_frame: Annotated[Literal["base", "camera"], Affects.INDEX | Affects.CLIPS] = "base"
    """Frame of the poses: the robot's base (the released recipe), or the camera, where its extrinsics are known."""
    crop: Annotated[Literal["released", "square", "letterbox"], Affects.CLIPS | Affects.PLAN] = "released"
    """How a frame that is not square is cropped. released: its centre, 1.35 times as wide as high at most, squashed.
    square: its central square (upstream's evaluation). letterbox: all of it, with black bars."""
    augment: Annotated[AugmentConfig, Affects.RUN] = AugmentConfig()
    """Random changes of training clips."""
    cache: Annotated[Literal["off", "auto", "require"], OFF, Affects.RUN] = "off"
    """Whether the frozen encoder's latents are cached on disk, so that each frame is encoded once. off: no. auto: those
    that are not there yet are encoded before the first step. require: refuse to start where they are not there."""
    cache_dtype: Annotated[Literal["bf16", "fp32", "int8"], Affects.LATENTS | Affects.RUN] = "bf16"
    """Storage type of latents: bf16; fp32, which takes twice as much room; int8 with a scale per token, half."""
    cache_dir: Annotated[Local | None, Affects.NOTHING] = None
    """Folder for latent caches, one folder in it for each; null: `latents` in the folder of `disk_cache`."""
    check_crc: Annotated[Literal["once", "always", "never"], Affects.NOTHING] = "once"
    """When the CRC-32C of a local TFRecord's data is checked: the first time that it is read on this machine, every
    time, or never. The CRC of a record's length is always checked. Likewise the CRC-32 of cached latents, frame by
    frame; once is then once for each process."""
    disk_cache: Annotated[DiskCacheConfig, Affects.NOTHING] = DiskCacheConfig()
    """The cache on this machine."""
    workers: Annotated[int, Field(ge=0, le=256), Affects.NOTHING] = 4
    """Loader processes; 0 loads in the training process. The data does not depend on it."""
    prefetch: Annotated[PositiveInt, Affects.NOTHING] = 2
    """Batches that each loader process prefetches."""
    connections: Annotated[int, Field(ge=1, le=256), Affects.NOTHING] = 16
    """Concurrent reads per process, for remote data."""

    @model_validator(mode="after")
    def _parts_fit(self) -> DataConfig:
        known = self.known_cameras
        if not self.cameras:
            raise ValueError("camera: an empty list; name one or more, or null for the source's first")
        for camera in self.cameras:
            if known is not None and camera not in known:
                raise ValueError(
                    f"camera {camera!r} is not one of the cameras of source {self.source}: {', '.join(known)}"
                )
        if self.source == "latents" and isinstance(self.stride, str):
            raise ValueError("stride auto: a latent cache has one stride; give its number")
        if self.source == "latents" and (self.cache != "off" or is_url(self.path)):
            raise ValueError("source latents is itself a cache, in a folder on this machine: set cache: off")
        if self.augment.is_on and (self.source == "latents" or self.cache != "off"):
            raise ValueError("augment changes frames, and latents that are cached are of unchanged ones: choose one")
        if self.validation_share + self.test_share >= 1.0:
            raise ValueError("validation_share and test_share leave nothing to train on")
        if self.pose_frame == "camera" and self.source in {"rlds", "lerobot"}:
            raise ValueError(f"pose_frame camera needs camera poses, which a source of {self.source} does not have")
        return self

    @model_validator(mode="after")
    def _vectors_fit(self) -> DataConfig:
        pose_only = {
            "source droid_raw": self.source == "droid_raw",
            "pose_frame camera": self.pose_frame == "camera",
            "idle.rule motion": self.idle.rule == "motion",
            "fields.gripper": self.fields.gripper != "closedness",
            "lerobot.rotation": self.lerobot.rotation != "euler_xyz",
            "lerobot.gripper_open and gripper_closed": (self.lerobot.gripper_open, self.lerobot.gripper_closed)
            != (0, 1),
        }
        asked = [name for name, is_asked in pose_only.items() if is_asked]
        if self.states == "vector" and asked:
            raise ValueError(f"{', '.join(asked)}: a matter of poses, and states is vector")
        if self.actions == "recorded" and self.states == "pose":
            raise ValueError("actions recorded needs states vector: the action of a pose is its difference to the next")
        if self.actions == "recorded" and self.stride != 1 and self.join_actions is None:
            raise ValueError(
                f"actions recorded at stride {self.stride}: a model step has a command for each of its control steps;"
                " set join_actions to sum (deltas), mean (velocities) or last (absolute targets)"
            )
        if self.actions != "recorded" and self.join_actions is not None:
            raise ValueError("join_actions belongs to actions recorded")
        return self

    @property
    def known_cameras(self) -> tuple[str, ...] | None:
        """The cameras known from the config, or None if only the data set knows them."""
        return {"rlds": tuple(self.fields.cameras), "lerobot": tuple(self.lerobot.cameras)}.get(self.source)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that clips are drawn from, one or more."""
        if self.camera is None:
            first = {"droid_raw": RAW_CAMERAS[0], "npz": "frames", "latents": "all"}
            return (first[self.source],) if self.known_cameras is None else self.known_cameras[:1]
        return (self.camera,) if isinstance(self.camera, str) else self.camera

    @property
    def own_section(self) -> dict[str, Section]:
        """The section of this form of data, by its name; none where it has no knobs of its own."""
        name = {"rlds": "fields", "droid_raw": "droid_raw", "lerobot": "lerobot"}.get(self.source)
        return {} if name is None else {name: getattr(self, name)}

    @property
    def takes_latents(self) -> bool:
        """Whether clips come from a latent cache, so that the encoder is not needed beside the predictor."""
        return self.source == "latents" or self.cache != "off"

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

    def strides_to_try(self, control_rate_hz: float) -> tuple[int, ...]:
        """Return the candidate strides at a control rate."""
        if self.stride_candidates is not None:
            return self.stride_candidates
        return tuple(sorted({max(1, round(stride * control_rate_hz / 15)) for stride in _STRIDES_AT_15_HZ}))

    def with_stride(self, stride: int) -> DataConfig:
        """Return the config with a calibrated stride."""
        return self.model_copy(update={"stride": stride})
