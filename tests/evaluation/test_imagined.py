"""Decoded rollouts of a held-out clip use the requested clip, models, actions and states."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from decoders import whole_decoder  # noqa: F401 - a fixture
from run_fixtures import MakeConfig
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.loader import validation_windows
from vjepa2_ac.decoding.imagine import AS_RECORDED, DecodedRollout, RolloutComparison
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation import imagined
from vjepa2_ac.evaluation.imagined import ImagineOptions, imagine_clip
from vjepa2_ac.evaluation.request import EvaluationOptions
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.simulation.counterfactual import simulated_outcome
from vjepa2_ac.spaces import actions_from_states

STEPS = 3
NEWEST = EvaluationOptions(checkpoint="newest")  # the selected checkpoint is the base model
Imagine = Callable[..., RolloutComparison]


@pytest.fixture
def imagine(whole_run: Path, whole_decoder: Path) -> Imagine:  # noqa: F811 - the fixture
    def compare_rollouts(subject: Path = whole_run, **requested: object) -> RolloutComparison:
        options = {"decoder": str(whole_decoder), "steps": STEPS, "evaluation": NEWEST, **requested}
        return imagine_clip(str(subject), ImagineOptions(**options))  # type: ignore[arg-type]

    return compare_rollouts


@pytest.fixture
def rollout_inputs(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Tensor, ...]]:
    """Return a list to which the inputs of every rollout are appended: latents, actions, states."""
    inputs_of_rollouts: list[tuple[Tensor, ...]] = []
    roll = WorldModel.rollout

    def record(model: WorldModel, *inputs: Tensor) -> Tensor:
        inputs_of_rollouts.append(inputs)
        return roll(model, *inputs)

    monkeypatch.setattr(WorldModel, "rollout", record)
    return inputs_of_rollouts


@pytest.fixture
def true_latents(monkeypatch: pytest.MonkeyPatch) -> list[Tensor]:
    """Return a list to which the latents of every encoded batch are appended."""
    latents: list[Tensor] = []
    encode = imagined.encode_batch

    def record(*values: object, **options: object) -> object:
        batch = encode(*values, **options)  # type: ignore[arg-type]
        latents.append(batch.latents)
        return batch

    monkeypatch.setattr(imagined, "encode_batch", record)
    return latents


def rollouts_by_model_and_actions(comparison: RolloutComparison) -> dict[tuple[str, str], DecodedRollout]:
    return {(rollout.model, rollout.name): rollout for rollout in comparison.rollouts}


def test_all_actions_are_rolled_out_by_base_and_adapter(imagine: Imagine) -> None:
    comparison = imagine(actions=("true", "close"))
    assert list(rollouts_by_model_and_actions(comparison)) == [
        (model, actions) for actions in (AS_RECORDED, "close") for model in ("base", "adapter")
    ]
    for rollout in comparison.rollouts:
        assert rollout.frames.shape == (STEPS, 32, 32, 3)
        assert (rollout.truth is not None) == (rollout.name == AS_RECORDED)
    assert comparison.seconds_per_step == pytest.approx(2 / 15)
    base, adapter = comparison.rollouts[:2]
    assert (base.frames != adapter.frames).any(), "the adapter must change the prediction"


def test_a_perfect_predictor_shows_decoded_truth_bit_for_bit(
    imagine: Imagine, true_latents: list[Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(WorldModel, "rollout", lambda *_: true_latents[0][:, 1:])
    comparison = imagine(actions=("true", "up"))
    for rollout in comparison.rollouts:
        np.testing.assert_array_equal(rollout.frames, comparison.decoded_truth)
    assert (comparison.decoded_truth != comparison.decoded_first).any()


def test_rollouts_use_recorded_states_only_with_recorded_actions(
    imagine: Imagine, rollout_inputs: list[tuple[Tensor, ...]], true_latents: list[Tensor], make_config: MakeConfig
) -> None:
    comparison = imagine(actions=("true", "right"))
    dataset = open_dataset(make_config().data)
    episode = dataset.table.find(comparison.episode_id)
    steps = range(comparison.start, comparison.start + 2 * STEPS + 1, 2)
    recorded = dataset.source.read(episode).states[list(steps)]
    as_recorded, (counterfactual, _) = rollout_inputs[:2], rollout_inputs[2:]
    for context, *_ in rollout_inputs:
        assert torch.equal(context, true_latents[0][:, :1])
    for _, actions, states, *_ in as_recorded:
        np.testing.assert_allclose(states[0].numpy(), recorded[:-1], atol=1e-5)
        np.testing.assert_allclose(actions[0].numpy(), actions_from_states(recorded), atol=1e-5)
    _, actions, states, *_ = counterfactual
    np.testing.assert_allclose(states[0, 0].numpy(), recorded[0], atol=1e-5)
    assert (actions[0, :, 1] < 0).all()
    np.testing.assert_allclose(np.diff(states[0, :, :3].numpy(), axis=0), actions[0, :-1, :3].numpy(), atol=1e-5)
    np.testing.assert_allclose(states[0, :, 3:].numpy(), recorded[:1, 3:].repeat(STEPS, axis=0), atol=1e-5)
    assert np.abs(states[0, 1:].numpy() - recorded[1:-1]).max() > 0.01, "recorded and counterfactual states must differ"


def test_frames_are_those_of_the_requested_clip(imagine: Imagine, make_config: MakeConfig) -> None:
    dataset = open_dataset(make_config().data)
    name = dataset.table.identity(int(dataset.episodes[2]))
    comparison = imagine(actions=("true",), episode=name[3:], start=5)  # a substring of only this name
    assert (comparison.episode_id, comparison.start) == (name, 5)
    assert imagine(actions=("true",), episode=name).start == 0
    assert len(comparison.truth) == len(comparison.decoded_truth) == STEPS
    later = imagine(actions=("true",), episode=name, start=7)
    np.testing.assert_array_equal(comparison.truth[0], later.first)
    np.testing.assert_array_equal(comparison.truth[1:], later.truth[:-1])


def test_default_clip_has_the_most_motion_of_the_split(imagine: Imagine, make_config: MakeConfig) -> None:
    split = "validation"
    comparison = imagine(actions=("true",), evaluation=EvaluationOptions(split=split))
    dataset = open_dataset(make_config(data__frames=STEPS + 1).data)

    def motion(name: str, start: int) -> float:
        states = dataset.source.read(dataset.table.find(name)).states[start : start + 2 * STEPS + 1 : 2]
        return float(np.linalg.norm(np.diff(states[:, :3], axis=0), axis=1).sum())

    windows = [
        (dataset.table.identity(episode), start)
        for episode, start in validation_windows(dataset, split, clips=64)  # type: ignore[arg-type]
    ]
    motions = {window: motion(*window) for window in windows}
    assert len(motions) > 3
    assert motions[comparison.episode_id, comparison.start] == pytest.approx(max(motions.values()))


def test_action_files_are_named_after_the_file(
    imagine: Imagine, rollout_inputs: list[tuple[Tensor, ...]], tmp_path: Path
) -> None:
    rows = np.tile([0, 0, 0.02, 0, 0, 0, 0], (STEPS + 2, 1))
    files = [tmp_path / "up.npy", tmp_path / f"{AS_RECORDED}.npy", tmp_path / "more" / "up.npy"]
    (tmp_path / "more").mkdir()
    for file in files:
        np.save(file, rows)
    np.savetxt(tmp_path / "up.csv", 2 * rows, delimiter=",")
    comparison = imagine(actions=("up", *map(str, files), str(tmp_path / "up.csv")))
    names = ["up", "up.npy", f"{AS_RECORDED}.npy", str(files[2]), "up.csv"]
    assert [rollout.name for rollout in comparison.rollouts if rollout.model == "adapter"] == names
    for _, actions, states, *_ in rollout_inputs[2:8]:
        np.testing.assert_allclose(actions[0].numpy(), rows[:STEPS], atol=1e-6)
        np.testing.assert_allclose(states[0, :, 2] - states[0, 0, 2], 0.02 * np.arange(STEPS), atol=1e-5)


def test_model_is_rolled_out_on_the_given_data(
    imagine: Imagine, base_folder: Path, make_config: MakeConfig, tmp_path: Path
) -> None:
    options = EvaluationOptions(data=make_config(), out=tmp_path)
    comparison = imagine(base_folder, actions=("true", "up"), evaluation=options)
    assert list(rollouts_by_model_and_actions(comparison)) == [("model", AS_RECORDED), ("model", "up")]


def test_real_data_have_no_simulated_outcome(whole_run: Path, whole_decoder: Path) -> None:  # noqa: F811
    requested = ImagineOptions(decoder=str(whole_decoder), actions=("up",), steps=2, evaluation=NEWEST)
    comparison = imagine_clip(str(whole_run), requested, simulate=simulated_outcome)
    assert (comparison.notes, [rollout.truth for rollout in comparison.rollouts]) == ((), [None, None])


# ---- what is refused -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("requested", "comparison"),
    [
        (
            {"actions": ("sideways",)},
            r"actions: 'sideways'. Expected true \(the actions of a recorded clip\), none, up",
        ),
        ({"actions": ("nowhere.npy",)}, "nowhere.npy: cannot be read"),
        ({"size_m": 0.0}, "--size"),
        ({"episode": "nobody"}, "--episode nobody: 0 episodes with this name"),
        ({"episode": "first", "start": -1}, r"--start: -1, in an episode of 24 steps.*0 to 17"),
        ({"episode": "first", "start": 18}, r"--start: 18, .*0 to 17: a clip takes 7 control steps"),
        ({"episode": "first", "steps": 12}, "a longer episode"),
        ({"steps": 12}, "--steps: 12 model steps"),
        ({"decoder": "nowhere"}, "--decoder nowhere"),
    ],
)
def test_invalid_imagine_options_raise(
    imagine: Imagine, make_config: MakeConfig, requested: dict, comparison: str
) -> None:
    if requested.get("episode") == "first":
        dataset = open_dataset(make_config().data)
        requested = requested | {"episode": dataset.table.identity(int(dataset.episodes[0]))}
    with pytest.raises(InputError, match=comparison):
        imagine(**requested)


def test_vector_states_allow_only_recorded_actions(make_config: MakeConfig) -> None:
    vectors = {"states": "vector", "actions": "recorded", "join_actions": "last"}
    config = make_config(**{f"data__{key}": value for key, value in vectors.items()})
    dataset = open_dataset(config.data)
    batch = next(imagined.read_batches(dataset, validation_windows(dataset, "test", clips=1), batch_size=1))
    options = ImagineOptions(decoder="", actions=("true",))
    assert list(imagined._select_actions(options, batch, dataset, limits=None)) == [AS_RECORDED]
    options = ImagineOptions(decoder="", actions=("true", "up"))
    with pytest.raises(InputError, match="--actions up: states that are not poses"):
        imagined._select_actions(options, batch, dataset, limits=None)
