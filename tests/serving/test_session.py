"""The session: it sends the controller's actions, and the zero action or an error in all invalid cases."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from decisions import make_vector_controller
from served import STATE, image, make_controller, request, session
from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.policies.score import changes_of_chunks
from vjepa2_ac.serving.session import (
    ActionForm,
    ClientDisconnectedError,
    Session,
    SessionOptions,
    find_limit_violation,
    has_black_bars,
    interpolate_waypoints,
)
from vjepa2_ac.serving.wire import pack, unpack
from vjepa2_ac.spaces import POSE, actions_from_states, apply_action, make_vector_states

CUP = {"cup": (SubGoal(image(50), "cup"),), "two": (SubGoal(image(51), "a", at_most=1), SubGoal(image(52), "b"))}


def ask(served: Session, **keys: object) -> dict:
    reply = served.reply_to(pack(keys))
    assert isinstance(reply, bytes), reply
    return unpack(reply)


def get_error(served: Session, **keys: object) -> str:
    reply = served.reply_to(pack(keys))
    assert isinstance(reply, str)
    return reply


@pytest.mark.parametrize("changes", [{}, {"context": 2, "warm_start": True}])
def test_reply_equals_the_controllers_decision_bit_for_bit(changes: dict) -> None:
    served, controller = session(**changes), make_controller(**changes)
    controller.reset(image(100))
    for step in range(3):
        goal = {"goal_image": image(100)} if step != 1 else {}  # a client may send the goal once or with every request
        reply = ask(served, **request(step, **goal))
        action = controller.act(image(step), STATE)
        np.testing.assert_array_equal(reply["actions"][0], action)
        assert reply["actions"].shape == (2, 7)
        assert reply["actions"].dtype == np.float64
        np.testing.assert_array_equal(reply["actions"], controller.decision.plan.actions.double().numpy())
        np.testing.assert_array_equal(reply["target"], controller.decision.states[1:])
        assert reply["energy"] == {"now": controller.decision.current_energy, "plan": controller.decision.plan.energy}
        assert reply["why"] == "planned"
        assert reply["server_timing"].keys() == {"infer_ms"} | ({"prev_total_ms"} if step else set())


def test_all_arrays_of_a_reply_have_one_row_per_action() -> None:
    """Openpi's ActionChunkBroker slices all arrays, so every array of the reply has one row per action."""
    for form, rows in (("delta", 2), ("pose", 4)):
        reply = ask(session(SessionOptions(form)), **request(goal_image=image(1)))
        arrays_in = [value for value in reply.values() if isinstance(value, np.ndarray)]
        assert [array.shape for array in arrays_in] == [(rows, 7)]


def test_named_goal_or_prompt_selects_a_goal_of_the_server() -> None:
    served = session(goals=CUP)
    assert ask(served, **request(0, goal_name="cup"))["goal"]["name"] == "cup"
    first = ask(served, **request(1, prompt="two"))
    assert (first["goal"]["name"], first["goal"]["since"]) == ("a", 0)
    second = ask(served, **request(2, prompt="two"))
    assert (second["goal"]["name"], second["goal"]["index"], second["goal"]["since"]) == ("b", 1, 1)
    assert "the limit of 1 step is reached" in second["goal"]["changed"]
    assert "the name of a goal (the goals of this server are cup, two)" in get_error(served, **request(prompt="cap"))
    assert "no goal was set in this episode" in get_error(served, **request(3)), (
        "an invalid goal does not leave the previous goal active"
    )


def test_new_goal_reset_or_session_id_starts_a_new_episode() -> None:
    served = session()
    first = ask(served, **request(0, goal_image=image(100), session_id="a"))["actions"]
    repeated = ask(served, **request(0, goal_image=image(100), session_id="a"))["actions"]
    assert not np.array_equal(first, repeated), "the second decision has another seed"
    for keys in ({"session_id": "b"}, {"session_id": "b", "reset": True}):
        reply = ask(served, **request(0, goal_image=image(100), **keys))["actions"]
        np.testing.assert_array_equal(reply, first)
    assert ask(served, endpoint="reset", session_id="b") == {"status": "reset"}
    assert "no goal was set in this episode" in get_error(served, **request(0, session_id="b"))
    ask(served, endpoint="reset", **{"goal/image": image(100)})
    np.testing.assert_array_equal(ask(served, **request(0))["actions"], first)
    served.reset()
    assert "no goal was set in this episode" in get_error(served, **request(0))


