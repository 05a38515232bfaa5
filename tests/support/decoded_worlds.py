"""Clips whose latents have images: the world of `worlds`, a random linear decoder, and frames near what it draws."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from vjepa2_ac.decoding.decoder import Decoder, DecoderCard, DecoderShape, TrainedDecoder, as_pixels
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.evaluate import Contender, RepeatableClips
from worlds import DIM, TOKENS, in_batches, rows


def decoder(*, dim: int = DIM, tokens: int = TOKENS, strength: float = 0.25) -> TrainedDecoder:
    """Return a linear decoder that draws smooth patches; of strength 0 it draws the same grey image of everything."""
    shape = DecoderShape("linear", dim, round(tokens**0.5), 16)
    made = Decoder(shape).eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(3)
    coarse = torch.randn(dim * 3, 1, 4, 4, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, size=(16, 16), mode="bilinear").reshape(dim, -1)
    made.linear.weight.copy_(strength * smooth.T)
    made.linear.bias.zero_()
    card = DecoderCard("vjepa2-ac decoder 1", shape, "an encoder", "released", "fp32", "data", ("camera",), 3, 30, 100)
    return TrainedDecoder(card, made, Path("decoder"))


def clips(batch: LatentBatch, trained: TrainedDecoder, size: int = 4, noise: float = 0.03) -> RepeatableClips:
    """Return clips whose true frames are the decoder's images with some noise that it cannot draw."""
    images = trained.decoder.decode(batch.latents)
    drawn = torch.randn(images.shape[-3:], generator=torch.Generator().manual_seed(4))
    frames = as_pixels(images + noise * drawn)
    places = {name: place for place, name in enumerate(zip(batch.episode_ids, batch.starts, strict=True))}

    def read(names):  # type: ignore[no-untyped-def]
        chosen = list(places.values()) if names is None else [places[name] for name in names]
        for number, part in enumerate(in_batches(rows(batch, chosen), size)):
            yield part, lambda row, first=number * size: frames[chosen[first + row]]

    return RepeatableClips(tuple(places), read)


class Known:
    """Predicts what it was told: the latents of all clips, by their first frame."""

    def __init__(self, latents: Tensor) -> None:
        self.latents = latents

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return nothing of use."""
        raise NotImplementedError

    def rollout(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return the frames after the first."""
        del actions, states, extrinsics
        clips = [int((self.latents[:, 0] - one).abs().sum(dim=(1, 2)).argmin()) for one in latents[:, 0]]
        return self.latents[clips, 1:]


def contenders(trained: object, base: object | None = None) -> Sequence[Contender]:
    """Return a base, if there is one, and a trained model."""
    found = [] if base is None else [Contender("base", "base", base)]  # type: ignore[arg-type]
    return [*found, Contender("adapter", "trained", trained)]  # type: ignore[arg-type]
