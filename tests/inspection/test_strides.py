"""The stride of an oracle is found; an uncertain result is reported as uncertain."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from torch import Tensor

from memory_source import MemorySource
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.index import StepSelection
from vjepa2_ac.data.selection import BrokenEpisodes
from vjepa2_ac.episode import Batch, LatentBatch, Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.measure import ClipSample
from vjepa2_ac.inspection.variants import Calibration, VariantResult, calibrate
from vjepa2_ac.intervals import Estimate


def tracks(lengths: Sequence[int], noise: float = 0.0, unreadable: frozenset[int] = frozenset()) -> MemorySource:
    """Return episodes in which x grows by 1 mm a step, plus `noise`."""

    def states(index: int) -> np.ndarray:
        speed = 1 + noise * np.random.default_rng(index).normal()
        return np.pad(0.001 * speed * np.arange(lengths[index])[:, None], ((0, 0), (0, 6)))

    names = [f"track {number}" for number in range(len(lengths))]
    return MemorySource(lengths, states=states, names=names, unreadable=unreadable)


def dataset_of(source: MemorySource, **changes: object) -> Dataset:
    values = {"path": "tracks", "frames": 4, "stride": 1, "validation_share": 0.9, "test_share": 0.0, "workers": 0}
    config = DataConfig.model_validate(values | changes)
    table = source.infos()
    kept = StepSelection.all_steps(table, np.ones(len(table), bool))
    return Dataset(config, source, table, kept, BrokenEpisodes(config, len(table)))


def encode(batch: Batch) -> LatentBatch:
    """The latent of a frame is where the robot is, in millimetres."""
    return LatentBatch(
        latents=batch.states[:, :, None, :1] * 1000,
        states=batch.states,
        actions=batch.actions,
        extrinsics=None,
        episode_ids=batch.episode_ids,
        starts=batch.starts,
    )


class ConstantVelocity:
    """Predicts that the robot moves by `millimetres` from each frame to the next."""

    def __init__(self, millimetres: float) -> None:
        self.millimetres = millimetres

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        del actions, states, extrinsics
        return latents + self.millimetres

    def rollout(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        del latents, actions, states, extrinsics
        raise AssertionError("calibration needs no rollout")


def calibrated(
    model: ConstantVelocity, source: MemorySource, progress: Progress = no_progress, **options: object
) -> Calibration:
    sample = ClipSample(batch_size=4, **options)  # type: ignore[arg-type]
    return calibrate(model, encode, dataset_of(source), sample, progress=progress)


@pytest.mark.parametrize("learned", [4, 8, 15])
def test_calibration_recovers_the_stride_of_the_training(learned: int) -> None:
    found = calibrated(ConstantVelocity(learned), tracks([80] * 20, noise=0.1))
    assert found.stride == learned
    assert found.is_certain
    assert "not significant" not in found.verdict()


def test_ratios_equal_values_computed_by_hand() -> None:
    found = calibrated(ConstantVelocity(8), tracks([80] * 5), clips=10)
    assert list(found.results) == [4, 8, 15]
    assert [one.ratio.value for one in found.results.values()] == [
        pytest.approx(4 / 4, abs=1e-3), pytest.approx(0.0, abs=1e-3), pytest.approx(7 / 15, abs=1e-3),
    ]  # fmt: skip
    assert [one["stride"] for one in found.as_dict()["strides"]] == [4, 8, 15]
    assert found.best.difference is not None
    assert found.best.difference.value == pytest.approx(-7 / 15, abs=1e-3)


def test_all_strides_are_measured_at_the_same_starts() -> None:
    seen: dict[int, list[tuple[str, int]]] = {}

    def noting(batch: Batch) -> LatentBatch:
        stride = round(float(batch.actions[0, 0, 0]) * 1000)
        seen.setdefault(stride, []).extend(zip(batch.episode_ids, batch.starts, strict=True))
        return encode(batch)

    source = tracks([30, 50, 60, 80, 46])
    calibrate(ConstantVelocity(4), noting, dataset_of(source), ClipSample(batch_size=4, clips=12))
    assert seen[4] == seen[8] == seen[15]
    assert len(set(seen[4])) == 12
    assert "track 0" not in {episode for episode, _ in seen[4]}, "a clip at stride 15 has 46 steps"


def test_persistence_model_has_no_significant_best_stride() -> None:
    found = calibrated(ConstantVelocity(0), tracks([80] * 6, noise=0.2))
    assert [one.ratio.value for one in found.results.values()] == [1.0, 1.0, 1.0]
    assert not found.is_certain
    assert "not significant" in found.verdict()
    assert "The model is not better than persistence at any stride" in found.verdict()


def test_stride_longer_than_every_episode_is_reported_and_the_others_are_measured() -> None:
    found = calibrated(ConstantVelocity(4), tracks([30] * 6))
    assert list(found.results) == [4, 8]
    assert list(found.impossible) == [15]
    assert "46 steps for a clip of 4 frames at stride 15" in found.impossible[15]


def test_stride_that_fits_one_episode_only_is_impossible() -> None:
    found = calibrated(ConstantVelocity(4), tracks([30] * 6 + [80] * 1))
    assert list(found.results) == [4, 8]
    assert "only 1 episode" in found.impossible[15]
    assert found.best.episodes >= 5


def test_clips_have_at_most_eight_frames_by_default() -> None:
    source = tracks([130] * 4)
    assert calibrate(ConstantVelocity(4), encode, dataset_of(source, frames=16), ClipSample()).frames == 8
    assert calibrate(ConstantVelocity(4), encode, dataset_of(source), ClipSample()).frames == 4


def test_unreadable_clips_are_skipped_and_an_error_if_no_clip_is_readable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vjepa2_ac.data.selection.max_broken", lambda episodes: episodes)
    monkeypatch.setattr(Dataset, "control_rate_hz", 15.0)
    source = tracks([80] * 20)
    dataset = dataset_of(source, broken_episodes="skip")
    source.unreadable = frozenset({int(dataset.windows("validation").episodes[0])})
    found = calibrate(ConstantVelocity(8), encode, dataset, ClipSample(clips=200, batch_size=1))
    assert found.best.episodes == len(dataset.windows("validation").episodes) - 1
    assert len({one.clips for one in found.results.values()}) == 1
    source.unreadable = frozenset(range(20))
    with pytest.raises(InputError, match="none of the clips can be read; broken episodes: track"):
        calibrate(ConstantVelocity(8), encode, dataset, ClipSample(batch_size=4))


def test_best_variant_needs_twice_the_half_width_of_its_interval() -> None:
    """Both were chosen on these clips: an interval that just leaves 0 out says little."""
    result = VariantResult("one", Estimate(0.5, 0.4, 0.6), 0.2, 0.4, clips=10, episodes=10)
    narrow, wide = (replace(result, difference=Estimate(-0.1, -0.1 - half, half - 0.1)) for half in (0.03, 0.08))
    assert narrow.is_certainly_better(min_episodes=10)
    assert not wide.is_certainly_better(min_episodes=10)
    assert not narrow.is_certainly_better(min_episodes=11)
