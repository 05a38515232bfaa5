"""Captioned frames: images side by side, enlarged and unchanged, with captions above."""

import numpy as np

from vjepa2_ac.media.figure import side_by_side


def test_images_stand_side_by_side_below_their_words() -> None:
    images = [np.full((20, 60, 3), shade, dtype=np.uint8) for shade in (50, 120)]
    frame = side_by_side(images, ["a", "b"], "both")
    body = frame[-40:]
    assert (body[:, :120] == 50).all()
    assert (body[:, -120:] == 120).all()
    head = frame[:-40]
    assert head.min() < 80 < head.max() == 255  # ink on white
    assert (side_by_side(images, ["a", "$x_{"], "both") != frame).any()  # dollars begin no formula
    assert (side_by_side(images, ["a", "b"], "other") != frame).any()
