"""Frames and latents of the decoder: what the encoder saw, each encoded once, of the right episodes."""

import numpy as np
import pytest
import torch

from decoders import EncodeSplit
from run_fixtures import MakeConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.transforms import input_to_pixels, pixels_to_input, view
from vjepa2_ac.decoding.frame_pairs import FramePairs, wanted_frames
from vjepa2_ac.decoding.network import as_images, as_pixels
from vjepa2_ac.encoding.latent_cache import needed_frames
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


@pytest.mark.parametrize("frames", [1, 7, 30, 10_000])
@pytest.mark.parametrize("split", ["train", "test"])
def test_frames_are_of_the_split_at_most_as_many_as_asked_and_spread(
    make_config: MakeConfig, frames: int, split: str
) -> None:
    config = make_config(data__camera=["wrist_left", "exterior_1_left"])
    dataset = open_dataset(config.data)
    members = dataset.members(split)  # type: ignore[arg-type]
    wanted = wanted_frames(dataset, split, frames=frames)  # type: ignore[arg-type]
    needed = {(one.episode, one.camera): set(one.steps.tolist()) for one in needed_frames(dataset)}
    there = sum(len(steps) for (episode, _), steps in needed.items() if members[episode])
    assert sum(len(one.steps) for one in wanted) == min(frames, there)
    assert all(members[one.episode] for one in wanted)
    assert all(set(one.steps.tolist()) <= needed[one.episode, one.camera] for one in wanted)
    if frames >= 30:
        assert {one.camera for one in wanted} == {"wrist_left", "exterior_1_left"}
        assert {one.episode for one in wanted} == set(np.flatnonzero(members))
        counts = [len(one.steps) for one in wanted]
        assert max(counts) - min(counts) <= 1


def test_an_episode_that_could_not_be_encoded_is_left_out_and_a_damaged_file_is_named(
    make_config: MakeConfig, encode_split: EncodeSplit
) -> None:
    pairs = encode_split(make_config())
    gone, damaged = (pairs.files.path(one.episode, one.camera) for one in pairs.frames[:2])
    gone.unlink()
    dataset = open_dataset(make_config().data)
    rest = FramePairs.of(dataset, pairs.frames, pairs.files)
    assert rest.episode_ids == pairs.episode_ids[1:]
    assert len(rest) == len(pairs) - len(pairs.frames[0].steps)
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with pytest.raises(InputError, match=damaged.name):
        rest.read(range(len(rest)))
