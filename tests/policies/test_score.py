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


def policy(dataset: Dataset, name: str, noise: float, chunks: int = 3, steps: int = 4) -> PolicyChunks:
    """Return the demonstrated actions plus noise, as targets at control rate."""
    rng, places, found = np.random.default_rng(1), [], []
    for number in range(EPISODES):
        states = dataset.source.read(number).states
        for step in (0, 5, STEPS - 1):
            places.append((dataset.table.identity(number), step))
            true = states[np.minimum(step + 1 + np.arange(steps), STEPS - 1)]
            off = rng.normal(0, 0.02, (chunks, steps, 7))
            off[..., 6] = 0.0
            found.append(true + noise * off)
    return PolicyChunks(name, tuple(places), np.array(found))


class OracleController(Controller):
    """A controller whose energy is the distance to the true actions, which are the first chunk."""

    is_blind = False

    def score(self, frame: np.ndarray, state: np.ndarray, chunks: np.ndarray) -> ChunkScores:
        del frame, state
        far = np.linalg.norm((chunks - chunks[:1])[..., :6], axis=(1, 2))
        still = float(np.linalg.norm(chunks[0, :, :6]))
        if self.is_blind:
            far = np.random.default_rng(int(1e6 * abs(chunks[1, 0, 0]))).uniform(1, 2, len(chunks))
        return ChunkScores(far + 0.1, still + 0.1, 1.0, 0)


def oracle_controller(*, blind: bool = False) -> Controller:
    run = OracleController(tiny_model(), PlanningConfig())
    run.is_blind = blind
    return run


def test_policies_of_known_quality_are_ranked_correctly(dataset: Dataset) -> None:
    policies = [policy(dataset, name, noise) for name, noise in (("bad", 1.0), ("good", 0.05), ("fair", 0.3))]
    found = score_policies(oracle_controller(), dataset, policies)
    assert [one.name for one in found.policies] == ["good", "fair", "bad"]
    assert (found.places, found.episodes, found.left_out) == (2 * EPISODES, EPISODES, EPISODES)
    assert not found.is_blind
    assert found.others_below_true.value == 0.0
    assert found.policies[0].behind is None
    assert all(one.behind.low > 0 for one in found.policies[1:] if one.behind is not None)
    assert all(one.best.value <= one.mean.value for one in found.policies)
    assert found.demonstrated.value < found.policies[0].mean.value
    assert json.loads(json.dumps(found.as_dict()))["is_blind"] is False


def test_model_at_chance_is_blind(dataset: Dataset) -> None:
    found = score_policies(oracle_controller(blind=True), dataset, [policy(dataset, "one", 0.1)])
    assert found.is_blind
    assert found.others_below_true.low < 0.5


class RecordingController(OracleController):
    """A controller that records the chunks to score."""

    def score(self, frame: np.ndarray, state: np.ndarray, chunks: np.ndarray) -> ChunkScores:
        self.frames, self.chunks = [*getattr(self, "frames", []), frame], [*getattr(self, "chunks", []), chunks]
        return super().score(frame, state, chunks)


def test_alternative_actions_are_from_other_episodes(dataset: Dataset) -> None:
    run, one = RecordingController(tiny_model(), PlanningConfig()), policy(dataset, "one", 0.1)
    score_policies(run, dataset, [one])
    episodes = [name for name, step in sorted(one.points) if step < STEPS - 1]
    true = np.stack([chunks[0] for chunks in run.chunks])
    assert len(true) == len(episodes) == 2 * EPISODES
    for name, chunks in zip(episodes, run.chunks, strict=True):
        for other in chunks[1 : len(chunks) - 3]:
            (places,) = np.nonzero((true == other).all(axis=(1, 2)))
            assert {episodes[place] for place in places.tolist()}.isdisjoint({name})
            assert len(places)


def test_views_are_read_side_by_side_as_in_planning(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for number in range(3):
        views = {name: rng.integers(0, 255, (STEPS, 24, 32, 3), dtype=np.uint8) for name in ("frames", "right")}
        states = np.tile([0.4, 0.0, 0.3, 3.1, 0.0, 0.0, 0.0], (STEPS, 1))
        np.savez(tmp_path / f"{number}.npz", states=states + 0.01 * np.arange(STEPS)[:, None], fps_hz=15.0, **views)
    how = {"source": "npz", "frames": 3, "stride": STRIDE, "workers": 0}
    both = open_dataset(tmp_path, camera=("frames", "right"), **how)
    one = PolicyChunks("one", ((both.table.identity(1), 3),), np.zeros((1, 1, 4, 7)) + 0.4)
    run = RecordingController(tiny_model(), PlanningConfig(views=2))
    score_policies(run, both, [one])
    expected = [both.source.read(1, camera).read_frames([3])[0] for camera in ("frames", "right")]
    np.testing.assert_array_equal(run.frames[0], np.hstack(expected))
    with pytest.raises(InputError, match=r"data\.camera: frames\. Expected 2 cameras"):
        score_policies(run, open_dataset(tmp_path, camera="frames", **how), [one])


def test_points_missing_in_a_file_are_skipped_and_unknown_episodes_raise(dataset: Dataset) -> None:
    one, other = policy(dataset, "one", 0.1), policy(dataset, "other", 0.1)
    fewer = PolicyChunks("other", other.points[:2], other.chunks[:2])
    assert score_policies(oracle_controller(), dataset, [one, fewer]).places == 2
    with pytest.raises(InputError, match="no common evaluation point"):
        score_policies(oracle_controller(), dataset, [one, PolicyChunks("none", (("x", 0),), other.chunks[:1])])
    with pytest.raises(InputError, match="has no such episode"):
        score_policies(oracle_controller(), dataset, [PolicyChunks("none", (("x", 0),), other.chunks[:1])])


def test_policy_files_are_read_without_executing_code(tmp_path: Path) -> None:
    good = {"episodes": np.array(["a", "b"]), "frames": np.array([0, 3]), "chunks": np.zeros((2, 1, 4, 7))}
    np.savez(tmp_path / "good.npz", **good)
    found = read_policy_chunks(tmp_path / "good.npz")
    assert (found.name, found.points) == ("good", (("a", 0), ("b", 3)))
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
    found = read_run_ranking_error(str(whole_run), "step-00000006 (the newest)")
    assert found is not None
    assert 0 <= found.value <= 1
    assert read_run_ranking_error(str(tmp_path), "") is None


def test_score_command_ranks_policies(whole_run: Path, data_folder: Path, tmp_path: Path) -> None:
    dataset = open_dataset(data_folder, frames=4, stride=2, workers=0)
    chunks = dataset.source.read(0).states[1:5][None, None]
    place = {"episodes": np.array([dataset.table.identity(0)]), "frames": np.array([0])}
    np.savez(tmp_path / "one.npz", chunks=chunks, **place)
    words = ["--policy", str(tmp_path / "one.npz"), "--out", str(tmp_path / "score.json")]
    assert main(["score", str(whole_run), *words]) in {0, 1}
    found = json.loads((tmp_path / "score.json").read_text())
    assert found["places"] == 1
    assert found["policies"][0]["mean"]["value"] == pytest.approx(found["demonstrated"]["value"], rel=1e-4)
