"""DROID's raw recordings: states, frames, cameras, and errors of damaged episodes."""

import pickle
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from gcs import Gcs
from recordings import write_mp4, write_raw_droid
from synthetic import draw_frame, synthetic_states
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.droid_raw import RawDroidSource
from vjepa2_ac.errors import InputError
from vjepa2_ac.media import video as video_reader

STEPS, SIZE = 24, (72, 128)
LEFT, RIGHT, WRIST = "23404442", "29838012", "16787047"
IDENTITY = "LAB/success/2023-07-07/Fri_Jul__7_09:42:23_2023"
STATES = synthetic_states(STEPS)
FRAMES = {
    serial: [draw_frame(state, size=SIZE, camera=camera) for state in STATES]
    for camera, serial in enumerate((LEFT, RIGHT, WRIST))
}


def write(root: Path, folder: str = IDENTITY, **changes: Any) -> Path:
    return write_raw_droid(root / folder, STATES, **{"frames_by_serial": FRAMES, "gop": 8, **changes})


def source(path: Path, **values: Any) -> RawDroidSource:
    return RawDroidSource(DataConfig(source="droid_raw", path=str(path), **values))


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((first.astype(float) - second) ** 2)))


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes, one a failure; changed by no test."""
    root = tmp_path_factory.mktemp("raw")
    write(root, frames_by_serial={LEFT: FRAMES[LEFT]})
    write(root, "LAB/failure/2023-07-07/Fri_Jul__7_09:50:00_2023", frames_by_serial={LEFT: FRAMES[LEFT]}, success=False)
    return root


def test_episode_has_measured_states_task_and_outcome(tree: Path) -> None:
    raw = source(tree)
    infos = raw.infos()
    assert [info.success for info in infos] == [False, True]
    assert infos[1].id == IDENTITY
    episode = raw.read(1)
    np.testing.assert_array_equal(episode.states, STATES)
    assert (episode.control_rate_hz, episode.metadata) == (15.0, {"language": "move to place 0"})


def test_cameras_are_selected_by_name_or_serial_number(tmp_path: Path) -> None:
    write(tmp_path)
    for camera, serial in (("left", LEFT), ("right", RIGHT), ("wrist", WRIST), (RIGHT, RIGHT)):
        for episode in (source(tmp_path, camera=camera).read(0), source(tmp_path).read(0, camera)):
            assert psnr(episode.read_frames([7])[0], FRAMES[serial][7]) > 30


def test_mistyped_camera_name_raises_with_a_suggestion(tmp_path: Path) -> None:
    write(tmp_path)
    with pytest.raises(InputError, match=r"wirst\.mp4: no such file.*Did you mean wrist\?"):
        source(tmp_path, camera="wirst").infos()


@pytest.mark.parametrize("part", ["", "LAB", "LAB/success", IDENTITY])
def test_identity_is_independent_of_the_configured_subfolder(tree: Path, part: str) -> None:
    assert IDENTITY in [info.id for info in source(tree / part).infos()]


@pytest.mark.parametrize("frames", [STEPS - 1, STEPS, STEPS + 1])
def test_episode_length_is_limited_by_states_and_frames(tmp_path: Path, frames: int) -> None:
    write(tmp_path, frames_by_serial={LEFT: (FRAMES[LEFT] * 2)[:frames]})
    raw = source(tmp_path)
    steps = min(frames, STEPS)
    assert [info.num_steps for info in raw.infos()] == [steps]
    assert len(raw.read(0).states) == steps
    with pytest.raises(ValueError, match="steps"):
        raw.read(0).read_frames([steps])


def test_steps_without_operator_are_dropped_with_their_frames(tmp_path: Path) -> None:
    skipped = [0, 5, 6]
    used_steps = np.setdiff1d(np.arange(STEPS), skipped)
    poses = np.arange(STEPS * 6.0).reshape(STEPS, 6) / 100
    write(tmp_path, skipped=skipped, extrinsics={LEFT: poses}, joint_velocities=np.ones((STEPS, 7)) * poses[:, :1])
    episode = source(tmp_path).read(0)
    np.testing.assert_array_equal(episode.states, STATES[used_steps])
    np.testing.assert_array_equal(episode.extrinsics, poses[used_steps])
    np.testing.assert_array_equal(episode.joint_velocities[:, 3], poses[used_steps, 0])
    assert psnr(episode.read_frames([0, 4])[1], FRAMES[LEFT][7]) > 30


def test_extrinsics_belong_to_the_selected_camera(tmp_path: Path) -> None:
    static, moving = np.tile(np.arange(6.0), (STEPS, 1)), np.arange(STEPS * 6.0).reshape(STEPS, 6)
    write(tmp_path, extrinsics={LEFT: static, WRIST: moving})
    np.testing.assert_array_equal(source(tmp_path, camera="wrist").read(0).extrinsics, moving)
    np.testing.assert_array_equal(source(tmp_path).read(0).extrinsics, static)
    assert source(tmp_path, camera="right").read(0).extrinsics is None
    with pytest.raises(InputError, match="pose_frame"):
        source(tmp_path, camera="right", pose_frame="camera").infos()


@pytest.mark.parametrize("b_frames", [0, 2])
def test_trajectory_and_video_are_parsed_once_per_machine(
    tmp_path: Path, b_frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "raw", frames_by_serial={LEFT: FRAMES[LEFT]}, b_frames=b_frames)
    cache = {"dir": str(tmp_path / "cache")}
    first = source(tmp_path / "raw", disk_cache=cache).read(0)
    frames = first.read_frames([3, 17])
    monkeypatch.setattr(h5py.h5f, "open_file_image", lambda _: pytest.fail("parsed again"))
    packets, times = video_reader._Video.packets, []

    def counted(self: video_reader._Video, *arguments: int) -> Iterator[object]:
        for packet in packets(self, *arguments):
            times.append(packet.pts)
            yield packet

    monkeypatch.setattr(video_reader._Video, "packets", counted)
    other = source(tmp_path / "raw", disk_cache=cache).read(0)
    np.testing.assert_array_equal(other.states, first.states)
    np.testing.assert_array_equal(other.read_frames([3, 17]), frames)
    assert len(times) < STEPS


def change_trajectory(change: Callable[[h5py.File], object]) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        with h5py.File(folder / "trajectory.h5", "r+") as file:
            change(file)

    return apply


def set_array(name: str, value: Any) -> Callable[[Path], object]:
    def change(file: h5py.File) -> None:
        if name in file:
            del file[name]
        if value is not None:
            file[name] = value

    return change_trajectory(change)


def cut(name: str, fraction: float) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        (path,) = folder.glob(name)
        path.write_bytes(path.read_bytes()[: int(path.stat().st_size * fraction)])

    return apply


POSE, GRIPPER = "observation/robot_state/cartesian_position", "observation/robot_state/gripper_position"
MP4 = f"recordings/MP4/{LEFT}.mp4"
ONE_NAN = np.where(np.arange(STEPS)[:, None] == 3, np.nan, STATES[:, :6])

BROKEN = {
    "no trajectory": (lambda folder: (folder / "trajectory.h5").unlink(), "trajectory.h5"),
    "no metadata": (lambda folder: next(folder.glob("*.json")).unlink(), "metadata"),
    "no video": (lambda folder: (folder / MP4).unlink(), f"{LEFT}.mp4: no such file"),
    "no key": (
        set_array(GRIPPER, None),
        "gripper_position: no such array; group observation/robot_state contains cartesian_position",
    ),
    "text for numbers": (set_array(POSE, np.full((STEPS, 6), b"x")), "kind"),
    "shorter gripper": (set_array(GRIPPER, STATES[:-1, 6]), "gripper: values for 23 of 24 steps"),
    "no steps": (set_array(POSE, np.zeros((0, 6))), "no steps"),
    "not a number": (set_array(POSE, ONE_NAN), "step 3"),
    "out of reach": (set_array(POSE, STATES[:, :6] + [6, 0, 0, 0, 0, 0]), "5 m"),
    "all steps skipped": (set_array("observation/timestamp/skip_action", np.ones(STEPS, bool)), "no steps"),
    "cut trajectory": (cut("trajectory.h5", 0.5), "trajectory.h5: .*HDF5"),
    "cut metadata": (cut("*.json", 0.5), "invalid JSON"),
    "no such camera": (lambda folder: next(folder.glob("*.json")).write_text("{}"), "left_mp4_path"),
    "cut video": (cut(MP4, 0.5), f"{LEFT}.mp4"),
    "video two frames short": (lambda folder: write_mp4(folder / MP4, FRAMES[LEFT][:-2]), "but 22 frames"),
}  # fmt: skip


@pytest.mark.parametrize("damage", BROKEN)
def test_unusable_episode_is_a_problem_with_its_name_and_reason(tree: Path, tmp_path: Path, damage: str) -> None:
    root = shutil.copytree(tree, tmp_path / "raw")
    change, message = BROKEN[damage]
    change(root / IDENTITY)
    infos = source(root).infos()
    assert len(infos) == 1
    (problem,) = infos.problems
    assert problem.name == IDENTITY
    assert re.search(message, str(InputError(where=problem.where, found=problem.found, needed=problem.needed)))
    with pytest.raises(InputError, match=message):
        source(root / IDENTITY).infos()


def test_remote_tree_equals_local_tree(tree: Path, gcs: Gcs, tmp_path: Path) -> None:
    url, local = gcs.upload(tree, "bucket/droid_raw/1.0.1"), source(tree)
    raw = source(url, disk_cache={"dir": str(tmp_path)})
    assert list(raw.infos()) == list(local.infos())
    episode, same = raw.read(1), local.read(1)
    np.testing.assert_array_equal(episode.states, same.states)
    np.testing.assert_array_equal(episode.read_frames([3, 20]), same.read_frames([3, 20]))
    gcs.forget()
    unpickled = pickle.loads(pickle.dumps(raw))  # noqa: S301 - our own bytes
    np.testing.assert_array_equal(unpickled.read(1).read_frames([7]), same.read_frames([7]))
    assert gcs.requests == []  # the content and the length of the video are cached
