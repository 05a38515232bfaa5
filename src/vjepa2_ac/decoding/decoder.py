"""The decoder, which turns the latents of a frame into an image, and its folder of files (no code is executed).

A decoder is trained only on the latents of true frames, without an adversarial loss, and applied to predictions without
changes. If a prediction averages several possible futures, the image is blurred. A decoder fits only one encoder:
latents of another encoder would give meaningless images and are rejected.

Source of the idea: Assran et al. (2025), V-JEPA 2, appendix B.3; sizes and losses differ.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from einops import rearrange
from einops.layers.torch import Rearrange
from jaxtyping import Float, UInt8
from pydantic import Field
from torch import Generator, Tensor, nn

from vjepa2_ac import __version__
from vjepa2_ac.config import DataConfig
from vjepa2_ac.errors import InputError, MissingFileError
from vjepa2_ac.model.model_files import ASSETS
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.storage import folder_writer
from vjepa2_ac.storage.paths import BUILTIN, NO_DATA, SIMULATION_FILE
from vjepa2_ac.storage.structured import parse_record, read_json_object
from vjepa2_ac.storage.tensors import read_tensors, save_tensors

logger = logging.getLogger(__name__)

Latents = Float[Tensor, "*batch tokens dim"]
Images = Float[Tensor, "*batch 3 size size"]  # black 0 to white 1
Size = Literal["linear", "tiny", "small", "medium"]

_MIDDLE, _RANGE = 0.5, 0.25  # pixel = output x range + middle; the network's outputs are about -2 .. 2
_FREQUENCIES = 10_000.0
_STD = 0.02
UPSAMPLED = 4  # upsampling factor of the convolutions before the last one: the resolution is doubled twice
_LAST = -2  # index of the last layer with weights in `Decoder.further`


@dataclass(frozen=True)
class DecoderShape:
    """The size of a decoder, and the sizes of its encoder's latents."""

    size: Size
    dim: Annotated[int, Field(ge=1, le=1 << 14)]  # number of values of a token
    grid: Annotated[int, Field(ge=1, le=256)]  # tokens along each side of a frame
    patch_size: Annotated[int, Field(ge=UPSAMPLED, le=64, multiple_of=UPSAMPLED)]  # pixels

    @property
    def image_size(self) -> int:
        """Height and width of an image, in pixels."""
        return self.grid * self.patch_size


# Number of blocks, their width and attention heads, and the channels after each of the two doublings of the resolution.
_SIZES = {"tiny": (2, 128, 4, 64, 32), "small": (6, 512, 8, 256, 128), "medium": (12, 768, 12, 256, 128)}


class Decoder(nn.Module):
    """A network that decodes the latents of each frame to an image.

    The size `linear` has one matrix, which maps each token to an image patch. The other sizes add a second branch:
    attention blocks over the tokens of the frame, then convolutions that double the resolution twice and predict
    patches of a quarter of the patch size.
    """

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.shape = shape
        self.linear = nn.Linear(shape.dim, 3 * shape.patch_size**2)
        patches = "n (rows columns) (c p q) -> n c (rows p) (columns q)"
        self.unfold = Rearrange(patches, rows=shape.grid, c=3, p=shape.patch_size)
        self.further = None if shape.size == "linear" else _make_convolutions(shape)

    def initialise(self, generator: Generator) -> None:
        """Initialise all weights from a random generator."""
        for module in self.modules():
            if isinstance(module, nn.Linear | nn.Conv2d):
                fan_in = module.weight[0].numel()
                std = _STD if isinstance(module, nn.Linear) else 1.0 / math.sqrt(fan_in)
                nn.init.trunc_normal_(module.weight, std=std, generator=generator)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    @torch.no_grad()
    def copy_linear(self, linear: Decoder) -> None:
        """Make the output equal to a linear decoder's: copy its matrix and zero the last layer of the second branch."""
        self.linear.load_state_dict(linear.linear.state_dict())
        if self.further is not None:
            for parameter in self.further[_LAST].parameters():
                parameter.zero_()

    def forward(self, latents: Latents) -> Images:
        """Return images, black 0 to white 1; not clipped.

        Args:
            latents: Layer-normalised latents from the encoder or the predictor.

        Raises:
            ValueError: The latents have another size.
        """
        shape = self.shape
        if tuple(latents.shape[-2:]) != (shape.grid**2, shape.dim):
            actual = "x".join(map(str, latents.shape[-2:]))
            raise ValueError(f"latents of shape {actual}; this decoder expects {shape.grid**2}x{shape.dim}")
        frames = latents.reshape(-1, *latents.shape[-2:])
        outputs: Tensor = self.unfold(self.linear(frames))
        if self.further is not None:
            outputs = outputs + self.further(frames)
        images = outputs.float() * _RANGE + _MIDDLE
        return images.reshape(*latents.shape[:-2], *images.shape[-3:])

    @staticmethod
    def to_outputs(images: Images) -> Images:
        """Return the outputs of the network for which `forward` returns these images."""
        return (images - _MIDDLE) / _RANGE

    @torch.no_grad()
    def decode(self, latents: Latents, *, chunk: int = 64) -> Images:
        """Return images in float32, clipped to 0 .. 1; `chunk` frames are decoded at a time, to limit the memory."""
        frames = latents.reshape(-1, *latents.shape[-2:])
        images: Tensor = torch.cat([self(part).clamp(0.0, 1.0) for part in torch.split(frames, chunk)])
        return images.reshape(*latents.shape[:-2], *images.shape[-3:])


