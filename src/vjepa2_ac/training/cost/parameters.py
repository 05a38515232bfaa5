"""Parameter counts: how many a model has, and which are trained. No weight is made."""

from __future__ import annotations

from dataclasses import dataclass

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.training.cost.fake_model import meta_predictor

_TUBELET = 2  # frames that the encoder's first layer takes at once
_LEVELS = 4  # of V-JEPA 2.1, each with a norm


@dataclass(frozen=True)
class Parameters:
    """How many parameters there are, exactly."""

    encoder: int
    predictor: int
    trained_tensors: tuple[int, ...]  # elements of each: of an adapter and whole heads, or of the whole predictor

    @property
    def trained(self) -> int:
        """How many are trained."""
        return sum(self.trained_tensors)


def count_parameters(config: Config, sizes: ModelSizes) -> Parameters:
    """Return how many parameters a model of these sizes has, and how many of them the config trains.

    Raises:
        InputError: A knob of the adapter does not fit the predictor.
    """
    width, hidden = sizes.encoder.width, int(sizes.encoder.width * sizes.encoder.mlp_ratio)
    block = 4 * (width + 1) * width + 4 * width + (width + 1) * hidden + (hidden + 1) * width
    every = list(meta_predictor(config, sizes).parameters())
    trained = tuple(one.numel() for one in every if one.requires_grad)
    total = sum(one.numel() for one in every)
    own = total if config.adapter.kind == "none" else total - sum(trained)
    return Parameters(sizes.encoder.depth * block + _beside_blocks(sizes), own, trained)


def _beside_blocks(sizes: ModelSizes) -> int:
    """Return the encoder's parameters outside of its blocks; of V-JEPA 2.1 those of both frame paths are there."""
    width, of_a_frame = sizes.encoder.width, 3 * sizes.patch_size**2
    video, norm = (_TUBELET * of_a_frame + 1) * width, 2 * width
    if sizes.encoder.family == "v2":
        return video + norm
    return video + (of_a_frame + 1) * width + 2 * width + _LEVELS * norm
