"""The controller: receives a goal image once, then returns one action for each image and state."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.data.sources.indexed_source import get_spaces
from vjepa2_ac.data.transforms import Crop
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import require_image
from vjepa2_ac.model.world_model import (
    Fingerprints,
    WorldModel,
    describe_model_widths,
    find_projections_to_replace,
    get_model_widths,
)
from vjepa2_ac.planning.cameras import Cameras, Fault
from vjepa2_ac.planning.energy import AxesRotation, ChunkScores, EnergyFunction, Goal, Scene, WorldModelCost, distance
from vjepa2_ac.planning.goals import REACHED, GoalProgress, GripperMode, SubGoal, make_timed_goals, require_goal_ends
from vjepa2_ac.planning.model_setup import prepare_for_planning
from vjepa2_ac.planning.planner import Cancelled, Plan, Planner, make_cancellation_check
from vjepa2_ac.planning.search_space import SearchSpace, Workspace, is_within_limits, make_search_space
from vjepa2_ac.planning.settings import read_axes, require_base_frame, resolve_data_limits, warn_if_limits_exceed_data
from vjepa2_ac.planning.solvers import PlanStart
from vjepa2_ac.registry import PLANNING_FILES
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.spaces import EXTRINSICS, POSES, Spaces, integrate_changes

_PRIOR_STEPS = 3  # steps left, as the prior receives them, if a goal has no `at_most`; fewer lead to larger motions
State = Float[np.ndarray, " numbers"]
Latents = Float[Tensor, "tokens dim"]
Reason = Literal["planned", "out of time", "at the goal", "no finite energy", "outside the workspace", Fault]


@dataclass(frozen=True)
class Surprise:
    """The difference between a frame and its prediction."""

    score: float
    errors: Float[Tensor, " tokens"]  # of each patch, row by row
    is_alarm: bool  # the score is above the threshold


PriorStart = Callable[[WorldModelCost, Latents, int, SearchSpace], PlanStart]
"""Returns the start of a search towards a goal's latents, given the number of model steps left (`planning.prior`)."""
Compare = Callable[[Latents, Latents], Surprise]
"""Compares the latents of a predicted frame with those of the camera's frame (`planning.monitor`)."""


@dataclass(frozen=True)
class Decision:
    """An action for the next model step, and the reason for it."""

    action: Float[np.ndarray, " dim"]  # for the next model step; zero for some values of `why`
    # "out of time": the action is from the best plan so far. For all values but this and "planned" the action is zero.
    # "uniform frame": the image of a camera has no contrast. "frozen frame": an image equals the previous one, although
    # the robot moved.
    why: Reason
    current_energy: float  # energy of a plan in which the image stays as it is; NaN for a faulty frame
    goals: tuple[int, ...]  # index of the goal that applies in each model step of a plan
    progress: GoalProgress  # the goal that applies, since when, and why it changed
    plan: Plan | None = None  # None if the goal is reached, or the robot is outside the workspace
    states: Float[np.ndarray, "time dim"] | None = None  # states predicted along the plan, the current state first
    cost: WorldModelCost | None = None  # evaluates other actions
    is_done: bool = False  # the last goal is reached: no motion
    from_samples: bool = False  # the search started from actions that a policy proposed
    surprise: Surprise | None = None  # None: no monitor, or no prediction for this frame


