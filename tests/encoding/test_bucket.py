"""A latent cache in a bucket: written whole, found by one listing, read in ranges, over networks that fail."""

import os
import time
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path

import fsspec
import pytest
import torch

from gcs import Failure, Gcs
from killable import KILLED, Nursery
from latent_sets import NUMBERS
from run_fixtures import MakeConfig, SilentReporter, as_yaml, set_up
from same_run import assert_same_run
from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.data.sources.latents import cache_key
from vjepa2_ac.encoding.encode_dataset import encode_config, with_latents_if_there
from vjepa2_ac.encoding.latent_cache import LatentCache
from vjepa2_ac.errors import InputError, RefusedError, UnreachableError
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.training.loop import train

URL = "gs://bucket/caches"
EPISODES, CLIPS = 8, 12
SMALL = 2600  # bytes: header and numbers of an episode
LATENTS = r"GET /download/.*safetensors"
ALWAYS = 10_000  # times
UPLOAD = r"POST /upload/.*safetensors"


@pytest.fixture(autouse=True)
def _small_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    """These episodes are so small that the head of a file would be most of it."""
    monkeypatch.setattr("vjepa2_ac.data.sources.latents.tensor_file._HEAD_BYTES", 512)


@pytest.fixture
def bucket(gcs: Gcs) -> Gcs:
    """A bucket that has another file."""
    gcs.put("bucket/other", b"another's")
    gcs.forget()
    return gcs


@pytest.fixture
def far(make_config: MakeConfig, tmp_path: Path) -> Callable[..., Config]:
    """Return a config whose cache is in the bucket, on a machine of this name."""

    def make(machine: str = "one", **changes: object) -> Config:
        disk = {"dir": str(tmp_path / machine), "limit_gb": 1.0}
        knobs = {"data__cache_dir": URL, "data__disk_cache": disk, "data__cache": "require"}
        return make_config(**knobs | changes)

    return make


def batches(dataset: Dataset) -> list[torch.Tensor]:
    """Return the latents of the first clips; the loader works in this process."""
    loader = training_loader(dataset, seed=3, batch_size=2)
    return [part for batch in islice(loader, 6) for part in (batch.latents.values, batch.latents.scales, batch.states)
            if part is not None]  # fmt: skip


def opened(config: Config) -> Dataset:
    found = with_latents_if_there(config, open_dataset(config.data), load_base(config.model, seed=config.seed))
    assert found.config.is_cache
    return found


def alone(config: Config, folder: Path | str, **changes: object) -> Dataset:
    """Return the data of a finished cache without its data set."""
    return open_dataset(config.data.as_kind("latents", path=str(folder), cache="off", **changes))


def latents_in(bucket: Gcs) -> list[str]:
    return [name for name in bucket.names("bucket") if name.endswith(".safetensors")]


def equal(one: list[torch.Tensor], other: list[torch.Tensor]) -> bool:
    return len(one) == len(other) > 0 and all(map(torch.equal, one, other))


# ---- written, found and read -------------------------------------------------------------------------------------


