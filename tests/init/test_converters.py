"""Each converter reproduces the recorded data and reports invalid input; `data converter` prints the scripts."""

import argparse
import csv
import io
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
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
from vjepa2_ac.init.recognize import read_properties
from vjepa2_ac.media.video import write_video

STEPS, RATE_HZ = 20, 10.0
STATES = synthetic_states(STEPS, seed=1)
FRAMES = np.stack([draw_frame(state, size=(64, 96), camera=0) for state in STATES])
TYPES = get_typestore(Stores.ROS2_HUMBLE)


@pytest.fixture(params=["mp4_and_csv", "ros2_bag", "lance_to_files"])
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def run(script: str, *arguments: object) -> None:
    """Run a converter in this process."""
    original_arguments = sys.argv
    sys.argv = [script, *map(str, arguments)]
    try:
        runpy.run_path(str(ROOT / f"examples/convert/{script}.py"), run_name="__main__")
    finally:
        sys.argv = original_arguments


def test_data_converter_prints_the_script_and_lists_all_scripts(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "converter", name]) == 0
    assert capsys.readouterr().out == (ROOT / f"examples/convert/{name}.py").read_text()
    assert main(["data", "converter"]) == 0
    assert name in capsys.readouterr().out
    assert main(["data", "converter", f"../{name}"]) == 2
    assert "Expected one of lance_to_files, mp4_and_csv, ros2_bag" in capsys.readouterr().err


# Videos and tables.

MP4_AND_CSV = runpy.run_path(str(ROOT / "examples/convert/mp4_and_csv.py"))
EULER_HEADER = "x,y,z,roll,pitch,yaw,gripper"
ROTATIONS = Rotation.from_euler("xyz", STATES[:, 3:6])


