"""The checkpoints that Meta has published: names, addresses, sizes and what is in them. PyTorch is not imported.

Sources: facebookresearch/vjepa2 @ 204698b, src/hub/backbones.py and app/vjepa_2_1/models; the models' cards on the Hub.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from typing import Literal

from vjepa2_ac.config.model import Family
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.encoder_origin import VIT_B, VIT_G, VIT_H, VIT_L, EncoderShape, VIT_g

OFFICIAL = "vjepa2-ac-vitg"  # Meta's world model, which `download` fetches without a name

_URL = "https://dl.fbaipublicfiles.com/vjepa2/"
_TOLERANCE = 0.25  # of a size that is only estimated


@dataclass(frozen=True)
class Published:
    """A file that can be downloaded; Meta publishes no hashes."""

    name: str  # for `vjepa2-ac download`; names differ by more than the case of a letter
    remote: str  # Meta's name of the file
    holds: Literal["world model", "encoder"]
    family: Family
    encoder: EncoderShape
    image_size: int  # at which it was trained last, in pixels
    key: str  # of the encoder's weights in the file
    hub_name: str  # its name in Meta's torch.hub
    gigabytes: float  # about: encoder, its average, predictor and the optimizer's moments, in float32
    bytes: int | None = None  # exactly, where known
    licence: str = "MIT"  # of Meta's repository; Meta's server sends none with the file

    @property
    def url(self) -> str:
        """Its address."""
        return _URL + self.remote

    @property
    def file(self) -> str:
        """The name under which it is stored: it tells ViT-g from ViT-G on a disk that is blind to case."""
        return f"{self.name}.pt"

    @property
    def size(self) -> str:
        """Its size, for people."""
        return f"about {self.gigabytes:g} GB" if self.bytes is None else f"{self.bytes:,} bytes"

    @property
    def bytes_range(self) -> tuple[int, int]:
        """The least and the largest size that is taken for this file, in bytes; equal where it is known exactly.

        The range around an estimate excludes what a proxy answers, and the file of the next encoder.
        """
        if self.bytes is not None:
            return self.bytes, self.bytes
        return round(self.gigabytes * (1 - _TOLERANCE) * 10**9), round(self.gigabytes * (1 + _TOLERANCE) * 10**9)

    @property
    def knob(self) -> str:
        """The knob of a config that takes the file."""
        return "model.base" if self.holds == "world model" else "model.encoder.path"


PUBLISHED: tuple[Published, ...] = (
    Published(
        "vjepa2-ac-vitg", "vjepa2-ac-vitg.pt", "world model", "v2", VIT_g, 256, "encoder",
        "vjepa2_ac_vit_giant", 11.7,
    ),
    Published(
        "vjepa2-vitl", "vitl.pt", "encoder", "v2", VIT_L, 256, "target_encoder",
        "vjepa2_vit_large", 5.1,
    ),
    Published(
        "vjepa2-vith", "vith.pt", "encoder", "v2", VIT_H, 256, "target_encoder",
        "vjepa2_vit_huge", 10.4,
    ),
    Published(
        "vjepa2-vitg", "vitg.pt", "encoder", "v2", VIT_g, 256, "target_encoder",
        "vjepa2_vit_giant", 16.5,
    ),
    Published(
        "vjepa2-vitg-384", "vitg-384.pt", "encoder", "v2", VIT_g, 384, "target_encoder",
        "vjepa2_vit_giant_384", 16.5,
    ),
    Published(
        "vjepa2.1-vitb-384", "vjepa2_1_vitb_dist_vitG_384.pt", "encoder", "v2.1", VIT_B, 384, "ema_encoder",
        "vjepa2_1_vit_base_384", 1.66, 1_664_223_428,
    ),
    Published(
        "vjepa2.1-vitl-384", "vjepa2_1_vitl_dist_vitG_384.pt", "encoder", "v2.1", VIT_L, 384, "ema_encoder",
        "vjepa2_1_vit_large_384", 5.1,
    ),
    Published(
        "vjepa2.1-vitg-1b-384", "vjepa2_1_vitg_384.pt", "encoder", "v2.1", VIT_g, 384, "target_encoder",
        "vjepa2_1_vit_giant_384", 16.5,
    ),
    Published(
        "vjepa2.1-vitG-2b-384", "vjepa2_1_vitG_384.pt", "encoder", "v2.1", VIT_G, 384, "target_encoder",
        "vjepa2_1_vit_gigantic_384", 29.8,
    ),
)  # fmt: skip


def published_as(file_name: str) -> Published | None:
    """Return the published file of this name, Meta's or ours, exactly as it is spelt; None: it is none of them."""
    return next((one for one in PUBLISHED if file_name in {one.remote, one.file}), None)


def find_published(text: str) -> Published:
    """Return the published checkpoint that a name means; dots, dashes and underscores do not matter, the case does.

    Args:
        text: Our name, Meta's name of the file or the name in torch.hub; with or without `.pt`.

    Raises:
        InputError: None has this name.
    """
    names = {_plain(name): one for one in PUBLISHED for name in (one.name, one.remote, one.hub_name)}
    if (meant := names.get(_plain(text))) is not None:
        return meant
    folded = [name.casefold() for name in names]
    near = difflib.get_close_matches(_plain(text.rpartition("/")[2]).casefold(), folded, n=3)
    close = " or ".join(dict.fromkeys(one.name for name, one in names.items() if name.casefold() in near))
    raise InputError(
        where=f"download {text}",
        found="no published checkpoint of this name",
        fix=f"{f'Did you mean {close}? ' if close else ''}`vjepa2-ac download --list` shows all; where the file goes is"
        " said by --to",
    )


def _plain(name: str) -> str:
    return re.sub(r"[-_. ]", "", name.removesuffix(".pt"))
