"""With an oracle, the variant that repairs a fault is better than the unchanged data; correct data have none."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from memory_source import MemorySource
from moving_arms import STEPS, spot_states
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.index import StepSelection
from vjepa2_ac.data.selection import BrokenEpisodes
from vjepa2_ac.episode import Batch, Episode, LatentBatch, StepRanges
from vjepa2_ac.evaluation.measure import ClipSample
from vjepa2_ac.inspection.probe import (
    UNCHANGED,
    VariantProbe,
    make_variants,
    mirror_poses,
    probe_variants,
)
from vjepa2_ac.inspection.variants import VariantResult
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.spaces import actions_from_states, matrices_from_euler
from worlds import Copier

EPISODES, BEYOND = 8, 8  # episodes; states before the first and after the last step, for shifts
ROTATION = slice(3, 12)
RIGHT = 7  # blue value of the right part of a frame

Fault = Callable[[np.ndarray], np.ndarray]


@cache
def truth(number: int, steps: int = STEPS) -> np.ndarray:
    """Return the true states of an episode at each step, and at some steps before and after."""
    return spot_states(number, steps + 2 * BEYOND)


def at(shift: int) -> Fault:
    return lambda states: states[BEYOND + shift : len(states) - BEYOND + shift]


def with_inverted_gripper(states: np.ndarray) -> np.ndarray:
    return np.concatenate([states[:, :6], 1 - states[:, 6:]], axis=1)


class TwoSided(MemorySource):
    """A source whose frames have other steps and another blue value in the right part than in the left part."""

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return an episode."""
        episode = super().read(index, camera, needed)

        def frames(steps: Sequence[int]) -> np.ndarray:
            frames = episode.read_frames(steps)
            frames[:, :, 3:, 1] = (7 * frames[:, :, 3:, 1] + 3) % STEPS
            frames[:, :, 3:, 2] = RIGHT
            return frames

        return replace(episode, read_frames=frames)


class StepOracle:
    """An oracle for the time of each frame, and for the effect of an action on position, rotation and gripper."""

    def __init__(self, steps: int = STEPS, *, sees_bgr: bool = False, sees_mirrored: bool = False) -> None:
        self._latents = [self._latent(at(0)(truth(number, steps))) for number in range(EPISODES)]
        self._channels = [2, 1, 0] if sees_bgr else [0, 1, 2]
        self._column = -1 if sees_mirrored else 0
        self.encoded = 0

    @staticmethod
    def _latent(states: np.ndarray) -> np.ndarray:
        rotations = matrices_from_euler(states[:, 3:6]).reshape(len(states), 9)
        return np.concatenate([states[:, :3], rotations, states[:, 6:]], axis=1)

    def _encode_step(self, episode: int, step: int) -> np.ndarray:
        latents = self._latents[episode % EPISODES]
        return latents[step % len(latents)]

    def encode(self, batch: Batch) -> LatentBatch:
        """Look up the latents: the colours of a frame are the indices of its episode and its step."""
        assert batch.frames is not None
        self.encoded += 1
        pixels = batch.frames[:, :, 0, self._column][..., self._channels].numpy().astype(int)
        encoded_steps = [[self._encode_step(episode, step) for episode, step, _ in clip] for clip in pixels]
        latents = torch.from_numpy(np.array(encoded_steps)).float()[:, :, None]
        return LatentBatch(latents, batch.states, batch.actions, None, batch.episode_ids, batch.starts)

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return the pose after each action."""
        del states, extrinsics
        after, changes = latents.clone(), actions[:, :, None]
        after[..., :3] += changes[..., :3]
        turned = torch.from_numpy(matrices_from_euler(changes[..., 3:6].double().numpy())).float()
        after[..., ROTATION] = (turned @ after[..., ROTATION].unflatten(-1, (3, 3))).flatten(-2)
        after[..., 12:] += changes[..., 6:]
        return after

    def rollout(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Not used."""
        raise NotImplementedError


