"""Encoding: done once, also after interruptions; a run on cached latents equals the run on frames."""

import errno
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from killable import KILLED, Nursery
from ranks import finish, free_port, start_rank
from run_fixtures import MakeConfig, SilentReporter, as_yaml, set_up
from same_run import assert_same_run
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.data.sources.latents.manifest import is_whole, read_manifest
from vjepa2_ac.encoding import disk_space
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.encoding.cache_lookup import needed_frames
from vjepa2_ac.encoding.encode_dataset import encode_config
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.storage import files as writing
from vjepa2_ac.training.loop import train

CAMERA = "exterior_1_left"


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def contents(folder: Path) -> dict[str, object]:
    """Return everything in a cache; the order in the header of a file with latents is no matter."""
    return {
        name: opened(folder / name) if name.endswith(".safetensors") else data
        for name, data in files_of(folder).items()
    }


def opened(path: Path) -> object:
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name).flatten().view(torch.uint8).tolist() for name in file.keys()}  # noqa: SIM118
        return tensors, file.metadata()


def encode(config: Config, out: Path, progress: Progress | None = None) -> list[str]:
    reporter = SilentReporter()
    if progress is not None:
        reporter.task = lambda *_: progress
    encode_config(config, reporter, out=out)
    return reporter.notes


def needed(config: Config) -> int:
    dataset = open_dataset(config.data)
    return sum(len(one.steps) for one in needed_frames(dataset)) * len(config.data.cameras)


def chunks(frames: int, config: Config) -> int:
    return -(-frames // config.model.encode_chunk)


def test_every_needed_frame_is_encoded_once_in_whole_chunks(
    make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]
) -> None:
    config = make_config(model__encode_chunk=7, data__start_every=2)
    reported: list[tuple[int, int]] = []
    notes = encode(config, tmp_path / "out", lambda *of: reported.append(of))
    frames = needed(config)
    assert frames == 8 * 12  # of 24 steps every second one
    assert encoded_frames == [7] * chunks(frames, config)
    assert (0, frames) in reported
    assert reported[-1] == (frames, frames)
    assert read_manifest(tmp_path / "out").frames == frames
    assert "GB per hour of robot data" in notes[0]
    assert "GB free on its disk" in notes[1]
    encoded_frames.clear()
    assert encode(config, tmp_path / "out") == [f"Everything is encoded already, in {tmp_path / 'out'}"]
    assert not encoded_frames


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_what_is_encoded_is_what_a_run_would_encode_bit_for_bit(
    make_config: MakeConfig, tmp_path: Path, precision: str
) -> None:
    config = make_config(data__cache_dtype="fp32", training__precision=precision, model__encode_chunk=5)
    encode(config, tmp_path / "out")
    model, dataset = load_base(config.model, seed=config.seed), open_dataset(config.data)
    batch = next(validation_batches(dataset, "validation", clips=5, batch_size=5))
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
        live = encode_batch(model, batch, device=torch.device("cpu"), chunk=5).latents
    for clip, (name, start) in enumerate(zip(batch.episode_ids, batch.starts, strict=True)):
        number = dataset.table.find(name)
        with safe_open(tmp_path / f"out/episodes/000/{number:06d}-{CAMERA}.safetensors", framework="pt") as file:
            places = [file.get_tensor("frame_steps").tolist().index(step) for step in range(start, start + 8, 2)]
            assert torch.equal(file.get_tensor("latents")[places], live[clip])


def test_of_several_cameras_each_is_encoded(make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]) -> None:
    config = make_config(data__camera=["wrist_left", CAMERA], data__start_every=2)
    encode(config, tmp_path / "out")
    assert sum(encoded_frames) == 2 * 8 * 12
    names = [path.name for path in (tmp_path / "out" / "episodes" / "000").iterdir()]
    assert sorted(names) == sorted(f"{n:06d}-{camera}.safetensors" for n in range(8) for camera in config.data.cameras)


# ---- whatever happens --------------------------------------------------------------------------------------------


