"""Action coverage: diverse motion is ok and low-diversity motion is a warning, in every orientation of the axes."""

from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.inspection.check import check_data
from vjepa2_ac.inspection.coverage import (
    PLAY,
    Coverage,
    ReadEpisode,
    coverage_findings,
    coverage_of_changes,
    measure_coverage,
)
from vjepa2_ac.inspection.statistics import inspect_dataset
from vjepa2_ac.spaces import POSE, make_vector_states, matrices_from_euler, rotation_differences, states_in_camera_frame

DIVERSE = "motions are diverse enough to plan with"


def moving(*scales: float, lift: tuple[float, ...] = (0, 0, 0), steps: int = 400, seed: int = 0) -> np.ndarray:
    """Changes of poses: normal with a standard deviation along each axis, in cm, around a mean."""
    changes = np.zeros((steps, 7))
    changes[:, :3] = (np.random.default_rng(seed).normal(size=(steps, 3)) * scales + lift) / 100
    return changes


def upwards() -> np.ndarray:
    changes = moving(3, 3, 3, steps=4000)
    changes[:, 2] = np.abs(changes[:, 2])
    return changes


def poses(changes: np.ndarray, stride: int = 1) -> Coverage:
    return coverage_of_changes(changes, POSE, stride)


DIVERSE_MOTION = {
    "isotropic": moving(3, 3, 3),
    "few steps": moving(3, 3, 3, steps=100),
    "flattened": moving(3, 3, 1.8),
    "leaning": moving(3, 3, 3, lift=(1, 0, 0)),
    "some stand still": np.concatenate([moving(3, 3, 3), np.zeros((100, 7))]),
}
LOW_DIVERSITY = {
    "one way": (
        moving(0.2, 0.2, 0.2, lift=(3, 0, 0)),
        "nearly all point in the same direction, (x +1.0, y +0.0, z +0.0)",
    ),
    "one axis": (moving(0, 3, 0), "nearly all are along one axis"),
    "one plane": (moving(3, 3, 0), "nearly all are in one plane, normal to"),
    "thick plane": (moving(3, 3, 0.6), "nearly all are in one plane, normal to"),
    "one half": (upwards(), "few point towards (x +0.0, y +0.0, z -1.0)"),
    "tiny": (moving(0.3, 0.3, 0.3), "90 % of the steps are at most"),
}


@pytest.mark.parametrize("changes", DIVERSE_MOTION.values(), ids=DIVERSE_MOTION)
def test_diverse_motion_has_no_low_diversity_reason(changes: np.ndarray) -> None:
    assert (poses(changes).low_diversity_reason, poses(changes).verdict) == ("", DIVERSE)


@pytest.mark.parametrize(("changes", "reason"), LOW_DIVERSITY.values(), ids=LOW_DIVERSITY)
def test_low_diversity_motion_gives_the_reason_and_a_fix(changes: np.ndarray, reason: str) -> None:
    coverage = poses(changes)
    assert reason in coverage.low_diversity_reason
    assert coverage.verdict == f"motions are not diverse enough to plan with: {coverage.low_diversity_reason}. {PLAY}"


def test_coverage_of_too_few_steps_is_skipped() -> None:
    for coverage in (poses(moving(3, 0, 0, steps=99)), poses(moving(3, 0, 0, steps=399), 4)):
        assert coverage.low_diversity_reason == ""
        assert coverage.verdict == f"needs at least 100 consecutive moving steps, found {coverage.moving_steps}"
        levels = {finding.about: finding.level for finding in coverage_findings(coverage)}
        assert levels == {"axes": "ok", "coverage": "skipped"}, "the reason is printed once"
    static = poses(np.zeros((5, 7)))
    assert (static.metrics["directions"], static.metrics["mean_direction"], static.low_diversity_reason) == (0, 0, "")


