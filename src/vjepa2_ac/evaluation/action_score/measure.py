"""Action Score measurement: plans from frames of held-out clips, compared with the demonstrated actions.

Two plans from each start: one step towards the next frame, by the settings of the config's `planning`; and three steps
towards the frame that came three steps later, by the Action Score's protocol (`planning_protocol`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config.planning import EnergyConfig, PlanningConfig
from vjepa2_ac.episode import LatentBatch, Progress, no_progress
from vjepa2_ac.evaluation.action_score.protocol import FRAMES, FRAMES_SEEN, SCORED, STEPS
from vjepa2_ac.evaluation.action_use.one_step import clip_generator
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.result import PlanningStudy, Plans
from vjepa2_ac.planning.energy import distance
from vjepa2_ac.planning.interfaces import Plan
from vjepa2_ac.planning.planner import Planner
from vjepa2_ac.planning.search_space import SearchSpace, pose_space
from vjepa2_ac.planning.state_integration import states_along
from vjepa2_ac.spaces import POSE

_RANDOM_PLANS = 64  # of each start: their mean error is the random plan's
_SAME_M = 1e-6


@dataclass(frozen=True)
class PlanningStart:
    """A frame of a held-out clip, the following frames, and the demonstrated actions."""

    clip: int  # index into the evaluation's clips
    episode_id: str
    place: int  # of the frame in the clip
    frame: Float[Tensor, "tokens dim"]
    following: Float[Tensor, "tokens dim"]  # one step later
    goal: Float[Tensor, "tokens dim"]  # three steps later
    state: Float[Tensor, " 7"]
    demonstrated: Float[np.ndarray, "3 7"]
    extrinsics: Float[Tensor, " 6"] | None
    seeds: tuple[int, int, int]  # of the one-step plan, of the scored one, of random ones


class WindowCost:
    """The cost of action sequences from one frame: the energy of the last prediction with respect to a goal.

    The model never sees more than the last two frames, as in the Action Score's protocol; before one step that is one.
    States are integrated with the actions, and the camera does not move.
    """

    def __init__(
        self, model: Predictor, start: PlanningStart, goal: Float[Tensor, "tokens dim"], config: EnergyConfig
    ) -> None:
        self._model, self._start, self._goal, self._config = model, start, goal.float(), config

    def __call__(self, actions: Float[Tensor, "samples steps 7"]) -> Float[Tensor, " samples"]:
        """Return energies on the device of the actions."""
        parts = actions.to(self._start.state).split(self._config.samples_at_once)  # type: ignore[no-untyped-call]  # torch
        return torch.cat([self._energies(part) for part in parts]).to(actions.device)

    def _energies(self, actions: Float[Tensor, "samples steps 7"]) -> Float[Tensor, " samples"]:
        start, (samples, steps) = self._start, actions.shape[:2]
        states = states_along(start.state, actions)[:, :-1]
        cameras = None if start.extrinsics is None else start.extrinsics.expand(samples, steps, -1)

        def during(first: int, last: int) -> tuple[Tensor, Tensor, Tensor | None]:
            window = slice(first, last)
            return actions[:, window], states[:, window], None if cameras is None else cameras[:, window]

        frame = start.frame.expand(samples, 1, *start.frame.shape)
        frames = self._model.rollout(frame, *during(0, FRAMES_SEEN))
        for end in range(FRAMES_SEEN + 1, steps + 1):
            following = self._model.predict(frames, *during(end - FRAMES_SEEN, end))[:, -1:]
            frames = torch.cat([frames[:, 1:], following], dim=1)
        return distance(frames[:, -1].float(), self._goal, self._config)


def planning_start(batch: LatentBatch, row: int, clip: int, seed: int) -> PlanningStart:
    """Return a frame of a clip with three steps after it; it is drawn from the seed and the clip's name.

    Raises:
        ValueError: The clip has fewer than four frames.
    """
    if batch.latents.shape[1] < FRAMES:
        raise ValueError(f"{batch.latents.shape[1]} frames, and planning {STEPS} steps takes {FRAMES}")
    generator = clip_generator(seed, batch.episode_ids[row], batch.starts[row])
    place = int(generator.integers(batch.latents.shape[1] - STEPS))
    one, scored, drawn = generator.integers(2**62, size=3).tolist()
    return PlanningStart(
        clip=clip,
        episode_id=batch.episode_ids[row],
        place=place,
        frame=batch.latents[row, place].clone(),
        following=batch.latents[row, place + 1].clone(),
        goal=batch.latents[row, place + STEPS].clone(),
        state=batch.states[row, place],
        demonstrated=batch.actions[row, place : place + STEPS].cpu().numpy().astype(np.float64),
        extrinsics=None if batch.extrinsics is None else batch.extrinsics[row, place],
        seeds=(one, scored, drawn),
    )


def one_step_settings(config: PlanningConfig) -> PlanningConfig:
    """Return a config's settings for one step from one frame, without a time budget: no metric depends on a clock."""
    fixed = {"horizon": 1, "action_repeat": 1, "context": 1, "warm_start": False, "budget_s": None}
    return config.model_copy(update=fixed)


