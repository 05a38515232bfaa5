"""The stride of an oracle is calibration; an uncertain result is reported as uncertain."""

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
    """Return episodes in which x increases by 1 mm per step; the speed of an episode deviates by `noise`."""

    def states(index: int) -> np.ndarray:
        speed = 1 + noise * np.random.default_rng(index).normal()
        return np.pad(0.001 * speed * np.arange(lengths[index])[:, None], ((0, 0), (0, 6)))

    names = [f"track {number}" for number in range(len(lengths))]
    return MemorySource(lengths, states=states, names=names, unreadable=unreadable)


def dataset_of(source: MemorySource, **changes: object) -> Dataset:
    values = {"path": "tracks", "frames": 4, "stride": 1, "validation_share": 0.9, "test_share": 0.0, "workers": 0}
    config = DataConfig.model_validate(values | changes)
    table = source.infos()
    selection = StepSelection.all_steps(table, np.ones(len(table), bool))
    return Dataset(config, source, table, selection, BrokenEpisodes(config, len(table)))


def encode(batch: Batch) -> LatentBatch:
    """Return latents that are the x position of the robot in millimetres."""
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
    calibration = calibrated(ConstantVelocity(learned), tracks([80] * 20, noise=0.1))
    assert calibration.stride == learned
    assert calibration.is_certain
    assert "uncertain" not in calibration.verdict()


def test_ratios_equal_values_computed_by_hand() -> None:
    calibration = calibrated(ConstantVelocity(8), tracks([80] * 5), clips=10)
    assert list(calibration.results) == [4, 8, 15]
    assert [result.ratio.value for result in calibration.results.values()] == [
        pytest.approx(4 / 4, abs=1e-3), pytest.approx(0.0, abs=1e-3), pytest.approx(7 / 15, abs=1e-3),
    ]  # fmt: skip
    assert [result["stride"] for result in calibration.as_dict()["strides"]] == [4, 8, 15]
    assert calibration.best.difference is not None
    assert calibration.best.difference.value == pytest.approx(-7 / 15, abs=1e-3)


def test_all_strides_are_measured_at_the_same_starts() -> None:
    starts_by_stride: dict[int, list[tuple[str, int]]] = {}

    def record(batch: Batch) -> LatentBatch:
        stride = round(float(batch.actions[0, 0, 0]) * 1000)
        starts_by_stride.setdefault(stride, []).extend(zip(batch.episode_ids, batch.starts, strict=True))
        return encode(batch)

    source = tracks([30, 50, 60, 80, 46])
    calibrate(ConstantVelocity(4), record, dataset_of(source), ClipSample(batch_size=4, clips=12))
    assert starts_by_stride[4] == starts_by_stride[8] == starts_by_stride[15]
    assert len(set(starts_by_stride[4])) == 12
    assert "track 0" not in {episode for episode, _ in starts_by_stride[4]}, "a clip at stride 15 has 46 steps"


def test_persistence_model_has_no_significant_best_stride() -> None:
    calibration = calibrated(ConstantVelocity(0), tracks([80] * 6, noise=0.2))
    assert [result.ratio.value for result in calibration.results.values()] == [1.0, 1.0, 1.0]
    assert not calibration.is_certain
    assert "uncertain" in calibration.verdict()
    assert "The model is not better than persistence at any stride" in calibration.verdict()


def test_stride_longer_than_every_episode_is_reported_and_shorter_strides_are_measured() -> None:
    calibration = calibrated(ConstantVelocity(4), tracks([30] * 6))
    assert list(calibration.results) == [4, 8]
    assert list(calibration.impossible) == [15]
    assert "46 steps for a clip of 4 frames at stride 15" in calibration.impossible[15]


def test_stride_that_fits_one_episode_only_is_impossible() -> None:
    calibration = calibrated(ConstantVelocity(4), tracks([30] * 6 + [80] * 1))
    assert list(calibration.results) == [4, 8]
    assert "only 1 episode" in calibration.impossible[15]
    assert calibration.best.episodes >= 5


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
    calibration = calibrate(ConstantVelocity(8), encode, dataset, ClipSample(clips=200, batch_size=1))
    assert calibration.best.episodes == len(dataset.windows("validation").episodes) - 1
    assert len({result.clips for result in calibration.results.values()}) == 1
    source.unreadable = frozenset(range(20))
    with pytest.raises(InputError, match="none of the clips can be read; broken episodes: track"):
        calibrate(ConstantVelocity(8), encode, dataset, ClipSample(batch_size=4))


def test_best_variant_needs_twice_the_half_width_of_its_interval() -> None:
    """The best variant was selected on the same clips, so an interval that barely excludes 0 is no evidence."""
    result = VariantResult("one", Estimate(0.5, 0.4, 0.6), 0.2, 0.4, clips=10, episodes=10)
    narrow, wide = (replace(result, difference=Estimate(-0.1, -0.1 - half, half - 0.1)) for half in (0.03, 0.08))
    assert narrow.is_certainly_better(min_episodes=10)
    assert not wide.is_certainly_better(min_episodes=10)
    assert not narrow.is_certainly_better(min_episodes=11)