def test_invalid_request_does_not_change_the_next_reply() -> None:
    served, other = session(), session()
    expected = [ask(other, **request(step, goal_image=image(100)))["actions"] for step in range(2)]
    np.testing.assert_array_equal(ask(served, **request(0, goal_image=image(100)))["actions"], expected[0])
    assert "frame: 32 x 24 pixels" in get_error(served, **request(1) | {"observation/image": image(1, 24, 32)})
    assert "degrees" in get_error(served, **request(1) | {"observation/state": STATE * [1, 1, 1, 60, 1, 1, 1]})
    assert "finite numbers" in get_error(served, **request(1) | {"observation/state": STATE * np.nan})
    assert served.reply_to(b"\xc1") == "the message is not valid msgpack within the size limits (FormatError)"
    np.testing.assert_array_equal(ask(served, **request(1))["actions"], expected[1])
    assert (served.counts.rejected, served.counts.failed) == (4, 0)


def test_internal_error_is_logged_and_not_sent_to_the_client(caplog, monkeypatch) -> None:
    served = session()
    ask(served, **request(0, goal_image=image(100)))

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("/home/me/secret.pt is broken")

    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(served.controller, "act", fail)
        assert get_error(served, **request(1)) == "internal error; the server's log contains the details"
    assert "secret" in caplog.text
    assert served.counts.failed == 1
    ask(served, **request(1))


class _ExpiringClock:
    """A clock that exceeds every deadline after a given number of reads."""

    def __init__(self, reads: int) -> None:
        self.left = reads

    def __call__(self) -> float:
        self.left -= 1
        return 0.0 if self.left >= 0 else 1e6


def test_deadline_returns_the_zero_action_and_does_not_change_the_next_decision() -> None:
    controller = make_controller()
    expired_session = Session(controller, None, SessionOptions(deadline_s=2.5), clock=_ExpiringClock(2))
    reply = ask(expired_session, **request(0, goal_image=image(100)))
    assert reply["why"] == "past the deadline"
    assert not reply["actions"].any()
    assert reply["actions"].shape == (2, 7)
    expired_session._clock = lambda: 0.0
    np.testing.assert_array_equal(
        ask(expired_session, **request(0))["actions"], ask(session(), **request(0, goal_image=image(100)))["actions"]
    )


def test_disconnect_ends_the_search_within_one_iteration() -> None:
    served, calls = session(iterations=50), []

    def is_disconnected() -> bool:
        calls.append(1)
        return len(calls) > 3

    with pytest.raises(ClientDisconnectedError):
        served.reply_to(pack(request(0, goal_image=image(100))), is_disconnected)
    assert len(calls) < 7


def test_dry_run_plans_and_sends_zero_actions() -> None:
    live = ask(session(), **request(0, goal_image=image(100)))
    dry = ask(session(SessionOptions(dry_run=True)), **request(0, goal_image=image(100)))
    assert dry["dry_run"] is True
    assert not dry["actions"].any()
    assert dry["target"] == [STATE.tolist()]
    assert dry["planned"] == live["target"]
    poses = ask(session(SessionOptions("pose", dry_run=True)), **request(0, goal_image=image(100)))
    np.testing.assert_allclose(poses["actions"], np.tile(STATE, (4, 1)), atol=1e-12)


BOX = ((0.3, -0.2, 0.1), (0.45, 0.2, 0.5))
LIMITS = LimitsConfig(xyz=(0.05, 0.04, 0.03), rotation=0.1, workspace=BOX)


class _UnsafeController(Controller):
    """A controller whose plan contains arbitrary actions."""

    planned_actions = np.zeros((2, 7))

    def act(self, frame: np.ndarray, state: np.ndarray, **options: object) -> np.ndarray:
        action = super().act(frame, state, **options)
        if self.decision.plan is not None:
            plan = replace(self.decision.plan, actions=torch.from_numpy(self.planned_actions))
            self.decision = replace(self.decision, plan=plan, action=self.planned_actions[0])
        return action


@pytest.fixture(scope="module")
def unsafe_session() -> Session:
    safe = make_controller(limits=LIMITS)
    unsafe, plans = _UnsafeController(safe._model, safe.config), []
    search = unsafe.planner.plan

    def search_once(*arguments: object) -> object:  # the actions of this plan are replaced
        plans[:] = plans or [search(*arguments)]
        return plans[0]

    unsafe.planner.plan = search_once
    return Session(unsafe)


