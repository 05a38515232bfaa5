"""The Action Score: how close are plans from frames of held-out clips to the demonstrated actions?

Two plans from each start: one step towards the next frame, by the settings of the config's `planning`; and three steps
towards the frame that came three steps later, by the Action Score's protocol (`request.SCORED`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vjepa2_ac.config.planning import EnergyConfig, PlanningConfig
from vjepa2_ac.distributed import shared
from vjepa2_ac.episode import LatentBatch, Progress, no_progress
from vjepa2_ac.evaluation.action_use import RolloutStart, start_of
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.request import FRAMES_SEEN, SCORED, STEPS
from vjepa2_ac.evaluation.result import Evaluation, PlanningStudy, Plans
from vjepa2_ac.intervals import Estimate, bootstrapped, mean_of, ratio
from vjepa2_ac.model.state_integration import states_along
from vjepa2_ac.planning.energy import EnergyFunction, distance
from vjepa2_ac.planning.planner import Plan, Planner
from vjepa2_ac.planning.search_space import SearchSpace, pose_space
from vjepa2_ac.planning.solvers import PlanStart
from vjepa2_ac.policies.action_prior import ActionPrior
from vjepa2_ac.spaces import POSE

_RANDOM_PLANS = 64  # of each start: their mean error is the random plan's
_SAME_M = 1e-6


@dataclass(frozen=True)
class PlanningStart(RolloutStart):
    """A frame of a held-out clip, the following frames, and the demonstrated actions."""

    place: int  # of the frame in the clip
    goal: Float[Tensor, "tokens dim"]  # three steps later
    demonstrated: Float[np.ndarray, "3 7"]
    seeds: tuple[int, int, int]  # of the one-step plan, of the scored one, of random ones


@dataclass(frozen=True)
class WindowCost:
    """The cost of action sequences from one frame: the energy of the last prediction with respect to a goal.

    The model never sees more than the last two frames, as in the Action Score's protocol; before one step that is one.
    States are integrated with the actions, and the camera does not move.
    """

    model: Predictor
    start: PlanningStart
    goal: Float[Tensor, "tokens dim"]
    energy: EnergyConfig | EnergyFunction

    def __call__(self, actions: Float[Tensor, "samples steps 7"]) -> Float[Tensor, " samples"]:
        """Return energies on the device of the actions."""
        at_once = EnergyFunction.of(self.energy).config.samples_at_once
        parts = actions.to(self.start.state).split(at_once)  # type: ignore[no-untyped-call]  # torch
        return torch.cat([self._energies(part) for part in parts]).to(actions.device)

    def _energies(self, actions: Float[Tensor, "samples steps 7"]) -> Float[Tensor, " samples"]:
        start, (samples, steps) = self.start, actions.shape[:2]
        states = states_along(start.state, actions)[:, :-1]
        cameras = None if start.extrinsics is None else start.extrinsics.expand(samples, steps, -1)

        def during(first: int, last: int) -> tuple[Tensor, Tensor, Tensor | None]:
            window = slice(first, last)
            return actions[:, window], states[:, window], None if cameras is None else cameras[:, window]

        frame = start.frame.expand(samples, 1, *start.frame.shape)
        frames = self.model.rollout(frame, *during(0, FRAMES_SEEN))
        for end in range(FRAMES_SEEN + 1, steps + 1):
            following = self.model.predict(frames, *during(end - FRAMES_SEEN, end))[:, -1:]
            frames = torch.cat([frames[:, 1:], following], dim=1)
        return distance(frames[:, -1].float(), self.goal.float(), self.energy)


def planning_start(batch: LatentBatch, row: int, seed: int) -> PlanningStart:
    """Return a frame of a clip with three steps after it; it is drawn from the seed and the clip's name."""
    generator = start_of(batch, row, 0).generator(seed)
    place = int(generator.integers(batch.latents.shape[1] - STEPS))
    one, scored, drawn = generator.integers(2**62, size=3).tolist()
    return PlanningStart(
        **vars(start_of(batch, row, place)),
        place=place,
        goal=batch.latents[row, place + STEPS].clone(),
        demonstrated=batch.actions[row, place : place + STEPS].cpu().numpy().astype(np.float64),
        seeds=(one, scored, drawn),
    )


