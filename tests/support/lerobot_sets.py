"""Write LeRobot data sets, v3.0 and v2.1, with pyarrow and PyAV."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import UInt8
from PIL import Image

from recordings import write_mp4
from synthetic import draw_frame, synthetic_states

CAMERAS = ("exterior_1_left", "wrist_left")
STATE = ("observation.state.cartesian_position", "observation.state.gripper_position")
FPS = 15
SIZE = (36, 64)

_BLOCK = 8  # pixels of one bit
_DATA_V30 = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO_V30 = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_DATA_V21 = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_VIDEO_V21 = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"

Frames = list[UInt8[np.ndarray, "height width 3"]]


@dataclass(frozen=True)
class Recorded:
    """One episode to write: columns of [steps, numbers], and the frames of each camera."""

    columns: Mapping[str, np.ndarray]
    frames: Mapping[str, Frames]
    task: str = "pick up the block"


def recorded(number: int, steps: int, *, size: tuple[int, int] = SIZE) -> Recorded:
    """Return an episode with the columns of DROID's ports; each frame encodes its episode, step and camera."""
    states = synthetic_states(steps, seed=number).astype(np.float32)
    columns = {
        STATE[0]: states[:, :6],
        STATE[1]: states[:, 6:],
        "action.joint_velocity": np.sin(np.arange(steps)[:, None] / 15 + np.arange(7)).astype(np.float32),
        "is_episode_successful": np.full((steps, 1), number % 3 != 2),
    }
    frames = {
        f"observation.images.{name}": [
            draw_numbers(draw_frame(state, size=size, camera=camera), number, step, camera)
            for step, state in enumerate(states)
        ]
        for camera, name in enumerate(CAMERAS)
    }
    return Recorded(columns, frames, task=f"move to place {number % 2}")


