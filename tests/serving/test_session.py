"""The session: the controller's own actions, and none where anything is wrong."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from decisions import vector_controller
from served import STATE, controller, image, request, session
from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.policies.score import changes_of_chunks
from vjepa2_ac.serving.session import (
    ActionForm,
    GoneError,
    Session,
    SessionOptions,
    has_black_bars,
    waypoints,
    why_not_sent,
)
from vjepa2_ac.serving.wire import pack, unpack
from vjepa2_ac.spaces import POSE, actions_from_states, apply_action, vector_states

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
    assert "it ends after 1 step" in second["goal"]["changed"]
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


class _OverAfter:
    """A clock that passes every deadline when it was read so many times."""

    def __init__(self, reads: int) -> None:
        self.left = reads

    def __call__(self) -> float:
        self.left -= 1
        return 0.0 if self.left >= 0 else 1e6


def test_past_the_deadline_nobody_moves_and_the_next_decision_is_as_if_nothing_had_been() -> None:
    own = controller()
    late = Session(own, None, SessionOptions(deadline_s=2.5), clock=_OverAfter(2))
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
LIMITS = LimitsConfig(xyz=(0.05, 0.04, 0.03), rotation=0.1, workspace=BOX)


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
    lying, plans = _Liar(true._model, true.config), []
    search = lying.planner.plan

    def search_once(*given: object) -> object:  # what it finds is replaced
        plans[:] = plans or [search(*given)]
        return plans[0]

    lying.planner.plan = search_once
    return Session(lying)


LARGEST = np.array([*LIMITS.xyz_m, *[LIMITS.rotation] * 3, 1.0])
WILD = arrays(np.float64, (2, 7), elements=st.floats(allow_nan=True, allow_infinity=True) | st.floats(-0.2, 0.2))
SHARES = st.sampled_from([0.0, 0.5, 0.99, 1.5])  # of the limits of position, rotation and gripper
NEAR = st.builds(
    lambda shares, parts: shares * np.repeat(parts, [3, 3, 1]) * LARGEST,
    arrays(np.float64, (2, 7), elements=st.floats(-1.0, 1.0)),
    st.tuples(SHARES, SHARES, SHARES),
)


@settings(max_examples=150, deadline=None)
@example(np.array([[0.04, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]] * 2), "delta", 0.4)  # together they leave the workspace
@given(WILD | NEAR, st.sampled_from(["delta", "pose"]), st.floats(0.26, 0.5))
def test_whatever_a_controller_plans_the_action_sent_is_within_the_limits(
    liar: Session, lie: np.ndarray, form: ActionForm, x: float
) -> None:
    liar.controller.lie, liar.options = lie, SessionOptions(form)
    state, frame = np.array([x, *STATE[1:]]), image(int(1e9 * x))  # another frame wherever the arm is
    answer = liar.answer(pack({"observation/image": frame, "observation/state": state, "goal/image": image(100)}))
    found = unpack(answer)
    sent = found["actions"]
    assert np.isfinite(sent).all()
    steps = sent
    if form == "pose":
        assert ((sent[:, 6] >= 0) & (sent[:, 6] <= 1)).all()
        steps = POSE.differences(np.stack([state, sent[-1]]))
    assert (abs(steps) <= LARGEST + 1e-5).all()
    targets = state[:3] + np.cumsum(steps[:, :3], axis=0)
    is_inside = (targets >= np.array(BOX[0]) - 1e-5).all() and (targets <= np.array(BOX[1]) + 1e-5).all()
    assert is_inside or not abs(steps[:, :3]).max() > 1e-9
    if found["why"].startswith("not sent"):
        assert not abs(steps).max() > 1e-9
        assert found["target"] == [state.tolist()]
    else:
        assert found["why"] in {"planned", "outside the workspace"}


WITHIN = np.array([[0.02, 0.01, 0.0, 0.09, 0.0, 0.0, 0.0]] * 2)
PLAIN = LIMITS.model_copy(update={"workspace": None})


def changed(step: int, axis: int, value: float) -> np.ndarray:
    changes = WITHIN.copy()
    changes[step, axis] = value
    return changes


@pytest.mark.parametrize("step", [0, 1])
@pytest.mark.parametrize(
    ("axis", "limit", "word"),
    [(0, 0.05, "xyz"), (1, -0.04, "xyz"), (2, 0.03, "xyz"), (3, 0.1, "rotation"), (4, -0.1, "rotation"),
     (5, 0.1, "rotation"), (6, -1.0, "gripper")],
)  # fmt: skip
def test_one_number_beyond_its_limit_in_any_step_keeps_a_plan_from_being_sent(
    step: int, axis: int, limit: float, word: str
) -> None:
    assert why_not_sent(STATE, changed(step, axis, limit), PLAIN, POSE) == ""
    for beyond in (limit + np.sign(limit) * 3e-6, 3 * limit):
        assert word in why_not_sent(STATE, changed(step, axis, beyond), PLAIN, POSE)
    for wrong in (np.nan, np.inf, -np.inf):
        assert "not finite" in why_not_sent(STATE, changed(step, axis, wrong), PLAIN, POSE)


def test_rounding_of_limits_that_are_searched_in_float32_is_allowed() -> None:
    for axis, limit in ((0, 0.05), (3, 0.1)):
        assert why_not_sent(STATE, changed(0, axis, limit + 5e-7), PLAIN, POSE) == ""
    widest = PLAIN.model_copy(update={"rotation": np.pi})
    assert why_not_sent(STATE, changed(0, 3, np.pi), widest, POSE) == ""
    assert "rotation" in why_not_sent(STATE, changed(0, 3, np.pi + 5e-7), widest, POSE), "a half turn, the other way"


@pytest.mark.parametrize(("steps", "is_sent"), [((0.02, 0.02), True), ((0.04, 0.04), False), ((0.04, -0.04), True)])
def test_the_targets_of_all_steps_together_are_in_the_workspace(steps: tuple[float, float], is_sent: bool) -> None:
    changes = np.zeros((2, 7))
    changes[:, 0] = steps
    assert why_not_sent(STATE, changes, LIMITS, POSE) == ("" if is_sent else "out of planning.limits.workspace")
    assert why_not_sent(STATE, changes, PLAIN, POSE) == ""


def test_outside_the_workspace_only_the_position_has_to_stay() -> None:
    outside, turn = np.array([0.5, *STATE[1:]]), np.zeros((2, 7))
    turn[:, 3:] = 0.05
    assert why_not_sent(outside, turn, LIMITS, POSE) == ""
    turn[0, 0] = -0.01  # not far enough
    assert "workspace" in why_not_sent(outside, turn, LIMITS, POSE)


def test_changes_of_vectors_are_within_the_limits_of_their_axes() -> None:
    space, limits = vector_states(3), LimitsConfig(axes=(0.1, 0.2, 0.0))
    changes = np.array([[0.1, -0.2, 0.0], [-0.1, 0.2, 0.0]])
    assert why_not_sent(np.zeros(3), changes, limits, space) == ""
    for axis, value in ((0, 0.11), (1, -0.21), (2, 0.01)):
        wrong = changes.copy()
        wrong[1, axis] = value
        assert "axes" in why_not_sent(np.zeros(3), wrong, limits, space)
    assert "axes" in why_not_sent(np.zeros(3), changes, LimitsConfig(), space), "without limits nothing moves"


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


def test_a_frozen_camera_moves_nothing_once_the_arm_has_moved_and_a_reset_forgets_it() -> None:
    one, there, moved = session(), STATE.copy(), STATE + np.eye(7)[0] * 0.006
    for form in ({"session_id": "a"}, {"session_id": "b"}, {"session_id": "b", "reset": True}):
        assert ask(one, **request(0, goal_image=image(100), **form))["why"] == "planned"
        for _ in range(2):
            found = ask(one, **request(0) | {"observation/state": moved})
            assert (found["why"], found["target"], found["energy"]["now"]) == ("frozen frame", [moved.tolist()], None)
            assert not found["actions"].any()
    one.begin()
    assert ask(one, **request(0, goal_image=image(100)) | {"observation/state": moved})["why"] == "planned"
    assert ask(one, **request(0) | {"observation/state": there})["why"] == "frozen frame"
    assert one.counts.decisions == {"planned": 4, "frozen frame": 7}


CHUNKS = STATE + np.random.default_rng(0).normal(0, 0.01, (300, 4, 7)) * [1, 1, 1, 1, 1, 1, 0]
SCORE = {"endpoint": "score", "policy/chunks": CHUNKS}


@pytest.mark.parametrize("ended_by", ["deadline", "client"])
def test_a_score_ends_after_the_part_in_which_it_is_cancelled(ended_by: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one = session(energy=EnergyConfig(samples_at_once=16))
    ask(one, **request(goal_image=image(100)))
    parts: list[int] = []
    rollout = one.controller._model.rollout

    def counted(frame: torch.Tensor, *more: object, **how: object) -> object:
        parts.append(len(frame))
        return rollout(frame, *more, **how)

    monkeypatch.setattr(one.controller._model, "rollout", counted)
    message = pack(request(1, **SCORE))
    if ended_by == "client":
        with pytest.raises(GoneError):
            one.answer(message, lambda: bool(parts))
    else:
        one._clock = _OverAfter(2)
        assert one.answer(message).startswith("request: no answer: past the deadline")
    assert parts == [16]


@pytest.mark.parametrize("endpoint", ["infer", "reset"])
def test_goals_are_encoded_until_the_deadline(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one, encoded = session(), []
    monkeypatch.setattr(one.controller, "encoded", lambda _: encoded.append(1) or torch.zeros(9, 32))
    one._clock = _OverAfter(3)
    goals = {"goal/images": np.stack([image(seed) for seed in range(5)]), "goal/rules": [{"at_most": 1}] * 4 + [{}]}
    answer = one.answer(pack(request(**goals) | {"endpoint": endpoint}))
    assert len(encoded) == 2
    if endpoint == "infer":
        found = unpack(answer)
        assert (found["why"], found["goal"], found["actions"].any()) == ("past the deadline", None, np.False_)
    else:
        assert answer.startswith("request: no answer: past the deadline")
    one._clock = lambda: 0.0
    monkeypatch.undo()
    assert "no goal in this episode" in refused(one, **request())


def test_an_episode_is_counted_once_and_not_for_a_robot_that_leaves() -> None:
    one = session()
    one.begin()
    assert one.counts.episodes == 0
    ask(one, endpoint="reset", session_id="a")
    assert one.counts.episodes == 1
    ask(one, **request(goal_image=image(100), session_id="a"))
    assert one.counts.episodes == 1
    ask(one, **request(goal_image=image(100), session_id="b"))
    ask(one, **request(goal_image=image(100), reset=True))
    assert one.counts.episodes == 3
    one.begin()
    ask(one, **request(goal_image=image(100)))
    assert one.counts.episodes == 4, "a client may name no episodes"


# ---- waypoints ----

NEAR_PI = np.array([0.4, 0.1, 0.3, np.pi - 0.02, 0.1, -1.2, 0.5])
ACTION = np.array([0.02, -0.01, 0.03, 0.3, -0.2, 0.4, 0.25])


@pytest.mark.parametrize("steps", [1, 4, 7])
def test_they_are_even_and_the_last_one_is_the_target(steps: int) -> None:
    found = waypoints(NEAR_PI, ACTION, steps)
    np.testing.assert_array_equal(found[-1], apply_action(NEAR_PI, ACTION))
    changes = actions_from_states(np.concatenate([NEAR_PI[None], found]))
    np.testing.assert_allclose(changes, np.broadcast_to(changes[0], changes.shape), atol=1e-9)
    np.testing.assert_allclose(changes[:, :3].sum(axis=0), ACTION[:3], atol=1e-12)


def test_no_action_stays_where_it_is_and_a_gripper_is_between_open_and_closed() -> None:
    np.testing.assert_allclose(waypoints(NEAR_PI, np.zeros(7), 3), np.tile(NEAR_PI, (3, 1)), atol=1e-12)
    closing = np.array([0, 0, 0, 0, 0, 0, 1.0])
    assert waypoints(NEAR_PI, closing, 4)[:, 6].tolist() == [0.75, 1.0, 1.0, 1.0]
