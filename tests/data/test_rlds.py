"""RLDS episodes are read exactly, and whatever is wrong with them is named."""

import dataclasses
import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import simplejpeg

from synthetic import synthetic_episode, synthetic_states, write_synthetic_droid
from vjepa2_ac.config import DataConfig, RldsFields
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.data.sources.rlds_writer import CAMERAS, write_droid_rlds
from vjepa2_ac.data.sources.tfrecord import index_records, read_record, write_record
from vjepa2_ac.errors import InputError

Features = dict[str, tuple[Any, Any]]
Spoil = Callable[[Callable[[Features], None]], Path]
BRIDGE = RldsFields(
    state=("steps/observation/state",),
    gripper="openness",
    identity=("episode_metadata/file_path", "episode_metadata/episode_id"),
    cameras={"image_0": "steps/observation/image_0"},
    control_rate_hz=5.0,
)


def open_droid(folder: Path, **knobs: Any) -> RldsSource:
    return RldsSource(DataConfig(path=str(folder), **knobs))


def test_what_was_written_is_read(droid: Path) -> None:
    source = open_droid(droid)
    infos = source.infos()
    assert sorted(info.num_steps for info in infos) == [12, 13, 14, 15, 16, 17]
    for index, info in enumerate(infos):
        number = int(info.id.split("episode_")[1][:4])
        assert info.success is (number % 3 != 2)
        episode = source.read(index)
        assert episode.info == info
        assert np.array_equal(episode.states, synthetic_states(info.num_steps + 1, seed=number)[:-1])
        written = synthetic_episode(number, steps=info.num_steps, size=(48, 96)).images[CAMERAS[0]]
        frames = episode.read_frames([info.num_steps - 1, 0])
        for frame, jpeg in zip(frames, (written[-1], written[0]), strict=True):
            assert np.array_equal(frame, simplejpeg.decode_jpeg(jpeg, fastdct=True))
        assert episode.metadata["language"] == f"move to place {number}"
        assert episode.control_rate_hz == 15.0


def test_a_camera_is_the_one_that_was_asked_for(droid: Path) -> None:
    frames = {camera: open_droid(droid, camera=camera).read(0).read_frames([0]) for camera in RldsFields().cameras}
    blue = [frame[..., 2].mean() for frame in frames.values()]
    assert blue[0] + 20 < blue[1] < blue[2] - 20


def test_only_the_frames_asked_for_are_decoded(spoiled: Spoil) -> None:
    def spoil(features: Features) -> None:
        features["steps/observation/exterior_image_1_left"][1][5] = b"\xff\xd8 no JPEG"
        features["steps/observation/wrist_image_left"][1][:] = [b""] * 12

    episode = open_droid(spoiled(spoil)).read(0)
    assert episode.read_frames([0, 4, 6]).shape == (3, 48, 96, 3)
    with pytest.raises(InputError, match=r"exterior_image_1_left: step 5: .*not a JPEG"):
        episode.read_frames([4, 5])


def test_states_and_pictures_equal_what_tfds_reads_bit_for_bit(shared: Path) -> None:
    folder = shared / "data" / "droid_rlds"
    expected = json.loads((folder / "expected.json").read_text())
    with np.load(folder / "expected.npz") as arrays:
        tfds = dict(arrays)
    compared = 0
    for camera, feature in RldsFields().cameras.items():
        source = open_droid(folder / "r2d2_faceblur" / "1.0.0", camera=camera)
        assert [info.id for info in source.infos()] == expected["record_order"]
        for number, info in enumerate(source.infos()):
            assert info.num_steps == expected["episodes"][info.id]["steps"]
            assert info.success == (expected["episodes"][info.id]["outcome"] == "success")
            episode = source.read(number)
            assert np.array_equal(episode.states, tfds[f"{number}.states"])
            for name, value in tfds.items():
                if name.startswith(f"{number}.{feature.split('/')[-1]}."):
                    assert np.array_equal(episode.read_frames([int(name.split(".")[-1])])[0], value)
                    compared += 1
    assert compared == 18


def test_real_robot_episodes_of_another_schema_are_read_by_mapped_names(shared: Path) -> None:
    path = str(shared / "data" / "bridge_rlds" / "bridge_dataset" / "1.0.0")
    source = RldsSource(DataConfig(path=path, fields=BRIDGE, camera="image_0"))
    infos = source.infos()
    assert len({info.id for info in infos}) == 25
    for number, info in enumerate(infos):
        episode = source.read(number)
        assert info.success is None
        assert episode.read_frames([0, info.num_steps - 1]).std() > 20  # pictures of something
        assert abs(np.diff(episode.states[:, :3], axis=0)).max() < 0.1  # metres in a fifth of a second
        assert episode.states[:, 6].min() > -0.05
        assert episode.states[0, 6] < 0.1  # the gripper starts open
        assert episode.metadata["language"]