def draw_numbers(frame: UInt8[np.ndarray, "height width 3"], *numbers: int) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image with numbers below 256 in its upper rows, as black and white blocks that a codec preserves."""
    frame = frame.copy()
    for row, number in enumerate(numbers):
        for bit in range(8):
            block = frame[row * _BLOCK : (row + 1) * _BLOCK, bit * _BLOCK : (bit + 1) * _BLOCK]
            block[:] = 255 if number >> bit & 1 else 0
    return frame


def numbers_of(frame: UInt8[np.ndarray, "height width 3"], count: int = 3) -> tuple[int, ...]:
    """Return the numbers that `draw_numbers` drew."""
    bits = frame[_BLOCK // 2 :: _BLOCK, _BLOCK // 2 :: _BLOCK].mean(axis=-1)[:count, :8] > 127
    return tuple(int(sum(1 << bit for bit in np.flatnonzero(row))) for row in bits)


def write_v30(
    folder: str | Path,
    episodes: Sequence[Recorded],
    *,
    episodes_per_video: int = 3,
    gop: int = 2,
    image_format: str = "video",
) -> Path:
    """Write a v3.0 data set: several episodes in each Parquet file and in each video. Returns the folder."""
    root = Path(folder)
    rows: list[dict[str, Any]] = []
    for file, first in enumerate(range(0, len(episodes), 2)):
        numbers = range(first, min(first + 2, len(episodes)))
        table = pa.concat_tables([_rows(episodes, number, image_format) for number in numbers])
        _write_table(root / _DATA_V30.format(chunk_index=0, file_index=file), table)
        rows += [{"data/chunk_index": 0, "data/file_index": file} for _ in numbers]
    if image_format == "video":
        for key in episodes[0].frames:
            _write_shared_videos(root, key, episodes, rows, episodes_per_video, gop)
    for number, (row, episode) in enumerate(zip(rows, episodes, strict=True)):
        start = sum(_length(earlier) for earlier in episodes[:number])
        row |= {"episode_index": number, "length": _length(episode), "tasks": [episode.task]}
        row |= {"dataset_from_index": start, "dataset_to_index": start + _length(episode)}
        if "is_episode_successful" in episode.columns:
            row["stats/is_episode_successful/max"] = [bool(episode.columns["is_episode_successful"].max())]
    _write_table(root / "meta/episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(rows))
    tasks = sorted({episode.task for episode in episodes})
    table = pa.table({"task_index": range(len(tasks)), "__index_level_0__": tasks})
    _write_table(root / "meta/tasks.parquet", table)
    video = _VIDEO_V30 if image_format == "video" else None
    _write_info(root, episodes, "v3.0", {"data_path": _DATA_V30, "video_path": video}, image_format)
    return root


def write_v21(folder: str | Path, episodes: Sequence[Recorded], *, gop: int = 2, image_format: str = "video") -> Path:
    """Write a v2.1 data set: a Parquet file and a video for each episode. Returns the folder."""
    root = Path(folder)
    for number, episode in enumerate(episodes):
        at = {"episode_chunk": number // 3, "episode_index": number}
        _write_table(root / _DATA_V21.format(**at), _rows(episodes, number, image_format))
        if image_format == "video":
            for key, frames in episode.frames.items():
                write_mp4(root / _VIDEO_V21.format(**at, video_key=key), frames, rate=FPS, gop=gop)
    lines = [
        {"episode_index": number, "tasks": [episode.task], "length": _length(episode)}
        for number, episode in enumerate(episodes)
    ]
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    paths = {"data_path": _DATA_V21, "video_path": _VIDEO_V21 if image_format == "video" else None}
    _write_info(root, episodes, "v2.1", paths | {"chunks_size": 3}, image_format)
    return root


def change_info(root: Path, **changes: object) -> None:
    """Change values of meta/info.json."""
    path = root / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def change_table(path: Path, **columns: object) -> None:
    """Replace columns of a Parquet file, or remove them (None)."""
    table = pq.read_table(path)
    for name, values in columns.items():
        index = table.schema.get_field_index(name)
        table = table.remove_column(index)
        if values is not None:
            table = table.add_column(index, name, values)
    _write_table(path, table)


def column_of(values: np.ndarray, *, fixed: bool = False) -> pa.Array:
    """Return [steps, numbers] as a column of LeRobot: scalars if there is one number per step, otherwise lists."""
    if values.shape[1] == 1:
        return pa.array(values[:, 0])
    kind = pa.from_numpy_dtype(values.dtype)
    return pa.array(values.tolist(), type=pa.list_(kind, values.shape[1]) if fixed else pa.list_(kind))


def _rows(episodes: Sequence[Recorded], number: int, image_format: str) -> pa.Table:
    episode, length = episodes[number], _length(episodes[number])
    start = sum(_length(earlier) for earlier in episodes[:number])
    columns = {name: column_of(values, fixed=values.shape[1] == 6) for name, values in episode.columns.items()}
    if image_format != "video":
        kind = pa.struct({"bytes": pa.binary(), "path": pa.string()})
        for key, frames in episode.frames.items():
            stored = [{"bytes": _encoded(frame, image_format), "path": f"{step}"} for step, frame in enumerate(frames)]
            columns[key] = pa.array(stored, type=kind)
    return pa.table(
        columns
        | {
            "timestamp": (np.arange(length) / FPS).astype(np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, number),
            "index": np.arange(start, start + length),
            "task_index": np.full(length, number % 2),
        }
    )


def _write_shared_videos(
    root: Path, key: str, episodes: Sequence[Recorded], rows: list[dict[str, Any]], together: int, gop: int
) -> None:
    for first in range(0, len(episodes), together):
        numbers, frames = range(first, min(first + together, len(episodes))), []
        for number in numbers:
            start = len(frames)
            frames += episodes[number].frames[key]
            name = f"videos/{key}"
            rows[number] |= {f"{name}/chunk_index": 0, f"{name}/file_index": first // together}
            rows[number] |= {f"{name}/from_timestamp": start / FPS, f"{name}/to_timestamp": len(frames) / FPS}
        path = root / _VIDEO_V30.format(video_key=key, chunk_index=0, file_index=first // together)
        write_mp4(path, frames, rate=FPS, gop=gop)


def _write_table(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, write_page_checksum=True)


def _write_info(
    root: Path, episodes: Sequence[Recorded], version: str, paths: Mapping[str, object], image_format: str
) -> None:
    first = episodes[0]
    features: dict[str, Any] = {
        name: {"dtype": str(values.dtype), "shape": [values.shape[1]], "names": None}
        for name, values in first.columns.items()
    }
    for key, frames in first.frames.items():
        dtype = "video" if image_format == "video" else "image"
        features[key] = {"dtype": dtype, "shape": list(frames[0].shape), "names": ["height", "width", "channels"]}
    for name, dtype in (("timestamp", "float32"), *((n, "int64") for n in ("frame_index", "episode_index", "index"))):
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    content = {
        "codebase_version": version,
        "robot_type": "Franka",
        "total_episodes": len(episodes),
        "total_frames": sum(map(_length, episodes)),
        "chunks_size": 1000,
        "fps": FPS,
        "splits": {"train": f"0:{len(episodes)}"},
        "features": features,
    }
    (root / "meta/info.json").write_text(json.dumps(content | dict(paths), indent=4))


def _encoded(frame: UInt8[np.ndarray, "height width 3"], format_name: str) -> bytes:
    file = io.BytesIO()
    Image.fromarray(frame).save(file, format_name)
    return file.getvalue()


def _length(episode: Recorded) -> int:
    return len(next(iter(episode.columns.values())))
