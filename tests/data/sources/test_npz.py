""".npz episodes: the arrays are read as written, and unusable files are problems."""

import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs import Gcs
from synthetic import draw_frame, synthetic_states
from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.sources.npz import NpzSource
from vjepa2_ac.errors import InputError

STEPS, SIZE = 20, (36, 64)
STATES = synthetic_states(STEPS)
FRAMES = np.stack([draw_frame(state, size=SIZE) for state in STATES])
WRIST = np.stack([draw_frame(state, size=SIZE, camera=1) for state in STATES])
EPISODE = {"states": STATES, "frames": FRAMES, "fps_hz": 15.0}


def write(path: Path, *, compressed: bool = False, without: str = "", **changes: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: value for name, value in (EPISODE | changes).items() if name != without}
    (np.savez_compressed if compressed else np.savez)(path, **arrays)
    return path


def source(path: Path | str, **options: Any) -> NpzSource:
    return NpzSource(DataConfig(source="npz", path=str(path), **options))


@pytest.mark.parametrize("compressed", [False, True])
def test_episode_equals_the_written_arrays(tmp_path: Path, compressed: bool) -> None:
    write(tmp_path / "kitchen/one.npz", compressed=compressed, success=True, language="pick it up", wrist=WRIST)
    plain = source(tmp_path)
    (info,) = plain.infos()
    assert (info.id, info.num_steps, info.success) == ("kitchen/one", STEPS, True)
    episode = plain.read(0)
    np.testing.assert_array_equal(episode.states, STATES)
    np.testing.assert_array_equal(episode.read_frames([7, 0, 19, 7]), FRAMES[[7, 0, 19, 7]])
    np.testing.assert_array_equal(plain.read(0, "wrist").read_frames([3]), WRIST[[3]])
    assert (episode.control_rate_hz, episode.metadata) == (15.0, {"language": "pick it up"})
    assert episode.extrinsics is None
    assert episode.joint_velocities is None


def test_extrinsics_per_camera_and_commands_are_read(tmp_path: Path) -> None:
    moving = np.arange(STEPS * 6.0).reshape(STEPS, 6)
    arrays = {"extrinsics": np.arange(6.0), "extrinsics_wrist": moving, "joint_velocities": STATES}
    write(tmp_path / "one.npz", wrist=WRIST, **arrays)
    plain = source(tmp_path, pose_frame="camera")
    np.testing.assert_array_equal(plain.read(0).extrinsics, np.tile(np.arange(6.0), (STEPS, 1)))
    np.testing.assert_array_equal(plain.read(0, "wrist").extrinsics, moving)
    np.testing.assert_array_equal(plain.read(0).joint_velocities, STATES)


def test_uncompressed_file_reads_only_requested_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "one.npz")
    episode = source(tmp_path).read(0)
    sizes: list[int] = []

    class CountedFile(io.FileIO):
        def readinto(self, buffer: Any) -> int:
            sizes.append(count := super().readinto(buffer) or 0)
            return count

    monkeypatch.setattr(storage, "open_for_reading", lambda path: io.BufferedReader(CountedFile(path)))
    episode.read_frames([5, 6])
    assert sum(sizes) < FRAMES[:2].nbytes + 4 * io.DEFAULT_BUFFER_SIZE < FRAMES.nbytes / 2


