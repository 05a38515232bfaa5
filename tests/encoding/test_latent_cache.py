"""The latent cache: same clips in the same order; a wrong or damaged cache is refused."""

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

    def no_pictures(steps: Sequence[int]) -> np.ndarray:
        raise AssertionError(f"pictures of {steps}")

    return Episode(
        info=EpisodeInfo("lab/episode 1", steps, success=True),
        states=synthetic_states(steps),
        read_frames=no_pictures,
        control_rate_hz=15.0,
        extrinsics=np.arange(steps * 6.0).reshape(steps, 6),
        joint_velocities=np.ones((steps, 7), np.float32),
        metadata={"language": "pick — it up"},
        commands=np.linspace(0, 1, steps * 3, dtype=np.float32).reshape(steps, 3),
    )


def drawn_latents(frames: int = len(FRAMES), seed: int = 0) -> torch.Tensor:
    latents = torch.randn(frames, TOKENS, DIM, generator=torch.Generator().manual_seed(seed))
    latents[0, 0] = 0  # a token without a scale
    return latents


def written(folder: Path, kind: CacheType = "fp32", *, exact: bool = False) -> LatentFiles:
    """Write episode 0."""
    files = LatentFiles(folder, "key")
    pictures = np.stack([np.full((16, 16, 3), 20 * step, np.uint8) for step in FRAMES])
    latents = pack_latents(drawn_latents(), kind)
    files.write(0, EncodedEpisode(episode(), "left", FRAMES, latents, pictures), lossless_images=exact)
    return files


def read_all(files: LatentFiles) -> tuple[StoredLatents, np.ndarray]:
    file, everything = files.open(0, "left"), range(len(FRAMES))
    return file.read_latents(everything), file.read_images(everything)


@pytest.mark.parametrize(("kind", "largest_error"), [("fp32", 0.0), ("bf16", 2**-8), ("int8", 0.5)])
def test_cached_latents_have_the_precision_of_the_cache(tmp_path: Path, kind: CacheType, largest_error: float) -> None:
    found = written(tmp_path, kind).open(0, "left").read_latents([3, 0])
    true = drawn_latents()[[3, 0]]
    unit = {"fp32": 1.0, "bf16": true.abs(), "int8": true.abs().amax(-1, keepdim=True) / 127}[kind]
    assert unpack_latents(found).dtype == torch.float32
    assert ((unpack_latents(found) - true).abs() <= largest_error * unit * (1 + 1e-5)).all()
    assert (found.scales is not None) == (kind == "int8")


@pytest.mark.parametrize("exact", [False, True])
def test_other_cached_values_are_bit_exact(tmp_path: Path, exact: bool) -> None:
    file, true = written(tmp_path, exact=exact).open(0, "left"), episode()
    for name in ("states", *OPTIONAL):
        assert file.read_array(name).dtype == getattr(true, name).dtype
        np.testing.assert_array_equal(file.read_array(name), getattr(true, name))
    assert file.metadata == true.metadata
    assert file.frame_steps.tolist() == list(FRAMES)
    assert file.find_frames([11, 0]) == [3, 0]
    assert abs(file.read_images([3, 1]).mean(axis=(1, 2, 3)) - [220, 40]).max() < (1e-6 if exact else 3)


# ---- a damaged file ----------------------------------------------------------------------------------------------


def changed(path: Path, change: Callable[[dict[str, torch.Tensor], dict[str, str]], object]) -> None:
    with safe_open(path, framework="pt") as file:
        tensors, about = load_file(path), file.metadata()
    change(tensors, about)
    save_file({name: one.contiguous() for name, one in tensors.items()}, path, about)


@pytest.mark.parametrize(
    "change",
    [
        lambda tensors, _: tensors.pop("latents"),
        lambda tensors, _: tensors.update(latents=tensors["latents"][1:]),
        lambda tensors, _: tensors.update(picture_ends=-tensors["picture_ends"]),
        lambda tensors, _: tensors.update(pictures=torch.zeros_like(tensors["pictures"])),
        lambda _, about: about.pop("metadata"),
        lambda _, about: about.update(metadata="["),
    ],
)
def test_invalid_third_party_cache_file_raises(tmp_path: Path, change: Callable[..., object]) -> None:
    files = written(tmp_path)
    read_all(files)
    changed(Path(files.path(0, "left")), change)
    with pytest.raises(InputError, match="000000-left"):
        read_all(files)