def scored_space() -> SearchSpace:
    """Return the search space of the Action Score, whose first samples of the gripper are narrow."""
    space = pose_space(SCORED)
    space.std[:, 6] = 0.1
    return space


def one_step_settings(config: PlanningConfig) -> PlanningConfig:
    """Return a config's settings for one step from one frame, without a time budget: no metric depends on a clock."""
    fixed = {"horizon": 1, "action_repeat": 1, "warm_start": False, "budget_s": None}
    return config.model_copy(update=fixed)


def measure_plans(
    model: Predictor,
    starts: Sequence[PlanningStart],
    config: PlanningConfig,
    progress: Progress = no_progress,
    *,
    prior: ActionPrior | None = None,
) -> Plans:
    """Plan from each start, one step and three.

    Args:
        model: The predictor.
        starts: One or more.
        config: Settings of one-step plans; for three steps, only the number of samples per batch.
        progress: Called with the number of finished plans.
        prior: Network of `planning.prior`, on the device of the starts: one-step plans start from it.
    """
    fixed = SCORED.energy.model_copy(update={"samples_at_once": config.energy.samples_at_once})
    planner, scored = (
        Planner(one_step_settings(config)),
        Planner(SCORED.model_copy(update={"energy": fixed}), scored_space()),
    )
    near, far = EnergyFunction.of(config.energy), EnergyFunction.of(fixed)

    def planned(start: PlanningStart) -> list[Plan]:
        begun = None
        if prior is not None:
            mean, std = prior.next_action(start.frame.float(), start.state, start.following.float(), 1)
            begun = PlanStart(mean[None], mean[None, None], std[None])
        one, three = (torch.Generator().manual_seed(seed) for seed in start.seeds[:2])
        return [
            planner.plan(WindowCost(model, start, start.following, near), one, begun),
            scored.plan(WindowCost(model, start, start.goal, far), three),
        ]

    plans = list(zip(*shared(starts, planned, progress), strict=True))
    one_step, three_steps = (
        np.stack([plan.actions.numpy().astype(np.float64) for plan in found])[None] for found in plans
    )
    empty = sum(plan.stopped == "no finite energy" for found in plans for plan in found)
    return Plans(one_step[:, :, 0], three_steps, empty)


def study_of(starts: Sequence[PlanningStart], config: PlanningConfig) -> PlanningStudy:
    """Return the references for plans: the demonstrated actions, and model-free plans."""
    one, scored = pose_space(one_step_settings(config)), scored_space()
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


AXES = ("x", "y", "z")
LEAST_CM = 0.5  # a demonstrated step that is shorter has no direction, and along an axis no sign
_GRIPPER = 6
_NOWHERE_CM = 1e-7
_NO_ANGLE = 90.0  # of a plan that goes nowhere: the mean of random directions


def ways_of(evaluation: Evaluation) -> dict[str, Plans]:
    """Return the plans of every model that planned, by its name, in the order of the table."""
    return {name: model.plans for name, model in evaluation.models.items() if model.plans is not None}


def metrics_of(study: PlanningStudy, plans: Plans) -> dict[str, Estimate]:
    """Return the errors of plans with respect to the demonstrated actions, in cm and degrees.

    Returns:
        `score` (0 to 80); `missed_cm`, of which it is made, and `missed_over_zero` (0 perfect, 1 as good as doing
        nothing). Of one step: `step_cm`, the distance of the translations, and `step_over_zero`; `axes_cm.x`, y, z;
        `angle_degrees` between them; `signs.x`, y, z, the share that is right (by chance 0.5); `gripper`, the
        difference in closedness.
    """
    ids, missed, step = study.episode_ids, missed_cm(study, plans), _step_cm(study, plans)
    wanted, planned = 100 * study.demonstrated[:, 0, POSE.position], 100 * plans.one_step[..., POSE.position]
    off = np.abs(planned - wanted).mean(axis=0)
    right = (0.5 + 0.5 * np.sign(planned) * np.sign(wanted)).mean(axis=0)  # a plan that does not move: half
    directed = 100 * np.linalg.norm(study.demonstrated[:, 0, POSE.position], axis=-1) >= LEAST_CM
    gripper = np.abs(plans.one_step[..., _GRIPPER] - study.demonstrated[:, 0, _GRIPPER]).mean(axis=0)
    return {
        "score": bootstrapped(_score, _sums(missed), ids)[0],
        "missed_cm": mean_of(missed, ids),
        "missed_over_zero": ratio(missed, missed_cm(study, study.zero), ids),
        "step_cm": mean_of(step, ids),
        "step_over_zero": ratio(step, _step_cm(study, study.zero), ids),
        **{f"axes_cm.{name}": mean_of(off[:, axis], ids) for axis, name in enumerate(AXES)},
        "angle_degrees": _mean_where(_angles(planned, wanted).mean(axis=0), directed, ids),
        **{
            f"signs.{name}": _mean_where(right[:, axis], signed_along(study, axis), ids)
            for axis, name in enumerate(AXES)
        },
        "gripper": mean_of(gripper, ids),
    }


