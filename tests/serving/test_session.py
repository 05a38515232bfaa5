"""The session: the controller's own actions, and none where anything is wrong."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from served import STATE, controller, image, request, session, vector_controller
from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.chunks import changes_of_chunks
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.serving.session import ActionForm, GoneError, Session, SessionOptions, has_black_bars
from vjepa2_ac.serving.wire import pack, unpack

CUP = {"cup": (SubGoal(image(50), "cup"),), "two": (SubGoal(image(51), "a", at_most=1), SubGoal(image(52), "b"))}


def ask(one: Session, **keys: object) -> dict:
    answer = one.answer(pack(keys))
    assert isinstance(answer, bytes), answer
    return unpack(answer)


def refused(one: Session, **keys: object) -> str:
    answer = one.answer(pack(keys))
    assert isinstance(answer, str)
    return answer


@pytest.mark.parametrize("changes", [{}, {"context": 2, "warm_start": True}])
def test_what_is_sent_is_what_the_controller_does_bit_for_bit(changes: dict) -> None:
    served, own = session(**changes), controller(**changes)
    own.reset(image(100))
    for step in range(3):
        goal = {"goal_image": image(100)} if step != 1 else {}  # a client may send it every time, or once
        found = ask(served, **request(step, **goal))
        action = own.act(image(step), STATE)
        np.testing.assert_array_equal(found["actions"][0], action)
        assert found["actions"].shape == (2, 7)
        assert found["actions"].dtype == np.float64
        np.testing.assert_array_equal(found["actions"], own.decision.plan.actions.double().numpy())
        np.testing.assert_array_equal(found["target"], own.decision.states[1:])
        assert found["energy"] == {"now": own.decision.energy_now, "plan": own.decision.plan.energy}
        assert found["why"] == "planned"
        assert found["server_timing"].keys() == {"infer_ms"} | ({"prev_total_ms"} if step else set())


def test_an_answer_suits_a_client_that_cuts_arrays_at_their_first_axis() -> None:
    """As openpi's ActionChunkBroker does: every array of the answer has a row for each action."""
    for form, rows in (("delta", 2), ("pose", 4)):
        found = ask(session(SessionOptions(form)), **request(goal_image=image(1)))
        arrays_in = [value for value in found.values() if isinstance(value, np.ndarray)]
        assert [one.shape for one in arrays_in] == [(rows, 7)]


def test_a_named_goal_and_a_prompt_begin_what_the_server_keeps() -> None:
    one = session(goals=CUP)
    assert ask(one, **request(0, goal_name="cup"))["goal"]["name"] == "cup"
    first = ask(one, **request(1, prompt="two"))
    assert (first["goal"]["name"], first["goal"]["since"]) == ("a", 0)
    second = ask(one, **request(2, prompt="two"))
    assert (second["goal"]["name"], second["goal"]["index"], second["goal"]["since"]) == ("b", 1, 1)
    assert "its 1 steps are over" in second["goal"]["changed"]
    assert "names no goal. needed: the name of one (this server keeps cup, two)" in refused(
        one, **request(prompt="cap")
    )
    assert "no goal in this episode" in refused(one, **request(3)), "a wrong goal leaves none, not the one of before"


def test_another_goal_a_reset_and_another_session_id_begin_anew() -> None:
    one = session()
    first = ask(one, **request(0, goal_image=image(100), session_id="a"))["actions"]
    again = ask(one, **request(0, goal_image=image(100), session_id="a"))["actions"]
    assert not np.array_equal(first, again), "the second decision has another seed"
    for keys in ({"session_id": "b"}, {"session_id": "b", "reset": True}):
        found = ask(one, **request(0, goal_image=image(100), **keys))["actions"]
        np.testing.assert_array_equal(found, first)
    assert ask(one, endpoint="reset", session_id="b") == {"status": "reset"}
    assert "no goal in this episode" in refused(one, **request(0, session_id="b"))
    ask(one, endpoint="reset", **{"goal/image": image(100)})
    np.testing.assert_array_equal(ask(one, **request(0))["actions"], first)
    one.begin()
    assert "no goal in this episode" in refused(one, **request(0))


