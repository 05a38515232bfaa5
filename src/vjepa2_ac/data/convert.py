"""Convert any supported data set to a LeRobot data set v3.0.

Frames are encoded as H.264 (yuv420p, constant rate factor 18, a key frame every 2 frames), which is lossy. Numbers and
texts are stored exactly. There is one MP4 for each episode and camera, and one table of numbers with a row group for
each episode. Layout, names and types are those of LeRobot 0.4.4.
"""

from __future__ import annotations

import importlib.resources
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Shaped, UInt8

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig, IdleConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.sources.lerobot_meta import INFO, TABLES, fill_template
from vjepa2_ac.data.sources.parquet import import_pyarrow
from vjepa2_ac.data.windows import require_frames
from vjepa2_ac.episode import Episode
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.media.video import write_video
from vjepa2_ac.reporter import INDEXING, Reporter

STATE, ACTION, SUCCESS, CAMERA = "observation.state", "action", "is_episode_successful", "observation.images."

_FRAMES_AT_ONCE = 32  # frames that are decoded together, which limits the memory
Columns = Mapping[str, Shaped[np.ndarray, "steps numbers"]]
Frames = Iterable[UInt8[np.ndarray, "height width 3"]]
Statistics = dict[str, np.ndarray]
"""min, max, mean, std, count and quantiles of a feature, under the names that LeRobot uses."""

_TEMPLATE = Path(str(importlib.resources.files("vjepa2_ac"))) / "assets" / "lerobot" / "v30.json"
_TASK = "__index_level_0__"  # column of the task texts: the index of the pandas table in which LeRobot looks tasks up
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_CRF, _KEY_FRAME_EVERY = 18, 2  # constant rate factor of H.264, and frames per key frame
_SAMPLED_FRAMES, _SAMPLED_SIDE = 32, 100  # frames per episode, and pixels per side, for the statistics of a camera
_EPISODES_AT_ONCE = 100  # rows per write of the table of episodes


def convert_to_lerobot(config: DataConfig, folder: Path, reporter: Reporter) -> tuple[int, int]:
    """Write a data set as LeRobot v3.0 and return the numbers of written episodes and control steps.

    The episodes that `data.exclude` and `data.outcome` select are written completely, including idle steps, in the
    order of the source. Each written episode has measured states, actions, the frames of all cameras of `data.camera`,
    the task and the success label. The actions are the recorded commands if `data.actions` is recorded, otherwise the
    change to the next control step (0 at the last step). The folder appears only when it is complete.

    Args:
        config: The data set and how to read it.
        folder: A new or empty folder.
        reporter: Shows the progress.

    Raises:
        InputError: The data set cannot be read or is a latent cache, an episode is broken and `data.broken_episodes`
            does not skip it, or the folder cannot be written.
        UnreachableError: pyarrow or PyAV is not installed.
    """
    require_frames(config, to="write its frames")
    if unsupported := [camera for camera in config.cameras if "/" in camera]:
        raise InputError(
            where="data.camera", found=repr(unsupported[0]), needed="a name without /, as LeRobot requires"
        )
    dataset = open_dataset(config.model_copy(update={"idle": IdleConfig()}), progress=reporter.task(INDEXING))
    episodes = np.flatnonzero(dataset.is_selected).tolist()
    has_label = dataset.table.success[episodes] >= 0
    if has_label.any() and not has_label.all():
        num_unlabelled = (~has_label).sum()
        reporter.note(
            f"Success is not written: {num_unlabelled} of {counted(len(episodes), 'episode')} have no success label."
        )
    progress, spaces = reporter.task("writing episodes"), dataset.spaces
    names = {STATE: spaces.state.names, ACTION: spaces.action.names}
    with (
        storage.folder_writer(folder, INFO) as unfinished_folder,
        closing(LeRobotWriter(unfinished_folder, dataset.control_rate_hz, names)) as writer,
    ):
        for num_done, index in enumerate(episodes, start=1):
            try:
                _write_episode(writer, dataset, index, has_success=bool(has_label.all()))
            except InputError as error:
                dataset.skip_episode(index, error)
            progress(num_done, len(episodes))
        writer.finish()
    return writer.num_episodes, writer.num_steps


def _write_episode(writer: LeRobotWriter, dataset: Dataset, index: int, *, has_success: bool) -> None:
    by_camera = {camera: dataset.read(index, camera) for camera in dataset.config.cameras}
    recording = next(iter(by_camera.values()))
    columns = {STATE: recording.states.astype(np.float32), ACTION: _compute_actions(recording, dataset)}
    if has_success:
        columns[SUCCESS] = np.full((len(recording.states), 1), dataset.table[index].success)
    frames = {CAMERA + camera: _read_all_frames(episode) for camera, episode in by_camera.items()}
    writer.add(columns, frames, recording.metadata.get("language", ""))