def differences_of(study: PlanningStudy, plans: Plans, other: Plans) -> dict[str, Estimate]:
    """Return the differences of two plans' metrics, paired by start: below 0 is better, except for the score."""
    ids, missed = study.episode_ids, [missed_cm(study, each) for each in (plans, other)]
    both = np.concatenate([_sums(each) for each in missed])
    return {
        "score": bootstrapped(lambda sums: _score(sums[:2]) - _score(sums[2:]), both, ids)[0],
        "missed_cm": mean_of(missed[0] - missed[1], ids),
        "step_cm": mean_of(_step_cm(study, plans) - _step_cm(study, other), ids),
    }


def missed_cm(study: PlanningStudy, plans: Plans) -> Float[np.ndarray, " starts"]:
    """Return the error of each plan's end position in cm: the sum over x, y and z.

    Source: facebookresearch/jepa-wms @ 6eafb14, evals/simu_env_planning/planning/plan_evaluator.py, PlanEvaluator.eval:
    end_distance_xyz.
    """
    ends = plans.three_steps[..., POSE.position].sum(axis=-2) - study.demonstrated[..., POSE.position].sum(axis=-2)
    return np.asarray(100 * np.abs(ends).sum(axis=-1).mean(axis=0))


def signed_along(study: PlanningStudy, axis: int) -> Bool[np.ndarray, " starts"]:
    """Return which demonstrated first steps are long enough along an axis to have a sign there."""
    return np.asarray(100 * np.abs(study.demonstrated[:, 0, axis]) >= LEAST_CM)


def _score(sums: np.ndarray) -> np.ndarray:
    """Return the score of sums over starts: of centimetres, and of ones.

    Source: facebookresearch/jepa-wms @ 6eafb14, app/plan_common/plot/logs_plan_joint_per_design_choice.py.
    """
    return np.asarray(np.maximum(0.0, 800 * (0.1 - sums[0] / sums[1] / 100)))


def _sums(values: Float[np.ndarray, " starts"]) -> Float[np.ndarray, "2 starts 1"]:
    return np.stack([values, np.ones_like(values)])[:, :, None]


def _step_cm(study: PlanningStudy, plans: Plans) -> Float[np.ndarray, " starts"]:
    apart = plans.one_step[..., POSE.position] - study.demonstrated[:, 0, POSE.position]
    return np.asarray(100 * np.linalg.norm(apart, axis=-1).mean(axis=0))


def _angles(
    planned: Float[np.ndarray, "draws starts 3"], wanted: Float[np.ndarray, "starts 3"]
) -> Float[np.ndarray, "draws starts"]:
    lengths = np.linalg.norm(planned, axis=-1) * np.linalg.norm(wanted, axis=-1)
    cosines = (planned * wanted).sum(axis=-1) / np.maximum(lengths, np.finfo(float).tiny)
    nowhere = np.linalg.norm(planned, axis=-1) < _NOWHERE_CM
    return np.where(nowhere, _NO_ANGLE, np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))))


def _mean_where(values: np.ndarray, chosen: Bool[np.ndarray, " starts"], ids: Sequence[str]) -> Estimate:
    """Return the mean over some starts; NaN if there are none."""
    kept = [name for name, keep in zip(ids, chosen, strict=True) if keep]
    return mean_of(values[chosen], kept) if kept else Estimate(np.nan, np.nan, np.nan)
