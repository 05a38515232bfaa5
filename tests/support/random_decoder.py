"""An untrained decoder for a model's encoder, whose images have the right size."""

from pathlib import Path

import torch

from vjepa2_ac.decoding.decoder import Decoder, DecoderCard, DecoderShape, save_decoder
from vjepa2_ac.model.world_model import WorldModel


def write_decoder(folder: Path, model: WorldModel, *, encoder: str | None = None) -> Path:
    """Write the folder of a decoder for a model; `encoder` replaces the fingerprint of the model's encoder."""
    patch = model.sizes.patch_size
    decoder = Decoder(DecoderShape("tiny", model.latent_dim, model.image_size // patch, patch))
    decoder.initialise(torch.Generator().manual_seed(0))
    card = DecoderCard(
        format="vjepa2-ac decoder 1",
        shape=decoder.shape,
        encoder=encoder or model.encoder_fingerprint(),
        crop="released",
        precision="fp32",
        data="none",
        cameras=("left",),
        episodes=1,
        frames=1,
        steps=1,
    )
    save_decoder(folder, card, decoder.state_dict())
    return folder
