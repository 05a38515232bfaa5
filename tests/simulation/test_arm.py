"""Images show the arm at its pose in the colours of its domain; with contacts it does the same and moves the block."""

import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from projections import hand_pixel
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.simulation.arm import ContactArm, SimulatedArm
from vjepa2_ac.simulation.camera import View
from vjepa2_ac.simulation.domains import (
    BLOCK_M,
    DOMAIN_A,
    DOMAIN_B,
    FINGER_HALF_M,
    FINGER_INSIDE_M,
    FINGER_OUTSIDE_M,
    FINGER_TRAVEL_M,
    FINGERTIP_M,
    MARK_M,
    SUBSTEPS,
    Domain,
    DomainRanges,
    compile_scene,
    load_mujoco,
    sample_domain,
)
from vjepa2_ac.simulation.motion import CONTROL_RATE_HZ, HIGH, HOME, LOW, forward_kinematics, rest_joints
from vjepa2_ac.spaces import matrices_from_euler

REACHES = HOME + np.array([[0] * 7, [0.4, 0.3, 0.0, 0.4, 0.1, 0.2, 0.5], [-0.6, 0.2, 0.3, -0.2, 0.0, -0.3, 0.0]])


def test_scene_and_kinematics_agree_on_the_flange_pose() -> None:
    model = compile_scene(DOMAIN_A)
    np.testing.assert_array_equal(model.jnt_range[:7].T, [LOW, HIGH])
    data = mujoco.MjData(model)
    for joints in np.random.default_rng(0).uniform(LOW, -LOW, size=(10, 7)):
        data.qpos[:7] = joints
        mujoco.mj_kinematics(model, data)
        pose = forward_kinematics(joints)
        np.testing.assert_allclose(data.site("flange").xpos, pose[:3], atol=1e-9)
        np.testing.assert_allclose(data.site("flange").xmat.reshape(3, 3), matrices_from_euler(pose[3:]), atol=1e-6)


def test_scene_sizes_equal_the_constants_of_tasks() -> None:
    model = compile_scene(DOMAIN_A, block=True, mark=True)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    finger = model.body("finger1").geomadr[0]
    middle, half = model.geom_pos[finger], model.geom_size[finger]
    np.testing.assert_allclose([middle[1] - half[1], middle[1] + half[1]], [FINGER_INSIDE_M, FINGER_OUTSIDE_M])
    np.testing.assert_allclose([half[0], middle[2] + half[2]], [FINGER_HALF_M, FINGERTIP_M])
    np.testing.assert_array_equal(model.joint("finger1").range, [0.0, FINGER_TRAVEL_M])
    np.testing.assert_array_equal(model.geom("block").size, [BLOCK_M / 2] * 3)
    assert model.geom("mark").size[0] == MARK_M
    assert model.opt.timestep * SUBSTEPS == pytest.approx(1 / CONTROL_RATE_HZ, rel=1e-12)


@pytest.mark.parametrize("domain", [DOMAIN_A, DOMAIN_B], ids=["A", "B"])
def test_hand_pixels_match_projected_pose(domain: Domain) -> None:
    arm = SimulatedArm(domain)
    images = []
    for joints in REACHES:
        arm.set_joints(joints + rest_joints(domain) - HOME, 0.0)
        image = arm.image().astype(int)
        column, row = hand_pixel(arm, arm.state).astype(int)
        red, _, blue = image[row, column]
        assert red > 2 * blue  # the hand's colour, which nothing else has
        images.append(image)
    changed = (np.abs(images[0] - images[1]) > 40).any(axis=-1).mean()
    assert 0.03 < changed < 0.6


def test_skipped_rays_change_no_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    sparing, thorough = (SimulatedArm(DOMAIN_B) for _ in range(2))
    for joints in REACHES:
        sparing.set_joints(joints, 0.0)
        thorough.set_joints(joints, 0.0)
        with monkeypatch.context() as patch:
            rendered = sparing.image()
            patch.setattr(View, "near_arm", lambda view, *_: np.arange(len(view.rays)))
            np.testing.assert_array_equal(rendered, thorough.image())


def test_textures_are_random_and_moving_objects_circle_without_contact() -> None:
    ranges = DomainRanges(textures=True, moving=2)
    domain, other = (sample_domain(np.random.default_rng(seed), ranges) for seed in (1, 2))
    plain = replace(domain, texture_seed=0, moving=0)
    assert plain == sample_domain(np.random.default_rng(1)), "all else is drawn as without"
    assert domain.texture_seed != other.texture_seed

    def walls(texture_seed: int) -> np.ndarray:
        return SimulatedArm(replace(plain, texture_seed=texture_seed)).image()

    assert (walls(0) != walls(3)).any(axis=2).mean() > 0.3
    assert (walls(4) != walls(3)).any(axis=2).mean() > 0.3
    images = []
    beside_the_block = replace(domain, clutter_seed=7)  # four of its five things are outside the work area
    for arm in (ContactArm(beside_the_block, mark=True), SimulatedArm(domain)):
        before, block = arm.image(), arm.block
        arm.command_joints(arm.joints, 0.0, 4)
        images.append(arm.image())
        assert 0.001 < (before != images[-1]).any(axis=2).mean() < 0.1, "two small things have moved"
        if block is not None:
            np.testing.assert_allclose(arm.block, block, atol=1e-3)
    repeated = SimulatedArm(domain)
    for _ in range(4):
        repeated.command_joints(repeated.joints, 0.0)
    np.testing.assert_array_equal(repeated.image(), images[-1])


def test_missing_mujoco_raises_with_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(UnreachableError, match=r"MuJoCo.*\[sim\]"):
        load_mujoco()


@pytest.mark.parametrize("domain", [DOMAIN_A, DOMAIN_B], ids=["A", "B"])
def test_contact_arm_in_free_space_follows_like_kinematic_arm(domain: Domain) -> None:
    free, touching = SimulatedArm(domain), ContactArm(domain)
    for step in range(3):
        target = free.state + np.array([0.05, -0.05, -0.04, 0.0, 0.0, 0.0, 0.3])
        free_state, touching_state = free.command(target, 4), touching.command(target, 4)
        np.testing.assert_allclose(touching_state[:3], free_state[:3], atol=2e-3)
        turn = matrices_from_euler(touching_state[3:6]) @ matrices_from_euler(free_state[3:6]).T
        assert np.arccos(min(1.0, (np.trace(turn) - 1) / 2)) < 0.01
        assert touching_state[6] == pytest.approx(free_state[6], abs=0.02), step


def test_block_is_placed_and_falls_on_the_table() -> None:
    arm, block = ContactArm(DOMAIN_B), np.array([0.4, 0.2, 0.25, 0.3])
    arm.place(block, None)
    np.testing.assert_allclose(arm.block, block, atol=1e-9)
    np.testing.assert_allclose(arm._data.body("block").xpos, DOMAIN_B.base_pose()[:3, :3] @ block[:3], atol=1e-9)
    arm.command_joints(arm.joints, 0.0, 15)
    np.testing.assert_allclose(arm.block[:3], [*block[:2], BLOCK_M / 2], atol=5e-3)
