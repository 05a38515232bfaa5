"""Formats of rotation numbers: a wrong format is detected at jumps, the right format is never rejected."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vjepa2_ac.config.data import RotationFormat
from vjepa2_ac.data.poses import FORMATS, find_smoother_format, measure_rotation_speeds

MAX_RAD_S = 10.0
RATES_HZ = (1.0, 5.0, 15.0, 30.0)
BASES: dict[str, Callable[[np.random.Generator], Rotation]] = {
    "down": lambda rng: Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * Rotation.from_euler("x", np.pi),
    "tilted": lambda rng: Rotation.from_euler("z", rng.normal(0, 0.3)) * Rotation.from_euler("x", np.pi - 0.5),
    "forward": lambda rng: Rotation.from_euler("z", rng.normal(0, 0.3)) * Rotation.from_euler("y", np.pi / 2),
    "near zero": lambda rng: Rotation.from_rotvec(rng.normal(0, 0.2, 3)),
}


def smooth_motion(base: str, seed: int) -> tuple[list[Rotation], float]:
    """Return rotations of a hand that turns around a base rotation, for ten episodes, and their rate in Hz."""
    rng = np.random.default_rng(seed)
    rate_hz, noise_rad = float(rng.choice(RATES_HZ)), float(rng.choice([0.0, 0.0005, 0.003]))
    amplitudes = np.append(np.full(2, rng.uniform(0.05, 0.4)), rng.uniform(0.1, 1.2))
    episodes = []
    for _ in range(10):
        times_s = np.arange(rng.integers(30, 120)) / rate_hz
        waves = [
            np.sin(2 * np.pi * rng.uniform(0.03, 0.3, 3) * times_s[:, None] + rng.uniform(0, 6, 3)) for _ in range(3)
        ]
        turns = Rotation.from_rotvec(amplitudes * np.sum(waves, axis=0) / 2)
        noise = Rotation.from_rotvec(rng.normal(0, noise_rad, (len(times_s), 3)))
        episodes.append(noise * turns * BASES[base](rng))
    return episodes, rate_hz


def numbers_of(rotation: Rotation, rotation_format: RotationFormat) -> np.ndarray:
    if rotation_format == "rotation_vector":
        return np.asarray(rotation.as_rotvec())
    return np.asarray(rotation.as_euler("xyz", degrees=rotation_format == "euler_xyz_degrees"))


def find_smoother_formats(numbers: list[np.ndarray], rate_hz: float) -> dict[RotationFormat, RotationFormat | None]:
    speeds = measure_rotation_speeds(numbers, rate_hz)
    return {configured: find_smoother_format(speeds, configured, MAX_RAD_S) for configured in FORMATS}


def unchanged(numbers: np.ndarray) -> np.ndarray:
    return numbers


def repeated(numbers: np.ndarray) -> np.ndarray:
    return numbers[np.arange(len(numbers)) // 3 * 3]


def with_dropouts(numbers: np.ndarray) -> np.ndarray:
    is_lost = np.random.default_rng(len(numbers)).random(len(numbers)) < 0.05
    return np.where(is_lost[:, None], 0.0, numbers)


def padded(numbers: np.ndarray) -> np.ndarray:
    return np.where(np.arange(len(numbers))[:, None] < 0.8 * len(numbers), numbers, 0.0)


def rounded(numbers: np.ndarray) -> np.ndarray:
    return np.round(numbers, 2)


@pytest.mark.parametrize("rotation_format", FORMATS)
@pytest.mark.parametrize("base", BASES)
def test_correct_rotation_format_is_never_rejected(base: str, rotation_format: RotationFormat) -> None:
    for seed in range(8):
        episodes, rate_hz = smooth_motion(base, seed)
        numbers = [numbers_of(rotations, rotation_format) for rotations in episodes]
        for change in (unchanged, repeated, with_dropouts, padded, rounded):
            assert find_smoother_formats([change(episode) for episode in numbers], rate_hz)[rotation_format] is None, (
                seed,
                change,
            )
        pooled_numbers = [np.concatenate(numbers[first : first + 5]) for first in (0, 5)]
        assert find_smoother_formats(pooled_numbers, rate_hz)[rotation_format] is None, seed


@pytest.mark.parametrize("rotation_format", FORMATS)
@pytest.mark.parametrize("change", [unchanged, repeated, with_dropouts, padded, rounded])
def test_wrong_rotation_format_is_detected_for_a_hand_pointing_down(
    rotation_format: RotationFormat, change: Callable[[np.ndarray], np.ndarray]
) -> None:
    for seed in range(8):
        episodes, rate_hz = smooth_motion("down", seed)
        smoother_formats = find_smoother_formats(
            [change(numbers_of(rotations, rotation_format)) for rotations in episodes], rate_hz
        )
        wrong_formats = [configured for configured in FORMATS if configured != rotation_format]
        assert [smoother_formats[configured] for configured in wrong_formats] == [rotation_format] * 2, seed


def test_numbers_without_jumps_do_not_identify_the_format() -> None:
    numbers = [numbers_of(rotations, "rotation_vector") for rotations in smooth_motion("near zero", 0)[0]]
    speeds = measure_rotation_speeds(numbers, 15.0)
    assert {format_speeds.num_jumps for format_speeds in speeds.values()} == {0}
    assert set(find_smoother_formats(numbers, 15.0).values()) == {None}


def test_rotation_speeds_match_the_rotation_in_each_format() -> None:
    angles = np.linspace(3.0, 3.5, 11)[:, None] * [1.0, 0, 0]
    wrapped = np.where(angles > np.pi, angles - 2 * np.pi, angles) + np.array([0.0, 0.3, 0.0])
    speeds = measure_rotation_speeds([wrapped], 10.0)
    assert speeds["euler_xyz"].median_rad_s == pytest.approx(0.5)
    assert speeds["euler_xyz_degrees"].median_rad_s == pytest.approx(0.5 * np.pi / 180)
    (at_the_wrap,) = speeds["euler_xyz"].at_jumps
    assert at_the_wrap == pytest.approx(1.0)
    assert speeds["rotation_vector"].at_jumps[0] > 5
    assert [format_speeds.num_smooth_jumps for format_speeds in speeds.values()] == [1, 0, 0]


def test_numbers_too_large_or_too_fast_for_radians_are_degrees() -> None:
    degrees = np.linspace(-170.0, -120.0, 40)[:, None] * [1.0, 0, 0] + [0.0, 3.0, 20.0]
    assert [*measure_rotation_speeds([degrees], 10.0)] == ["euler_xyz_degrees"]
    assert find_smoother_formats([degrees], 10.0) == dict.fromkeys(FORMATS, "euler_xyz_degrees") | {
        "euler_xyz_degrees": None
    }
    small = 5 * np.sin(np.arange(60)[:, None] * [1.0, 1.3, 1.7] / 3)
    assert find_smoother_formats([small], 10.0)["euler_xyz"] == "euler_xyz_degrees"
