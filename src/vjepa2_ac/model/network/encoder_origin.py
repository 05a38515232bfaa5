"""Where an encoder came from, and what identifies it beyond its tensors."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from vjepa2_ac.config import EncoderSizes
from vjepa2_ac.model.network.published_sizes import HEADS


@dataclass(frozen=True)
class EncoderOrigin:
    """The file or repository that an encoder was read from."""

    file: str  # its name
    key: str = ""  # of the weights in it; "" of a folder
    licence: str = ""  # where it is known

    def __str__(self) -> str:
        key = f", {self.key}" if self.key else ""
        return f"{self.file}{key}{f' ({self.licence})' if self.licence else ''}"


def identified(fingerprint: str, sizes: EncoderSizes, *, heads_are_told: bool) -> str:
    """Return the fingerprint of an encoder: that of its tensors, with what they do not show and latents depend on.

    Of V-JEPA 2's tubelets with the published heads it is that of the tensors alone, whatever file they came from.

    Args:
        fingerprint: Of the tensors.
        sizes: Of the encoder.
        heads_are_told: Whether the heads belong to it. Those of a model of before were not asked for: its caches stay.
    """
    beyond = [] if sizes.family == "v2" else [f"family {sizes.family}"]
    beyond += [] if sizes.frame == "tubelet" else [f"frame {sizes.frame}"]
    beyond += [f"heads {sizes.heads}"] if heads_are_told and HEADS.get(sizes.width) != sizes.heads else []
    if not beyond:
        return fingerprint
    return hashlib.sha256("\n".join([fingerprint, *beyond]).encode()).hexdigest()
