"""Batches: augmentation is applied before encoding."""

from dataclasses import replace

import torch

from vjepa2_ac.config import ModelSizes
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Augmentation, Batch, LatentBatch
from vjepa2_ac.model.network.world_model import WorldModel

TINY = {
    "image_size": 32,
    "encoder": {"width": 24, "depth": 1, "heads": 2},
    "predictor": {"width": 24, "depth": 1, "heads": 2},
}


def batch(frames: torch.Tensor, *augmentations: Augmentation) -> Batch:
    clips, time = frames.shape[:2]
    return Batch(
        frames=frames,
        states=torch.zeros(clips, time, 7),
        actions=torch.zeros(clips, time - 1, 7),
        extrinsics=None,
        episode_ids=tuple("ab"[:clips]),
        starts=(0,) * clips,
        augmentations=augmentations,
    )


def test_an_augmented_batch_gives_the_latents_of_the_cropped_frames() -> None:
    model = WorldModel.random(ModelSizes.model_validate(TINY), seed=0)
    frames = torch.randint(0, 256, (2, 2, 40, 50, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))

    def latents(of: Batch) -> torch.Tensor:
        return encode_batch(model, of, device=torch.device("cpu"), chunk=4).latents

    whole, part = Augmentation((0, 0, 40, 50)), Augmentation((4, 6, 30, 36))
    found = latents(batch(frames, part, whole))
    torch.testing.assert_close(found[:1], latents(batch(frames[:1, :, 4:34, 6:42])))
    torch.testing.assert_close(found[1:], latents(batch(frames))[1:])
    assert not torch.allclose(found[0], latents(batch(frames))[0], atol=1e-3)


def test_what_is_on_its_way_to_the_device_is_taken_from_there() -> None:
    model = WorldModel.random(ModelSizes.model_validate(TINY), seed=0)
    given = batch(torch.randint(0, 256, (2, 2, 40, 50, 3), dtype=torch.uint8))
    there = given.mapped(lambda tensor: tensor + 1)
    held = [there]
    ahead = replace(given, on_device=lambda: held.pop() if held else None)

    def encoded(of: Batch) -> LatentBatch:
        return encode_batch(model, of, device=torch.device("cpu"), chunk=4)

    for expected in (encoded(there), encoded(given)):  # taken once; then the batch itself is copied
        found = encoded(ahead)
        assert torch.equal(found.latents, expected.latents)
        assert torch.equal(found.states, expected.states)
        assert torch.equal(found.actions, expected.actions)
