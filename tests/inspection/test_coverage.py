"""Coverage of actions: what is varied is fit to plan with, what is not is narrow, whichever way the axes point."""

from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.inspection.check import check_data
from vjepa2_ac.inspection.coverage import PLAY, Coverage, ReadEpisode, coverage_findings, coverage_in, coverage_of
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
    return coverage_of(changes, POSE, stride)


FIT = {
    "isotropic": moving(3, 3, 3),
    "few steps": moving(3, 3, 3, steps=100),
    "flattened": moving(3, 3, 1.8),
    "leaning": moving(3, 3, 3, lift=(1, 0, 0)),
    "some stand still": np.concatenate([moving(3, 3, 3), np.zeros((100, 7))]),
}
NARROW = {
    "one way": (moving(0.2, 0.2, 0.2, lift=(3, 0, 0)), "nearly all go one way, (x +1.0, y +0.0, z +0.0)"),
    "one axis": (moving(0, 3, 0), "nearly all go back and forth along"),
    "one plane": (moving(3, 3, 0), "nearly all are in one plane, normal to"),
    "thick plane": (moving(3, 3, 0.6), "nearly all are in one plane, normal to"),
    "one half": (upwards(), "few go towards (x +0.0, y +0.0, z -1.0)"),
    "tiny": (moving(0.3, 0.3, 0.3), "90 % of the steps are at most"),
}


@pytest.mark.parametrize("changes", FIT.values(), ids=FIT)
def test_varied_motion_is_fit_to_plan_with(changes: np.ndarray) -> None:
    assert (poses(changes).narrow, poses(changes).verdict) == ("", DIVERSE)


@pytest.mark.parametrize(("changes", "reason"), NARROW.values(), ids=NARROW)
def test_motion_of_few_directions_or_tiny_is_narrow_with_the_reason_and_what_to_record(
    changes: np.ndarray, reason: str
) -> None:
    found = poses(changes)
    assert reason in found.narrow
    assert found.verdict == f"motions are not diverse enough to plan with: {found.narrow}. {PLAY}"


def test_too_few_steps_decide_nothing() -> None:
    for found in (poses(moving(3, 0, 0, steps=99)), poses(moving(3, 0, 0, steps=399), 4)):
        assert found.narrow == ""
        assert found.verdict == f"needs at least 100 consecutive moving steps, found {found.moving_steps}"
        assert {one.about: one.level for one in coverage_findings(found)} == {
            "directions": "skipped", "axes": "ok", "coverage": "skipped"
        }  # fmt: skip
    still = poses(np.zeros((5, 7)))
    assert (still.metrics["directions"], still.metrics["mean_direction"], still.narrow) == (0, 0, "")


def test_changes_are_those_over_a_stride_within_kept_ranges_in_the_frame_of_the_model() -> None:
    generator = np.random.default_rng(2)
    states = generator.uniform(-1, 1, (20, 7))
    kept = ((0, 7), (9, 12), (14, 20))
    found = np.concatenate(list(ReadEpisode(0, states, kept).changes(3, POSE)))
    pairs = [(first, first + 3) for start, end in kept for first in range(start, end - 3)]
    expected = np.array([states[b] - states[a] for a, b in pairs])
    expected[:, 3:6] = [rotation_differences(states[[a, b], 3:6])[0] for a, b in pairs]
    order = [found[:, 6].tolist().index(one) for one in expected[:, 6]]
    np.testing.assert_allclose(found[order], expected, atol=1e-12)
    assert len(found) == len(pairs)

    camera = np.tile(generator.uniform(-1, 1, 6), (20, 1))
    seen = np.concatenate(list(ReadEpisode(0, states, kept, camera).changes(3, POSE)))
    np.testing.assert_allclose(seen[:, :3], found[:, :3] @ matrices_from_euler(camera[0, 3:6]), atol=1e-9)
    moved = states_in_camera_frame(states, camera)
    np.testing.assert_allclose(seen[0, 3:6], rotation_differences(moved[[0, 3], 3:6])[0], atol=1e-9)


def test_vectors_are_narrow_where_most_numbers_hardly_move_or_go_one_way() -> None:
    def vectors(changes: np.ndarray, stride: int = 1) -> Coverage:
        return coverage_of(changes, make_vector_states(6), stride)

    free = np.random.default_rng(0).normal(size=(300, 6)) * 0.1
    assert vectors(free).verdict == DIVERSE
    held = free * [1, 1, 0, 0, 0.001, 0.001]
    found = vectors(held)
    assert (found.metrics["both_ways"], found.metrics["still"]) == ([0, 1], [2, 3, 4, 5])
    assert found.narrow == "4 of 6 numbers hardly move, 0 move only one way"
    assert vectors(np.abs(free)).narrow == "0 of 6 numbers hardly move, 6 move only one way"
    assert vectors(held, 4).narrow == "", "75 steps"
    assert found.lines["numbers"] == "2 of 6 numbers go up and down, 4 hardly move"


def written(folder: Path, *, one_way: bool) -> DataConfig:
    generator = np.random.default_rng(0)
    for number in range(10):
        states = np.tile([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.0], (50, 1))
        ways = generator.normal(size=(50, 3)) * 0.02
        states[:, :3] += np.cumsum(np.abs(ways) * [0.5, 0, 0] if one_way else ways, axis=0)
        frames = generator.integers(0, 256, (50, 16, 16, 3), dtype=np.uint8)
        np.savez(folder / f"{number}.npz", states=states, frames=frames, fps_hz=10.0)
    values = {"source": "npz", "path": str(folder), "frames": 3, "stride": 2, "test_share": 0.0, "workers": 0}
    return DataConfig.model_validate(values)


@pytest.mark.parametrize("one_way", [True, False])
def test_data_check_and_inspect_say_whether_data_are_fit_to_plan_with(tmp_path: Path, *, one_way: bool) -> None:
    config = written(tmp_path, one_way=one_way)
    found = {one.about: one for one in check_data(config, clips=4)}
    assert found["coverage"].level == found["directions"].level == ("warning" if one_way else "ok")
    assert ("nearly all go one way, (x +1.0, y +0.0, z +0.0)" in found["coverage"].text) == one_way
    written_down = inspect_dataset(open_dataset(config)).values["coverage"]
    assert written_down["narrow"].startswith("they cover 7 %" if one_way else "")
    assert bool(written_down["narrow"]) == one_way
    assert coverage_in(open_dataset(config)).metrics == written_down, "of the same episodes"


def test_data_without_a_model_step_are_skipped_with_what_they_need() -> None:
    (finding,) = coverage_findings(None)
    assert (finding.level, finding.about) == ("skipped", "coverage")
    assert "needs episodes with more consecutive steps than data.stride" in finding.text
