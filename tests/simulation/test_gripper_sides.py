"""Differences to `none` count by their sign, and the simulator's gripper opens or closes on `pick`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from counterfactual_requests import asked_of_tiny
from vjepa2_ac.intervals import share_of
from vjepa2_ac.simulation.gripper_sides import ACTIONS, TRUE_FRAMES, GripperCell, GripperSides, measure_gripper
from vjepa2_ac.simulation.recording.record import RecordingSpec, record_dataset


def latent(read: float, true: float) -> dict[str, np.ndarray]:
    """Return inner products of latents that have one number."""
    return {"m": np.array([read * true]), "decoded_truth": np.array([true * true])}


def sides(*cells: tuple[str, str, float, float]) -> GripperSides:
    """Return cells of one step: episode, name of the action, true difference, difference that is read."""
    made = [
        GripperCell(one, 0, name, np.array([true]), {"m": np.array([read])}, latent(3 * read, true))
        for one, name, true, read in cells
    ]
    return GripperSides(tuple(made), ("m",), 96, (10, 2), {})


def test_a_cell_is_right_if_the_difference_has_the_true_sign() -> None:
    found = sides(("a", "open", -0.9, -0.1), ("a", "close", 0.9, 0.2), ("b", "close", 0.4, -0.2))
    assert (found.of("m", "open").right, found.of("m", "close").right) == (1, 1)
    assert (found.of("m").right, found.of("m").cells) == (2, 3)


def test_a_model_that_ignores_its_actions_is_never_right() -> None:
    found = sides(("a", "open", -0.9, 0.0), ("b", "close", 0.9, 0.0))
    assert found.of("m").right == 0
    extent = found.extent("m")
    assert extent is not None
    assert extent.value == 0


def test_where_the_gripper_was_open_or_closed_already_no_side_is_true() -> None:
    found = sides(("a", "open", -0.24, -0.9), ("a", "close", 0.25, 0.9))
    assert (found.of("m").cells, found.of("m").left_out) == (1, 1)
    assert found.of("m", "open").share is None
    assert found.extent("m", "open") is None


def test_extent_is_what_is_read_over_what_is_true() -> None:
    found = sides(("a", "open", -0.8, -0.4), ("b", "close", 0.4, 0.2), ("c", "close", 0.8, -0.4))
    whole, opened = found.extent("m"), found.extent("m", "open")
    assert whole is not None
    assert opened is not None
    assert whole.value == pytest.approx(0.2 / 2.0)
    assert opened.value == pytest.approx(0.5)
    in_latents = found.extent_in_latents("m", "open")
    assert in_latents is not None
    assert in_latents.value == pytest.approx(1.5)
    assert found.extent_in_latents("truth") is None, "frames are no latents"


def test_the_true_gripper_closes_under_close_and_opens_under_open(tmp_path: Path) -> None:
    data = record_dataset(tmp_path / "data", RecordingSpec("A", 13, seed=4, task="pick"), episodes=8)
    found = measure_gripper("builtin:sim-tiny", asked_of_tiny(tmp_path, data))
    assert [cell.name for cell in found.cells] == list(ACTIONS)
    assert found.sources == (TRUE_FRAMES, "decoded_truth", "model")
    opened, closed = (cell.true for cell in found.cells)
    assert (closed - opened > 0.25).all(), "the whole way, or to the block"
    assert (closed >= -0.01).all()
    assert (opened <= 0.01).all()


def test_the_true_frames_show_what_the_simulator_measures(tmp_path: Path) -> None:
    data = record_dataset(tmp_path / "data", RecordingSpec("A", 14, seed=4), episodes=16)
    found = measure_gripper("builtin:sim-tiny", replace(asked_of_tiny(tmp_path, data), starts=3))
    assert found.of(TRUE_FRAMES).share == share_of(3, 3), "the gripper is either open or closed: one action counts"
    assert found.readings[TRUE_FRAMES].error < 0.8 * found.readings[TRUE_FRAMES].error_of_mean
    whole = found.extent_in_latents("decoded_truth")
    assert whole is not None
    assert whole.value == 1
    assert {values.shape for cell in found.cells for values in cell.read.values()} == {(2,)}
