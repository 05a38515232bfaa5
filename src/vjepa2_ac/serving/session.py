"""Reply to the requests of one robot with the decisions of a controller. This module does not use the network.

On any error the robot does not move. The reply to an invalid request is a sentence, which openpi's clients raise as an
error. Without a plan the reply contains the zero action. No action is sent twice, and the limits of each planned action
are checked once more, independently of the planner.
"""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vjepa2_ac.config.planning import LimitsConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller, Decision
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.planning.planner import Cancelled, SearchCancelledError
from vjepa2_ac.planning.search_space import Workspace, is_within_limits
from vjepa2_ac.policies.score import changes_of_chunks
from vjepa2_ac.serving.recording import Recorder
from vjepa2_ac.serving.request import IMAGE_KEYS, GoalRequest, Request, read_request
from vjepa2_ac.serving.wire import WireError, pack, unpack
from vjepa2_ac.spaces import StateSpace, apply_action, euler_from_matrices, matrices_from_euler
from vjepa2_ac.storage.structured import to_plain

logger = logging.getLogger(__name__)

ActionForm = Literal["delta", "pose"]
Clock = Callable[[], float]  # seconds since an arbitrary time

_MAX_NAMES = 20  # names of goals in an error message
DEADLINE_EXCEEDED = "past the deadline"
_ALARM = "the camera image differs from the predicted frame; check the robot"
_BAR_HEIGHT = 0.05  # smallest height of a black bar, as a fraction of the image's height


@dataclass(frozen=True)
class SessionOptions:
    """The options of a session."""

    actions: ActionForm = "delta"
    control_steps: int = 4  # control steps per model step; with `actions="pose"` the number of waypoints per reply
    image_keys: tuple[str, ...] = IMAGE_KEYS
    deadline_s: float = 60.0  # for a decision, including the encoding of its goal; a late decision is a zero action
    dry_run: bool = False  # whether to plan but send the zero action
    is_blind: bool = (
        False  # whether the model ranks actions at chance level; the field `best` of a reply with scores is then None
    )


@dataclass
class Counts:
    """Counters of a session, for the URL /metrics."""

    decisions: Counter[str] = field(default_factory=Counter)  # number of decisions by reason
    rejected: int = 0  # invalid requests
    failed: int = 0  # requests that ended in an internal error
    episodes: int = 0
    alarms: int = 0  # frames whose surprise was above the threshold
    surprise: float = 0.0  # of the last monitored frame
    seconds: float = 0.0  # total duration of all decisions


class ClientDisconnectedError(Exception):
    """The client has disconnected, so no reply is needed."""


