"""The projection of a point is the pixel through which the camera casts the ray to it."""

import numpy as np
import pytest

from vjepa2_ac.simulation.world.camera import RayCamera, exterior_pose, hand_pixels, pixels_of
from vjepa2_ac.simulation.world.domains import DOMAIN_A, DOMAIN_B, Domain
from vjepa2_ac.simulation.world.motion import forward_kinematics, rest_joints

pytest.importorskip("mujoco", reason="the extra `sim` is not installed")

from vjepa2_ac.simulation.world.arm import SimulatedArm

SIZE = (18, 32)


@pytest.mark.parametrize("camera", ["exterior_1", "exterior_2"])
@pytest.mark.parametrize("domain", [DOMAIN_A, DOMAIN_B], ids=["A", "B"])
def test_points_on_the_ray_of_a_pixel_are_in_that_pixels_middle(domain: Domain, camera: str) -> None:
    pose = exterior_pose(domain, camera)
    eye = SimulatedArm(domain, size=SIZE)._camera(camera)
    assert isinstance(eye, RayCamera)
    eye.image(SimulatedArm(domain)._data)
    assert eye._background is not None
    points = eye._background.spots  # what each pixel shows
    rows, columns = np.divmod(np.arange(len(points)), SIZE[1])
    found = pixels_of(np.asarray(points, dtype=float), pose, domain, SIZE)
    np.testing.assert_allclose(found, np.stack([columns + 0.5, rows + 0.5], axis=1), atol=1e-3)
    assert np.isnan(pixels_of(2 * pose[:3, 3][None] - points[:1], pose, domain, SIZE)).all()  # behind it


@pytest.mark.parametrize("domain", [DOMAIN_A, DOMAIN_B], ids=["A", "B"])
def test_the_hands_colour_is_where_the_hand_is_projected_to(domain: Domain) -> None:
    joints = rest_joints(domain)[None]
    states = np.concatenate([forward_kinematics(joints), [[0.0]]], axis=1)
    column, row = hand_pixels(states, domain)[0].astype(int)
    red, _, blue = SimulatedArm(domain).image()[row, column].astype(int)
    assert red > 2 * blue
    np.testing.assert_allclose(hand_pixels(states, domain, size=(360, 640)), 2 * hand_pixels(states, domain))


def test_the_wrists_camera_does_not_see_its_hand_move() -> None:
    with pytest.raises(ValueError, match="no camera 'wrist' that stands still"):
        hand_pixels(np.zeros((1, 7)), DOMAIN_A, "wrist")
