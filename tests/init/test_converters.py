"""Each converter makes of its form what was recorded, and says what is wrong; `data converter` prints it."""

import csv
import io
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pyarrow import parquet
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from paths import GOLDEN, ROOT
from synthetic import draw_frame, synthetic_states
from vjepa2_ac import open_dataset
from vjepa2_ac.cli import main
from vjepa2_ac.init.look import look_at
from vjepa2_ac.media.video import write_video

STEPS, RATE_HZ = 20, 10.0
STATES = synthetic_states(STEPS, seed=1)
FRAMES = np.stack([draw_frame(state, size=(64, 96), camera=0) for state in STATES])
TYPES = get_typestore(Stores.ROS2_HUMBLE)


@pytest.fixture(params=["mp4_and_csv", "ros2_bag", "lance_to_files"])
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def run(script: str, *words: object) -> None:
    """Run a converter in this process."""
    before = sys.argv
    sys.argv = [script, *map(str, words)]
    try:
        runpy.run_path(str(ROOT / f"examples/convert/{script}.py"), run_name="__main__")
    finally:
        sys.argv = before


def test_the_command_prints_it_whole_and_lists_it(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "converter", name]) == 0
    assert capsys.readouterr().out == (ROOT / f"examples/convert/{name}.py").read_text()
    assert main(["data", "converter"]) == 0
    assert name in capsys.readouterr().out
    assert main(["data", "converter", f"../{name}"]) == 2
    assert "needed: one of lance_to_files, mp4_and_csv, ros2_bag" in capsys.readouterr().err


# Videos and tables.


def write_recording(folder: Path, *, header: str = "x,y,z,roll,pitch,yaw,gripper", rows: np.ndarray = STATES) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_video(folder / "first.mp4", FRAMES, rate_hz=RATE_HZ)
    with (folder / "first.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([header.split(","), *rows.tolist()])
    return folder


def states_in(folder: Path) -> np.ndarray:
    dataset = open_dataset(folder, source="npz", frames=3, stride=2, validation_share=0.0, test_share=0.0)
    assert dataset.control_rate_hz == RATE_HZ
    return np.asarray(dataset.source.read(0).states)


def with_quaternions() -> np.ndarray:
    return np.concatenate([STATES[:, :3], Rotation.from_euler("xyz", STATES[:, 3:6]).as_quat(), STATES[:, 6:]], axis=1)


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        ("x,y,z,roll,pitch,yaw,gripper", STATES),
        ("x,y,z,qx,qy,qz,qw,gripper", with_quaternions()),
        ("time,x,y,z,roll,pitch,yaw,gripper", np.insert(STATES, 0, np.arange(STEPS) / RATE_HZ + 0.02, axis=1)[::-1]),
    ],
    ids=["angles", "quaternions", "times, in any order"],
)
def test_videos_and_tables_become_episodes(header: str, rows: np.ndarray, tmp_path: Path) -> None:
    run("mp4_and_csv", write_recording(tmp_path / "own", header=header, rows=rows), tmp_path / "npz", "--height", 32)
    assert np.abs(states_in(tmp_path / "npz") - STATES).max() < 1e-6
    with np.load(tmp_path / "npz/first.npz") as file:
        assert file["frames"].shape == (STEPS, 32, 48, 3)
        smaller = [np.asarray(Image.fromarray(frame).resize((48, 32))) for frame in FRAMES]
        assert np.abs(file["frames"] - np.stack(smaller).astype(float)).mean() < 12  # of 255: a codec and two resizers


def drop_table(folder: Path) -> None:
    (folder / "first.csv").unlink()


@pytest.mark.parametrize(
    ("changes", "spoil", "found"),
    [
        ({"rows": STATES[:-2]}, None, "18 rows for 20 frames"),
        ({"header": "x,y,z,roll,pitch,yaw,grip"}, None, "no column gripper; it has grip, pitch"),
        ({}, drop_table, "no table of poses beside it, first.csv"),
        (
            {"header": "time,x,y,z,roll,pitch,yaw,gripper", "rows": np.insert(STATES, 0, 1.7e9, axis=1)},
            None,
            "is `time` 0 at the first frame",
        ),
    ],
    ids=["lengths", "column", "no table", "another clock"],
)
def test_a_recording_that_does_not_fit_says_why(
    changes: dict[str, Any], spoil: Callable[[Path], None] | None, found: str, tmp_path: Path
) -> None:
    folder = write_recording(tmp_path / "own", **changes)
    if spoil is not None:
        spoil(folder)
    with pytest.raises(SystemExit, match=found):
        run("mp4_and_csv", folder, tmp_path / "npz")
    assert not list(tmp_path.rglob("*.npz"))


# ROS bags.


