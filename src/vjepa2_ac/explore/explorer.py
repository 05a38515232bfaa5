"""Models, decoder and held-out episodes of `explore`, and predictions one step at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import read_batches
from vjepa2_ac.data.transforms import crop_frames, to_display_frames
from vjepa2_ac.data.windows import require_frames
from vjepa2_ac.decoding.decoder import TrainedDecoder
from vjepa2_ac.decoding.imagine import decode_views
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch, encode_frames
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import LoadedModels
from vjepa2_ac.model.predictor import KeyValueCache
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.energy import EnergySlice, Goal, Scene, WorldModelCost, compute_energy_slices, distance
from vjepa2_ac.planning.planner import Cancelled, Plan, Planner, make_cancellation_check
from vjepa2_ac.planning.search_space import SearchSpace, make_search_space
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.spaces import Spaces, clip_gripper_changes, integrate_states

MAX_STEPS = 16  # longest path in model steps, as in the training of the released model
_MAX_CACHED_STEPS = 128  # cached predictions per model, for undo and for alternative actions
_ACTION_TOLERANCE = 2e-5  # tolerance for equal actions, because links to the page contain rounded numbers
Pixels = UInt8[np.ndarray, "size size 3"]
Actions = tuple[tuple[float, ...], ...]
Simulate = Callable[[int, int, Actions, Cancelled], tuple[np.ndarray, np.ndarray, bool]]
"""(episode, control step, actions, cancelled) -> (frame, state, whether the arm reached its target)."""


@dataclass(frozen=True)
class RolloutPosition:
    """A position in a rollout, defined by its start frame and the actions after that frame."""

    episode: int  # index among the episodes of the page
    start: int  # control step
    actions: Actions = ()

    @property
    def previous(self) -> RolloutPosition:
        """The position before the last action."""
        return RolloutPosition(self.episode, self.start, self.actions[:-1])

    def with_action(self, action: tuple[float, ...]) -> RolloutPosition:
        """Return the position after one more action."""
        return RolloutPosition(self.episode, self.start, (*self.actions, action))


@dataclass(frozen=True, eq=False)
class Observation:
    """A true observation: a frame, its latents, and the state at the same time."""

    pixels: Pixels  # the input of the encoder
    latents: Float[Tensor, "tokens dim"]
    state: Float[np.ndarray, " state_dim"]
    action: tuple[float, ...] | None = None  # the recorded action that leads to the next frame; None: unknown
    extrinsics: Float[Tensor, " 6"] | None = None  # pose of the camera, if the model uses it
    is_simulated: bool = False  # whether the frame is simulated; otherwise it was recorded
    has_reached_target: bool = True  # whether the arm reached the target of the last action


class Explorer:
    """Predicts rollouts from held-out frames, one action at a time, with each of several models.

    A prediction depends only on its `RolloutPosition`, so several pages, undo and links need no state on the server.
    Predictions are cached.
    """

    def __init__(
        self,
        models: LoadedModels,
        decoder: TrainedDecoder,
        dataset: Dataset,
        episodes: tuple[int, ...],
        autocast: Callable[[], Any],
        simulate: Simulate | None = None,
    ) -> None:
        """Create an explorer from loaded parts; see `open_explorer`.

        Args:
            models: The models, on their device.
            decoder: The decoder of the models' latents.
            dataset: A data set with clips of two frames of one camera.
            episodes: Indices of the episodes of the page in the data set.
            autocast: Returns the precision context for the models.
            simulate: Simulates the outcome of actions that were not recorded; None: the data are not from a simulator.

        Raises:
            InputError: The data do not define which state follows from an action.
        """
        self.world_model, self.evaluated_models, self.notes = models.world_model, models.evaluated_models, models.notes
        self.decoder, self.dataset, self.episodes, self.autocast = decoder, dataset, episodes, autocast
        self.simulate = simulate
        if self.spaces.action.effect == "unknown":
            problem = "the effect of the recorded commands on the state is unknown"
            needed = "data.actions: difference, or data.join_actions: sum or last"
            raise InputError(where="data.actions: recorded", found=problem, needed=needed)
        self._cached_pair = lru_cache(maxsize=256)(self._read_pair)
        self._cached_prediction = lru_cache(maxsize=_MAX_CACHED_STEPS * len(self.evaluated_models))(self._predict_step)

    @property
    def spaces(self) -> Spaces:
        """The spaces of states and actions."""
        return self.dataset.spaces

    @property
    def stride(self) -> int:
        """Control steps per model step."""
        return self.dataset.config.model_stride

    @property
    def device(self) -> torch.device:
        """The device of the models."""
        return self.world_model.device

    def get_episode_name(self, episode: int) -> str:
        """Return the name of an episode in its data set."""
        return self.dataset.table.identity(self.episodes[episode])

    def get_num_steps(self, episode: int) -> int:
        """Return the number of control steps of an episode."""
        return int(self.dataset.table.num_steps[self.episodes[episode]])

    def validate(self, position: RolloutPosition) -> RolloutPosition:
        """Check a position, and replace actions that equal the recorded actions up to rounding by the recorded actions.

        Raises:
            InputError: There is no such frame, or an action is invalid.
        """
        if position.episode >= len(self.episodes):
            needed = f"0 to {len(self.episodes) - 1}"
            raise InputError(where="episode", found=f"episode {position.episode}", needed=needed)
        last = self.get_num_steps(position.episode) - 1 - self.stride
        if not 0 <= position.start <= last:
            raise InputError(where="start", found=f"control step {position.start}", needed=f"0 to {last}")
        if len(position.actions) > MAX_STEPS:
            fix = "Undo some actions, or start from another frame"
            raise InputError(
                where="actions", found=f"{len(position.actions)} actions", needed=f"at most {MAX_STEPS}", fix=fix
            )
        width, checked = len(self.spaces.state), RolloutPosition(position.episode, position.start)
        for action in position.actions:
            if len(action) != width or not np.isfinite(action).all() or np.abs(action).max() > np.pi:
                needed = f"{width} numbers of one step in metres, radians and gripper position, each at most pi"
                raise InputError(where="actions", found=f"{len(action)} numbers", needed=needed)
            recorded = self.get_next_recorded_action(checked)
            is_recorded = recorded is not None and np.allclose(action, recorded, atol=_ACTION_TOLERANCE)
            checked = checked.with_action(recorded if is_recorded and recorded is not None else action)
        return checked

    # ---- ground truth ----

    def get_observation(self, episode: int, step: int) -> Observation:
        """Return the recorded observation at a control step."""
        last = self.get_num_steps(episode) - 1 - self.stride
        if step <= last:
            return self._cached_pair(episode, step)[0]
        return self._cached_pair(episode, step - self.stride)[1]

    def get_recorded_observations(self, position: RolloutPosition) -> list[Observation | None]:
        """Return the recorded observations at the start and after each action.

        Observations after the first action that differs from the recorded action are None, as are those after the end
        of the episode.
        """
        step = position.start
        observations: list[Observation | None] = [self.get_observation(position.episode, step)]
        for action in position.actions:
            previous, step = observations[-1], step + self.stride
            is_recorded = (
                previous is not None and action == previous.action and step < self.get_num_steps(position.episode)
            )
            observations.append(self.get_observation(position.episode, step) if is_recorded else None)
        return observations

    def get_recorded_observation(self, position: RolloutPosition) -> Observation | None:
        """Return the recorded observation at a position; None if the actions differ from the recorded ones."""
        return self.get_recorded_observations(position)[-1]

    def get_next_recorded_action(self, position: RolloutPosition) -> tuple[float, ...] | None:
        """Return the recorded action at a position; None if there is none."""
        observation = self.get_recorded_observation(position)
        return None if observation is None else observation.action

    @torch.no_grad()
    def _read_pair(self, episode: int, step: int) -> tuple[Observation, Observation]:
        (batch,) = read_batches(self.dataset, [(self.episodes[episode], step)], batch_size=1)
        with self.autocast():
            encoded = encode_batch(self.world_model, batch, device=self.device, chunk=2)
        if batch.frames is None:
            raise ValueError("the batch has no frames")  # `open_explorer` has checked that the data have frames
        pixels = to_display_frames(batch.frames[0].numpy(), self.world_model.image_size)
        states = batch.states[0].double().numpy()
        action = batch.actions[0, 0].double().numpy()
        if self.spaces.action.effect == "target":
            action = self.spaces.state.compute_differences(np.stack([states[0], action]))[0]
        camera, latents = None if encoded.extrinsics is None else encoded.extrinsics[0, 0], encoded.latents[0]
        first = Observation(pixels[0], latents[0], states[0], tuple(action.tolist()), camera)
        return first, Observation(pixels[1], latents[1], states[1])

    @torch.no_grad()
    def get_true_observation(
        self, position: RolloutPosition, cancelled: Cancelled = lambda: False
    ) -> Observation | None:
        """Return the recorded observation at a position, or else the simulated one; None if there is no simulator.

        Raises:
            SearchCancelledError: The simulation was cancelled.
        """
        recorded = self.get_recorded_observation(position)
        if recorded is not None or self.simulate is None:
            return recorded
        episode, crop = self.episodes[position.episode], self.dataset.config.crop
        frame, state, has_reached_target = self.simulate(episode, position.start, position.actions, cancelled)
        with self.autocast():
            latents = encode_frames(self.world_model, frame[None], crop)[0]
        (pixels,) = to_display_frames(crop_frames(frame[None], crop), self.world_model.image_size)
        return Observation(pixels, latents, state, is_simulated=True, has_reached_target=has_reached_target)

    # ---- predictions ----

    def integrate_states(self, position: RolloutPosition) -> Float[np.ndarray, "time state_dim"]:
        """Return the states at the start and after each action: recorded for recorded actions, otherwise integrated."""
        states = [self.get_observation(position.episode, position.start).state]
        for action, recorded in zip(position.actions, self.get_recorded_observations(position)[1:], strict=True):
            following = integrate_states(states[-1], np.array([action]), self.spaces.state)[1]
            states.append(following if recorded is None else recorded.state)
        return np.stack(states)

    def predict_latents(self, model_index: int, position: RolloutPosition) -> Float[Tensor, "tokens dim"]:
        """Return the predicted latents at a position; without actions, the latents of the start frame.

        Args:
            model_index: Index of the model in `evaluated_models`.
            position: The start frame and the actions.
        """
        return self._cached_prediction(model_index, position)[0]

    @torch.no_grad()
    def _predict_step(
        self, model_index: int, position: RolloutPosition
    ) -> tuple[Float[Tensor, "tokens dim"], KeyValueCache]:
        """Return the predicted latents at a position, and the key/value cache of all steps before it."""
        if not position.actions:
            return self.get_observation(position.episode, position.start).latents, KeyValueCache()
        (latents, cache), states = (
            self._cached_prediction(model_index, position.previous),
            self.integrate_states(position),
        )
        values = states[-1]
        if self.spaces.action.effect != "target":
            values = np.array(position.actions[-1])
            if self.get_recorded_observation(position) is None:  # the gripper cannot open or close beyond its range
                values = clip_gripper_changes(states[-2], values[None], self.spaces.state)[0]
        cache, camera = cache.copy(), self.get_extrinsics(position)
        action, state = (torch.as_tensor(x, dtype=torch.float32, device=self.device) for x in (values, states[-2]))
        inputs = latents[None, None], action[None, None], state[None, None]
        with self.autocast(), self.evaluated_models[model_index].prediction_context():
            predicted = self.get_model(model_index).predict(
                *inputs, None if camera is None else camera[None, None], cache
            )
        return predicted[0, 0].float(), cache

    def get_model(self, model_index: int) -> WorldModel:
        """Return a model. Use it within its `prediction_context()`, because models share weights."""
        model = self.evaluated_models[model_index].model
        assert isinstance(model, WorldModel)  # noqa: S101  # the type that `load_subject` loads
        return model

    def get_extrinsics(self, position: RolloutPosition) -> Float[Tensor, " 6"] | None:
        """Return the pose of the camera, if the models use it."""
        return self.get_observation(position.episode, position.start).extrinsics

    def decode(self, latents: Float[Tensor, "tokens dim"]) -> Pixels:
        """Decode latents into an image."""
        return np.asarray(decode_views(self.decoder.decoder, latents[None])[0])


def compute_relative_spread(latents: Float[Tensor, "tokens dim"], like: Float[Tensor, "tokens dim"]) -> float:
    """Return the variance of latents over the patches of a frame, relative to that of another frame."""
    return float(latents.var(dim=0).sum() / like.var(dim=0).sum())


def open_explorer(
    config: Config,
    decoder: TrainedDecoder,
    split: Split,
    load: Callable[[Dataset, TrainedDecoder], LoadedModels],
    simulate: Callable[[Dataset], Simulate | None] = lambda _: None,
    reporter: Reporter = SILENT,
) -> Explorer:
    """Load the models and open the data of an explorer, on the device of the config.

    Args:
        config: The config with the data.
        decoder: The decoder of the models' latents.
        split: The split whose episodes are shown.
        load: Loads the models.
        simulate: Returns the simulator of a data set; None if the data are not from a simulator.
        reporter: Shows the progress.

    Raises:
        InputError: Models or data cannot be used, or the decoder belongs to another encoder.
    """
    changes = {"frames": 2, "camera": config.data.cameras[0], "workers": 0}
    config = config.model_copy(update={"data": config.data.model_copy(update=changes)})
    accelerator = make_accelerator(config)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    require_frames(config.data, to="show the recorded frames")
    reporter.task(LOADING)
    models = load(dataset, decoder)
    models.move_to(accelerator.device)
    decoder.to(accelerator.device)
    is_in_split = dataset.split_mask(split)[dataset.episodes]
    is_long_enough = dataset.table.num_steps[dataset.episodes] > config.data.model_stride
    episodes = tuple(int(index) for index in dataset.episodes[is_in_split & is_long_enough])
    if not episodes:
        dataset.windows(split)  # raises an error with the reason
    return Explorer(models, decoder, dataset, episodes, accelerator.autocast, simulate(dataset))


# ---- energies and plans ----

_GRID_POINTS = 7  # points of an energy map along each axis


@dataclass(frozen=True, eq=False)
class PlanResult:
    """A plan, and predicted frames of the search."""

    plan: Plan
    energy_now: float  # energy of the frame from which the plan starts
    best: tuple[Float[Tensor, "tokens dim"], ...]  # last frame of the best sample, for each of the last 8 iterations


class Search:
    """Computes plans and energy maps from predicted frames."""

    def __init__(self, explorer: Explorer, config: PlanningConfig) -> None:
        """Create a search.

        Args:
            explorer: The explorer with the models.
            config: The planning config, with the energy.
        """
        self._explorer, self.config = explorer, config

    def make_search_space(self, steps: int = 1) -> SearchSpace:
        """Return the allowed actions of a plan.

        Raises:
            InputError: There are no limits for vectors.
        """
        return make_search_space(self._with_horizon(steps), self._explorer.spaces.state)

    def _with_horizon(self, steps: int) -> PlanningConfig:
        return self.config.model_copy(update={"horizon": steps, "action_repeat": 1})

    @property
    def map_components(self) -> tuple[int, ...]:
        """Components of an action that the energy maps vary: the position of a pose, or the first free numbers."""
        is_pose = self._explorer.spaces.state.is_pose
        return (0, 1, 2) if is_pose else tuple(self.make_search_space().free[:3].tolist())

    def compute_energy(self, latents: Float[Tensor, "tokens dim"], goal: Float[Tensor, "tokens dim"]) -> float:
        """Return the energy of a frame: its distance to the goal frame."""
        return float(distance(latents[None], goal[None], self.config.energy))

    def compute_maps(
        self,
        model_index: int,
        position: RolloutPosition,
        goal: Tensor,
        action: Sequence[float],
        progress: Progress,
        cancelled: Cancelled,
    ) -> tuple[EnergySlice, ...]:
        """Return the energy after one more action, as maps over each pair of `map_components`.

        Args:
            model_index: Index of the model.
            position: The position before the action.
            goal: Latents of the goal frame.
            action: The action in the middle of the maps.
            progress: Called with the number of evaluated actions.
            cancelled: Returns whether to cancel.

        Raises:
            InputError: The config has no limits of actions.
            SearchCancelledError: The computation was cancelled.
        """
        center_action = torch.tensor([list(action)], dtype=torch.float32)
        with self._open_cost(model_index, position, goal) as cost:
            checked_progress = make_cancellation_check(cancelled, progress)
            return compute_energy_slices(
                cost,
                center_action,
                self.make_search_space(),
                self.map_components,
                nodes=_GRID_POINTS,
                progress=checked_progress,
            )

    def plan(
        self,
        model_index: int,
        position: RolloutPosition,
        goal: Tensor,
        steps: int,
        progress: Progress,
        cancelled: Cancelled,
    ) -> PlanResult:
        """Plan `steps` model steps towards a goal frame.

        Raises:
            InputError: The config has no limits of actions.
            SearchCancelledError: The search was cancelled.
        """
        planner = Planner(self._with_horizon(steps), self.make_search_space(steps), progress=progress)
        with self._open_cost(model_index, position, goal) as cost, torch.no_grad():
            plan = planner.plan(cost, torch.Generator().manual_seed(0), cancelled=cancelled)
            elites = torch.stack(
                [iteration.elites[0] for iteration in plan.iterations if len(iteration.elites)][-8:] or [plan.actions]
            )
            best, _ = cost.rollout(elites)
        energy_now = self.compute_energy(self._explorer.predict_latents(model_index, position), goal)
        return PlanResult(plan, energy_now, tuple(best[:, -1].float()))

    @contextmanager
    def _open_cost(self, model_index: int, position: RolloutPosition, goal: Tensor) -> Iterator[WorldModelCost]:
        """Yield the cost of action sequences from a position; the predicted frame is used like an observed frame."""
        explorer = self._explorer
        state = torch.from_numpy(np.array(explorer.integrate_states(position)[-1], dtype=np.float32))
        scene = Scene(explorer.predict_latents(model_index, position), state, explorer.get_extrinsics(position))
        with explorer.autocast(), explorer.evaluated_models[model_index].prediction_context():
            goals, config = Goal(goal[None]), self.config.energy
            yield WorldModelCost(explorer.get_model(model_index), scene, goals, config, spaces=explorer.spaces)
