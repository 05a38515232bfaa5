"""The checkpoints that Meta has published: names, addresses, sizes and what is in them. PyTorch is not imported.

Sources: facebookresearch/vjepa2 @ 204698b, src/hub/backbones.py and app/vjepa_2_1/models; the models' cards on the Hub.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vjepa2_ac.config.model import Family
from vjepa2_ac.model.network.published_sizes import VIT_B, VIT_G, VIT_H, VIT_L, EncoderShape, VIT_g

_URL = "https://dl.fbaipublicfiles.com/vjepa2/"
_MIT = "MIT"


@dataclass(frozen=True)
class Published:
    """A file that can be downloaded."""

    name: str  # for `vjepa2-ac download`; names differ by more than the case of a letter
    remote: str  # Meta's name of the file
    holds: Literal["world model", "encoder"]
    family: Family
    encoder: EncoderShape
    image_size: int  # at which it was trained last, in pixels
    key: str  # of the encoder's weights in the file
    gigabytes: float  # about: encoder, its average, predictor and the optimizer's moments, in float32
    bytes: int | None = None  # exactly, where known
    sha256: str | None = None  # where known; Meta publishes none
    licence: str = _MIT

    @property
    def url(self) -> str:
        """Its address."""
        return _URL + self.remote

    @property
    def file(self) -> str:
        """The name under which it is stored: it tells ViT-g from ViT-G on a disk that is blind to case."""
        return f"{self.name}.pt"


PUBLISHED: tuple[Published, ...] = (
    Published("vjepa2-ac-vitg", "vjepa2-ac-vitg.pt", "world model", "v2", VIT_g, 256, "encoder", 11.7),
    Published("vjepa2-vitl", "vitl.pt", "encoder", "v2", VIT_L, 256, "target_encoder", 5.1),
    Published("vjepa2-vith", "vith.pt", "encoder", "v2", VIT_H, 256, "target_encoder", 10.4),
    Published("vjepa2-vitg", "vitg.pt", "encoder", "v2", VIT_g, 256, "target_encoder", 16.5),
    Published("vjepa2-vitg-384", "vitg-384.pt", "encoder", "v2", VIT_g, 384, "target_encoder", 16.5),
    Published(
        "vjepa2.1-vitb-384", "vjepa2_1_vitb_dist_vitG_384.pt", "encoder", "v2.1", VIT_B, 384, "ema_encoder", 1.66,
        bytes=1_664_223_428,
    ),
    Published("vjepa2.1-vitl-384", "vjepa2_1_vitl_dist_vitG_384.pt", "encoder", "v2.1", VIT_L, 384, "ema_encoder", 5.1),
    Published("vjepa2.1-vitg-1b-384", "vjepa2_1_vitg_384.pt", "encoder", "v2.1", VIT_g, 384, "target_encoder", 16.5),
    Published("vjepa2.1-vitG-2b-384", "vjepa2_1_vitG_384.pt", "encoder", "v2.1", VIT_G, 384, "target_encoder", 29.8),
)  # fmt: skip


def published_as(file_name: str) -> Published | None:
    """Return the published file of this name, Meta's or ours, exactly as it is spelt; None: it is none of them."""
    return next((one for one in PUBLISHED if file_name in {one.remote, one.file}), None)
