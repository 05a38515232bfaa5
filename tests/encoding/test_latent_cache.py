"""The latent cache: it has the same clips in the same order, and an unsuitable or damaged cache raises."""

import json
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from latent_sets import NUMBERS, as_numbers, write_cache
from memory_source import MemorySource
from synthetic import synthetic_episode, synthetic_states, write_synthetic_droid
from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.index import StepSelection
from vjepa2_ac.data.loader import read_batches, training_loader, validation_batches
from vjepa2_ac.data.selection import BrokenEpisodes
from vjepa2_ac.data.sources.latent_files import (
    OPTIONAL,
    CacheType,
    EncodedEpisode,
    LatentFiles,
    pack_latents,
    unpack_latents,
)
from vjepa2_ac.data.sources.latents import CACHE_FILE, EPISODES_FILE, STEPS_FILE, CacheKey, require_matching_folder
from vjepa2_ac.encoding import batch
from vjepa2_ac.encoding.latent_cache import LatentCache
from vjepa2_ac.episode import Batch, Episode, EpisodeInfo, StoredLatents
from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation.droid_writer import write_droid_rlds

STEPS, FRAMES, TOKENS, DIM = 12, (0, 2, 5, 11), 4, 24


def episode(steps: int = STEPS) -> Episode:
    """Return an episode with all optional values; its frames must not be read."""

    def fail(steps: Sequence[int]) -> np.ndarray:
        raise AssertionError(f"frames of {steps} are read")

    return Episode(
        info=EpisodeInfo("lab/episode 1", steps, success=True),
        states=synthetic_states(steps),
        read_frames=fail,
        control_rate_hz=15.0,
        extrinsics=np.arange(steps * 6.0).reshape(steps, 6),
        joint_velocities=np.ones((steps, 7), np.float32),
        metadata={"language": "pick — it up"},
        commands=np.linspace(0, 1, steps * 3, dtype=np.float32).reshape(steps, 3),
    )


def random_latents() -> torch.Tensor:
    latents = torch.randn(len(FRAMES), TOKENS, DIM, generator=torch.Generator().manual_seed(0))
    latents[0, 0] = 0  # a token whose int8 scale is zero
    return latents


def write_episode(folder: Path, kind: CacheType = "fp32", *, is_lossless: bool = False) -> LatentFiles:
    """Write the file of episode 0."""
    files = LatentFiles(folder, "key")
    images = np.stack([np.full((16, 16, 3), 20 * step, np.uint8) for step in FRAMES])
    latents = pack_latents(random_latents(), kind)
    files.write(0, EncodedEpisode(episode(), "left", FRAMES, latents, images), lossless_images=is_lossless)
    return files


def read_all(files: LatentFiles) -> tuple[StoredLatents, np.ndarray]:
    file, indices = files.open(0, "left"), range(len(FRAMES))
    return file.read_latents(indices), file.read_images(indices)


@pytest.mark.parametrize(("kind", "largest_error"), [("fp32", 0.0), ("bf16", 2**-8), ("int8", 0.5)])
def test_cached_latents_have_the_precision_of_the_cache(tmp_path: Path, kind: CacheType, largest_error: float) -> None:
    stored = write_episode(tmp_path, kind).open(0, "left").read_latents([3, 0])
    true = random_latents()[[3, 0]]
    unit = {"fp32": 1.0, "bf16": true.abs(), "int8": true.abs().amax(-1, keepdim=True) / 127}[kind]
    assert unpack_latents(stored).dtype == torch.float32
    assert ((unpack_latents(stored) - true).abs() <= largest_error * unit * (1 + 1e-5)).all()
    assert (stored.scales is not None) == (kind == "int8")


@pytest.mark.parametrize("is_lossless", [False, True])
def test_cached_values_other_than_latents_and_jpegs_are_bit_exact(tmp_path: Path, is_lossless: bool) -> None:
    file, true = write_episode(tmp_path, is_lossless=is_lossless).open(0, "left"), episode()
    for name in ("states", *OPTIONAL):
        assert file.read_array(name).dtype == getattr(true, name).dtype
        np.testing.assert_array_equal(file.read_array(name), getattr(true, name))
    assert file.metadata == true.metadata
    assert file.frame_steps.tolist() == list(FRAMES)
    assert file.find_frames([11, 0]) == [3, 0]
    assert abs(file.read_images([3, 1]).mean(axis=(1, 2, 3)) - [220, 40]).max() < (1e-6 if is_lossless else 3)


# ---- a damaged file ----------------------------------------------------------------------------------------------


def rewrite(path: Path, change: Callable[[dict[str, torch.Tensor], dict[str, str]], object]) -> None:
    with safe_open(path, framework="pt") as file:
        tensors, metadata = load_file(path), file.metadata()
    change(tensors, metadata)
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path, metadata)


