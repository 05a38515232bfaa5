"""Features of a video are of all its frames in their order, and of an odd number of all but the last."""

import pytest
import torch

from tiny_models import draw, tiny_model
from vjepa2_ac.evaluation.video.features import frames_used, video_features

ENCODER = tiny_model().present_encoder


def test_features_are_normalised_tokens_averaged() -> None:
    videos = draw(3, 4, 3, 48, 48)
    tokens = ENCODER.encode_videos(videos).double()
    normalised = (tokens - tokens.mean(dim=-1, keepdim=True)) / (
        tokens.var(-1, correction=0, keepdim=True) + 1e-5
    ).sqrt()
    torch.testing.assert_close(video_features(ENCODER, videos).double(), normalised.mean(dim=1), rtol=1e-4, atol=1e-5)


def test_the_last_of_an_odd_number_of_frames_is_left_out() -> None:
    videos = draw(2, 5, 3, 48, 48)
    assert torch.equal(video_features(ENCODER, videos), video_features(ENCODER, videos[:, :4]))
    assert [frames_used(frames) for frames in (2, 3, 16, 63, 64)] == [2, 2, 16, 62, 64]


def test_the_order_of_the_frames_matters() -> None:
    videos = draw(2, 4, 3, 48, 48)
    difference = video_features(ENCODER, videos) - video_features(ENCODER, videos.flip(1))
    assert difference.abs().max() > 1e-4


@pytest.mark.parametrize("frames", [1, 66])
def test_too_few_or_too_many_frames_are_refused(frames: int) -> None:
    with pytest.raises(ValueError, match="takes 2 to 64"):
        video_features(ENCODER, torch.zeros(1, frames, 3, 48, 48))
