from collections.abc import Callable

import pytest
import torch

from vjepa2_ac.model.network.world_model import WorldModel


def test_each_frame_is_encoded_by_itself(model: WorldModel, inputs) -> None:
    together = model.encode(inputs.frames)
    for time in range(4):
        alone = model.encode(inputs.frames[:, time : time + 1])
        torch.testing.assert_close(together[:, time : time + 1], alone, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("chunk", [1, 3, 100])
def test_chunks_change_nothing(model: WorldModel, inputs, chunk: int) -> None:
    torch.testing.assert_close(
        model.encode(inputs.frames, chunk=chunk), model.encode(inputs.frames), rtol=1e-5, atol=1e-5
    )


def test_latents_are_normalised(model: WorldModel, inputs) -> None:
    latents = model.encode(inputs.frames)
    torch.testing.assert_close(latents.mean(dim=-1), torch.zeros(2, 4, 9), rtol=0, atol=1e-5)
    torch.testing.assert_close(latents.var(dim=-1, correction=0), torch.ones(2, 4, 9), rtol=0, atol=1e-2)


def test_the_encoder_stays_frozen_and_in_eval_mode_while_the_model_trains(model: WorldModel, inputs) -> None:
    model.train()
    assert model.predictor.training
    assert not any(module.training for module in model.encoder.modules())
    assert not any(value.requires_grad for value in model.encoder.parameters())
    assert not model.encode(inputs.frames.requires_grad_()).requires_grad


def test_frames_of_another_size_are_refused(model: WorldModel) -> None:
    with pytest.raises(ValueError, match="64 x 64 px; this encoder needs 48 x 48 px"):
        model.encode(torch.zeros(1, 1, 3, 64, 64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_patches_are_embedded_as_the_convolution_does_it_on_a_frame_seen_twice(
    fresh: Callable[..., WorldModel], inputs, dtype: torch.dtype
) -> None:
    projection = fresh().encoder.vit.embeddings.patch_embeddings.proj
    with torch.no_grad():
        projection.weight *= 10
        projection.bias.normal_(generator=torch.Generator().manual_seed(0))
    tubelets = inputs.frames.flatten(0, 1)[:, :, None].expand(-1, -1, 2, -1, -1)
    given = (tubelets, projection.weight, projection.bias)
    exact = torch.nn.functional.conv3d(*(one.double() for one in given), stride=projection.stride)
    found = projection.to(dtype)(tubelets.to(dtype))
    assert found.shape == exact.shape
    tolerance = 1e-6 if dtype == torch.float32 else 2e-2
    assert (found - exact).abs().max() <= tolerance * exact.abs().max()
