"""RLDS episodes equal the written episodes, and errors contain the path and number of the record."""

import dataclasses
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg

from synthetic import synthetic_episode, synthetic_states
from tfrecords import index_records
from vjepa2_ac.config import DataConfig, RldsFields
from vjepa2_ac.data.index import EpisodeProblem
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation.droid_writer import CAMERAS, write_droid_rlds

Features = dict[str, tuple[Any, Any]]
WriteChanged = Callable[[Callable[[Features], None]], Path]
BRIDGE = RldsFields(
    state=("steps/observation/state",),
    gripper_open=1.0,
    gripper_closed=0.0,
    identity=("episode_metadata/file_path", "episode_metadata/episode_id"),
    cameras={"image_0": "steps/observation/image_0"},
    control_rate_hz=5.0,
)


def open_droid(folder: Path, **values: Any) -> RldsSource:
    return RldsSource(DataConfig(path=str(folder), **values))


def set_step_2(features: Features, name: str, value: float) -> None:
    values = features[f"steps/observation/{name}"][1]
    values[2 * len(values) // 12] = value


def convert_to_degrees(poses: list[float]) -> None:
    poses[:] = [value * 57.3 if index % 6 >= 3 else value for index, value in enumerate(poses)]


def to_error(problem: EpisodeProblem) -> InputError:
    return InputError(where=problem.where, found=problem.found, needed=problem.needed, fix=problem.fix)


def test_episodes_equal_the_written_episodes(droid: Path) -> None:
    source = open_droid(droid)
    infos = source.infos()
    assert sorted(info.num_steps for info in infos) == [12, 13, 14, 15, 16, 17]
    for index, info in enumerate(infos):
        number = int(info.id.split("episode_")[1][:4])
        assert info.success is (number % 3 != 2)
        episode = source.read(index)
        assert episode.info == info
        assert np.array_equal(episode.states, synthetic_states(info.num_steps + 1, seed=number)[:-1])
        recorded_frames = synthetic_episode(number, steps=info.num_steps, size=(48, 96)).images[CAMERAS[0]]
        frames = episode.read_frames([info.num_steps - 1, 0])
        for frame, jpeg in zip(frames, (recorded_frames[-1], recorded_frames[0]), strict=True):
            assert np.array_equal(frame, simplejpeg.decode_jpeg(jpeg, fastdct=True))
        assert episode.metadata["language"] == f"move to place {number}"
        assert episode.control_rate_hz == 15.0


def test_only_requested_frames_are_decoded(write_with_changed_record: WriteChanged) -> None:
    def change_features(features: Features) -> None:
        features["steps/observation/exterior_image_1_left"][1][5] = b"\xff\xd8 no JPEG"
        features["steps/observation/wrist_image_left"][1][:] = [b""] * 12

    episode = open_droid(write_with_changed_record(change_features)).read(0)
    assert episode.read_frames([0, 4, 6]).shape == (3, 48, 96, 3)
    with pytest.raises(InputError, match=r"exterior_image_1_left: step 5: .*not a JPEG"):
        episode.read_frames([4, 5])


def test_states_and_images_equal_tfds_bit_for_bit(shared: Path) -> None:
    folder = shared / "data" / "droid_rlds"
    expected = json.loads((folder / "expected.json").read_text())
    with np.load(folder / "expected.npz") as arrays:
        tfds_arrays = dict(arrays)
    num_compared = 0
    for camera, feature in RldsFields().cameras.items():
        source = open_droid(folder / "r2d2_faceblur" / "1.0.0", camera=camera)
        assert [info.id for info in source.infos()] == expected["record_order"]
        for number, info in enumerate(source.infos()):
            assert info.num_steps == expected["episodes"][info.id]["steps"]
            assert info.success == (expected["episodes"][info.id]["outcome"] == "success")
            episode = source.read(number)
            assert np.array_equal(episode.states, tfds_arrays[f"{number}.states"])
            for name, value in tfds_arrays.items():
                if name.startswith(f"{number}.{feature.split('/')[-1]}."):
                    assert np.array_equal(episode.read_frames([int(name.split(".")[-1])])[0], value)
                    num_compared += 1
    assert num_compared == 18


def test_real_robot_episodes_are_read_with_configured_feature_names(shared: Path) -> None:
    path = str(shared / "data" / "bridge_rlds" / "bridge_dataset" / "1.0.0")
    source = RldsSource(DataConfig(path=path, fields=BRIDGE, camera="image_0"))
    infos = source.infos()
    assert len({info.id for info in infos}) == 25
    for number, info in enumerate(infos):
        episode = source.read(number)
        assert info.success is None
        assert episode.read_frames([0, info.num_steps - 1]).std() > 20  # images of arbitrary content
        assert abs(np.diff(episode.states[:, :3], axis=0)).max() < 0.1  # metres in a fifth of a second
        assert episode.states[:, 6].min() > -0.05
        assert episode.states[0, 6] < 0.1  # the gripper starts open
        assert episode.metadata["language"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.pop("steps/observation/cartesian_position"), "no feature steps/observation/cartesian_position"),
        (
            lambda f: f.pop("steps/observation/exterior_image_1_left"),
            "Did you mean steps/observation/exterior_image_2_left",
        ),
        (
            lambda f: f.pop("episode_metadata/file_path"),
            "no feature episode_metadata/file_path; existing features: .*steps/action",
        ),
        (lambda f: f.update({"steps/is_first": ("float_list", [1.0] * 12)}), "a float_list.*Expected a int64_list"),
        (lambda f: f.update({"steps/is_first": ("int64_list", [])}), "no steps.*Expected one or more"),
        (lambda f: set_step_2(f, "cartesian_position", float("nan")), "step 2: .*finite"),
        (lambda f: set_step_2(f, "gripper_position", 1.5), "step 2: .*gripper between 0 and 1"),
        (lambda f: convert_to_degrees(f["steps/observation/cartesian_position"][1]), "radians"),
        (
            lambda f: f["steps/observation/gripper_position"][1].extend([0.0] * 12),
            "position \\[6\\] .*position \\[2\\]",
        ),
    ],
)
def test_unusable_episode_is_a_problem_and_not_in_the_table(
    write_with_changed_record: WriteChanged, change: Any, message: str
) -> None:
    def change_features(features: Features) -> None:
        change(features)

    table = open_droid(write_with_changed_record(change_features)).infos()
    assert len(table) == 5
    [problem] = table.problems
    assert "tfrecord-00000-of-00002: record 0 at byte 0" in problem.where
    assert re.search(message, str(to_error(problem)))


