"""Strips and animations: each frame at its place in a border that says what it is; the same film, the same bytes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from vjepa2_ac.media.image_file import read_image
from vjepa2_ac.reports.figures.film.animation import film_durations_s, film_frames, write_animation
from vjepa2_ac.reports.figures.film.film import Film, FilmRow
from vjepa2_ac.reports.figures.film.panels import BORDER, COLOURS
from vjepa2_ac.reports.figures.film.strip import MOST_COLUMNS, draw_strip, write_strip

SIDE = 64  # enlarged four times
PANEL = 4 * SIDE


def row(first: int, *, count: int = 4, **changes: Any) -> FilmRow:
    """Frames of one shade of red each: first, first + 1, ..."""
    frames = np.zeros((count, SIDE, SIDE, 3), dtype=np.uint8)
    frames[..., 0] = 60 + first + np.arange(count)[:, None, None]
    frames[..., 2] = 250
    return FilmRow(**({"label": f"row {first}", "frames": frames, "kind": "imagined", "given": 0} | changes))


def film(*rows: FilmRow, count: int = 4, **changes: Any) -> Film:
    seconds = tuple(0.25 * column for column in range(count))
    return Film(**({"title": "a film", "rows": rows, "seconds": seconds} | changes))


def corner(image: np.ndarray, shade: int) -> tuple[int, int]:
    """Return top and left of the panel of the frame with this shade of red, checked to be whole and in its place."""
    found = np.argwhere((image == (60 + shade, 0, 250)).all(axis=-1))
    (top, left), (bottom, right) = found.min(axis=0), found.max(axis=0)
    assert (bottom - top + 1, right - left + 1) == (PANEL, PANEL)
    return int(top) - BORDER, int(left) - BORDER


def border(image: np.ndarray, shade: int) -> str:
    """Return what the border of this frame says that it is."""
    top, left = corner(image, shade)
    colour = image[top + PANEL + BORDER + 1, left + PANEL // 2]
    return next(kind for kind, each in COLOURS.items() if (np.round(255 * np.array(to_rgb(each))) == colour).all())


def is_marked(image: np.ndarray, shade: int) -> bool:
    """Return whether a mark stands in the corner of this frame."""
    top, left = corner(image, shade)
    return bool((image[top + BORDER, left + BORDER] == image[top, left]).all())


def test_frames_stand_in_rows_and_columns_in_borders_that_say_what_they_are() -> None:
    image = draw_strip(film(row(0, kind="recorded"), row(10, given=1, start=0), row(20, kind="simulated")))
    tops, lefts = zip(*(corner(image, first + 1) for first in (0, 10, 20)), strict=True)
    assert list(tops) == sorted(set(tops))
    assert len(set(lefts)) == 1
    across = [corner(image, shade)[1] for shade in (0, 1, 2, 3)]
    assert len(set(np.diff(across))) == 1
    assert [border(image, shade) for shade in (0, 10, 11, 20)] == ["recorded", "recorded", "imagined", "simulated"]
    assert [is_marked(image, shade) for shade in (0, 10, 11)] == [False, True, False]


def test_a_given_frame_that_was_decoded_says_both() -> None:
    image = draw_strip(film(row(0, given=1, given_kind="decoded")))
    assert border(image, 0) == "decoded"
    assert is_marked(image, 0)


def test_a_row_that_begins_later_stands_below_its_times() -> None:
    image = draw_strip(film(row(0), row(10, count=2, start=2)))
    assert [corner(image, shade)[1] for shade in (10, 11)] == [corner(image, shade)[1] for shade in (2, 3)]


def test_of_a_long_film_some_columns_are_shown_and_the_strip_says_so() -> None:
    shown = draw_strip(film(row(0, count=41), count=41))
    shades = {int(red) for red in np.unique(shown[(shown[..., 2] == 250) & (shown[..., 1] == 0)][:, 0])}
    assert shades == {60 + shade for shade in range(0, 41, 5)}
    assert len(shades) == MOST_COLUMNS
    all_shown = draw_strip(film(row(0, count=9), count=9))
    assert shown.shape[0] > all_shown.shape[0]  # by a line


def test_texts_are_drawn_and_change_nothing_else() -> None:
    plain = film(row(0), captions=("", "up", "up", "up"))
    image = draw_strip(plain)
    for other in (
        replace(plain, title="another"),
        replace(plain, captions=("", "up", "up", "down")),
        replace(plain, seconds=(0.0, 0.25, 0.5, 0.9)),
        replace(plain, rows=(replace(plain.rows[0], label="$x_{"),)),
    ):
        changed = (draw_strip(other) != image).any(axis=-1)
        assert changed.any()
        frames = (image[..., 2] == 250) & (image[..., 1] == 0)
        assert not changed[frames].any()
    assert (image[0] == 255).all()


def test_an_animation_shows_every_time_and_all_rows_at_once() -> None:
    made = film(row(0), row(10), row(20), row(30, count=2, start=1), captions=("", "up", "up", "close"))
    frames = film_frames(made)
    assert len(frames) == len(film_durations_s(made)) == 4
    assert len({frame.shape for frame in frames}) == 1
    assert frames[0].shape[0] % 2 == frames[0].shape[1] % 2 == 0
    for column, frame in enumerate(frames):
        places = [corner(frame, first + column) for first in (0, 10, 20)]
        assert places == [corner(frames[0], first) for first in (0, 10, 20)]
    assert all(is_marked(frame, column) for column, frame in enumerate(frames))  # each is named: these are imagined
    recorded = film_frames(replace(made, rows=(row(0, kind="recorded", given=1),)))
    assert [is_marked(frame, column) for column, frame in enumerate(recorded)] == [True, False, False, False]
    corner(frames[1], 30)
    with pytest.raises(ValueError, match="zero-size"):
        corner(frames[3], 31)  # the row has ended: pale


def test_first_and_last_frame_are_held() -> None:
    assert film_durations_s(film(row(0))) == [1.0, 0.4, 0.4, 1.5]
    assert film_durations_s(film(row(0), seconds=(0.0, 2.0, 3.0, 4.0))) == [2.0, 1.0, 1.0, 1.5]


def test_files_hold_what_was_drawn_and_their_bytes_repeat(tmp_path: Path) -> None:
    made = film(row(0), row(10, kind="recorded"))
    strip = write_strip(made, tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(strip), draw_strip(made))
    gif = write_animation(made, tmp_path / "a.gif")
    with Image.open(gif) as image:
        assert image.n_frames == 4
    assert strip.read_bytes() == write_strip(made, tmp_path / "b.png").read_bytes()
    assert gif.read_bytes() == write_animation(made, tmp_path / "b.gif").read_bytes()


def test_a_video_lasts_as_long_as_its_frames_are_shown(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="the extra `video` is not installed")
    from vjepa2_ac.media.video_reader import count_frames

    made = film(row(0))
    path = write_animation(made, tmp_path / "a.mp4")
    assert count_frames(path, where="film") == 20 * sum(film_durations_s(made))


def test_an_animation_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a \.mp4 or a \.gif"):
        write_animation(film(row(0)), tmp_path / "film.webm")
    assert not list(tmp_path.iterdir())