def dataset_of(fault: Fault, *, episodes: int = EPISODES, steps: int = STEPS, **changes: object) -> Dataset:
    values = {"path": "memory", "frames": 3, "validation_share": 0.0, "test_share": 0.0, "workers": 0}
    config = DataConfig.model_validate(values | changes)
    source = TwoSided([steps] * episodes, states=lambda number: fault(truth(number, steps)))
    table = source.infos()
    selection = StepSelection.all_steps(table, np.ones(episodes, bool))
    return Dataset(config, source, table, selection, BrokenEpisodes(config, episodes))


def probed(dataset: Dataset, model: StepOracle | Copier | None = None) -> VariantProbe:
    oracle = model if isinstance(model, StepOracle) else StepOracle()
    return probe_variants(model or oracle, oracle.encode, dataset, ClipSample("train", 16))


FAULTS: dict[str, Fault] = {
    **{f"frames {n} step{'s' * (n > 1)} late": at(n) for n in (1, 8)},
    **{f"frames {n} step{'s' * (n > 1)} early": at(-n) for n in (2, 4)},
    "states reversed": lambda states: at(0)(states)[::-1].copy(),
    "x negated": lambda states: mirror_poses(at(0)(states), 0),
    "y negated": lambda states: mirror_poses(at(0)(states), 1),
    "gripper inverted": lambda states: with_inverted_gripper(at(0)(states)),
}


@pytest.mark.parametrize("name", FAULTS)
def test_repairing_variant_of_each_fault_is_the_best_variant(name: str) -> None:
    probe = probed(dataset_of(FAULTS[name]))
    assert probe.better is not None
    assert probe.better.name == name
    assert probe.better.ratio.value < 0.02 < 0.1 < probe.plain.ratio.value
    assert probe.verdict().endswith(f" lower for the variant '{name}'. To fix the data, {probe.better.repair}")


@pytest.mark.parametrize("name", ["red and blue exchanged", "frames mirrored"])
def test_variant_that_changes_frames_as_in_training_is_better(name: str) -> None:
    oracle = StepOracle(sees_bgr=name.startswith("red"), sees_mirrored=name.startswith("frames"))
    probe = probed(dataset_of(at(0)), oracle)
    assert probe.better is not None
    assert probe.better.name == name


def test_correct_data_have_no_better_variant_and_only_changed_frames_are_encoded_again() -> None:
    oracle = StepOracle()
    probe = probed(dataset_of(at(0)), oracle)
    assert probe.better is None
    assert probe.plain.ratio.value < 0.02
    assert min(result.difference.value for result in probe.results) > 0.1
    assert probe.verdict().endswith("on 16 clips from 8 episodes; no variant is significantly better")
    assert probe.is_decided
    assert oracle.encoded == 2 * 3  # two batches; again with red and blue exchanged, and mirrored
    assert {result.name for result in probe.results} >= {*FAULTS, "red and blue exchanged"}


def test_probe_of_few_episodes_is_undecided() -> None:
    probe = probed(dataset_of(FAULTS["states reversed"], episodes=4))
    assert min(result.difference.value for result in probe.results) < -0.1
    assert probe.better is None
    assert probe.verdict().startswith("needs at least 5 episodes, found 4 (")
    assert not probe.is_decided


def test_variant_worse_than_persistence_is_not_better() -> None:
    def find_better_variant(ratio: Estimate) -> VariantResult | None:
        difference = Estimate(-0.2, -0.25, -0.15)
        plain = VariantResult(UNCHANGED, Estimate(1.3, 1.2, 1.4), 0.4, 0.3, clips=64, episodes=12)
        other = replace(plain, name="y negated", ratio=ratio, difference=difference)
        return VariantProbe(plain, (other,)).better

    assert find_better_variant(Estimate(1.1, 1.05, 1.15)) is None
    assert find_better_variant(Estimate(0.95, 0.85, 1.05)) is None
    assert find_better_variant(Estimate(0.9, 0.85, 0.95)) is not None


def test_probe_with_a_model_not_better_than_persistence_is_undecided() -> None:
    probe = probed(dataset_of(FAULTS["y negated"]), Copier())
    assert probe.better is None
    assert probe.verdict().startswith("needs a model that predicts these data better than persistence (")
    assert not probe.is_decided


