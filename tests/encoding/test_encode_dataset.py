"""Encoding encodes each frame once, also after interruptions; a run on cached latents equals a run on frames."""

import errno
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from killable import KILLED, ForkServer
from latent_sets import NUMBERS, contents, latents_in, opened, write_cache
from ranks import finish, free_port, start_rank
from run_fixtures import MakeConfig, SilentReporter, as_yaml
from same_run import assert_same_run
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.encoding.encode_dataset import EncodingResult, encode_config
from vjepa2_ac.encoding.latent_cache import needed_frames
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage import files as storage_files
from vjepa2_ac.training.loop import train


def encode(
    config: Config, out: Path, progress: Progress | None = None, reporter: SilentReporter | None = None
) -> EncodingResult:
    reporter = reporter or SilentReporter()
    if progress is not None:
        reporter.task = lambda *_: progress
    return encode_config(config, reporter, out=out)


def count_needed_frames(config: Config) -> int:
    return sum(len(request.steps) for request in needed_frames(open_dataset(config.data)))


def test_each_needed_frame_is_encoded_once(
    make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int], reporter: SilentReporter
) -> None:
    config = make_config(data__start_every=2)
    progress: list[tuple[int, int]] = []
    result = encode(config, tmp_path / "out", lambda *counts: progress.append(counts), reporter)
    frames = count_needed_frames(config)
    assert frames == 8 * 12  # every second of 24 steps
    assert sum(encoded_frames) == frames
    assert (0, frames) in progress
    assert progress[-1] == (frames, frames)
    assert (result.encoded, result.episodes, result.frames, result.is_finished) == (8, 8, frames, True)
    assert result.bytes == sum(path.stat().st_size for path in latents_in(tmp_path / "out"))
    assert "GB free)" in reporter.notes[1]
    encoded_frames.clear()
    assert encode(config, tmp_path / "out") == result
    assert not encoded_frames


# ---- interruptions -----------------------------------------------------------------------------------------------


def test_kill_loses_at_most_one_episode(
    fork_server: ForkServer, make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]
) -> None:
    config = make_config(data__start_every=2)
    (tmp_path / "config.yaml").write_text(as_yaml(config))
    encode(config, tmp_path / "whole")
    expected, out, num_files = contents(tmp_path / "whole"), tmp_path / "out", 0
    command = ("encode", str(tmp_path / "config.yaml"), "--out", str(out))
    for die_at in (2, 9, 13, 16):
        assert fork_server.start(*command, folder=out, die_at=die_at).wait() == KILLED
        files = [path for path in latents_in(out) if not path.name.startswith(".")]
        assert all(opened(path) == expected[str(path.relative_to(out))] for path in files)
        assert num_files <= len(files) < 8
        num_files = len(files)
    assert num_files > 0
    encoded_frames.clear()
    assert encode(config, out).is_finished
    assert sum(encoded_frames) == (8 - num_files) * 12
    assert contents(out) == expected


