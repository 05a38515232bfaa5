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
from vjepa2_ac.episode import LatentBatch, Progress, no_progress
from vjepa2_ac.evaluation.action_use import clip_generator
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.evaluation.request import FRAMES_SEEN, SCORED, STEPS
from vjepa2_ac.evaluation.result import Evaluation, PlanningStudy, Plans
from vjepa2_ac.intervals import Estimate, bootstrapped, mean_of, ratio
from vjepa2_ac.planning.energy import distance
from vjepa2_ac.planning.planner import Plan, Planner
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
    """Return a frame of a clip with three steps after it; it is drawn from the seed and the clip's name."""
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


AXES = ("x", "y", "z")
LEAST_CM = 0.5  # a demonstrated step that is shorter has no direction, and along an axis no sign
_GRIPPER = 6
_NONE = Estimate(np.nan, np.nan, np.nan)
_NOWHERE_CM = 1e-7
_NO_ANGLE = 90.0  # of a plan that goes nowhere: the mean of random directions


@dataclass(frozen=True)
class PlanMetrics:
    """Metrics of one planning method; cm and degrees."""

    score: Estimate  # 0 to 80
    missed_cm: Estimate  # basis of the score: sum over x, y, z of the difference of displacements
    missed_over_zero: Estimate  # over that of doing nothing: 0 perfect, 1 as good
    step_cm: Estimate  # one step: distance of planned and demonstrated translation
    step_over_zero: Estimate
    axes_cm: tuple[Estimate, Estimate, Estimate]  # along x, y, z
    angle_degrees: Estimate  # between them
    signs: tuple[Estimate, Estimate, Estimate]  # share of steps whose sign is right, along x, y, z; by chance 0.5
    gripper: Estimate  # difference in closedness


@dataclass(frozen=True)
class PlanDifferences:
    """One planning method minus another from the same starts; below 0 is better, except for the score."""

    score: Estimate
    missed_cm: Estimate
    step_cm: Estimate


def ways_of(evaluation: Evaluation) -> dict[str, Plans]:
    """Return the plans of every model that planned, by its name, in the order of the table."""
    return {name: model.plans for name, model in evaluation.models.items() if model.plans is not None}


def metrics_of(study: PlanningStudy, plans: Plans) -> PlanMetrics:
    """Return the errors of plans with respect to the demonstrated actions."""
    ids, missed, step = study.episode_ids, missed_cm(study, plans), _step_cm(study, plans)
    wanted, planned = 100 * study.demonstrated[:, 0, POSE.position], 100 * plans.one_step[..., POSE.position]
    return PlanMetrics(
        score=bootstrapped(_score, _sums(missed), ids)[0],
        missed_cm=mean_of(missed, ids),
        missed_over_zero=ratio(missed, missed_cm(study, study.zero), ids),
        step_cm=mean_of(step, ids),
        step_over_zero=ratio(step, _step_cm(study, study.zero), ids),
        axes_cm=_each(np.abs(planned - wanted).mean(axis=0), ids),
        angle_degrees=_mean_where(_angles(planned, wanted).mean(axis=0), directed(study), ids),
        signs=_signs(study, planned),
        gripper=mean_of(np.abs(plans.one_step[..., _GRIPPER] - study.demonstrated[:, 0, _GRIPPER]).mean(axis=0), ids),
    )


def differences_of(study: PlanningStudy, plans: Plans, other: Plans) -> PlanDifferences:
    """Return the differences of two plans' errors, paired by start."""
    ids, missed = study.episode_ids, [missed_cm(study, each) for each in (plans, other)]
    both = np.concatenate([_sums(each) for each in missed])
    return PlanDifferences(
        score=bootstrapped(lambda sums: _score(sums[:2]) - _score(sums[2:]), both, ids)[0],
        missed_cm=mean_of(missed[0] - missed[1], ids),
        step_cm=mean_of(_step_cm(study, plans) - _step_cm(study, other), ids),
    )


def missed_cm(study: PlanningStudy, plans: Plans) -> Float[np.ndarray, " starts"]:
    """Return the error of each plan's end position in cm: the sum over x, y and z.

    Source: facebookresearch/jepa-wms @ 6eafb14, evals/simu_env_planning/planning/plan_evaluator.py, PlanEvaluator.eval:
    end_distance_xyz.
    """
    ends = plans.three_steps[..., POSE.position].sum(axis=-2) - study.demonstrated[..., POSE.position].sum(axis=-2)
    return np.asarray(100 * np.abs(ends).sum(axis=-1).mean(axis=0))


def directed(study: PlanningStudy) -> Bool[np.ndarray, " starts"]:
    """Return which demonstrated first steps are long enough to have a direction."""
    return np.asarray(100 * np.linalg.norm(study.demonstrated[:, 0, POSE.position], axis=-1) >= LEAST_CM)


def signed_along(study: PlanningStudy, axis: int) -> Bool[np.ndarray, " starts"]:
    """Return which of them are long enough along an axis to have a sign there."""
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


def _signs(study: PlanningStudy, planned: Float[np.ndarray, "draws starts 3"]) -> tuple[Estimate, Estimate, Estimate]:
    """Return shares of right signs; a plan that does not move counts half."""
    right = 0.5 + 0.5 * np.sign(planned) * np.sign(study.demonstrated[:, 0, POSE.position])
    x, y, z = (
        _mean_where(right[..., axis].mean(axis=0), signed_along(study, axis), study.episode_ids) for axis in range(3)
    )
    return x, y, z


def _mean_where(values: np.ndarray, chosen: Bool[np.ndarray, " starts"], ids: Sequence[str]) -> Estimate:
    """Return the mean over some starts; NaN if there are none."""
    kept = [name for name, keep in zip(ids, chosen, strict=True) if keep]
    return mean_of(values[chosen], kept) if kept else _NONE


def _each(values: Float[np.ndarray, "starts 3"], ids: Sequence[str]) -> tuple[Estimate, Estimate, Estimate]:
    x, y, z = (mean_of(values[:, axis], ids) for axis in range(3))
    return x, y, z