@pytest.mark.parametrize(("steps", "widest"), [(STEPS, 8), (22, 4), (14, 2), (11, 1), (9, 0)])
def test_shifts_are_limited_by_the_states_on_both_sides_of_a_clip(steps: int, widest: int) -> None:
    dataset = dataset_of(at(0), steps=steps)
    oracle = StepOracle(steps)
    encoded_starts: list[tuple[int, int]] = []

    def encode(batch: Batch) -> LatentBatch:
        encoded_starts.extend(
            (dataset.table.find(name) or 0, start) for name, start in zip(batch.episode_ids, batch.starts, strict=True)
        )
        return oracle.encode(batch)

    probe = probe_variants(oracle, encode, dataset, ClipSample("train", 16))
    results = {result.name for result in probe.results}
    for shift in (1, 2, 4, 8):
        assert (f"frames {shift} step{'s' * (shift > 1)} late" in results) == (shift <= widest)
    assert encoded_starts
    assert all(widest <= start <= steps - 9 - widest for _, start in encoded_starts)
    assert probe.better is None


def test_variants_depend_on_the_state_and_on_available_frames() -> None:
    def names(**changes: object) -> set[str]:
        return {variant.name for variant in make_variants(DataConfig.model_validate({"path": "set"} | changes), [1])}

    shifted = {"frames 1 step late", "frames 1 step early"}
    colours = {"red and blue exchanged", "frames mirrored"}
    poses = {"x negated", "y negated", "gripper inverted"}
    assert names() == shifted | colours | poses | {"states reversed"}
    assert names(source="latents") == shifted | poses | {"states reversed"}
    assert names(source="npz", states="vector") == shifted | colours | {"states reversed"}
    assert names(source="npz", states="vector", actions="recorded", join_actions="sum") == shifted | colours


def test_persistence_is_measured_on_the_changed_frames() -> None:
    """Otherwise a change that reduces the motion in the latents would seem better."""
    oracle = StepOracle()

    def encode(batch: Batch) -> LatentBatch:
        assert batch.frames is not None
        is_mirrored = bool((batch.frames[:, :, 0, 0, 2] == RIGHT).all())
        latents = oracle.encode(batch)
        return replace(latents, latents=latents.latents * 0.01) if is_mirrored else latents

    dataset = dataset_of(at(0))
    probe = probe_variants(Copier(), encode, dataset, ClipSample("train", 16))
    (mirrored_result,) = [result for result in probe.results if result.name == "frames mirrored"]
    assert mirrored_result.ratio.value == pytest.approx(1)
    assert probe.better is None


@pytest.mark.parametrize("axis", [0, 1])
def test_mirroring_twice_restores_poses_and_rotations_stay_proper(axis: int) -> None:
    generator = np.random.default_rng(axis)
    states = generator.uniform(-1, 1, (50, 7)) * [1, 1, 1, np.pi, 1.5, np.pi, 1]
    mirrored = mirror_poses(states, axis)
    np.testing.assert_allclose(np.linalg.det(matrices_from_euler(mirrored[:, 3:6])), 1)
    np.testing.assert_allclose(mirror_poses(mirrored, axis), states, atol=1e-9)
    np.testing.assert_allclose(mirrored[:, axis], -states[:, axis])
    np.testing.assert_allclose(np.delete(mirrored, [axis, 3, 4, 5], axis=1), np.delete(states, [axis, 3, 4, 5], axis=1))
    actions, mirrored_actions = actions_from_states(states), actions_from_states(mirrored)
    np.testing.assert_allclose(mirror_poses(actions, axis), mirrored_actions, atol=1e-9)  # so do its actions
    pointing, mirrored_pointing = (matrices_from_euler(poses[:, 3:6])[:, :, 2] for poses in (states, mirrored))
    np.testing.assert_allclose(mirrored_pointing, pointing * np.where(np.arange(3) == axis, -1, 1), atol=1e-9)
