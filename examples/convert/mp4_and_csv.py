"""Convert videos and tables of poses to .npz episodes: each NAME.mp4 with its NAME.csv.

    python mp4_and_csv.py RECORDINGS data/my_robot

Columns of a table, in any order; other columns are ignored:

    x, y, z            position of the flange in the frame of the robot's base, in metres or --position-unit
    roll, pitch, yaw   extrinsic xyz Euler angles in radians; or a unit quaternion (qx, qy, qz, qw; quat_x ...; rx, ry,
                       rz, rw); or a rotation vector (rotvec_x ...; axis_angle_x ...; wx, wy, wz). --rotation names the
                       format where the column names do not.
    gripper            0 open to 1 closed, or --gripper-open to --gripper-closed
    time               optional: seconds since the video's first frame

Without `time`, row n belongs to frame n. With `time`, each frame gets the row that is nearest in time.

Steps are evenly spaced in time. A video with uneven frame times requires --fps. With --fps, each step takes
the frame that is nearest in time, and the row of that frame. Poses are not interpolated, because an interpolated pose
is not the pose that the frame shows.
"""

import argparse
import csv
import math
import re
from pathlib import Path
from typing import Any

import av
import numpy as np
from scipy.spatial.transform import Rotation

MAX_ROW_DISTANCE_S = 0.1  # largest time between a frame and its row
MAX_JITTER = 0.2  # largest difference between a frame interval and the mean interval, relative to the mean
MAX_REPEATED_SHARE = 0.2  # largest share of steps that repeat the frame or the row of the step before
RATE_TOLERANCE = 0.02  # an even video keeps all frames if --fps differs from its rate by a smaller share
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}

EULER, EULER_DEGREES, VECTOR = "euler_xyz", "euler_xyz_degrees", "rotation_vector"
XYZW, WXYZ = "quaternion_xyzw", "quaternion_wxyz"
ROTATION_COLUMNS = [  # names in lower case without dots, spaces and underscores, and the format that they imply
    *((f"{name}x {name}y {name}z {name}w", XYZW) for name in ("q", "quat", "quaternion", "orientation", "r", "rot")),
    ("roll pitch yaw", EULER),
    *((f"{name}x {name}y {name}z", VECTOR) for name in ("rotvec", "axisangle", "rvec", "w")),
    *((f"{name}0 {name}1 {name}2", VECTOR) for name in ("rotvec", "axisangle", "rvec")),
    *((f"{name}1 {name}2 {name}3", VECTOR) for name in ("rotvec", "axisangle", "rvec")),
    *((f"{name}x {name}y {name}z", None) for name in ("r", "rot")),  # None: --rotation must name the format
    *((f"{name}0 {name}1 {name}2 {name}3", None) for name in ("q", "quat", "quaternion")),
    *((f"{name}1 {name}2 {name}3 {name}4", None) for name in ("q", "quat", "quaternion")),
]