def test_data_set_without_usable_episode_raises_first_error(tmp_path: Path, droid: Path) -> None:
    good = [synthetic_episode(number, steps=40, size=(16, 32)) for number in range(3)]
    out_of_reach = {"observation/cartesian_position": np.full((40, 6), 7.0)}
    out_of_reach_episodes = [
        dataclasses.replace(episode, arrays={**episode.arrays, **out_of_reach}) for episode in good
    ]
    folder = write_droid_rlds(tmp_path / "some", [good[0], *out_of_reach_episodes[1:]], shards=1)
    table = open_droid(folder).infos()
    assert ([info.id for info in table], len(table.problems)) == ([table.identity(0)], 2)
    unusable_folder = write_droid_rlds(tmp_path / "every", out_of_reach_episodes, shards=1)
    with pytest.raises(InputError, match=r"within 5 m.*Check data\.fields: state, .*gripper_closed\.$"):
        open_droid(unusable_folder).infos()
    with pytest.raises(InputError, match="no feature steps/nothing"):
        open_droid(droid, fields=RldsFields(state=("steps/nothing",))).infos()


def test_first_read_on_a_machine_detects_damage(droid: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(droid, tmp_path / "set")
    shard = sorted(folder.glob("*.tfrecord-*"))[0]
    open_droid(folder).read(0)
    change_silently(shard, index_records(shard)[0].end - 10, shard.stat())
    open_droid(folder).read(0)  # a new source, as in another process
    with pytest.raises(InputError, match="record 0 at byte 0: the CRC of the data does not match"):
        open_droid(folder, disk_cache={"dir": str(tmp_path / "other")}).read(0)


def change_silently(file: Path, offset: int, status: os.stat_result) -> None:
    """Flip a bit without changing size and modification time, as a failing disk does."""
    content = bytearray(file.read_bytes())
    content[offset] ^= 1
    file.write_bytes(content)
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))


def test_file_changed_during_use_raises(droid: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(droid, tmp_path / "set")
    source = open_droid(folder)
    episode = source.read(0)
    shard = sorted(folder.glob("*.tfrecord-*"))[0]
    os.truncate(shard, shard.stat().st_size // 2)
    for use in (lambda: source.read(0), lambda: episode.read_frames([3])):
        with pytest.raises(InputError, match=rf"{shard.name}: .*the file has changed since the data set was opened"):
            use()
    shard.unlink()
    with pytest.raises(InputError, match=rf"{shard.name}: cannot be read"):
        source.read(0)


def test_truncated_shard_loses_only_records_after_the_cut(droid: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(droid, tmp_path / "set")
    shard = sorted(folder.glob("*.tfrecord-*"))[0]
    content = shard.read_bytes()
    offsets = [span.end for span in index_records(shard)]
    for size in (0, 1, 12, 1000, len(content) // 2, len(content) - 1, *offsets[:-1]):
        shard.write_bytes(content[:size])
        table = open_droid(folder).infos()
        num_complete = sum(end <= size for end in offsets)
        assert (len(table), len(table.problems)) == (3 + num_complete, 3 - num_complete)
        assert all(shard.name in problem.where for problem in table.problems)
        assert [problem.name for problem in table.problems] == [
            f"{shard.name}: record {n}" for n in range(num_complete, 3)
        ]


def test_missing_shards_raise_with_their_names(droid: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(droid, tmp_path / "set")
    (folder / "r2d2_faceblur-train.tfrecord-00001-of-00002").unlink()
    with pytest.raises(
        InputError, match=r"1 of 2 shards are missing: r2d2_faceblur-train\.tfrecord-00001-of-00002\. .*Download them"
    ):
        open_droid(folder).infos()


def test_folder_without_data_set_suggests_subfolders(droid: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        open_droid(tmp_path / "none").infos()
    with pytest.raises(InputError, match="is empty"):
        open_droid(tmp_path).infos()
    for version in ("1.9.0", "1.10.0"):
        shutil.copytree(droid, tmp_path / version)
    with pytest.raises(InputError, match=r"did you mean .*1\.10\.0, .*1\.9\.0\?"):
        open_droid(tmp_path).infos()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "invalid JSON"),
        ('{"name": "a", "splits": []}', "no episodes"),
        ('{"name": "a", "splits": [{"name": "train", "shardLengths": ["x"]}]}', "not a valid data set description"),
        (
            '{"name": "a", "splits": [{"name": "train", "shardLengths": [9999999999]}]}',
            "shard of 9,999,999,999 episodes",
        ),
        ('{"name": "a", "fileFormat": "array_record", "splits": []}', "array_record"),
    ],
)
def test_invalid_dataset_info_raises(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "dataset_info.json").write_text(text)
    with pytest.raises(InputError, match=message):
        open_droid(tmp_path).infos()