class Controller:
    """Plans towards a goal, one model step at a time, and stores the observations that later decisions need.

    The same seed, images and states give the same actions: decision n after a reset (counted from 0) uses the
    random seed `seed + n`. Actions are within `planning.limits`, for any output of the model.

    Example:
        >>> controller = Controller(load_model("builtin:sim-tiny"))  # for a run: Controller.of_run(load_run(FOLDER))
        >>> controller.reset(goal)  # height x width x 3, uint8, RGB
        >>> action = controller.act(image, state)  # 7 numbers: metres, radians, gripper position
    """

    def __init__(
        self,
        world_model: WorldModel,
        config: PlanningConfig | None = None,
        *,
        seed: int = 0,
        crop: Crop = "released",
        extrinsics: Float[np.ndarray, " 6"] | None = None,
        spaces: Spaces = POSES,
    ) -> None:
        """Create a controller.

        Args:
            world_model: The model, which is set to eval mode. If it has an adapter, the controller uses a merged copy
                (`model_setup.prepare_for_planning`).
            config: Planning settings; None: the defaults.
            seed: Seed of all decisions.
            crop: As in training (`data.crop`).
            extrinsics: Pose of the camera, if the model uses it.
            spaces: Meaning of the model's states and actions.

        Raises:
            InputError: The widths of the model's states and actions do not fit `spaces`, the effect of an action on the
                state is unknown, a camera pose is missing or not used, the blocks cannot be compiled, limits for
                vectors are missing, a workspace is set for vectors, or `planning.axes` was fitted for another model.
        """
        self.config = config or PlanningConfig()
        self.seed, self.crop, self.spaces = seed, crop, spaces
        _require_spaces(world_model, spaces)
        _require_camera_pose(world_model, extrinsics, self.config.views)
        self._model = prepare_for_planning(world_model, self.config)
        self.cameras = Cameras(self._model, crop, self.config.views)
        self._camera_pose = None if extrinsics is None else torch.from_numpy(extrinsics.astype(np.float32))
        self._energy = EnergyFunction.from_config(self.config.energy)
        self._load_files(world_model)
        self.space = make_search_space(self.config, spaces.state)  # the search space of the latest decision
        self.planner = Planner(self.config, self.space)
        self._workspace = Workspace.from_limits(self.config.limits, spaces.state)
        self._search_spaces: dict[GripperMode | None, SearchSpace] = {None: self.space}
        self._goals: tuple[SubGoal, ...] = ()
        self._progress: GoalProgress | None = None  # at the last usable frame
        self._num_decisions = 0  # since the reset
        self.decision: Decision | None = None  # the latest decision

    def _load_files(self, world_model: WorldModel) -> None:
        """Read the calibrated axes, the monitor and the prior, and check that each was made for this model."""
        config, self._axes_rotation = self.config, None
        self._compare: Compare | None = None
        self._prior_start: PriorStart | None = None
        if not (config.axes or config.monitor or config.prior):
            return
        fingerprints = world_model.fingerprints()
        if config.axes:
            require_base_frame(f"planning.axes: {config.axes}", is_base=self.spaces.state.is_base_pose)
            self._axes_rotation = _load_axes_rotation(config.axes, fingerprints)
        if config.monitor:
            self._compare = PLANNING_FILES.find("monitor")(config.monitor, fingerprints, self.cameras)
        if config.prior:
            self._prior_start = PLANNING_FILES.find("prior")(config.prior, fingerprints, self.cameras)

    @classmethod
    def of_run(
        cls,
        run: Subject,
        config: PlanningConfig | None = None,
        *,
        seed: int | None = None,
        extrinsics: Float[np.ndarray, " 6"] | None = None,
    ) -> Controller:
        """Return the controller of a trained run, with its crop; `config` and `seed` default to those of the run.

        If limits exceed the motions in the training data, or these have a low diversity, a warning is logged.

        Raises:
            InputError: As `Controller`.
        """
        settings = run.config if config is None else run.config.model_copy(update={"planning": config})
        settings = resolve_data_limits(settings, Path(settings.run_dir))
        warn_if_limits_exceed_data(settings, Path(settings.run_dir))
        return cls.of_subject(replace(run, config=settings), seed=seed, extrinsics=extrinsics)

    @classmethod
    def of_subject(
        cls, subject: Subject, *, seed: int | None = None, extrinsics: Float[np.ndarray, " 6"] | None = None
    ) -> Controller:
        """Return the controller of a model that `load_for_planning` loaded.

        Args:
            subject: The model, and the config with the settings for planning, the crop and the spaces.
            seed: Seed of all decisions; None: the config's.
            extrinsics: Pose of the camera, if the model uses it.

        Raises:
            InputError: As `Controller`.
        """
        config = subject.config
        return cls(
            subject.world_model,
            config.planning,
            seed=config.seed if seed is None else seed,
            crop=config.data.crop,
            extrinsics=extrinsics,
            spaces=get_spaces(config.data, get_model_widths(subject.world_model.sizes)),
        )

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return self._model.device

    @property
    def display_components(self) -> tuple[int, ...]:
        """Indices of the numbers to show, at most three: the position of a pose, or the first free numbers."""
        return (0, 1, 2) if self.spaces.state.is_pose else tuple(self.space.free[:3].tolist())

    def reset(self, *goals: np.ndarray, durations: tuple[int, ...] = (), mask: np.ndarray | None = None) -> None:
        """Set a goal, or several in order, and forget all observations.

        Args:
            goals: RGB images, height x width x 3, uint8, all of one size.
            durations: Number of model steps of each goal except the last.
            mask: Region of the image that counts towards the energy: height x width, nonzero inside it; None: all.

        Raises:
            InputError: An image is invalid, sizes differ, or the mask is empty.
            ValueError: No goals, or the number of durations is not the number of goals minus one, or one is below 1.
        """
        self.follow(make_timed_goals(goals, durations), mask=mask)

    def follow(
        self, goals: Sequence[SubGoal], *, mask: np.ndarray | None = None, cancelled: Cancelled = lambda: False
    ) -> None:
        """Set goals that apply one after another, each until its rule is met, and forget all observations.

        A goal applies for at least `at_least` and at most `at_most` model steps. Between these bounds the next goal
        begins to apply as soon as the energy is below `share` times the energy at the start of the goal. An earlier
        goal never applies again. The last goal is reached by the same rule; then the action is zero until a reset.

        Args:
            goals: In order; images of one size.
            mask: As for `reset`.
            cancelled: Called before each goal is encoded; returns whether to stop.

        Raises:
            SearchCancelledError: `cancelled` returned true; the previous goals still apply.
            InputError: An image is invalid, sizes differ, or the mask is empty. A goal other than the last has neither
                `at_most` nor `share`, or the last goal has `at_most`. A gripper mode is set although the states are
                vectors, or no component of the action remains free.
            ValueError: No goals.
        """
        if not goals:
            raise ValueError("no goal")
        for index, goal in enumerate(goals):
            require_image(goal.image, where=f"goal {index}", like=goals[0].image if index else None)
            self.cameras.require_contrast(goal.image, where=f"goal {index}")
        require_goal_ends(goals)
        search_spaces = {goal.gripper: self._make_search_space(goal.gripper) for goal in goals} | {
            None: self._search_spaces[None]
        }
        check, latents = make_cancellation_check(cancelled), []
        for index, goal in enumerate(goals):
            check(index, len(goals))
            latents.append(self.encode(goal.image))
        weights = self.cameras.compute_patch_weights(mask, goals[0].image)
        self._goals, self._goal_latents, self._patch_weights = tuple(goals), torch.stack(latents), weights
        self._search_spaces, self.space = search_spaces, search_spaces[None]
        self.cameras.latest_frames, self._progress, self._num_decisions, self.decision = (), None, 0, None

    def act(
        self,
        frame: np.ndarray,
        state: np.ndarray,
        *,
        samples: Float[np.ndarray, "samples steps dim"] | None = None,
        cancelled: Cancelled = lambda: False,
    ) -> Float[np.ndarray, " dim"]:
        """Return the action for the next model step: dx, dy, dz, three rotations, gripper (see `vjepa2_ac.episode`).

        For vector states the action is the change of each number of the state, or the target state if the model was
        trained on recorded targets. Call this method once per model step. `decision` then holds the reason.

        Args:
            frame: The current camera image, with the size of the goal image.
            state: The measured state: pose and gripper, or a vector; a vector of any width if the model has no state
                input and an action is a change of the state.
            samples: Actions that a policy proposes, as changes of the state in each model step (`policies.score`). The
                search starts from their mean and standard deviation; None: from `planning.prior`, if it is set.
            cancelled: Called before every iteration; returns whether the action is no longer needed.

        Raises:
            InputError: The image or the state cannot be used.
            SearchCancelledError: `cancelled` returned true. After any error the controller is unchanged.
            ValueError: No goal was set.
        """
        state = self._check_input(frame, state)
        max_change = self.space.upper[0].double().numpy()
        latest_frames, fault = self.cameras.check_frame(frame, state, self.spaces.state, max_change)
        if fault is None:
            decision = self._decide(self.encode(frame), state, samples, cancelled)
            self._progress = decision.progress
        else:
            decision = self._decide_without_motion(state, fault)
        # Set after all calls that can raise, so that an error leaves the controller unchanged.
        self.cameras.latest_frames, self._num_decisions, self.decision = (
            latest_frames,
            self._num_decisions + 1,
            decision,
        )
        return decision.action

    @torch.no_grad()
    def score(
        self,
        frame: np.ndarray,
        state: np.ndarray,
        chunks: Float[np.ndarray, "chunks steps dim"],
        *,
        cancelled: Cancelled = lambda: False,
    ) -> ChunkScores:
        """Return the energies of given action sequences and of the zero action, towards the goal that applies now.

        The controller does not plan, and its state does not change. Limits do not apply; predictions for actions beyond
        the limits may be unreliable.

        Args:
            frame: As for `act`.
            state: As for `act`.
            chunks: Changes of the state in each model step (`policies.score.changes_of_chunks`), any number of steps.
            cancelled: Called after every `planning.energy.samples_at_once` chunks; returns whether to stop.

        Raises:
            InputError: As for `act`, or the frame has no contrast, or the chunks have another shape.
            SearchCancelledError: `cancelled` returned true.
            ValueError: No goal was set.
        """
        state = self._check_input(frame, state)
        self.cameras.require_contrast(frame, where="frame")
        latents = self.encode(frame)
        if chunks.ndim != 3 or 0 in chunks.shape or chunks.shape[2] != self.space.dim:
            needed = f"chunks x model steps x {self.space.dim}"
            raise InputError(where="chunks", found=f"an array with shape {chunks.shape}", needed=needed)
        progress = self._update_progress(latents)
        current_energies, _ = self._compute_current_energies(latents, progress, chunks.shape[1])
        cost = self._make_cost(latents, state, progress)
        cost.progress = make_cancellation_check(cancelled)
        energies = cost(torch.from_numpy(np.concatenate([np.zeros_like(chunks[:1]), chunks])).float()).double()
        return ChunkScores(
            energies[1:].numpy(), float(energies[0]), self._combine_steps(current_energies), progress.goal_index
        )

    def _check_input(self, frame: np.ndarray, state: np.ndarray) -> Float[np.ndarray, " dim"]:
        """Return the measured state as float64; refuse an unusable frame or state, and a controller without a goal."""
        if not self._goals:
            raise ValueError("no goal was set; call reset first")
        require_image(frame, where="frame", like=self._goals[0].image)
        state, space = np.asarray(state, dtype=np.float64), self.spaces.state
        is_needed = self._model.sizes.predictor.use_states or self.spaces.action.effect != "change"
        if not is_needed and not space.is_pose and state.shape != (len(space),):
            state = np.zeros(len(space))  # the model takes no states, so a vector may have any width
        space.require_state(state, "state")
        return state

    def _decide_without_motion(self, state: np.ndarray, why: Fault) -> Decision:
        """Return a zero action for a faulty frame; the goal is unchanged, since the frame may be wrong."""
        progress = self._progress or GoalProgress(0, 0, math.nan)
        goals, command = (progress.goal_index,) * self.space.steps, self._get_command(state, np.zeros(len(state)))
        return Decision(command, why, math.nan, goals, replace(progress, changed=""), is_done=progress.is_done)

    def encode(self, image: UInt8[np.ndarray, "height width 3"]) -> Latents:
        """Return the latents of an image on the model's device; the latents of several views are concatenated.

        Raises:
            InputError: The width does not fit the number of views.
        """
        return encode_frames(self._model, image[None], self.crop, views=self.config.views)[0]

    def _update_progress(self, latents: Latents) -> GoalProgress:
        """Return the progress through the goals at the current image."""

        def energy(index: int) -> float:
            return float(distance(latents, self._goal_latents[index], self._energy, self._patch_weights))

        if self._progress is None:
            return GoalProgress(0, 0, energy(0))
        return self._progress.advance(self._goals, self._num_decisions, energy)

    def _get_goal(self, index: int) -> Goal:
        """Return a goal and the later goals that can apply during a plan, each with `at_most` as its duration."""
        durations: list[int] = []
        for goal in self._goals[index:-1]:
            if goal.at_most is None:
                break
            durations.append(goal.at_most)
        return Goal(self._goal_latents[index : index + len(durations) + 1], tuple(durations), self._patch_weights)

    def _compute_current_energies(
        self, latents: Latents, progress: GoalProgress, steps: int
    ) -> tuple[Float[Tensor, " steps"], tuple[int, ...]]:
        """Return the energy of the current image towards the goal of each of the next steps, and the goals' indices."""
        goal, elapsed_steps = self._get_goal(progress.goal_index), self._num_decisions - progress.start_step
        goal_latents = goal.get_latents(elapsed_steps, steps)
        current_energies = distance(latents.expand_as(goal_latents), goal_latents, self._energy, goal.weights)
        return current_energies, tuple(
            progress.goal_index + goal.get_index(elapsed_steps + step) for step in range(steps)
        )

    def _make_cost(self, latents: Latents, state: State, progress: GoalProgress) -> WorldModelCost:
        goal, elapsed_steps = self._get_goal(progress.goal_index), self._num_decisions - progress.start_step
        scene = Scene(
            latents, torch.from_numpy(state).float(), self._camera_pose, self._axes_rotation, self.config.views
        )
        return WorldModelCost(self._model, scene, goal, self._energy, elapsed_steps=elapsed_steps, spaces=self.spaces)

    def _combine_steps(self, energies: Float[Tensor, " steps"]) -> float:
        return float(energies[-1] if self.config.energy.steps == "last" else energies.sum())

    def _decide(self, latents: Latents, state: State, samples: np.ndarray | None, cancelled: Cancelled) -> Decision:
        """Return the decision for a frame without a fault: a plan, or zero if no motion is needed or possible."""
        progress = self._update_progress(latents)
        current_energies, goal_indices = self._compute_current_energies(latents, progress, self.config.horizon)
        energy = self._combine_steps(current_energies)
        command = self._get_command(state, np.zeros(len(state)))
        zero_action = Decision(
            command, "at the goal", energy, goal_indices, progress, surprise=self._measure_surprise(latents)
        )
        if progress.is_done or float(current_energies.max()) <= REACHED:
            return replace(zero_action, is_done=progress.goal_index == len(self._goals) - 1)
        if self._workspace is not None and not is_within_limits(
            self._workspace.get_return_motion(state[:3]), self.config.limits
        ):
            return replace(zero_action, why="outside the workspace")
        self.space = self._search_spaces[self._goals[progress.goal_index].gripper]
        cost = self._make_cost(latents, state, progress)
        plan = self._search(state, cost, self._get_start(cost, progress, samples), cancelled)
        states = integrate_changes(torch.from_numpy(state), plan.actions.double()[None], self.spaces.state)
        why: Reason = "planned" if plan.stopped == "finished" else plan.stopped
        return replace(
            zero_action,
            action=self._get_command(state, plan.actions[0].double().numpy()),
            why=why,
            plan=plan,
            states=states[0].numpy(),
            cost=cost,
            from_samples=samples is not None,
        )

    def _measure_surprise(self, latents: Latents) -> Surprise | None:
        """Return the difference between the current frame and its prediction by the last decision."""
        previous = self.decision
        if self._compare is None or previous is None or previous.cost is None or previous.plan is None:
            return None
        with torch.no_grad():
            predicted, _ = previous.cost.rollout(previous.plan.actions[None, :1])
        return self._compare(predicted[0, 0], latents)

    def _get_start(self, cost: WorldModelCost, progress: GoalProgress, samples: np.ndarray | None) -> PlanStart | None:
        """Return the start of a search: from a policy's samples, the action prior, or the rest of the last plan."""
        if samples is not None:
            return PlanStart.from_samples(torch.from_numpy(np.array(samples, dtype=np.float64)), self.space)
        if self._prior_start is not None:
            bound = self._goals[progress.goal_index].at_most
            steps_left = _PRIOR_STEPS if bound is None else bound - (self._num_decisions - progress.start_step)
            return self._prior_start(cost, self._goal_latents[progress.goal_index], steps_left, self.space)
        last_plan = None if self.decision is None else self.decision.plan
        return last_plan.make_next_start() if last_plan is not None and self.config.warm_start else None

    def _search(self, state: np.ndarray, cost: WorldModelCost, start: PlanStart | None, cancelled: Cancelled) -> Plan:
        """Return the plan of a search, kept inside the workspace if there is one, with the energy of its actions."""
        generator, workspace = torch.Generator().manual_seed(self.seed + self._num_decisions), self._workspace
        space = self.space if workspace is None else workspace.narrow(self.space, state)
        plan = self.planner.plan(cost, generator, start, cancelled, space)
        if workspace is None or plan.stopped == "no finite energy":
            return plan
        actions = torch.from_numpy(workspace.clip_actions(state, plan.actions.double().numpy(), self.config.limits)).to(
            plan.actions
        )
        if torch.equal(actions, plan.actions):
            return plan
        with torch.no_grad():
            energy = float(cost(actions[None])[0])
        return replace(plan, actions=actions, energy=energy, evaluations=plan.evaluations + 1)

    def _make_search_space(self, gripper: GripperMode | None) -> SearchSpace:
        """Return the search space of a gripper mode.

        Raises:
            InputError: No component is free, or the index of the gripper is unknown.
        """
        if gripper is None:
            return self._search_spaces[None]
        where, fix = f"gripper mode {gripper!r} of a goal", "Remove the gripper mode of the goal"
        if not self.spaces.state.is_pose:
            raise InputError(where=where, found="a model with vector states, whose gripper is unknown", fix=fix)
        limits = self.config.limits.model_copy(update={"gripper_mode": gripper})
        space = make_search_space(self.config.model_copy(update={"limits": limits}), self.spaces.state)
        if not len(space.free):
            raise InputError(where=where, found="no free component: planning.limits fix position and rotation", fix=fix)
        return space

    def _get_command(self, state: np.ndarray, change: np.ndarray) -> Float[np.ndarray, " action_dim"]:
        """Return the action for a change of the state: the change itself, or the resulting state."""
        return state + change if self.spaces.action.effect == "target" else change


