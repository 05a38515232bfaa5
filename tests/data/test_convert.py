"""Conversion to LeRobot v3.0: the values are equal when read back, and a failed conversion leaves no folder."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from pyarrow import parquet

from lerobot_sets import Recorded, draw_numbers, numbers_of, write_v30
from synthetic import draw_frame, synthetic_states
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.data.convert import convert_to_lerobot
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.spaces import actions_from_states

CAMERAS = ("exterior_1_left", "wrist_left")
LENGTHS = [12, 14, 16, 13, 15, 17]  # of the episodes of two shards


def config_of(path: object, **data: Any) -> DataConfig:
    values = {"path": path, "frames": 3, "stride": 2, "workers": 0} | data
    return parse_config({"run_dir": "r", "data": values, "model": {"base": "builtin:sim-tiny"}}, where="").data


def read_back(folder: Path, *cameras: str, **data: Any) -> Dataset:
    lerobot = {"state": ["observation.state"], "cameras": {name: f"observation.images.{name}" for name in cameras}}
    return open_dataset(config_of(folder, source="lerobot", camera=list(cameras), lerobot=lerobot, **data))


def info_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "meta/info.json").read_text())
    return content


def mean_difference(first: np.ndarray, second: np.ndarray) -> float:
    return float(abs(first.astype(int) - second.astype(int)).mean())


def files_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_converted_poses_equal_the_originals(droid: Path, tmp_path: Path) -> None:
    config = config_of(droid, camera=list(CAMERAS))
    assert convert_to_lerobot(config, tmp_path / "out", SILENT) == (6, 87)
    before, after = open_dataset(config), read_back(tmp_path / "out", *CAMERAS)
    assert after.table.num_steps.tolist() == before.table.num_steps.tolist()
    assert after.table.success.tolist() == before.table.success.tolist() == [1, 0, 1, 1, 1, 0]
    assert after.control_rate_hz == before.control_rate_hz == 15
    for index in range(6):
        original, converted = before.source.read(index), after.source.read(index)
        np.testing.assert_array_equal(converted.states, original.states.astype(np.float32))
        np.testing.assert_allclose(
            actions_from_states(converted.states), actions_from_states(original.states), atol=2e-6
        )
        assert converted.metadata == original.metadata == {"language": f"move to place {LENGTHS[index] - 12}"}
        for camera in CAMERAS:
            steps = range(len(original.states))
            frames = [dataset.source.read(index, camera).read_frames(steps) for dataset in (before, after)]
            assert mean_difference(*frames) < 3
    table = parquet.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    actions = np.array(table["action"].to_pylist())
    last_steps = np.cumsum(before.table.num_steps) - 1
    assert not actions[last_steps].any(), "nothing follows the last step of an episode"
    np.testing.assert_allclose(actions[: last_steps[0]], actions_from_states(before.source.read(0).states), atol=1e-6)


def test_converted_video_has_one_frame_per_step(tmp_path: Path) -> None:
    def recording(number: int, steps: int) -> Recorded:
        states = synthetic_states(steps, seed=number).astype(np.float32)
        drawn = [draw_numbers(draw_frame(state, size=(48, 64)), number, step) for step, state in enumerate(states)]
        return Recorded({"observation.state": states}, {"observation.images.front": drawn})

    source = write_v30(tmp_path / "in", [recording(number, 70) for number in range(3)])
    fields = {"state": ["observation.state"], "cameras": {"front": "observation.images.front"}}
    convert_to_lerobot(config_of(source, source="lerobot", lerobot=fields), tmp_path / "out", SILENT)
    after = read_back(tmp_path / "out", "front")
    for index in range(3):
        frames = after.source.read(index).read_frames(range(70))
        assert [numbers_of(frame, 2) for frame in frames] == [(index, step) for step in range(70)]


def test_converted_files_have_the_lerobot_layout(droid: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    convert_to_lerobot(config_of(droid), out, SILENT)
    key = "observation.images.exterior_1_left"
    assert files_in(out) == [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        *(f"videos/{key}/chunk-000/file-{number:03d}.mp4" for number in range(6)),
    ]
    info = info_of(out)
    features = info.pop("features")
    assert info == {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": 6,
        "total_frames": 87,
        "total_tasks": 6,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": 15,
        "splits": {"train": "0:6"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    assert type(info["fps"]) is int
    assert features["observation.state"] == {
        "dtype": "float32", "shape": [7], "names": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
    }  # fmt: skip
    assert features["action"]["names"] == ["dx", "dy", "dz", "droll", "dpitch", "dyaw", "dgripper"]
    assert features["is_episode_successful"] == {"dtype": "bool", "shape": [1], "names": None}
    camera_info = features[key].pop("info")
    assert features[key] == {"dtype": "video", "shape": [48, 96, 3], "names": ["height", "width", "channels"]}
    assert camera_info == {
        "video.height": 48, "video.width": 96, "video.codec": "h264", "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False, "video.fps": 15, "video.channels": 3, "has_audio": False,
    }  # fmt: skip
    with av.open(str(out / f"videos/{key}/chunk-000/file-002.mp4")) as video:
        stream = video.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert (stream.average_rate, stream.frames) == (15, 16)
        assert [entry.is_keyframe for entry in stream.index_entries] == [True, False] * 8

    schema = parquet.read_schema(out / "data/chunk-000/file-000.parquet")
    assert {field.name: str(field.type) for field in schema} == {
        "observation.state": "fixed_size_list<element: float>[7]",
        "action": "fixed_size_list<element: float>[7]",
        "is_episode_successful": "bool",
        "timestamp": "float",
        "frame_index": "int64",
        "episode_index": "int64",
        "index": "int64",
        "task_index": "int64",
    }
    assert parquet.ParquetFile(out / "data/chunk-000/file-000.parquet").num_row_groups == 6
    tasks = parquet.read_table(out / "meta/tasks.parquet")
    assert tasks.column_names == ["task_index", "__index_level_0__"]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]


def test_converted_statistics_match_numbers_and_pixels(droid: Path, tmp_path: Path) -> None:
    convert_to_lerobot(config_of(droid), tmp_path / "out", SILENT)
    dataset = open_dataset(config_of(droid))
    states = [dataset.source.read(index).states.astype(np.float32) for index in range(6)]
    statistics = json.loads((tmp_path / "out/meta/stats.json").read_text())
    all_states, state_statistics = np.concatenate(states), statistics["observation.state"]
    for kind in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(
            state_statistics[kind], getattr(np, kind)(all_states.astype(float), axis=0), atol=1e-6
        )
    assert state_statistics["count"] == [87]
    weights = [len(episode_states) / 87 for episode_states in states]
    medians = sum(
        weight * np.median(episode_states, axis=0) for weight, episode_states in zip(weights, states, strict=True)
    )
    np.testing.assert_allclose(state_statistics["q50"], medians, atol=1e-6)
    success_statistics, pixel_statistics = (
        statistics["is_episode_successful"],
        statistics["observation.images.exterior_1_left"],
    )
    assert (success_statistics["min"], success_statistics["max"]) == ([False], [True])
    frames = (
        np.concatenate([dataset.source.read(i).read_frames(range(LENGTHS[i])) for i in range(6)]).reshape(-1, 3) / 255
    )
    for kind in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(np.ravel(pixel_statistics[kind]), getattr(np, kind)(frames, axis=0), atol=1e-9)
    assert (np.shape(pixel_statistics["mean"]), pixel_statistics["count"]) == ((3, 1, 1), [87])


def test_conversion_writes_idle_steps_and_omits_excluded_episodes(droid: Path, tmp_path: Path) -> None:
    idle = {"rule": "motion", "shortest_kept_steps": 2, "cut_last_steps": 6}
    config = config_of(droid, idle=idle, validation_share=0.5, stride="auto")
    assert convert_to_lerobot(config, tmp_path / "out", SILENT) == (6, 87)
    missing_list = config_of(droid, idle={"rule": "published", "ranges": str(tmp_path / "missing.json")})
    assert convert_to_lerobot(missing_list, tmp_path / "unfiltered", SILENT) == (6, 87)
    first = open_dataset(config_of(droid)).table.identity(0)
    filtered = config_of(droid, idle=idle, exclude=[first], outcome="success")
    assert convert_to_lerobot(filtered, tmp_path / "less", SILENT) == (3, 13 + 15 + 16)
    assert read_back(tmp_path / "less", "exterior_1_left").table.num_steps.tolist() == [16, 13, 15]


# Data sets that cannot be written.


def damaged(write_with_changed_record: Callable[..., Path]) -> Path:
    def change_features(features: dict[str, tuple[Any, Any]]) -> None:
        features["steps/observation/wrist_image_left"][1][9] = b"GIF89a"  # after other frames were written

    return write_with_changed_record(change_features)


def test_broken_episode_stops_the_conversion_and_leaves_no_folder(
    write_with_changed_record: Callable[..., Path], tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"not a JPEG.*add to data\.exclude"):
        convert_to_lerobot(
            config_of(damaged(write_with_changed_record), camera=list(CAMERAS)), tmp_path / "out", SILENT
        )
    assert not (tmp_path / "out").exists()


def test_broken_episode_is_skipped_by_the_skip_policy(
    write_with_changed_record: Callable[..., Path], tmp_path: Path
) -> None:
    config = config_of(damaged(write_with_changed_record), camera=list(CAMERAS), broken_episodes="skip")
    assert convert_to_lerobot(config, tmp_path / "out", SILENT) == (5, 75)
    after = read_back(tmp_path / "out", *CAMERAS)
    assert after.table.num_steps.tolist() == LENGTHS[1:]
    videos = [name for name in files_in(tmp_path / "out") if name.endswith(".mp4")]
    assert len(videos) == 10
    assert (
        mean_difference(
            after.source.read(0, CAMERAS[1]).read_frames([5]),
            open_dataset(config).source.read(1, CAMERAS[1]).read_frames([5]),
        )
        < 3
    )


def test_conversion_of_latents_or_camera_names_with_a_slash_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a latent cache, which has no frames.*to write its frames"):
        convert_to_lerobot(config_of("x", source="latents"), tmp_path / "out", SILENT)
    with pytest.raises(InputError, match=r"'a/b'.*without /"):
        convert_to_lerobot(config_of("x", source="npz", camera="a/b"), tmp_path / "out", SILENT)