class Session:
    """Replies to the requests of one robot at a time.

    Raises:
        InputError: `actions` is "pose", but the model's states are not poses.
    """

    def __init__(
        self,
        controller: Controller,
        goals: Mapping[str, tuple[SubGoal, ...]] | None = None,
        options: SessionOptions | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        """Create a session.

        Args:
            controller: Plans the actions.
            goals: Goals that a client can select by name.
            options: Options of the session.
            clock: Measures the deadline.
        """
        self.controller, self.options = controller, options or SessionOptions()
        self.goals = goals or {}
        self.counts = Counts()
        self.recorder: Recorder | None = None  # records every decision
        self._clock = clock
        self._episode: str | None = None
        self._has_episode = False  # whether the current robot has started an episode
        self._goal: str | None = None  # fingerprint of the current goal
        self._sub_goal_names: tuple[str, ...] = ()  # of the current goal
        self._notes: list[str] = []  # notes for the client in this episode
        self._last_ms: float | None = None  # duration of the previous request
        if self.options.actions == "pose" and not controller.spaces.state.is_pose:
            problem = "the states of the model are not poses"
            raise InputError(
                where="--actions pose", found=problem, needed="--actions delta, or a model with pose states"
            )

    def reset(self) -> None:
        """Reset the state of the session for another robot."""
        self._episode, self._has_episode, self._last_ms = None, False, None

    def reply_to(self, message: bytes, is_disconnected: Callable[[], bool] = lambda: False) -> bytes | str:
        """Return the reply to a message: an encoded map, or the text of an error.

        Args:
            message: The received bytes.
            is_disconnected: Returns whether the client has disconnected.

        Raises:
            ClientDisconnectedError: The client disconnected during the search.
        """
        start_time = self._clock()
        try:
            request = read_request(unpack(message), self.options.image_keys)
            reply = self._handle(request, start_time, is_disconnected)
        except (WireError, InputError) as error:
            self.counts.rejected += 1
            return str(error)
        except ClientDisconnectedError:
            raise
        except Exception:
            self.counts.failed += 1
            logger.exception("an internal error occurred while a request was processed")
            return "internal error; the server's log contains the details"
        self._last_ms = 1e3 * (self._clock() - start_time)
        return pack(reply)

    def _handle(self, request: Request, start_time: float, is_disconnected: Callable[[], bool]) -> dict[str, Any]:
        if request.is_new_episode or not self._has_episode or request.episode not in (None, self._episode):
            self._episode, self._has_episode, self._goal, self._notes = request.episode or self._episode, True, None, []
            self.counts.episodes += 1
        deadline = start_time + self.options.deadline_s
        try:
            return self._execute(request, start_time, lambda: is_disconnected() or self._clock() > deadline)
        except SearchCancelledError:
            if is_disconnected():
                raise ClientDisconnectedError from None
            if request.frame is None or request.state is None or request.is_score:
                fix = "Send fewer goals or chunks, or increase --deadline"
                raise InputError(
                    where="request", found=f"not finished within the deadline of {self.options.deadline_s:g} s", fix=fix
                ) from None
            return self._make_reply(request.frame, request.state, (None, DEADLINE_EXCEEDED), (start_time, start_time))

    def _execute(self, request: Request, start_time: float, cancelled: Cancelled) -> dict[str, Any]:
        """Set the goal of a request if it is new, then decide or score, and return the reply.

        Raises:
            SearchCancelledError: The search was cancelled.
        """
        if request.goal is not None and (fingerprint := request.goal.fingerprint) != self._goal:
            self._goal, self._notes = None, []  # in case the new goal is invalid
            self._set_goal(request.goal, cancelled)
            self._goal = fingerprint
        if request.frame is None or request.state is None:
            return {"status": "reset"}
        if self._goal is None:
            needed = f"goal/image, goal/images or goal/name{self._list_goal_names()}"
            raise InputError(where="request", found="no goal was set in this episode", needed=needed)
        changes, planning_start = self._convert_chunks(request), self._clock()
        observation = request.frame, request.state
        if request.is_score and changes is not None:  # the robot does not move, and no decision is counted
            scores = self.controller.score(*observation, changes, cancelled=cancelled)
            return {**scores.as_dict(is_blind=self.options.is_blind), "goal": scores.goal}
        self.controller.act(*observation, samples=changes, cancelled=cancelled)
        decision, why = self._check_limits(request.state)
        self._warn_about_padding(request.frame)
        self._count_surprise(decision)
        return self._make_reply(*observation, (decision, why), (start_time, planning_start))

    def _convert_chunks(self, request: Request) -> Float[np.ndarray, "chunks model_steps dim"] | None:
        """Convert the action chunks of a request into changes per model step; None if there are none."""
        if request.chunks is None or request.state is None:
            return None
        steps, space = self.options.control_steps, self.controller.spaces.state
        return changes_of_chunks(request.chunks, request.state, form=request.form, control_steps=steps, space=space)

    def _make_reply(
        self,
        frame: np.ndarray,
        state: np.ndarray,
        decision_and_reason: tuple[Decision | None, str],
        start_times: tuple[float, float],
    ) -> dict[str, Any]:
        """Return the reply to a request for an action; count and record it.

        Args:
            frame: The camera image.
            state: The measured state.
            decision_and_reason: The decision, or None, and its reason.
            start_times: Start times of the request and of the planning.
        """
        reply, now = self._format_decision(decision_and_reason[0], state, why := decision_and_reason[1]), self._clock()
        reply["server_timing"], reply["policy_timing"] = ({"infer_ms": 1e3 * (now - start)} for start in start_times)
        if self._last_ms is not None:
            reply["server_timing"]["prev_total_ms"] = self._last_ms
        self.counts.decisions[why] += 1
        self.counts.seconds += now - start_times[0]
        if self.recorder is not None:
            self.recorder.write_decision(frame, state, reply)
        return reply

    def _check_limits(self, state: np.ndarray) -> tuple[Decision, str]:
        """Return the decision of the controller and its reason, without the plan if it violates the limits."""
        decision, controller = self.controller.decision, self.controller
        if decision is None:
            raise ValueError("the controller has no decision after `act`")
        if decision.plan is None:
            return decision, decision.why
        changes = decision.plan.actions.double().numpy()
        reason = find_limit_violation(state, changes, controller.config.limits, controller.spaces.state)
        if not reason:
            return decision, decision.why
        logger.error("a planned action was not sent: %s", reason)
        return replace(decision, plan=None, states=None), f"not sent: {reason}"

    def _format_decision(self, decision: Decision | None, state: np.ndarray, why: str) -> dict[str, Any]:
        """Return the reply for a decision. Without a decision, or if it has no plan, the action is zero.

        For each action a client takes one row of every array in the reply. So only values with one row per action are
        arrays.
        """
        planned, changes = np.atleast_2d(state), np.zeros((self.controller.space.steps, self.controller.space.dim))
        reply: dict[str, Any] = {
            "target": planned, "why": why, "goal": None, "done": False, "energy": {"now": None, "plan": None},
            "notes": self._notes,
        }  # fmt: skip
        if decision is not None:
            progress, plan = decision.progress, decision.plan
            name = self._sub_goal_names[progress.goal_index]
            goal = {
                "index": progress.goal_index,
                "name": name,
                "since": progress.start_step,
                "changed": progress.changed,
            }
            energy = {"now": decision.current_energy, "plan": None if plan is None else plan.energy}
            reply |= {"goal": goal, "done": decision.is_done, "energy": energy}
            if (surprise := decision.surprise) is not None:
                reply["surprise"] = {"score": surprise.score, "is_alarm": surprise.is_alarm}
                if surprise.is_alarm:
                    reply["notes"] = [*self._notes, _ALARM]
            planned = planned if decision.states is None else decision.states[1:]
            if plan is not None and not self.options.dry_run:
                changes = plan.actions.double().numpy()
        reply |= {"dry_run": True, "planned": planned} if self.options.dry_run else {"target": planned}
        return {"actions": self._format_actions(state, changes), **to_plain(reply)}

    def _format_actions(
        self, state: np.ndarray, changes: Float[np.ndarray, "steps dim"]
    ) -> Float[np.ndarray, "rows dim"]:
        """Convert the changes of a plan into the actions of the reply.

        With `actions="pose"` the actions are waypoints to the first target. Otherwise there is one action per model
        step: the target state if the model was trained on recorded targets, else the change.
        """
        if self.options.actions == "pose":
            return interpolate_waypoints(state, changes[0], self.options.control_steps)
        if self.controller.spaces.action.effect == "target":
            return np.asarray(state + np.cumsum(changes, axis=0))
        return changes

    def _set_goal(self, goal: GoalRequest, cancelled: Cancelled) -> None:
        if goal.name is not None and goal.name not in self.goals:
            needed = f"the name of a goal{self._list_goal_names()}"
            raise InputError(where="goal", found=f"unknown goal {goal.name!r}", needed=needed)
        goals = goal.goals if goal.name is None else self.goals[goal.name]
        self.controller.follow(goals, mask=goal.mask, cancelled=cancelled)
        self._sub_goal_names = tuple(sub_goal.name for sub_goal in goals)
        if self.recorder is not None:
            self.recorder.set_goals(goals, goal.mask)

    def _list_goal_names(self) -> str:
        names = list(self.goals)
        more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
        return f" (the goals of this server are {', '.join(names[:_MAX_NAMES])}{more})" if names else ""

    def _count_surprise(self, decision: Decision) -> None:
        if (surprise := decision.surprise) is not None:
            self.counts.surprise = surprise.score
            self.counts.alarms += surprise.is_alarm
            if surprise.is_alarm:
                logger.warning("surprise %.4g: %s", surprise.score, _ALARM)

    def _warn_about_padding(self, frame: np.ndarray) -> None:
        text = "black bars at the top and bottom of the image; send images without padding"
        if has_black_bars(frame) and text not in self._notes:
            self._notes.append(text)
            logger.warning(text)


def has_black_bars(frame: np.ndarray) -> bool:
    """Return whether an image is padded with black bars at the top and bottom, as by openpi's `resize_with_pad`."""
    rows = max(1, int(_BAR_HEIGHT * len(frame)))
    return not frame[:rows].any() and not frame[-rows:].any() and bool(frame.any())


def interpolate_waypoints(
    state: Float[np.ndarray, " 7"], action: Float[np.ndarray, " 7"], steps: int
) -> Float[np.ndarray, "steps 7"]:
    """Return evenly spaced poses between a state and its target; the last pose is the target.

    A pose is x, y, z in metres, extrinsic xyz angles in radians, and gripper position from 0 to 1. The position moves
    along a straight line. The rotation is about one axis with constant speed.

    Args:
        state: The measured pose.
        action: The change of the pose in one model step.
        steps: Control steps per model step.
    """
    fractions = np.arange(1, steps + 1)[:, None] / steps
    turn = Rotation.from_matrix(matrices_from_euler(action[3:6])).as_rotvec()
    turns = Rotation.from_rotvec(fractions * turn).as_matrix()
    positions, gripper = (state[part] + fractions * action[part] for part in (slice(0, 3), slice(6, 7)))
    poses = np.concatenate([positions, euler_from_matrices(turns @ matrices_from_euler(state[3:6])), gripper], axis=1)
    poses[-1] = apply_action(state, action)  # bit-identical to the target of the plan
    poses[:, 6] = poses[:, 6].clip(0.0, 1.0)
    return poses


_ROUNDING = 1e-6  # tolerance for the float32 rounding of planned actions


def find_limit_violation(
    state: Float[np.ndarray, " dim"], changes: Float[np.ndarray, "steps dim"], limits: LimitsConfig, space: StateSpace
) -> str:
    """Return the reason for which planned changes must not be sent to a robot; empty if they may be sent.

    Args:
        state: The measured state.
        changes: The change of the state in each model step.
        limits: The limits of actions.
        space: The meaning of the numbers of a state.
    """
    if not np.isfinite(changes).all():
        return "a number is not finite"
    if not space.is_pose:
        largest = np.array(limits.axes if isinstance(limits.axes, tuple) else (0.0,))
        return "a change exceeds planning.limits.axes" if (abs(changes) > largest + _ROUNDING).any() else ""
    if not is_within_limits(changes[:, :3], limits, _ROUNDING):
        return "a translation exceeds planning.limits.xyz or l1"
    if (abs(changes[:, 3:6]) > min(limits.rotation + _ROUNDING, math.pi)).any():
        return "a rotation exceeds planning.limits.rotation"
    if (
        abs(changes[:, 6]).max() > 1.0
    ):  # the gripper modes `open` and `close` command a change of 1, whatever the limit is
        return "a gripper change exceeds 1"
    box, targets = Workspace.from_limits(limits, space), state[:3] + np.cumsum(changes[:, :3], axis=0)
    is_out = box is not None and changes[:, :3].any() and (abs(box.get_return_motion(targets)) > _ROUNDING).any()
    return "a target is outside planning.limits.workspace" if is_out else ""