def with_nan(tensors: dict[str, torch.Tensor], _: object) -> None:
    tensors["states"][2, 1] = torch.nan


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_nan, r"states: step 2: the numbers .*finite numbers"),
        (lambda tensors, _: tensors.update(states=tensors["states"][:3]), r"states: shape \(3, 7\).*Expected 40 x 7"),
        (lambda tensors, _: tensors.update(states=tensors["states"] * 1000), r"states: step 0: .*like millimetres"),
        (lambda tensors, _: tensors.update(extrinsics=torch.zeros(3, 6)), r"extrinsics: shape \(3, 6\)"),
        (lambda tensors, _: tensors.pop("states"), r"not a complete file of latents"),
    ],
)
def test_states_of_a_third_party_cache_are_checked(tmp_path: Path, change: Callable[..., object], message: str) -> None:
    through = open_dataset(cached_config(tmp_path))
    files = sorted((Path(through.config.path) / "episodes/000").glob("*.safetensors"))
    through.source.read(1)
    changed(files[1], change)
    with pytest.raises(InputError, match=rf"(?s)000001-.*{message}"):
        through.source.read(1)


def cached_config(tmp_path: Path) -> DataConfig:
    folder = write_synthetic_droid(tmp_path / "1.0.0", episodes=4, steps=40)
    config = DataConfig.model_validate(
        {"path": str(folder), "frames": 3, "stride": 2, "workers": 0, "disk_cache": {"dir": str(tmp_path / "cache")}}
    )
    return config.with_source("latents", path=str(write_cache(open_dataset(config))), camera=config.cameras)


