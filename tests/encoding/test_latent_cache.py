"""The latent cache: same clips in the same order; a wrong or damaged cache is refused."""

import json
import os
import pickle
import shutil
from collections.abc import Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from safetensors import safe_open
from safetensors.torch import save_file

from clips import clip_at
from latent_sets import NUMBERS, as_numbers, write_cache
from memory_source import MemorySource
from synthetic import synthetic_episode, synthetic_states
from vector_sets import write_vectors
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips import frames_of
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.index.episode_table import EpisodeTable
from vjepa2_ac.data.loader import batches_of, training_loader, validation_batches
from vjepa2_ac.data.selection import BrokenEpisodes, StepSelection
from vjepa2_ac.data.sources.latents.dtypes import CacheType, pack_latents, unpack_latents
from vjepa2_ac.data.sources.latents.episode_file import EncodedEpisode, EpisodeFile, EpisodeLayout, write_episode_file
from vjepa2_ac.data.sources.latents.manifest import EPISODES, KEPT, MANIFEST, path_of
from vjepa2_ac.data.sources.rlds.writing.droid_writer import write_droid_rlds
from vjepa2_ac.data.windows import clip_starts
from vjepa2_ac.encoding.cache_lookup import needed_frames, require_encoding, through_cache
from vjepa2_ac.episode import Batch, Episode, EpisodeInfo, StoredLatents
from vjepa2_ac.errors import InputError
from vjepa2_ac.inspection.check import check_data
from vjepa2_ac.inspection.sheet import plot_dataset
from vjepa2_ac.inspection.statistics import inspect_dataset

STEPS, FRAMES, TOKENS, DIM = 12, (0, 2, 5, 11), 4, 24


def episode(steps: int = STEPS) -> Episode:
    """Return an episode with everything that one can have; its frames must not be read."""

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


def written(folder: Path, kind: CacheType = "fp32") -> tuple[Path, EpisodeLayout]:
    path, layout = folder / "a" / "b.safetensors", EpisodeLayout("key", kind, TOKENS, DIM)
    pictures = np.stack([np.full((16, 16, 3), 20 * step, np.uint8) for step in FRAMES])
    latents = pack_latents(drawn_latents(), kind)
    write_episode_file(path, layout, EncodedEpisode(episode(), "left", FRAMES, latents, pictures))
    return path, layout


@pytest.mark.parametrize(("kind", "largest_error"), [("fp32", 0.0), ("bf16", 2**-8), ("int8", 0.5)])
def test_latents_come_back_in_the_precision_that_they_are_kept_in(
    tmp_path: Path, kind: CacheType, largest_error: float
) -> None:
    record = EpisodeFile(*written(tmp_path, kind))
    found = record.latents([3, 0], check=[3, 0])
    true = drawn_latents()[[3, 0]]
    unit = {"fp32": 1.0, "bf16": true.abs(), "int8": true.abs().amax(-1, keepdim=True) / 127}[kind]
    assert unpack_latents(found).dtype == torch.float32
    assert ((unpack_latents(found) - true).abs() <= largest_error * unit * (1 + 1e-5)).all()
    assert (found.scales is not None) == (kind == "int8")


def test_everything_else_of_an_episode_comes_back_bit_for_bit(tmp_path: Path) -> None:
    record, true = EpisodeFile(*written(tmp_path)), episode()
    for name in ("states", "extrinsics", "joint_velocities", "commands"):
        assert record[name].dtype == getattr(true, name).dtype
        np.testing.assert_array_equal(record[name], getattr(true, name))
    assert record.metadata == true.metadata
    assert record.frame_steps.tolist() == list(FRAMES)
    assert record.places_of([11, 0]) == [3, 0]
    assert abs(record.pictures([3, 1]).mean(axis=(1, 2, 3)) - [220, 40]).max() < 3


