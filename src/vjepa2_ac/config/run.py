"""The complete config of a run, and the replay section."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from vjepa2_ac.config.data import DataConfig, source_of
from vjepa2_ac.config.model import AdapterConfig, ModelConfig
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.config.section import Affects, Section
from vjepa2_ac.config.sources import RldsData  # noqa: F401 - registers all data formats
from vjepa2_ac.config.training import CheckpointConfig, DecoderConfig, TrackingConfig, TrainingConfig, ValidationConfig
from vjepa2_ac.storage import paths


def _run_folder(path: str) -> str:
    try:
        return paths.resolve_local_path(path)
    except ValueError as error:
        if not paths.is_url(path):
            raise
        raise ValueError(f"{error}. To copy the run there during training, set checkpoint.remote") from None


class ReplayConfig(Section):
    """A second data set whose clips are mixed into training to reduce forgetting.

    Use for example the training data of the base model, or data with diverse motion. Validation, evaluation and
    planning use the first data set only.
    """

    share: Annotated[float, Field(gt=0.0, lt=1.0), Affects.RUN] = 0.25
    """Share of the training clips that come from the replay data set, evenly spread over the run."""
    data: Annotated[DataConfig, Affects.RUN]
    """The replay data set: `path`, and the keys that differ from `data`. All other keys are inherited from `data`,
    except `exclude`, and `camera` if the source differs. Frames per clip, kind of states and actions, and use of a
    latent cache must be the same as in `data`. Only the training split is used; `workers` is ignored."""

    def find_mismatches(self, first: DataConfig) -> list[str]:
        """Return why clips of both data sets cannot be in one micro-batch, according to the two configs."""
        lines = [
            f"replay.data.{name} {replayed} differs from data.{name} {value}"
            for name in ("frames", "states", "actions", "join_actions", "pose_frame")
            if (replayed := getattr(self.data, name)) != (value := getattr(first, name))
        ]
        if self.data.uses_cached_latents != first.uses_cached_latents:
            lines.append("only one of data and replay.data uses cached latents. Set the same value of cache in both")
        if "auto" in (first.stride, self.data.stride):
            lines.append(
                "stride: auto is not possible with replay. Set numbers that give both data sets equal model steps"
            )
        return lines


class Config(Section):
    """A complete run."""

    run_dir: Annotated[str, AfterValidator(_run_folder), Affects.NOTHING]
    """Local folder of the run: resolved config, checkpoints, metrics. `checkpoint.remote` keeps a copy."""
    seed: Annotated[int, Field(ge=0, lt=2**31), Affects.RUN | Affects.PLAN] = 0
    """Seed of the order of clips, new weights, dropout and the planner's samples."""
    plugins: Annotated[tuple[str, ...], Affects.NOTHING] = ()
    """Your modules, imported before the config is validated: they register data formats, transforms, losses, planners,
    metrics, energies and trackers (docs/extending.md). Plug-ins of installed packages need not be listed."""
    data: DataConfig
    """The data set and the clips made from it."""
    replay: ReplayConfig | None = None
    """A second data set for a share of the training clips; null: none."""
    model: ModelConfig
    """Which world model to start from."""
    adapter: Annotated[AdapterConfig, Affects.RUN] = AdapterConfig()
    """What is trained."""
    training: Annotated[TrainingConfig, Affects.RUN] = TrainingConfig()
    """Optimization, losses and computation."""
    validation: Annotated[ValidationConfig, Affects.RUN] = ValidationConfig()
    """Validation before the first step and during training."""
    checkpoint: Annotated[CheckpointConfig, Affects.NOTHING] = CheckpointConfig()
    """Checkpoints, and their copies on remote storage."""
    tracking: Annotated[TrackingConfig, Affects.NOTHING] = TrackingConfig()
    """Experiment trackers that receive the metrics."""
    planning: Annotated[PlanningConfig, Affects.PLAN] = PlanningConfig()
    """How actions are planned with the trained model; training does not use it."""
    decoder: Annotated[DecoderConfig, Affects.NOTHING] = DecoderConfig()
    """The decoder of `vjepa2-ac decoder`; training does not use it."""

    @model_serializer(mode="wrap")
    def _shorten_replay(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Write the keys of `replay.data` that differ from those of `data`, with its source and path."""
        values: dict[str, Any] = handler(self)
        if values.get("replay") and values.get("data"):
            second = values["replay"]["data"]
            inherited = _inherited(values["data"], second) | {"source": None, "path": None}
            if not second["exclude"]:
                inherited["exclude"] = second["exclude"]
            values["replay"] = {**values["replay"], "data": _differences(inherited, second)}
        return values

    @model_validator(mode="after")
    def _parts_fit(self) -> Config:
        training, adapter, model, best = self.training, self.adapter, self.model, self.checkpoint.keep_best
        predictor, steps, lora = model.sizes.predictor, training.rollout_steps, adapter.kind == "lora"
        is_fp32, is_compiled = training.precision == "fp32", training.compile != "off" and lora
        # A CUDA graph would repeat the same dropout masks, and the same loss scale of fp16.
        draws_or_scales = training.precision == "fp16" or adapter.dropout > 0
        has_patience, is_ranked = training.patience is not None, self.validation.ranking_clips > 0
        unusable = [name for name in ("targets", "modules_to_save") if "state_encoder" in getattr(adapter, name)]
        unusable = unusable if lora and not predictor.use_states else []
        without_cameras = [data.source for data in self.data_sets if not data.has_camera_poses]
        mismatches = [] if self.replay is None else self.replay.find_mismatches(self.data)
        return self.check_rules(
            (steps >= self.data.frames, f"training.rollout_steps {steps} needs data.frames of at least {steps + 1}"),
            (
                model.is_random and lora,
                "model.base: random needs adapter.kind: none, because all weights must be trained",
            ),
            (is_fp32 and model.dtype != "float32", "training.precision fp32 needs model.dtype float32"),
            (
                is_compiled and adapter.dora,
                "training.compile: blocks does not support adapter.dora. Turn one of them off",
            ),
            (training.cuda_graph and draws_or_scales, "training.cuda_graph needs adapter.dropout 0, and bf16 or fp32"),
            (best == "ranking" and not is_ranked, "checkpoint.keep_best ranking needs validation.ranking_clips"),
            (
                best == "off" and has_patience,
                "training.patience needs checkpoint.keep_best: ranking or error, and it is off",
            ),
            (
                predictor.use_extrinsics and without_cameras,
                f"predictor.use_extrinsics needs camera poses, not in source {without_cameras}",
            ),
            (unusable, f"adapter.{' and '.join(unusable)}: with predictor.use_states: false there is no state_encoder"),
            (mismatches, "; ".join(mismatches)),
        )

    @property
    def data_sets(self) -> tuple[DataConfig, ...]:
        """The data set and, if configured, the replay data set."""
        return (self.data,) if self.replay is None else (self.data, self.replay.data)

    def with_stride(self, stride: int) -> Config:
        """Return the config with a calibrated stride."""
        return self.model_copy(update={"data": self.data.with_stride(stride)})

    def for_replay(self) -> Config:
        """Return the config of a run on the data set of `replay` alone.

        Raises:
            ValueError: There is no replay data set.
        """
        if self.replay is None:
            raise ValueError("the config has no replay data set")
        return self.model_copy(update={"data": self.replay.data, "replay": None})


def with_complete_replay(values: dict[str, Any]) -> dict[str, Any]:
    """Return the plain values of a config, with `replay.data` completed by the keys that it inherits from `data`."""
    data, replay = values.get("data"), values.get("replay")
    if not (isinstance(data, dict) and isinstance(replay, dict) and isinstance(second := replay.get("data"), dict)):
        return values
    return {**values, "replay": {**replay, "data": _merged(_inherited(data, second), second)}}


def _inherited(data: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of `data` that the replay data set inherits."""
    dropped = {"path", "exclude"}
    source = second.get("source", source_of(data))
    if source != source_of(data):
        kind = DataConfig.kinds.get(source_of(data), DataConfig)
        dropped |= {"source", "camera", *kind.format_sections()}
    return {key: value for key, value in data.items() if key not in dropped}


def _merged(base: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of both mappings; `other` overrides `base`, and sections are merged key by key."""
    sections = {key for key in base.keys() & other if isinstance(base[key], dict) and isinstance(other[key], dict)}
    return {**base, **other, **{key: {**base[key], **other[key]} for key in sections}}


def _differences(base: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that differ from `base`, also within sections: the inverse of `_merged`."""
    differing = {}
    for key, value in values.items():
        base_value = base.get(key)
        if isinstance(value, dict) and isinstance(base_value, dict):
            if inner := {
                name: item for name, item in value.items() if name not in base_value or item != base_value[name]
            }:
                differing[key] = inner
        elif key not in base or value != base_value:
            differing[key] = value
    return differing
