"""Will a run fit on the GPU? Its memory, part by part, by arithmetic: no model is built and torch is not needed.

The counts of parameters are exact. What autograd keeps (`training.kept`) is held by a test to what PyTorch really keeps
on a CPU. The whole has not yet been compared with the peak that a GPU measures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.episode import ACTION_DIM, EXTRINSICS_DIM, STATE_DIM
from vjepa2_ac.training.kept import FLOAT32, Kept, Kind, adapted_layers

GIGABYTE = 10**9
ALLOWANCE = 3 * GIGABYTE // 2  # CUDA context 0.5, cuBLAS workspaces, holes between blocks: not computed, allowed for
USUAL_GPU = 24 * GIGABYTE

_TUBELET = 2  # frames that the encoder's first layer takes at once


@dataclass(frozen=True)
class Parameters:
    """How many parameters there are, exactly."""

    encoder: int
    predictor: int
    trained: int  # an adapter's; or the whole predictor


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes on the GPU, part by part. `total` is the largest of three moments: they do not happen at once."""

    parameters: Parameters
    checkpointing: bool  # what the config asks for
    encoder_weights: int
    predictor_weights: int  # frozen; none where the whole predictor is trained
    trained: int
    gradients: int
    moments: int
    latents: int
    encoding: int  # activations of the encoder, for one chunk of frames, and the frames
    teacher_forcing: int
    rollout: int
    losses: int
    cast_cache: int  # bfloat16 copies of trained weights
    checkpointed: int  # all of teacher forcing, rollout and losses, when blocks are computed again
    temporaries: int
    optimizer_temporaries: int

    @property
    def standing(self) -> int:
        """What is there all the time."""
        weights = self.encoder_weights + self.predictor_weights + self.trained
        return weights + self.gradients + self.moments + ALLOWANCE

    def total(self, *, checkpointing: bool) -> int:
        """Return the peak with or without gradient checkpointing."""
        kept = self.checkpointed if checkpointing else self.teacher_forcing + self.rollout + self.losses
        predicting = self.latents + kept + self.cast_cache + self.temporaries
        return self.standing + max(self.latents + self.encoding, predicting, self.optimizer_temporaries)


def estimate_memory(config: Config, sizes: ModelSizes, device: Kind = "cuda") -> MemoryEstimate:
    """Return what a run needs.

    Args:
        config: The run.
        sizes: Sizes of its model, such as `model.load.base_sizes` gives.
        device: Whose rules of what is kept are meant.
    """
    parameters = count_parameters(config, sizes)
    number = 2 if config.model.dtype == "bfloat16" else FLOAT32
    kept = Kept(config, sizes, device)
    return MemoryEstimate(
        parameters=parameters,
        checkpointing=config.training.gradient_checkpointing,
        encoder_weights=parameters.encoder * number,
        predictor_weights=parameters.predictor * number if config.adapter.kind == "lora" else 0,
        trained=parameters.trained * FLOAT32,
        gradients=parameters.trained * FLOAT32,
        moments=2 * parameters.trained * FLOAT32,
        latents=_frames(config) * _tokens_per_frame(sizes) * sizes.encoder.width * FLOAT32,
        encoding=_encoding(config, sizes),
        teacher_forcing=kept.teacher_forcing(),
        rollout=kept.rollout(),
        losses=kept.losses(),
        cast_cache=kept.cast_cache(),
        checkpointed=kept.with_checkpointing(),
        temporaries=_temporaries(config, sizes),
        optimizer_temporaries=parameters.trained * FLOAT32,
    )


def count_parameters(config: Config, sizes: ModelSizes) -> Parameters:
    """Return how many parameters a model of these sizes has, and how many of them the config trains."""
    encoder, predictor = sizes.encoder, sizes.predictor
    patch = 3 * _TUBELET * sizes.patch_size**2
    in_encoder = (patch + 1) * encoder.width + 2 * encoder.width
    in_encoder += encoder.depth * _block(encoder.width, int(encoder.width * encoder.mlp_ratio))
    hidden = int(predictor.width * predictor.mlp_ratio)
    inputs = sum(dim + 1 for dim in (encoder.width, ACTION_DIM, STATE_DIM, EXTRINSICS_DIM)) * predictor.width
    outputs = 2 * predictor.width + (predictor.width + 1) * encoder.width
    in_predictor = inputs + predictor.depth * _block(predictor.width, hidden) + outputs
    if config.adapter.kind == "none":
        idle = 0 if predictor.use_extrinsics else (EXTRINSICS_DIM + 1) * predictor.width  # there, and left alone
        return Parameters(in_encoder, in_predictor, trained=in_predictor - idle)
    ends = {
        "q": 2 * predictor.width, "k": 2 * predictor.width, "v": 2 * predictor.width, "o": 2 * predictor.width,
        "fc1": predictor.width + hidden, "fc2": predictor.width + hidden,
    }  # fmt: skip
    outer = {
        "predictor_embed": encoder.width, "predictor_proj": encoder.width, "action_encoder": ACTION_DIM,
        "state_encoder": STATE_DIM, "extrinsics_encoder": EXTRINSICS_DIM,
    }  # fmt: skip
    targets = adapted_layers(config, sizes)
    rows = predictor.depth * sum(size for name, size in ends.items() if name in targets)
    rows += sum(size + predictor.width for name, size in outer.items() if name in targets)
    return Parameters(in_encoder, in_predictor, trained=config.adapter.rank * rows)