def test_a_file_opens_with_plain_safetensors(tmp_path: Path) -> None:
    with safe_open(written(tmp_path, "bf16")[0], framework="pt") as file:
        assert file.get_slice("latents").get_shape() == [len(FRAMES), TOKENS, DIM]
        assert torch.equal(file.get_slice("latents")[2:3], drawn_latents()[2:3].bfloat16())
        assert file.metadata()["id"] == "lab/episode 1"


# ---- a damaged file ----------------------------------------------------------------------------------------------


def flipped(path: Path, place: int, bit: int = 4) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1 << bit
    path.write_bytes(data)


def place_of(path: Path, name: str, byte: int = 0) -> int:
    """Return the position of a tensor's byte in a file."""
    header = int.from_bytes(path.read_bytes()[:8], "little")
    begin, end = json.loads(path.read_bytes()[8 : 8 + header])[name]["data_offsets"]
    assert byte < end - begin
    return 8 + header + begin + byte


def test_a_flipped_bit_in_a_frame_is_found_when_that_frame_is_read_and_only_then(tmp_path: Path) -> None:
    path, layout = written(tmp_path, "int8")
    for name, size in (("latents", DIM * TOKENS), ("scales", 4 * TOKENS)):
        flipped(path, place_of(path, name, byte=size + 1))
        record = EpisodeFile(path, layout)
        record.latents([0, 2, 3], check=[0, 2, 3])  # the others are sound
        record.latents([1], check=[])
        with pytest.raises(InputError, match=r"b\.safetensors: damaged: the CRC of control step 2 is wrong") as error:
            record.latents([0, 1], check=[0, 1])
        assert "encode" in error.value.fix
        flipped(path, place_of(path, name, byte=size + 1))


def test_a_flipped_bit_in_a_frame_is_found_when_it_is_read(tmp_path: Path) -> None:
    path, layout = written(tmp_path)
    flipped(path, place_of(path, "pictures", byte=40))
    record = EpisodeFile(path, layout)
    record.pictures([2])
    with pytest.raises(InputError, match="CRC of the image of control step 0"):
        record.pictures([0])


@pytest.mark.parametrize("name", ["states", "commands", "extrinsics", "frame_steps", "frame_crc", "picture_ends"])
def test_a_flipped_bit_in_anything_small_is_found_when_the_file_is_opened(tmp_path: Path, name: str) -> None:
    path, layout = written(tmp_path)
    flipped(path, place_of(path, name, byte=3))
    with pytest.raises(InputError, match="damaged: its CRC"):
        EpisodeFile(path, layout)


def test_no_flipped_bit_in_a_header_passes(tmp_path: Path) -> None:
    path, layout = written(tmp_path)
    header = int.from_bytes(path.read_bytes()[:8], "little")
    sound = EpisodeFile(path, layout)
    everything = list(range(len(FRAMES)))
    true = unpack_latents(sound.latents(everything, check=everything))
    places, refused = range(0, 8 + header, 5), 0
    for place in places:
        flipped(path, place, bit=place % 8)
        try:
            record = EpisodeFile(path, layout)
            found = unpack_latents(record.latents(everything, check=everything))
        except InputError as error:
            refused += str(path) in str(error)
        else:  # white space after the JSON
            assert torch.equal(found, true)
            assert record.about == sound.about
        flipped(path, place, bit=place % 8)
    assert refused > 0.95 * len(places)


@pytest.mark.parametrize("left", [0, 5, 100, -1])
def test_a_truncated_file_is_named(tmp_path: Path, left: int) -> None:
    path, layout = written(tmp_path)
    path.write_bytes(path.read_bytes()[:left])
    with pytest.raises(InputError, match=r"b\.safetensors: not a whole safetensors file"):
        EpisodeFile(path, layout)


def test_a_file_of_another_cache_is_refused(tmp_path: Path) -> None:
    path, layout = written(tmp_path)
    with pytest.raises(InputError, match="a file of another cache"):
        EpisodeFile(path, replace(layout, key="other"))
    for other in (replace(layout, kind="bf16"), replace(layout, dim=DIM + 1)):
        with pytest.raises(InputError, match="needed: latents of"):
            EpisodeFile(path, other)


