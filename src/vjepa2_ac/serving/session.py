"""The session: one robot's requests, answered by a controller. It knows no sockets.

Whatever is wrong or doubtful, nobody moves: a request that cannot be used is answered by a sentence, which openpi's
clients raise as an error, and a decision without a result by an action of zeros. No action is ever sent twice.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.controller import Controller, Decision
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.planning.planner import SearchCancelledError
from vjepa2_ac.serving.motion import waypoints, why_not_sent
from vjepa2_ac.serving.recording import Recorder
from vjepa2_ac.serving.request import IMAGE_KEYS, GivenGoal, NamedGoal, Request, read_request
from vjepa2_ac.serving.wire import WireError, pack, unpack
from vjepa2_ac.storage.structured import finite_or_none

logger = logging.getLogger(__name__)

ActionForm = Literal["delta", "pose"]
Clock = Callable[[], float]  # seconds, from anywhere

_NOT_SENT = "not sent"
_MOST_NAMES = 20  # of goals in a message
_BAR = 0.05  # share of an image's height, black at the top and at the bottom: a padded image


@dataclass(frozen=True)
class SessionOptions:
    """How a session answers."""

    actions: ActionForm = "delta"
    control_steps: int = 4  # of a model step: as many waypoints has an answer of poses
    image_keys: tuple[str, ...] = IMAGE_KEYS
    deadline_s: float = 60.0  # for a decision, its goal's encoding included; then the action is zero
    dry_run: bool = False  # plans, and sends zeros


@dataclass
class Counts:
    """What a session has done, for whoever watches it."""

    decisions: dict[str, int] = field(default_factory=dict)  # by their reason
    refused: int = 0
    failed: int = 0
    episodes: int = 0
    seconds: list[float] = field(default_factory=list)  # of each decision since it was last read


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
        self._goal: str | None = None  # fingerprint of the present one
        self._names: tuple[str, ...] = ()  # of its parts
        self._notes: list[str] = []  # that hold for this episode
        self._last_ms: float | None = None
        if self.options.actions == "pose" and not controller.spaces.state.is_pose:
            found = "a model whose states are not poses"
            raise InputError(where="--actions pose", found=found, needed="--actions delta, or a model of poses")

    def begin(self) -> None:
        """Begin with another robot: nothing of the last one is left."""
        self._forget(None)
        self._last_ms = None

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
        if request.begins or request.episode not in (None, self._episode):
            self._forget(request.episode or self._episode)
        if request.goal is not None and request.goal.fingerprint != self._goal:
            self._set(request.goal)
        if request.is_reset_only or request.frame is None or request.state is None:
            return {"status": "reset"}
        if self._goal is None:
            needed = f"a goal first: goal/image, goal/images or goal/name{self._known_names()}"
            raise InputError(where="request", found="no goal in this episode", needed=needed)
        return self._decided(request.frame, request.state, began, is_gone)

    def _decided(
        self, frame: np.ndarray, state: np.ndarray, began: float, is_gone: Callable[[], bool]
    ) -> dict[str, Any]:
        planning_began = self._clock()
        until = began + self.options.deadline_s
        try:
            self.controller.act(frame, state, cancelled=lambda: is_gone() or self._clock() > until)
        except SearchCancelledError:
            if is_gone():
                raise GoneError from None
            return self._nothing(state, "past the deadline", began, planning_began)
        decision = self.controller.decision
        if decision is None:
            raise ValueError("a controller that acted has decided")
        changes, why = self._checked(decision, state)
        self._note(frame)
        found = self._message(decision, state, changes, why)
        found["policy_timing"] = {"infer_ms": 1e3 * (self._clock() - planning_began)}
        found = self._finished(found, why, began)
        if self.recorder is not None:
            self.recorder.decision(self.controller, frame, state, found)
        return found

    def _checked(self, decision: Decision, state: np.ndarray) -> tuple[Float[np.ndarray, "steps dim"], str]:
        """Return the changes of each model step, and why they are so; zeros where they must not be sent."""
        steps, dim = self.controller.space.steps, self.controller.space.dim
        zeros = np.zeros((steps, dim))
        changes = zeros if decision.plan is None else decision.plan.actions.double().numpy()
        wrong = why_not_sent(state, changes, self.controller.config.limits, self.controller.spaces.state)
        if wrong:
            logger.error("a planned action is not sent: %s", wrong)
            return zeros, f"{_NOT_SENT}: {wrong}"
        return changes, decision.why

    def _message(
        self, decision: Decision, state: np.ndarray, changes: Float[np.ndarray, "steps dim"], why: str
    ) -> dict[str, Any]:
        """Return an answer. Its arrays have one row an action, and all else is plain: clients take rows of arrays."""
        sent = np.zeros_like(changes) if self.options.dry_run else changes
        actions = self._actions(state, sent)
        states = None if why.startswith(_NOT_SENT) else decision.states
        planned = _rows(state if states is None else states[1:])
        found: dict[str, Any] = {
            "actions": actions,
            "target": _rows(state) if self.options.dry_run else planned,
            "why": why,
            "goal": {
                "index": decision.goal,
                "name": self._names[decision.goal],
                "since": decision.progress.since,
                "changed": decision.progress.changed,
            },
            "done": decision.done,
            "energy": {
                "now": finite_or_none(decision.energy_now),
                "plan": None if decision.plan is None else finite_or_none(decision.plan.energy),
            },
            "notes": list(self._notes),
        }
        return found | ({"dry_run": True, "planned": planned} if self.options.dry_run else {})

    def _nothing(self, state: np.ndarray, why: str, began: float, planning_began: float) -> dict[str, Any]:
        """Return the answer of no decision: nobody moves."""
        zeros = np.zeros((self.controller.space.steps, self.controller.space.dim))
        found: dict[str, Any] = {
            "actions": self._actions(state, zeros),
            "target": _rows(state),
            "why": why,
            "goal": None,
            "done": False,
            "energy": {"now": None, "plan": None},
            "notes": list(self._notes),
            "policy_timing": {"infer_ms": 1e3 * (self._clock() - planning_began)},
        }
        return self._finished(found, why, began)

    def _finished(self, found: dict[str, Any], why: str, began: float) -> dict[str, Any]:
        seconds = self._clock() - began
        found["server_timing"] = {"infer_ms": 1e3 * seconds}
        if self._last_ms is not None:
            found["server_timing"]["prev_total_ms"] = self._last_ms
        self.counts.decisions[why] = self.counts.decisions.get(why, 0) + 1
        self.counts.seconds.append(seconds)
        return found

    def _actions(self, state: np.ndarray, changes: Float[np.ndarray, "steps dim"]) -> Float[np.ndarray, "rows dim"]:
        """Return changes as the robot wants them: waypoints to the first target, or what each model step does."""
        if self.options.actions == "pose":
            return waypoints(state, changes[0], self.options.control_steps)
        if self.controller.spaces.action.follows == "target":
            return np.asarray(state + np.cumsum(changes, axis=0))
        return changes

    def _forget(self, episode: str | None) -> None:
        self._episode, self._goal, self._notes = episode, None, []
        self.counts.episodes += 1

    def _set(self, goal: GivenGoal | NamedGoal) -> None:
        self._goal, self._notes = None, []  # a goal that cannot be used leaves none
        goals, mask = self._sub_goals(goal)
        self.controller.follow(goals, mask=mask)
        self._names = tuple(one.name for one in goals)
        if self.recorder is not None:
            self.recorder.goal(goals, mask)
        self._goal = goal.fingerprint

    def _sub_goals(self, goal: GivenGoal | NamedGoal) -> tuple[tuple[SubGoal, ...], np.ndarray | None]:
        if isinstance(goal, GivenGoal):
            return goal.goals, goal.mask
        if goal.name not in self.goals:
            found = f"{goal.name!r}, which names no goal"
            raise InputError(where="goal", found=found, needed=f"the name of one{self._known_names()}")
        return self.goals[goal.name], None

    def _known_names(self) -> str:
        names = list(self.goals)
        more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
        return f" (this server keeps {', '.join(names[:_MOST_NAMES])}{more})" if names else ""

    def _note(self, frame: np.ndarray) -> None:
        text = "black bars at the top and the bottom of the picture: send whole frames, not padded ones"
        if has_black_bars(frame) and text not in self._notes:
            self._notes.append(text)
            logger.warning(text)


def _rows(states: np.ndarray) -> list[list[float]]:
    found: list[list[float]] = np.atleast_2d(states).tolist()
    return found


def has_black_bars(frame: np.ndarray) -> bool:
    """Return whether an image was padded at its top and its bottom, as openpi's `resize_with_pad` does."""
    rows = max(1, int(_BAR * len(frame)))
    return not frame[:rows].any() and not frame[-rows:].any() and bool(frame.any())
