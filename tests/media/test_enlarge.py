"""Enlarged frames: the same scene, larger."""

import numpy as np
import pytest

from vjepa2_ac.media.enlarge import enlarged


def test_plain_areas_keep_their_colour_and_their_place() -> None:
    frame = np.full((24, 36, 3), 200, dtype=np.uint8)
    frame[:, 12:] = (10, 90, 160)
    large = enlarged(frame, 3)
    assert large.shape == (72, 108, 3)
    assert (large[:, :27] == 200).all()
    assert (large[:, 45:] == (10, 90, 160)).all()


def test_a_factor_of_one_changes_nothing_and_none_is_refused() -> None:
    frame = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    np.testing.assert_array_equal(enlarged(frame, 1), frame)
    with pytest.raises(ValueError, match="factor of 0"):
        enlarged(frame, 0)