def _compute_actions(recording: Episode, dataset: Dataset) -> Float32[np.ndarray, "steps action_dim"]:
    if recording.commands is not None:
        return recording.commands.astype(np.float32)
    actions = np.zeros(recording.states.shape, np.float32)
    if len(actions) > 1:
        actions[:-1] = dataset.spaces.state.compute_differences(recording.states)
    return actions


def _read_all_frames(recording: Episode) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    steps = range(len(recording.states))
    for first in steps[::_FRAMES_AT_ONCE]:
        yield from recording.read_frames(steps[first : first + _FRAMES_AT_ONCE])


class LeRobotWriter:
    """A writer of episodes into an empty folder. The data set is complete after `finish`.

    Args:
        folder: The folder.
        rate_hz: Control steps per second.
        names: The names of the numbers of a feature, by the feature's name.
    """

    def __init__(self, folder: Path, rate_hz: float, names: Mapping[str, Sequence[str]]) -> None:
        self._folder, self._names, self._template = folder, names, json.loads(_TEMPLATE.read_text())
        self._pa = import_pyarrow("data convert")
        self._rate_hz = int(rate_hz) if float(rate_hz).is_integer() else rate_hz  # LeRobot writes integers
        self._features: dict[str, Any] = {}
        self._statistics: dict[str, Statistics] = {}
        self._tasks: dict[str, int] = {}
        self._rows: list[dict[str, Any]] = []  # unwritten rows of the table of episodes
        self._tables: dict[str, Any] = {}  # open Parquet files
        self.num_episodes = self.num_steps = 0

    def add(self, columns: Columns, frames: Mapping[str, Frames], task: str) -> None:
        """Write an episode, or nothing if one of its frames cannot be used.

        Args:
            columns: The numbers of the episode, by the name of the feature.
            frames: One frame per step, by the name of the feature. An odd last row or column of pixels is dropped.
            task: The instruction; may be empty.

        Raises:
            InputError: A frame cannot be read, or its size differs from the frames of the first episode.
            OSError: A file cannot be written.
        """
        number, start, steps = self.num_episodes, self.num_steps, len(next(iter(columns.values())))
        order = np.arange(steps)[:, None]
        columns = {
            **columns,
            "timestamp": (order / self._rate_hz).astype(np.float32),
            "frame_index": order,
            "episode_index": np.full_like(order, number),
            "index": start + order,
            "task_index": np.full_like(order, self._tasks.get(task, len(self._tasks))),
        }
        for name, values in columns.items():
            description = {"dtype": str(values.dtype), "shape": [values.shape[1]], "names": self._names.get(name)}
            self._features.setdefault(name, description)
        statistics = {name: compute_statistics(values) for name, values in columns.items()}
        row = {"episode_index": number, "tasks": [task], "length": steps, **_file_indices("data", 0, 0)}
        row |= {"dataset_from_index": start, "dataset_to_index": start + steps}
        chunk, file = divmod(number, self._template["info"]["chunks_size"])
        videos = {
            key: self._folder / fill_template(self._template["info"]["video_path"], chunk, file, key) for key in frames
        }
        try:
            for key, path in videos.items():
                statistics[key] = self._write_video(path, key, frames[key], steps)
                times = {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": steps / self._rate_hz}
                row |= {**_file_indices(f"videos/{key}", chunk, file), **times}
        except BaseException:
            for path in videos.values():
                path.unlink(missing_ok=True)
            raise
        rows = {name: self._to_arrow(values) for name, values in columns.items()}
        self._append(fill_template(self._template["info"]["data_path"], 0, 0), rows)
        for name, episode_statistics in statistics.items():
            row |= {f"stats/{name}/{kind}": value.tolist() for kind, value in episode_statistics.items()}
            total = self._statistics.get(name)
            self._statistics[name] = (
                episode_statistics if total is None else combine_statistics(total, episode_statistics)
            )
        self._rows.append(row | _file_indices("meta/episodes", 0, 0))
        self._tasks.setdefault(task, len(self._tasks))
        self.num_episodes, self.num_steps = number + 1, start + steps
        if len(self._rows) == _EPISODES_AT_ONCE:
            self._write_rows()

    def finish(self) -> None:
        """Write the metadata of the data set, meta/info.json last."""
        self._write_rows()
        pandas = {"pandas": json.dumps(self._template["pandas_of_tasks"])}
        self._append("meta/tasks.parquet", {"task_index": [*self._tasks.values()], _TASK: [*self._tasks]}, pandas)
        self.close()
        counts = {"episodes": self.num_episodes, "frames": self.num_steps, "tasks": len(self._tasks)}
        info = self._template["info"] | {f"total_{name}": count for name, count in counts.items()}
        info |= {"fps": self._rate_hz, "splits": {"train": f"0:{self.num_episodes}"}, "features": self._features}
        for name, content in (("meta/stats.json", self._statistics), (INFO, info)):
            storage.write_atomically(self._folder / name, json.dumps(content, indent=4, default=np.ndarray.tolist))

    def close(self) -> None:
        """Close the tables."""
        for table in self._tables.values():
            table.close()

    def _write_video(self, path: Path, key: str, frames: Frames, steps: int) -> Statistics:
        """Write the video of a camera, and return statistics of a sample of its pixels as values from 0 to 1."""
        sample: list[UInt8[np.ndarray, "height width 3"]] = []

        def sample_while_iterating() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
            for step, frame in enumerate(frames):
                height, width = (size // 2 * 2 for size in frame.shape[:2])
                first_shape = self._features.setdefault(key, self._describe_camera(height, width))["shape"]
                if first_shape[:2] != [height, width]:
                    needed = f"{first_shape[0]}x{first_shape[1]}, as in the first episode"
                    fix = "Convert recordings with different image sizes to separate data sets"
                    raise InputError(where=key, found=f"frames of {height}x{width}", needed=needed, fix=fix)
                if step % (steps // _SAMPLED_FRAMES + 1) == 0:
                    pixel_stride = min(height, width) // _SAMPLED_SIDE + 1
                    sample.append(frame[:height:pixel_stride, :width:pixel_stride])
                yield frame

        write_video(
            path, sample_while_iterating(), rate_hz=float(self._rate_hz), crf=_CRF, key_frame_every=_KEY_FRAME_EVERY
        )
        pixel_statistics = compute_statistics(np.stack(sample).reshape(-1, 3) / 255) | {
            "count": np.array([len(sample)])
        }
        return {name: value if name == "count" else value.reshape(3, 1, 1) for name, value in pixel_statistics.items()}

    def _describe_camera(self, height: int, width: int) -> dict[str, Any]:
        sizes = {"video.height": height, "video.width": width, "video.fps": self._rate_hz}
        shape, names = [height, width, 3], ["height", "width", "channels"]
        return {"dtype": "video", "shape": shape, "names": names, "info": self._template["camera"] | sizes}

    def _to_arrow(self, values: Shaped[np.ndarray, "steps numbers"]) -> Any:
        flat, width = self._pa.array(values.ravel()), values.shape[1]
        return flat if width == 1 else self._pa.FixedSizeListArray.from_arrays(flat, width)

    def _write_rows(self) -> None:
        if rows := self._rows:
            self._append(fill_template(TABLES["v3.0"], 0, 0), {name: [row[name] for row in rows] for name in rows[0]})
            rows.clear()

    def _append(self, name: str, columns: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        """Append a row group to a Parquet file, creating the file if needed."""
        table = self._pa.table(dict(columns), metadata=metadata)
        if name not in self._tables:
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            self._tables[name] = self._pa.parquet.ParquetWriter(path, table.schema, write_page_checksum=True)
        self._tables[name].write_table(table)


def compute_statistics(values: Shaped[np.ndarray, "steps numbers"]) -> Statistics:
    """Return the statistics of each number of a column."""
    numbers = values.astype(np.float64)
    moments = {"mean": numbers.mean(axis=0), "std": numbers.std(axis=0), "count": np.array([len(values)])}
    quantiles = dict(zip(_QUANTILES, np.quantile(numbers, [*_QUANTILES.values()], axis=0), strict=True))
    return {"min": values.min(axis=0), "max": values.max(axis=0), **moments, **quantiles}


def combine_statistics(first: Statistics, second: Statistics) -> Statistics:
    """Combine the statistics of two sets of steps. Quantiles are averaged, weighted by count, as in LeRobot."""
    weight = second["count"] / (first["count"] + second["count"])
    averages = {name: first[name] + (second[name] - first[name]) * weight for name in ("mean", *_QUANTILES)}
    variances = [
        statistics["std"] ** 2 + (statistics["mean"] - averages["mean"]) ** 2 for statistics in (first, second)
    ]
    std, count = np.sqrt(variances[0] * (1 - weight) + variances[1] * weight), first["count"] + second["count"]
    extremes = {"min": np.minimum(first["min"], second["min"]), "max": np.maximum(first["max"], second["max"])}
    return {**extremes, "std": std, "count": count, **averages}


def _file_indices(kind: str, chunk: int, file: int) -> dict[str, Any]:
    return {f"{kind}/chunk_index": chunk, f"{kind}/file_index": file}