@pytest.mark.parametrize(
    "change",
    [
        lambda tensors, _: tensors.pop("latents"),
        lambda tensors, _: tensors.update(latents=tensors["latents"][1:]),
        lambda tensors, _: tensors.update(picture_ends=-tensors["picture_ends"]),
        lambda tensors, _: tensors.update(pictures=torch.zeros_like(tensors["pictures"])),
        lambda _, metadata: metadata.pop("metadata"),
        lambda _, metadata: metadata.update(metadata="["),
    ],
)
def test_invalid_third_party_cache_file_raises(tmp_path: Path, change: Callable[..., object]) -> None:
    files = write_episode(tmp_path)
    read_all(files)
    rewrite(Path(files.path(0, "left")), change)
    with pytest.raises(InputError, match="000000-left"):
        read_all(files)


def add_nan(tensors: dict[str, torch.Tensor], _: object) -> None:
    tensors["states"][2, 1] = torch.nan


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (add_nan, r"states: step 2: the numbers .*finite numbers"),
        (lambda tensors, _: tensors.update(states=tensors["states"][:3]), r"states: shape \(3, 7\).*Expected 40 x 7"),
        (lambda tensors, _: tensors.update(states=tensors["states"] * 1000), r"states: step 0: .*like millimetres"),
        (lambda tensors, _: tensors.update(extrinsics=torch.zeros(3, 6)), r"extrinsics: shape \(3, 6\)"),
        (lambda tensors, _: tensors.pop("states"), r"not a complete file of latents"),
    ],
)
def test_states_of_a_third_party_cache_are_checked(tmp_path: Path, change: Callable[..., object], message: str) -> None:
    dataset = open_dataset(cached_config(tmp_path))
    files = sorted((Path(dataset.config.path) / "episodes/000").glob("*.safetensors"))
    dataset.source.read(1)
    rewrite(files[1], change)
    with pytest.raises(InputError, match=rf"(?s)000001-.*{message}"):
        dataset.source.read(1)


def cached_config(tmp_path: Path) -> DataConfig:
    folder = write_synthetic_droid(tmp_path / "1.0.0", episodes=4, steps=40)
    config = DataConfig.model_validate(
        {"path": str(folder), "frames": 3, "stride": 2, "workers": 0, "disk_cache": {"dir": str(tmp_path / "cache")}}
    )
    return config.with_source("latents", path=str(write_cache(open_dataset(config))), camera=config.cameras)


