"""The models, the decoder and the held-out episodes of `explore`; and the prediction of one more step."""

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
from vjepa2_ac.data.loader import batches_of
from vjepa2_ac.data.transforms import frames_as_seen, view
from vjepa2_ac.data.windows import require_frames
from vjepa2_ac.decoding.decoder import TrainedDecoder
from vjepa2_ac.decoding.imagine import shown
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch, encode_frames
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate_run import Models
from vjepa2_ac.model.predictor import KeyValueCache
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.energy import EnergySlice, Goal, Scene, WorldModelCost, distance, energy_slices
from vjepa2_ac.planning.planner import Cancelled, Plan, Planner, until_cancelled
from vjepa2_ac.planning.search_space import SearchSpace, search_space
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.spaces import Spaces, counterfactual_states, feasible_actions

MOST_STEPS = 16  # of a path: as many as the released model was trained on
_KEPT_STEPS = 128  # of each model, for undo and for other branches
_SAME = 2e-5  # of numbers of an action: links are rounded
Pixels = UInt8[np.ndarray, "size size 3"]
Actions = tuple[tuple[float, ...], ...]
Simulate = Callable[[int, int, Actions, Cancelled], tuple[np.ndarray, np.ndarray, bool]]
"""Episode, control step, actions, whether it is cancelled -> frame, state, and whether the arm reached its target."""


@dataclass(frozen=True)
class Place:
    """Where a person is: the given frame, and the actions that were taken from there."""

    episode: int  # among those that are shown
    start: int  # control step
    actions: Actions = ()

    @property
    def before(self) -> Place:
        """The place before the last action."""
        return Place(self.episode, self.start, self.actions[:-1])

    def after(self, action: tuple[float, ...]) -> Place:
        """Return the place after one more action."""
        return Place(self.episode, self.start, (*self.actions, action))


@dataclass(frozen=True, eq=False)
class Moment:
    """A true frame, and the state that was measured then."""

    pixels: Pixels  # as the encoder sees it
    latents: Float[Tensor, "tokens dim"]
    state: Float[np.ndarray, " state_dim"]
    action: tuple[float, ...] | None = None  # that was recorded, to the next moment; None: nobody knows
    extrinsics: Float[Tensor, " 6"] | None = None  # of the camera, where the model uses them
    is_simulated: bool = False  # else recorded
    reached: bool = True  # whether the arm could do the last action


