"""Action chunks of every form are converted to changes per model step and scored with the planner's energies."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from decisions import QUICK, STATE, image
from tiny_models import tiny_model
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.policies.score import changes_of_chunks
from vjepa2_ac.spaces import actions_from_states, apply_action, make_vector_states


def random_walks(seed: int, steps: int = 12) -> np.ndarray:
    """Return the states after each control step of three chunks; the gripper stays within its limits."""
    rng = np.random.default_rng(seed)
    trajectories = []
    for _ in range(3):
        state, states = STATE, []
        for step in rng.normal(0, [0.01] * 3 + [0.1] * 3 + [0.02], (steps, 7)):
            state = apply_action(state, step)
            states.append(state)
        trajectories.append(states)
    return np.array(trajectories)


@settings(max_examples=15)
@given(st.integers(0, 30), st.sampled_from([1, 3, 4]))
def test_every_chunk_form_gives_the_same_changes(seed: int, control_steps: int) -> None:
    targets = random_walks(seed)
    deltas = np.stack([actions_from_states(np.concatenate([STATE[None], trajectory])) for trajectory in targets])
    offsets = np.array(
        [[actions_from_states(np.stack([STATE, state]))[0] for state in trajectory] for trajectory in targets]
    )
    chunk_ends = targets[:, control_steps - 1 :: control_steps]
    expected = [actions_from_states(np.concatenate([STATE[None], trajectory])) for trajectory in chunk_ends]
    for form, chunks in (("targets", targets), ("deltas", deltas), ("offsets", offsets)):
        changes = changes_of_chunks(chunks, STATE, form=form, control_steps=control_steps)
        np.testing.assert_allclose(changes, expected, atol=1e-9)


def test_incomplete_model_steps_are_dropped_and_vector_deltas_are_summed() -> None:
    chunks = np.arange(30.0).reshape(1, 10, 3)
    changes = changes_of_chunks(chunks, np.zeros(3), form="deltas", control_steps=4, space=make_vector_states(3))
    np.testing.assert_allclose(changes, [[chunks[0, :4].sum(0), chunks[0, 4:8].sum(0)]])


@pytest.mark.parametrize(
    ("chunks", "message"),
    [
        (np.zeros((2, 8, 6)), r"shape \(2, 8, 6\)"),
        (np.full((2, 8, 7), np.nan), "finite"),
        (np.zeros((2, 3, 7)), "3 control steps"),
        (np.full((2, 8, 7), 400.0), "metres"),
    ],
)
def test_invalid_chunks_raise(chunks: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        changes_of_chunks(chunks, STATE, form="targets", control_steps=4)


def test_scores_equal_planner_energies_and_leave_the_controller_unchanged() -> None:
    controller = Controller(tiny_model(), QUICK)
    controller.reset(image(100))
    controller.act(image(0), STATE)
    decision = controller.decision
    chunks = np.random.default_rng(0).normal(0, 0.03, (5, 2, 7))
    scores = controller.score(image(0), STATE, chunks)
    assert controller.decision is decision
    with torch.no_grad():
        expected = decision.cost(torch.from_numpy(chunks).float())
        zero_action_energy = float(decision.cost(torch.zeros(1, 2, 7)))
    np.testing.assert_allclose(scores.energies, expected, rtol=1e-5)
    assert scores.zero_action_energy == pytest.approx(zero_action_energy, rel=1e-5)
    assert scores.current_energy == pytest.approx(decision.current_energy)
    assert scores.energies[scores.order].tolist() == sorted(scores.energies)
    other = Controller(tiny_model(), QUICK)
    other.reset(image(100))
    other.act(image(0), STATE)
    np.testing.assert_array_equal(controller.act(image(1), STATE), other.act(image(1), STATE))
