"""Which knobs are there? Every one, once: its type, range, default and meaning. `config_file` reads them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

PositiveInt = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0.0, lt=1.0)]


class Section(BaseModel):
    """A group of knobs: frozen, and unknown keys are errors."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class RldsFields(Section):
    """Where an RLDS data set keeps what the model needs; the defaults are DROID's."""

    state: tuple[str, ...] = (
        "steps/observation/cartesian_position",
        "steps/observation/gripper_position",
    )
    """Features that give, joined, the 7 numbers of the *measured* state (legend: episode.py)."""
    gripper: Literal["closedness", "openness"] = "closedness"
    """What the last number of the state is: 0 open .. 1 closed (DROID), or 0 closed .. 1 open (BridgeData)."""
    identity: tuple[str, ...] = ("episode_metadata/recording_folderpath", "episode_metadata/file_path")
    """Features that name an episode; the split into train, validation and test is a hash of them."""
    cameras: dict[str, str] = {
        "exterior_1_left": "steps/observation/exterior_image_1_left",
        "exterior_2_left": "steps/observation/exterior_image_2_left",
        "wrist_left": "steps/observation/wrist_image_left",
    }
    """Camera name -> feature with its pictures."""
    language: str | None = "steps/language_instruction"
    """Feature kept in the episode's metadata; the model does not use it."""
    control_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 15.0
    """Control steps per second (RLDS does not say)."""


class DataConfig(Section):
    """Which clips, from where."""

    source: Literal["rlds"] = "rlds"
    """Form of the data set. rlds: TFRecord shards with a dataset_info.json, as TFDS writes them."""
    path: str
    """Folder of the data set (the one with dataset_info.json)."""
    fields: RldsFields = RldsFields()
    """Names of the features in the data set."""
    camera: str = "exterior_1_left"
    """Which of `fields.cameras` the model sees. The released weights saw the left exterior camera."""
    frames: Annotated[int, Field(ge=2, le=256)] = 16
    """Frames of a clip, one per model step."""
    stride: PositiveInt = 4
    """Control steps per model step. Unsettled for the released weights: 4, 8 and 15 are candidates."""
    validation_share: Share = 0.05
    """Share of the episodes held out for validation, chosen by a hash of the episode's identity."""
    test_share: Share = 0.05
    """Share of the episodes held out for `evaluate`, likewise; never seen in training nor in validation."""
    short_episodes: Literal["skip", "error"] = "skip"
    """What to do with episodes shorter than a clip: leave them out and say how many, or stop."""
    exclude: tuple[str, ...] = ()
    """Identities of episodes to leave out, as errors name them."""
    check_crc: bool = True
    """Check the masked CRC-32C of every record that is read."""
    workers: Annotated[int, Field(ge=0, le=256)] = 4
    """Loader processes; 0 loads in the training process. The data does not depend on it."""

    @model_validator(mode="after")
    def _camera_is_mapped(self) -> DataConfig:
        if self.camera not in self.fields.cameras:
            raise ValueError(f"camera {self.camera!r} is not one of fields.cameras: {', '.join(self.fields.cameras)}")
        if self.validation_share + self.test_share >= 1.0:
            raise ValueError("validation_share and test_share leave nothing to train on")
        return self

    @property
    def clip_steps(self) -> int:
        """Control steps that a clip spans, first and last frame included."""
        return (self.frames - 1) * self.stride + 1


class EncoderSizes(Section):
    """Sizes of the frozen video encoder; the defaults are ViT-g/16's."""

    width: PositiveInt = 1408
    """Width of a latent."""
    depth: PositiveInt = 40
    """Transformer blocks."""
    heads: PositiveInt = 22
    """Attention heads; width / heads is the size of a head."""
    mlp_ratio: Annotated[float, Field(gt=0.0)] = 48 / 11
    """Hidden width of the MLP over the width."""


class PredictorSizes(Section):
    """Sizes of the action-conditioned predictor; the defaults are the released ones."""

    width: PositiveInt = 1024
    """Width of a token."""
    depth: PositiveInt = 24
    """Transformer blocks."""
    heads: PositiveInt = 16
    """Attention heads."""
    mlp_ratio: Annotated[float, Field(gt=0.0)] = 4.0
    """Hidden width of the MLP over the width."""
    use_extrinsics: bool = False
    """Whether the camera pose is one more input token per time step."""


