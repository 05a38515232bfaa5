"""The contact sheet has a fixed width for any episodes, and marks the crop of the model's input."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.transforms import crop_box
from vjepa2_ac.inspection.sheet import Strip, num_images_per_row, plot_contact_sheet
from vjepa2_ac.inspection.statistics import inspect_dataset

pytestmark = pytest.mark.usefixtures("drawn")

Plotted = Callable[..., np.ndarray]


@pytest.fixture
def plotted(droid: Path, tmp_path: Path) -> Plotted:
    """Return a function that draws strips as a contact sheet and returns the pixels."""
    inspection = inspect_dataset(open_dataset(DataConfig(path=str(droid), frames=4, stride=2)))

    def plot(*strips: Strip) -> np.ndarray:
        path = plot_contact_sheet(inspection, strips, tmp_path / "sheet.png")
        assert [path] == list(tmp_path.iterdir())
        return (imread(path)[..., :3] * 255).round().astype(np.int16)

    return plot


def strip(colour: tuple[int, int, int] = (200, 30, 40), *, steps: int = 30, size: tuple[int, int] = (18, 32)) -> Strip:
    count = min(num_images_per_row(*size), steps)
    return Strip(
        name="a/rather/long/name/of/an/episode" * 4,
        success=True,
        frames=np.full((count, *size, 3), colour, np.uint8),
        speed=np.linspace(0, 20, steps),
        gripper_position=np.linspace(0, 1, steps),
        unused=((0, 2),),
        crop=crop_box(*size),
    )


@pytest.mark.parametrize(("rows", "steps", "size"), [(1, 1, (18, 32)), (12, 9, (64, 64)), (2, 40, (48, 20))])
def test_sheet_has_the_same_width_for_any_number_of_rows_and_image_shape(
    plotted: Plotted, rows: int, steps: int, size: tuple[int, int]
) -> None:
    assert plotted(*(strip(steps=steps, size=size) for _ in range(rows))).shape[1] == 1430


def test_image_is_unchanged_inside_the_crop_and_pale_outside(plotted: Plotted) -> None:
    pixels = plotted(strip())
    unchanged = (abs(pixels - (200, 30, 40)).max(axis=-1) <= 2).sum()
    pale = (abs(pixels - (149, 98, 101)).max(axis=-1) <= 2).sum()
    assert unchanged > 10_000
    assert pale / (pale + unchanged) == pytest.approx(8 / 32, abs=0.03), "24 of 32 columns are inside the crop"
