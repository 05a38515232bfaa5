"""Policies are ranked by the energy of their actions, unless the model ranks actions no better than chance."""

import json
from pathlib import Path

import numpy as np
import pytest

from tiny_models import tiny_model
from vjepa2_ac.api import open_dataset
from vjepa2_ac.cli import main
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.energy import ChunkScores
from vjepa2_ac.policies.score import (
    PolicyChunks,
    read_policy_chunks,
    read_run_ranking_error,
    score_policies,
)

STRIDE, EPISODES, STEPS = 2, 4, 14


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder, rng = tmp_path_factory.mktemp("npz"), np.random.default_rng(0)
    for number in range(EPISODES):
        states = np.concatenate(
            [rng.normal(0, 0.02, (STEPS, 6)).cumsum(0) * 0.3, rng.uniform(0, 1, (STEPS, 1))], axis=1
        )
        frames = rng.integers(0, 255, (STEPS, 48, 48, 3), dtype=np.uint8)
        np.savez(folder / f"episode_{number}.npz", states=states, frames=frames, fps_hz=15.0)
    return open_dataset(folder, source="npz", frames=3, stride=STRIDE, workers=0)


def make_policy(dataset: Dataset, name: str, noise: float, chunks: int = 3, steps: int = 4) -> PolicyChunks:
    """Return the demonstrated actions plus noise, as targets at control rate."""
    rng, points, proposals = np.random.default_rng(1), [], []
    for number in range(EPISODES):
        states = dataset.source.read(number).states
        for step in (0, 5, STEPS - 1):
            points.append((dataset.table.identity(number), step))
            demonstrated = states[np.minimum(step + 1 + np.arange(steps), STEPS - 1)]
            offsets = rng.normal(0, 0.02, (chunks, steps, 7))
            offsets[..., 6] = 0.0
            proposals.append(demonstrated + noise * offsets)
    return PolicyChunks(name, tuple(points), np.array(proposals))


class OracleController(Controller):
    """A controller whose energy is the distance to the true actions, which are the first chunk."""

    is_blind = False

    def score(self, frame: np.ndarray, state: np.ndarray, chunks: np.ndarray) -> ChunkScores:
        del frame, state
        distances = np.linalg.norm((chunks - chunks[:1])[..., :6], axis=(1, 2))
        zero_action_distance = float(np.linalg.norm(chunks[0, :, :6]))
        if self.is_blind:
            distances = np.random.default_rng(int(1e6 * abs(chunks[1, 0, 0]))).uniform(1, 2, len(chunks))
        return ChunkScores(distances + 0.1, zero_action_distance + 0.1, 1.0, 0)


def oracle_controller(*, is_blind: bool = False) -> Controller:
    controller = OracleController(tiny_model(), PlanningConfig())
    controller.is_blind = is_blind
    return controller


def test_policies_of_known_quality_are_ranked_correctly(dataset: Dataset) -> None:
    policies = [make_policy(dataset, name, noise) for name, noise in (("bad", 1.0), ("good", 0.05), ("fair", 0.3))]
    scores = score_policies(oracle_controller(), dataset, policies)
    assert [policy.name for policy in scores.policies] == ["good", "fair", "bad"]
    assert (scores.places, scores.episodes, scores.left_out) == (2 * EPISODES, EPISODES, EPISODES)
    assert not scores.is_blind
    assert scores.others_below_true.value == 0.0
    assert scores.policies[0].behind is None
    assert all(policy.behind.low > 0 for policy in scores.policies[1:] if policy.behind is not None)
    assert all(policy.best.value <= policy.mean.value for policy in scores.policies)
    assert scores.demonstrated.value < scores.policies[0].mean.value
    assert json.loads(json.dumps(scores.as_dict()))["is_blind"] is False


def test_model_at_chance_is_blind(dataset: Dataset) -> None:
    scores = score_policies(oracle_controller(is_blind=True), dataset, [make_policy(dataset, "one", 0.1)])
    assert scores.is_blind
    assert scores.others_below_true.low < 0.5


class RecordingController(OracleController):
    """A controller that records the chunks to score."""

    def score(self, frame: np.ndarray, state: np.ndarray, chunks: np.ndarray) -> ChunkScores:
        self.frames, self.chunks = [*getattr(self, "frames", []), frame], [*getattr(self, "chunks", []), chunks]
        return super().score(frame, state, chunks)


