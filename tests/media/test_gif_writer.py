"""Written GIFs: every frame comes back, for as long as it should, in its own colours."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vjepa2_ac.media.gif_writer import write_gif


def frames(count: int = 5, height: int = 33, width: int = 48) -> list[np.ndarray]:
    made = [np.full((height, width, 3), 255, dtype=np.uint8) for _ in range(count)]
    for number, frame in enumerate(made):
        frame[4:12, 4 * number : 4 * number + 8] = (200, 40 * number, 30)
    return made


def test_every_frame_comes_back_for_as_long_as_it_was_to_be_shown(tmp_path: Path) -> None:
    made = frames()
    path = write_gif(tmp_path / "new" / "film.gif", made, [1.0, 0.25, 0.25, 0.27, 1.5])
    with Image.open(path) as gif:
        assert gif.n_frames == 5
        assert gif.info["loop"] == 0  # for ever
        durations = []
        for number, frame in enumerate(made):
            gif.seek(number)
            durations.append(gif.info["duration"])
            np.testing.assert_allclose(np.asarray(gif.convert("RGB")).astype(int), frame, atol=6)
        assert durations == [1000, 250, 250, 270, 1500]


def test_a_plain_area_has_no_noise_and_white_stays_white(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frame = np.full((64, 96, 3), 255, dtype=np.uint8)
    frame[:32] = rng.integers(0, 255, (32, 96, 3))  # more colours than a palette has
    frame[:32, :8] = 253
    frame[40:60, 20:50] = (213, 94, 0)
    with Image.open(write_gif(tmp_path / "film.gif", [frame], [1.0])) as gif:
        shown = np.asarray(gif.convert("RGB"))
    assert (shown[61:] == 255).all()
    assert len(np.unique(shown[40:60, 20:50].reshape(-1, 3), axis=0)) == 1


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    first, second = (write_gif(tmp_path / name, frames(), [0.3] * 5).read_bytes() for name in ("a.gif", "b.gif"))
    assert first == second


@pytest.mark.parametrize(
    ("made", "durations_s", "wrong"),
    [
        ([], [], "without frames"),
        (frames(2), [0.5], "1 durations for 2 frames"),
        ([*frames(1), *frames(1, 20)], [0.5, 0.5], "pixels in one GIF"),
        (frames(2), [0.5, 0.0], "at least 0.02 s"),
    ],
)
def test_what_cannot_be_a_gif_is_refused_and_leaves_nothing(
    tmp_path: Path, made: list[np.ndarray], durations_s: list[float], wrong: str
) -> None:
    with pytest.raises(ValueError, match=wrong):
        write_gif(tmp_path / "film.gif", made, durations_s)
    assert not list(tmp_path.iterdir())