class Explorer:
    """Imagines what follows from a held-out frame, one action after another, for each of some models.

    A path is a pure function of its `Place`: two pages, undo and a link need no state here. What was computed is kept
    for a while.
    """

    def __init__(
        self,
        models: Models,
        decoder: TrainedDecoder,
        dataset: Dataset,
        episodes: tuple[int, ...],
        autocast: Callable[[], Any],
        simulate: Simulate | None = None,
    ) -> None:
        """Prepare; `open_explorer` loads the parts.

        Args:
            models: The models, on their device.
            decoder: Of their latents.
            dataset: Clips of two frames of one camera.
            episodes: Those that are shown, by their places in the data set.
            autocast: Within which models compute.
            simulate: Simulates what was not recorded; None: the data were not simulated.

        Raises:
            InputError: Nobody knows which state follows from an action.
        """
        self.world_model, self.contenders, self.notes = models.world_model, models.contenders, models.notes
        self.decoder, self.dataset, self.episodes, self.autocast = decoder, dataset, episodes, autocast
        self.simulate = simulate
        if self.spaces.action.follows == "unknown":
            found = "commands of which nobody knows what they do to the state"
            needed = "data.actions: difference; or join_actions: sum or last"
            raise InputError(where="data.actions: recorded", found=found, needed=needed)
        self._pair = lru_cache(maxsize=256)(self._read_pair)
        self._end = lru_cache(maxsize=_KEPT_STEPS * len(self.contenders))(self._imagine)

    @property
    def spaces(self) -> Spaces:
        """What states and actions are."""
        return self.dataset.spaces

    @property
    def stride(self) -> int:
        """Control steps of a model step."""
        return self.dataset.config.model_stride

    @property
    def device(self) -> torch.device:
        """Where the models are."""
        return self.world_model.device

    def name(self, episode: int) -> str:
        """Return the name of an episode in its data set."""
        return self.dataset.table.identity(self.episodes[episode])

    def steps(self, episode: int) -> int:
        """Return the control steps of an episode."""
        return int(self.dataset.table.num_steps[self.episodes[episode]])

    def require(self, place: Place) -> Place:
        """Return a place with its actions as they are understood: close to a recorded one, the recorded one.

        Raises:
            InputError: There is no such frame, or an action is none.
        """
        if place.episode >= len(self.episodes):
            needed = f"0 to {len(self.episodes) - 1}"
            raise InputError(where="episode", found=str(place.episode), needed=needed)
        last = self.steps(place.episode) - 1 - self.stride
        if not 0 <= place.start <= last:
            raise InputError(where="start", found=f"control step {place.start}", needed=f"0 to {last}")
        if len(place.actions) > MOST_STEPS:
            fix = "Undo some, or begin anew from another frame"
            raise InputError(where="actions", found=f"{len(place.actions)}", needed=f"at most {MOST_STEPS}", fix=fix)
        width, understood = len(self.spaces.state), Place(place.episode, place.start)
        for action in place.actions:
            if len(action) != width or not np.isfinite(action).all() or np.abs(action).max() > np.pi:
                needed = f"{width} numbers of one step, in metres, radians and closedness"
                raise InputError(where="actions", found=f"{len(action)} numbers", needed=needed)
            recorded = self.recorded_next(understood)
            is_it = recorded is not None and np.allclose(action, recorded, atol=_SAME)
            understood = understood.after(recorded if is_it and recorded is not None else action)
        return understood

    # ---- what is recorded ----

    def moment(self, episode: int, step: int) -> Moment:
        """Return the recorded moment at a control step."""
        last = self.steps(episode) - 1 - self.stride
        return self._pair(episode, step)[0] if step <= last else self._pair(episode, step - self.stride)[1]

    def along(self, place: Place) -> list[Moment | None]:
        """Return what is recorded at the start and after each action; None: the recording ended, or went elsewhere."""
        step = place.start
        found: list[Moment | None] = [self.moment(place.episode, step)]
        for action in place.actions:
            before, step = found[-1], step + self.stride
            goes_there = before is not None and action == before.action and step < self.steps(place.episode)
            found.append(self.moment(place.episode, step) if goes_there else None)
        return found

    def recorded(self, place: Place) -> Moment | None:
        """Return the recorded moment at a place; None: the recording ended, or did something else."""
        return self.along(place)[-1]

    def recorded_next(self, place: Place) -> tuple[float, ...] | None:
        """Return the recorded action at a place; None: there is none."""
        moment = self.recorded(place)
        return None if moment is None else moment.action

    @torch.no_grad()
    def _read_pair(self, episode: int, step: int) -> tuple[Moment, Moment]:
        (batch,) = batches_of(self.dataset, [(self.episodes[episode], step)], batch_size=1)
        with self.autocast():
            encoded = encode_batch(self.world_model, batch, device=self.device, chunk=2)
        if batch.frames is None:
            raise ValueError("a cache was refused")
        pixels = frames_as_seen(batch.frames[0].numpy(), self.world_model.image_size)
        states = batch.states[0].double().numpy()
        action = batch.actions[0, 0].double().numpy()
        if self.spaces.action.follows == "target":
            action = self.spaces.state.differences(np.stack([states[0], action]))[0]
        camera, latents = None if encoded.extrinsics is None else encoded.extrinsics[0, 0], encoded.latents[0]
        first = Moment(pixels[0], latents[0], states[0], tuple(action.tolist()), camera)
        return first, Moment(pixels[1], latents[1], states[1])

    @torch.no_grad()
    def truth(self, place: Place, cancelled: Cancelled = lambda: False) -> Moment | None:
        """Return what is true at a place: recorded, else simulated; None: it is unknown.

        Raises:
            SearchCancelledError: It was cancelled.
        """
        recorded = self.recorded(place)
        if recorded is not None or self.simulate is None:
            return recorded
        episode, crop = self.episodes[place.episode], self.dataset.config.crop
        frame, state, reached = self.simulate(episode, place.start, place.actions, cancelled)
        with self.autocast():
            latents = encode_frames(self.world_model, frame[None], crop)[0]
        (pixels,) = frames_as_seen(view(frame[None], crop), self.world_model.image_size)
        return Moment(pixels, latents, state, is_simulated=True, reached=reached)

    # ---- what is imagined ----

    def states(self, place: Place) -> Float[np.ndarray, "time state_dim"]:
        """Return the states along a path: recorded as far as the recording goes that way, then integrated."""
        states = [self.moment(place.episode, place.start).state]
        for action, recorded in zip(place.actions, self.along(place)[1:], strict=True):
            following = counterfactual_states(states[-1], np.array([action]), self.spaces.state)[1]
            states.append(following if recorded is None else recorded.state)
        return np.stack(states)

    def imagined(self, teller: int, place: Place) -> Float[Tensor, "tokens dim"]:
        """Return the latents at the end of a path as a model imagines them; without actions the true ones."""
        return self._end(teller, place)[0]

    @torch.no_grad()
    def _imagine(self, teller: int, place: Place) -> tuple[Float[Tensor, "tokens dim"], KeyValueCache]:
        """Return the latents at the end of a path, and the cache of the steps before."""
        if not place.actions:
            return self.moment(place.episode, place.start).latents, KeyValueCache()
        (before, cache), states = self._end(teller, place.before), self.states(place)
        given = states[-1]
        if self.spaces.action.follows != "target":
            given = np.array(place.actions[-1])
            if self.recorded(place) is None:  # its gripper changes as far as it can
                given = feasible_actions(states[-2], given[None], self.spaces.state)[0]
        cache, camera = cache.copy(), self.camera(place)
        action, state = (torch.as_tensor(one, dtype=torch.float32, device=self.device) for one in (given, states[-2]))
        seen = before[None, None], action[None, None], state[None, None]
        with self.autocast(), self.contenders[teller].switched():
            predicted = self.model(teller).predict(*seen, None if camera is None else camera[None, None], cache)
        return predicted[0, 0].float(), cache

    def model(self, teller: int) -> WorldModel:
        """Return what imagines; it counts within `contenders[teller].switched()`."""
        model = self.contenders[teller].model
        assert isinstance(model, WorldModel)  # noqa: S101  # `load_subject` loads no other
        return model

    def camera(self, place: Place) -> Float[Tensor, " 6"] | None:
        """Return the camera's pose, where the models use it."""
        return self.moment(place.episode, place.start).extrinsics

    def decoded(self, latents: Float[Tensor, "tokens dim"]) -> Pixels:
        """Return latents as an image for people."""
        return np.asarray(shown(self.decoder.decoder, latents[None])[0])


