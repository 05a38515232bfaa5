"""What decoded rollouts need before they are measured: a decoder that fits, and a probe for the hand's position."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import batches_of, validation_windows
from vjepa2_ac.data.transforms import input_to_pixels, pixels_to_input
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder
from vjepa2_ac.decoding.frame_pairs import as_images
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.decoded.hand import HandPositions, HandProbe, fit_hand_probe
from vjepa2_ac.evaluation.decoded_rollouts.measure import CACHE, Decoding, HandReader
from vjepa2_ac.model.network.world_model import WorldModel

HandsOf = Callable[[Dataset, int], HandPositions | str]
"""From a data set and the side of an image to the positions of the hand; or why nobody knows."""

_NOBODY = "nobody says where the hand is in these data"
_BATCH = 16
MOST_CLIPS = 255  # of the training split, for the probe: so few are read without worker processes


def decoding_of(decoder: TrainedDecoder, world_model: WorldModel, dataset: Dataset, hands: HandsOf | None) -> Decoding:
    """Return what decoded rollouts are measured with.

    Args:
        decoder: On the device.
        world_model: Its encoder was set aside if latents come from a cache.
        dataset: From which the clips are read.
        hands: Says where the hand is; None: nobody does.
    """
    is_cache, size = dataset.config.is_cache, world_model.image_size
    hand: HandReader | str = _NOBODY
    if is_cache:
        hand = CACHE
    elif hands is not None:
        positions = hands(dataset, size)
        hand = positions if isinstance(positions, str) else _hand_reader(dataset, positions, size)
    return Decoding(decoder, not is_cache, None if is_cache else world_model, hand=hand)


def _hand_reader(dataset: Dataset, positions: HandPositions, size: int) -> HandReader | str:
    """Return a probe; or why there is none, which ends no evaluation."""
    try:
        return HandReader(fitted_probe(dataset, positions, size), positions)
    except InputError as error:
        return str(error)


def fitted_probe(dataset: Dataset, positions: HandPositions, size: int) -> HandProbe:
    """Return a probe fitted on true frames of the training split, as the encoder sees them.

    Raises:
        InputError: The split has no clips, or fewer than two episodes that show the hand.
    """
    images, found, ids = [], [], []
    for seen, states, name in frames_of_training(dataset, size):
        images.append(seen)
        found.append(positions(name, states))
        ids += [name] * len(seen)
    return fit_hand_probe(torch.cat(images), np.concatenate(found), ids)


def frames_of_training(
    dataset: Dataset, size: int
) -> Iterator[tuple[Float[Tensor, "time 3 size size"], Float[np.ndarray, "time state_dim"], str]]:
    """Yield true frames of the training split as the encoder sees them, their states and the id of their episode.

    Raises:
        InputError: The split has no clips.
    """
    for batch in batches_of(dataset, validation_windows(dataset, "train", clips=MOST_CLIPS), batch_size=_BATCH):
        if batch.frames is None:
            raise ValueError("a batch without frames")
        seen = as_images(input_to_pixels(pixels_to_input(batch.frames, size)))
        for row, name in enumerate(batch.episode_ids):
            yield seen[row], batch.states[row].double().numpy(), name
