"""Cells count by the side to which the hand moves, per axis; small true displacements are left out."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from counterfactual_requests import asked_of_tiny
from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation.counterfactual_sides import AXES, Cell, Sides, measure_sides


def sides(*cells: tuple[str, float, float]) -> Sides:
    """Return cells of one step: name of the action, true pixels, imagined pixels along them."""
    made = tuple(Cell("e", 0, name, np.array([true]), {"m": np.array([along])}) for name, true, along in cells)
    return Sides(made, ("m",), 96, (10, 2))


def test_a_cell_is_right_if_the_hand_moves_along_the_true_displacement() -> None:
    found = sides(("up", 5.0, 1.0), ("down", 5.0, -1.0), ("up", 5.0, 0.0), ("left", 9.0, 3.0))
    up = found.of("m", "z")
    assert (up.right, up.cells, up.left_out) == (1, 3, 0)
    assert found.of("m").right == 2
    share = found.of("m", "y").share
    assert share is not None
    assert share.value == 1.0
    assert share.low < 0.3, "one cell says little"


def test_where_the_hand_hardly_moves_no_side_is_true() -> None:
    found = sides(("forward", 1.9, 5.0), ("back", 2.0, 5.0))
    assert (found.of("m", "x").cells, found.of("m", "x").left_out) == (1, 1)
    assert found.of("m", "z").share is None


def test_every_start_has_a_cell_for_each_direction_and_the_true_hand_moves(simulated: Path, tmp_path: Path) -> None:
    found = measure_sides("builtin:sim-tiny", asked_of_tiny(tmp_path, simulated))
    assert sorted(cell.name for cell in found.cells) == sorted(name for pair in AXES.values() for name in pair)
    assert found.sources == ("decoded_truth", "model")
    assert all(cell.true_px[1] > cell.true_px[0] > 1 for cell in found.cells)
    assert {one.shape for cell in found.cells for one in cell.along_px.values()} == {(2,)}
    assert found.of("model").cells + found.of("model").left_out == 6


def test_data_that_were_not_simulated_are_refused(data_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="were not simulated"):
        measure_sides("builtin:sim-tiny", asked_of_tiny(tmp_path, data_folder))
