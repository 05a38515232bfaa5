"""A decoder of a model's encoder that has learned nothing: quick to make, and its images are of the right size."""

from pathlib import Path

import torch

from vjepa2_ac.decoding.decoder_folder import DecoderCard, save_decoder
from vjepa2_ac.decoding.network import Decoder, DecoderShape
from vjepa2_ac.model.network.world_model import WorldModel


def write_decoder(folder: Path, model: WorldModel, *, encoder: str | None = None) -> Path:
    """Write the folder of a decoder for a model; with another fingerprint, for an encoder of the same size."""
    patch = model.sizes.patch_size
    shapes = [DecoderShape(size, model.latent_dim, model.image_size // patch, patch) for size in ("tiny", "linear")]
    decoders = [Decoder(shape) for shape in shapes]
    for seed, decoder in enumerate(decoders):
        decoder.initialise(torch.Generator().manual_seed(seed))
    card = DecoderCard(
        format="vjepa2-ac decoder 1", shape=shapes[0], encoder=encoder or model.encoder_fingerprint(), crop="released",
        precision="fp32", data="none", cameras=("left",), episodes=1, frames=1, steps=1,
    )  # fmt: skip
    save_decoder(folder, card, *(decoder.state_dict() for decoder in decoders))
    return folder