def test_processes_split_the_episodes_without_waiting(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoded_frames: list[int]
) -> None:
    config = make_config(data__start_every=2)
    encode(config, tmp_path / "whole")
    monkeypatch.setenv("WORLD_SIZE", "3")
    for rank, episodes, is_last in (("2", 2, False), ("0", 3, False), ("1", 3, True)):
        encoded_frames.clear()
        monkeypatch.setenv("RANK", rank)
        assert encode(config, tmp_path / "out").is_finished == is_last
        assert sum(encoded_frames) == 12 * episodes
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_full_disk_raises_and_leaves_no_partial_file(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, out, original_writer = make_config(), tmp_path / "out", storage_files.atomic_writer

    @contextmanager
    def write_to_full_disk(path: Path) -> Iterator[object]:
        with original_writer(path) as file:
            yield file
            if len(latents_in(out)) >= 3:
                raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        patch.setattr("vjepa2_ac.storage.files.atomic_writer", write_to_full_disk)
        with pytest.raises(InputError, match=r"safetensors: cannot be written: No space left"):
            encode(config, out)
    assert len(latents_in(out)) == 3
    assert encode(config, out).is_finished


def test_unwritable_folder_or_folder_with_other_files_raises(make_config: MakeConfig, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").touch()
    for folder, message in ((tmp_path / "config.yaml" / "out", "cannot be written"), (tmp_path, r"config\.yaml")):
        with pytest.raises(InputError, match=message):
            encode(make_config(), folder)
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["config.yaml"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data__stride": "auto"}, "data.stride: auto"),
        ({"data__source": "latents"}, "already encoded"),
    ],
)
def test_config_that_cannot_be_encoded_raises_before_opening_the_data(
    make_config: MakeConfig, tmp_path: Path, changes: dict, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        encode(make_config(data__path=str(tmp_path / "nowhere"), **changes), tmp_path / "out")


def test_next_encoding_writes_only_damaged_deleted_and_new_files(
    make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]
) -> None:
    out = tmp_path / "out"
    seven_episodes = make_config(data__exclude=[open_dataset(make_config().data).table.identity(0)])
    assert encode(seven_episodes, out).encoded == 7
    encoded_frames.clear()
    assert encode(make_config(), out).encoded == 8
    assert sum(encoded_frames) == 24
    expected, (truncated, deleted, zeroed, replaced, *_) = contents(out), latents_in(out)
    other_cache = write_cache(open_dataset(make_config(data__cache_dir=str(tmp_path / "others")).data), NUMBERS)
    truncated.write_bytes(truncated.read_bytes()[:-10])
    deleted.unlink()
    zeroed.write_bytes(bytes(zeroed.stat().st_size))
    shutil.copy(other_cache / replaced.relative_to(out), replaced)
    encoded_frames.clear()
    encode(make_config(), out)
    assert sum(encoded_frames) == 4 * 24
    assert contents(out) == expected


# ---- broken episodes ---------------------------------------------------------------------------------------------


@pytest.fixture
def repair_source(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Make the frames of episode 3 unreadable, and return a function that repairs them."""
    from vjepa2_ac.data.sources.rlds import RldsSource

    original_read, is_broken = RldsSource.read, True

    def read(source: RldsSource, index: int, *arguments: object) -> object:
        episode = original_read(source, index, *arguments)
        if index != 3 or not is_broken:
            return episode

        def raise_error(steps: list[int]) -> np.ndarray:
            raise InputError(where=episode.info.id, found=f"a damaged JPEG at step {steps[0]}")

        return type(episode)(**{**vars(episode), "read_frames": raise_error})

    monkeypatch.setattr(RldsSource, "read", read)

    def repair() -> None:
        nonlocal is_broken
        is_broken = False

    return repair


def test_broken_episode_stops_the_encoding_or_is_skipped_and_retried(
    make_config: MakeConfig, tmp_path: Path, repair_source: Callable[[], None]
) -> None:
    skip, out = make_config(data__broken_episodes="skip"), tmp_path / "out"
    with pytest.raises(InputError, match=r"damaged JPEG.*data\.exclude"):
        encode(make_config(), out)
    result = encode(skip, out)
    ((name, reason),) = result.broken.items()
    assert name == open_dataset(skip.data).table.identity(3)
    assert "damaged JPEG" in reason
    assert (result.encoded, result.is_finished) == (7, True)
    repair_source()
    assert encode(skip, out).broken == {}


@pytest.mark.usefixtures("repair_source")
def test_too_many_broken_episodes_over_all_processes_raise(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, config = tmp_path / "out", make_config(data__broken_episodes="skip")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "0")
    encode(config, out)  # episodes 0, 2, 4 and 6
    for file in latents_in(out)[:3]:
        file.rename(file.with_suffix(".broken"))
    monkeypatch.setenv("RANK", "1")
    with pytest.raises(InputError, match="4 of 8 episodes are broken"):
        encode(config, out)


# ---- a run that encodes first ------------------------------------------------------------------------------------


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def test_run_with_cached_latents_equals_run_on_frames_bit_for_bit(
    make_config: MakeConfig, tmp_path: Path, whole_run: Path, cache: Path, encoded_frames: list[int]
) -> None:
    reporter = SilentReporter()
    cached = {"data__cache": "auto", "data__cache_dtype": "fp32", "data__cache_dir": str(cache)}
    config = make_config(run_dir=str(tmp_path / "latents"), **cached)
    latents = train(config, reporter)
    assert sum(encoded_frames) == count_needed_frames(config), "training encodes no frame"
    assert_same_run(whole_run, latents)
    encoded_frames.clear()
    assert_same_run(whole_run, train(make_config(run_dir=str(tmp_path / "again"), **cached), reporter))
    assert not encoded_frames
    assert any("Reading latents from" in note for note in reporter.notes)


def test_two_processes_share_the_encoding_before_the_first_step(
    make_config: MakeConfig, tmp_path: Path, cache: Path
) -> None:
    config = make_config(data__cache="auto", data__cache_dir=str(cache), training__steps=1, training__accumulation=1)
    (tmp_path / "config.yaml").write_text(as_yaml(config))
    command, port = ["-m", "vjepa2_ac.cli", "train", str(tmp_path / "config.yaml")], free_port()
    (first_output, _), (second_output, _) = finish([start_rank(command, rank, 2, port) for rank in range(2)])
    (folder,) = cache.iterdir()
    assert len(latents_in(folder)) == 8
    assert "encoding frames 96/96" in first_output
    assert "Reading latents from" in first_output
    assert not second_output
