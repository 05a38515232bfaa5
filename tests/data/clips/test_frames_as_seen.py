"""People see frames in their own colours."""

import numpy as np
import torch

from vjepa2_ac.data.clips.transforms import frames_as_seen


def test_frames_of_the_encoders_size_are_shown_as_they_are() -> None:
    frames = torch.randint(90, 110, (3, 16, 16, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    np.testing.assert_array_equal(frames_as_seen(frames.numpy(), 16), frames.numpy())


def test_a_dark_frame_stays_dark_whatever_the_others_are() -> None:
    frames = torch.full((2, 20, 30, 3), 20, dtype=torch.uint8)
    frames[1] = 200
    shown = frames_as_seen(frames.numpy(), 16)
    assert shown.shape == (2, 16, 16, 3)
    assert (shown[0] == 20).all()
    assert (shown[1] == 200).all()