def test_a_kill_costs_one_episode_at_most(
    nursery: Nursery, make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]
) -> None:
    config = make_config(data__start_every=2)
    (tmp_path / "config.yaml").write_text(as_yaml(config))
    encode(config, tmp_path / "whole")
    expected, per_episode, out = contents(tmp_path / "whole"), 12, tmp_path / "out"
    before = 0
    for die_at in (9, 17):
        child = nursery.start(
            "encode",
            str(tmp_path / "config.yaml"),
            "--out",
            str(out),
            folder=str(out),
            die_at=die_at,  # type: ignore[arg-type]
        )
        assert child.wait() == KILLED
        assert not is_whole(out)
        done = [path for path in out.rglob("*.safetensors") if not path.name.startswith(".")]
        assert all(opened(path) == expected[str(path.relative_to(out))] for path in done)
        assert len(done) >= before
        before = len(done)
    assert 0 < before < 8
    encoded_frames.clear()
    notes = encode(config, out)
    assert sum(encoded_frames) == -(-(8 - before) * per_episode // 16) * 16  # whole chunks
    assert f"{before * per_episode:,} frames are there already; {(8 - before) * per_episode:,} are left" in notes[2]
    assert contents(out) == expected


def test_two_processes_share_the_episodes_and_the_last_one_makes_the_cache_whole(
    make_config: MakeConfig, tmp_path: Path
) -> None:
    config = make_config()
    (tmp_path / "config.yaml").write_text(as_yaml(config))
    words = ["-m", "vjepa2_ac.cli", "encode", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "out")]
    reported = finish([start_rank(words, rank, 2, free_port()) for rank in range(2)])
    assert sum("This process has done its share" in out for out, _ in reported) <= 1
    assert is_whole(tmp_path / "out"), reported
    encode(config, tmp_path / "whole")
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_process_does_its_own_share_only(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoded_frames: list[int]
) -> None:
    config = make_config(data__start_every=2)
    monkeypatch.setenv("WORLD_SIZE", "3")
    shares = []
    for rank in ("2", "0", "1"):
        monkeypatch.setenv("RANK", rank)
        assert not is_whole(tmp_path / "out")
        encode(config, tmp_path / "out")
        shares.append(sum(encoded_frames) // 16 * 16)
    assert is_whole(tmp_path / "out")
    assert [len(list((tmp_path / "out").rglob("*.safetensors")))] == [8]
    assert shares[-1] == 32 + 48 + 48  # of 2, 3 and 3 episodes of 12 frames


def test_ctrl_c_keeps_what_is_done(make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]) -> None:
    config = make_config(data__start_every=2)

    def pressed(done: int, _total: int) -> None:
        if done >= 24:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        encode(config, tmp_path / "out", pressed)
    done = len(list((tmp_path / "out").rglob("*.safetensors")))
    assert done >= 2
    assert not list((tmp_path / "out").rglob("*.partial"))
    encoded_frames.clear()
    encode(config, tmp_path / "out")
    assert sum(encoded_frames) == -(-(8 - done) * 12 // 16) * 16
    assert is_whole(tmp_path / "out")


def test_a_disk_that_fills_up_is_named_and_nothing_half_written_counts(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, out = make_config(), tmp_path / "out"
    whole = writing.atomic_writer

    @contextmanager
    def full(path: Path) -> Iterator[object]:
        with whole(path) as file:
            yield file
            if len(list(out.rglob("*.safetensors"))) >= 3:
                raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        patch.setattr("vjepa2_ac.storage.atomic_writer", full)
        with pytest.raises(InputError, match=r"safetensors: cannot be written: No space left"):
            encode(config, out)
    assert not is_whole(out)
    assert len(list(out.rglob("*.safetensors"))) == 3
    encode(config, out)
    assert is_whole(out)


def test_a_disk_that_is_too_small_is_refused_with_the_numbers_before_anything_is_encoded(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoded_frames: list[int]
) -> None:
    monkeypatch.setattr(disk_space, "free_bytes", lambda _: 100_000)
    with pytest.raises(InputError) as error:
        encode(make_config(), tmp_path / "out")
    text = str(error.value)
    assert "0.0001 GB free" in text
    assert "GB for the latents of 192 frames" in text
    for way_out in ("data.cache_dtype: int8", "data.start_every: 2", "fewer episodes", "data.cache_dir"):
        assert way_out in text
    assert not encoded_frames
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError) as error:
        encode(make_config(data__cache_dtype="int8", data__start_every=2), tmp_path / "out")
    assert "data.start_every" not in str(error.value)
    assert "cache_dtype" not in str(error.value)


def test_room_is_asked_for_on_the_disk_of_a_folder_that_is_not_there_yet(tmp_path: Path) -> None:
    free = shutil.disk_usage(tmp_path).free
    assert disk_space.free_bytes(tmp_path / "a" / "b") == pytest.approx(free, rel=0.1)


def test_a_folder_that_cannot_be_written_is_refused(make_config: MakeConfig, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        encode(make_config(), tmp_path / "file" / "out")


def test_a_folder_of_other_files_is_refused_and_not_changed(make_config: MakeConfig, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").touch()
    with pytest.raises(InputError, match=r"other things in it, such as config\.yaml"):
        encode(make_config(), tmp_path)
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["config.yaml"]


def test_a_folder_of_another_cache_is_refused_and_what_differs_is_named(
    make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]
) -> None:
    encode(make_config(), tmp_path / "out")
    before, frames = files_of(tmp_path / "out"), len(encoded_frames)
    for unfinished in (False, True):
        if unfinished:
            (tmp_path / "out" / "cache.json").unlink()
            before.pop("cache.json")
        with pytest.raises(InputError, match=r"data\.crop: released, not square"):
            encode(make_config(data__crop="square"), tmp_path / "out")
        assert files_of(tmp_path / "out") == before
    assert len(encoded_frames) == frames


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"data__stride": "auto"}, "data.stride: auto"),
        ({"data__augment": {"brightness": 0.1}}, "data.augment"),
        ({"data__source": "latents"}, "encoded already"),
    ],
)
def test_what_cannot_be_encoded_is_refused_before_the_data_is_opened(
    make_config: MakeConfig, tmp_path: Path, changes: dict, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        encode(make_config(data__path=str(tmp_path / "nowhere"), **changes), tmp_path / "out")


# ---- broken episodes ---------------------------------------------------------------------------------------------


@pytest.fixture
def mend(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Episode 3 has a frame that cannot be decoded; a call repairs it."""
    from vjepa2_ac.data import selection as broken_episodes
    from vjepa2_ac.data.sources.rlds.source import RldsSource

    read, is_broken = RldsSource.read, True

    def reading(source: RldsSource, index: int, *more: object) -> object:
        episode = read(source, index, *more)
        if index != 3 or not is_broken:
            return episode

        def frames(steps: list[int]) -> np.ndarray:
            raise InputError(where=episode.info.id, found=f"a damaged JPEG at step {steps[0]}")

        return type(episode)(**{**vars(episode), "read_frames": frames})

    monkeypatch.setattr(RldsSource, "read", reading)
    monkeypatch.setattr(broken_episodes, "MOST_BROKEN", 0.2)

    def mended() -> None:
        nonlocal is_broken
        is_broken = False

    return mended


@pytest.mark.usefixtures("mend")
def test_a_broken_episode_is_left_out_and_named_or_stops_the_work_as_the_policy_says(
    make_config: MakeConfig, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"damaged JPEG.*data\.exclude"):
        encode(make_config(), out)
    assert not is_whole(out)
    encode(make_config(data__broken_episodes="skip"), out)
    manifest = read_manifest(out)
    (name,) = manifest.broken
    assert name == open_dataset(make_config().data).table.identity(3)
    assert "damaged JPEG" in manifest.broken[name]
    assert manifest.encoded == 7


def test_an_episode_that_was_mended_is_encoded_by_the_next_start(
    make_config: MakeConfig, tmp_path: Path, mend: Callable[[], None], encoded_frames: list[int]
) -> None:
    config, out = make_config(data__broken_episodes="skip"), tmp_path / "out"
    encode(config, out)
    (out / "cache.json").unlink()  # as if another process had not been done
    mend()
    encoded_frames.clear()
    encode(config, out)
    assert sum(encoded_frames) == 32  # its 24
    assert not read_manifest(out).broken


def test_the_fix_for_a_damaged_file_repairs_the_cache(
    make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]
) -> None:
    out = tmp_path / "out"
    encode(make_config(), out)
    sound, damaged = contents(out), sorted(out.rglob("*.safetensors"))[0]
    alone = make_config(data__source="latents", data__path=str(out)).data
    with damaged.open("r+b") as file:
        file.truncate(100)
    with pytest.raises(InputError, match=r"Run `vjepa2-ac encode` again, as the cache was made"):
        open_dataset(alone)
    encoded_frames.clear()
    reported = encode(make_config(), out)
    assert re.search(rf"episode.*{damaged.name}: 100 bytes instead of [\d,]+\)\. It is encoded again", reported[0])
    assert contents(out) == sound
    assert 0 < len(encoded_frames) < chunks(needed(make_config()), make_config())
    damaged.write_bytes(bytes(damaged.stat().st_size))
    with pytest.raises(InputError, match=r"000000.*Delete this file, and then run `vjepa2-ac encode` again"):
        open_dataset(alone).source.read(0)
    damaged.unlink()
    encode(make_config(), out)
    assert contents(out) == sound
    open_dataset(alone)


def test_episodes_that_take_part_from_now_on_are_added_to_a_cache(
    make_config: MakeConfig, tmp_path: Path, encoded_frames: list[int]
) -> None:
    out = tmp_path / "out"
    few = make_config(data__exclude=[open_dataset(make_config().data).table.identity(0)])
    encode(few, out)
    assert read_manifest(out).encoded == 7
    encoded_frames.clear()
    assert "not encoded yet" in encode(make_config(), out)[0]
    assert read_manifest(out).encoded == 8
    assert 0 < sum(encoded_frames) < needed(make_config()) / 4
    sorted(out.rglob("*.safetensors"))[0].unlink()
    encode(few, out)
    assert read_manifest(out).encoded == 7, "one that takes no part is not encoded again"


@pytest.mark.usefixtures("mend")
def test_too_many_broken_episodes_of_all_processes_together_stop_the_last_one(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vjepa2_ac.encoding.workload import note_broken

    out, config = tmp_path / "out", make_config(data__broken_episodes="skip")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "0")
    encode(config, out)  # 0, 2, 4, 6
    table = open_dataset(config.data).table
    note_broken(out, 2, table.identity(2), "damaged")
    monkeypatch.setenv("RANK", "1")
    with pytest.raises(InputError, match="2 of 8 episodes are broken"):
        encode(config, out)
    assert not is_whole(out)


# ---- a run that encodes first ------------------------------------------------------------------------------------


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def test_a_run_that_encodes_first_is_the_run_on_frames_bit_for_bit(
    make_config: MakeConfig, tmp_path: Path, whole_run: Path, cache: Path, encoded_frames: list[int]
) -> None:
    reporter = SilentReporter()
    cached = {"data__cache": "auto", "data__cache_dtype": "fp32", "data__cache_dir": str(cache)}
    config = make_config(run_dir=str(tmp_path / "latents"), **cached)
    latents = train(config, reporter)
    assert sum(encoded_frames) == needed(config)  # and not one in training
    assert_same_run(whole_run, latents)
    encoded_frames.clear()
    assert_same_run(whole_run, train(make_config(run_dir=str(tmp_path / "again"), **cached), reporter))
    assert not encoded_frames
    assert any("Latents come from" in note for note in reporter.notes)


def test_a_run_mends_the_cache_that_it_finds_damaged(
    make_config: MakeConfig, tmp_path: Path, cache: Path, reporter: SilentReporter, encoded_frames: list[int]
) -> None:
    knobs = {"data__cache": "auto", "data__cache_dir": str(cache), "training__steps": 1}
    first = train(make_config(run_dir=str(tmp_path / "first"), **knobs), reporter)
    (folder,) = cache.iterdir()
    sound, (cut, gone, *_) = contents(folder), sorted(folder.rglob("*.safetensors"))
    cut.write_bytes(cut.read_bytes()[:-10])
    gone.unlink()
    with pytest.raises(InputError, match=r"000000.*bytes.*Run `vjepa2-ac encode`"):
        train(make_config(run_dir=str(tmp_path / "x"), **knobs | {"data__cache": "require"}), reporter)
    reporter.notes.clear()
    encoded_frames.clear()
    again = make_config(run_dir=str(tmp_path / "again"), **knobs)
    train(again, reporter, check_only=True)
    (reported,) = [note for note in reporter.notes if "Missing in the latent cache" in note]
    assert re.search(
        rf"damaged: .*{cut.name}: .* bytes instead of .* and 1 more\. A run would encode it again", reported
    )
    assert not gone.exists(), "a check writes nothing"
    assert is_whole(folder)
    assert_same_run(first, train(again, reporter))
    assert "It is encoded again." in "".join(reporter.notes)
    assert contents(folder) == sound
    encoded_frames.clear()
    train(make_config(run_dir=str(tmp_path / "third"), **knobs), reporter)
    assert not encoded_frames


def test_a_kill_while_a_cache_is_mended_leaves_what_is_found_again(
    make_config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    encode(make_config(), out)
    sound, (cut, *_) = contents(out), sorted(out.rglob("*.safetensors"))
    cut.write_bytes(cut.read_bytes()[:-10])
    unlink, unlinked = Path.unlink, []

    def killed(path: Path, missing_ok: bool = False) -> None:
        if unlinked:
            raise KeyboardInterrupt
        unlinked.append(path.name)
        unlink(path, missing_ok)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", killed)
        with pytest.raises(KeyboardInterrupt):
            encode(make_config(), out)
    assert unlinked == [cut.name], "what makes it whole goes last"
    encode(make_config(), out)
    assert contents(out) == sound


def test_a_run_on_latents_has_no_encoder_on_its_device_and_does_not_count_its_work(
    make_config: MakeConfig, cache: Path, reporter: SilentReporter
) -> None:
    run = set_up(make_config(data__cache="auto", data__cache_dir=str(cache)), reporter)
    assert not list(run.world_model.encoder.parameters())
    assert not run.encodes
    assert set_up(make_config(), reporter).encodes


def test_a_required_cache_that_is_not_there_is_refused_with_the_command_that_makes_it(
    make_config: MakeConfig, cache: Path, reporter: SilentReporter, encoded_frames: list[int]
) -> None:
    with pytest.raises(InputError, match="Run `vjepa2-ac encode`"):
        train(make_config(data__cache="require", data__cache_dir=str(cache)), reporter)
    assert not encoded_frames


def test_check_says_what_would_be_encoded_and_tries_the_rest_on_frames(
    make_config: MakeConfig, cache: Path, reporter: SilentReporter, encoded_frames: list[int]
) -> None:
    config = make_config(data__cache="auto", data__cache_dir=str(cache))
    train(config, reporter, check_only=True)
    assert not cache.exists()
    (reported,) = [note for note in reporter.notes if "would first encode" in note]
    assert f"{needed(config)} of {needed(config)} frames" in reported
    assert "frames/s" in reported
    assert "Everything is in place" in reporter.notes[-1]
    assert 16 < sum(encoded_frames) < needed(config)  # a timed chunk, and the clips that were tried


def test_latents_of_another_encoder_are_never_used(
    make_config: MakeConfig, tmp_path: Path, base_folder: Path, cache: Path, reporter: SilentReporter
) -> None:
    from vjepa2_ac.model.base_model import read_sizes

    encode_config(make_config(data__cache_dir=str(cache)), reporter)
    other = tmp_path / "other"
    WorldModel.random(read_sizes(base_folder), seed=9).save_pretrained(other)
    knobs = {"data__cache_dir": str(cache), "model__base": str(other)}
    with pytest.raises(InputError, match=r"was made otherwise: encoder: "):
        train(make_config(data__cache="require", **knobs), reporter)
    (folder,) = cache.iterdir()
    set_up(make_config(data__source="latents", data__path=str(folder)), reporter)
    with pytest.raises(InputError, match="encoder"):
        set_up(make_config(data__source="latents", data__path=str(folder), model__base=str(other)), reporter)


def test_two_processes_of_a_run_share_the_encoding_before_the_first_step(
    make_config: MakeConfig, tmp_path: Path, cache: Path
) -> None:
    config = make_config(data__cache="auto", data__cache_dir=str(cache), training__steps=1, training__accumulation=1)
    (tmp_path / "config.yaml").write_text(as_yaml(config))
    words, port = ["-m", "vjepa2_ac.cli", "train", str(tmp_path / "config.yaml")], free_port()
    reported = finish([start_rank(words, rank, 2, port) for rank in range(2)])
    (folder,) = cache.iterdir()
    assert read_manifest(folder).frames == needed(config)
    assert "encoding frames 96/96" in reported[0][0]
    assert "Latents come from" in reported[0][0]
    assert not reported[1][0]


def test_no_latents_are_encoded_of_data_that_a_run_refuses(
    make_config: MakeConfig, tmp_path: Path, data_folder: Path, cache: Path, encoded_frames: list[int]
) -> None:
    changes = {"training__steps": 2, "data__cache": "auto", "data__cache_dir": str(cache)}
    train(make_config(**changes), SilentReporter())
    before = files_of(cache)
    encoded_frames.clear()
    shutil.copytree(data_folder, tmp_path / "others")
    next((tmp_path / "others").rglob("*.tfrecord*")).touch()
    others = make_config(**changes, data__path=str(tmp_path / "others"))
    with pytest.raises(InputError, match="other episodes or files than the run has seen"):
        train(others, SilentReporter())
    assert (files_of(cache), encoded_frames) == (before, [])
    train(others, SilentReporter(), allow_config_change=True)
    assert encoded_frames, "the change is meant"