def relative_spread(latents: Float[Tensor, "tokens dim"], like: Float[Tensor, "tokens dim"]) -> float:
    """Return the variance of latents over the patches of a frame, as a share of another frame's; 1: as varied."""
    return float(latents.var(dim=0).sum() / like.var(dim=0).sum())


def open_explorer(
    config: Config,
    decoder: TrainedDecoder,
    split: Split,
    load: Callable[[Dataset, TrainedDecoder], Models],
    simulate: Callable[[Dataset], Simulate | None] = lambda _: None,
    reporter: Reporter = SILENT,
) -> Explorer:
    """Load everything, on the device of the config.

    Args:
        config: With the data.
        decoder: Of the latents of the models.
        split: Whose episodes are shown.
        load: Loads the models.
        simulate: Returns what simulates a data set.
        reporter: Shows the progress.

    Raises:
        InputError: Models or data cannot be used, or the decoder is that of another encoder.
    """
    one = {"frames": 2, "camera": config.data.cameras[0], "workers": 0}
    config = config.model_copy(update={"data": config.data.model_copy(update=one)})
    accelerator = make_accelerator(config)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    require_frames(config.data, to="show what is true")
    reporter.task(LOADING)
    models = load(dataset, decoder)
    models.put_on(accelerator.device)
    decoder.to(accelerator.device)
    members = dataset.members(split)[dataset.episodes]
    long_enough = dataset.table.num_steps[dataset.episodes] > config.data.model_stride
    episodes = tuple(int(one) for one in dataset.episodes[members & long_enough])
    if not episodes:
        dataset.windows(split)  # says why
    return Explorer(models, decoder, dataset, episodes, accelerator.autocast, simulate(dataset))


