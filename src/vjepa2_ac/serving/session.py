"""The session: one robot's requests, answered by a controller. It knows no sockets.

Whatever is wrong or doubtful, nobody moves: a request that cannot be used is answered by a sentence, which openpi's
clients raise as an error, and a decision without a result by an action of zeros. No action is ever sent twice, and each
is checked once more, independently of how it was planned.
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
from vjepa2_ac.planning.search_space import Workspace, is_allowed
from vjepa2_ac.policies.score import changes_of_chunks
from vjepa2_ac.serving.recording import Recorder
from vjepa2_ac.serving.request import IMAGE_KEYS, GivenGoal, Request, read_request
from vjepa2_ac.serving.wire import WireError, pack, unpack
from vjepa2_ac.spaces import StateSpace, apply_action, euler_from_matrices, matrices_from_euler
from vjepa2_ac.storage.structured import plain

logger = logging.getLogger(__name__)

ActionForm = Literal["delta", "pose"]
Clock = Callable[[], float]  # seconds, from anywhere

_MOST_NAMES = 20  # of goals in a message
LATE = "past the deadline"
_ALARM = "what the camera sees departs from what was predicted: look at the robot"
_BAR = 0.05  # share of an image's height, black at the top and at the bottom: a padded image


@dataclass(frozen=True)
class SessionOptions:
    """How a session answers."""

    actions: ActionForm = "delta"
    control_steps: int = 4  # of a model step: as many waypoints has an answer of poses
    image_keys: tuple[str, ...] = IMAGE_KEYS
    deadline_s: float = 60.0  # for a decision, its goal's encoding included; then the action is zero
    dry_run: bool = False  # plans, and sends zeros
    is_blind: bool = False  # the model ranks true actions no better than chance: it names no best chunk


@dataclass
class Counts:
    """What a session has done, for whoever watches it."""

    decisions: Counter[str] = field(default_factory=Counter)  # by their reason
    refused: int = 0
    failed: int = 0
    episodes: int = 0
    alarms: int = 0  # frames that departed from what was predicted
    surprise: float = 0.0  # of the last frame that was compared
    seconds: float = 0.0  # that all decisions took


class GoneError(Exception):
    """Nobody waits for the answer any more."""


class Session:
    """Answers the requests of one robot after another.

    Raises:
        InputError: Poses are to be sent, and states are none.
    """

    def __init__(
        self,
        controller: Controller,
        goals: Mapping[str, tuple[SubGoal, ...]] | None = None,
        options: SessionOptions | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        """Begin without a robot.

        Args:
            controller: Plans.
            goals: That a client may name.
            options: How it answers.
            clock: Measures the deadline.
        """
        self.controller, self.options = controller, options or SessionOptions()
        self.goals = goals or {}
        self.counts = Counts()
        self.recorder: Recorder | None = None  # writes every decision down
        self._clock = clock
        self._episode: str | None = None
        self._has_begun = False  # whether there was an episode of this robot
        self._goal: str | None = None  # fingerprint of the present one
        self._names: tuple[str, ...] = ()  # of its parts
        self._notes: list[str] = []  # that hold for this episode
        self._last_ms: float | None = None
        if self.options.actions == "pose" and not controller.spaces.state.is_pose:
            found = "a model whose states are not poses"
            raise InputError(where="--actions pose", found=found, needed="--actions delta, or a model of poses")

    def begin(self) -> None:
        """Begin with another robot: nothing of the last one is left."""
        self._episode, self._has_begun, self._last_ms = None, False, None

    def answer(self, message: bytes, is_gone: Callable[[], bool] = lambda: False) -> bytes | str:
        """Return the answer to a message: a map, or the sentence of an error.

        Args:
            message: From the wire.
            is_gone: Whether nobody waits for the answer any more.

        Raises:
            GoneError: Nobody does.
        """
        began = self._clock()
        try:
            request = read_request(unpack(message), self.options.image_keys)
            found = self._answered(request, began, is_gone)
        except (WireError, InputError) as error:
            self.counts.refused += 1
            return str(error)
        except GoneError:
            raise
        except Exception:
            self.counts.failed += 1
            logger.exception("a request could not be answered")
            return "the server failed at this request; its log says more"
        self._last_ms = 1e3 * (self._clock() - began)
        return pack(found)

    def _answered(self, request: Request, began: float, is_gone: Callable[[], bool]) -> dict[str, Any]:
        if request.begins or not self._has_begun or request.episode not in (None, self._episode):
            self._episode, self._has_begun, self._goal, self._notes = request.episode or self._episode, True, None, []
            self.counts.episodes += 1
        until = began + self.options.deadline_s
        try:
            return self._carried_out(request, began, lambda: is_gone() or self._clock() > until)
        except SearchCancelledError:
            if is_gone():
                raise GoneError from None
            if request.frame is None or request.state is None or request.is_score:
                fix = "Send fewer goals or chunks, or raise --deadline"
                raise InputError(where="request", found=f"no answer: {LATE}", fix=fix) from None
            return self._sent(request.frame, request.state, (None, LATE), (began, began))

    def _carried_out(self, request: Request, began: float, cancelled: Cancelled) -> dict[str, Any]:
        """Return the answer to a request.

        Raises:
            SearchCancelledError: It was cancelled.
        """
        if request.goal is not None and (fingerprint := request.goal.fingerprint) != self._goal:
            self._goal, self._notes = None, []  # a goal that cannot be used leaves none
            self._set(request.goal, cancelled)
            self._goal = fingerprint
        if request.frame is None or request.state is None:
            return {"status": "reset"}
        if self._goal is None:
            needed = f"a goal first: goal/image, goal/images or goal/name{self._known_names()}"
            raise InputError(where="request", found="no goal in this episode", needed=needed)
        changes, planning_began, seen = self._changes(request), self._clock(), (request.frame, request.state)
        if request.is_score and changes is not None:  # nothing moves, and no decision is counted
            found = self.controller.score(*seen, changes, cancelled=cancelled)
            return {**found.as_dict(is_blind=self.options.is_blind), "goal": found.goal}
        self.controller.act(*seen, samples=changes, cancelled=cancelled)
        decision, why = self._checked(request.state)
        self._note(request.frame)
        self._watch(decision)
        return self._sent(*seen, (decision, why), (began, planning_began))

    def _changes(self, request: Request) -> Float[np.ndarray, "chunks model_steps dim"] | None:
        """Return what a policy would do as changes of model steps."""
        if request.chunks is None or request.state is None:
            return None
        steps, space = self.options.control_steps, self.controller.spaces.state
        return changes_of_chunks(request.chunks, request.state, form=request.form, control_steps=steps, space=space)

    def _sent(
        self,
        frame: np.ndarray,
        state: np.ndarray,
        decided: tuple[Decision | None, str],
        began: tuple[float, float],
    ) -> dict[str, Any]:
        """Return the answer to a request for an action; it is counted and recorded.

        Args:
            frame: What the camera saw.
            state: Measured.
            decided: The decision, if there is one, and its reason.
            began: When the request and its planning began.
        """
        found, now = self._message(decided[0], state, why := decided[1]), self._clock()
        found["server_timing"], found["policy_timing"] = ({"infer_ms": 1e3 * (now - one)} for one in began)
        if self._last_ms is not None:
            found["server_timing"]["prev_total_ms"] = self._last_ms
        self.counts.decisions[why] += 1
        self.counts.seconds += now - began[0]
        if self.recorder is not None:
            self.recorder.decision(frame, state, found)
        return found

    def _checked(self, state: np.ndarray) -> tuple[Decision, str]:
        """Return the decision, and why it is so; without a plan where that must not be sent."""
        decision, controller = self.controller.decision, self.controller
        if decision is None:
            raise ValueError("a controller that acted has decided")
        if decision.plan is None:
            return decision, decision.why
        changes = decision.plan.actions.double().numpy()
        wrong = why_not_sent(state, changes, controller.config.limits, controller.spaces.state)
        if not wrong:
            return decision, decision.why
        logger.error("a planned action is not sent: %s", wrong)
        return replace(decision, plan=None, states=None), f"not sent: {wrong}"

    def _message(self, decision: Decision | None, state: np.ndarray, why: str) -> dict[str, Any]:
        """Return an answer. Its arrays have one row an action, and all else is plain: clients take rows of arrays.

        Without a decision, or a plan in it, nobody moves.
        """
        planned, changes = np.atleast_2d(state), np.zeros((self.controller.space.steps, self.controller.space.dim))
        found: dict[str, Any] = {
            "target": planned, "why": why, "goal": None, "done": False, "energy": {"now": None, "plan": None},
            "notes": self._notes,
        }  # fmt: skip
        if decision is not None:
            progress, plan = decision.progress, decision.plan
            name = self._names[progress.place]
            goal = {"index": progress.place, "name": name, "since": progress.since, "changed": progress.changed}
            energy = {"now": decision.energy_now, "plan": None if plan is None else plan.energy}
            found |= {"goal": goal, "done": decision.done, "energy": energy}
            if (seen := decision.surprise) is not None:
                found["surprise"] = {"score": seen.score, "is_alarm": seen.is_alarm}
                if seen.is_alarm:
                    found["notes"] = [*self._notes, _ALARM]
            planned = planned if decision.states is None else decision.states[1:]
            if plan is not None and not self.options.dry_run:
                changes = plan.actions.double().numpy()
        found |= {"dry_run": True, "planned": planned} if self.options.dry_run else {"target": planned}
        return {"actions": self._actions(state, changes), **plain(found)}

    def _actions(self, state: np.ndarray, changes: Float[np.ndarray, "steps dim"]) -> Float[np.ndarray, "rows dim"]:
        """Return changes as the robot wants them: waypoints to the first target, or what each model step does."""
        if self.options.actions == "pose":
            return waypoints(state, changes[0], self.options.control_steps)
        if self.controller.spaces.action.follows == "target":
            return np.asarray(state + np.cumsum(changes, axis=0))
        return changes

    def _set(self, goal: GivenGoal, cancelled: Cancelled) -> None:
        if goal.name is not None and goal.name not in self.goals:
            needed = f"the name of one{self._known_names()}"
            raise InputError(where="goal", found=f"{goal.name!r}, which names no goal", needed=needed)
        goals = goal.goals if goal.name is None else self.goals[goal.name]
        self.controller.follow(goals, mask=goal.mask, cancelled=cancelled)
        self._names = tuple(one.name for one in goals)
        if self.recorder is not None:
            self.recorder.goal(goals, goal.mask)

    def _known_names(self) -> str:
        names = list(self.goals)
        more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
        return f" (this server keeps {', '.join(names[:_MOST_NAMES])}{more})" if names else ""

    def _watch(self, decision: Decision) -> None:
        if (found := decision.surprise) is not None:
            self.counts.surprise = found.score
            self.counts.alarms += found.is_alarm
            if found.is_alarm:
                logger.warning("surprise %.4g: what is seen departs from what was predicted", found.score)

    def _note(self, frame: np.ndarray) -> None:
        text = "black bars at the top and the bottom of the picture: send whole frames, not padded ones"
        if has_black_bars(frame) and text not in self._notes:
            self._notes.append(text)
            logger.warning(text)


def has_black_bars(frame: np.ndarray) -> bool:
    """Return whether an image was padded at its top and its bottom, as openpi's `resize_with_pad` does."""
    rows = max(1, int(_BAR * len(frame)))
    return not frame[:rows].any() and not frame[-rows:].any() and bool(frame.any())