def test_only_requested_latents_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files, count, frame = LatentFiles(tmp_path, "key"), 200, 64 * 1024 * 4
    latents = StoredLatents(torch.zeros(1, 64, 1024).expand(count, -1, -1))
    pictures = np.zeros((count, 8, 8, 3), np.uint8)
    files.write(0, EncodedEpisode(episode(count), "left", range(count), latents, pictures))
    read, lengths = storage.read_ranges, list[int]()

    def counted(path: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        lengths.extend(length for _, length in ranges)
        return read(path, ranges)

    monkeypatch.setattr(storage, "read_ranges", counted)
    kept = files.open(0, "left").read_latents([17, 190])
    assert 2 * frame < sum(lengths) <= 2 * frame + (32 << 10)
    assert kept.values.shape == (2, 64, 1024)


# ---- a data set through its cache --------------------------------------------------------------------------------

KNOBS: dict[str, Any] = {
    "frames": 3, "stride": 2, "validation_share": 0.3, "test_share": 0.2, "workers": 0, "cache": "require",
}  # fmt: skip
IDLE = {"rule": "motion", "shortest_idle_steps": 3, "shortest_kept_steps": 4, "cut_last_steps": 1}
EVERYTHING = {
    "plain": {},
    "one phase of idle": {"start_every": 2, "idle": IDLE, "camera": ("wrist_left",)},
    "another crop": {"crop": "square"},
}


@pytest.fixture(scope="module")
def droid_with_rests(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen episodes of 12 to 27 steps, some of them idle."""
    drawn = []
    for number in range(16):
        one = synthetic_episode(number, steps=12 + number, size=(36, 64), success=number % 3 != 2)
        still = slice(4 + number % 3, 9 + number // 4)
        for name in ("cartesian", "gripper"):
            positions = one.arrays[f"observation/{name}_position"]
            positions[still] = positions[still.start]
        drawn.append(one)
    return write_droid_rlds(tmp_path_factory.mktemp("droid") / "1.0.0", drawn, shards=2)


def config_of(data: Path, tmp_path: Path, **options: Any) -> DataConfig:
    values = {"path": str(data), "cache_dir": str(tmp_path / "caches")} | KNOBS | options
    return DataConfig.model_validate(values)


def cached(path: Path, tmp_path: Path, **options: Any) -> tuple[Dataset, Dataset]:
    """Return a data set of frames, and the same data set read from its cache."""
    original = open_dataset(config_of(path, tmp_path, **options))
    write_cache(original)
    return original, LatentCache.for_dataset(original, NUMBERS).open_dataset()


def open_cache_only(through: Dataset, **options: Any) -> Dataset:
    """Open a cache without its data set and with another disk cache."""
    changes = {
        "source": "latents",
        "cache": "off",
        "disk_cache": {"dir": f"{through.config.cache_dir}-other"},
    } | options
    config = through.config.model_dump() | changes
    return open_dataset(DataConfig.model_validate(config))


def first_batches(dataset: Dataset, count: int = 6) -> list[Batch]:
    with closing(training_loader(dataset, seed=3, batch_size=2)) as loader:
        return list(islice(loader, count))


def assert_same_clips(original: list[Batch], cached: list[Batch]) -> None:
    """Check that the states, actions and frames of each clip equal those of the original."""
    assert len(original) == len(cached)
    for one, other in zip(original, cached, strict=True):
        assert one.frames is not None
        assert (one.episode_ids, one.starts, one.cameras) == (other.episode_ids, other.starts, other.cameras)
        for name in ("states", "actions", "extrinsics"):
            first, second = getattr(one, name), getattr(other, name)
            assert torch.equal(first, second) if first is not None else second is None
        if one.starts:
            assert other.frames is None
            assert other.latents is not None
            true = torch.stack([as_numbers(frames.numpy()) for frames in one.frames])
            torch.testing.assert_close(unpack_latents(other.latents), true, rtol=2**-8, atol=0)


@pytest.mark.parametrize("options", EVERYTHING.values(), ids=EVERYTHING)
def test_cached_clips_equal_those_of_the_data_set(
    droid_with_rests: Path, tmp_path: Path, options: dict[str, Any]
) -> None:
    original, through = cached(droid_with_rests, tmp_path, **options)
    by_itself = open_cache_only(through)
    splits: tuple[Split, ...] = ("train", "validation", "test")
    for split in splits:
        windows = original.windows(split)
        for other in (through, by_itself):
            found = other.windows(split)
            assert [found[place] for place in range(len(found))] == [windows[place] for place in range(len(windows))]
    for other in (through, by_itself):
        assert_same_clips(first_batches(original), first_batches(other))
        assert_same_clips(
            list(validation_batches(original, "validation", clips=9, batch_size=4)),
            list(validation_batches(other, "validation", clips=9, batch_size=4)),
        )
    assert by_itself.control_rate_hz == original.control_rate_hz


# ---- broken episodes ---------------------------------------------------------------------------------------------


@pytest.fixture
def cached_set_with_broken_episode(tmp_path: Path) -> Dataset:
    """A cached data set of 100 episodes; the frames of one episode cannot be read."""
    unreadable = frozenset({5})
    source = MemorySource([6] * 100, pictureless=unreadable)
    config = config_of(tmp_path, tmp_path, broken_episodes="skip", validation_share=0.1, test_share=0.1)
    table = source.infos()
    is_selected = np.ones(100, bool)
    return Dataset(config, source, table, StepSelection.all_steps(table, is_selected), BrokenEpisodes(config, 100))


def test_broken_episode_is_skipped_with_and_without_a_cache(cached_set_with_broken_episode: Dataset) -> None:
    original = cached_set_with_broken_episode
    write_cache(original)
    through = replace(
        LatentCache.for_dataset(original, NUMBERS).open_dataset(), broken=BrokenEpisodes(original.config, 100)
    )
    batches = first_batches(original, 90), first_batches(through, 90)
    assert_same_clips(*batches)
    assert {len(batch.starts) for batch in batches[1]} > {2}
    assert list(through.broken.reasons) == list(original.broken.reasons) == ["episode 5"]
    assert "encoding could not read the episode (memory: pictures of episode 5: damaged)" in str(through.broken.reasons)


def test_damaged_cache_file_follows_the_broken_episode_policy(cached_set_with_broken_episode: Dataset) -> None:
    def opened(policy: str) -> Dataset:
        config = cached_set_with_broken_episode.config.model_copy(update={"broken_episodes": policy})
        source, broken = MemorySource([6] * 100), BrokenEpisodes(config, 100)
        return replace(cached_set_with_broken_episode, config=config, source=source, broken=broken)

    write_cache(opened("error"))
    files = LatentCache.for_dataset(opened("error"), NUMBERS).files
    path = Path(files.path(7, "exterior_1_left"))
    changed(path, lambda tensors, _: tensors.pop("states"))  # detected on reading
    with pytest.raises(InputError, match=r"000007.*data\.broken_episodes"):
        list(
            read_batches(
                LatentCache.for_dataset(opened("error"), NUMBERS).open_dataset(), [(6, 0), (7, 0)], batch_size=1
            )
        )
    through = LatentCache.for_dataset(opened("skip"), NUMBERS).open_dataset()
    assert len(list(read_batches(through, [(6, 0), (7, 0)], batch_size=1))) == 1
    assert list(through.broken.reasons) == ["episode 7"]
    path.unlink()  # detected when the cache is opened
    with pytest.raises(InputError, match=r"no latents of 1 of 100 episodes, such as episode 7"):
        LatentCache.for_dataset(opened("skip"), NUMBERS).open_dataset()


# ---- errors ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shared_cache(droid_with_rests: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Dataset, Path]:
    """A data set, the same data set read from its cache, and the folder of `cache_dir`; tests must not change them."""
    folder = tmp_path_factory.mktemp("cache")
    original, through = cached(droid_with_rests, folder, idle=IDLE, outcome="success")
    return original, through, folder


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        ({"stride": 3}, r"data\.stride: 2, not 3"),
        ({"crop": "letterbox"}, r"data\.crop: released, not letterbox"),
        ({"idle": IDLE | {"translation_m": 0.5}}, r"data\.idle\.translation_m: 0\.001, not 0\.5"),
        ({"outcome": "all"}, r"no latents of \d+ of \d+ episodes.*data\.outcome"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_cache_of_other_clips_raises_with_the_difference(
    shared_cache: tuple[Dataset, Dataset, Path], options: dict[str, Any], reported: str
) -> None:
    original, through, _ = shared_cache
    with pytest.raises(InputError, match=reported):
        open_cache_only(through, **options)
    config = DataConfig.model_validate(original.config.model_dump() | options)
    with pytest.raises(InputError, match=reported):
        LatentCache.for_dataset(open_dataset(config), NUMBERS).open_dataset()


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"encoder": "another"}, "encoder: numbers, not another"),
        ({"training.precision": "bf16"}, r"training\.precision: fp32, not bf16"),
    ],
    ids=str,
)
def test_cache_of_another_encoder_raises_with_the_difference(
    shared_cache: tuple[Dataset, Dataset, Path], change: dict[str, Any], reported: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, through, _ = shared_cache
    encoding = replace(NUMBERS, parts={**NUMBERS.parts, **change})
    monkeypatch.setattr(batch, "get_encoding", lambda model, _: model)
    with pytest.raises(
        InputError, match=f"no latent cache.*other caches in its folder: 1.*{reported}.*vjepa2-ac encode"
    ):
        LatentCache.for_dataset(original, encoding).open_dataset()
    with pytest.raises(InputError, match=reported):
        batch.require_same_encoder(encoding, open_cache_only(through), None)  # type: ignore[arg-type]
    batch.require_same_encoder(NUMBERS, open_cache_only(through), None)  # type: ignore[arg-type]
    batch.require_same_encoder(encoding, original, None)  # type: ignore[arg-type]  # no cache


def test_unfinished_or_damaged_cache_raises(droid_with_rests: Path, tmp_path: Path) -> None:
    original, through = cached(droid_with_rests, tmp_path, idle=IDLE)
    folder = Path(through.config.path)
    for name in (EPISODES_FILE, STEPS_FILE, CACHE_FILE):
        sound = (folder / name).read_bytes()
        (folder / name).write_bytes(sound[:-40])
        with pytest.raises(InputError, match=name):
            open_cache_only(through)
        (folder / name).write_bytes(sound)
    (folder / STEPS_FILE).rename(folder / "other")
    with pytest.raises(InputError, match=r"kept\.npz"):
        open_cache_only(through)
    (folder / "other").rename(folder / STEPS_FILE)
    next(folder.rglob("*.safetensors")).unlink()
    for read in (lambda: open_cache_only(through), lambda: LatentCache.for_dataset(original, NUMBERS).open_dataset()):
        with pytest.raises(InputError, match=r"no latents of 1 of \d+ episodes.*vjepa2-ac encode"):
            read()
    with pytest.raises(InputError, match="no latent cache"):
        open_cache_only(through, path=str(tmp_path))


def test_key_of_an_older_version_accepts_removed_keys_at_their_default(tmp_path: Path) -> None:
    key = CacheKey({"decoder": {"size": "small"}})
    for noise, is_accepted in ((0.0, True), (0.5, False)):
        (tmp_path / "key.json").write_text(json.dumps({"key": {"decoder": {"size": "small", "noise": noise}}}))
        with nullcontext() if is_accepted else pytest.raises(InputError, match=r"noise: 0\.5"):
            require_matching_folder(tmp_path, "key.json", key, where="decoder.folder")