LARGEST = np.array([*LIMITS.xyz_m, *[LIMITS.rotation] * 3, 1.0])
ANY_ACTIONS = arrays(np.float64, (2, 7), elements=st.floats(allow_nan=True, allow_infinity=True) | st.floats(-0.2, 0.2))
LIMIT_FRACTIONS = st.sampled_from([0.0, 0.5, 0.99, 1.5])  # of the limits of position, rotation and gripper
ACTIONS_NEAR_LIMITS = st.builds(
    lambda directions, fractions: directions * np.repeat(fractions, [3, 3, 1]) * LARGEST,
    arrays(np.float64, (2, 7), elements=st.floats(-1.0, 1.0)),
    st.tuples(LIMIT_FRACTIONS, LIMIT_FRACTIONS, LIMIT_FRACTIONS),
)


@settings(max_examples=150, deadline=None)
@example(
    np.array([[0.04, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]] * 2), "delta", 0.4
)  # both actions together leave the workspace
@given(ANY_ACTIONS | ACTIONS_NEAR_LIMITS, st.sampled_from(["delta", "pose"]), st.floats(0.26, 0.5))
def test_sent_action_is_within_the_limits_for_any_plan(
    unsafe_session: Session, planned_actions: np.ndarray, form: ActionForm, x: float
) -> None:
    unsafe_session.controller.planned_actions, unsafe_session.options = planned_actions, SessionOptions(form)
    state, frame = np.array([x, *STATE[1:]]), image(int(1e9 * x))  # the frame differs for each position of the arm
    reply = unsafe_session.reply_to(
        pack({"observation/image": frame, "observation/state": state, "goal/image": image(100)})
    )
    reply = unpack(reply)
    sent = reply["actions"]
    assert np.isfinite(sent).all()
    steps = sent
    if form == "pose":
        assert ((sent[:, 6] >= 0) & (sent[:, 6] <= 1)).all()
        steps = POSE.compute_differences(np.stack([state, sent[-1]]))
    assert (abs(steps) <= LARGEST + 1e-5).all()
    targets = state[:3] + np.cumsum(steps[:, :3], axis=0)
    is_inside = (targets >= np.array(BOX[0]) - 1e-5).all() and (targets <= np.array(BOX[1]) + 1e-5).all()
    assert is_inside or not abs(steps[:, :3]).max() > 1e-9
    if reply["why"].startswith("not sent"):
        assert not abs(steps).max() > 1e-9
        assert reply["target"] == [state.tolist()]
    else:
        assert reply["why"] in {"planned", "outside the workspace"}


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
def test_plan_with_one_number_beyond_its_limit_is_not_sent(step: int, axis: int, limit: float, word: str) -> None:
    assert find_limit_violation(STATE, changed(step, axis, limit), PLAIN, POSE) == ""
    for beyond in (limit + np.sign(limit) * 3e-6, 3 * limit):
        assert word in find_limit_violation(STATE, changed(step, axis, beyond), PLAIN, POSE)
    for wrong in (np.nan, np.inf, -np.inf):
        assert "not finite" in find_limit_violation(STATE, changed(step, axis, wrong), PLAIN, POSE)


def test_float32_rounding_of_limits_is_tolerated() -> None:
    for axis, limit in ((0, 0.05), (3, 0.1)):
        assert find_limit_violation(STATE, changed(0, axis, limit + 5e-7), PLAIN, POSE) == ""
    limits = PLAIN.model_copy(update={"rotation": np.pi})
    assert find_limit_violation(STATE, changed(0, 3, np.pi), limits, POSE) == ""
    assert "rotation" in find_limit_violation(STATE, changed(0, 3, np.pi + 5e-7), limits, POSE), (
        "a rotation beyond pi is a rotation in the other direction"
    )


@pytest.mark.parametrize(("steps", "is_sent"), [((0.02, 0.02), True), ((0.04, 0.04), False), ((0.04, -0.04), True)])
def test_cumulative_targets_must_be_in_the_workspace(steps: tuple[float, float], is_sent: bool) -> None:
    changes = np.zeros((2, 7))
    changes[:, 0] = steps
    assert find_limit_violation(STATE, changes, LIMITS, POSE) == (
        "" if is_sent else "a target is outside planning.limits.workspace"
    )
    assert find_limit_violation(STATE, changes, PLAIN, POSE) == ""


def test_rotation_outside_the_workspace_is_allowed() -> None:
    outside, turn = np.array([0.5, *STATE[1:]]), np.zeros((2, 7))
    turn[:, 3:] = 0.05
    assert find_limit_violation(outside, turn, LIMITS, POSE) == ""
    turn[0, 0] = -0.01  # ends outside the workspace
    assert "workspace" in find_limit_violation(outside, turn, LIMITS, POSE)