def measure_plans(
    model: Predictor, starts: Sequence[PlanningStart], config: PlanningConfig, progress: Progress = no_progress
) -> Plans:
    """Plan from each start, one step and three.

    Args:
        model: The predictor.
        starts: One or more.
        config: Settings of one-step plans; for three steps, only the number of samples per batch.
        progress: Called with the number of finished plans.
    """
    began = time.perf_counter()
    one, scored = Planner(one_step_settings(config)), Planner(_as_protocol(config))
    plans: list[tuple[Plan, Plan]] = []
    for start in starts:
        first = _plan(one, model, start, start.following, start.seeds[0])
        progress(2 * len(plans) + 1, 2 * len(starts))
        plans.append((first, _plan(scored, model, start, start.goal, start.seeds[1])))
        progress(2 * len(plans), 2 * len(starts))
    return Plans(
        one_step=np.stack([_array(first)[0] for first, _ in plans])[None],
        three_steps=np.stack([_array(second) for _, second in plans])[None],
        empty=sum(plan.stopped == "no finite energy" for pair in plans for plan in pair),
        seconds=time.perf_counter() - began,
    )


def study_of(starts: Sequence[PlanningStart], config: PlanningConfig) -> PlanningStudy:
    """Return the references for plans: the demonstrated actions, and model-free plans."""
    one, scored = pose_space(one_step_settings(config)), pose_space(SCORED)
    demonstrated = np.stack([start.demonstrated for start in starts])
    within = Plans(_allowed(one, demonstrated[:, :1])[None, :, 0], _allowed(scored, demonstrated)[None])
    return PlanningStudy(
        clips=tuple(start.clip for start in starts),
        places=tuple(start.place for start in starts),
        episode_ids=tuple(start.episode_id for start in starts),
        demonstrated=demonstrated,
        zero=Plans(np.zeros((1, len(starts), 7)), np.zeros((1, *demonstrated.shape))),
        random=_random(starts, one, scored),
        within_limits=within,
        one_step_beyond=_beyond(within.one_step[0], demonstrated[:, 0]),
        three_steps_beyond=_beyond(within.three_steps[0], demonstrated),
        settings=one_step_settings(config),
    )


def _as_protocol(config: PlanningConfig) -> PlanningConfig:
    at_once = {"samples_at_once": config.energy.samples_at_once}
    return SCORED.model_copy(update={"energy": SCORED.energy.model_copy(update=at_once)})


def _plan(planner: Planner, model: Predictor, start: PlanningStart, goal: Tensor, seed: int) -> Plan:
    cost = WindowCost(model, start, goal, planner.config.energy)
    return planner.plan(cost, torch.Generator().manual_seed(seed))


def _array(plan: Plan) -> Float[np.ndarray, "steps 7"]:
    return plan.actions.numpy().astype(np.float64)


def _random(starts: Sequence[PlanningStart], one: SearchSpace, scored: SearchSpace) -> Plans:
    """Return plans of which every number is uniform within its limits, independently of all others."""
    drawn: list[list[np.ndarray]] = [[], []]
    for start in starts:
        generator = np.random.default_rng(start.seeds[2])
        for space, found in zip((one, scored), drawn, strict=True):
            low, high = space.lower.numpy(), space.upper.numpy()
            found.append(_allowed(space, generator.uniform(low, high, size=(_RANDOM_PLANS, *low.shape))))
    one_step, three_steps = (np.stack(found, axis=1) for found in drawn)
    return Plans(one_step[:, :, 0], three_steps)


def _allowed(space: SearchSpace, actions: np.ndarray) -> np.ndarray:
    return space.allowed(torch.from_numpy(actions).float()).numpy().astype(np.float64)


def _beyond(allowed: np.ndarray, demonstrated: np.ndarray) -> float:
    """Return the share of demonstrated steps that exceed the limits of a plan along an axis."""
    cut = np.abs(allowed - demonstrated)[..., POSE.position] > _SAME_M
    return float(cut.any(axis=-1).mean())
