"""Pre-train the tiny encoder on simulated frames.

pixels: the encoder predicts the normalised pixels of masked patches (He et al. 2022, arXiv 2111.06377, but with mask
tokens in the encoder, as in SimMIM, arXiv 2111.09886). latents: it predicts the latents that a moving average of itself
computes for masked patches (V-JEPA 2, arXiv 2506.09985, but for single frames and without a separate predictor). The
frames show other scenes than those of the base model and of the experiments, with cameras on more sides.
"""

from __future__ import annotations

import copy
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import interpolate, l1_loss, mse_loss

from vjepa2_ac import read_clips
from vjepa2_ac.config import RldsData
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.transforms import pixels_to_input
from vjepa2_ac.model.predictor import normalise_latents
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.simulation.domains import DomainRanges
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset

SCENES = DomainRanges(
    azimuth_deg=(-20.0, 150.0),
    elevation_deg=(15.0, 45.0),
    distance_m=(1.1, 1.6),
    look_at_jitter_m=0.05,
    base_yaw_deg=(-60.0, 60.0),
    light_elevation_deg=(30.0, 80.0),
    textures=True,
)
RECORDINGS = (  # specification, number of episodes, frames per clip, stride
    (RecordingSpec(SCENES, steps=21, seed=101), 1_600, 5, 4),
    (RecordingSpec(SCENES, steps=41, seed=102, task="push"), 400, 8, 5),
    (RecordingSpec(SCENES, steps=41, seed=103, task="pick"), 400, 8, 5),
)
STEPS, BATCH, RATE, WARMUP, DECAY = 12_000, 64, 1e-3, 200, 0.04
MASKED, LARGEST_BLOCK = 0.6, 3  # smallest masked fraction of the patches, and largest side of a masked block
AVERAGE = 0.99  # of the weights of the target encoder, at the start; it rises to 1
HELD_OUT, REPORT_EVERY = 256, 200


def read_frames(folder: Path, size: int) -> UInt8[Tensor, "frames 3 size size"]:
    """Return the frames of all recordings in random order, after recording those that are missing."""
    parts = []
    for spec, episodes, num_frames, stride in RECORDINGS:
        path = folder / (spec.task or "reach")
        if not path.exists():
            print(f"recording {path}", flush=True)
            record_dataset(path, spec, episodes=episodes, workers=os.cpu_count() or 1)
        data = RldsData(
            path=str(path), frames=num_frames, stride=stride, validation_share=0.0, test_share=0.0, workers=0
        )
        for batch in read_clips(open_dataset(data), clips=3 * episodes, batch_size=16):
            assert batch.frames is not None, "no latent cache"
            pixels = rearrange(batch.frames, "clips time h w c -> (clips time) c h w").float()
            small = interpolate(pixels, size=(size, size), mode="bilinear", align_corners=False, antialias=False)
            parts.append(small.round().clamp(0, 255).to(torch.uint8))
    frames = torch.cat(parts)
    return frames[torch.from_numpy(np.random.default_rng(0).permutation(len(frames)))]


class MaskedEncoder(nn.Module):
    """An encoder that predicts the content of masked patches.

    Args:
        model: The model whose encoder is trained.
        outputs: Width of a prediction: that of a latent, or the number of pixel values of a patch.
    """

    def __init__(self, model: WorldModel, outputs: int) -> None:
        super().__init__()
        width = model.latent_dim
        self.vit: Any = model.loaded_encoder.vit.requires_grad_()
        self.mask_token = nn.Parameter(0.02 * torch.randn(width))
        self.head = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, outputs))

    def forward(
        self, frames: Float[Tensor, "batch 3 size size"], masks: Bool[Tensor, "batch patches"]
    ) -> Float[Tensor, "batch patches outputs"]:
        """Return a prediction for every patch; the encoder receives the mask token in place of masked patches."""
        predicted: Tensor = self.head(encode(self.vit, frames, masks, self.mask_token))
        return predicted