class ModelSizes(Section):
    """Sizes of a world model. The defaults are V-JEPA 2-AC ViT-g/16 at 256 px."""

    image_size: PositiveInt = 256
    """Height and width of a frame in pixels; a multiple of patch_size."""
    patch_size: PositiveInt = 16
    """Height and width of a patch in pixels."""
    encoder: EncoderSizes = EncoderSizes()
    """The frozen encoder."""
    predictor: PredictorSizes = PredictorSizes()
    """The predictor."""

    @model_validator(mode="after")
    def _sizes_divide(self) -> ModelSizes:
        if self.image_size % self.patch_size:
            raise ValueError(f"image_size {self.image_size} is not a multiple of patch_size {self.patch_size}")
        for name, part in (("encoder", self.encoder), ("predictor", self.predictor)):
            if part.width % part.heads:
                raise ValueError(f"{name}.width {part.width} is not a multiple of {name}.heads {part.heads}")
            if part.width // part.heads < 6 or (part.width // part.heads) % 2:
                raise ValueError(
                    f"{name}: a head of {part.width // part.heads} does not fit 3D RoPE (even, at least 6)"
                )
        return self


class ModelConfig(Section):
    """Which world model to start from."""

    base: str | None = None
    """The model to adapt: the official `.pt`, a folder written by `save_pretrained`, or `builtin:sim-tiny` (the tiny
    model of the demo, which comes with the package)."""
    random: ModelSizes | None = None
    """Instead of `base`: a fresh model of these sizes; with `adapter.kind: none` that is training from scratch."""
    random_start: Literal["persistence", "released"] = "persistence"
    """How a `random` model begins: close to copying the last frame, or as the released recipe drew its weights."""
    sizes: ModelSizes = ModelSizes()
    """What an official `.pt` cannot say of itself: image size and heads. Everything else is read from its tensors."""
    dtype: Literal["float32", "bfloat16"] = "bfloat16"
    """Type of the frozen weights; what is trained is always float32."""
    encode_chunk: PositiveInt = 16
    """Frames that go through the encoder at once: bounds its memory."""

    @model_validator(mode="after")
    def _one_start(self) -> ModelConfig:
        if (self.base is None) == (self.random is None):
            raise ValueError("give either base (a model to adapt) or random (sizes of a fresh one)")
        return self


class AdapterConfig(Section):
    """What is trained: a LoRA adapter on the predictor, or the whole predictor."""

    kind: Literal["lora", "none"] = "lora"
    """lora: low-rank adapter (PEFT). none: every weight of the predictor is trained."""
    rank: Annotated[int, Field(ge=1, le=1024)] = 16
    """Rank of the update of each target."""
    alpha: Annotated[float, Field(gt=0.0)] = 32.0
    """Scale of the update: alpha / sqrt(rank) with rsLoRA, alpha / rank without."""
    rslora: bool = True
    """Rank-stabilised scale (arXiv 2312.03732)."""
    dropout: Share = 0.05
    """Dropout before the adapter's first matrix, in training only."""
    targets: tuple[str, ...] = ("q", "k", "v", "o", "fc1", "fc2")
    """Linear layers of the predictor that get an adapter, by the last part of their name; besides the defaults:
    predictor_embed, predictor_proj, action_encoder, state_encoder."""


