"""The decoder's network: an image depends on the latents of its frame, on all of them, and on nothing else."""

import pytest
import torch

from vjepa2_ac.decoding.decoder import Decoder, DecoderShape
from vjepa2_ac.decoding.training import decoder_loss

SIZES = ["linear", "tiny"]


def decoder_of(size: str, seed: int = 0) -> Decoder:
    decoder = Decoder(DecoderShape(size, dim=24, grid=3, patch_size=8))  # type: ignore[arg-type]
    decoder.initialise(torch.Generator().manual_seed(seed))
    return decoder.eval()


def latents_of(*batch: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*batch, 9, 24, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("size", SIZES)
def test_an_image_depends_on_its_own_frame_alone(size: str) -> None:
    decoder, latents = decoder_of(size), latents_of(4)
    images = decoder.decode(latents)
    other = latents.clone()
    other[2] = latents_of(1, seed=2)[0]
    changed = decoder.decode(other)
    same = [torch.equal(one, two) for one, two in zip(images, changed, strict=True)]
    assert same == [True, True, False, True]


@pytest.mark.parametrize("size", SIZES)
def test_how_many_frames_are_decoded_at_once_does_not_matter(size: str) -> None:
    decoder, latents = decoder_of(size), latents_of(2, 5)
    whole = decoder.decode(latents)
    assert whole.shape == (2, 5, 3, 24, 24)
    for chunk in (1, 3, 4):
        torch.testing.assert_close(decoder.decode(latents, chunk=chunk), whole, atol=1e-5, rtol=0)
    torch.testing.assert_close(decoder.decode(latents[1, 3]), whole[1, 3], atol=1e-5, rtol=0)


def test_a_decoder_begins_as_the_linear_one() -> None:
    linear, decoder, latents = decoder_of("linear", seed=3), decoder_of("tiny"), latents_of(3)
    assert not torch.equal(decoder(latents), linear(latents))
    decoder.start_from(linear)
    assert torch.equal(decoder(latents), linear(latents))
    loss, _ = decoder_loss(decoder(latents), torch.rand(3, 3, 24, 24, generator=torch.Generator().manual_seed(4)))
    loss.backward()
    last = decoder.further[-2].weight.grad
    assert last.abs().max() > 0, "or it would remain the linear one"


def test_of_the_linear_decoder_a_patch_depends_on_its_token_alone_of_the_others_on_all() -> None:
    latents = latents_of(1)
    other = latents.clone()
    other[0, 5] += 1.0  # second row, third column
    for size in SIZES:
        decoder = decoder_of(size)
        moved = (decoder(latents) != decoder(other))[0].any(dim=0)
        inside = torch.zeros_like(moved)
        inside[8:16, 16:24] = True
        assert moved[inside].all()
        assert bool(moved[~inside].any()) == (size != "linear")


def test_the_loss_of_equal_images_is_0_and_each_part_sees_what_it_is_for() -> None:
    images = torch.rand(2, 3, 48, 48, generator=torch.Generator().manual_seed(0))
    assert float(decoder_loss(images, images)[0]) == pytest.approx(0, abs=1e-6)
    brighter = decoder_loss(images + 0.1, images)[1]
    assert float(brighter["l1"]) == pytest.approx(0.1, abs=1e-5)
    assert float(brighter["edges"]) == pytest.approx(0, abs=1e-5)
    blurred = decoder_loss(torch.nn.functional.avg_pool2d(images, 3, 1, 1), images)[1]
    assert float(blurred["structure"]) > 0.1
    assert float(blurred["edges"]) > 0.1