def encode(
    vit: Any,
    frames: Float[Tensor, "batch 3 size size"],
    masks: Bool[Tensor, "batch patches"] | None = None,
    mask_token: Tensor | None = None,
) -> Float[Tensor, "batch patches dim"]:
    """Return the features of frames, optionally with some patches replaced by the mask token."""
    tokens = vit.embeddings(frames[:, None].expand(-1, 2, -1, -1, -1))
    if masks is not None and mask_token is not None:
        tokens = torch.where(masks[..., None], mask_token, tokens)
    for layer in vit.layer:
        tokens = layer(tokens, None)[0]
    return vit.layernorm(tokens)


def pretrain(model: WorldModel, frames: UInt8[Tensor, "frames 3 size size"], objective: str, seed: int) -> None:
    """Train the encoder of a model in place."""
    torch.manual_seed(seed)
    patch, side = model.sizes.patch_size, model.image_size // model.sizes.patch_size
    student = MaskedEncoder(model, model.latent_dim if objective == "latents" else 3 * patch**2)
    target = copy.deepcopy(student.vit).requires_grad_(False)
    optimizer = torch.optim.AdamW(student.parameters(), lr=RATE, weight_decay=DECAY, betas=(0.9, 0.95))
    held_out, frames = frames[:HELD_OUT], frames[HELD_OUT:]
    rng, started = np.random.default_rng(seed), time.monotonic()
    for step in range(1, STEPS + 1):
        cosine = 0.5 + 0.5 * math.cos(math.pi * step / STEPS)
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1.0, step / WARMUP) * cosine
        batch = _normalised(frames[torch.from_numpy(rng.integers(len(frames), size=BATCH))], model.image_size)
        masks = torch.from_numpy(np.stack([draw_mask(rng, side) for _ in range(BATCH)]))
        predicted = student(batch, masks)[masks]
        if objective == "latents":
            with torch.no_grad():
                true = normalise_latents(encode(target, batch))[masks]
            loss = l1_loss(predicted, true)
        else:
            loss = mse_loss(predicted, _patch_pixels(batch, patch)[masks])
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(student.parameters(), 1.0)
        optimizer.step()
        _update_average(target, student.vit, 1.0 - (1.0 - AVERAGE) * cosine)
        if step % REPORT_EVERY == 0:
            with torch.no_grad():
                features = normalise_latents(encode(student.vit, _normalised(held_out, model.image_size)))
            spread = float(features.std(dim=0).mean())  # 0: collapsed, all frames have the same features
            print(
                f"step {step}: loss {loss:.4f}, std over frames {spread:.3f}, {time.monotonic() - started:.0f} s",
                flush=True,
            )
    if objective == "latents":
        student.vit.load_state_dict(target.state_dict())
    student.vit.requires_grad_(False)


def draw_mask(rng: np.random.Generator, side: int) -> Bool[np.ndarray, " patches"]:
    """Return a mask of rectangles that cover at least `MASKED` of the patches."""
    mask = np.zeros((side, side), dtype=bool)
    while mask.mean() < MASKED:
        height, width = rng.integers(1, LARGEST_BLOCK + 1, size=2)
        top, left = rng.integers(0, side - height + 1), rng.integers(0, side - width + 1)
        mask[top : top + height, left : left + width] = True
    return mask.reshape(-1)


def _normalised(frames: UInt8[Tensor, "batch 3 size size"], size: int) -> Float[Tensor, "batch 3 size size"]:
    return pixels_to_input(rearrange(frames, "b c h w -> 1 b h w c"), size)[0]


def _patch_pixels(frames: Float[Tensor, "batch 3 size size"], patch: int) -> Float[Tensor, "batch patches values"]:
    """Return the pixels of each patch, normalised by their mean and standard deviation."""
    values = rearrange(frames, "b c (r p) (s q) -> b (r s) (c p q)", p=patch, q=patch)
    return (values - values.mean(-1, keepdim=True)) / (values.var(-1, keepdim=True) + 1e-2).sqrt()


@torch.no_grad()
def _update_average(average: nn.Module, module: nn.Module, weight: float) -> None:
    for old, new in zip(average.parameters(), module.parameters(), strict=True):
        old.lerp_(new, 1.0 - weight)