def test_another_machine_goes_on_with_what_is_there_and_then_finds_it_finished(
    bucket: Gcs, far: Callable[..., Config], encoded_frames: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    found = encode_config(far("one"))
    assert (found.encoded, found.is_finished) == (EPISODES // 2, False)
    encoded_frames.clear()
    monkeypatch.delenv("WORLD_SIZE")
    found = encode_config(far("two"))
    assert sum(encoded_frames) == EPISODES // 2 * 24
    encoded_frames.clear()
    bucket.forget()
    assert encode_config(far("three")) == found
    assert (found.encoded, found.is_finished, found.folder) == (EPISODES, True, f"{URL}/{found.folder[-32:]}")
    assert not encoded_frames
    assert not bucket.uploads()
    sizes = [size for name, size in storage.file_sizes(found.folder).items() if name.endswith(".safetensors")]
    assert (len(sizes), sum(sizes)) == (EPISODES, found.bytes)


@pytest.mark.parametrize(("kind", "mode"), [("fp32", "auto"), ("bf16", "require"), ("int8", "auto")])
@pytest.mark.usefixtures("bucket")
def test_a_run_on_latents_in_a_bucket_is_the_run_on_those_of_a_folder_bit_for_bit(
    far: Callable[..., Config], tmp_path: Path, kind: str, mode: str, encoded_frames: list[int]
) -> None:
    runs = []
    for name, place in (("here", str(tmp_path / "caches")), ("there", URL)):
        knobs = {"data__cache_dtype": kind, "data__cache": mode, "data__cache_dir": place, "training__steps": 3}
        config = far(name, run_dir=str(tmp_path / f"run {name}"), **knobs)
        if mode == "require":
            encode_config(config)
        runs.append(train(config, SilentReporter()))
    assert_same_run(*runs)
    assert sum(encoded_frames) == 2 * EPISODES * 24


def test_a_cache_is_opened_by_one_listing_and_read_in_ranges_once(bucket: Gcs, far: Callable[..., Config]) -> None:
    knobs = {"data__start_every": 2, "data__frames": 8}
    folder = encode_config(far(**knobs)).folder
    far = partial(far, **knobs)
    expected = batches(opened(far("two")))
    bucket.forget()
    dataset = alone(far("three"), folder)
    asked = [request.target for request in bucket.requests]
    assert len([one for one in asked if one.startswith("GET /storage/v1/b/bucket/o?")]) == 1
    assert not [one for one in asked if ".safetensors" in one], "nothing of any episode"
    assert equal(batches(dataset), expected)
    clip = expected[0][0].nbytes
    assert bucket.bytes_read(".safetensors") <= CLIPS * clip + EPISODES * SMALL
    assert clip in [one.sent for one in bucket.reads(".safetensors")], "neighbouring frames come together"
    bucket.forget()
    assert equal(batches(alone(far("three"), folder)), expected)
    assert not bucket.reads(".safetensors"), "all from this machine's disk"


@pytest.mark.parametrize("protocol", ["memory", "file"])
def test_any_place_of_fsspec_will_do(far: Callable[..., Config], tmp_path: Path, protocol: str) -> None:
    if protocol == "memory":
        fsspec.filesystem("memory").rm("/", recursive=True) if fsspec.filesystem("memory").ls("/") else None
    config = far(data__cache_dir=f"{protocol}://{tmp_path}/there")
    found = encode_config(config)
    assert isinstance(found.folder, Path) == (protocol == "file")
    here = encode_config(far(data__cache_dir=str(tmp_path / "here"))).folder
    url = f"{protocol}://{tmp_path}/there/{str(found.folder)[-32:]}"
    assert equal(batches(alone(config, url)), batches(alone(config, here)))
    assert encode_config(config) == found


# ---- what can fail -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("failure", [503, 429, "reset", "cut", "short"])
def test_what_passes_is_tried_again_and_changes_nothing(
    bucket: Gcs, far: Callable[..., Config], failure: Failure
) -> None:
    upload_failure = 503 if failure in {"cut", "short"} else failure  # those are of answers with a body
    bucket.fail_next(upload_failure, times=2, match=UPLOAD)
    folder = encode_config(far()).folder
    assert not bucket.faults_left
    expected = batches(alone(far("two"), folder))
    bucket.fail_next(failure, times=2, match=LATENTS)
    assert equal(batches(alone(far("three"), folder)), expected)
    assert not bucket.faults_left


def test_a_failing_connection_is_no_broken_episode(bucket: Gcs, far: Callable[..., Config]) -> None:
    folder = encode_config(far()).folder
    dataset = alone(far("two"), folder, broken_episodes="skip")
    bucket.fail_next(503, times=ALWAYS, match=LATENTS)
    with pytest.raises(UnreachableError, match=r"5 attempts.*HTTP 503"):
        batches(dataset)
    assert not dataset.broken.reasons


@pytest.mark.parametrize(
    ("url", "status", "words"),
    [
        ("gs://nowhere/caches", None, "there is no bucket nowhere"),
        (URL, 403, r"no permission.*gcloud auth application-default login"),
    ],
)
def test_a_place_that_cannot_be_written_is_one_error_before_a_frame_is_encoded(
    bucket: Gcs, far: Callable[..., Config], url: str, status: int | None, words: str, encoded_frames: list[int]
) -> None:
    if status:
        bucket.fail_next(status, times=ALWAYS, match="POST /upload/")
    for start in (encode_config, lambda config: set_up(config, SilentReporter())):
        with pytest.raises(RefusedError, match=words):
            start(far(data__cache_dir=url, data__cache="auto"))
    assert not encoded_frames
    assert bucket.names("bucket") == ["other"]


def test_who_may_not_write_encodes_nothing_of_what_another_began(
    bucket: Gcs, far: Callable[..., Config], encoded_frames: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setenv("WORLD_SIZE", "2")
        encode_config(far())
    encoded_frames.clear()
    bucket.fail_next(403, times=ALWAYS, match="POST /upload/")
    with pytest.raises(RefusedError, match="no permission"):
        encode_config(far("two"))
    assert not encoded_frames


def test_a_finished_cache_is_read_by_who_may_not_write(
    bucket: Gcs, far: Callable[..., Config], encoded_frames: list[int]
) -> None:
    encode_config(far())
    encoded_frames.clear()
    bucket.forget()
    bucket.fail_next(403, times=ALWAYS, match="POST|DELETE")
    set_up(far("two", data__cache="auto"), SilentReporter())
    assert encode_config(far("three")).is_finished
    assert not encoded_frames


@pytest.mark.parametrize("damage", [lambda data: data[:-10], lambda data: data[:20], lambda data: bytes(len(data))])
def test_a_damaged_file_is_named_and_encoded_again(
    bucket: Gcs, far: Callable[..., Config], damage: Callable[[bytes], bytes], encoded_frames: list[int]
) -> None:
    folder = encode_config(far()).folder
    expected = batches(alone(far(), folder))
    for name in storage.file_sizes(folder):
        if name.endswith(".safetensors"):
            place = storage.join(folder, name)
            bucket.put(place.removeprefix("gs://"), damage(storage.read_bytes(place)))
    with pytest.raises(InputError, match=r"gs://.*safetensors: not a whole file of latents.*vjepa2-ac encode"):
        batches(alone(far(), folder))
    encoded_frames.clear()
    encode_config(far())
    assert sum(encoded_frames) == EPISODES * 24
    assert equal(batches(alone(far(), folder)), expected)


def test_a_deleted_file_is_missed_when_the_cache_is_opened(bucket: Gcs, far: Callable[..., Config]) -> None:
    folder = encode_config(far()).folder
    name = next(name for name in storage.file_sizes(folder) if name.endswith(".safetensors"))
    storage.remove(storage.join(folder, name))
    bucket.forget()
    with pytest.raises(InputError, match="no latents of 1 of 8 episodes"):
        alone(far(), folder)


@pytest.mark.usefixtures("bucket")
def test_another_cache_beside_it_is_named_and_the_disk_is_no_matter(
    far: Callable[..., Config], monkeypatch: pytest.MonkeyPatch, reporter: SilentReporter
) -> None:
    def no_disk(_: Path) -> int:
        raise AssertionError("a bucket has no free space")

    monkeypatch.setattr("vjepa2_ac.encoding.latent_cache.free_bytes", no_disk)
    monkeypatch.setattr("vjepa2_ac.encoding.encode_dataset.free_bytes", no_disk)
    encode_config(far(), reporter)
    assert f"The latents go into {URL}/" in reporter.notes[1]
    assert "192 frames" in reporter.notes[0]
    assert " GB" in reporter.notes[0]
    with pytest.raises(InputError, match=r"Other caches there: 1; .*data\.crop: released, not square"):
        train(far(data__crop="square"), SilentReporter())


# ---- several processes, and their death --------------------------------------------------------------------------


def start(nursery: Nursery, config: Config, folder: Path, name: str, **environment: str) -> object:
    """Start `vjepa2-ac encode` in a process of its own."""
    path = folder / f"{name}.yaml"
    path.write_text(as_yaml(config))
    words = ("-m", "vjepa2_ac.cli", "encode", str(path))
    files = [str(folder / f"{name}.{stream}") for stream in ("out", "err")]
    for file in files:
        Path(file).touch()
    return nursery.start_script(*words, environment=dict(os.environ) | environment, out=files[0], err=files[1])


def test_a_killed_upload_leaves_nothing_that_looks_finished(
    bucket: Gcs, far: Callable[..., Config], nursery: Nursery, tmp_path: Path, encoded_frames: list[int]
) -> None:
    expected = batches(alone(far(), encode_config(far(data__cache_dir=str(tmp_path / "whole"))).folder))
    encoded_frames.clear()
    bucket.fail_next("hang", times=ALWAYS, match=r"POST /upload/.*00000[3-7]-")
    child = start(nursery, far("two"), tmp_path, "killed")
    while bucket.faults_left == ALWAYS or len(latents_in(bucket)) < 3:  # the fourth upload is under way
        assert child.is_running()
        time.sleep(0.01)
    assert child.kill() == KILLED
    bucket.forget()
    folder = f"gs://bucket/{os.path.commonpath([name for name in bucket.names('bucket') if 'caches/' in name])}"
    with pytest.raises(InputError, match="no latents of 5 of 8 episodes"):
        alone(far("three"), folder)
    found = encode_config(far("three"))
    assert sum(encoded_frames) == 5 * 24
    assert equal(batches(alone(far("three"), found.folder)), expected)
    assert not [
        name for name in bucket.names("bucket") if not name.endswith((".safetensors", ".json", ".npz", "other"))
    ]


def test_another_encoder_may_begin_at_any_moment(
    bucket: Gcs, far: Callable[..., Config], monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = LatentCache.of(open_dataset(far().data), NUMBERS)

    def then_begins(read: Callable[..., object]) -> Callable[..., object]:
        def reading(*given: object, **more: object) -> object:
            try:
                return read(*given, **more)
            finally:
                monkeypatch.undo()
                monkeypatch.setenv("STORAGE_EMULATOR_HOST", bucket.url)
                LatentCache.of(open_dataset(far().data), NUMBERS).begin()

        return reading

    monkeypatch.setattr(storage, "list_names", then_begins(storage.list_names))
    monkeypatch.setattr(cache_key, "read_json_object", then_begins(cache_key.read_json_object))
    cache.begin()
    assert cache.is_begun


def test_two_encoders_at_once_do_not_disturb_each_other(
    bucket: Gcs, far: Callable[..., Config], nursery: Nursery, tmp_path: Path
) -> None:
    here = encode_config(far(data__cache_dir=str(tmp_path / "whole"))).folder
    children = [start(nursery, far(rank), tmp_path, rank, RANK=rank, WORLD_SIZE="2") for rank in ("0", "1")]
    assert [child.wait() for child in children] == [0, 0], [(tmp_path / f"{rank}.err").read_text() for rank in (0, 1)]
    folder = f"{URL}/{str(here)[-32:]}"
    assert equal(batches(alone(far("three"), folder)), batches(alone(far("three"), here)))
    assert len([one for one in bucket.uploads() if ".safetensors" in one.target]) == EPISODES
