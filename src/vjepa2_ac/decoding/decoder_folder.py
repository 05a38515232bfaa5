"""The folder of a decoder: decoder.json and decoder.safetensors. Nothing in it is executed.

A decoder belongs to an encoder. The latents of another one would give images, too, but meaningless ones: they are
refused.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from vjepa2_ac import __version__
from vjepa2_ac.config import DataConfig
from vjepa2_ac.decoding.network import Decoder, DecoderShape
from vjepa2_ac.errors import InputError, MissingFileError
from vjepa2_ac.model.model_files import ASSETS
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.storage import folder_writer
from vjepa2_ac.storage.places import BUILTIN, NO_DATA, SIMULATION_FILE
from vjepa2_ac.storage.structured import read_json_object, record_of
from vjepa2_ac.storage.tensors import read_tensors, save_tensors

logger = logging.getLogger(__name__)

CARD, WEIGHTS = "decoder.json", "decoder.safetensors"
BUILTIN_DECODER = "decoder"  # the folder of a model of the package that holds its decoder
SIMULATED = "frames of the simulated arm"

_NEEDED = "the folder of a decoder, as `vjepa2-ac decoder` writes it"
_FIX = "Copy the folder again, or train the decoder again"


@dataclass(frozen=True)
class DecoderCard:
    """What is known of a decoder."""

    format: Literal["vjepa2-ac decoder 1"]
    shape: DecoderShape
    encoder: str  # WorldModel.encoder_fingerprint
    crop: str  # data.crop: frames cut otherwise look otherwise to it
    precision: str  # training.precision, in which the latents were computed
    data: str  # data.path
    cameras: tuple[str, ...]
    episodes: int  # learned from
    frames: int
    steps: int
    held_out: Mapping[str, Any] = field(default_factory=dict)  # by `frame_pairs.measure_decoders`
    version: str = __version__
    time: str = ""  # UTC


@dataclass(frozen=True, eq=False)
class TrainedDecoder:
    """A decoder in eval mode, with its card."""

    card: DecoderCard
    decoder: Decoder
    name: str  # as given
    where: str = "--decoder"  # the option or knob that names it

    def to(self, device: torch.device) -> TrainedDecoder:
        """Move the decoder to a device."""
        self.decoder.to(device)
        return self

    def as_dict(self) -> dict[str, str]:
        """Return its name and its encoder's fingerprint, for a JSON of what it has shown."""
        return {"name": self.name, "encoder": self.card.encoder}

    def require_fit(
        self, world_model: WorldModel, data: DataConfig, *, subject: str, shown: str | None = None
    ) -> tuple[str, ...]:
        """Refuse a model with another encoder or crop; log and return a warning if the decoder has seen other data.

        Args:
            world_model: Its latents are decoded.
            data: Its crop is that of the frames.
            subject: What is decoded, for messages.
            shown: The data set of the frames, by its path, or `SIMULATED`; None: that of `data`.

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
        if differing := [f"{name} {ours}, not {theirs}" for name, ours, theirs in compared if ours != theirs]:
            found = f"the decoder of another encoder or crop than that of {subject} ({'; '.join(differing)})"
            needed = "one that was trained on the latents of both: others would be read wrongly"
            fix = "Train one with `vjepa2-ac decoder CONFIG`, on the config of this model"
            raise InputError(where=f"{self.where} {self.name}", found=found, needed=needed, fix=fix)
        learned = SIMULATED if self.name.startswith(BUILTIN) else card.data
        shown = shown or (NO_DATA if data.is_cache else data.path)
        if shown == NO_DATA or _is_same_data(learned, shown):
            return ()
        warning = f"The decoder {self.name} was trained on {learned}, not on {shown}: its images may be wrong."
        logger.warning(warning)
        return (warning,)


def _is_same_data(one: str, other: str) -> bool:
    """Return whether two data sets are the same, or both show the simulated arm, by their `data.path`."""
    are_simulated = (path == SIMULATED or Path(path, SIMULATION_FILE).is_file() for path in (one, other))
    return Path(one).resolve() == Path(other).resolve() or all(are_simulated)


def save_decoder(folder: Path, card: DecoderCard, weights: Mapping[str, Tensor]) -> None:
    """Write a decoder into a folder, decoder.json last: a folder that has one is complete.

    Raises:
        InputError: The folder cannot be written.
    """
    with folder_writer(folder, CARD) as fresh:
        save_tensors(weights, fresh / WEIGHTS)
        (fresh / CARD).write_text(json.dumps(asdict(card), indent=1) + "\n", encoding="utf-8")


def load_decoder(name: str | Path, *, where: str = "--decoder") -> TrainedDecoder:
    """Read a decoder, on the CPU.

    Args:
        name: Its folder; or builtin:sim-tiny, for the one in the package.
        where: The option or knob that names it, for messages.

    Raises:
        InputError: There is none, or it is incomplete or damaged.
    """
    is_ours = str(name).startswith(BUILTIN)
    folder = ASSETS / str(name).removeprefix(BUILTIN) / BUILTIN_DECODER if is_ours else Path(name)
    card = read_card(folder, where=where)
    decoder = Decoder(card.shape).eval().requires_grad_(False)
    decoder.load_state_dict(read_tensors(folder / WEIGHTS, decoder.state_dict(), needed=_NEEDED, fix=_FIX))
    return TrainedDecoder(card, decoder, str(name), where)


def read_card(folder: Path, *, where: str = "--decoder") -> DecoderCard:
    """Return what is known of a decoder.

    Raises:
        InputError: The folder holds none, or decoder.json is damaged.
    """
    path = folder / CARD
    try:
        values = read_json_object(path, needed=_NEEDED, fix=_FIX)
    except MissingFileError:
        fix = "Train one with `vjepa2-ac decoder CONFIG`; one that is unfinished goes on with the same command"
        found = f"no {CARD} there"
        raise InputError(where=f"{where} {folder}", found=found, needed=_NEEDED, fix=fix) from None
    return record_of(DecoderCard, values, where=str(path), needed=_NEEDED, fix=_FIX)