def test_changes_span_one_stride_within_selected_ranges_in_the_model_frame() -> None:
    generator = np.random.default_rng(2)
    states = generator.uniform(-1, 1, (20, 7))
    selected = ((0, 7), (9, 12), (14, 20))
    changes = np.concatenate(list(ReadEpisode(0, states, selected).changes(3, POSE)))
    pairs = [(first, first + 3) for start, end in selected for first in range(start, end - 3)]
    expected = np.array([states[b] - states[a] for a, b in pairs])
    expected[:, 3:6] = [rotation_differences(states[[a, b], 3:6])[0] for a, b in pairs]
    order = [changes[:, 6].tolist().index(gripper_change) for gripper_change in expected[:, 6]]
    np.testing.assert_allclose(changes[order], expected, atol=1e-12)
    assert len(changes) == len(pairs)

    camera = np.tile(generator.uniform(-1, 1, 6), (20, 1))
    observed_changes = np.concatenate(list(ReadEpisode(0, states, selected, camera).changes(3, POSE)))
    np.testing.assert_allclose(observed_changes[:, :3], changes[:, :3] @ matrices_from_euler(camera[0, 3:6]), atol=1e-9)
    moved = states_in_camera_frame(states, camera)
    np.testing.assert_allclose(observed_changes[0, 3:6], rotation_differences(moved[[0, 3], 3:6])[0], atol=1e-9)


def test_vectors_whose_numbers_hardly_change_or_only_increase_have_low_diversity() -> None:
    def vectors(changes: np.ndarray, stride: int = 1) -> Coverage:
        return coverage_of_changes(changes, make_vector_states(6), stride)

    free = np.random.default_rng(0).normal(size=(300, 6)) * 0.1
    assert vectors(free).verdict == DIVERSE
    nearly_constant = free * [1, 1, 0, 0, 0.001, 0.001]
    coverage = vectors(nearly_constant)
    assert (coverage.metrics["both_ways"], coverage.metrics["still"]) == ([0, 1], [2, 3, 4, 5])
    assert coverage.low_diversity_reason == "4 of 6 numbers hardly change, 0 change in one direction only"
    assert vectors(np.abs(free)).low_diversity_reason == "0 of 6 numbers hardly change, 6 change in one direction only"
    assert vectors(nearly_constant, 4).low_diversity_reason == "", "75 steps"
    assert coverage.lines["numbers"] == "2 of 6 numbers increase and decrease, 4 hardly change"


def write_dataset(folder: Path, *, one_way: bool) -> DataConfig:
    generator = np.random.default_rng(0)
    for number in range(10):
        states = np.tile([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.0], (50, 1))
        steps = generator.normal(size=(50, 3)) * 0.02
        states[:, :3] += np.cumsum(np.abs(steps) * [0.5, 0, 0] if one_way else steps, axis=0)
        frames = generator.integers(0, 256, (50, 16, 16, 3), dtype=np.uint8)
        np.savez(folder / f"{number}.npz", states=states, frames=frames, fps_hz=10.0)
    values = {"source": "npz", "path": str(folder), "frames": 3, "stride": 2, "test_share": 0.0, "workers": 0}
    return DataConfig.model_validate(values)


@pytest.mark.parametrize("one_way", [True, False])
def test_check_and_inspect_report_the_same_coverage(tmp_path: Path, *, one_way: bool) -> None:
    config = write_dataset(tmp_path, one_way=one_way)
    findings = {finding.about: finding for finding in check_data(config, clips=4)}
    assert findings["coverage"].level == findings["directions"].level == ("warning" if one_way else "ok")
    assert ("nearly all point in the same direction, (x +1.0, y +0.0, z +0.0)" in findings["coverage"].text) == one_way
    stored = inspect_dataset(open_dataset(config)).values["coverage"]
    assert stored["narrow"].startswith("they cover 7 %" if one_way else "")
    assert bool(stored["narrow"]) == one_way
    assert measure_coverage(open_dataset(config)).metrics == stored, "measured on the same episodes"


def test_coverage_without_a_model_step_is_skipped_with_the_need() -> None:
    (finding,) = coverage_findings(None)
    assert (finding.level, finding.about) == ("skipped", "coverage")
    assert "needs episodes with more consecutive steps than data.stride" in finding.text


def test_inspect_marks_skipped_coverage(tmp_path: Path) -> None:
    config = write_dataset(tmp_path, one_way=False).model_copy(update={"stride": 60})
    assert inspect_dataset(open_dataset(config)).summary["coverage"] == (
        "skipped: needs episodes with more consecutive steps than data.stride, found none"
    )
