"""Frames and latents of the decoder: what the encoder saw, each encoded once, of the right episodes."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from decoders import EncodeSplit
from run_fixtures import MakeConfig
from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.transforms import input_to_pixels, pixels_to_input, view
from vjepa2_ac.decoding import frame_pairs
from vjepa2_ac.decoding.frame_pairs import as_images, as_pixels, require_space_for_pairs, wanted_frames
from vjepa2_ac.encoding.cache_lookup import needed_frames
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.loading import load_base


def test_the_image_is_the_encoder_input_up_to_rounding() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (2, 48, 48, 3), dtype=np.uint8)
    same = input_to_pixels(pixels_to_input(torch.from_numpy(frames)[None], 48))[0]
    np.testing.assert_array_equal(same.permute(0, 2, 3, 1).numpy(), frames)
    inputs = pixels_to_input(torch.from_numpy(frames)[None], 32)
    again = input_to_pixels(inputs)
    back = pixels_to_input(again[0].permute(0, 2, 3, 1)[None], 32)
    assert (back - inputs).abs().max() <= 0.5 / (0.224 * 255) * 1.001


def test_images_and_pixels_are_inverse() -> None:
    pixels = torch.arange(256, dtype=torch.uint8).repeat(3, 1).reshape(1, 3, 16, 16)
    np.testing.assert_array_equal(as_pixels(as_images(pixels)), pixels.permute(0, 2, 3, 1).numpy())
    assert as_pixels(torch.tensor([-0.5, 1.5, 0.5]).reshape(1, 3, 1, 1)).flatten().tolist() == [0, 255, 128]


@pytest.mark.parametrize("crop", ["released", "square"])
def test_pairs_are_what_the_encoder_saw_and_what_it_gave(
    make_config: MakeConfig, encode_split: EncodeSplit, crop: str
) -> None:
    config = make_config(data__crop=crop, data__cache_dtype="fp32", model__encode_chunk=3)
    pairs = encode_split(config, frames=20)
    dataset, model = open_dataset(config.data), load_base(config.model, seed=config.seed)
    numbers = [len(pairs) - 1, 0, 7]
    read, place = pairs.read(numbers), 0
    places = {}
    for one in wanted_frames(dataset, "train", frames=20):
        for step in one.steps.tolist():
            places[place] = (one.episode, step)
            place += 1
    assert place == len(pairs)
    for number, latents, image, name in zip(numbers, read.latents, read.images, read.episode_ids, strict=True):
        episode, step = places[number]
        assert name == dataset.table.identity(episode)
        seen = view(dataset.source.read(episode, config.data.cameras[0]).read_frames([step]), config.data.crop)
        inputs = pixels_to_input(torch.from_numpy(np.ascontiguousarray(seen))[None], 32)
        assert torch.equal(image, input_to_pixels(inputs)[0, 0])
        with torch.no_grad():
            torch.testing.assert_close(latents, model.encode(inputs)[0, 0], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("kind", "most"), [("fp32", 0.0), ("bf16", 2**-8), ("int8", 1 / 127)])
def test_each_storage_type_is_as_exact_as_it_says(
    make_config: MakeConfig, encode_split: EncodeSplit, kind: str, most: float
) -> None:
    exact = encode_split(make_config(data__cache_dtype="fp32"), frames=12, folder="exact").read(range(12))
    pairs = encode_split(make_config(data__cache_dtype=kind), frames=12, folder=kind).read(range(12))
    assert pairs.latents.dtype == torch.float32
    error = (pairs.latents - exact.latents).abs()
    assert (error <= most * exact.latents.abs().amax(dim=-1, keepdim=True)).all()
    assert bool(error.max() > 0) == (kind != "fp32")
    assert torch.equal(pairs.images, exact.images)


def test_frames_are_encoded_once(make_config: MakeConfig, encode_split: EncodeSplit, encoded_frames: list[int]) -> None:
    config = make_config()
    first = encode_split(config)
    assert sum(encoded_frames) == len(first) <= 40
    encoded_frames.clear()
    again = encode_split(config)
    assert not encoded_frames
    assert torch.equal(again.read(range(40)).latents, first.read(range(40)).latents)
    again.files[1].path.unlink()
    encode_split(config)
    assert sum(encoded_frames) == again.files[1].frames, "only what is missing"


@pytest.mark.parametrize("frames", [1, 7, 30, 10_000])
@pytest.mark.parametrize("split", ["train", "test"])
def test_frames_are_of_the_split_at_most_as_many_as_asked_and_spread(
    make_config: MakeConfig, frames: int, split: str
) -> None:
    config = make_config(data__camera=["wrist_left", "exterior_1_left"])
    dataset = open_dataset(config.data)
    members = dataset.members(split)  # type: ignore[arg-type]
    wanted = wanted_frames(dataset, split, frames=frames)  # type: ignore[arg-type]
    needed = {one.episode: set(one.steps.tolist()) for one in needed_frames(dataset)}
    there = 2 * sum(len(steps) for episode, steps in needed.items() if members[episode])
    assert sum(len(one.steps) for one in wanted) == min(frames, there)
    assert all(members[one.episode] for one in wanted)
    assert all(set(one.steps.tolist()) <= needed[one.episode] for one in wanted)
    if frames >= 30:
        assert {one.camera for one in wanted} == {"wrist_left", "exterior_1_left"}
        assert {one.episode for one in wanted} == set(np.flatnonzero(members))
        counts = [len(one.steps) for one in wanted]
        assert max(counts) - min(counts) <= 1


def test_a_split_without_clips_has_no_frames(make_config: MakeConfig) -> None:
    dataset = open_dataset(make_config(data__test_share=0.0).data)
    assert wanted_frames(dataset, "test", frames=9) == []


def test_a_disk_that_is_too_small_is_refused_and_what_is_there_counts(
    make_config: MakeConfig, encode_split: EncodeSplit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = make_config()
    wanted = wanted_frames(open_dataset(config.data), "train", frames=40)
    sizes = {"tokens": 4, "dim": 24, "image_size": 32, "kind": "bf16"}
    expected = 40 * (4 * 24 * 2 + 3 * 32**2)
    assert require_space_for_pairs(wanted, tmp_path / "pairs", **sizes) == expected  # type: ignore[arg-type]
    monkeypatch.setattr(frame_pairs, "free_bytes", lambda _: expected - 1)
    with pytest.raises(InputError, match=r"GB free on its disk.*decoder\.frames"):
        require_space_for_pairs(wanted, tmp_path / "pairs", **sizes)  # type: ignore[arg-type]
    encode_split(config)
    left = require_space_for_pairs(wanted, tmp_path / "pairs", **sizes)  # type: ignore[arg-type]
    assert left == 0, "encoded already"


def broken(monkeypatch: pytest.MonkeyPatch, config: Config) -> str:
    """Break the last frames of a training episode; return its name."""
    from vjepa2_ac.data import selection as broken_episodes
    from vjepa2_ac.data.sources.rlds.source import RldsSource

    dataset, read = open_dataset(config.data), RldsSource.read
    bad = wanted_frames(dataset, "train", frames=40)[1].episode

    def reading(source: RldsSource, index: int, *more: object) -> object:
        episode = read(source, index, *more)
        if index != bad:
            return episode

        def frames(steps: list[int]) -> np.ndarray:
            raise InputError(where=episode.info.id, found=f"a damaged JPEG at step {steps[0]}")

        return type(episode)(**{**vars(episode), "read_frames": frames})

    monkeypatch.setattr(RldsSource, "read", reading)
    monkeypatch.setattr(broken_episodes, "MOST_BROKEN", 0.2)
    return dataset.table.identity(bad)


def test_a_broken_episode_is_left_out_if_the_policy_says_so(
    make_config: MakeConfig, encode_split: EncodeSplit, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = make_config(data__broken_episodes="skip")
    names = {file.episode_id for file in encode_split(config, folder="all").files}
    bad = broken(monkeypatch, config)
    assert {file.episode_id for file in encode_split(config).files} == names - {bad}
    with pytest.raises(InputError, match="damaged JPEG"):
        encode_split(make_config(data__broken_episodes="error"), folder="strict")


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize("damage", [Path.unlink, truncated, lambda path: path.write_bytes(b"no tensors")])
def test_a_damaged_file_is_named_with_the_way_out(
    make_config: MakeConfig, encode_split: EncodeSplit, damage: Callable[[Path], None]
) -> None:
    pairs = encode_split(make_config())
    damage(pairs.files[1].path)
    with pytest.raises(InputError, match=re.escape(pairs.files[1].path.name)) as caught:
        pairs.read(range(len(pairs)))
    assert "encodes it again" in str(caught.value)
    assert len(pairs.read([0]).latents) == 1