def test_vector_changes_must_be_within_their_limits() -> None:
    space, limits = make_vector_states(3), LimitsConfig(axes=(0.1, 0.2, 0.0))
    changes = np.array([[0.1, -0.2, 0.0], [-0.1, 0.2, 0.0]])
    assert find_limit_violation(np.zeros(3), changes, limits, space) == ""
    for axis, value in ((0, 0.11), (1, -0.21), (2, 0.01)):
        wrong = changes.copy()
        wrong[1, axis] = value
        assert "axes" in find_limit_violation(np.zeros(3), wrong, limits, space)
    assert "axes" in find_limit_violation(np.zeros(3), changes, LimitsConfig(), space), (
        "without limits no change is allowed"
    )


def test_padded_image_adds_a_note() -> None:
    padded = image(0)
    padded[:6], padded[-6:] = 0, 0
    assert has_black_bars(padded)
    assert not has_black_bars(image(0))
    assert not has_black_bars(np.zeros_like(padded)), "a dark image is not padding"
    served = session()
    assert ask(served, **request(0, goal_image=image(100)))["notes"] == []
    (note,) = ask(served, **request(1) | {"observation/image": padded})["notes"]
    assert note.startswith("black bars")


def test_vector_states_get_changes_or_targets_and_reject_poses() -> None:
    for joined in ("sum", "last"):
        controller, state = make_vector_controller(joined), np.full(8, 0.1)
        controller.reset(image(100))
        message = {"observation/image": image(0), "observation/state": state, "goal/image": image(100)}
        reply = unpack(Session(make_vector_controller(joined)).reply_to(pack(message)))
        np.testing.assert_array_equal(reply["actions"][0], controller.act(image(0), state))
        assert reply["actions"].shape == (2, 8)
        dry = unpack(Session(controller, None, SessionOptions(dry_run=True)).reply_to(pack(message)))
        np.testing.assert_array_equal(dry["actions"], np.tile(state if joined == "last" else 0 * state, (2, 1)))
        with pytest.raises(InputError, match="--actions pose: the states of the model are not poses"):
            Session(controller, None, SessionOptions("pose"))


def test_score_of_policy_chunks_makes_no_decision() -> None:
    served, controller = session(), make_controller()
    controller.reset(image(100))
    chunks = STATE + np.random.default_rng(0).normal(0, 0.01, (3, 8, 7)) * [1, 1, 1, 1, 1, 1, 0]
    keys = {"endpoint": "score", "policy/chunks": chunks}
    reply = ask(served, **request(goal_image=image(100), **keys))
    expected = controller.score(image(0), STATE, changes_of_chunks(chunks, STATE, form="targets", control_steps=4))
    np.testing.assert_array_equal(reply["energies"], expected.energies)
    assert (reply["best"], reply["tied"], reply["is_blind"]) == (expected.best, expected.tied, False)
    assert not served.counts.decisions
    blind = session(SessionOptions(is_blind=True))
    reply = ask(blind, **request(goal_image=image(100), **keys))
    assert (reply["best"], reply["is_blind"]) == (None, True)
    assert "3 control steps" in get_error(served, **request(**keys | {"policy/chunks": chunks[:, :3]}))
    assert "no goal" in get_error(session(), **request(**keys))


def test_search_starts_from_policy_chunks() -> None:
    controller = make_controller()
    controller.reset(image(100))
    chunks = np.tile(np.array([0.01, 0.0, -0.005, 0, 0, 0, 0.0]), (4, 8, 1))
    changes = changes_of_chunks(chunks, STATE, form="deltas", control_steps=4)
    action = controller.act(image(0), STATE, samples=changes)
    reply = ask(session(), **request(goal_image=image(100), **{"policy/chunks": chunks, "policy/form": "deltas"}))
    np.testing.assert_array_equal(reply["actions"][0], action)
    assert not np.array_equal(action, ask(session(), **request(goal_image=image(100)))["actions"][0])
    short = {"policy/chunks": chunks[:, :4], "policy/form": "deltas"}
    assert "samples of a policy" in get_error(session(), **request(goal_image=image(100), **short))


def test_frozen_camera_gives_the_zero_action_until_a_reset() -> None:
    served, start_state, moved = session(), STATE.copy(), STATE + np.eye(7)[0] * 0.006
    for form in ({"session_id": "a"}, {"session_id": "b"}, {"session_id": "b", "reset": True}):
        assert ask(served, **request(0, goal_image=image(100), **form))["why"] == "planned"
        for _ in range(2):
            reply = ask(served, **request(0) | {"observation/state": moved})
            assert (reply["why"], reply["target"], reply["energy"]["now"]) == ("frozen frame", [moved.tolist()], None)
            assert not reply["actions"].any()
    served.reset()
    assert ask(served, **request(0, goal_image=image(100)) | {"observation/state": moved})["why"] == "planned"
    assert ask(served, **request(0) | {"observation/state": start_state})["why"] == "frozen frame"
    assert served.counts.decisions == {"planned": 4, "frozen frame": 7}