def test_alternative_actions_are_from_other_episodes(dataset: Dataset) -> None:
    controller, policy = RecordingController(tiny_model(), PlanningConfig()), make_policy(dataset, "policy", 0.1)
    score_policies(controller, dataset, [policy])
    episodes = [name for name, step in sorted(policy.points) if step < STEPS - 1]
    demonstrated = np.stack([chunks[0] for chunks in controller.chunks])
    assert len(demonstrated) == len(episodes) == 2 * EPISODES
    for name, chunks in zip(episodes, controller.chunks, strict=True):
        for alternative in chunks[1 : len(chunks) - 3]:
            (indices,) = np.nonzero((demonstrated == alternative).all(axis=(1, 2)))
            assert len(indices)
            assert name not in {episodes[index] for index in indices.tolist()}


def test_views_are_read_side_by_side_as_in_planning(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for number in range(3):
        views = {name: rng.integers(0, 255, (STEPS, 24, 32, 3), dtype=np.uint8) for name in ("frames", "right")}
        states = np.tile([0.4, 0.0, 0.3, 3.1, 0.0, 0.0, 0.0], (STEPS, 1))
        np.savez(tmp_path / f"{number}.npz", states=states + 0.01 * np.arange(STEPS)[:, None], fps_hz=15.0, **views)
    options = {"source": "npz", "frames": 3, "stride": STRIDE, "workers": 0}
    two_views = open_dataset(tmp_path, camera=("frames", "right"), **options)
    policy = PolicyChunks("policy", ((two_views.table.identity(1), 3),), np.zeros((1, 1, 4, 7)) + 0.4)
    controller = RecordingController(tiny_model(), PlanningConfig(views=2))
    score_policies(controller, two_views, [policy])
    expected = [two_views.source.read(1, camera).read_frames([3])[0] for camera in ("frames", "right")]
    np.testing.assert_array_equal(controller.frames[0], np.hstack(expected))
    with pytest.raises(InputError, match=r"data\.camera: frames\. Expected 2 cameras"):
        score_policies(controller, open_dataset(tmp_path, camera="frames", **options), [policy])


def test_points_missing_in_one_file_are_skipped_and_unknown_episodes_raise(dataset: Dataset) -> None:
    first, other = make_policy(dataset, "first", 0.1), make_policy(dataset, "other", 0.1)
    fewer = PolicyChunks("other", other.points[:2], other.chunks[:2])
    assert score_policies(oracle_controller(), dataset, [first, fewer]).places == 2
    with pytest.raises(InputError, match="no common evaluation point"):
        score_policies(oracle_controller(), dataset, [first, PolicyChunks("none", (("x", 0),), other.chunks[:1])])
    with pytest.raises(InputError, match="has no such episode"):
        score_policies(oracle_controller(), dataset, [PolicyChunks("none", (("x", 0),), other.chunks[:1])])


def test_policy_files_are_read_without_executing_code(tmp_path: Path) -> None:
    good = {"episodes": np.array(["a", "b"]), "frames": np.array([0, 3]), "chunks": np.zeros((2, 1, 4, 7))}
    np.savez(tmp_path / "good.npz", **good)
    policy = read_policy_chunks(tmp_path / "good.npz")
    assert (policy.name, policy.points) == ("good", (("a", 0), ("b", 3)))
    for name, change in {
        "pickled": {"episodes": np.array(["a", None], dtype=object)},
        "short": {"frames": np.array([0])},
        "flat": {"chunks": np.zeros((2, 4, 7))},
        "text": {"frames": np.array(["0", "3"])},
    }.items():
        np.savez(tmp_path / f"{name}.npz", **good | change)
        with pytest.raises(InputError, match=f"{name}.npz"):
            read_policy_chunks(tmp_path / f"{name}.npz")
    with pytest.raises(InputError, match="cannot be read"):
        read_policy_chunks(tmp_path / "absent.npz")


def test_run_ranking_error_is_read_from_its_validation(tmp_path: Path, whole_run: Path) -> None:
    error = read_run_ranking_error(str(whole_run), "step-00000006 (the newest)")
    assert error is not None
    assert 0 <= error.value <= 1
    assert read_run_ranking_error(str(tmp_path), "") is None


def test_score_command_ranks_policies(whole_run: Path, data_folder: Path, tmp_path: Path) -> None:
    dataset = open_dataset(data_folder, frames=4, stride=2, workers=0)
    chunks = dataset.source.read(0).states[1:5][None, None]
    point = {"episodes": np.array([dataset.table.identity(0)]), "frames": np.array([0])}
    np.savez(tmp_path / "one.npz", chunks=chunks, **point)
    words = ["--policy", str(tmp_path / "one.npz"), "--out", str(tmp_path / "score.json")]
    assert main(["score", str(whole_run), *words]) in {0, 1}
    scores = json.loads((tmp_path / "score.json").read_text())
    assert scores["places"] == 1
    assert scores["policies"][0]["mean"]["value"] == pytest.approx(scores["demonstrated"]["value"], rel=1e-4)
