"""Decoder knobs: the network that turns latents into images, and its training."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from vjepa2_ac.config.section import Affects, Count, Local, Positive, PositiveInt, Section, Share, ZeroToOne

DecoderSize = Literal["tiny", "small", "medium"]


class DecoderConfig(Section):
    """The decoder that `vjepa2-ac decoder` trains: it shows what the encoder's latents hold."""

    folder: Annotated[Local | None, Affects.NOTHING] = None
    """Folder of the decoder; null: `decoder`, beside run_dir. It is made for an encoder and a camera, not for a run."""
    size: DecoderSize = "small"
    """Parameters at the released sizes: tiny 2 M, for small encoders; small 27 M; medium 96 M."""
    frames: PositiveInt = 40_000
    """Frames to learn from, at most, spread over the training episodes; each is encoded once. They take 0.9 MB of disk
    each at the released sizes with data.cache_dtype bf16, 0.6 MB with int8, until training ends."""
    held_out_frames: PositiveInt = 1_000
    """Frames of test episodes, at most, on which the decoder is measured in the end."""
    steps: PositiveInt = 20_000
    """Optimizer steps."""
    batch_size: PositiveInt = 64
    """Frames of a step."""
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 5e-4
    """Peak learning rate; it falls to none by half a cosine."""
    warmup_steps: Count = 500
    """Optimizer steps of the linear warm-up."""
    weight_decay: ZeroToOne = 0.05
    """AdamW's decay; biases and norms are exempt."""
    max_grad_norm: Positive = 1.0
    """Gradients are clipped to this norm."""
    average: Share = 0.999
    """Decay of the moving average of the weights, which is the decoder in the end; 0: the last weights."""
    noise: Annotated[float, Field(ge=0.0, le=2.0)] = 0.0
    """Noise on latents in training, up to this standard deviation. It hides what distinguishes latents; 0: none."""
    checkpoint_every: PositiveInt = 500
    """Steps between checkpoints."""
