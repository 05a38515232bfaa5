"""Films: which frame belongs to which time and what it is; what is no film is refused."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vjepa2_ac.reports.figures.film.difference import FULL_SCALE, difference_row, heat_colours
from vjepa2_ac.reports.figures.film.film import Film, FilmRow, even_columns


def row(**changes: Any) -> FilmRow:
    frames = np.arange(3, dtype=np.uint8)[:, None, None, None] * np.ones((1, 12, 16, 3), dtype=np.uint8)
    return FilmRow(**({"label": "a row", "frames": frames, "kind": "imagined", "given": 1} | changes))


def film(*rows: FilmRow, **changes: Any) -> Film:
    return Film(**({"title": "a film", "rows": rows, "seconds": (0.0, 0.25, 0.5)} | changes))


def test_a_frame_is_found_by_its_time_and_known_for_what_it_is() -> None:
    late = row(start=1, captions=("", "up", "up"), given_kind="decoded")
    assert late.frame_at(0) is None
    assert [int(late.frame_at(column)[0, 0, 0]) for column in (1, 2, 3)] == [0, 1, 2]  # type: ignore[index]
    assert late.frame_at(4) is None
    assert [late.is_given(column) for column in range(4)] == [False, True, False, False]
    assert [late.kind_at(column) for column in (1, 2)] == ["decoded", "imagined"]
    assert [late.caption_at(column) for column in (0, 1, 2)] == ["", "", "up"]


@pytest.mark.parametrize(
    ("changes", "wrong"),
    [
        ({"label": " "}, "no label"),
        ({"frames": np.zeros((0, 4, 4, 3), np.uint8), "given": 0}, "row 'a row': no frames"),
        ({"frames": np.zeros((2, 4, 4, 3))}, "float64 of shape"),
        ({"frames": np.zeros((4, 4, 3), np.uint8)}, r"shape \(4, 4, 3\)"),
        ({"given": 4}, "4 given frames of 3"),
        ({"start": -1}, "column -1"),
        ({"captions": ("up",)}, "1 captions for 3 frames"),
    ],
)
def test_what_is_no_row_is_refused(changes: dict[str, Any], wrong: str) -> None:
    with pytest.raises(ValueError, match=wrong):
        row(**changes)


def test_what_is_no_film_is_refused() -> None:
    small = row(label="small", frames=np.zeros((3, 6, 8, 3), np.uint8))
    for rows, changes, wrong in (
        ((), {}, "no rows"),
        ((row(), small), {}, r"\(6, 8\) pixels in row 'small', of \(12, 16\)"),
        ((row(start=1),), {}, "a frame in column 3; there are 3 times"),
        ((row(),), {"seconds": (0.0, 0.5, 0.5)}, "do not increase"),
        ((row(),), {"captions": ("up", "up")}, "2 captions for 3 columns"),
    ):
        with pytest.raises(ValueError, match=wrong):
            film(*rows, **changes)


def test_chosen_columns_hold_both_ends_and_are_even() -> None:
    assert even_columns(5, 9) == [0, 1, 2, 3, 4]
    assert even_columns(27, 3) == [0, 13, 26]
    assert even_columns(1, 9) == [0]


def test_a_difference_is_black_where_rows_agree_and_bright_only_where_they_do_not() -> None:
    frames = np.full((3, 12, 16, 3), 100, dtype=np.uint8)
    changed = frames.copy()
    changed[2, 3:6, 4:8] += FULL_SCALE
    found = difference_row(row(frames=changed), row(frames=frames[1:], start=1))
    assert (found.start, found.end, found.kind) == (1, 3, "difference")
    none, full = heat_colours(np.array([0.0, 1.0]))
    assert none.max() < 10
    assert full.min() > 180
    assert (found.frames[0] == none).all()
    spot = (found.frames[1] == full).all(axis=-1)
    assert spot[3:6, 4:8].all()
    assert spot.sum() == 12


def test_a_difference_needs_frames_of_one_size_at_one_time() -> None:
    with pytest.raises(ValueError, match="no column in common"):
        difference_row(row(), row(start=3))
    with pytest.raises(ValueError, match="have no difference"):
        difference_row(row(), row(frames=np.zeros((3, 6, 8, 3), np.uint8)))


def test_what_a_film_shows_is_named_once() -> None:
    shown = film(row(kind="recorded"), row(), row(given_kind="decoded"))
    assert shown.kinds == ("recorded", "imagined", "decoded")
    assert film(row()).with_row(row(label="more")).rows[-1].label == "more"
    assert film(row(), captions=("", "up", "up")).is_captioned
    assert not film(replace(row(), captions=("", "", ""))).is_captioned