def ways_to_fit(config: Config, sizes: ModelSizes, available: int) -> list[str] | None:
    """Return the knobs to turn, one after the other, until the run fits; None where all of them do not suffice."""
    turned: list[str] = []
    for knob, turn in _KNOBS:
        if _total(config, sizes) <= available:
            break
        lighter = turn(config)
        if _total(lighter, sizes) < _total(config, sizes):
            turned.append(knob)
            config = lighter
    return turned if _total(config, sizes) <= available else None


def _total(config: Config, sizes: ModelSizes) -> int:
    return estimate_memory(config, sizes).total(checkpointing=config.training.gradient_checkpointing)


def _with(config: Config, section: str, **changes: object) -> Config:
    return config.model_copy(update={section: getattr(config, section).model_copy(update=changes)})


_KNOBS: tuple[tuple[str, Callable[[Config], Config]], ...] = (
    ("training.gradient_checkpointing=true", lambda run: _with(run, "training", gradient_checkpointing=True)),
    (
        "training.batch_size=1 (and as much more accumulation)",
        lambda run: _with(run, "training", batch_size=1),
    ),
    (
        "model.dtype=bfloat16 with training.precision=bf16",
        lambda run: _with(_with(run, "model", dtype="bfloat16"), "training", precision="bf16"),
    ),
    ("model.encode_chunk=4", lambda run: _with(run, "model", encode_chunk=min(4, run.model.encode_chunk))),
    (
        "data.frames=8",
        lambda run: _with(run, "data", frames=min(run.data.frames, max(8, run.training.rollout_steps + 1))),
    ),
    ("adapter.kind=lora", lambda run: run if run.model.random else _with(run, "adapter", kind="lora")),
)


def _block(width: int, hidden: int) -> int:
    """Return the parameters of a transformer block: four projections, two norms, two layers of an MLP."""
    return 4 * (width + 1) * width + 4 * width + (width + 1) * hidden + (hidden + 1) * width


def _frames(config: Config) -> int:
    return config.training.batch_size * config.data.frames


def _tokens_per_frame(sizes: ModelSizes) -> int:
    return (sizes.image_size // sizes.patch_size) ** 2


def _encoding(config: Config, sizes: ModelSizes) -> int:
    """Return the bytes that live at once in the larger half of an encoder block, the frames, and the features."""
    width, hidden = sizes.encoder.width, int(sizes.encoder.width * sizes.encoder.mlp_ratio)
    number = 2 if config.training.precision == "bf16" else FLOAT32
    tokens = min(config.model.encode_chunk, _frames(config)) * _tokens_per_frame(sizes)
    attention = width * (4 * number + 5 * FLOAT32)  # residual, query, key, value; normed, and four while rotating
    mlp = width * (2 * number + 2 * FLOAT32) + 2 * hidden * number  # residual and output; normed, cast; around GELU
    frames = _frames(config) * 3 * sizes.image_size**2 * FLOAT32
    features = _frames(config) * _tokens_per_frame(sizes) * width * (number + FLOAT32)  # as computed, and as float32
    return tokens * max(attention, mlp) + frames + features


def _temporaries(config: Config, sizes: ModelSizes) -> int:
    """Return four float32 tensors as wide as the MLP: the adapter's input and gradients at their widest."""
    conditions = 2 + sizes.predictor.use_extrinsics
    tokens = config.training.batch_size * (config.data.frames - 1) * (_tokens_per_frame(sizes) + conditions)
    return 4 * tokens * int(sizes.predictor.width * sizes.predictor.mlp_ratio) * FLOAT32