def find_recordings(folder: Path) -> list[tuple[Path, Path]]:
    """Return each video with its table. The ._NAME files of macOS are ignored."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("._"))
    videos = {path.with_suffix(""): path for path in files if path.suffix.lower() == ".mp4"}
    tables = {path.with_suffix(""): path for path in files if path.suffix.lower() == ".csv"}
    if not videos:
        raise SystemExit(f"{folder}: no .mp4 files")
    for name in sorted(videos.keys() - tables.keys()):
        raise SystemExit(f"{videos[name]}: no table of poses. Expected {name.name}.csv in the same folder.")
    for name in sorted(tables.keys() - videos.keys()):
        print(f"warning: {tables[name]} is not used: there is no {name.name}.mp4 in the same folder")
    return [(video, tables[name]) for name, video in videos.items()]


def read_table(path: Path, options: argparse.Namespace) -> tuple[np.ndarray, np.ndarray | None, str]:
    """Read a table with commas, semicolons or tabs between its cells.

    Returns the states, [rows, 7]: x, y, z (metres), roll, pitch, yaw (radians), gripper (0 open to 1 closed); the times
    of the rows in seconds, or None; and the format and the columns of the rotation, for messages.
    """
    try:
        text = path.read_text(encoding="utf-8-sig").split("\n")
        delimiter = max(",;\t", key=text[0].count)
        reader = csv.reader(text, delimiter=delimiter)
        lines = [(f"{path}: line {reader.line_num}", [cell.strip() for cell in cells]) for cells in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise SystemExit(f"{path}: not a text table ({error}). Save the table as CSV (UTF-8).") from None
    (_, header), *rows = [line for line in lines if any(line[1])] or [("", [])]
    names = [re.sub(r"[^a-z0-9]", "", name.lower()) for name in header]
    if not rows:
        raise SystemExit(f"{path}: no rows. Expected a line with the names of the columns, then a row for each pose.")
    if missing := [name for name in ("x", "y", "z", "gripper") if name not in names]:
        raise SystemExit(f"{path}: no column {', '.join(missing)}; the table has {', '.join(header)}")
    rotation, rotation_columns = choose_rotation(path, names, options.rotation)
    used = ["x", "y", "z", *rotation_columns, "gripper", *(["time"] if "time" in names else [])]
    if duplicates := [name for name in used if names.count(name) > 1]:
        raise SystemExit(
            f"{path}: {names.count(duplicates[0])} columns are called {duplicates[0]}. Rename all but one."
        )
    numbers = np.empty((len(rows), len(used)))
    for row, (location, cells) in enumerate(rows):
        if any(cells[len(header) :]):
            raise SystemExit(f"{location}: {len(cells)} cells. Expected {len(header)}, as in the first line.")
        cells_by_name = dict(zip(names, cells, strict=False))
        for column, name in enumerate(used):
            cell = cells_by_name.get(name, "")
            try:
                numbers[row, column] = float(cell if delimiter == "," else cell.replace(",", "."))
            except ValueError:
                numbers[row, column] = math.nan
            if not math.isfinite(numbers[row, column]):
                problem = repr(cell) if cell else "an empty cell"
                raise SystemExit(f"{location}, column {header[names.index(name)]}: {problem}. Expected a number.")
    states = make_states([location for location, _ in rows], numbers[:, : 4 + len(rotation_columns)], rotation, options)
    return states, numbers[:, -1] if "time" in names else None, f"{rotation} from {', '.join(rotation_columns)}"


def choose_rotation(path: Path, names: list[str], requested: str | None) -> tuple[str, list[str]]:
    """Return the format of the rotation, and its columns."""
    present = [(group.split(), implied) for group, implied in ROTATION_COLUMNS if set(group.split()) <= set(names)]
    if requested is not None:
        kind, width = requested.split("_")[0], 4 if requested in {XYZW, WXYZ} else 3
        present = [
            (columns, implied)
            for columns, implied in present
            if (implied or requested).startswith(kind) and len(columns) == width
        ]
    if not present:
        expected = requested or "roll, pitch, yaw, or qx, qy, qz, qw, or rotvec_x, rotvec_y, rotvec_z"
        raise SystemExit(f"{path}: no columns for the rotation; the table has {', '.join(names)}. Expected {expected}.")
    group, implied = present[0]
    rotation = implied if implied == XYZW else requested or implied  # qx, qy, qz, qw: the names give the order
    if rotation is None:
        formats = f"{XYZW} or {WXYZ}" if len(group) == 4 else f"{VECTOR}, {EULER} or {EULER_DEGREES}"
        raise SystemExit(f"{path}: {', '.join(group)} can be {formats}. Pass one of them as --rotation.")
    return rotation, group


def make_states(locations: list[str], numbers: np.ndarray, rotation: str, options: argparse.Namespace) -> np.ndarray:
    """Return the states, [rows, 7], from x, y, z, the rotation and the gripper as they are in the table."""
    positions, rotations = numbers[:, :3] * METRES[options.position_unit], numbers[:, 3:-1]
    gripper = (numbers[:, -1:] - options.gripper_open) / (options.gripper_closed - options.gripper_open)
    if rotation in {XYZW, WXYZ}:
        is_rotation = abs(np.linalg.norm(rotations, axis=1) - 1) <= 0.01
    else:
        is_rotation = abs(rotations).max(axis=1) <= 1.02 * (360 if rotation == EULER_DEGREES else 2 * math.pi)
    for is_valid, part, expected in (
        (abs(positions).max(axis=1) <= 5, numbers[:, :3], "a position within 5 m of the base. Check --position-unit"),
        (is_rotation, rotations, f"{rotation} (a unit quaternion, or angles in its unit). Check --rotation"),
        (abs(gripper[:, 0] - 0.5) <= 0.6, numbers[:, -1:], "a gripper of 0 to 1. Set --gripper-open, --gripper-closed"),
    ):
        if not is_valid.all():
            row = int(is_valid.argmin())
            problem = ", ".join(f"{number:g}" for number in part[row])
            raise SystemExit(f"{locations[row]}: {problem}. Expected {expected}.")
    if rotation in {XYZW, WXYZ}:
        rotations = np.roll(rotations, -1, axis=1) if rotation == WXYZ else rotations
        rotations = Rotation.from_quat(rotations).as_euler("xyz")
    elif rotation == VECTOR:
        rotations = Rotation.from_rotvec(rotations).as_euler("xyz")
    elif rotation == EULER_DEGREES:
        rotations = np.radians(rotations)
    return np.concatenate([positions, rotations, gripper], axis=1)


def read_video(path: Path, height: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the frames as players show them, [height, width, 3] of uint8, and their times in seconds."""
    frames: list[np.ndarray] = []
    times: list[Any] = []
    try:
        with av.open(str(path)) as video:
            for frame in video.decode(video=0) if video.streams.video else ():
                frames.append(decode_upright(path, frame, height))
                times.append(frame.time)
    except av.FFmpegError as error:
        raise SystemExit(f"{path}: not a readable video ({error})") from None
    if len(frames) < 2 or None in times or min(np.diff(times)) <= 0 or len({frame.shape for frame in frames}) > 1:
        raise SystemExit(f"{path}: {len(frames)} frames. Expected two or more, of one size and with rising times.")
    return frames, np.array(times) - times[0]


