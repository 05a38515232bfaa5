"""The encoding pipeline: each frame is read once, and an unreachable source is not a broken episode."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from memory_source import MemorySource
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data import dataset
from vjepa2_ac.data.sources.latent_files import LatentFiles, unpack_latents
from vjepa2_ac.encoding.latent_cache import FRAMES_AT_ONCE, EncoderOnDevice, FramesToEncode, encode_files
from vjepa2_ac.errors import UnreachableError

LENGTHS = [FRAMES_AT_ONCE + 1, 3, 2 * FRAMES_AT_ONCE]
Run = Callable[..., LatentFiles]


def colours(inputs: torch.Tensor, chunk: int) -> torch.Tensor:
    """Return latents of one token: the frame's colour, which encodes episode and step."""
    del chunk
    return inputs[..., 2, 2][..., None, :]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Return a function that encodes every step of a source."""

    def encode(source: MemorySource) -> LatentFiles:
        monkeypatch.setattr(dataset, "open_source", lambda _: source)
        config = DataConfig(path="memory", crop="letterbox", workers=2, broken_episodes="skip", cache_dtype="int8")
        steps = [np.arange(length, dtype=np.int32) for length in source.lengths]
        requests = [FramesToEncode(index, "left", steps[index]) for index in range(len(steps))]
        model = SimpleNamespace(image_size=5, encode=colours)
        encoder = EncoderOnDevice(model, torch.device("cpu"), nullcontext, chunk=7)  # type: ignore[arg-type]
        files = LatentFiles(tmp_path, "key")
        encode_files(dataset.open_dataset(config), requests, encoder, files)
        return files

    return encode


def test_pipeline_reads_each_frame_of_each_episode_once(run: Run) -> None:
    source = MemorySource(LENGTHS)
    files = run(source)
    assert sorted(source.decoded) == [(index, step) for index, length in enumerate(LENGTHS) for step in range(length)]
    assert sorted(index for index, _, _ in source.reads) == [0, 1, 2]
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    for index, length in enumerate(LENGTHS):
        file = files.open(index, "left")
        assert file.frame_steps.tolist() == list(range(length))
        pixels = 255 * (unpack_latents(file.read_latents(range(length)))[:, 0] * std + mean)
        expected = np.stack([np.full(length, index), np.arange(length)], axis=1)
        np.testing.assert_allclose(pixels[:, :2].numpy(), expected, atol=0.6)


def test_network_failure_does_not_mark_an_episode_broken(run: Run, tmp_path: Path) -> None:
    unreachable = MemorySource(
        [2], unreadable=frozenset({0}), fault=lambda where: UnreachableError(where=where, found="gone")
    )
    with pytest.raises(UnreachableError):
        run(unreachable)
    assert not list(tmp_path.rglob("*.broken"))
