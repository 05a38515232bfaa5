"""A picture at a place is the same picture, however little else is decoded."""

from pathlib import Path

import av
import numpy as np
import pytest

from recordings import write_mp4
from synthetic import draw_frame, synthetic_states
from vjepa2_ac.data.video import Clock, count_frames, frame_size, read_frames
from vjepa2_ac.errors import InputError

STEPS = 40
FRAMES = [draw_frame(state, size=(36, 64)) for state in synthetic_states(STEPS)]


def every_frame(path: Path) -> np.ndarray:
    with av.open(str(path)) as file:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])


@pytest.mark.parametrize(("gop", "b_frames"), [(1, 0), (2, 0), (12, 0), (12, 3), (250, 3)])
def test_asked_pictures_equal_those_of_decoding_everything(tmp_path: Path, gop: int, b_frames: int) -> None:
    path = write_mp4(tmp_path / "a.mp4", FRAMES, gop=gop, b_frames=b_frames)
    frames, generator = every_frame(path), np.random.default_rng(gop)
    for _ in range(25):
        steps = generator.integers(0, STEPS, generator.integers(1, 9)).tolist()
        np.testing.assert_array_equal(read_frames(path, steps, where="a"), frames[steps])
        np.testing.assert_array_equal(read_frames(path, steps, where="a", clock=Clock(0.0, 15.0)), frames[steps])