def test_openness_becomes_closedness(droid: Path) -> None:
    closedness = open_droid(droid).read(1).states
    openness = open_droid(droid, fields=RldsFields(gripper="openness")).read(1).states
    assert np.array_equal(openness[:, 6], 1 - closedness[:, 6])
    assert np.array_equal(openness[:, :6], closedness[:, :6])


def test_a_source_travels_to_a_worker_small(droid: Path) -> None:
    source = open_droid(droid)
    infos = source.infos()
    source.read(0)
    sent = pickle.dumps(source)
    assert len(sent) < 5_000
    assert pickle.loads(sent).infos() == infos  # noqa: S301 - our own bytes


def test_a_data_set_behind_a_url_is_read_like_a_local_one(droid: Path) -> None:
    memory = fsspec.filesystem("memory")
    for file in droid.iterdir():
        memory.pipe_file(f"/droid/{file.name}", file.read_bytes())
    here, there = open_droid(droid), RldsSource(DataConfig(path="memory://droid"))
    assert there.infos() == here.infos()
    assert np.array_equal(there.read(4).states, here.read(4).states)
    assert np.array_equal(there.read(4).read_frames([3]), here.read(4).read_frames([3]))


def test_identities_do_not_depend_on_the_shards(droid: Path, tmp_path: Path) -> None:
    other = write_synthetic_droid(tmp_path / "set", steps=range(12, 18), size=(16, 32), shards=5)
    assert {info.id for info in open_droid(other).infos()} == {info.id for info in open_droid(droid).infos()}