def write_recording(folder: Path, *, header: str = EULER_HEADER, rows: np.ndarray = STATES) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_video(folder / "first.mp4", FRAMES, rate_hz=RATE_HZ)
    with (folder / "first.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([header.split(","), *rows.tolist()])
    return folder


def write_video_at(path: Path, times: np.ndarray) -> None:
    """Write FRAMES as a video whose frames have these times in seconds."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=10, options={"crf": "1", "bf": "0"})
        stream.height, stream.width, stream.pix_fmt = 64, 96, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 10000)
        for time, pixels in zip(times, FRAMES, strict=True):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = round(10000 * time), Fraction(1, 10000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


def read_converted_states(folder: Path) -> np.ndarray:
    dataset = open_dataset(folder, source="npz", frames=3, stride=2, validation_share=0.0, test_share=0.0)
    assert dataset.control_rate_hz == RATE_HZ
    return np.asarray(dataset.source.read(0).states)


def read_table(path: Path, text: str | bytes, **options: Any) -> Any:
    """Return the states of a table with this text, as the converter reads them."""
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    defaults: dict[str, Any] = {"rotation": None, "position_unit": "m", "gripper_open": 0.0, "gripper_closed": 1.0}
    return MP4_AND_CSV["read_table"](path, argparse.Namespace(**defaults | options))[0]


def table_of(header: str, numbers: np.ndarray = STATES) -> str:
    return "\n".join([header, *(",".join(map(repr, row)) for row in numbers.tolist())]) + "\n"


def with_rotation(rotation: np.ndarray) -> np.ndarray:
    return np.concatenate([STATES[:, :3], rotation, STATES[:, 6:]], axis=1)


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        (EULER_HEADER, STATES),
        ("x,y,z,qx,qy,qz,qw,gripper", with_rotation(ROTATIONS.as_quat())),
        (f"time,{EULER_HEADER}", np.insert(STATES, 0, np.arange(STEPS) / RATE_HZ + 0.02, axis=1)[::-1]),
    ],
    ids=["angles", "quaternions", "times, in any order"],
)
def test_videos_and_tables_become_episodes(
    header: str, rows: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("mp4_and_csv", write_recording(tmp_path / "own", header=header, rows=rows), tmp_path / "npz", "--height", 32)
    assert np.abs(read_converted_states(tmp_path / "npz") - STATES).max() < 1e-6
    assert "warning" not in capsys.readouterr().out
    with np.load(tmp_path / "npz/first.npz") as file:
        assert file["frames"].shape == (STEPS, 32, 48, 3)
        smaller = [np.asarray(Image.fromarray(frame).resize((48, 32))) for frame in FRAMES]
        assert (
            np.abs(file["frames"] - np.stack(smaller).astype(float)).mean() < 12
        )  # of 255, because of a codec and two resizers


def drop_table(folder: Path) -> None:
    (folder / "first.csv").unlink()


def damage_video(folder: Path) -> None:
    (folder / "first.mp4").write_bytes(b"no video" * 100)


@pytest.mark.parametrize(
    ("changes", "damage", "message"),
    [
        ({"rows": STATES[:-2]}, None, "18 rows for 20 frames"),
        (
            {"header": "x,y,z,roll,pitch,yaw,grip"},
            None,
            "no column gripper; the table has x, y, z, roll, pitch, yaw, grip",
        ),
        ({}, drop_table, r"first.mp4: no table of poses. Expected first.csv"),
        ({}, damage_video, r"first.mp4: not a readable video"),
        (
            {"header": f"time,{EULER_HEADER}", "rows": np.insert(STATES, 0, 1.7e9, axis=1)},
            None,
            "Set `time` to 0 at the first frame",
        ),
        (
            {"header": f"time,{EULER_HEADER}", "rows": np.insert(STATES[::3], 0, np.arange(0, STEPS, 3) / 30, axis=1)},
            None,
            "a frame is 1.30 s from the nearest row",
        ),
        (
            {
                "header": f"time,{EULER_HEADER}",
                "rows": np.insert(STATES[::2], 0, np.arange(0.5, STEPS, 2) / 10, axis=1),
            },
            None,
            r"first.csv: 10 of 20 steps repeat the row of the step before. Expected 20% at most. Pass a lower --fps",
        ),
    ],
    ids=["lengths", "column", "no table", "damaged video", "another clock", "short table", "half as many rows"],
)
def test_inconsistent_recording_raises_with_the_reason(
    changes: dict[str, Any], damage: Callable[[Path], None] | None, message: str, tmp_path: Path
) -> None:
    folder = write_recording(tmp_path / "own", **changes)
    if damage is not None:
        damage(folder)
    with pytest.raises(SystemExit, match=message):
        run("mp4_and_csv", folder, tmp_path / "npz")
    assert not list(tmp_path.rglob("*.npz"))


# Frames at uneven times.


def convert(folder: Path, times: np.ndarray, *arguments: object, row_times: np.ndarray | None = None) -> Any:
    """Convert a recording whose frames have these times; `row_times` adds a column `time`."""
    write_recording(folder)
    write_video_at(folder / "first.mp4", times)
    if row_times is not None:
        table = np.insert(STATES, 0, row_times, axis=1)
        (folder / "first.csv").write_text(table_of(f"time,{EULER_HEADER}", table))
    run("mp4_and_csv", folder, folder / "npz", "--height", 64, *arguments)
    return np.load(folder / "npz/first.npz")


def require_steps(converted_file: Any, expected: np.ndarray) -> None:
    """Check that the states are those of the expected rows, and the frames those of the same rows."""
    assert np.abs(converted_file["states"] - STATES[expected]).max() < 1e-9
    distances = np.abs(converted_file["frames"][:, None].astype(int) - FRAMES).mean(axis=(2, 3, 4))
    assert np.array_equal(distances.argmin(axis=1), expected)


UNEVEN = np.r_[0, np.cumsum(np.random.default_rng(0).choice([0.03, 0.1, 0.2, 0.6], STEPS - 1))]


def test_uneven_frame_times_raise_and_name_the_resampling_option(tmp_path: Path) -> None:
    with pytest.raises(
        SystemExit, match=r"first.mp4: frames are 0\.030 to 0\.600 s apart.*up to 1\.65 no step repeats"
    ):
        convert(tmp_path, UNEVEN)


@pytest.mark.parametrize("has_times", [False, True], ids=["rows by number", "rows by time"])
def test_fps_selects_the_nearest_frame_and_its_pose(has_times: bool, tmp_path: Path) -> None:
    converted_file = convert(tmp_path, UNEVEN, "--fps", 1.65, row_times=UNEVEN if has_times else None)
    grid = np.arange(0, UNEVEN[-1], 1 / 1.65)
    expected = np.abs(UNEVEN - grid[:, None]).argmin(axis=1)
    assert converted_file["fps_hz"] == 1.65
    require_steps(converted_file, expected)


# Display matrices, as phones write them.

TURNS = {  # display matrix (a, b, c, d) of the video's header, and the displayed frames as a function of the stored
    "90 clockwise": ((0, 1, -1, 0), lambda frames: np.rot90(frames, -1, (1, 2))),
    "90 counterclockwise": ((0, -1, 1, 0), lambda frames: np.rot90(frames, 1, (1, 2))),
    "upside down": ((1, 0, 0, -1), lambda frames: frames[:, ::-1]),
    "mirrored and turned": ((0, 1, 1, 0), lambda frames: frames.swapaxes(1, 2)),
}


def set_display_matrix(path: Path, entries: Sequence[float]) -> None:
    data, unity = bytearray(path.read_bytes()), display_matrix((1, 0, 0, 1))
    start = bytes(data).index(unity, bytes(data).index(b"tkhd"))
    data[start : start + len(unity)] = display_matrix(entries)
    path.write_bytes(data)


def display_matrix(entries: Sequence[float]) -> bytes:
    a, b, c, d = (round(65536 * entry) for entry in entries)
    return np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], ">i4").tobytes()


@pytest.mark.parametrize("turn", TURNS)
def test_frames_are_rotated_by_the_display_matrix(turn: str, tmp_path: Path) -> None:
    entries, displayed = TURNS[turn]
    folder = write_recording(tmp_path / "own")
    run("mp4_and_csv", folder, tmp_path / "stored", "--height", 64)
    set_display_matrix(folder / "first.mp4", entries)
    run("mp4_and_csv", folder, tmp_path / "npz", "--height", 96 if entries[0] == 0 else 64)
    with np.load(tmp_path / "stored/first.npz") as stored, np.load(tmp_path / "npz/first.npz") as converted_file:
        assert np.array_equal(converted_file["frames"], displayed(stored["frames"]))


# Cells of a table.

PLAIN = table_of(EULER_HEADER)


@pytest.mark.parametrize(
    "text",
    [
        PLAIN,
        b"\xef\xbb\xbf" + PLAIN.encode(),
        PLAIN.replace("\n", "\r\n"),
        PLAIN.replace(",", ";").replace(".", ","),
        PLAIN.replace(",", ";"),
        PLAIN.replace(",", "\t"),
        PLAIN.replace("x,y,z", " X, Y ,Z"),
        PLAIN.replace("\n", ",\n"),
        PLAIN + "\n,,,,,,\n",
        table_of(f"note,{EULER_HEADER},note").replace("\n", "\nopen; 1.5,", STEPS),
    ],
    ids=["plain", "BOM", "CRLF", "decimal commas", "semicolons", "tabs", "names", "empty column", "empty rows", "text"],
)
def test_common_csv_dialects_are_read(text: str | bytes, tmp_path: Path) -> None:
    assert np.abs(read_table(tmp_path / "a.csv", text) - STATES).max() < 1e-12


ROW = "0.1,0.2,0.3,0.4,0.5,0.6,0.7"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (f"{EULER_HEADER}\n{ROW}\n,0.2,0.3,0.4,0.5,0.6,0.7", "line 3, column x: an empty cell. Expected a number"),
        (f"{EULER_HEADER}\n\n{ROW.replace('0.7', 'open')}", "line 3, column gripper: 'open'. Expected a number"),
        (f"{EULER_HEADER}\n0,1,0,2,0,3,0,4,0,5,0,6,0,7", "line 2: 14 cells. Expected 7, as in the first line"),
        (f"{EULER_HEADER},X\n{ROW},1", "2 columns are called x. Rename all but one"),
        (f"{EULER_HEADER}", "no rows. Expected a line with the names"),
        (PLAIN.encode("utf-16"), r"not a text table .*Save the table as CSV \(UTF-8\)"),
        (
            f"x,y,z,gripper\n{ROW}",
            "no columns for the rotation; the table has x, y, z, gripper. Expected roll, pitch, yaw, or",
        ),
        (f"x,y,z,rx,ry,rz,gripper\n{ROW}", "rx, ry, rz can be rotation_vector, euler_xyz or euler_xyz_degrees. Pass"),
        ("x,y,z,qx,qy,qz,qw,gripper\n0,0,0,0,0,0,1,0\n0,0,0,0,0,0,0,0", "line 3: 0, 0, 0, 0. Expected quaternion_xyzw"),
        (f"{EULER_HEADER}\n{ROW.replace('0.1', '412')}", "line 2: 412, 0.2, 0.3. Expected .*5 m.*--position-unit"),
        (f"{EULER_HEADER}\n{ROW.replace('0.7', '85')}", "line 2: 85. Expected .*0 to 1. Set --gripper-open"),
    ],
)
def test_invalid_table_raises_with_line_and_column(rows: str | bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=rf"a\.csv: {message}"):
        read_table(tmp_path / "a.csv", rows)


XYZW, WXYZ, VECTOR = ROTATIONS.as_quat(), ROTATIONS.as_quat(scalar_first=True), ROTATIONS.as_rotvec()


@pytest.mark.parametrize(
    ("columns", "rotation", "numbers"),
    [
        ("rx,ry,rz,rw", None, XYZW),
        ("qw,qx,qy,qz", "quaternion_wxyz", WXYZ),
        ("quat_x,quat_y,quat_z,quat_w", None, XYZW),
        ("q0,q1,q2,q3", "quaternion_wxyz", WXYZ),
        ("rotvec_x,rotvec_y,rotvec_z", None, VECTOR),
        ("rx,ry,rz", "rotation_vector", VECTOR),
        ("rx,ry,rz", "euler_xyz", STATES[:, 3:6]),
        ("roll,pitch,yaw", "euler_xyz_degrees", np.degrees(STATES[:, 3:6])),
    ],
)
def test_rotation_format_follows_from_names_or_option(
    columns: str, rotation: str | None, numbers: np.ndarray, tmp_path: Path
) -> None:
    table = table_of(f"x,y,z,{columns},gripper", with_rotation(numbers))
    states = read_table(tmp_path / "a.csv", table, rotation=rotation)
    assert np.abs(states - STATES).max() < 1e-9


# ROS bags.


ARM = np.sin(np.arange(STEPS)[:, None] / 5 + np.arange(7))
FINGER = 0.04 * (1 - STATES[:, 6])
JOINTS = [*(f"arm/joint{number}" for number in range(7)), "left.finger", "right.finger"]
NO_ORIENTATION = (0.0, 0.0, 0.0, 0.0)


def make_messages(
    *,
    encoding: str = "jpeg",
    skip: range = range(0),
    orientations: Mapping[int, tuple[float, ...]] | None = None,
    joints: Sequence[str] = (),
    arm: np.ndarray | None = None,
) -> Iterator[tuple[str, str, float, Any]]:
    """Yield topic, type, time in seconds and message; the camera is 20 ms late.

    Args:
        encoding: Encoding of the frames.
        skip: Steps without a frame.
        orientations: Quaternions of the pose that replace the true ones, by step.
        joints: Names of the joints in /fingers.
        arm: Joints that precede the fingers in /fingers.
    """
    kinds = TYPES.types
    header = kinds["std_msgs/msg/Header"](stamp=kinds["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="")
    for step, (state, frame) in enumerate(zip(STATES, FRAMES, strict=True)):
        time, fingers = step / RATE_HZ, np.repeat(FINGER[step], 2)
        quaternion = (orientations or {}).get(step, tuple(Rotation.from_euler("xyz", state[3:6]).as_quat()))
        orientation = kinds["geometry_msgs/msg/Quaternion"](*quaternion)
        pose = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](*state[:3]), orientation)
        yield "/pose", "geometry_msgs/msg/PoseStamped", time, kinds["geometry_msgs/msg/PoseStamped"](header, pose)
        numbers = fingers if arm is None else np.r_[arm[step], fingers]
        positions = kinds["sensor_msgs/msg/JointState"](header, list(joints), numbers, np.zeros(0), np.zeros(0))
        yield "/fingers", "sensor_msgs/msg/JointState", time, positions
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
            fields = (height, width, encoding, 0, rows.shape[1], rows.ravel())
            image = kinds["sensor_msgs/msg/Image"](header, *fields)
        yield "/camera", type(image).__msgtype__, time + 0.02, image


def write_bag(path: Path, storage: StoragePlugin, **changes: Any) -> Path:
    with Writer(path, version=9, storage_plugin=storage) as writer:
        topics: dict[str, Any] = {}
        for topic, kind, time, message in make_messages(**changes):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(topics[topic], int(time * 1e9), TYPES.serialize_cdr(message, kind))
    return path


TOPIC_ARGUMENTS = ("--pose", "/pose", "--gripper", "/fingers:position", "--gripper-open", 0.08, "--gripper-closed", 0)


@pytest.mark.parametrize(("storage", "encoding"), [(StoragePlugin.SQLITE3, "jpeg"), (StoragePlugin.MCAP, "bgr8")])
def test_bag_is_converted_to_one_episode(storage: StoragePlugin, encoding: str, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bags/first", storage, encoding=encoding)
    bags = bag.parent if encoding == "jpeg" else next(file for file in bag.iterdir() if file.suffix != ".yaml")
    out = tmp_path / "npz"
    run(
        "ros2_bag",
        bags,
        "--out",
        out,
        "--rate",
        RATE_HZ,
        "--camera",
        "frames=/camera",
        *TOPIC_ARGUMENTS,
        "--height",
        64,
    )
    first = 1  # the episode starts at the first frame
    assert np.abs(read_converted_states(out) - STATES[first - 1 : -1]).max() < 1e-6
    with np.load(next(out.glob("*.npz"))) as file:
        differences = np.abs(file["frames"].astype(int) - FRAMES[:-1])
        assert differences.max() == 0 if encoding == "bgr8" else differences.mean() < 3


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ({"encoding": "16UC1"}, TOPIC_ARGUMENTS, r"images of 16UC1; read are rgb8.*depth is not"),
        ({"skip": range(5, 15)}, TOPIC_ARGUMENTS, r"/camera: silent for 1\.\d+ s"),
        ({}, ("--pose", "/tf", *TOPIC_ARGUMENTS[2:]), "no topic /tf; it has /camera, /fingers, /pose"),
        (
            {},
            (*TOPIC_ARGUMENTS[:4], "--gripper-open", 0.001, "--gripper-closed", 0),
            r"goes from 0\.02957 to 0\.07884: set --gripper-open",
        ),
        (
            {"joints": JOINTS, "arm": ARM},
            TOPIC_ARGUMENTS,
            r"/fingers:position: 9 joints, numbered from 0 to 8: arm/joint0, .*right.finger. Expected the gripper",
        ),
        (
            {"orientations": dict.fromkeys(range(STEPS), NO_ORIENTATION)},
            TOPIC_ARGUMENTS,
            "/pose: no message has a measurement",
        ),
        (
            {"orientations": {7: (0.0, 0.0, 0.0, 0.5)}},
            TOPIC_ARGUMENTS,
            r"/pose at 0\.70 s: the rotation \[0\.0, 0\.0, 0\.0, 0\.5\]\. Expected a unit quaternion",
        ),
    ],
    ids=lambda value: "" if not isinstance(value, str) else value[:20],
)
def test_inconsistent_bag_raises_with_the_reason(
    changes: dict[str, Any], arguments: tuple[object, ...], message: str, tmp_path: Path
) -> None:
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3, **changes)
    with pytest.raises(SystemExit, match=message):
        run("ros2_bag", bag, "--out", tmp_path / "npz", "--camera", "frames=/camera", *arguments)
    assert not (tmp_path / "npz").exists()


# Lance tables. The converter runs in a subprocess, because Lance warns about forks in the process that imports it.

HOSTILE = """
import sys, lance, pyarrow as pa
kind = pa.schema([("path", pa.string()), ("data", pa.large_binary())])
rows = [{"path": "info.json", "data": b'{"storage_format": "lance"}'}, {"path": "../../away", "data": b""}]
lance.write_dataset(pa.Table.from_pylist(rows, schema=kind), sys.argv[1])
"""


def run_in_subprocess(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *map(str, arguments)], text=True, capture_output=True, check=False)


def test_lance_tables_are_converted_to_the_original_files(tmp_path: Path) -> None:
    """The original files are a data set of the tests. lerobot-lancedb wrote the tables from these files."""
    original, out = GOLDEN / "lerobot_lance/original", tmp_path / "files"
    process = run_in_subprocess(ROOT / "examples/convert/lance_to_files.py", GOLDEN / "lerobot_lance/tables", out)
    assert process.returncode == 0, process.stderr
    files = sorted(path.relative_to(original) for path in original.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(out) for path in out.rglob("*") if path.is_file())
    videos = [path for path in files if path.suffix == ".mp4"]
    assert len(videos) == 4
    assert all((out / path).read_bytes() == (original / path).read_bytes() for path in videos)
    for path in (path for path in files if path.parts[0] == "data"):
        converted, expected = (parquet.read_table(root / path) for root in (out, original))
        assert converted.column_names == expected.column_names
        assert converted.to_pylist() == expected.to_pylist()
    assert read_properties(str(out)).source == "lerobot"


def test_file_names_in_lance_metadata_cannot_leave_the_folder(tmp_path: Path) -> None:
    assert run_in_subprocess("-c", HOSTILE, tmp_path / "in/meta.lance").returncode == 0
    process = run_in_subprocess(ROOT / "examples/convert/lance_to_files.py", tmp_path / "in", tmp_path / "deep/out")
    assert process.returncode == 1
    assert "a file of meta called ../../away" in process.stderr
    assert not (tmp_path / "away").exists()