CHUNKS = STATE + np.random.default_rng(0).normal(0, 0.01, (300, 4, 7)) * [1, 1, 1, 1, 1, 1, 0]
SCORE = {"endpoint": "score", "policy/chunks": CHUNKS}


@pytest.mark.parametrize("ended_by", ["deadline", "client"])
def test_cancelled_score_stops_after_the_current_batch(ended_by: str, monkeypatch: pytest.MonkeyPatch) -> None:
    served = session(energy=EnergyConfig(samples_at_once=16))
    ask(served, **request(goal_image=image(100)))
    batch_sizes: list[int] = []
    rollout = served.controller._model.rollout

    def record_batch(frame: torch.Tensor, *arguments: object, **options: object) -> object:
        batch_sizes.append(len(frame))
        return rollout(frame, *arguments, **options)

    monkeypatch.setattr(served.controller._model, "rollout", record_batch)
    message = pack(request(1, **SCORE))
    if ended_by == "client":
        with pytest.raises(ClientDisconnectedError):
            served.reply_to(message, lambda: bool(batch_sizes))
    else:
        served._clock = _ExpiringClock(2)
        assert served.reply_to(message).startswith("request: not finished within the deadline")
    assert batch_sizes == [16]


@pytest.mark.parametrize("endpoint", ["infer", "reset"])
def test_goal_encoding_stops_at_the_deadline(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    served, encoded = session(), []
    monkeypatch.setattr(served.controller, "encode", lambda _: encoded.append(1) or torch.zeros(9, 32))
    served._clock = _ExpiringClock(3)
    goals = {"goal/images": np.stack([image(seed) for seed in range(5)]), "goal/rules": [{"at_most": 1}] * 4 + [{}]}
    reply = served.reply_to(pack(request(**goals) | {"endpoint": endpoint}))
    assert len(encoded) == 2
    if endpoint == "infer":
        reply = unpack(reply)
        assert (reply["why"], reply["goal"], reply["actions"].any()) == ("past the deadline", None, np.False_)
    else:
        assert reply.startswith("request: not finished within the deadline")
    served._clock = lambda: 0.0
    monkeypatch.undo()
    assert "no goal was set in this episode" in get_error(served, **request())


def test_episode_is_counted_once_and_not_for_a_reset_alone() -> None:
    served = session()
    served.reset()
    assert served.counts.episodes == 0
    ask(served, endpoint="reset", session_id="a")
    assert served.counts.episodes == 1
    ask(served, **request(goal_image=image(100), session_id="a"))
    assert served.counts.episodes == 1
    ask(served, **request(goal_image=image(100), session_id="b"))
    ask(served, **request(goal_image=image(100), reset=True))
    assert served.counts.episodes == 3
    served.reset()
    ask(served, **request(goal_image=image(100)))
    assert served.counts.episodes == 4, "a client without session ids starts an episode after a reset"


# ---- waypoints ----

NEAR_PI = np.array([0.4, 0.1, 0.3, np.pi - 0.02, 0.1, -1.2, 0.5])
ACTION = np.array([0.02, -0.01, 0.03, 0.3, -0.2, 0.4, 0.25])


@pytest.mark.parametrize("steps", [1, 4, 7])
def test_waypoints_are_evenly_spaced_and_end_at_the_target(steps: int) -> None:
    reply = interpolate_waypoints(NEAR_PI, ACTION, steps)
    np.testing.assert_array_equal(reply[-1], apply_action(NEAR_PI, ACTION))
    changes = actions_from_states(np.concatenate([NEAR_PI[None], reply]))
    np.testing.assert_allclose(changes, np.broadcast_to(changes[0], changes.shape), atol=1e-9)
    np.testing.assert_allclose(changes[:, :3].sum(axis=0), ACTION[:3], atol=1e-12)


def test_zero_action_keeps_the_pose_and_gripper_is_clipped() -> None:
    np.testing.assert_allclose(interpolate_waypoints(NEAR_PI, np.zeros(7), 3), np.tile(NEAR_PI, (3, 1)), atol=1e-12)
    closing = np.array([0, 0, 0, 0, 0, 0, 1.0])
    assert interpolate_waypoints(NEAR_PI, closing, 4)[:, 6].tolist() == [0.75, 1.0, 1.0, 1.0]
