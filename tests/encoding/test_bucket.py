"""A latent cache in a bucket: complete files only, one listing, range reads, and network failures."""

import os
import time
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path

import pytest
import torch

from gcs import Gcs
from killable import KILLED, ForkServer
from run_fixtures import MakeConfig, SilentReporter, as_yaml, set_up
from same_run import assert_same_run
from vjepa2_ac import storage
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.encoding.encode_dataset import encode_config, use_finished_cache
from vjepa2_ac.errors import InputError, RefusedError
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.training.loop import train

URL = "gs://bucket/caches"
EPISODES, CLIPS = 8, 12
HEADER_BYTES = 2600  # header, states and actions of an episode
ALWAYS = 10_000  # number of failures that a test does not reach


@pytest.fixture(autouse=True)
def _small_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read smaller file heads, because the files of these tests are small."""
    monkeypatch.setattr("vjepa2_ac.data.sources.latent_files._HEAD_BYTES", 512)


@pytest.fixture
def bucket(gcs: Gcs) -> Gcs:
    """A bucket that contains another file."""
    gcs.put("bucket/other", b"another file")
    gcs.forget()
    return gcs


@pytest.fixture
def bucket_config(make_config: MakeConfig, tmp_path: Path) -> Callable[..., Config]:
    """Return a function that makes a config for a machine: its own disk cache, and the latent cache in the bucket."""

    def make(machine: str = "one", **changes: object) -> Config:
        disk = {"dir": str(tmp_path / machine), "limit_gb": 1.0}
        options = {"data__cache_dir": URL, "data__disk_cache": disk, "data__cache": "require"}
        return make_config(**options | changes)

    return make


def batches(dataset: Dataset) -> list[torch.Tensor]:
    """Return the latents and states of the first clips, read in this process."""
    loader = training_loader(dataset, seed=3, batch_size=2)
    return [value for batch in islice(loader, 6) for value in (batch.latents.values, batch.latents.scales, batch.states)
            if value is not None]  # fmt: skip


def open_cached(config: Config) -> Dataset:
    dataset = use_finished_cache(config, open_dataset(config.data), load_base(config.model, seed=config.seed))
    assert dataset.config.is_cache
    return dataset


def open_cache_only(config: Config, folder: Path | str, **changes: object) -> Dataset:
    """Open a finished cache without the data set from which it was encoded."""
    return open_dataset(config.data.with_source("latents", path=str(folder), cache="off", **changes))


def latents_in(bucket: Gcs) -> list[str]:
    return [name for name in bucket.names("bucket") if name.endswith(".safetensors")]


def are_equal(actual: list[torch.Tensor], expected: list[torch.Tensor]) -> bool:
    return len(actual) == len(expected) > 0 and all(map(torch.equal, actual, expected))


# ---- writing and reading -----------------------------------------------------------------------------------------


def test_second_machine_completes_a_cache_in_a_bucket(
    bucket: Gcs, bucket_config: Callable[..., Config], encoded_frames: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    result = encode_config(bucket_config("one"))
    assert (result.encoded, result.is_finished) == (EPISODES // 2, False)
    encoded_frames.clear()
    monkeypatch.delenv("WORLD_SIZE")
    result = encode_config(bucket_config("two"))
    assert sum(encoded_frames) == EPISODES // 2 * 24
    encoded_frames.clear()
    bucket.forget()
    assert encode_config(bucket_config("three")) == result
    assert (result.encoded, result.is_finished, result.folder) == (EPISODES, True, f"{URL}/{result.folder[-32:]}")
    assert not encoded_frames
    assert not bucket.uploads()
    sizes = [size for name, size in storage.file_sizes(result.folder).items() if name.endswith(".safetensors")]
    assert (len(sizes), sum(sizes)) == (EPISODES, result.bytes)


@pytest.mark.usefixtures("bucket")
def test_run_on_a_bucket_cache_equals_run_on_a_local_cache_bit_for_bit(
    bucket_config: Callable[..., Config], tmp_path: Path, encoded_frames: list[int]
) -> None:
    runs = []
    for name, folder in (("local", str(tmp_path / "caches")), ("bucket", URL)):
        options = {"data__cache_dtype": "int8", "data__cache": "auto", "data__cache_dir": folder, "training__steps": 3}
        config = bucket_config(name, run_dir=str(tmp_path / f"run {name}"), **options)
        runs.append(train(config, SilentReporter()))
    assert_same_run(*runs)
    assert sum(encoded_frames) == 2 * EPISODES * 24


def test_bucket_cache_needs_one_listing_and_reads_each_range_once(
    bucket: Gcs, bucket_config: Callable[..., Config]
) -> None:
    options = {"data__start_every": 2, "data__frames": 8}
    folder = encode_config(bucket_config(**options)).folder
    bucket_config = partial(bucket_config, **options)
    expected = batches(open_cached(bucket_config("two")))
    bucket.forget()
    dataset = open_cache_only(bucket_config("three"), folder)
    targets = [request.target for request in bucket.requests]
    assert len([target for target in targets if target.startswith("GET /storage/v1/b/bucket/o?")]) == 1
    assert not [target for target in targets if ".safetensors" in target], "opening reads no episode"
    assert are_equal(batches(dataset), expected)
    clip_bytes = expected[0][0].nbytes
    assert bucket.bytes_read(".safetensors") <= CLIPS * clip_bytes + EPISODES * HEADER_BYTES
    assert clip_bytes in [read.sent for read in bucket.reads(".safetensors")], "neighbouring frames need one request"
    bucket.forget()
    assert are_equal(batches(open_cache_only(bucket_config("three"), folder)), expected)
    assert not bucket.reads(".safetensors"), "all latents are in the disk cache"


# ---- failures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "status", "message"),
    [
        ("gs://nowhere/caches", None, "bucket nowhere does not exist"),
        (URL, 403, r"no permission.*gcloud auth application-default login"),
    ],
)
def test_unwritable_cache_url_raises_before_encoding(
    bucket: Gcs,
    bucket_config: Callable[..., Config],
    url: str,
    status: int | None,
    message: str,
    encoded_frames: list[int],
) -> None:
    if status:
        bucket.fail_next(status, times=ALWAYS, match="POST /upload/")
    for encode in (encode_config, lambda config: set_up(config, SilentReporter())):
        with pytest.raises(RefusedError, match=message):
            encode(bucket_config(data__cache_dir=url, data__cache="auto"))
    assert not encoded_frames
    assert bucket.names("bucket") == ["other"]


def test_damaged_bucket_file_is_reported_and_encoded_again(
    bucket: Gcs, bucket_config: Callable[..., Config], encoded_frames: list[int]
) -> None:
    folder = encode_config(bucket_config()).folder
    expected = batches(open_cache_only(bucket_config(), folder))
    for name in storage.file_sizes(folder):
        if name.endswith(".safetensors"):
            url = storage.join(folder, name)
            bucket.put(url.removeprefix("gs://"), storage.read_bytes(url)[:-10])
    with pytest.raises(InputError, match=r"gs://.*safetensors: not a complete file of latents.*vjepa2-ac encode"):
        batches(open_cache_only(bucket_config(), folder))
    encoded_frames.clear()
    encode_config(bucket_config())
    assert sum(encoded_frames) == EPISODES * 24
    assert are_equal(batches(open_cache_only(bucket_config(), folder)), expected)


# ---- several and killed processes -------------------------------------------------------------------------------


def start_encoding(fork_server: ForkServer, config: Config, folder: Path) -> object:
    """Start `vjepa2-ac encode` in a separate process."""
    path, out, err = folder / "config.yaml", folder / "out.txt", folder / "err.txt"
    path.write_text(as_yaml(config))
    out.touch()
    err.touch()
    command = ("-m", "vjepa2_ac.cli", "encode", str(path))
    return fork_server.start_script(*command, environment=dict(os.environ), out=str(out), err=str(err))


def test_killed_upload_leaves_no_finished_file(
    bucket: Gcs,
    bucket_config: Callable[..., Config],
    fork_server: ForkServer,
    tmp_path: Path,
    encoded_frames: list[int],
) -> None:
    expected = batches(
        open_cache_only(bucket_config(), encode_config(bucket_config(data__cache_dir=str(tmp_path / "whole"))).folder)
    )
    encoded_frames.clear()
    bucket.fail_next("hang", times=ALWAYS, match=r"POST /upload/.*00000[3-7]-")
    child = start_encoding(fork_server, bucket_config("two"), tmp_path)
    while bucket.faults_left == ALWAYS or len(latents_in(bucket)) < 3:  # during the fourth upload
        assert child.is_running()
        time.sleep(0.01)
    assert child.kill() == KILLED
    bucket.forget()
    folder = f"gs://bucket/{os.path.commonpath([name for name in bucket.names('bucket') if 'caches/' in name])}"
    with pytest.raises(InputError, match="no latents of 5 of 8 episodes"):
        open_cache_only(bucket_config("three"), folder)
    result = encode_config(bucket_config("three"))
    assert sum(encoded_frames) == 5 * 24
    assert are_equal(batches(open_cache_only(bucket_config("three"), result.folder)), expected)
    assert not [
        name for name in bucket.names("bucket") if not name.endswith((".safetensors", ".json", ".npz", "other"))
    ]
