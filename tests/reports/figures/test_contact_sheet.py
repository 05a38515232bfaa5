"""The contact sheet is written completely for any kind of episodes, and shows the right frames."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from vjepa2_ac.data.transforms import crop_box
from vjepa2_ac.reports.figures.contact_sheet import ContactSheet, Strip, pictures_per_row, plot_contact_sheet


def strip(colour: tuple[int, int, int] = (200, 30, 40), *, steps: int = 30, size: tuple[int, int] = (18, 32)) -> Strip:
    count = min(pictures_per_row(*size), steps)
    return Strip(
        name="a/rather/long/name/of/an/episode" * 4,
        success=True,
        frames=np.full((count, *size, 3), colour, np.uint8),
        steps=np.linspace(0, steps - 1, count).astype(np.int64),
        speed=np.linspace(0, 20, steps),
        closedness=np.linspace(0, 1, steps),
        shaded=((0, 2),),
        seen=crop_box(*size),
    )


def sheet(*strips: Strip, **changes: object) -> ContactSheet:
    values: dict[str, object] = {
        "title": "a set", "facts": ("one", "two " * 100), "strips": strips, "control_rate_hz": 15.0,
        "lengths_s": np.array([2.0]), "moved": {4: np.array([1.0, 2.0]), 15: np.zeros(0)}, "reference": 12.9,
        "places_m": np.zeros((3, 3)), "shaded_means": "standing still",
    }  # fmt: skip
    return ContactSheet(**(values | changes))  # type: ignore[arg-type]


def pixels(path: Path) -> np.ndarray:
    return (imread(path)[..., :3] * 255).round().astype(np.int16)


@pytest.mark.parametrize(("rows", "steps", "size"), [(1, 1, (18, 32)), (12, 9, (64, 64)), (2, 40, (48, 20))])
def test_any_number_of_rows_and_any_shape_of_image_fit(
    tmp_path: Path, rows: int, steps: int, size: tuple[int, int]
) -> None:
    strips = [strip(steps=steps, size=size) for _ in range(rows)]
    seen = pixels(plot_contact_sheet(sheet(*strips), tmp_path / "sheet.png"))
    assert seen.shape[1] == 1430
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]


def test_the_crop_is_shown_unchanged_and_the_rest_is_pale(tmp_path: Path) -> None:
    seen = pixels(plot_contact_sheet(sheet(strip()), tmp_path / "sheet.png"))
    as_it_is = (abs(seen - (200, 30, 40)).max(axis=-1) <= 2).sum()
    pale = (abs(seen - (149, 98, 101)).max(axis=-1) <= 2).sum()
    assert as_it_is > 10_000
    assert pale / (pale + as_it_is) == pytest.approx(8 / 32, abs=0.03), "24 of 32 columns are seen"


def test_episodes_stand_below_one_another_in_their_order(tmp_path: Path) -> None:
    colours = [(200, 30, 40), (30, 200, 40), (40, 30, 200)]
    three = pixels(plot_contact_sheet(sheet(*map(strip, colours)), tmp_path / "three.png"))
    centres = [np.argwhere(abs(three - colour).max(axis=-1) <= 2)[:, 0].mean() for colour in colours]
    assert centres == sorted(centres)