def messages(*, encoding: str, skip: range = range(0)) -> Iterator[tuple[str, str, float, Any]]:
    """Yield topic, type, time in seconds, and message; the camera's are 20 ms late, so that the newest is its own."""
    kinds = TYPES.types
    header = kinds["std_msgs/msg/Header"](stamp=kinds["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="")
    for step, (state, frame) in enumerate(zip(STATES, FRAMES, strict=True)):
        time, grip = step / RATE_HZ, 0.04 * (1 - state[6])
        turned = kinds["geometry_msgs/msg/Quaternion"](*Rotation.from_euler("xyz", state[3:6]).as_quat())
        pose = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](*state[:3]), turned)
        yield "/pose", "geometry_msgs/msg/PoseStamped", time, kinds["geometry_msgs/msg/PoseStamped"](header, pose)
        fingers = kinds["sensor_msgs/msg/JointState"](header, [], np.array([grip, grip]), np.zeros(0), np.zeros(0))
        yield "/fingers", "sensor_msgs/msg/JointState", time, fingers
        if step in skip:
            continue
        if encoding == "jpeg":
            file = io.BytesIO()
            Image.fromarray(frame).save(file, "JPEG", quality=95)
            data = np.frombuffer(file.getvalue(), np.uint8)
            image = kinds["sensor_msgs/msg/CompressedImage"](header, "jpeg", data)
        else:
            data, (height, width) = {"bgr8": frame[..., ::-1], "16UC1": frame[..., :2]}[encoding], frame.shape[:2]
            pad = np.zeros((height, 8), np.uint8)  # rows may be longer than their pixels
            rows = np.concatenate([data.reshape(height, -1), pad], axis=1)
            of_image = (height, width, encoding, 0, rows.shape[1], rows.ravel())
            image = kinds["sensor_msgs/msg/Image"](header, *of_image)
        yield "/camera", type(image).__msgtype__, time + 0.02, image


def write_bag(path: Path, storage: StoragePlugin, **changes: Any) -> Path:
    with Writer(path, version=9, storage_plugin=storage) as writer:
        topics: dict[str, Any] = {}
        for topic, kind, time, message in messages(**({"encoding": "jpeg"} | changes)):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(topics[topic], int(time * 1e9), TYPES.serialize_cdr(message, kind))
    return path


CHOSEN = ("--pose", "/pose", "--gripper", "/fingers:position", "--gripper-open", 0.08, "--gripper-closed", 0)


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("encoding", ["jpeg", "bgr8"])
def test_a_bag_becomes_an_episode(storage: StoragePlugin, encoding: str, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bags/first", storage, encoding=encoding)
    bags = bag.parent if encoding == "jpeg" else next(file for file in bag.iterdir() if file.suffix != ".yaml")
    out = tmp_path / "npz"
    run("ros2_bag", bags, "--out", out, "--rate", RATE_HZ, "--camera", "frames=/camera", *CHOSEN, "--height", 64)
    first = 1  # from the first picture on
    assert np.abs(states_in(out) - STATES[first - 1 : -1]).max() < 1e-6
    with np.load(next(out.glob("*.npz"))) as file:
        away = np.abs(file["frames"].astype(int) - FRAMES[:-1])
        assert away.max() == 0 if encoding == "bgr8" else away.mean() < 3


@pytest.mark.parametrize(
    ("changes", "words", "found"),
    [
        ({"encoding": "16UC1"}, CHOSEN, r"images of 16UC1; read are rgb8.*depth is not"),
        ({"skip": range(5, 15)}, CHOSEN, r"/camera: silent for 1\.\d+ s"),
        ({}, ("--pose", "/tf", *CHOSEN[2:]), "no topic /tf; it has /camera, /fingers, /pose"),
        ({}, ("--pose", "/pose", "--gripper", "/fingers:width"), "has no width; it has header, name, position"),
        (
            {},
            (*CHOSEN[:4], "--gripper-open", 0.001, "--gripper-closed", 0),
            r"goes from 0\.02957 to 0\.07884: set --gripper-open",
        ),
    ],
    ids=["depth", "silent", "topic", "no field", "gripper"],
)
def test_a_bag_that_does_not_fit_says_why(
    changes: dict[str, Any], words: tuple[object, ...], found: str, tmp_path: Path
) -> None:
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3, **changes)
    with pytest.raises(SystemExit, match=found):
        run("ros2_bag", bag, "--out", tmp_path / "npz", "--camera", "frames=/camera", *words)
    assert not (tmp_path / "npz").exists()


# Lance tables. In processes of their own: Lance warns of every fork in the process that has imported it.

HOSTILE = """
import sys, lance, pyarrow as pa
kind = pa.schema([("path", pa.string()), ("data", pa.large_binary())])
rows = [{"path": "info.json", "data": b'{"storage_format": "lance"}'}, {"path": "../../away", "data": b""}]
lance.write_dataset(pa.Table.from_pylist(rows, schema=kind), sys.argv[1])
"""


def apart(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *map(str, words)], text=True, capture_output=True, check=False)


def test_tables_become_the_files_they_were_made_of(tmp_path: Path) -> None:
    """By the original writer: the tests' own data set, and what lerobot-lancedb made of it."""
    original, out = GOLDEN / "lerobot_lance/original", tmp_path / "files"
    done = apart(ROOT / "examples/convert/lance_to_files.py", GOLDEN / "lerobot_lance/tables", out)
    assert done.returncode == 0, done.stderr
    files = sorted(path.relative_to(original) for path in original.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(out) for path in out.rglob("*") if path.is_file())
    videos = [path for path in files if path.suffix == ".mp4"]
    assert len(videos) == 4
    assert all((out / path).read_bytes() == (original / path).read_bytes() for path in videos)
    for path in (path for path in files if path.parts[0] == "data"):
        ours, theirs = (parquet.read_table(root / path) for root in (out, original))
        assert ours.column_names == theirs.column_names
        assert ours.to_pylist() == theirs.to_pylist()
    assert look_at(str(out)).source == "lerobot"


def test_a_name_of_meta_stays_in_the_folder(tmp_path: Path) -> None:
    assert apart("-c", HOSTILE, tmp_path / "in/meta.lance").returncode == 0
    done = apart(ROOT / "examples/convert/lance_to_files.py", tmp_path / "in", tmp_path / "deep/out")
    assert done.returncode == 1
    assert "a file of meta called ../../away" in done.stderr
    assert not (tmp_path / "away").exists()
