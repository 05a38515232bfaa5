"""Replay: a share of the clips from a second data set, in an order that resumes exactly; mismatches are errors."""

import itertools
import json
from pathlib import Path

import pytest

from run_fixtures import KilledError, dying_reporter, set_up
from same_run import assert_same_run
from synthetic import write_synthetic_droid
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict, parse_config
from vjepa2_ac.data import loader
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import MixedDataset, training_loader
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import newest_checkpoint, read_state
from vjepa2_ac.runs.folder import read_run_config
from vjepa2_ac.training.loop import train

Names = list[tuple[str, int]]


@pytest.fixture(scope="module")
def second(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the replay data set, whose episodes differ from those of the first data set."""
    folder = tmp_path_factory.mktemp("second") / "set"
    return write_synthetic_droid(folder, episodes=4, steps=20, size=(36, 64), first=100)


@pytest.fixture
def make_replay_config(make_config, second: Path):
    """Return a config of a run that replays the second data set."""

    def make(share: float = 0.25, **changes: object) -> Config:
        values = config_as_dict(make_config())
        data = {**values["data"], "path": str(second), "validation_share": 0.0, "test_share": 0.0}
        replay_keys = {f"replay__data__{key}": value for key, value in data.items()}
        return make_config(**{**replay_keys, "replay__share": share, **changes})

    return make


def names(batches: list[Batch]) -> Names:
    return [name for batch in batches for name in zip(batch.episode_ids, batch.starts, strict=True)]


def draw_clips(config: Config, count: int, **options: object) -> Names:
    first, replayed = (open_dataset(data) for data in config.data_sets)
    loader_options = {"seed": 1, "batch_size": 4, **options}
    batches = training_loader(MixedDataset(first, replayed, config.replay.share), **loader_options)
    return names(list(itertools.islice(batches, count)))


def is_replayed(name: tuple[str, int]) -> bool:
    return int(name[0].split("episode_")[1][:4]) >= 100


def test_replay_share_is_exact_and_the_order_of_each_data_set_is_unchanged(make_replay_config) -> None:
    config = make_replay_config(0.6)
    drawn = draw_clips(config, 25)
    assert sum(map(is_replayed, drawn)) == 60
    for data, replayed in zip(config.data_sets, (False, True), strict=True):
        drawn_from_data = [name for name in drawn if is_replayed(name) == replayed]
        alone = names(
            list(itertools.islice(training_loader(open_dataset(data), seed=1, batch_size=1), len(drawn_from_data)))
        )
        assert drawn_from_data == alone


def test_resumed_run_with_replay_equals_an_uninterrupted_run(make_replay_config, reporter, tmp_path) -> None:
    changes = {
        "training__steps": 4, "data__cache": "auto",
        "replay__data__cache": "auto", "data__cache_dir": str(tmp_path / "a"),
        "replay__data__cache_dir": str(tmp_path / "b"),
    }  # fmt: skip
    train(make_replay_config(run_dir=str(tmp_path / "whole"), **changes), reporter)
    config = make_replay_config(run_dir=str(tmp_path / "broken"), **changes)
    with pytest.raises(KilledError):
        train(config, dying_reporter(type(reporter)(), 3))
    train(config, reporter)
    assert_same_run(tmp_path / "whole", tmp_path / "broken")
    assert any("Replay: 25% of the training clips are drawn from" in note for note in reporter.notes)
    assert (tmp_path / "b").exists()
    state = read_state(newest_checkpoint(tmp_path / "broken/checkpoints"))
    assert state.data[1].windows == len(open_dataset(config.replay.data).windows("train"))


def test_unreadable_clip_is_recorded_in_the_data_set_that_contains_it(make_replay_config, monkeypatch) -> None:
    config = make_replay_config(0.5, data__broken_episodes="skip", replay__data__broken_episodes="skip")
    first, replayed = (open_dataset(data) for data in config.data_sets)
    for dataset in (first, replayed):
        monkeypatch.setattr(dataset.broken, "_episodes", 1_000)
    read = loader.read_clip

    def broken(dataset, request):
        if dataset.config.path == config.replay.data.path:
            raise InputError(where="here", found="damage")
        return read(dataset, request)

    monkeypatch.setattr(loader, "read_clip", broken)
    batches = list(itertools.islice(training_loader(MixedDataset(first, replayed, 0.5), seed=1, batch_size=2), 4))
    assert [len(batch.starts) for batch in batches] == [1, 1, 1, 1]
    assert not first.broken.reasons
    assert replayed.broken.reasons
    assert all(is_replayed((name, 0)) for name in replayed.broken.reasons)


# ---- incompatible data sets ----


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"replay__data__frames": 5}, r"replay.data.frames 5 differs from data.frames 4"),
        ({"replay__data__states": "vector"}, r"replay.data.states vector differs from data.states pose"),
        ({"data__cache": "auto"}, r"only one of data and replay.data uses cached latents"),
        ({"data__stride": "auto"}, r"stride: auto is not possible with replay"),
        ({"replay__share": 1.0}, r"replay.share: .*less than 1"),
        ({"replay__data__nonsense": 1}, r"replay.data.nonsense: unknown key"),
    ],
)
def test_incompatible_replay_data_set_raises_when_the_config_is_parsed(make_replay_config, changes, message) -> None:
    with pytest.raises(InputError, match=message):
        make_replay_config(**changes)


def test_replay_data_set_inherits_settings_and_writes_differences(tmp_path: Path) -> None:
    data = {"path": "one", "frames": 4, "camera": "wrist_left", "exclude": ["a"], "fields": {"control_rate_hz": 5.0}}
    second = {"path": "two", "stride": 2, "fields": {"gripper_open": 2.0}}
    values = {"run_dir": str(tmp_path), "model": {"base": "base"}, "data": data, "replay": {"data": second}}
    config = parse_config(values, ["replay.data.idle.rule=motion"], where="")
    replayed = config.replay.data
    assert (replayed.frames, replayed.camera, replayed.stride, replayed.exclude) == (4, "wrist_left", 2, ())
    assert (replayed.fields.control_rate_hz, replayed.fields.gripper_open) == (5.0, 2.0)
    config_values = config_as_dict(config)
    assert config_values["replay"]["data"] == {"source": "rlds", **second, "idle": {"rule": "motion"}}
    assert parse_config(config_values, where="") == config
    values["replay"]["data"] = {"source": "lerobot", "path": "two"}
    other = parse_config(values, where="").replay.data
    assert (other.frames, other.camera, other.source) == (4, None, "lerobot")
    assert "fields" not in config_as_dict(parse_config(values, where=""))["replay"]["data"]


def test_config_of_version_0_1_with_replay_and_removed_keys_loads(make_replay_config, caplog) -> None:
    config = make_replay_config()
    folder = Path(config.run_dir)
    folder.mkdir()
    values, removed = (
        config_as_dict(config),
        {"check_crc": "once", "connections": 16, "prefetch": 4, "short_episodes": "skip"},
    )
    values["data"] |= removed
    values["replay"]["data"] = config.replay.data.model_dump(mode="json") | removed | {"validation_share": 0.0}
    (folder / "config.yaml").write_text(json.dumps(values))
    assert read_run_config(folder) == config
    assert "data.prefetch was 4; this version always uses 2" in caplog.text


def test_other_frame_size_in_replay_raises_and_caches_are_accepted(make_replay_config, reporter, tmp_path) -> None:
    larger = write_synthetic_droid(tmp_path / "larger", episodes=4, steps=20, size=(48, 80), first=100)
    with pytest.raises(InputError, match=r"(?s)replay.data: clips of frames of 48x65.*36x49.*data.cache"):
        train(make_replay_config(replay__data__path=str(larger)), reporter)
    caches = {"data__cache": "auto", "replay__data__cache": "auto"}
    cache_folders = {"data__cache_dir": str(tmp_path / "latents"), "replay__data__cache_dir": str(tmp_path / "latents")}
    train(make_replay_config(replay__data__path=str(larger), training__steps=1, **caches, **cache_folders), reporter)
    other = {"replay__data__cache_dtype": "int8", "run_dir": str(tmp_path / "other")}
    with pytest.raises(InputError, match=r"(?s)as int8 with scales.*as bfloat16"):
        train(
            make_replay_config(replay__data__path=str(larger), training__steps=1, **caches, **cache_folders, **other),
            reporter,
        )


def test_warning_lists_held_out_episodes_in_the_replay_data(make_replay_config, reporter, data_folder) -> None:
    set_up(make_replay_config(replay__data__path=str(data_folder)), reporter)
    (warning,) = [note for note in reporter.notes if "the replay data set would train on" in note]
    held_out = open_dataset(make_replay_config().data).windows("validation")
    assert open_dataset(make_replay_config().data).table.identity(held_out[0][0]) in warning
    reporter.notes.clear()
    same = {"replay__data__validation_share": 0.3, "replay__data__test_share": 0.2}
    set_up(make_replay_config(replay__data__path=str(data_folder), **same), reporter)
    assert not [note for note in reporter.notes if "held-out" in note]