def test_frames_of_another_type_are_damage(tmp_path: Path) -> None:
    path, layout = written(tmp_path)
    with safe_open(path, framework="pt") as file:
        tensors, about = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    save_file(tensors | {"pictures": tensors["pictures"].to(torch.bfloat16)}, path, about)
    with pytest.raises(InputError, match="values of BF16"):
        EpisodeFile(path, layout)


def test_a_step_that_was_not_encoded_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"lab/episode 1\): no frame of control step 3"):
        EpisodeFile(*written(tmp_path)).places_of([2, 3])


def test_only_the_frames_that_are_asked_for_are_read(tmp_path: Path) -> None:
    path, layout = tmp_path / "large.safetensors", EpisodeLayout("key", "fp32", 64, 1024)
    count = 200  # of 256 kB
    latents = StoredLatents(torch.zeros(1, 64, 1024).expand(count, -1, -1))
    pictures = np.zeros((count, 8, 8, 3), np.uint8)
    write_episode_file(path, layout, EncodedEpisode(episode(count), "left", range(count), latents, pictures))
    record = EpisodeFile(path, layout)
    kept = record.latents([17, 190], check=[17, 190])
    assert 2 * 256 << 10 <= resident_of(path) < path.stat().st_size / 5  # some kernels map 2 MB at once
    assert kept.values.shape == (2, 64, 1024)


def resident_of(path: Path) -> int:
    """Return how many bytes of a file this process has mapped into its memory."""
    resident, is_ours = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if line[0] in "0123456789abcdef":
            is_ours = line.endswith(str(path))
        elif is_ours and line.startswith("Rss:"):
            resident += 1024 * int(line.split()[1])
    return resident


# ---- a data set through its cache --------------------------------------------------------------------------------

KNOBS: dict[str, Any] = {
    "frames": 3, "stride": 2, "validation_share": 0.3, "test_share": 0.2, "workers": 0, "cache": "require",
}  # fmt: skip
IDLE = {"rule": "motion", "shortest_idle_steps": 3, "shortest_kept_steps": 4, "cut_last_steps": 1}
EVERYTHING = {
    "plain": {},
    "idle": {"idle": IDLE},
    "two cameras": {"camera": ("exterior_1_left", "wrist_left")},
    "one phase": {"start_every": 2},
    "one phase of idle": {"start_every": 2, "idle": IDLE, "camera": ("wrist_left",)},
    "one outcome": {"outcome": "success"},
    "another crop": {"crop": "square"},
}