class TrainingConfig(Section):
    """How the weights change."""

    steps: PositiveInt = 100_000
    """Optimizer steps."""
    batch_size: PositiveInt = 2
    """Clips per device and micro-batch."""
    accumulation: PositiveInt = 16
    """Micro-batches per optimizer step."""
    rollout_steps: Annotated[int, Field(ge=1, le=64)] = 2
    """Predictions of the rollout loss; the first is the teacher-forced one, each further one is fed back."""
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 1e-4
    """Peak learning rate."""
    schedule: Literal["cosine", "warmup_stable_decay"] = "cosine"
    """cosine: linear warm-up, then half a cosine. warmup_stable_decay: linear warm-up, constant, linear decay."""
    warmup_steps: Annotated[int, Field(ge=0)] = 1_000
    """Optimizer steps of the linear warm-up."""
    decay_steps: Annotated[int, Field(ge=0)] = 0
    """Optimizer steps of the final decay; warmup_stable_decay only."""
    start_learning_rate: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Where the warm-up starts."""
    final_learning_rate: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Where the schedule ends."""
    weight_decay: Annotated[float, Field(ge=0.0, le=1.0)] = 0.04
    """AdamW's decay; biases and norms are exempt."""
    betas: tuple[Annotated[float, Field(ge=0.0, lt=1.0)], Annotated[float, Field(ge=0.0, lt=1.0)]] = (0.9, 0.999)
    """AdamW's decay rates of the running moments."""
    max_grad_norm: Annotated[float, Field(gt=0.0)] | None = 1.0
    """Gradients are scaled down to this norm; null: never (the released recipe)."""
    precision: Literal["bf16", "fp32"] = "bf16"
    """Arithmetic of the networks (autocast)."""
    gradient_checkpointing: bool = False
    """Compute each predictor block again in the backward pass instead of keeping its activations."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: CUDA where there is one."""
    allow_weak_base: bool = False
    """Train even if the base is no better than persistence (copy the last frame) on the validation clips."""
    log_every: PositiveInt = 10
    """Optimizer steps between lines in metrics.jsonl."""

    @model_validator(mode="after")
    def _schedule_fits(self) -> TrainingConfig:
        if self.warmup_steps + self.decay_steps > self.steps:
            raise ValueError(
                f"warmup_steps {self.warmup_steps} and decay_steps {self.decay_steps} exceed steps {self.steps}"
            )
        if self.decay_steps and self.schedule != "warmup_stable_decay":
            raise ValueError(f"decay_steps belongs to schedule warmup_stable_decay, not {self.schedule}")
        return self


class ValidationConfig(Section):
    """The measurement before the first step and on the way."""

    every: PositiveInt = 1_000
    """Optimizer steps between validations."""
    clips: PositiveInt = 64
    """Clips of held-out episodes, always the same ones."""
    batch_size: Annotated[int, Field(ge=2)] = 4
    """Clips that are evaluated at once."""


class CheckpointConfig(Section):
    """What is kept of a run."""

    every: PositiveInt = 1_000
    """Optimizer steps between checkpoints."""
    keep: PositiveInt = 5
    """How many of the newest checkpoints stay."""


class TrackingConfig(Section):
    """Where figures go, besides metrics.jsonl in the run folder."""

    tensorboard: bool = True
    """Event files in RUN/tensorboard."""


class Config(Section):
    """A complete run."""

    run_dir: str
    """Folder of the run: resolved config, checkpoints, metrics."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    """Decides the order of clips, fresh weights and dropout."""
    data: DataConfig
    """Which clips, from where."""
    model: ModelConfig
    """Which world model to start from."""
    adapter: AdapterConfig = AdapterConfig()
    """What is trained."""
    training: TrainingConfig = TrainingConfig()
    """How the weights change."""
    validation: ValidationConfig = ValidationConfig()
    """The measurement before the first step and on the way."""
    checkpoint: CheckpointConfig = CheckpointConfig()
    """What is kept of a run."""
    tracking: TrackingConfig = TrackingConfig()
    """Where figures go."""

    @model_validator(mode="after")
    def _parts_fit(self) -> Config:
        if self.training.rollout_steps >= self.data.frames:
            raise ValueError(
                f"training.rollout_steps {self.training.rollout_steps} needs data.frames of at least"
                f" {self.training.rollout_steps + 1}, not {self.data.frames}"
            )
        if self.model.random is not None and self.adapter.kind == "lora":
            raise ValueError("model.random with adapter.kind lora would adapt noise; set adapter.kind: none")
        if self.training.precision == "fp32" and self.model.dtype != "float32":
            raise ValueError("training.precision fp32 needs model.dtype float32: bfloat16 weights compute in bfloat16")
        sizes = self.model.random or self.model.sizes
        if sizes.predictor.use_extrinsics:
            raise ValueError("predictor.use_extrinsics needs camera poses, which a data.source of rlds does not have")
        return self