def test_after_an_error_the_next_good_request_is_answered_as_if_there_had_been_none() -> None:
    one, other = session(), session()
    expected = [ask(other, **request(step, goal_image=image(100)))["actions"] for step in range(2)]
    np.testing.assert_array_equal(ask(one, **request(0, goal_image=image(100)))["actions"], expected[0])
    assert "frame: 32 x 24 pixels" in refused(one, **request(1) | {"observation/image": image(1, 24, 32)})
    assert "degrees" in refused(one, **request(1) | {"observation/state": STATE * [1, 1, 1, 60, 1, 1, 1]})
    assert "needed: finite numbers" in refused(one, **request(1) | {"observation/state": STATE * np.nan})
    assert one.answer(b"\xc1") == "not a msgpack message that is read here (FormatError)"
    np.testing.assert_array_equal(ask(one, **request(1))["actions"], expected[1])
    assert (one.counts.refused, one.counts.failed) == (4, 0)


def test_what_fails_inside_is_told_to_the_log_and_to_nobody_else(caplog, monkeypatch) -> None:
    one = session()
    ask(one, **request(0, goal_image=image(100)))

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("/home/me/secret.pt is broken")

    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(one.controller, "act", fail)
        assert refused(one, **request(1)) == "the server failed at this request; its log says more"
    assert "secret" in caplog.text
    assert one.counts.failed == 1
    ask(one, **request(1))


class _Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def test_past_the_deadline_nobody_moves_and_the_next_decision_is_as_if_nothing_had_been() -> None:
    own = controller()
    late = Session(own, None, SessionOptions(deadline_s=2.5), clock=_Clock())
    found = ask(late, **request(0, goal_image=image(100)))
    assert found["why"] == "past the deadline"
    assert not found["actions"].any()
    assert found["actions"].shape == (2, 7)
    late._clock = lambda: 0.0
    np.testing.assert_array_equal(
        ask(late, **request(0))["actions"], ask(session(), **request(0, goal_image=image(100)))["actions"]
    )


def test_when_nobody_waits_the_search_ends_within_an_iteration() -> None:
    one, asked = session(iterations=50), []

    def gone() -> bool:
        asked.append(1)
        return len(asked) > 3

    with pytest.raises(GoneError):
        one.answer(pack(request(0, goal_image=image(100))), gone)
    assert len(asked) < 7


def test_a_dry_run_plans_and_sends_zeros() -> None:
    wet = ask(session(), **request(0, goal_image=image(100)))
    dry = ask(session(SessionOptions(dry_run=True)), **request(0, goal_image=image(100)))
    assert dry["dry_run"] is True
    assert not dry["actions"].any()
    assert dry["target"] == [STATE.tolist()]
    assert dry["planned"] == wet["target"]
    poses = ask(session(SessionOptions("pose", dry_run=True)), **request(0, goal_image=image(100)))
    np.testing.assert_allclose(poses["actions"], np.tile(STATE, (4, 1)), atol=1e-12)


BOX = ((0.3, -0.2, 0.1), (0.45, 0.2, 0.5))
LIMITS = LimitsConfig(xyz=(0.05, 0.04, 0.03), rotation=0.1, ball="l2", radius=0.045, workspace=BOX)


class _Liar(Controller):
    """A controller that says anything."""

    lie = np.zeros((2, 7))

    def act(self, frame: np.ndarray, state: np.ndarray, **how: object) -> np.ndarray:
        action = super().act(frame, state, **how)
        if self.decision.plan is not None:
            plan = replace(self.decision.plan, actions=torch.from_numpy(self.lie))
            self.decision = replace(self.decision, plan=plan, action=self.lie[0])
        return action


@pytest.fixture(scope="module")
def liar() -> Session:
    true = controller(limits=LIMITS)
    return Session(_Liar(true._model, true.config))


WILD = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-0.2, 0.2)


