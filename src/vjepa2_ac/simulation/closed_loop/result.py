"""Closed-loop results: a record of each episode, and the metrics over all of them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from vjepa2_ac.intervals import Estimate, mean_of, share_of
from vjepa2_ac.simulation.closed_loop.tasks import TaskName, TaskProblem


@dataclass(frozen=True)
class EpisodeResult:
    """The record of an episode. Index 0 along `time` is before the first action."""

    problem: TaskProblem
    states: Float[np.ndarray, "time 7"]  # measured, in the robot base frame
    actions: Float[np.ndarray, "steps dim"]  # as returned by the policy
    blocks: Float[np.ndarray, "time 4"] | None  # pose of the block, as in `TaskProblem`; None: there is none
    distances_m: Float[np.ndarray, " time"]  # of what the task moves, to its goal
    reached: Bool[np.ndarray, " time"]  # whether the task is done, see `TaskProblem.succeeded`
    seconds: Float[np.ndarray, " steps"]  # taken by the policy
    whys: tuple[str, ...]  # of each action
    unreachable: int  # commands that the arm could not follow completely
    goal_image: UInt8[np.ndarray, "height width 3"]
    frames: UInt8[np.ndarray, "time height width 3"] | None  # if they are stored
    imagined: tuple[UInt8[np.ndarray, "height width 3"] | None, ...] = ()  # after each action, likewise; None: nothing

    @property
    def success(self) -> bool:
        """Whether the goal is reached at the end."""
        return bool(self.reached[-1])

    @property
    def steps_needed(self) -> int | None:
        """Model steps after which it stays reached; None: it is not reached at the end."""
        if not self.success:
            return None
        not_done = np.flatnonzero(~self.reached)
        return int(not_done[-1]) + 1 if len(not_done) else 0

    @property
    def success_ever(self) -> bool:
        """Whether the goal was reached after any of the steps, perhaps in passing."""
        return bool(self.reached[1:].any())


@dataclass(frozen=True)
class ClosedLoopResult:
    """A policy's episodes of a task; arrays hold one row per episode, estimates have 95 % intervals over episodes."""

    task: TaskName
    domain: str
    policy: str
    seed: int
    steps: int  # model steps of an episode
    stride: int  # control steps of a model step
    episodes: tuple[EpisodeResult, ...]

    @property
    def distance_cm(self) -> Float[np.ndarray, "episodes time"]:
        """Distance to the goal before the first step and after each."""
        return np.stack([episode.distances_m for episode in self.episodes]) * 100

    @property
    def successes(self) -> Bool[np.ndarray, " episodes"]:
        """Whether the goal is reached at the end."""
        return np.array([episode.success for episode in self.episodes])

    @property
    def seconds(self) -> Float[np.ndarray, "episodes steps"]:
        """Seconds of each decision."""
        return np.stack([episode.seconds for episode in self.episodes])

    @property
    def unreachable(self) -> Int[np.ndarray, " episodes"]:
        """Commands that the arm could not follow completely."""
        return np.array([episode.unreachable for episode in self.episodes])

    @property
    def success_rate(self) -> Estimate:
        """Share of episodes with the goal reached at the end."""
        return share_of(int(self.successes.sum()), len(self.episodes))

    @property
    def success_ever_rate(self) -> Estimate:
        """Share of episodes with the goal reached after any step: optimistic, only for comparison with others'."""
        return share_of(sum(episode.success_ever for episode in self.episodes), len(self.episodes))

    @property
    def final_distance_cm(self) -> Estimate:
        """Mean distance to the goal at the end."""
        return self._mean(self.distance_cm[:, -1])

    @property
    def steps_needed(self) -> Estimate | None:
        """Mean model steps until it stays reached, of episodes with success at the end; None: there are none."""
        needed = [episode.steps_needed for episode in self.episodes if episode.steps_needed is not None]
        return self._mean(np.array(needed, dtype=np.float64)) if needed else None

    @property
    def seconds_per_decision(self) -> Estimate:
        """Mean time of a decision."""
        return self._mean(self.seconds.mean(axis=1))

    @property
    def why_counts(self) -> dict[str, int]:
        """How often each reason was given for an action, the most common first."""
        return dict(Counter(why for episode in self.episodes for why in episode.whys).most_common())

    def _mean(self, values: Float[np.ndarray, " episodes"]) -> Estimate:
        return mean_of(values, [f"{number:06d}" for number in range(len(values))])
