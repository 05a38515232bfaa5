"""What the model's own frozen encoder sees in a whole video: the features of the V-JEPA 2 MMD.

The V-JEPA 2 MMD is `distribution.mmd.discrepancy` of these features of imagined and true clips. Beside it must stand:
squared MMD with JEDi's kernel on mean-pooled features of this model's own encoder, unbiased over episodes. It is **not
JEDi** (V-JEPA ViT-H, probe of Something-Something v2, another estimator). It is comparable only for the same encoder,
clips, frames, stride and decoder. The encoder judges images that were made from its own features: what it does not see,
this does not see.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.model.network.dynamics import normalise_latents
from vjepa2_ac.model.network.encoder import TUBELET, Encoder

MOST_FRAMES = 64  # the encoder was trained on 16 to 64


def frames_used(frames: int) -> int:
    """Return how many frames of a video are encoded: of an odd number, all but the last.

    Say so in a note where it is less than there are: the same holds for the true and the imagined video.

    Raises:
        ValueError: Fewer than 2 frames, or more than 64.
    """
    if not TUBELET <= frames <= MOST_FRAMES:
        raise ValueError(f"a video of {frames} frames; the encoder takes {TUBELET} to {MOST_FRAMES}")
    return frames - frames % TUBELET


@torch.no_grad()
def video_features(
    encoder: Encoder, videos: Float[Tensor, "batch time 3 height width"], chunk: int = 16
) -> Float[Tensor, "batch dim"]:
    """Return the features of each video: encoded as one, layer-normalised without affine, averaged over all tokens.

    Args:
        encoder: The frozen encoder of the model.
        videos: Frames normalised as in training, of its image size; the last of an odd number is left out
            (`frames_used`).
        chunk: Frames that go through the encoder at once, but one video at least.

    Raises:
        ValueError: Too few or too many frames, or of another size.
    """
    features = encoder.encode_videos(videos[:, : frames_used(videos.shape[1])], chunk)
    return normalise_latents(features).mean(dim=1)
