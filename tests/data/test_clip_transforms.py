"""Transforms of training clips: pure functions of seed and position whose results are checked and never cached."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clip_transforms import TRANSFORMS as EXAMPLES
from clips import open_memory_source
from memory_source import MemorySource
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import training_loader, validation_batches
from vjepa2_ac.encoding.encode_dataset import require_encodable
from vjepa2_ac.episode import Clip
from vjepa2_ac.errors import InputError
from vjepa2_ac.registry import TRANSFORMS


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    transforms = dict(EXAMPLES)
    monkeypatch.setattr(TRANSFORMS, "_things", transforms)
    return transforms


def open_set(*transforms: dict[str, Any], **keys: Any) -> Dataset:
    return open_memory_source(MemorySource([30] * 10), transforms=transforms, **keys)


def frames(dataset: Dataset, count: int, seed: int = 1, **keys: Any) -> torch.Tensor:
    batches = training_loader(dataset, seed=seed, batch_size=2, **keys)
    return torch.cat([batch.frames for batch in itertools.islice(batches, count)])


OFFSET = {"name": "offset"}


def test_transforms_depend_on_seed_and_position_and_apply_to_training_clips_only() -> None:
    dataset = open_set(OFFSET, validation_share=0.5)
    plain = open_set(validation_share=0.5)
    offsets = (frames(dataset, 20) - frames(plain, 20))[:, 0, 0, 0]
    assert torch.equal(offsets[:, 0], offsets[:, 1])  # one random number per clip
    assert 10 < len(set(offsets[:, 0].tolist())) <= 40
    assert torch.equal(frames(dataset, 20), frames(dataset, 20))
    offsets_of_seed_2 = (frames(dataset, 20, seed=2) - frames(plain, 20, seed=2))[:, 0, 0, 0]
    assert not torch.equal(offsets_of_seed_2, offsets)
    transformed, untransformed = (
        torch.cat([batch.frames for batch in validation_batches(data, "validation", clips=4, batch_size=2)])
        for data in (dataset, plain)
    )
    assert torch.equal(transformed, untransformed)
    np.testing.assert_array_equal(dataset.clips()[3].frames, plain.clips()[3].frames)


def test_transforms_are_identical_after_resume_and_in_workers(droid: Path) -> None:
    data = {"path": droid, "frames": 3, "stride": 2, "transforms": [OFFSET, {"name": "halve"}]}

    def read(count: int, start: int = 0, workers: int = 0) -> torch.Tensor:
        config = parse_config(values(**data, workers=workers), where="").data
        return frames(open_dataset(config), count, start_position=start)

    uninterrupted = read(12)
    assert torch.equal(read(4, 16), uninterrupted[16:])
    assert torch.equal(read(12, workers=2), uninterrupted)
    assert torch.equal(read(4, 16, workers=1), uninterrupted[16:])


def test_transforms_run_in_config_order_with_independent_random_numbers() -> None:
    plain, offset = frames(open_set(), 8), frames(open_set(OFFSET), 8)
    assert torch.equal(frames(open_set(OFFSET, {"name": "halve"}), 8), offset // 2)
    assert not torch.equal(frames(open_set({"name": "halve"}, OFFSET), 8), offset // 2)
    assert not torch.equal(frames(open_set(OFFSET, OFFSET), 8) - offset, offset - plain)


def test_transform_options_are_passed_to_the_class_and_validated() -> None:
    offset_by_one = open_set({"name": "offset", "options": {"most": 2}})
    assert torch.equal(frames(offset_by_one, 4), frames(open_set(), 4) + 1)
    for transform, words in (
        ({"name": "offset", "options": {"mots": 2}}, "mots"),
        ({"name": "halve", "options": {"most": 2}}, "no options of its own"),
        ({"name": "halved"}, "Did you mean halve"),
        ({"options": {}}, "a name, or {name: NAME"),
    ):
        with pytest.raises(InputError, match=words):
            parse_config(values(transforms=[transform]), where="")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda clip: clip.frames, "frames of object"),
        (lambda _: None, "frames of object"),
        (
            lambda clip: replace(clip, frames=clip.frames / 255),
            "frames of float64, 3 x height x width x 3.*uint8",
        ),
        (lambda clip: replace(clip, frames=clip.frames[:2]), "frames of uint8, 2 x height"),
        (lambda clip: replace(clip, frames=clip.frames[..., :1]), r"width x 1\."),
        (
            lambda clip: replace(clip, states=clip.states[:, :6]),
            "states of float32, 3 x 6. Expected states of float32, 3 x 7",
        ),
        (lambda clip: replace(clip, actions=clip.actions.astype(float)), "actions of float64"),
    ],
)
@pytest.mark.parametrize("policy", ["error", "skip"])
def test_invalid_transform_result_raises_without_marking_an_episode_broken(
    registered: dict[str, Any], change: Callable[[Clip], Any], words: str, policy: str
) -> None:
    registered["wrong"] = lambda clip, _: change(clip)
    dataset = open_set({"name": "wrong"}, broken_episodes=policy)
    with pytest.raises(InputError, match=f"data.transforms: wrong: .*({words})") as caught:
        frames(dataset, 1)
    assert "exclude" not in str(caught.value)
    assert not len(dataset.broken)


def values(**data: Any) -> dict[str, Any]:
    return {"run_dir": "run", "data": {"path": "data", **data}, "model": {"base": "builtin:sim-tiny"}}


@pytest.mark.parametrize("data", [{"cache": "auto"}, {"cache": "require"}, {"source": "latents"}])
def test_transforms_on_cached_latents_raise(data: dict[str, str]) -> None:
    with pytest.raises(InputError, match="transforms change frames, but not cached latents"):
        parse_config(values(transforms=[{"name": "halve"}], **data), where="")
    parse_config(values(transforms=[], **data), where="")
    with pytest.raises(InputError, match=r"data\.transforms: .*Remove data\.transforms"):
        require_encodable(parse_config(values(transforms=[{"name": "halve"}]), where=""))