def test_only_requested_latents_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files, num_frames, frame_bytes = LatentFiles(tmp_path, "key"), 200, 64 * 1024 * 4
    latents = StoredLatents(torch.zeros(1, 64, 1024).expand(num_frames, -1, -1))
    images = np.zeros((num_frames, 8, 8, 3), np.uint8)
    files.write(0, EncodedEpisode(episode(num_frames), "left", range(num_frames), latents, images))
    read_ranges, lengths = storage.read_ranges, list[int]()

    def count_bytes(path: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        lengths.extend(length for _, length in ranges)
        return read_ranges(path, ranges)

    monkeypatch.setattr(storage, "read_ranges", count_bytes)
    stored = files.open(0, "left").read_latents([17, 190])
    assert 2 * frame_bytes < sum(lengths) <= 2 * frame_bytes + (32 << 10)
    assert stored.values.shape == (2, 64, 1024)


# ---- a data set read from its cache ------------------------------------------------------------------------------

OPTIONS: dict[str, Any] = {
    "frames": 3, "stride": 2, "validation_share": 0.3, "test_share": 0.2, "workers": 0, "cache": "require",
}  # fmt: skip
IDLE = {"rule": "motion", "shortest_idle_steps": 3, "shortest_kept_steps": 4, "cut_last_steps": 1}
CASES = {
    "plain": {},
    "idle steps and every second start": {"start_every": 2, "idle": IDLE, "camera": ("wrist_left",)},
    "another crop": {"crop": "square"},
}


@pytest.fixture(scope="module")
def droid_with_idle_steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen episodes of 12 to 27 steps, each with some idle steps."""
    episodes = []
    for index in range(16):
        episode = synthetic_episode(index, steps=12 + index, size=(36, 64), success=index % 3 != 2)
        idle = slice(4 + index % 3, 9 + index // 4)
        for name in ("cartesian", "gripper"):
            positions = episode.arrays[f"observation/{name}_position"]
            positions[idle] = positions[idle.start]
        episodes.append(episode)
    return write_droid_rlds(tmp_path_factory.mktemp("droid") / "1.0.0", episodes, shards=2)


def config_of(data: Path, tmp_path: Path, **options: Any) -> DataConfig:
    values = {"path": str(data), "cache_dir": str(tmp_path / "caches")} | OPTIONS | options
    return DataConfig.model_validate(values)


def open_with_cache(path: Path, tmp_path: Path, **options: Any) -> tuple[Dataset, Dataset]:
    """Return a data set of frames, and the same data set read from its cache."""
    original = open_dataset(config_of(path, tmp_path, **options))
    write_cache(original)
    return original, LatentCache.for_dataset(original, NUMBERS).open_dataset()


def open_cache_only(cached: Dataset, **options: Any) -> Dataset:
    """Open a cache without the data set from which it was encoded, and with another disk cache."""
    changes = {
        "source": "latents",
        "cache": "off",
        "disk_cache": {"dir": f"{cached.config.cache_dir}-other"},
    } | options
    config = cached.config.model_dump() | changes
    return open_dataset(DataConfig.model_validate(config))


def first_batches(dataset: Dataset, count: int = 6) -> list[Batch]:
    with closing(training_loader(dataset, seed=3, batch_size=2)) as loader:
        return list(islice(loader, count))


def assert_same_clips(original: list[Batch], cached: list[Batch]) -> None:
    """Check that the states, actions and frames of each clip equal those of the original."""
    assert len(original) == len(cached)
    for expected, actual in zip(original, cached, strict=True):
        assert expected.frames is not None
        assert (actual.episode_ids, actual.starts, actual.cameras) == (
            expected.episode_ids, expected.starts, expected.cameras,
        )  # fmt: skip
        for name in ("states", "actions", "extrinsics"):
            expected_value, value = getattr(expected, name), getattr(actual, name)
            assert value is None if expected_value is None else torch.equal(value, expected_value)
        if expected.starts:
            assert actual.frames is None
            assert actual.latents is not None
            true = torch.stack([as_numbers(frames.numpy()) for frames in expected.frames])
            torch.testing.assert_close(unpack_latents(actual.latents), true, rtol=2**-8, atol=0)


@pytest.mark.parametrize("options", CASES.values(), ids=CASES)
def test_cached_clips_equal_those_of_the_data_set(
    droid_with_idle_steps: Path, tmp_path: Path, options: dict[str, Any]
) -> None:
    original, cached = open_with_cache(droid_with_idle_steps, tmp_path, **options)
    cache_only = open_cache_only(cached)
    splits: tuple[Split, ...] = ("train", "validation", "test")
    for split in splits:
        expected = original.windows(split)
        for dataset in (cached, cache_only):
            windows = dataset.windows(split)
            assert [windows[index] for index in range(len(windows))] == [expected[i] for i in range(len(expected))]
    for dataset in (cached, cache_only):
        assert_same_clips(first_batches(original), first_batches(dataset))
        assert_same_clips(
            list(validation_batches(original, "validation", clips=9, batch_size=4)),
            list(validation_batches(dataset, "validation", clips=9, batch_size=4)),
        )
    assert cache_only.control_rate_hz == original.control_rate_hz


# ---- broken episodes ---------------------------------------------------------------------------------------------


@pytest.fixture
def dataset_with_broken_episode(tmp_path: Path) -> Dataset:
    """A data set of 100 episodes with a cache; the frames of one episode cannot be read."""
    unreadable = frozenset({5})
    source = MemorySource([6] * 100, pictureless=unreadable)
    config = config_of(tmp_path, tmp_path, broken_episodes="skip", validation_share=0.1, test_share=0.1)
    table = source.infos()
    is_selected = np.ones(100, bool)
    return Dataset(config, source, table, StepSelection.all_steps(table, is_selected), BrokenEpisodes(config, 100))


def test_broken_episode_is_skipped_with_and_without_a_cache(dataset_with_broken_episode: Dataset) -> None:
    original = dataset_with_broken_episode
    write_cache(original)
    cached = replace(
        LatentCache.for_dataset(original, NUMBERS).open_dataset(), broken=BrokenEpisodes(original.config, 100)
    )
    batches, cached_batches = first_batches(original, 90), first_batches(cached, 90)
    assert_same_clips(batches, cached_batches)
    assert {len(batch.starts) for batch in cached_batches} > {2}
    assert list(cached.broken.reasons) == list(original.broken.reasons) == ["episode 5"]
    assert "encoding could not read the episode (memory: pictures of episode 5: damaged)" in str(cached.broken.reasons)


def test_damaged_cache_file_follows_the_broken_episode_policy(dataset_with_broken_episode: Dataset) -> None:
    def make_cache(policy: str) -> LatentCache:
        config = dataset_with_broken_episode.config.model_copy(update={"broken_episodes": policy})
        source, broken = MemorySource([6] * 100), BrokenEpisodes(config, 100)
        dataset = replace(dataset_with_broken_episode, config=config, source=source, broken=broken)
        return LatentCache.for_dataset(dataset, NUMBERS)

    write_cache(make_cache("error").dataset)
    path = Path(make_cache("error").files.path(7, "exterior_1_left"))
    rewrite(path, lambda tensors, _: tensors.pop("states"))  # detected when the episode is read
    with pytest.raises(InputError, match=r"000007.*data\.broken_episodes"):
        list(read_batches(make_cache("error").open_dataset(), [(6, 0), (7, 0)], batch_size=1))
    cached = make_cache("skip").open_dataset()
    assert len(list(read_batches(cached, [(6, 0), (7, 0)], batch_size=1))) == 1
    assert list(cached.broken.reasons) == ["episode 7"]
    path.unlink()  # detected when the cache is opened
    with pytest.raises(InputError, match=r"no latents of 1 of 100 episodes, such as episode 7"):
        make_cache("skip").open_dataset()


# ---- errors ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shared_cache(droid_with_idle_steps: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Dataset]:
    """A data set, and the same data set read from its cache; tests must not change them."""
    return open_with_cache(droid_with_idle_steps, tmp_path_factory.mktemp("cache"), idle=IDLE, outcome="success")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stride": 3}, r"data\.stride: 2, not 3"),
        ({"crop": "letterbox"}, r"data\.crop: released, not letterbox"),
        ({"idle": IDLE | {"translation_m": 0.5}}, r"data\.idle\.translation_m: 0\.001, not 0\.5"),
        ({"outcome": "all"}, r"no latents of \d+ of \d+ episodes.*data\.outcome"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_cache_of_other_clips_raises_with_the_difference(
    shared_cache: tuple[Dataset, Dataset], options: dict[str, Any], message: str
) -> None:
    original, cached = shared_cache
    with pytest.raises(InputError, match=message):
        open_cache_only(cached, **options)
    config = DataConfig.model_validate(original.config.model_dump() | options)
    with pytest.raises(InputError, match=message):
        LatentCache.for_dataset(open_dataset(config), NUMBERS).open_dataset()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"encoder": "another"}, "encoder: numbers, not another"),
        ({"training.precision": "bf16"}, r"training\.precision: fp32, not bf16"),
    ],
    ids=str,
)
def test_cache_of_another_encoder_raises_with_the_difference(
    shared_cache: tuple[Dataset, Dataset], change: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, cached = shared_cache
    encoding = replace(NUMBERS, parts={**NUMBERS.parts, **change})
    monkeypatch.setattr(batch, "get_encoding", lambda model, _: model)
    with pytest.raises(InputError, match=f"no latent cache.*The folder has 1 other cache.*{message}.*vjepa2-ac encode"):
        LatentCache.for_dataset(original, encoding).open_dataset()
    with pytest.raises(InputError, match=message):
        batch.require_same_encoder(encoding, open_cache_only(cached), None)  # type: ignore[arg-type]
    batch.require_same_encoder(NUMBERS, open_cache_only(cached), None)  # type: ignore[arg-type]
    batch.require_same_encoder(encoding, original, None)  # type: ignore[arg-type]  # a data set of frames


def test_unfinished_or_damaged_cache_raises(droid_with_idle_steps: Path, tmp_path: Path) -> None:
    original, cached = open_with_cache(droid_with_idle_steps, tmp_path, idle=IDLE)
    folder = Path(cached.config.path)
    for name in (EPISODES_FILE, STEPS_FILE, CACHE_FILE):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[:-40])
        with pytest.raises(InputError, match=name):
            open_cache_only(cached)
        (folder / name).write_bytes(content)
    (folder / STEPS_FILE).rename(folder / "other")
    with pytest.raises(InputError, match=r"kept\.npz"):
        open_cache_only(cached)
    (folder / "other").rename(folder / STEPS_FILE)
    next(folder.rglob("*.safetensors")).unlink()
    for read in (lambda: open_cache_only(cached), lambda: LatentCache.for_dataset(original, NUMBERS).open_dataset()):
        with pytest.raises(InputError, match=r"no latents of 1 of \d+ episodes.*vjepa2-ac encode"):
            read()
    with pytest.raises(InputError, match="no latent cache"):
        open_cache_only(cached, path=str(tmp_path))


def test_folder_of_an_older_version_is_accepted_if_removed_config_keys_have_their_default(tmp_path: Path) -> None:
    key = CacheKey({"decoder": {"size": "small"}})
    for noise, is_accepted in ((0.0, True), (0.5, False)):
        (tmp_path / "key.json").write_text(json.dumps({"key": {"decoder": {"size": "small", "noise": noise}}}))
        with nullcontext() if is_accepted else pytest.raises(InputError, match=r"noise: 0\.5"):
            require_matching_folder(tmp_path, "key.json", key, where="decoder.folder")
