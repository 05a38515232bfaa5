"""The linear decoder is the least squared error; how well decoders show frames is a mean that is a number."""

from dataclasses import dataclass

import pytest
import torch

from vjepa2_ac.decoding.frame_pairs import Pairs, fit_linear, measure_decoders
from vjepa2_ac.decoding.network import Decoder, DecoderShape
from vjepa2_ac.episode import no_progress

SHAPE = DecoderShape("tiny", dim=12, grid=2, patch_size=8)


@dataclass
class Linear:
    """Pairs whose images are linear in their latents, up to the rounding to 8 bits."""

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

    def read(self, numbers: list[int]) -> Pairs:
        return Pairs(self.latents[list(numbers)], self.images[list(numbers)], ("",) * len(numbers))


def fit(pairs: Linear) -> Decoder:
    return fit_linear(pairs, SHAPE, torch.device("cpu"), no_progress)  # type: ignore[arg-type]


def test_it_finds_a_linear_truth_up_to_rounding_and_ridge() -> None:
    pairs = Linear()
    found = fit(pairs)
    torch.testing.assert_close(found.linear.weight, pairs.truth.linear.weight, atol=2e-3, rtol=0)
    torch.testing.assert_close(found.linear.bias, pairs.truth.linear.bias, atol=2e-3, rtol=0)
    new = torch.randn(5, 4, 12, generator=torch.Generator().manual_seed(9))
    torch.testing.assert_close(found(new), pairs.truth(new).detach(), atol=2e-3, rtol=0)
    assert not found.training
    assert not any(one.requires_grad for one in found.parameters())


def test_what_latents_do_not_say_is_the_mean() -> None:
    pairs = Linear()
    pairs.latents = torch.randn(pairs.latents.shape, generator=torch.Generator().manual_seed(5))  # of other frames
    shown = fit(pairs)(pairs.latents)
    mean = pairs.images.float().mean(dim=0) / 255
    assert (shown - mean).abs().mean() < 0.25 * (pairs.images / 255.0 - mean).abs().mean()


def test_a_frame_that_is_shown_exactly_has_no_decibels_but_is_counted() -> None:
    """Its PSNR is infinite, and so would be the mean, which JSON cannot hold."""
    pairs, black = Linear(frames=9), torch.zeros(3, 16, 16)
    pairs.images[:2] = 0  # as the mean image shows them
    pairs.images[2:] = 51
    found = measure_decoders(pairs, {"decoder": pairs.truth}, black, no_progress)["mean_image"]  # type: ignore[arg-type]
    assert found["exact_frames"] == 2
    assert found["psnr_db"]["value"] == pytest.approx(13.979, abs=1e-3)  # -20 log10(51 / 255)
    assert found["ssim"]["value"] is not None
    pairs.images[:] = 0
    found = measure_decoders(pairs, {"decoder": pairs.truth}, black, no_progress)["mean_image"]  # type: ignore[arg-type]
    assert (found["exact_frames"], found["psnr_db"]["value"]) == (9, None)