def decode_upright(path: Path, frame: av.VideoFrame, height: int) -> np.ndarray:
    """Return RGB pixels of this height, turned and mirrored by the display matrix that phones write."""
    matrix: Any = frame.side_data.get("DISPLAYMATRIX")
    axes = np.eye(2)  # the directions (right, down) in which a stored row and a stored column are displayed
    if matrix is not None:
        axes = np.sign(np.frombuffer(bytes(matrix), np.int32)[[0, 1, 3, 4]]).reshape(2, 2)
    if abs(axes).tolist() not in ([[1, 0], [0, 1]], [[0, 1], [1, 0]]):
        raise SystemExit(f"{path}: frames are displayed at {frame.rotation} degrees. Expected 0, 90, 180 or 270.")
    if axes[0, 0]:
        pixels = frame.to_ndarray(format="rgb24", width=round(height * frame.width / frame.height), height=height)
    else:
        pixels = frame.to_ndarray(format="rgb24", width=height, height=round(height * frame.height / frame.width))
        pixels = pixels.swapaxes(0, 1)
    column_step, row_step = axes.sum(axis=0).astype(int)
    return pixels[::row_step, ::column_step]


def match_rows(path: Path, row_times: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the row of each frame, and the times of the frames, for a table with times."""
    duration = row_times[-1] - row_times[0]
    if len(row_times) == len(times) and abs(duration - times[-1]) > MAX_ROW_DISTANCE_S and np.diff(row_times).min() > 0:
        problem = f"a row for each frame, but `time` covers {duration:.2f} s and the video {times[-1]:.2f} s"
        print(f"warning: {path}: {problem}; row n is used for frame n, and `time` as the time of both")
        return np.arange(len(times)), row_times - row_times[0]
    rows = find_nearest(row_times, times)
    if (farthest := abs(row_times[rows] - times).max()) > MAX_ROW_DISTANCE_S:
        problem = f"{path}: a frame is {farthest:.2f} s from the nearest row"
        raise SystemExit(f"{problem}. Expected at most {MAX_ROW_DISTANCE_S} s. Set `time` to 0 at the first frame.")
    return rows, times


def choose_steps(path: Path, times: np.ndarray, fps: float | None) -> tuple[np.ndarray, float]:
    """Return the frame of each step, and the number of steps per second."""
    gaps, measured = np.diff(times), (len(times) - 1) / times[-1]
    is_even = abs(gaps * measured - 1).max() <= MAX_JITTER
    if is_even and (fps is None or abs(fps / measured - 1) <= RATE_TOLERANCE):
        return np.arange(len(times)), fps or round(measured, 2)
    if fps is None:
        problem = f"{path}: frames are {gaps.min():.3f} to {gaps.max():.3f} s apart"
        fix = f"Pass --fps N to resample; up to {0.99 / gaps.max():.3g} no step repeats a frame"
        raise SystemExit(f"{problem}. Expected even times (within {MAX_JITTER:.0%}). {fix}.")
    return find_nearest(times, np.arange(int(times[-1] * fps + 1e-6) + 1) / fps), fps


def find_nearest(times: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the index of the time nearest to each target; the earlier one of two at the same distance."""
    rising, indices = np.unique(times, return_index=True)
    after = np.searchsorted(rising, targets).clip(max=len(rising) - 1)
    before = (after - 1).clip(min=0)
    is_before = targets - rising[before] <= rising[after] - targets
    return np.asarray(indices[np.where(is_before, before, after)])


def report_repeats(path: Path, indices: np.ndarray, item: str) -> None:
    """Print how many steps repeat the frame or the row of the step before; exit if there are too many."""
    repeated = np.count_nonzero(np.diff(indices) == 0)
    problem = f"{path}: {repeated} of {len(indices)} steps repeat the {item} of the step before"
    if repeated > MAX_REPEATED_SHARE * len(indices):
        raise SystemExit(f"{problem}. Expected {MAX_REPEATED_SHARE:.0%} at most. Pass a lower --fps.")
    if repeated:
        print(f"warning: {problem}")


def main() -> None:
    """Write an .npz file for each video."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="a folder of NAME.mp4 and NAME.csv")
    parser.add_argument("out", type=Path, help="a folder for NAME.npz")
    parser.add_argument("--height", type=int, default=256, help="height of the stored frames (256, as the model reads)")
    parser.add_argument("--fps", type=float, help="steps per second; required for uneven frame times")
    parser.add_argument("--rotation", choices=[EULER, EULER_DEGREES, VECTOR, XYZW, WXYZ], help="format of the rotation")
    parser.add_argument("--position-unit", choices=METRES, default="m")
    parser.add_argument("--gripper-open", type=float, default=0.0, help="value of `gripper` when open")
    parser.add_argument("--gripper-closed", type=float, default=1.0, help="value of `gripper` when closed")
    args = parser.parse_args()
    if args.gripper_open == args.gripper_closed or (args.fps is not None and args.fps <= 0):
        parser.error("--gripper-open and --gripper-closed must differ, and --fps must be positive")
    recordings = find_recordings(args.recordings)
    tables = [
        read_table(table, args) for _, table in recordings
    ]  # all tables are checked before the first video is decoded
    for number, ((video, table), (states, row_times, rotation)) in enumerate(zip(recordings, tables, strict=True)):
        frames, times = read_video(video, args.height)
        rows = np.arange(len(states))
        if row_times is not None:
            rows, times = match_rows(table, row_times, times)
        elif len(states) != len(times):
            problem = f"{table}: {len(states)} rows for {len(times)} frames"
            raise SystemExit(f"{problem}. Expected one row per frame. Add a column `time` to match rows to frames.")
        steps, rate = choose_steps(video, times, args.fps)
        report_repeats(video, steps, "frame")
        report_repeats(table, rows[np.unique(steps)], "row")
        out = args.out / video.relative_to(args.recordings).with_suffix(".npz")
        out.parent.mkdir(parents=True, exist_ok=True)
        np.savez(out, frames=np.stack([frames[step] for step in steps]), states=states[rows[steps]], fps_hz=rate)
        print(f"{number + 1} of {len(recordings)}: {out}, {len(steps)} steps at {rate:g} per second, {rotation}")
    print(f"Next: vjepa2-ac init {args.out}")


if __name__ == "__main__":
    main()