def test_length_is_that_of_the_states_where_no_step_is_flagged(spoiled: Spoil) -> None:
    folder = spoiled(lambda features: features.pop("steps/is_first") and None)
    assert open_droid(folder).infos()[0].num_steps == 12


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
            "no feature episode_metadata/file_path; the record has .*steps/action",
        ),
        (lambda f: f.update({"steps/is_first": ("float_list", [1.0] * 12)}), "a float_list.*needed: a int64_list"),
    ],
)
def test_a_record_without_a_needed_field_is_found_before_any_clip(spoiled: Spoil, change: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        open_droid(spoiled(change)).infos()
    assert "tfrecord-00000-of-00002: record 0 at byte 0" in caught.value.where


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("cartesian_position", float("nan"), "step 2: .*finite"),
        ("cartesian_position", 900.0, "step 2: .*within 5 m"),
        ("gripper_position", 1.5, "step 2: .*gripper between 0 and 1"),
        ("cartesian_position", None, "71 numbers"),
    ],
)
def test_a_state_that_cannot_be_one_is_named(spoiled: Spoil, name: str, value: float | None, message: str) -> None:
    def spoil(features: Features) -> None:
        values = features[f"steps/observation/{name}"][1]
        if value is None:
            values.pop()
        else:
            values[2 * len(values) // 12] = value

    source = open_droid(spoiled(spoil))
    for meet in (source.infos, lambda: source.read(0)):  # at the start, and under a CRC that is checked
        with pytest.raises(InputError, match=message):
            meet()


def test_an_episode_that_cannot_be_used_says_how_to_leave_it_out(spoiled: Spoil) -> None:
    folder = spoiled(lambda features: features["steps/observation/gripper_position"][1].pop() and None)
    with pytest.raises(InputError, match=r"To leave out, add to data\.exclude: \[\S+\]") as caught:
        open_droid(folder).infos()
    exclude = tuple(json.loads(caught.value.fix.split("data.exclude: ")[1]))
    infos = open_droid(folder, exclude=exclude).infos()
    assert [info.id for info in infos if info.num_steps == 0] == list(exclude) == [infos[0].id]


def test_episodes_that_cannot_be_used_are_named_together(tmp_path: Path) -> None:
    far = dataclasses.replace(synthetic_episode(0).observation, cartesian_position=np.full((40, 6), 7.0))
    drawn = [synthetic_episode(number, steps=40, size=(16, 32)) for number in range(4)]
    bad = [dataclasses.replace(episode, observation=far) for episode in drawn]
    folder = write_droid_rlds(tmp_path / "set", [drawn[0], *bad[1:3], drawn[3]], shards=1)
    with pytest.raises(InputError, match=r"within 5 m.*1 more cannot be used either.*episode_0001.*episode_0002"):
        open_droid(folder).infos()
    every_one = write_droid_rlds(tmp_path / "every", bad, shards=1)
    with pytest.raises(InputError, match=r"within 5 m.*Check data\.fields\.state\.$"):
        open_droid(every_one).infos()


def test_a_data_set_without_language_is_read(spoiled: Spoil) -> None:
    source = open_droid(spoiled(lambda features: features.pop("steps/language_instruction") and None))
    assert source.infos()[0].num_steps == 12
    assert source.read(0).metadata == {}
    assert source.read(1).metadata["language"]


def test_degrees_are_not_taken_for_radians(spoiled: Spoil) -> None:
    def spoil(features: Features) -> None:
        values = features["steps/observation/cartesian_position"][1]
        values[:] = [value * 57.3 if place % 6 >= 3 else value for place, value in enumerate(values)]

    with pytest.raises(InputError, match="radians"):
        open_droid(spoiled(spoil)).read(0)


def test_a_state_of_the_wrong_width_says_what_it_is_made_of(droid: Path) -> None:
    fields = RldsFields(state=("steps/observation/joint_position", "steps/observation/gripper_position"))
    with pytest.raises(InputError, match=r"joint_position \[7\] \+ .*gripper_position \[1\]"):
        open_droid(droid, fields=fields).read(0)


def test_a_picture_too_few_is_named(spoiled: Spoil) -> None:
    folder = spoiled(lambda features: features["steps/observation/exterior_image_1_left"][1].pop() and None)
    with pytest.raises(InputError, match=r"11 pictures.*12 steps"):
        open_droid(folder).read(0)


def test_two_episodes_of_one_identity_are_refused(tmp_path: Path) -> None:
    episode = synthetic_episode(0, steps=3, size=(16, 32))
    folder = write_droid_rlds(tmp_path / "set", [episode, episode], shards=2)
    with pytest.raises(
        InputError, match=r"00001-of-00002: record 0.*same identity as .*00000-of-00002: record 0"
    ) as caught:
        open_droid(folder).infos()
    exclude = tuple(json.loads(caught.value.fix.split("data.exclude: ")[1]))
    assert len(open_droid(folder, exclude=exclude).infos()) == 2  # of which none takes part


def test_every_flipped_bit_is_noticed(droid: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(droid, tmp_path / "set")
    shard = sorted(folder.glob("*.tfrecord-*"))[1]
    whole = bytearray(shard.read_bytes())
    for position in np.random.default_rng(0).integers(0, 8 * len(whole), 100):
        whole[position // 8] ^= 1 << position % 8
        shard.write_bytes(whole)
        source = open_droid(folder)
        with pytest.raises(InputError, match=rf"{shard.name}.*CRC"):
            [source.read(number) for number in range(len(source.infos()))]
        whole[position // 8] ^= 1 << position % 8


def test_damage_under_a_right_crc_is_an_error_or_other_values_but_never_a_crash(droid: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(droid, tmp_path / "set")
    shard = sorted(folder.glob("*.tfrecord-*"))[0]
    first, *others = (read_record(span) for span in index_records(shard))
    generator = np.random.default_rng(0)
    refused = 0
    for _ in range(100):
        data = bytearray(first)
        for place in generator.integers(0, len(data), 20):
            data[place] = generator.integers(256)
        with shard.open("wb") as file:
            for record in (bytes(data), *others):
                write_record(file, record)
        source = open_droid(folder)
        try:
            source.read(0).read_frames(range(source.infos()[0].num_steps))
        except InputError:
            refused += 1
    assert refused > 10


def test_a_shard_truncated_anywhere_is_noticed(droid: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(droid, tmp_path / "set")
    shard = sorted(folder.glob("*.tfrecord-*"))[0]
    whole = shard.read_bytes()
    ends = [span.end for span in index_records(shard)]
    for size in (0, 1, 12, 1000, len(whole) // 2, len(whole) - 1, *ends[:-1]):
        shard.write_bytes(whole[:size])
        with pytest.raises(InputError, match=shard.name):
            open_droid(folder).infos()


def test_missing_shards_are_named(droid: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(droid, tmp_path / "set")
    (folder / "r2d2_faceblur-train.tfrecord-00001-of-00002").unlink()
    with pytest.raises(InputError, match=r"1 of 2 shards are missing: r2d2_faceblur-train\.tfrecord-00001-of-00002"):
        open_droid(folder).infos()


def test_a_folder_without_a_data_set_says_where_one_is(droid: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        open_droid(tmp_path / "none").infos()
    with pytest.raises(InputError, match="is empty"):
        open_droid(tmp_path).infos()
    with pytest.raises(InputError, match=r"did you mean .*1\.0\.0\?"):
        open_droid(droid.parent).infos()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "cannot be read"),
        ("[]", "another kind"),
        ('{"name": "a"}', "not a description"),
        ('{"name": "a", "splits": []}', "no episodes"),
        ('{"name": "a", "splits": [{"name": "train", "shardLengths": ["x"]}]}', "not a description"),
        ('{"name": "a", "fileFormat": "array_record", "splits": []}', "array_record"),
    ],
)
def test_a_description_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "dataset_info.json").write_text(text)
    with pytest.raises(InputError, match=message):
        open_droid(tmp_path).infos()