@pytest.fixture(scope="module")
def droid_with_rests(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen episodes of 12 to 27 steps, with some standstill."""
    drawn = []
    for number in range(16):
        one = synthetic_episode(number, steps=12 + number, size=(36, 64), success=number % 3 != 2)
        still = slice(4 + number % 3, 9 + number // 4)
        poses = one.observation.cartesian_position
        poses[still] = poses[still.start]
        one.observation.gripper_position[still] = one.observation.gripper_position[still.start]
        drawn.append(one)
    return write_droid_rlds(tmp_path_factory.mktemp("droid") / "1.0.0", drawn, shards=2)


def config_of(data: Path, tmp_path: Path, **knobs: Any) -> DataConfig:
    values = {"path": str(data), "cache_dir": str(tmp_path / "caches")} | KNOBS | knobs
    return DataConfig.model_validate(values)


def cached(path: Path, tmp_path: Path, **knobs: Any) -> tuple[Dataset, Dataset]:
    """Return a data set, and the same through its cache."""
    original = open_dataset(config_of(path, tmp_path, **knobs))
    write_cache(original)
    return original, through_cache(original, NUMBERS)


def alone(through: Dataset, **knobs: Any) -> Dataset:
    """Return what a cache is without its data set, as a config that was changed in two places opens it."""
    changes = {"source": "latents", "cache": "off", "disk_cache": {"dir": f"{through.config.cache_dir}-other"}} | knobs
    config = through.config.model_dump() | changes
    return open_dataset(DataConfig.model_validate(config))


def first_batches(dataset: Dataset, count: int = 6) -> list[Batch]:
    with closing(training_loader(dataset, seed=3, batch_size=2)) as loader:
        return list(islice(loader, count))


def assert_same_clips(original: list[Batch], cached: list[Batch]) -> None:
    """The states, actions and frames of each clip are those of the original."""
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


@pytest.mark.parametrize("knobs", EVERYTHING.values(), ids=EVERYTHING)
def test_a_cache_has_the_clips_of_its_data_set_in_their_order(
    droid_with_rests: Path, tmp_path: Path, knobs: dict[str, Any]
) -> None:
    original, through = cached(droid_with_rests, tmp_path, **knobs)
    by_itself = alone(through)
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


def test_one_phase_needs_a_frame_in_every_stride(droid_with_rests: Path, tmp_path: Path) -> None:
    frames, phases = [], []
    for every in (1, 2):
        needed = list(needed_frames(open_dataset(config_of(droid_with_rests, tmp_path, start_every=every))))
        frames.append(sum(len(one.steps) for one in needed))
        phases.append({tuple(np.unique(one.steps % 2)) for one in needed})
    assert frames[1] < 0.6 * frames[0]
    assert phases[0] == {(0, 1)}
    assert phases[1] <= {(0,), (1,)}


def test_clips_start_at_multiples_of_start_every_from_the_first_kept_step() -> None:
    table = EpisodeTable.of([EpisodeInfo("a", 40), EpisodeInfo("b", 20)])
    kept = StepSelection(
        *(np.array(column, np.int32) for column in ([0, 0, 1], [3, 20, 0], [16, 31, 20])), np.ones(2, bool)
    )
    config = DataConfig(path="nowhere", frames=3, stride=2, start_every=4)
    starts = clip_starts(table, kept, config)
    found = [
        (int(starts.episode[run]), step) for run in range(len(starts.first)) for step in starts.steps_of(run).tolist()
    ]
    assert found == [(0, 3), (0, 7), (0, 11), (0, 23), (1, 0), (1, 4), (1, 8), (1, 12)]


@pytest.mark.parametrize(("when", "caught"), [("never", [0, 0]), ("once", [0, 1]), ("always", [1, 1])])
def test_frames_are_checked_as_often_as_the_config_says(
    droid_with_rests: Path, tmp_path: Path, when: str, caught: list[int]
) -> None:
    """A frame is damaged after it was read: `always` finds it, `once` does where another process reads it."""
    _, through = cached(droid_with_rests, tmp_path, check_crc=when)
    path = path_of(Path(through.config.path), 3, "exterior_1_left")
    clip_at(through, 3, 0)
    with path.open("r+b") as file:  # in place: the bytes that are mapped change, too
        file.seek(place_of(path, "latents", byte=7))
        file.write(b"\x55")
    another_process = pickle.loads(pickle.dumps(through))  # noqa: S301 - our own
    for reader, is_caught in zip((through, another_process), caught, strict=True):
        with pytest.raises(InputError, match="control step 0 is wrong") if is_caught else nullcontext():
            clip_at(reader, 3, 0)


def test_needed_frames_are_those_of_the_clips_of_all_splits(droid_with_rests: Path, tmp_path: Path) -> None:
    for knobs in EVERYTHING.values():
        dataset = open_dataset(config_of(droid_with_rests, tmp_path, **knobs))
        asked: dict[int, set[int]] = {}
        for split in ("train", "validation", "test"):
            windows = dataset.windows(split)
            for episode, start in (windows[place] for place in range(len(windows))):
                asked.setdefault(episode, set()).update(range(start, start + dataset.config.clip_steps, 2))
        found = [(one.episode, one.steps.tolist()) for one in needed_frames(dataset)]
        assert found == sorted((episode, sorted(steps)) for episode, steps in asked.items())


def test_workers_change_nothing(droid_with_rests: Path, tmp_path: Path) -> None:
    _, through = cached(droid_with_rests, tmp_path, cache_dtype="int8")
    with_two = replace(through, config=through.config.model_copy(update={"workers": 2}))
    for one, other in zip(first_batches(through, 6), first_batches(with_two, 6), strict=True):
        assert one.latents is not None
        assert other.latents is not None
        assert torch.equal(one.latents.values, other.latents.values)
        assert torch.equal(unpack_latents(one.latents), unpack_latents(other.latents))
        assert torch.equal(one.states, other.states)
        assert (one.episode_ids, one.starts) == (other.episode_ids, other.starts)


def test_the_frames_of_a_cached_clip_are_small_ones_of_the_same_frames(droid_with_rests: Path, tmp_path: Path) -> None:
    original, through = cached(droid_with_rests, tmp_path, camera=("exterior_1_left", "wrist_left"))
    for one, other in zip(first_batches(original, 4), first_batches(through, 4), strict=True):
        for row in range(2):
            large, small = frames_of(original, one, row), frames_of(through, other, row)
            assert small.shape == (3, 16, 16, 3)
            np.testing.assert_allclose(small.mean(axis=(1, 2)), large.mean(axis=(1, 2)), atol=12)


def test_vectors_and_recorded_commands_go_through_a_cache(tmp_path: Path) -> None:
    folder = write_vectors(tmp_path / "vectors", width=9, action_width=5)
    knobs = {"states": "vector", "actions": "recorded", "join_actions": "sum"}
    original, through = cached(folder, tmp_path, source="npz", **knobs)
    for other in (through, alone(through)):
        assert other.widths == original.widths == (9, 5)
        assert_same_clips(first_batches(original), first_batches(other))


@pytest.mark.parametrize("is_fixed", [False, True])
def test_poses_in_the_frame_of_the_camera_go_through_a_cache(tmp_path: Path, is_fixed: bool) -> None:
    folder = tmp_path / "poses"
    folder.mkdir()
    for number in range(8):
        states = synthetic_states(14, seed=number)
        camera = np.tile([0.5, 0.1 * number, 0.8, 0.3, -2.0, 1.0], (14, 1))
        frames = np.random.default_rng(number).integers(0, 256, (14, 20, 24, 3), dtype=np.uint8)
        np.savez(
            folder / f"{number}.npz",
            states=states,
            frames=frames,
            fps_hz=15.0,
            extrinsics=camera[0] if is_fixed else camera,
        )
    original, through = cached(folder, tmp_path, source="npz", pose_frame="camera")
    batches = first_batches(original)
    assert batches[0].extrinsics is not None
    assert_same_clips(batches, first_batches(through))
    in_base = alone(through, pose_frame="base")  # states are kept as they were measured
    base = open_dataset(config_of(folder, tmp_path, source="npz"))
    assert_same_clips(first_batches(base), first_batches(in_base))


# ---- broken episodes ---------------------------------------------------------------------------------------------


@pytest.fixture
def with_a_broken_one(tmp_path: Path) -> Dataset:
    """A hundred episodes; the frames of one cannot be read."""
    unreadable = frozenset({5})
    source = MemorySource([6] * 100, pictureless=unreadable)
    config = config_of(tmp_path, tmp_path, broken_episodes="skip", validation_share=0.1, test_share=0.1)
    table = source.infos()
    taking_part = np.ones(100, bool)
    return Dataset(config, source, table, StepSelection.whole(table, taking_part), BrokenEpisodes(config, 100))


def test_an_episode_that_could_not_be_encoded_is_left_out_as_it_was_without_a_cache(with_a_broken_one: Dataset) -> None:
    original = with_a_broken_one
    write_cache(original)
    through = replace(through_cache(original, NUMBERS), broken=BrokenEpisodes(original.config, 100))
    batches = first_batches(original, 90), first_batches(through, 90)
    assert_same_clips(*batches)
    assert {len(batch.starts) for batch in batches[1]} > {2}
    assert list(through.broken.reasons) == list(original.broken.reasons) == ["episode 5"]
    assert "could not be read when they were encoded (memory: pictures of episode 5: damaged)" in str(
        through.broken.reasons
    )


@pytest.mark.parametrize("policy", ["error", "skip"])
def test_damage_to_a_cache_is_handled_as_damage_to_the_data(with_a_broken_one: Dataset, policy: Any) -> None:
    config = with_a_broken_one.config.model_copy(update={"broken_episodes": policy})
    source = MemorySource([6] * 100)
    original = replace(with_a_broken_one, config=config, source=source, broken=BrokenEpisodes(config, 100))
    path = path_of(write_cache(original), 7, "exterior_1_left")
    sound = path.read_bytes()
    flipped(path, place_of(path, "states", byte=9))
    through = through_cache(original, NUMBERS)
    if policy == "error":
        with pytest.raises(InputError, match=r"000007.*its CRC is wrong.*data\.broken_episodes"):
            list(batches_of(through, [(6, 0), (7, 0)], batch_size=1))
    else:
        assert len(list(batches_of(through, [(6, 0), (7, 0)], batch_size=1))) == 1
        assert list(through.broken.reasons) == ["episode 7"]
    for left in (sound[:-10], None):
        path.unlink() if left is None else path.write_bytes(left)
        if policy == "error":
            with pytest.raises(InputError, match=r"000007.*episode 7\): (no such file|[\d,]+ bytes)"):
                through_cache(original, NUMBERS)
        else:
            broken = BrokenEpisodes(config, 100)
            found = through_cache(replace(original, broken=broken), NUMBERS)
            assert list(found.broken.reasons) == ["episode 7"]


# ---- what is refused ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def a_cache(droid_with_rests: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Dataset, Path]:
    """A data set, the same through its cache, and the folder of `cache_dir`; read only."""
    folder = tmp_path_factory.mktemp("cache")
    original, through = cached(droid_with_rests, folder, idle=IDLE, outcome="success")
    return original, through, folder


@pytest.mark.parametrize(
    ("knobs", "reported"),
    [
        ({"stride": 3}, r"data\.stride: 2, not 3"),
        ({"frames": 4}, r"data\.frames: 3, not 4"),
        ({"start_every": 2}, r"data\.start_every: 1, not 2"),
        ({"crop": "letterbox"}, r"data\.crop: released, not letterbox"),
        ({"idle": IDLE | {"translation_m": 0.5}}, r"data\.idle\.translation_m: 0\.001, not 0\.5"),
        ({"idle": {}}, r"data\.idle\.rule: motion, not none"),
        ({"camera": "wrist_left"}, r"data\.camera: .*exterior_1_left.*, not .*wrist_left"),
        ({"outcome": "all"}, r"no latents of \d+ of \d+ episodes.*data\.outcome"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_a_cache_of_other_clips_is_refused_and_the_difference_named(
    a_cache: tuple[Dataset, Dataset, Path], knobs: dict[str, Any], reported: str
) -> None:
    original, through, _ = a_cache
    with pytest.raises(InputError, match=reported):
        alone(through, **knobs)
    config = DataConfig.model_validate(original.config.model_dump() | knobs)
    with pytest.raises(InputError, match=reported):
        through_cache(open_dataset(config), NUMBERS)


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"encoder": "another"}, "encoder: numbers, not another"),
        ({"image_size": 32}, "image_size: 16, not 32"),
        ({"weights": "bfloat16"}, r"model\.dtype: float32, not bfloat16"),
        ({"precision": "bf16"}, r"training\.precision: fp32, not bf16"),
    ],
    ids=str,
)
def test_a_cache_of_another_encoder_is_refused_and_the_difference_named(
    a_cache: tuple[Dataset, Dataset, Path], change: dict[str, Any], reported: str
) -> None:
    original, through, _ = a_cache
    encoding = replace(NUMBERS, **change)
    with pytest.raises(
        InputError, match=f"no whole latent cache.*Other caches there: 1; .*{reported}.*vjepa2-ac encode"
    ):
        through_cache(original, encoding)
    with pytest.raises(InputError, match=reported):
        require_encoding(alone(through), encoding)
    require_encoding(alone(through), NUMBERS)
    require_encoding(original, encoding)  # no cache


def test_a_data_set_that_has_changed_has_another_cache(droid_with_rests: Path, tmp_path: Path) -> None:
    folder = tmp_path / "1.0.0"
    shutil.copytree(droid_with_rests, folder)
    original, _ = cached(folder, tmp_path)
    for shard in folder.glob("*.tfrecord*"):
        os.utime(shard, ns=(1, 1))
    with pytest.raises(InputError, match=r"data set\.episodes"):
        through_cache(open_dataset(original.config), NUMBERS)


def test_an_unfinished_or_damaged_cache_is_refused(droid_with_rests: Path, tmp_path: Path) -> None:
    original, through = cached(droid_with_rests, tmp_path, idle=IDLE)
    folder = Path(through.config.path)
    for name, place in ((EPISODES, 300), (KEPT, 300), (MANIFEST, 200)):
        flipped(folder / name, place)
        with pytest.raises(InputError, match=name):
            through_cache(original, NUMBERS)
        flipped(folder / name, place)
    reported = (folder / MANIFEST).read_text()
    (folder / MANIFEST).write_text(reported.replace(f'"{KEPT}"', '"kept.nqz"'))
    with pytest.raises(InputError, match=r"cache\.json: damaged: no checksum of kept\.npz"):
        alone(through)
    (folder / MANIFEST).write_text(reported)
    sound = (folder / EPISODES).read_bytes()
    table = EpisodeTable.from_bytes(sound)
    (folder / EPISODES).write_bytes(replace(table, num_steps=table.num_steps + 1).to_bytes())
    with pytest.raises(InputError, match=r"not the one in cache\.json"):  # sound, but not this cache's
        alone(through)
    (folder / EPISODES).write_bytes(sound)
    (folder / MANIFEST).unlink()
    with pytest.raises(InputError, match="it is unfinished"):
        through_cache(original, NUMBERS)
    with pytest.raises(InputError, match="an unfinished latent cache"):
        alone(through)
    with pytest.raises(InputError, match="no latent cache"):
        alone(through, path=str(tmp_path))


def test_a_cache_has_one_stride(a_cache: tuple[Dataset, Dataset, Path]) -> None:
    assert a_cache[1].with_stride(2).config.stride == 2
    with pytest.raises(InputError, match="at stride 2"):
        a_cache[1].with_stride(4)


@pytest.mark.parametrize(
    ("knobs", "reported"),
    [
        ({"augment": {"brightness": 0.1}, "cache": "auto"}, "augment"),
        ({"augment": {"brightness": 0.1}, "source": "latents", "cache": "off"}, "augment"),
        ({"source": "latents", "cache": "require"}, "itself a cache"),
        ({"source": "latents", "cache": "off", "path": "gs://bucket/cache"}, "on this machine"),
        ({"source": "latents", "cache": "off", "stride": "auto"}, "stride auto"),
    ],
    ids=str,
)
def test_knobs_that_contradict_a_cache_are_errors(tmp_path: Path, knobs: dict[str, Any], reported: str) -> None:
    with pytest.raises(ValidationError, match=reported):
        config_of(tmp_path, tmp_path, **knobs)


def test_off_needs_no_quotes(tmp_path: Path) -> None:
    assert config_of(tmp_path, tmp_path, cache=False).cache == "off"


def test_a_cache_can_be_checked_and_inspected(a_cache: tuple[Dataset, Dataset, Path], tmp_path: Path) -> None:
    config = alone(a_cache[1], camera=None).config
    found = {finding.about: finding for finding in check_data(config)}
    assert "latents (2, 3, 4, 8) bfloat16" in found["batch"].text
    assert "camera exterior_1_left" in found["source"].text
    assert "error" not in {finding.level for finding in found.values()}
    dataset = open_dataset(config)
    sheet = plot_dataset(inspect_dataset(dataset), tmp_path / "sheet.png", rows=2)
    assert sheet.stat().st_size > 10_000