def waypoints(
    state: Float[np.ndarray, " 7"], action: Float[np.ndarray, " 7"], steps: int
) -> Float[np.ndarray, "steps 7"]:
    """Return evenly spaced poses to the target, which is the last: x, y, z, extrinsic xyz angles, closedness 0 .. 1.

    Positions go straight, rotations about one axis at one speed (R_delta^share @ R).

    Args:
        state: Measured: metres, radians, closedness.
        action: Its change in a model step.
        steps: Control steps of a model step.
    """
    shares = np.arange(1, steps + 1)[:, None] / steps
    turn = Rotation.from_matrix(matrices_from_euler(action[3:6])).as_rotvec()
    turns = Rotation.from_rotvec(shares * turn).as_matrix()
    positions, gripper = (state[part] + shares * action[part] for part in (slice(0, 3), slice(6, 7)))
    poses = np.concatenate([positions, euler_from_matrices(turns @ matrices_from_euler(state[3:6])), gripper], axis=1)
    poses[-1] = apply_action(state, action)  # to the last bit
    poses[:, 6] = poses[:, 6].clip(0.0, 1.0)
    return poses


_ROUNDING = 1e-6  # limits are float32 where actions are searched


def why_not_sent(
    state: Float[np.ndarray, " dim"], changes: Float[np.ndarray, "steps dim"], limits: LimitsConfig, space: StateSpace
) -> str:
    """Return why changes of a state must not be sent to a robot, as text; empty: they may.

    Args:
        state: Measured.
        changes: Of each model step, one after another.
        limits: Which they have to be within.
        space: What the numbers are.
    """
    if not np.isfinite(changes).all():
        return "a number that is not finite"
    if not space.is_pose:
        largest = np.array(limits.axes if isinstance(limits.axes, tuple) else (0.0,))
        return "more than planning.limits.axes" if (abs(changes) > largest + _ROUNDING).any() else ""
    if not is_allowed(changes[:, :3], limits, _ROUNDING):
        return "more than planning.limits.xyz or l1"
    if (abs(changes[:, 3:6]) > min(limits.rotation + _ROUNDING, math.pi)).any():
        return "more than planning.limits.rotation"
    if abs(changes[:, 6]).max() > 1.0:  # open and close are changes of 1, whatever the limit
        return "more than a gripper can change"
    box, targets = Workspace.of(limits, space), state[:3] + np.cumsum(changes[:, :3], axis=0)
    is_out = box is not None and changes[:, :3].any() and (abs(box.way_back(targets)) > _ROUNDING).any()
    return "out of planning.limits.workspace" if is_out else ""