@settings(max_examples=150)
@given(arrays(np.float64, (2, 7), elements=WILD), st.sampled_from(["delta", "pose"]), st.floats(0.26, 0.5))
def test_whatever_a_controller_says_what_is_sent_is_within_the_limits(liar: Session, lie, form: ActionForm, x) -> None:
    liar.controller.lie, liar.options = lie, SessionOptions(form)
    state = np.array([x, *STATE[1:]])
    answer = liar.answer(pack(request(0, goal_image=image(100)) | {"observation/state": state}))
    found = unpack(answer)
    sent = found["actions"]
    assert np.isfinite(sent).all()
    is_zero = not (sent if form == "delta" else sent - state)[:, :3].any()
    steps = sent[:, :3] if form == "delta" else np.diff(np.concatenate([state[None], sent]), axis=0)[:, :3]
    assert (abs(steps) <= np.array(LIMITS.xyz_m) + 1e-5).all()
    assert (np.linalg.norm(steps, axis=1) <= LIMITS.radius + 1e-5).all()
    last = (state[:3] + np.cumsum(steps, axis=0)) if form == "delta" else sent[-1:, :3]
    is_inside = (last >= np.array(BOX[0]) - 1e-5).all() and (last <= np.array(BOX[1]) + 1e-5).all()
    assert is_inside or is_zero
    if found["why"].startswith("not sent"):
        assert is_zero
        assert found["target"] == [state.tolist()]
    else:
        assert found["why"] in {"planned", "outside the workspace"}


def test_padded_pictures_are_told_of() -> None:
    padded = image(0)
    padded[:6], padded[-6:] = 0, 0
    assert has_black_bars(padded)
    assert not has_black_bars(image(0))
    assert not has_black_bars(np.zeros_like(padded)), "a dark room is no padding"
    one = session()
    assert ask(one, **request(0, goal_image=image(100)))["notes"] == []
    (note,) = ask(one, **request(1) | {"observation/image": padded})["notes"]
    assert note.startswith("black bars")


def test_of_vectors_changes_or_targets_are_sent_and_never_poses() -> None:
    for joined in ("sum", "last"):
        own, state = vector_controller(joined), np.full(8, 0.1)
        own.reset(image(100))
        message = {"observation/image": image(0), "observation/state": state, "goal/image": image(100)}
        found = unpack(Session(vector_controller(joined)).answer(pack(message)))
        np.testing.assert_array_equal(found["actions"][0], own.act(image(0), state))
        assert found["actions"].shape == (2, 8)
        nothing = unpack(Session(own, None, SessionOptions(dry_run=True)).answer(pack(message)))
        np.testing.assert_array_equal(nothing["actions"], np.tile(state if joined == "last" else 0 * state, (2, 1)))
        with pytest.raises(InputError, match="--actions pose: a model whose states are not poses"):
            Session(own, None, SessionOptions("pose"))


def test_a_policys_chunks_are_scored_without_a_decision() -> None:
    one, own = session(), controller()
    own.reset(image(100))
    chunks = STATE + np.random.default_rng(0).normal(0, 0.01, (3, 8, 7)) * [1, 1, 1, 1, 1, 1, 0]
    keys = {"endpoint": "score", "policy/chunks": chunks}
    found = ask(one, **request(goal_image=image(100), **keys))
    expected = own.score(image(0), STATE, changes_of_chunks(chunks, STATE, form="targets", control_steps=4))
    np.testing.assert_array_equal(found["energies"], expected.energies)
    assert (found["best"], found["tied"], found["is_blind"]) == (expected.best, expected.tied, False)
    assert not one.counts.decisions
    blind = session(SessionOptions(is_blind=True))
    found = ask(blind, **request(goal_image=image(100), **keys))
    assert (found["best"], found["is_blind"]) == (None, True)
    assert "3 control steps" in refused(one, **request(**keys | {"policy/chunks": chunks[:, :3]}))
    assert "no goal" in refused(session(), **request(**keys))


def test_a_search_starts_from_what_a_policy_would_do() -> None:
    own = controller()
    own.reset(image(100))
    chunks = np.tile(np.array([0.01, 0.0, -0.005, 0, 0, 0, 0.0]), (4, 8, 1))
    changes = changes_of_chunks(chunks, STATE, form="deltas", control_steps=4)
    action = own.act(image(0), STATE, samples=changes)
    found = ask(session(), **request(goal_image=image(100), **{"policy/chunks": chunks, "policy/form": "deltas"}))
    np.testing.assert_array_equal(found["actions"][0], action)
    assert not np.array_equal(action, ask(session(), **request(goal_image=image(100)))["actions"][0])
    short = {"policy/chunks": chunks[:, :4], "policy/form": "deltas"}
    assert "samples of a policy" in refused(session(), **request(goal_image=image(100), **short))
