"""The sizes of the encoders that Meta has published. PyTorch is not imported.

Source: facebookresearch/vjepa2 @ 204698b, src/hub/backbones.py and the classes that it names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class EncoderShape:
    """A published encoder."""

    name: str  # ViT-B, ...
    width: int
    depth: int
    heads: int
    hidden: int  # width of the MLP

    @property
    def mlp_ratio(self) -> float:
        """Hidden width of the MLP over the width."""
        return self.hidden / self.width


VIT_B = EncoderShape("ViT-B", 768, 12, 12, 3072)
VIT_L = EncoderShape("ViT-L", 1024, 24, 16, 4096)
VIT_H = EncoderShape("ViT-H", 1280, 32, 16, 5120)
VIT_g = EncoderShape("ViT-g", 1408, 40, 22, 6144)
VIT_G = EncoderShape("ViT-G", 1664, 48, 26, 8192)

HEADS: Mapping[int, int] = {one.width: one.heads for one in (VIT_B, VIT_L, VIT_H, VIT_g, VIT_G)}
"""Width of an encoder -> its attention heads, which its tensors do not show."""
