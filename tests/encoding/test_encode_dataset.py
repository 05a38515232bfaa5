"""Encoding: each frame once, also after interruptions; a run on cached latents equals the run on frames."""

import errno
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from killable import KILLED, Nursery
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
from vjepa2_ac.storage import files as writing
from vjepa2_ac.training.loop import train


def encode(
    config: Config, out: Path, progress: Progress | None = None, reporter: SilentReporter | None = None
) -> EncodingResult:
    reporter = reporter or SilentReporter()
    if progress is not None:
        reporter.task = lambda *_: progress
    return encode_config(config, reporter, out=out)


def needed(config: Config) -> int:
    return sum(len(one.steps) for one in needed_frames(open_dataset(config.data)))


def test_each_needed_frame_is_encoded_once(
    make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int], reporter: SilentReporter
) -> None:
    config = make_config(data__start_every=2)
    reported: list[tuple[int, int]] = []
    found = encode(config, tmp_path / "out", lambda *of: reported.append(of), reporter)
    frames = needed(config)
    assert frames == 8 * 12  # every second of 24 steps
    assert sum(encoded_frames) == frames
    assert (0, frames) in reported
    assert reported[-1] == (frames, frames)
    assert (found.encoded, found.episodes, found.frames, found.is_finished) == (8, 8, frames, True)
    assert found.bytes == sum(path.stat().st_size for path in latents_in(tmp_path / "out"))
    assert "GB free)" in reporter.notes[1]
    encoded_frames.clear()
    assert encode(config, tmp_path / "out") == found
    assert not encoded_frames


# ---- interruptions -----------------------------------------------------------------------------------------------


def test_kill_loses_at_most_one_episode(
    nursery: Nursery, make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]
) -> None:
    config = make_config(data__start_every=2)
    (tmp_path / "config.yaml").write_text(as_yaml(config))
    encode(config, tmp_path / "whole")
    expected, out, before = contents(tmp_path / "whole"), tmp_path / "out", 0
    words = ("encode", str(tmp_path / "config.yaml"), "--out", str(out))
    for die_at in (2, 9, 13, 16):
        assert nursery.start(*words, folder=out, die_at=die_at).wait() == KILLED
        done = [path for path in latents_in(out) if not path.name.startswith(".")]
        assert all(opened(path) == expected[str(path.relative_to(out))] for path in done)
        assert before <= len(done) < 8
        before = len(done)
    assert before > 0
    encoded_frames.clear()
    assert encode(config, out).is_finished
    assert sum(encoded_frames) == (8 - before) * 12
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
    config, out, whole = make_config(), tmp_path / "out", writing.atomic_writer

    @contextmanager
    def full(path: Path) -> Iterator[object]:
        with whole(path) as file:
            yield file
            if len(latents_in(out)) >= 3:
                raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        patch.setattr("vjepa2_ac.storage.files.atomic_writer", full)
        with pytest.raises(InputError, match=r"safetensors: cannot be written: No space left"):
            encode(config, out)
    assert len(latents_in(out)) == 3
    assert encode(config, out).is_finished


def test_unwritable_or_foreign_cache_folder_raises(make_config: MakeConfig, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").touch()
    for folder, words in ((tmp_path / "config.yaml" / "out", "cannot be written"), (tmp_path, r"config\.yaml")):
        with pytest.raises(InputError, match=words):
            encode(make_config(), folder)
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["config.yaml"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"data__stride": "auto"}, "data.stride: auto"),
        ({"data__source": "latents"}, "already encoded"),
    ],
)
def test_config_that_cannot_be_encoded_raises_before_opening_the_data(
    make_config: MakeConfig, tmp_path: Path, changes: dict, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        encode(make_config(data__path=str(tmp_path / "nowhere"), **changes), tmp_path / "out")


def test_next_encoding_writes_only_damaged_deleted_and_new_files(
    make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]
) -> None:
    out = tmp_path / "out"
    few = make_config(data__exclude=[open_dataset(make_config().data).table.identity(0)])
    assert encode(few, out).encoded == 7
    encoded_frames.clear()
    assert encode(make_config(), out).encoded == 8
    assert sum(encoded_frames) == 24
    sound, (cut, gone, zeros, foreign, *_) = contents(out), latents_in(out)
    other = write_cache(open_dataset(make_config(data__cache_dir=str(tmp_path / "others")).data), NUMBERS)
    cut.write_bytes(cut.read_bytes()[:-10])
    gone.unlink()
    zeros.write_bytes(bytes(zeros.stat().st_size))
    shutil.copy(other / foreign.relative_to(out), foreign)
    encoded_frames.clear()
    encode(make_config(), out)
    assert sum(encoded_frames) == 4 * 24
    assert contents(out) == sound


# ---- broken episodes ---------------------------------------------------------------------------------------------


@pytest.fixture
def repair_source(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Episode 3 has a frame that cannot be decoded; a call repairs it."""
    from vjepa2_ac.data.sources.rlds import RldsSource

    read, is_broken = RldsSource.read, True

    def reading(source: RldsSource, index: int, *more: object) -> object:
        episode = read(source, index, *more)
        if index != 3 or not is_broken:
            return episode

        def frames(steps: list[int]) -> np.ndarray:
            raise InputError(where=episode.info.id, found=f"a damaged JPEG at step {steps[0]}")

        return type(episode)(**{**vars(episode), "read_frames": frames})

    monkeypatch.setattr(RldsSource, "read", reading)

    def mended() -> None:
        nonlocal is_broken
        is_broken = False

    return mended


def test_broken_episode_stops_the_encoding_or_is_skipped_and_retried(
    make_config: MakeConfig, tmp_path: Path, repair_source: Callable[[], None]
) -> None:
    skip, out = make_config(data__broken_episodes="skip"), tmp_path / "out"
    with pytest.raises(InputError, match=r"damaged JPEG.*data\.exclude"):
        encode(make_config(), out)
    found = encode(skip, out)
    ((name, reason),) = found.broken.items()
    assert name == open_dataset(skip.data).table.identity(3)
    assert "damaged JPEG" in reason
    assert (found.encoded, found.is_finished) == (7, True)
    repair_source()
    assert encode(skip, out).broken == {}


@pytest.mark.usefixtures("repair_source")
def test_too_many_broken_episodes_over_all_processes_raise(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, config = tmp_path / "out", make_config(data__broken_episodes="skip")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "0")
    encode(config, out)  # 0, 2, 4, 6
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
    assert sum(encoded_frames) == needed(config)  # and none in training
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
    words, port = ["-m", "vjepa2_ac.cli", "train", str(tmp_path / "config.yaml")], free_port()
    reported = finish([start_rank(words, rank, 2, port) for rank in range(2)])
    (folder,) = cache.iterdir()
    assert len(latents_in(folder)) == 8
    assert "encoding frames 96/96" in reported[0][0]
    assert "Reading latents from" in reported[0][0]
    assert not reported[1][0]