def _load_axes_rotation(path: str, fingerprints: Fingerprints) -> AxesRotation:
    """Read calibrated axes, and check that they were fitted for this model.

    Raises:
        InputError: Planning cannot use the axes, or they were fitted for another model.
    """
    axes = read_axes(path)
    if (axes.encoder, axes.predictor) != (fingerprints.encoder, fingerprints.predictor):
        problem = f"axes that were calibrated for another model, {axes.subject}"
        fix = "Calibrate them for this model: `vjepa2-ac data calibrate CONFIG --axes MODEL`"
        raise InputError(where=f"planning.axes: {path}", found=problem, fix=fix)
    return AxesRotation(math.radians(axes.yaw_degrees), axes.centre_m)


def _require_camera_pose(model: WorldModel, extrinsics: np.ndarray | None, views: int) -> None:
    if extrinsics is not None:
        EXTRINSICS.require_state(extrinsics, "extrinsics")
    if (uses := model.sizes.predictor.use_extrinsics) != (extrinsics is not None):
        problem = f"{uses}, but {'no' if uses else 'a'} camera pose was given"
        needed = "a camera pose if and only if the model uses it"
        raise InputError(where="model: predictor.use_extrinsics", found=problem, needed=needed)
    if uses and views > 1:
        raise InputError(
            where="planning.views", found=f"{views} views, with a model that uses the camera pose", needed="1"
        )


def _require_spaces(model: WorldModel, spaces: Spaces) -> None:
    if find_projections_to_replace(model.sizes, spaces.widths):
        needed = (
            f"states of {spaces.widths.state} and actions of {spaces.widths.action} numbers, as in its training data"
        )
        raise InputError(where="model", found=describe_model_widths(model.sizes), needed=needed)
    if spaces.action.effect == "unknown":
        problem = "recorded actions whose effect on the state is unknown"
        fix = "To plan, train with data.actions: difference, or with data.join_actions: sum or last"
        raise InputError(where="data.actions: recorded", found=problem, fix=fix)