def _make_convolutions(shape: DecoderShape) -> nn.Sequential:
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
    """Position encoding: adds sines and cosines of a token's row (first half of the width) and column (second half)."""

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
    """Pre-norm transformer block over the tokens of a frame: attention and an MLP, with residual connections."""

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


def to_images(pixels: UInt8[Tensor, "*batch 3 size size"]) -> Images:
    """Convert 8-bit images to the decoder's range, black 0 to white 1."""
    return pixels.float() / 255.0


def to_pixels(images: Images) -> UInt8[np.ndarray, "*batch size size 3"]:
    """Convert images between 0 and 1 to 8-bit images with the channels last."""
    rounded = (images.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu()
    return np.asarray(rearrange(rounded, "... c h w -> ... h w c").numpy())


CARD, WEIGHTS = "decoder.json", "decoder.safetensors"
BUILTIN_DECODER = "decoder"  # name of the decoder's folder in the folder of a built-in model
SIMULATED = "frames of the simulated arm"

_NEEDED = "the folder of a decoder, as `vjepa2-ac decoder` writes it"
_FIX = "Copy the folder again, or train the decoder again with `vjepa2-ac decoder CONFIG`"


@dataclass(frozen=True)
class DecoderCard:
    """The content of decoder.json: the decoder's shape, its encoder, and how it was trained."""

    format: Literal["vjepa2-ac decoder 1"]
    shape: DecoderShape
    encoder: str  # WorldModel.encoder_fingerprint
    crop: str  # data.crop; the decoder fits this crop only
    precision: str  # training.precision, in which the latents were computed
    data: str  # data.path
    cameras: tuple[str, ...]
    episodes: int  # number of training episodes
    frames: int  # number of training frames
    steps: int  # number of optimizer steps
    held_out: Mapping[str, Any] = field(default_factory=dict)  # result of `frame_pairs.measure_decoders`
    version: str = __version__
    time: str = ""  # UTC


@dataclass(frozen=True, eq=False)
class TrainedDecoder:
    """A decoder in eval mode, with its card."""

    card: DecoderCard
    decoder: Decoder
    name: str  # folder or "builtin:..." name, as the user set it
    where: str = "--decoder"  # the option or config key that contains the name

    def to(self, device: torch.device) -> TrainedDecoder:
        """Move the decoder to a device."""
        self.decoder.to(device)
        return self

    def as_dict(self) -> dict[str, str]:
        """Return the name and the encoder's fingerprint as plain values for JSON."""
        return {"name": self.name, "encoder": self.card.encoder}

    def require_compatible(self, world_model: WorldModel, data: DataConfig, *, subject: str) -> tuple[str, ...]:
        """Refuse a model with another encoder or crop; log and return a warning if the training data differ.

        Args:
            world_model: The model whose latents are decoded.
            data: Config of the data, with the crop of the frames.
            subject: Name of the model, for messages.

        Raises:
            InputError: The encoder or the crop differs.
        """
        card, shape, model = self.card, self.card.shape, world_model
        compared = (
            ("tokens", shape.grid**2, model.num_tokens),
            ("dimensions", shape.dim, model.latent_dim),
            ("image size", shape.image_size, model.image_size),
            ("encoder", card.encoder, model.encoder_fingerprint()),
            ("data.crop", card.crop, data.crop),
        )
        if differing := [
            f"{name} {decoder_value}, the model's is {model_value}"
            for name, decoder_value, model_value in compared
            if decoder_value != model_value
        ]:
            problem = f"the decoder does not fit the encoder and crop of {subject} ({'; '.join(differing)})"
            needed = "a decoder trained on latents of the same encoder and crop"
            fix = "Train a decoder with `vjepa2-ac decoder CONFIG` and the config of this model"
            raise InputError(where=f"{self.where} {self.name}", found=problem, needed=needed, fix=fix)
        decoder_data = SIMULATED if self.name.startswith(BUILTIN) else card.data
        model_data = NO_DATA if data.is_cache else data.path
        if model_data == NO_DATA or _is_same_data(decoder_data, model_data):
            return ()
        warning = (
            f"The decoder {self.name} was trained on {decoder_data}, not on {model_data}: its images may be inaccurate."
        )
        logger.warning(warning)
        return (warning,)


def _is_same_data(first_path: str, second_path: str) -> bool:
    """Return whether two values of `data.path` are the same data set, or are both data sets of the simulated arm."""
    are_simulated = (path == SIMULATED or Path(path, SIMULATION_FILE).is_file() for path in (first_path, second_path))
    return Path(first_path).resolve() == Path(second_path).resolve() or all(are_simulated)


def save_decoder(folder: Path, card: DecoderCard, weights: Mapping[str, Tensor]) -> None:
    """Write a decoder into a folder. decoder.json is written last, so that a folder with this file is complete.

    Raises:
        InputError: The folder cannot be written.
    """
    with folder_writer(folder, CARD) as temporary:
        save_tensors(weights, temporary / WEIGHTS)
        (temporary / CARD).write_text(json.dumps(asdict(card), indent=1) + "\n", encoding="utf-8")


def load_decoder(name: str | Path, *, where: str = "--decoder") -> TrainedDecoder:
    """Read a decoder, on the CPU.

    Args:
        name: The folder of the decoder; or builtin:sim-tiny for the built-in decoder.
        where: The option or config key that contains the name, for messages.

    Raises:
        InputError: There is no decoder with this name, or it is incomplete or damaged.
    """
    is_builtin = str(name).startswith(BUILTIN)
    folder = ASSETS / str(name).removeprefix(BUILTIN) / BUILTIN_DECODER if is_builtin else Path(name)
    card = read_card(folder, where=where)
    decoder = Decoder(card.shape).eval().requires_grad_(False)
    decoder.load_state_dict(read_tensors(folder / WEIGHTS, decoder.state_dict(), needed=_NEEDED, fix=_FIX))
    return TrainedDecoder(card, decoder, str(name), where)


def read_card(folder: Path, *, where: str = "--decoder") -> DecoderCard:
    """Read decoder.json in the folder of a decoder.

    Raises:
        InputError: The folder contains no decoder, or decoder.json is damaged.
    """
    path = folder / CARD
    try:
        values = read_json_object(path, needed=_NEEDED, fix=_FIX)
    except MissingFileError:
        fix = "Train a decoder with `vjepa2-ac decoder CONFIG`; the same command resumes an unfinished training"
        raise InputError(where=f"{where} {folder}", found=f"no {CARD}", needed=_NEEDED, fix=fix) from None
    return parse_record(DecoderCard, values, where=str(path), needed=_NEEDED, fix=_FIX)