def test_file_changed_after_indexing_raises(tmp_path: Path) -> None:
    path = write(tmp_path / "one.npz")
    plain = source(tmp_path)
    plain.infos()
    write(path, states=STATES[:9], frames=FRAMES[:9])
    with pytest.raises(InputError, match=r"one.npz: 9 steps. Expected 20"):
        plain.read(0)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def flip_in_states(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[data.index(STATES.tobytes()) + 1] ^= 1
    path.write_bytes(data)


NAN = np.where(np.arange(STEPS)[:, None] == 3, np.nan, STATES)

BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "no states": (lambda path: write(path, without="states"), "states: no such array"),
    "rate of zero": (lambda path: write(path, fps_hz=0.0), "fps_hz: 0"),
    "another rate": (lambda path: write(path, fps_hz=30.0), "30 steps per second.*Expected 15 steps per second"),
    "no such camera": (lambda path: write(path, without="frames", wrist=WRIST), "frames: no such array"),
    "mistyped camera": (
        lambda path: write(path, without="frames", frame=FRAMES),
        r"frames: no such array.*Did you mean frame\?",
    ),
    "too few frames": (lambda path: write(path, frames=FRAMES[:-1]), r"frames: shape \(19, 36, 64, 3\)"),
    "float frames": (lambda path: write(path, frames=FRAMES / 255), "frames: shape .* float64"),
    "pickled frames": (lambda path: write(path, frames=np.array([{}, []], object)), "frames: .*objects"),
    "frames in Fortran order": (
        lambda path: write(path, frames=np.asfortranarray(FRAMES)),
        r"frames: frames in Fortran order.*Expected C order.*ascontiguousarray",
    ),
    "states of another width": (lambda path: write(path, states=STATES[:, :6]), r"states: shape \(20, 6\)"),
    "no steps": (lambda path: write(path, states=STATES[:0], frames=FRAMES[:0]), "no steps"),
    "not a number": (lambda path: write(path, states=NAN), "step 3"),
    "poses of another length": (lambda path: write(path, extrinsics=NAN[:4, :6]), r"extrinsics: shape \(4, 6\)"),
    "number for text": (lambda path: write(path, language=3), "language: shape"),
    "truncated": (truncate, "one.npz: cannot be read"),
    "not an archive": (lambda path: path.write_text("<html>404</html>" * 99), "one.npz: cannot be read"),
    "a flipped bit in the states": (flip_in_states, "states: cannot be read .*CRC"),
}


@pytest.mark.parametrize("damage", BROKEN)
def test_unusable_episode_is_a_problem_with_its_name_and_reason(tmp_path: Path, damage: str) -> None:
    write(tmp_path / "a.npz")
    write(tmp_path / "b.npz")
    change, message = BROKEN[damage]
    path = write(tmp_path / "one.npz")
    change(path)
    infos = source(tmp_path).infos()
    assert [info.id for info in infos] == ["a", "b"]
    (problem,) = infos.problems
    assert problem.name == "one"
    with pytest.raises(InputError, match=message):
        raise InputError(where=problem.where, found=problem.found, needed=problem.needed, fix=problem.fix)
    if damage != "another rate":
        (tmp_path / "alone").mkdir()
        shutil.move(path, tmp_path / "alone")
        with pytest.raises(InputError, match=message):
            source(tmp_path / "alone").infos()


@pytest.mark.parametrize("name", ["\udcff.npz", "\udcff/one.npz"])
def test_file_name_that_is_not_utf8_raises(tmp_path: Path, name: str) -> None:
    write(tmp_path / name)
    with pytest.raises(InputError, match=r"udcff.*UTF-8"):
        source(tmp_path).infos()


def test_remote_file_is_fetched_only_once(tmp_path: Path, gcs: Gcs) -> None:
    write(tmp_path / "set" / "one.npz")
    plain = source(gcs.upload(tmp_path / "set", "bucket/own"), disk_cache={"dir": str(tmp_path / "cache")})
    plain.read(0).read_frames([3])
    gcs.forget()
    reopened = source("gs://bucket/own", disk_cache={"dir": str(tmp_path / "cache")})
    np.testing.assert_array_equal(reopened.read(0).read_frames([3]), FRAMES[[3]])
    assert not gcs.reads()
    write(tmp_path / "set" / "one.npz", frames=FRAMES[::-1])
    gcs.upload(tmp_path / "set", "bucket/own")
    changed = source("gs://bucket/own", disk_cache={"dir": str(tmp_path / "cache")})
    np.testing.assert_array_equal(changed.read(0).read_frames([3]), FRAMES[::-1][[3]])
