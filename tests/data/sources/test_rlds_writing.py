"""Written RLDS data sets have DROID's schema, as written by TFDS (golden/DATA_ORIGIN.md)."""

import json
from pathlib import Path

import numpy as np

from paths import GOLDEN
from synthetic import synthetic_episode, write_synthetic_droid
from tfrecords import decode_example, index_records, read_record
from vjepa2_ac.simulation.droid_writer import CAMERAS, write_droid_rlds


def layout(shard: Path) -> dict[str, list[object]]:
    """Return kind and number of values (per step) of the features of the first record."""
    features = decode_example(read_record(index_records(shard)[0]))
    steps = len(features["steps/is_first"][1])
    return {
        name: [kind, len(values) // (steps if name.startswith("steps/") else 1)]
        for name, (kind, values) in features.items()
    }


def test_records_have_the_layout_of_tfds(droid: Path) -> None:
    golden = json.loads((GOLDEN / "droid_record_layout.json").read_text())
    for shard in droid.glob("*.tfrecord-*"):
        assert layout(shard) == golden


def test_golden_layout_equals_a_file_written_by_tfds(shared: Path) -> None:
    folder = shared / "data" / "droid_rlds" / "r2d2_faceblur" / "1.0.0"
    assert layout(sorted(folder.glob("*.tfrecord-*"))[0]) == json.loads(
        (GOLDEN / "droid_record_layout.json").read_text()
    )
    assert (folder / "features.json").read_text() == (GOLDEN / "droid_features.json").read_text()


def test_features_json_equals_tfds_byte_for_byte(tmp_path: Path) -> None:
    folder = write_synthetic_droid(tmp_path / "set", episodes=1, steps=2, shards=1)
    assert (folder / "features.json").read_text() == (GOLDEN / "droid_features.json").read_text()


def test_dataset_info_counts_match_the_shards(droid: Path) -> None:
    info = json.loads((droid / "dataset_info.json").read_text())
    (split,) = info["splits"]
    spans = [index_records(shard) for shard in sorted(droid.glob("*.tfrecord-*"))]
    assert split["shardLengths"] == [str(len(shard)) for shard in spans]
    assert split["numBytes"] == str(sum(span.length for shard in spans for span in shard))
    assert sorted(path.name for path in droid.iterdir()) == [
        "dataset_info.json",
        "features.json",
        "r2d2_faceblur-train.tfrecord-00000-of-00002",
        "r2d2_faceblur-train.tfrecord-00001-of-00002",
    ]


def test_written_flags_and_reward_follow_from_length_and_path(tmp_path: Path) -> None:
    episodes = [synthetic_episode(number, steps=3, size=(16, 32), success=number == 0) for number in range(2)]
    folder = write_droid_rlds(tmp_path / "set", episodes, shards=1)
    spans = index_records(next(folder.glob("*.tfrecord-*")))
    for span, episode, reward in zip(spans, episodes, ([0, 0, 1], [0, 0, 0]), strict=True):
        values = {name: list(values) for name, (_, values) in decode_example(read_record(span)).items()}
        expected = {"is_first": [1, 0, 0], "is_last": [0, 0, 1], "is_terminal": [0, 0, 1], "discount": [1, 1, 1]}
        assert {name: values[f"steps/{name}"] for name in [*expected, "reward"]} == {**expected, "reward": reward}
        for name, array in episode.arrays.items():
            assert np.array_equal(values[f"steps/{name}"], array.astype(np.float32).ravel())
        for camera in CAMERAS:
            assert values[f"steps/observation/{camera}"] == episode.images[camera]
