"""Training pairs of the decoder are encoder inputs and their latents; the linear fit and the metrics are correct."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from decoders import EncodeSplit
from run_fixtures import MakeConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.transforms import crop_frames, input_to_pixels, pixels_to_input
from vjepa2_ac.decoding.decoder import Decoder, DecoderShape
from vjepa2_ac.decoding.frame_pairs import FramePairs, PairBatch, fit_linear, measure_decoders, select_frames
from vjepa2_ac.encoding.latent_cache import needed_frames
from vjepa2_ac.episode import no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints import load_base


@pytest.mark.parametrize("crop", ["released", "square"])
def test_pairs_are_encoder_inputs_and_their_latents(
    make_config: MakeConfig, encode_split: EncodeSplit, crop: str
) -> None:
    config = make_config(data__crop=crop, data__cache_dtype="fp32")
    pairs = encode_split(config, frames=20)
    dataset, model = open_dataset(config.data), load_base(config.model, seed=config.seed)
    indices = [len(pairs) - 1, 0, 7]
    batch = pairs.read(indices)
    selected = select_frames(dataset, "train", frames=20)
    steps = [(entry.episode, step) for entry in selected for step in entry.steps.tolist()]
    assert len(steps) == len(pairs)
    for index, latents, image, name in zip(indices, batch.latents, batch.images, batch.episode_ids, strict=True):
        episode, step = steps[index]
        assert name == dataset.table.identity(episode)
        frames = dataset.source.read(episode, config.data.cameras[0]).read_frames([step])
        cropped = np.ascontiguousarray(crop_frames(frames, config.data.crop))
        inputs = pixels_to_input(torch.from_numpy(cropped)[None], 32)
        assert torch.equal(image, input_to_pixels(inputs)[0, 0])
        with torch.no_grad():
            torch.testing.assert_close(latents, model.encode(inputs)[0, 0], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("frames", "split"), [(7, "train"), (30, "test"), (10_000, "train")])
def test_selected_frames_are_spread_over_the_split_up_to_the_count(
    make_config: MakeConfig, frames: int, split: str
) -> None:
    config = make_config(data__camera=["wrist_left", "exterior_1_left"])
    dataset = open_dataset(config.data)
    is_member = dataset.split_mask(split)  # type: ignore[arg-type]
    selected = select_frames(dataset, split, frames=frames)  # type: ignore[arg-type]
    needed = {(entry.episode, entry.camera): set(entry.steps.tolist()) for entry in needed_frames(dataset)}
    num_available = sum(len(steps) for (episode, _), steps in needed.items() if is_member[episode])
    assert sum(len(entry.steps) for entry in selected) == min(frames, num_available)
    assert all(is_member[entry.episode] for entry in selected)
    assert all(set(entry.steps.tolist()) <= needed[entry.episode, entry.camera] for entry in selected)
    if frames >= 30:
        assert {entry.camera for entry in selected} == {"wrist_left", "exterior_1_left"}
        assert {entry.episode for entry in selected} == set(np.flatnonzero(is_member))
        counts = [len(entry.steps) for entry in selected]
        assert max(counts) - min(counts) <= 1


def test_unencoded_episode_is_skipped_and_damaged_file_raises(
    make_config: MakeConfig, encode_split: EncodeSplit
) -> None:
    pairs = encode_split(make_config())
    missing, damaged = (Path(pairs.files.path(entry.episode, entry.camera)) for entry in pairs.frames[:2])
    missing.unlink()
    dataset = open_dataset(make_config().data)
    remaining = FramePairs.from_files(dataset, pairs.frames, pairs.files)
    assert remaining.episode_ids == pairs.episode_ids[1:]
    assert len(remaining) == len(pairs) - len(pairs.frames[0].steps)
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with pytest.raises(InputError, match=damaged.name):
        remaining.read(range(len(remaining)))


# ---- the linear decoder and the metrics ----

SHAPE = DecoderShape("tiny", dim=12, grid=2, patch_size=8)


@dataclass
class LinearPairs:
    """Pairs whose images are linear functions of their latents, up to the rounding to 8 bits."""

    frames: int = 150

    def __post_init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        self.truth = Decoder(DecoderShape("linear", SHAPE.dim, SHAPE.grid, SHAPE.patch_size))
        self.truth.initialise(generator)
        torch.nn.init.uniform_(self.truth.linear.bias, -0.5, 0.5, generator=generator)
        self.latents = torch.randn(self.frames, SHAPE.grid**2, SHAPE.dim, generator=generator)
        with torch.no_grad():
            self.images = (self.truth(self.latents) * 255).round().clamp(0, 255).byte()

    def __len__(self) -> int:
        return self.frames

    def read(self, indices: list[int]) -> PairBatch:
        return PairBatch(self.latents[list(indices)], self.images[list(indices)], ("",) * len(indices))


def fit(pairs: LinearPairs) -> Decoder:
    return fit_linear(pairs, SHAPE, torch.device("cpu"), no_progress)  # type: ignore[arg-type]


def test_linear_fit_recovers_a_linear_decoder() -> None:
    pairs = LinearPairs()
    fitted = fit(pairs)
    torch.testing.assert_close(fitted.linear.weight, pairs.truth.linear.weight, atol=2e-3, rtol=0)
    torch.testing.assert_close(fitted.linear.bias, pairs.truth.linear.bias, atol=2e-3, rtol=0)
    latents = torch.randn(5, 4, 12, generator=torch.Generator().manual_seed(9))
    torch.testing.assert_close(fitted(latents), pairs.truth(latents).detach(), atol=2e-3, rtol=0)
    assert not fitted.training
    assert not any(parameter.requires_grad for parameter in fitted.parameters())


def test_exact_frames_are_counted_and_excluded_from_psnr() -> None:
    """The PSNR of an exact frame is infinite, and JSON cannot represent an infinite mean over all frames."""
    pairs, black = LinearPairs(frames=9), torch.zeros(3, 16, 16)
    pairs.images[:2] = 0  # equal to the mean image
    pairs.images[2:] = 51
    metrics = measure_decoders(pairs, {"decoder": pairs.truth}, black, no_progress)["mean_image"]  # type: ignore[arg-type]
    assert metrics["exact_frames"] == 2
    assert metrics["psnr_db"]["value"] == pytest.approx(13.979, abs=1e-3)  # -20 log10(51 / 255)
    assert metrics["ssim"]["value"] is not None
    pairs.images[:] = 0
    metrics = measure_decoders(pairs, {"decoder": pairs.truth}, black, no_progress)["mean_image"]  # type: ignore[arg-type]
    assert (metrics["exact_frames"], metrics["psnr_db"]["value"]) == (9, None)