# ---- energies and plans ----

_NODES = 7  # of an energy map along each axis


@dataclass(frozen=True, eq=False)
class PlanFound:
    """A plan, and what its search saw."""

    plan: Plan
    energy_now: float  # of what is imagined now
    best: tuple[Float[Tensor, "tokens dim"], ...]  # imagined end of the best sample of each iteration


class Search:
    """Searches from places that are imagined."""

    def __init__(self, explorer: Explorer, config: PlanningConfig) -> None:
        """Prepare.

        Args:
            explorer: With the models.
            config: How plans are searched, and what energy is.
        """
        self._explorer, self.config = explorer, config

    def space(self, steps: int = 1) -> SearchSpace:
        """Return the allowed actions of a plan.

        Raises:
            InputError: There are no limits for vectors.
        """
        return search_space(self._of(steps), self._explorer.spaces.state)

    def _of(self, steps: int) -> PlanningConfig:
        return self.config.model_copy(update={"horizon": steps, "action_repeat": 1})

    @property
    def axes(self) -> tuple[int, ...]:
        """The numbers of an action over which energy is shown: of a pose the position, else the first ones."""
        is_pose = self._explorer.spaces.state.is_pose
        return (0, 1, 2) if is_pose else tuple(self.space().free[:3].tolist())

    def energy(self, latents: Float[Tensor, "tokens dim"], goal: Float[Tensor, "tokens dim"]) -> float:
        """Return the distance of a frame to a goal."""
        return float(distance(latents[None], goal[None], self.config.energy))

    def maps(
        self, teller: int, place: Place, goal: Tensor, action: Sequence[float], progress: Progress, cancelled: Cancelled
    ) -> tuple[EnergySlice, ...]:
        """Return the energy after one more action, over each pair of its numbers.

        Raises:
            InputError: There are no limits.
            SearchCancelledError: It was cancelled.
        """
        around = torch.tensor([list(action)], dtype=torch.float32)
        with self._cost(teller, place, goal) as cost:
            watched = until_cancelled(cancelled, progress)
            return energy_slices(cost, around, self.space(), self.axes, nodes=_NODES, progress=watched)

    def plan(
        self, teller: int, place: Place, goal: Tensor, steps: int, progress: Progress, cancelled: Cancelled
    ) -> PlanFound:
        """Return a plan of some steps.

        Raises:
            InputError: There are no limits.
            SearchCancelledError: It was cancelled.
        """
        planner = Planner(self._of(steps), self.space(steps), progress=progress)
        with self._cost(teller, place, goal) as cost, torch.no_grad():
            plan = planner.plan(cost, torch.Generator().manual_seed(0), cancelled=cancelled)
            elites = torch.stack([one.elites[0] for one in plan.iterations if len(one.elites)][-8:] or [plan.actions])
            best, _ = cost.imagine(elites)
        now = self.energy(self._explorer.imagined(teller, place), goal)
        return PlanFound(plan, now, tuple(best[:, -1].float()))

    @contextmanager
    def _cost(self, teller: int, place: Place, goal: Tensor) -> Iterator[WorldModelCost]:
        """Yield the energy from a place; what is imagined there counts as seen."""
        explorer = self._explorer
        state = torch.from_numpy(np.array(explorer.states(place)[-1], dtype=np.float32))
        scene = Scene(explorer.imagined(teller, place), state, explorer.camera(place))
        with explorer.autocast(), explorer.contenders[teller].switched():
            goals, config = Goal(goal[None]), self.config.energy
            yield WorldModelCost(explorer.model(teller), scene, goals, config, spaces=explorer.spaces)
