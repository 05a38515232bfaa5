"""Config of the model: the base model, and which parts of it are trained."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, model_validator

from vjepa2_ac.config.section import Affects, PositiveInt, Section, Share
from vjepa2_ac.storage import paths

# Limits far above the released model (width 1408, depth 40, 1.3 billion weights), as protection from damaged and
# malicious files.
Width = Annotated[int, Field(ge=1, le=16_384)]
Depth = Annotated[int, Field(ge=1, le=512)]
Heads = Annotated[int, Field(ge=1, le=1_024)]
Ratio = Annotated[float, Field(gt=0.0, le=64.0)]
VectorWidth = Annotated[int, Field(ge=1, le=4_096)]
_MAX_TOKENS_PER_FRAME = 65_536
_MAX_WEIGHTS = 10**10  # 40 GB in float32
_MAX_TARGETS = 4_096
_STATE_DIM = 7  # position, rotation, gripper
_DEFAULT_ALPHA = 32.0  # in all configs of the package, at any rank


Family = Literal["v2", "v2.1"]
FramePath = Literal["tubelet", "image"]
EncoderKey = Literal["ema_encoder", "target_encoder", "encoder"]

RANDOM = "random"
"""The value of `model.base` for a new predictor; write a folder of this name as `./random`."""


class _EncoderShape(Section):
    """Sizes of an encoder, in configs and in model files; the defaults are those of ViT-g/16."""

    width: Width = 1408
    """Embedding width, the number of values per latent."""
    depth: Depth = 40
    """Number of transformer blocks."""
    heads: Heads = 22
    """Number of attention heads; width / heads is the size of a head."""


class _PredictorShape(Section):
    """Sizes and inputs of a predictor, in configs and in model files; the defaults are those of the released model."""

    width: Width = 1024
    """Embedding width, the number of values per token."""
    depth: Depth = 24
    """Number of transformer blocks."""
    heads: Heads = 16
    """Number of attention heads."""
    use_extrinsics: bool = False
    """Whether each time step has the camera pose as an additional input token."""
    use_states: bool = True
    """Whether each time step has the state as an input token. false: for a robot whose states are not calibrated; the
    states of the data may then have any width."""


class EncoderSizes(_EncoderShape):
    """Sizes of the frozen video encoder; the defaults are those of V-JEPA 2's ViT-g/16."""

    mlp_ratio: Ratio = 48 / 11
    """Hidden width of the MLP over the width."""
    family: Family = "v2"
    """V-JEPA 2, or 2.1, which has other rotary positions and a learned vector for the kind of input."""
    frame: FramePath = "tubelet"
    """How a frame is encoded. tubelet: as a video of two equal frames, as for all published predictors. image (only
    family v2.1): as one image, with the patch embedding for images."""


class PredictorSizes(_PredictorShape):
    """Sizes of the action-conditioned predictor; the defaults are the released ones."""

    mlp_ratio: Ratio = 4.0
    """Hidden width of the MLP over the width."""
    action_dim: VectorWidth = 7
    """Width of an action. If the data have another width, the action encoder is replaced by a new one."""
    state_dim: VectorWidth = _STATE_DIM
    """Width of a state. If the data have another width, the state encoder is replaced by a new one."""

    @model_validator(mode="after")
    def _widths_are_used(self) -> PredictorSizes:
        is_broken = not self.use_states and self.state_dim != _STATE_DIM
        return self.check_rules(
            (is_broken, f"state_dim {self.state_dim} has no effect with use_states: false. Remove it")
        )


