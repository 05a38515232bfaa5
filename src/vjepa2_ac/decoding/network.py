"""The decoder: the image of a frame from its latents alone.

It is trained on latents of true frames only, without an adversary, and applied to predictions as it is: where a
prediction is an average of futures, the image is blurred, and that is what it shows.

Source: the idea is that of Assran et al. (2025), V-JEPA 2, appendix B.3; sizes and losses are our own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from einops import rearrange
from einops.layers.torch import Rearrange
from jaxtyping import Float, UInt8
from pydantic import Field
from torch import Generator, Tensor, nn

Latents = Float[Tensor, "*batch tokens dim"]
Images = Float[Tensor, "*batch 3 size size"]  # black 0 to white 1
Size = Literal["linear", "tiny", "small", "medium"]

_MIDDLE, _RANGE = 0.5, 0.25  # of pixels: the network's numbers are about -2 .. 2
_FREQUENCIES = 10_000.0
_STD = 0.02
UPSAMPLED = 4  # the resolution of tokens is doubled twice
_LAST = -2  # of the further layers: the last one with weights


@dataclass(frozen=True)
class DecoderShape:
    """What a decoder is: its size, and the sizes of the encoder that it belongs to."""

    size: Size
    dim: Annotated[int, Field(ge=1, le=1 << 14)]  # of a latent
    grid: Annotated[int, Field(ge=1, le=256)]  # tokens along each side of a frame
    patch_size: Annotated[int, Field(ge=UPSAMPLED, le=64, multiple_of=UPSAMPLED)]  # pixels

    @property
    def image_size(self) -> int:
        """Height and width of an image, in pixels."""
        return self.grid * self.patch_size


# Blocks, their width and heads, and the channels after the first and the second doubling of the resolution.
_SIZES = {"tiny": (2, 128, 4, 64, 32), "small": (6, 512, 8, 256, 128), "medium": (12, 768, 12, 256, 128)}


class Decoder(nn.Module):
    """Turns the latents of a frame into its image, frame by frame.

    `linear` is one matrix: an image patch from each token. The others add to such a matrix attention blocks over the
    tokens of the frame, then convolutions that double the resolution twice and end in patches of a quarter of the patch
    size.
    """

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.shape = shape
        self.linear = nn.Linear(shape.dim, 3 * shape.patch_size**2)
        patches = "n (rows columns) (c p q) -> n c (rows p) (columns q)"
        self.unfold = Rearrange(patches, rows=shape.grid, c=3, p=shape.patch_size)
        self.further = None if shape.size == "linear" else _convolved(shape)

    def initialise(self, generator: Generator) -> None:
        """Draw fresh weights; the generator determines them."""
        for module in self.modules():
            if isinstance(module, nn.Linear | nn.Conv2d):
                fan_in = module.weight[0].numel()
                std = _STD if isinstance(module, nn.Linear) else 1.0 / math.sqrt(fan_in)
                nn.init.trunc_normal_(module.weight, std=std, generator=generator)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    @torch.no_grad()
    def start_from(self, linear: Decoder) -> None:
        """Begin as another decoder's matrix: the further layers add nothing yet."""
        self.linear.load_state_dict(linear.linear.state_dict())
        if self.further is not None:
            for one in self.further[_LAST].parameters():
                one.zero_()

    def forward(self, latents: Latents) -> Images:
        """Return images, black 0 to white 1; not clipped.

        Args:
            latents: Layer-normalised, as the encoder gives them and the predictor predicts them.

        Raises:
            ValueError: They are of another size.
        """
        shape = self.shape
        if tuple(latents.shape[-2:]) != (shape.grid**2, shape.dim):
            found = "x".join(map(str, latents.shape[-2:]))
            raise ValueError(f"latents of {found} numbers; this decoder takes {shape.grid**2}x{shape.dim}")
        frames = latents.reshape(-1, *latents.shape[-2:])
        numbers: Tensor = self.unfold(self.linear(frames))
        if self.further is not None:
            numbers = numbers + self.further(frames)
        images = numbers.float() * _RANGE + _MIDDLE
        return images.reshape(*latents.shape[:-2], *images.shape[-3:])

    @staticmethod
    def as_numbers(images: Images) -> Images:
        """Return what the layers have to give for an image."""
        return (images - _MIDDLE) / _RANGE

    @torch.no_grad()
    def decode(self, latents: Latents, *, chunk: int = 64) -> Images:
        """Return images between 0 and 1, in float32, some frames at a time: bounds the memory."""
        frames = latents.reshape(-1, *latents.shape[-2:])
        images: Tensor = torch.cat([self(part).clamp(0.0, 1.0) for part in torch.split(frames, chunk)])
        return images.reshape(*latents.shape[:-2], *images.shape[-3:])


def _convolved(shape: DecoderShape) -> nn.Sequential:
    blocks, width, heads, first, second = _SIZES[shape.size]
    last = shape.patch_size // UPSAMPLED
    return nn.Sequential(
        nn.Linear(shape.dim, width),
        _Positions(shape.grid, width),
        *(_Block(width, heads) for _ in range(blocks)),
        nn.LayerNorm(width),
        Rearrange("n (rows columns) width -> n width rows columns", rows=shape.grid),
        nn.Conv2d(width, 4 * first, 3, padding=1),
        nn.PixelShuffle(2),
        nn.GELU(),
        nn.Conv2d(first, 4 * second, 3, padding=1),
        nn.PixelShuffle(2),
        nn.GELU(),
        nn.Conv2d(second, 3 * last**2, 3, padding=1),
        nn.PixelShuffle(last),
    )


class _Positions(nn.Module):
    """Adds sines and cosines of each token's row (first half) and column."""

    table: Tensor

    def __init__(self, grid: int, width: int) -> None:
        super().__init__()
        rates = _FREQUENCIES ** -(torch.arange(width // 4) / (width // 4))
        angles = torch.arange(grid)[:, None] * rates
        along = torch.cat([angles.sin(), angles.cos()], dim=-1)
        rows, columns = along[:, None].expand(-1, grid, -1), along[None].expand(grid, -1, -1)
        self.register_buffer("table", torch.cat([rows, columns], dim=-1).flatten(0, 1), persistent=False)

    def forward(self, tokens: Float[Tensor, "frames tokens width"]) -> Float[Tensor, "frames tokens width"]:
        return tokens + self.table


class _Block(nn.Module):
    """Attention over the tokens of a frame, then an MLP; both after a norm and added to their input."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, tokens: Float[Tensor, "frames tokens width"]) -> Float[Tensor, "frames tokens width"]:
        projected = self.qkv(self.norm1(tokens))
        query, key, value = rearrange(projected, "n tokens (k heads d) -> k n heads tokens d", k=3, heads=self.heads)
        attended = nn.functional.scaled_dot_product_attention(query, key, value)
        tokens = tokens + self.out(rearrange(attended, "n heads tokens d -> n tokens (heads d)"))
        added: Tensor = tokens + self.mlp(self.norm2(tokens))
        return added


def as_images(pixels: UInt8[Tensor, "*batch 3 size size"]) -> Images:
    """Return images as the decoder gives them: black 0, white 1."""
    return pixels.float() / 255.0


def as_pixels(images: Images) -> UInt8[np.ndarray, "*batch size size 3"]:
    """Return images between 0 and 1 for files: rounded to 8 bits, colours last."""
    rounded = (images.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu()
    return np.asarray(rearrange(rounded, "... c h w -> ... h w c").numpy())
