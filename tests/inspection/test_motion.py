"""Faults of motion, rotation formats and episode ends are reported, and clean data give no warning."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_sets import STATE, recorded, write_v30
from vector_sets import write_vectors
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.inspection import motion
from vjepa2_ac.inspection.coverage import select_sample
from vjepa2_ac.inspection.findings import Finding
from vjepa2_ac.inspection.motion import (
    Stretch,
    check_motion,
    check_speed,
    warnings_from_index,
)

STEPS, RATE_HZ = 40, 10.0
Pair = tuple[np.ndarray, np.ndarray]


def states_of(number: int, steps: int = STEPS) -> np.ndarray:
    """Return poses of a flange that points down and moves smoothly; roll and yaw pass pi."""
    rng, time_s = np.random.default_rng(number), np.arange(steps)[:, None] / RATE_HZ
    waves = np.sin(rng.uniform(0.5, 2.0, 7) * time_s + rng.uniform(0, 6, 7))
    states = np.array([0.5, 0.0, 0.3, np.pi, 0.1, np.pi, 0.5]) + waves * [0.1, 0.2, 0.1, 0.2, 0.2, 0.6, 0.5]
    states[:, 3:6] = (states[:, 3:6] + np.pi) % (2 * np.pi) - np.pi
    return states


def frames_of(states: np.ndarray) -> np.ndarray:
    """Return frames with a bright disc at the position of each pose."""
    rows, columns = np.mgrid[:36, :48]
    distance = (rows - 18 + 40 * (states[:, 2] - 0.3)[:, None, None]) ** 2
    distance = distance + (columns - 24 - 40 * states[:, 1, None, None]) ** 2
    grey = 60 + 150 * np.exp(-distance / 40)
    return np.repeat(grey[..., None], 3, axis=3).astype(np.uint8)


def clean(number: int) -> Pair:
    states = states_of(number)
    return states, frames_of(states)


def padded(number: int) -> Pair:
    states, frames = clean(number)
    end = STEPS - 5 * (1 + number % 2)
    states[end:], frames[end:] = 0, 0
    return states, frames


def with_black_first_frame(number: int) -> Pair:
    states, frames = clean(number)
    frames[0] = 0
    return states, frames


def join_recordings(number: int) -> Pair:
    (first_states, first_frames), (second_states, second_frames) = clean(number), clean(100 + number)
    second_states[:, 0] += 0.4
    return np.concatenate([first_states, second_states]), np.concatenate([first_frames, second_frames])


def with_frozen_camera(number: int) -> Pair:
    states, frames = clean(number)
    frames[:8] = frames[8]
    return states, frames


def near_the_base(number: int) -> Pair:
    """Return poses relative to the first state of the episode, which is exactly zero."""
    states, frames = clean(number)
    states[:, :3] -= states[0, :3]
    first = Rotation.from_euler("xyz", states[0, 3:6])
    states[:, 3:6] = (Rotation.from_euler("xyz", states[:, 3:6]) * first.inv()).as_euler("xyz")
    states[0, 3:6] = 0
    return states, frames


def with_idle_ends(number: int) -> Pair:
    states, frames = clean(number)
    order = np.clip(np.arange(STEPS), 8, 30)
    return states[order], frames[order]


def config_of(
    folder: Path, make: Callable[[int], Pair], *, rate_hz: float = RATE_HZ, episodes: int = 6, **changes: object
) -> DataConfig:
    folder.mkdir(exist_ok=True)
    for number in range(episodes):
        states, frames = make(number)
        np.savez(folder / f"{number:03d}.npz", states=states, frames=frames, fps_hz=rate_hz)
    values = {"source": "npz", "path": str(folder), "frames": 3, "stride": 2, "test_share": 0.0, "workers": 0}
    return DataConfig.model_validate(values | changes)


def findings_of(config: DataConfig) -> dict[str, Finding]:
    return {finding.about: finding for finding in check_motion(open_dataset(config))}


def read_warnings(config: DataConfig) -> dict[str, str]:
    return {
        name: finding.text for name, finding in findings_of(config).items() if finding.level in {"warning", "error"}
    }


@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
@pytest.mark.parametrize("make", [clean, near_the_base, with_idle_ends])
def test_clean_motion_has_no_warning_at_any_rate(tmp_path: Path, make: Callable[[int], Pair], rate_hz: float) -> None:
    findings = findings_of(config_of(tmp_path / "set", make, rate_hz=rate_hz))
    assert {finding.level for finding in findings.values()} <= {"ok", "skipped"}
    assert findings["speed"].text.endswith("between control steps (6 of 6 episodes checked)")
    assert [name for name, finding in findings.items() if finding.level == "skipped"] == (
        ["scale", *(["rotation format"] if make is near_the_base else [])]
    )


def test_padding_finding_has_the_steps_and_black_frames_are_counted(tmp_path: Path) -> None:
    warnings = read_warnings(config_of(tmp_path / "set", padded))
    assert set(warnings) == {"speed", "padding", "episode ends"}
    assert warnings["padding"].startswith("45 states in 6 episodes with a position and a rotation of exactly zero")
    assert re.search(r"Example: 00[135], steps 30 to 39\.", warnings["padding"])
    fast = (
        "faster than 2.5 m/s or 10 rad/s, which no arm reaches: 6 control steps in 6 episodes (6 of 6 episodes checked)"
    )
    assert warnings["speed"].startswith(fast)
    assert warnings["episode ends"].startswith("45 black and 0 frozen frames")
    assert re.search(r"Example: 00[135], the last 10 frames are black\.", warnings["episode ends"])


def test_single_black_frame_is_described_in_the_singular(tmp_path: Path) -> None:
    warnings = read_warnings(config_of(tmp_path / "set", with_black_first_frame))
    assert re.search(r"Example: 00\d, the first frame is black\.", warnings["episode ends"])


def test_speed_example_is_the_step_between_joined_recordings(tmp_path: Path) -> None:
    warnings = read_warnings(config_of(tmp_path / "set", join_recordings))
    assert set(warnings) == {"speed"}
    assert f"step {STEPS - 1} to {STEPS}: " in warnings["speed"]
    states = join_recordings(0)[0]
    stretch = Stretch("e", 7, np.concatenate([states[:40], states[40:]]))
    text = check_speed([stretch], RATE_HZ, "1 of 1 episode checked").text
    jump_m = np.linalg.norm(states[40, :3] - states[39, :3])
    assert f"Example: e, step 46 to 47: {RATE_HZ * jump_m:.1f} m/s" in text


def with_one_outlier(number: int) -> Pair:
    states, frames = clean(number)
    states[7, 0] *= 8 if number == 4 else 1
    return states, frames


@pytest.mark.parametrize("num_sampled", [200, 1])
def test_single_impossible_position_in_one_episode_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, num_sampled: int
) -> None:
    monkeypatch.setattr(motion, "_EPISODES", num_sampled)
    config = config_of(tmp_path / "set", with_one_outlier)
    assert (open_dataset(config).table.find("004") in select_sample(open_dataset(config), num_sampled)) == (
        num_sampled > 1
    )
    for text in (
        read_warnings(config)["speed"],
        *(item.text for item in warnings_from_index(open_dataset(config))),
    ):
        assert ": 2 control steps in 1 episode (" in text
        assert "Example: 004, step " in text
        assert re.search(r"step (6 to 7|7 to 8): \d\d\.\d m/s", text)
    assert ("6 by the index" in read_warnings(config)["speed"]) == (num_sampled == 1)
    assert not warnings_from_index(open_dataset(config_of(tmp_path / "clean", clean)))


def test_blank_frames_are_reported_with_episodes_and_not_as_a_frozen_camera(tmp_path: Path) -> None:
    def make(number: int) -> Pair:
        states, frames = clean(number)
        if number in (2, 4):
            frames[5:-5] = 40 * number - 80
        return states, frames

    warnings = read_warnings(config_of(tmp_path / "set", make))
    assert set(warnings) == {"blank frames"}
    assert warnings["blank frames"].startswith("the middle frame is black or uniform in 2 of 6 episodes checked: 00")


def scaled(factor: float, numbers: Sequence[int]) -> Callable[[int], Pair]:
    def make(number: int) -> Pair:
        states, frames = clean(number)
        states[:, :3] *= factor if number in numbers else 1
        return states, frames

    return make


def test_episodes_at_another_scale_are_counted(tmp_path: Path) -> None:
    half = config_of(tmp_path / "half", scaled(0.5, range(0, 12, 2)), episodes=12)
    (warning,) = warnings_from_index(open_dataset(half))
    assert warning.about == "scale"
    assert re.match(
        r"6 episodes, such as 0(0|1)\d, have positions and motions (1.9|2.0)\d times as large", warning.text
    )
    assert findings_of(half)["scale"] == warning
    for name, make in {
        "clean": clean,
        "one": scaled(0.5, [3]),
        "moved": moved_in_x,
        "any size": scale_by_number,
    }.items():
        assert findings_of(config_of(tmp_path / name, make, episodes=12))["scale"].level == "ok", name


def scale_by_number(number: int) -> Pair:
    """Return the motion of episodes that differ in scale, but not in two groups."""
    return scaled(0.3 * (1 / 0.3) ** (number / 11), range(12))(number)


def moved_in_x(number: int) -> Pair:
    """Return the motion of a second station, farther from the base in one direction only."""
    states, frames = clean(number)
    states[:, 0] += 0.6 * (number % 2)
    return states, frames


def test_frozen_camera_is_counted_where_the_robot_moves(tmp_path: Path) -> None:
    warnings = read_warnings(config_of(tmp_path / "set", with_frozen_camera))
    assert warnings.keys() == {"episode ends"}
    assert warnings["episode ends"].startswith("0 black and 54 frozen frames")
    assert "the first 9 frames are one image while the robot moves" in warnings["episode ends"]


def test_checks_that_need_poses_or_frames_are_skipped_for_vectors_and_latent_caches(tmp_path: Path) -> None:
    values = {"source": "npz", "path": str(write_vectors(tmp_path / "set", width=7)), "states": "vector"}
    config = DataConfig.model_validate(values | {"frames": 3, "stride": 2, "workers": 0})
    findings = findings_of(config)
    assert [finding.level for finding in findings.values()] == ["skipped"] * 4 + ["ok"] * 2
    assert findings["speed"].text == "needs poses (data.states: pose), found vectors"


# ---- rotation formats ----


def written_as(folder: Path, numbers_of: Callable[[Rotation], np.ndarray], rotation: str) -> DataConfig:
    """Write LeRobot episodes of the same motion whose rotation numbers have another format than configured."""
    episodes = []
    for number in range(4):
        episode, states = recorded(number, STEPS), states_of(number)
        pose = np.concatenate([states[:, :3], numbers_of(Rotation.from_euler("xyz", states[:, 3:6]))], axis=1)
        episodes.append(replace(episode, columns={**episode.columns, STATE[0]: pose.astype(np.float32)}))
    values = {"source": "lerobot", "path": str(write_v30(folder, episodes)), "frames": 3, "stride": 2, "workers": 0}
    return DataConfig.model_validate(values | {"test_share": 0.0, "lerobot": {"rotation": rotation}})


FORMATS: dict[str, Callable[[Rotation], np.ndarray]] = {
    "euler_xyz": lambda rotation: rotation.as_euler("xyz"),
    "rotation_vector": lambda rotation: rotation.as_rotvec(),
    "euler_xyz_degrees": lambda rotation: rotation.as_euler("xyz", degrees=True),
}


@pytest.mark.parametrize("true", ["euler_xyz", "rotation_vector"])
@pytest.mark.parametrize("configured", FORMATS)
def test_wrong_rotation_format_is_a_warning_with_the_right_format(tmp_path: Path, true: str, configured: str) -> None:
    config = written_as(tmp_path / "set", FORMATS[true], configured)
    finding = findings_of(config)["rotation format"]
    assert finding.level == ("ok" if true == configured else "warning"), finding
    if true == configured:
        assert f"read as {true}, the rotation is smooth at" in finding.text
    else:
        assert finding.text.endswith(f"Set data.lerobot.rotation: {true}")
