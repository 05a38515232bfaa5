"""A data set opened through its latents has the same clips in the same order; a wrong or damaged cache is refused."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from synthetic import synthetic_states
from vjepa2_ac.data.sources.latents.precision import CacheType, decoded, stored
from vjepa2_ac.data.sources.latents.record import Layout, Record, write_record
from vjepa2_ac.episode import Episode, EpisodeInfo

STEPS, FRAMES, TOKENS, DIM = 12, (0, 2, 5, 11), 4, 24


def episode(steps: int = STEPS) -> Episode:
    """Return an episode with everything that one can have; its pictures must not be read."""

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


def written(folder: Path, kind: CacheType = "fp32") -> tuple[Path, Layout]:
    path, layout = folder / "a" / "b.safetensors", Layout("key", kind, TOKENS, DIM)
    pictures = np.stack([np.full((16, 16, 3), 20 * step, np.uint8) for step in FRAMES])
    write_record(
        path, layout, episode(), "left", steps=FRAMES, latents=stored(drawn_latents(), kind), pictures=pictures
    )
    return path, layout


@pytest.mark.parametrize(("kind", "largest_error"), [("fp32", 0.0), ("bf16", 2**-8), ("int8", 0.5)])
def test_latents_come_back_in_the_precision_that_they_are_kept_in(
    tmp_path: Path, kind: CacheType, largest_error: float
) -> None:
    record = Record(*written(tmp_path, kind))
    found = record.latents([3, 0], check=[3, 0])
    true = drawn_latents()[[3, 0]]
    unit = {"fp32": 1.0, "bf16": true.abs(), "int8": true.abs().amax(-1, keepdim=True) / 127}[kind]
    assert decoded(found).dtype == torch.float32
    assert ((decoded(found) - true).abs() <= largest_error * unit * (1 + 1e-5)).all()
    assert (found.scales is not None) == (kind == "int8")


def test_everything_else_of_an_episode_comes_back_bit_for_bit(tmp_path: Path) -> None:
    record, true = Record(*written(tmp_path)), episode()
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