class ModelSizes(Section):
    """Sizes of a world model, as in its file. The defaults are those of V-JEPA 2-AC ViT-g/16 at 256 px."""

    image_size: Annotated[int, Field(ge=1, le=8_192)] = 256
    """Height and width of a frame in pixels; a multiple of patch_size."""
    patch_size: PositiveInt = 16
    """Height and width of a patch in pixels."""
    encoder: EncoderSizes = EncoderSizes()
    """The frozen encoder."""
    predictor: PredictorSizes = PredictorSizes()
    """The predictor."""

    @property
    def tokens_per_frame(self) -> int:
        """The number of patches per frame."""
        return (self.image_size // self.patch_size) ** 2

    @property
    def narrow_predictor_warning(self) -> str | None:
        """The warning for training from scratch if the predictor cannot start near persistence, otherwise None."""
        if self.predictor.width >= self.encoder.width:
            return None
        return (
            f"model.base: random: a predictor of width {self.predictor.width} cannot copy latents of width"
            f" {self.encoder.width}, so that it starts with a random part of them. A predictor of width"
            f" {self.encoder.width} starts near persistence"
        )

    @model_validator(mode="after")
    def _sizes_divide(self) -> ModelSizes:
        image, patch = self.image_size, self.patch_size
        is_v2, as_image = self.encoder.family == "v2", self.encoder.frame == "image"
        self.check_rules(
            (image % patch, f"image_size {image} is not a multiple of patch_size {patch}"),
            (is_v2 and as_image, "encoder.frame: image needs V-JEPA 2.1. Set encoder.frame: tubelet"),
            (not is_v2 and image == patch, "image_size of one patch: V-JEPA 2.1 needs a grid of two patches or more"),
        )
        for name, part in (("encoder", self.encoder), ("predictor", self.predictor)):
            head, rest = divmod(part.width, part.heads)
            self.check_rules(
                (rest, f"{name}.width {part.width} is not a multiple of {name}.heads {part.heads}"),
                (
                    head < 6 or head % 2,
                    f"{name}: width / heads is {head}, and 3D RoPE needs an even number of at least 6",
                ),
                (part.width * part.mlp_ratio < 1, f"{name}.mlp_ratio {part.mlp_ratio} makes the MLP narrower than 1"),
            )
        return self

    @model_validator(mode="after")
    def _sizes_are_limited(self) -> ModelSizes:
        parts, tokens = (self.encoder, self.predictor), self.tokens_per_frame
        weights = sum(part.depth * part.width**2 * (4 + 2 * part.mlp_ratio) for part in parts)
        weights += 6 * self.patch_size**2 * self.encoder.width  # patch embedding of 3 colours and 2 frames
        return self.check_rules(
            (
                tokens > _MAX_TOKENS_PER_FRAME,
                f"image_size: {tokens:,} tokens per frame, more than {_MAX_TOKENS_PER_FRAME:,}",
            ),
            (
                weights > _MAX_WEIGHTS,
                f"encoder and predictor have {weights:.2g} weights, more than {_MAX_WEIGHTS:.0e}",
            ),
        )


class EncoderSizesConfig(_EncoderShape):
    """Sizes of a random encoder. For an official `.pt` only `heads` is used."""


class PredictorSizesConfig(_PredictorShape):
    """Sizes of a new predictor. For an official `.pt` only `heads` and `use_extrinsics` are used."""


class SizesConfig(Section):
    """Sizes of a new world model. The defaults are those of V-JEPA 2-AC ViT-g/16 at 256 px."""

    image_size: Annotated[int, Field(ge=1, le=8_192)] = 256
    """Height and width of a frame in pixels; a multiple of 16, the patch size."""
    encoder: EncoderSizesConfig = EncoderSizesConfig()
    """The frozen encoder."""
    predictor: PredictorSizesConfig = PredictorSizesConfig()
    """The predictor."""

    @property
    def model_sizes(self) -> ModelSizes:
        """All sizes, with the MLP ratios of the published models. States and actions have the widths of poses."""
        released = EncoderSizes()
        ratio = released.mlp_ratio if self.encoder.width == released.width else 4.0
        encoder = EncoderSizes(mlp_ratio=ratio, **self.encoder.model_dump())
        predictor = PredictorSizes(**self.predictor.model_dump())
        return ModelSizes(image_size=self.image_size, encoder=encoder, predictor=predictor)

    @model_validator(mode="after")
    def _fit_together(self) -> SizesConfig:
        try:
            _ = self.model_sizes
        except ValidationError as error:
            raise ValueError(error.errors()[0]["msg"].removeprefix("Value error, ")) from None
        return self


class EncoderConfig(Section):
    """A pre-trained encoder, for a base model without an encoder."""

    path: Annotated[str, AfterValidator(paths.resolve_encoder_path), Affects.PLAN]
    """Meta's `.pt` of V-JEPA 2 or 2.1 (`vjepa2-ac download --list`), a transformers folder, `hf://owner/name` or
    `hf://owner/name@revision` for such a folder on the Hub, or the folder of a model of this project. A run can resume
    after the path was changed, because the fingerprint of the weights is compared."""
    key: EncoderKey | None = None
    """Which encoder of a `.pt` is loaded; null: the first of these that the file contains. The file of a trained
    predictor records the key of its encoder."""
    frame: FramePath = "tubelet"
    """How a frame is encoded. tubelet: as a video of two equal frames, as for all published predictors. image (only
    V-JEPA 2.1): as one image, with the patch embedding for images."""
    heads: Heads | None = None
    """Number of attention heads, for an encoder whose width is not that of a published model; null: as in the published
    model of the same width."""
    layer: Depth | None = None
    """The block whose output is used as features; null: the last. Features of earlier blocks (at two thirds of the
    depth) contained more information about motion (docs/encoders.md) and cost less. They are normalised without the
    weights of the last norm."""


class ModelConfig(Section):
    """Which world model to start from."""

    base: Annotated[str, AfterValidator(paths.resolve_model_path), Affects.PLAN]
    """The base model: the official `.pt`, a folder written by `save_pretrained`, or `builtin:sim-tiny` (the tiny model
    of the demo, which is part of the package). A run can resume after the path was changed, because the fingerprint of
    the weights is compared. random: a new predictor with `sizes`, initialised close to persistence, with `encoder` or
    else a random encoder; with `adapter.kind: none` this is training from scratch."""
    encoder: Annotated[EncoderConfig | None, Affects.RUN] = None
    """A pre-trained encoder, for `base: random` or a base model without an encoder; null: the encoder of the base
    model. Family, width, depth and MLP are read from the file."""
    sizes: Annotated[SizesConfig, Affects.RUN | Affects.PLAN] = SizesConfig()
    """The sizes for `base: random`. For an official `.pt` only those that the file does not contain are used: the image
    size, the heads, and whether the camera pose is an input."""
    dtype: Annotated[Literal["float32", "bfloat16"], Affects.LATENTS | Affects.RUN | Affects.PLAN] = "bfloat16"
    """Data type of the frozen weights, and of planning; trained weights are always float32."""

    @property
    def is_random(self) -> bool:
        """Whether the predictor is new, not pre-trained."""
        return self.base == RANDOM

    def with_base(self, name: str) -> ModelConfig:
        """Return this config with another, existing base model."""
        sizes = SizesConfig() if self.is_random else self.sizes
        return self.model_copy(update={"base": name, "encoder": None, "sizes": sizes})


PEFT_NAMES = {  # PEFT's name -> config key
    "r": "rank",
    "lora_alpha": "alpha",
    "lora_dropout": "dropout",
    "target_modules": "targets",
    "modules_to_save": "modules_to_save",
    "use_rslora": "rslora",
    "use_dora": "dora",
}


class AdapterConfig(Section):
    """What is trained: a LoRA adapter on the predictor, or the whole predictor."""

    kind: Literal["lora", "none"] = "lora"
    """lora: low-rank adapter (PEFT). none: all weights of the predictor are trained."""
    rank: Annotated[int, Field(ge=1, le=1024)] = 16
    """Rank of the update of each target layer."""
    alpha: Annotated[float, Field(gt=0.0, le=1e6)] = 32.0
    """Scale of the update: alpha / sqrt(rank) with rsLoRA, alpha / rank without. With rsLoRA use the same alpha at any
    rank; with alpha = 2 x rank the update would grow with the rank."""
    rslora: bool = True
    """Whether the scale is rank-stabilised (rsLoRA, arXiv 2312.03732)."""
    dropout: Share = 0.0
    """Dropout before the adapter's first matrix, in training only. The released recipe and our measurements use none.
    Dropout takes an eighth of the step time on a GPU (estimated), and memory for a mask and a copy of each layer's
    input."""
    targets: Annotated[tuple[str, ...], Field(max_length=_MAX_TARGETS)] = ("q", "k", "v", "o", "fc1", "fc2")
    """Linear layers of the predictor with an adapter, by the last part of their name: the defaults, predictor_embed,
    predictor_proj, action_encoder and state_encoder. Or sets: attention (q, k, v, o), mlp (fc1, fc2), all (every linear
    layer). Or single layers by their full name, such as blocks.0.attn.q."""
    modules_to_save: tuple[Literal["predictor_embed", "predictor_proj", "action_encoder", "state_encoder"], ...] = ()
    """Layers before and after the blocks that are trained directly, without an adapter."""
    dora: bool = False
    """Whether the norm of each row of a weight is trained separately from its direction (DoRA, arXiv 2402.09353)."""
    peft: dict[str, Any] = {}
    """Further options of PEFT's LoraConfig, for example {rank_pattern: {fc1: 32}, init_lora_weights: gaussian}."""

    @model_validator(mode="after")
    def _keeps_the_base_weights(self) -> AdapterConfig:
        initialisation = self.peft.get("init_lora_weights", True)
        duplicates = [
            (True, f"peft.{name}: set adapter.{PEFT_NAMES[name]} instead") for name in self.peft if name in PEFT_NAMES
        ]
        changes_base = initialisation not in (True, False, "gaussian", "orthogonal")
        reason = "changes the base weights, which are not saved. Set true, false, gaussian or orthogonal"
        return self.check_rules(*duplicates, (changes_base, f"peft.init_lora_weights {initialisation!r} {reason}"))

    @property
    def alpha_warning(self) -> str | None:
        """The warning if alpha seems to be raised with the rank although rsLoRA is on, otherwise None."""
        if self.kind != "lora" or not self.rslora or self.alpha < 2 * _DEFAULT_ALPHA:
            return None
        scale, default_scale = (alpha / math.sqrt(self.rank) for alpha in (self.alpha, _DEFAULT_ALPHA))
        return (
            f"adapter.alpha {self.alpha:g} at rank {self.rank} gives a scale of {scale:.3g}; alpha {_DEFAULT_ALPHA:g}"
            f" gives {default_scale:.3g}. With adapter.rslora use the same alpha at every rank; a larger alpha needs a"
            f" lower training.learning_rate. Set adapter.alpha={_DEFAULT_ALPHA:g}, or compare both"
        )
