"""Where the hand is in what the encoder sees: cropped and squashed as the frames are; or why nobody knows."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.transforms import view
from vjepa2_ac.simulation.hand_in_images import as_seen, hand_positions


@pytest.mark.parametrize("crop", ["released", "square", "letterbox"])
def test_a_position_goes_where_its_pixel_goes(crop) -> None:
    frames = np.zeros((1, 180, 320, 3), np.uint8)
    frames[0, 60:64, 150:154] = 255
    seen = view(frames, crop)[0, :, :, 0]
    rows, columns = np.nonzero(seen)
    height, width = seen.shape
    expected = (columns.mean() + 0.5) * 96 / width, (rows.mean() + 0.5) * 96 / height
    np.testing.assert_allclose(as_seen(np.array([[152.0, 62.0]]), crop, 96)[0], expected)


def test_the_hand_is_red_where_it_is_said_to_be(simulated: Path) -> None:
    """In domain B nothing else at such a height is: its colour is that of the hand's `Look`."""
    dataset = open_dataset(DataConfig(path=str(simulated), frames=3, stride=2))
    positions = hand_positions(dataset, 180)
    assert callable(positions)
    episode = dataset.source.read(0, dataset.config.cameras[0])
    frames = view(episode.read_frames(range(14)), "released").astype(float)
    x, y = (positions(episode.info.id, episode.states) * (frames.shape[2] / 180, frames.shape[1] / 180)).T
    redness = [
        frames[step, int(y[step]) - 4 : int(y[step]) + 5, int(x[step]) - 4 : int(x[step]) + 5] @ (1, -0.5, -0.5)
        for step in range(14)
    ]
    everywhere = frames @ (1, -0.5, -0.5)
    assert np.mean([one.max() for one in redness]) > 60 > everywhere.mean() + 30


def test_of_other_data_the_reason_is_given(simulated: Path, data_folder: Path) -> None:
    assert "were not simulated" in hand_positions(
        open_dataset(DataConfig(path=str(data_folder), frames=3, stride=2)), 96
    )
    vectors = DataConfig(path=str(simulated), frames=3, stride=2, states="vector")
    assert "not poses" in hand_positions(open_dataset(vectors), 96)
