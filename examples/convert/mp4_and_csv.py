"""Make .npz episodes of videos and tables of poses: each NAME.mp4 with its NAME.csv, a row for each frame.

    python mp4_and_csv.py RECORDINGS data/my_robot

Columns of the table: x, y, z (metres), roll, pitch, yaw (radians) or qx, qy, qz, qw, and gripper (0 open .. 1 closed).
With a column `time` (seconds since the video's first frame), each frame gets the row that is nearest in time.
"""

import argparse
import csv
from pathlib import Path

import av
import numpy as np
from scipy.spatial.transform import Rotation

FARTHEST_S = 0.1  # between a frame and its row


def frames_of(path: Path, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames, [frames, height, width, 3] of uint8, and their times in seconds."""
    frames, times = [], []
    with av.open(str(path)) as video:
        for frame in video.decode(video=0):
            width = round(height * frame.width / frame.height)
            frames.append(frame.to_ndarray(format="rgb24", width=width, height=height))
            times.append(frame.time or 0.0)
    return np.stack(frames), np.array(times) - times[0]


def states_of(path: Path, times: np.ndarray) -> np.ndarray:
    """Return the states at these times, [frames, 7]: x, y, z, roll, pitch, yaw, gripper."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = set(rows[0]) if rows else set()
    angles = ["qx", "qy", "qz", "qw"] if "qx" in names else ["roll", "pitch", "yaw"]
    wanted = ["x", "y", "z", *angles, "gripper"]
    if missing := sorted(set(wanted) - names):
        raise SystemExit(f"{path}: no column {', '.join(missing)}; it has {', '.join(sorted(names)) or 'no rows'}")
    table = np.array([[float(row[name]) for name in wanted] for row in rows])
    if len(angles) == 4:
        turned = Rotation.from_quat(table[:, 3:7]).as_euler("xyz")
        table = np.concatenate([table[:, :3], turned, table[:, 7:]], axis=1)
    if "time" in names:
        away = np.abs(np.array([float(row["time"]) for row in rows]) - times[:, None])
        if (worst := float(away.min(axis=1).max())) > FARTHEST_S:
            raise SystemExit(f"{path}: a frame is {worst:.2f} s from the nearest row; is `time` 0 at the first frame?")
        return np.asarray(table[away.argmin(axis=1)])
    if len(table) != len(times):
        raise SystemExit(f"{path}: {len(table)} rows for {len(times)} frames; a column `time` says which go together")
    return table


def main() -> None:
    """Write an .npz file for each video."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="a folder of NAME.mp4 and NAME.csv")
    parser.add_argument("out", type=Path, help="a folder for NAME.npz")
    parser.add_argument("--height", type=int, default=256, help="of stored frames; the model looks at 256")
    parser.add_argument("--fps", type=float, help="of all videos, where they measure slightly different ones")
    args = parser.parse_args()
    videos = sorted(args.recordings.rglob("*.mp4"))
    if not videos:
        raise SystemExit(f"{args.recordings}: no .mp4 files")
    for number, path in enumerate(videos):
        if not path.with_suffix(".csv").exists():
            raise SystemExit(f"{path}: no table of poses beside it, {path.stem}.csv")
        frames, times = frames_of(path, args.height)
        rate = args.fps or round((len(times) - 1) / times[-1], 2)
        out = args.out / path.relative_to(args.recordings).with_suffix(".npz")
        states = states_of(path.with_suffix(".csv"), times)
        out.parent.mkdir(parents=True, exist_ok=True)
        np.savez(out, frames=frames, states=states, fps_hz=rate)
        print(f"{number + 1} of {len(videos)}: {out}, {len(times)} steps at {rate:g} a second")
    print(f"Next: vjepa2-ac init npz {args.out}")


if __name__ == "__main__":
    main()
