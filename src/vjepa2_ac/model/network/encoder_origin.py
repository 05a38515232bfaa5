"""Which encoder is it: the published shapes, where one came from, and what identifies it beyond its tensors.

PyTorch is not imported. Source of the shapes: facebookresearch/vjepa2 @ 204698b, src/hub/backbones.py and the classes
that it names.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass

from vjepa2_ac.config import EncoderSizes
from vjepa2_ac.config.model import Family, FramePath


@dataclass(frozen=True)
class EncoderShape:
    """A published encoder."""

    name: str  # ViT-B, ...
    width: int
    depth: int
    heads: int
    hidden: int  # width of the MLP

    @property
    def parameters(self) -> int:
        """About how many weights it has: those of blocks and patches, without biases and norms."""
        return self.depth * (4 * self.width**2 + 2 * self.width * self.hidden) + 2 * 3 * 16**2 * self.width

    def sizes(self, family: Family, frame: FramePath) -> EncoderSizes:
        """Return the sizes of an encoder of this shape."""
        own = {"width": self.width, "depth": self.depth, "heads": self.heads, "mlp_ratio": self.hidden / self.width}
        return EncoderSizes.model_validate({**own, "family": family, "frame": frame})


VIT_B = EncoderShape("ViT-B", 768, 12, 12, 3072)
VIT_L = EncoderShape("ViT-L", 1024, 24, 16, 4096)
VIT_H = EncoderShape("ViT-H", 1280, 32, 16, 5120)
VIT_g = EncoderShape("ViT-g", 1408, 40, 22, 6144)
VIT_G = EncoderShape("ViT-G", 1664, 48, 26, 8192)

HEADS: Mapping[int, int] = {one.width: one.heads for one in (VIT_B, VIT_L, VIT_H, VIT_g, VIT_G)}
"""Width of an encoder -> its attention heads, which its tensors do not show."""


@dataclass(frozen=True)
class EncoderOrigin:
    """The file or repository that an encoder was read from."""

    file: str  # its name
    key: str = ""  # of the weights in it; "" of a folder
    licence: str = ""  # where it is known
    heads_are_told: bool = True  # False: of a model whose own fingerprint does not know them

    def __str__(self) -> str:
        key = f", {self.key}" if self.key else ""
        return f"{self.file}{key}{f' ({self.licence})' if self.licence else ''}"


def beyond_tensors(sizes: EncoderSizes, *, heads_are_told: bool) -> dict[str, str | int]:
    """Return what latents depend on and tensors do not show; nothing of V-JEPA 2's tubelets with the published heads.

    Args:
        sizes: Of the encoder.
        heads_are_told: Whether the heads belong to it; not of a model that was made with its encoder.
    """
    found: dict[str, str | int] = {}
    if sizes.family != "v2":
        found |= {"encoder.family": sizes.family, "encoder.frame": sizes.frame}
    if heads_are_told and HEADS.get(sizes.width) != sizes.heads:
        found["encoder.heads"] = sizes.heads
    return found


def identified(fingerprint: str, beyond: Mapping[str, str | int]) -> str:
    """Return the fingerprint of an encoder: that of its tensors, with what they do not show.

    Args:
        fingerprint: Of the tensors.
        beyond: As `beyond_tensors` gives it; where there is nothing, the fingerprint stays that of the tensors,
            whatever file they came from.
    """
    if not beyond:
        return fingerprint
    return hashlib.sha256(json.dumps([fingerprint, dict(beyond)], sort_keys=True).encode()).hexdigest()


def described(sizes: EncoderSizes, origin: EncoderOrigin | None) -> str:
    """Return an encoder in words, for cards."""
    frame = "" if sizes.family == "v2" else f", each frame as {'a tubelet' if sizes.frame == 'tubelet' else 'an image'}"
    text = f"V-JEPA {sizes.family[1:]}, {sizes.depth} blocks of {sizes.width}, {sizes.heads} heads{frame}"
    return text if origin is None else f"{text}; from {origin}"
