"""Messages between the page and the server: requests, and replies with predictions, energies and plans."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field
from torch import Tensor

from vjepa2_ac.config import Config
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.data.windows import spread_indices_with_ends
from vjepa2_ac.episode import Progress, shorten_names
from vjepa2_ac.errors import InputError
from vjepa2_ac.explore.explorer import (
    MAX_STEPS,
    Explorer,
    Observation,
    Pixels,
    RolloutPosition,
    Search,
    compute_relative_spread,
)
from vjepa2_ac.media.figure import colour_errors
from vjepa2_ac.media.images import encode_jpeg
from vjepa2_ac.planning.energy import mean_difference
from vjepa2_ac.planning.planner import Cancelled
from vjepa2_ac.spaces import Space
from vjepa2_ac.storage.structured import parse_record, to_plain

_CPU_SEARCH = {"samples": 64, "iterations": 4}  # size of a search on a CPU (docs/planning.md)
_MAX_FRAMES = 16  # frames of an image strip
_MAX_EPISODES = 500  # episodes in the list of the page
_MAX_SAMPLED_EPISODES = 32  # episodes that are read to find the most motion and typical step sizes
_STEP_PERCENTILE = 90.0  # percentile of the recorded changes that is the typical step size
_REST_SHARE = 0.1  # changes below this fraction of the largest change are not used for the typical step size
# Step sizes of numbers that never change in the data: positions (m), rotations (rad), grippers, other numbers.
_DEFAULT_STEPS = (0.05, 0.1, 0.5, 0.05)
_MOVES: tuple[tuple[str, int | None, int], ...] = (
    ("forward", 0, 1), ("back", 0, -1), ("left", 1, 1), ("right", 1, -1), ("up", 2, 1), ("down", 2, -1),
    ("turn left", 5, 1), ("turn right", 5, -1), ("open", 6, -1), ("close", 6, 1), ("zero action", None, 0),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Views:
    """Computes the replies to the requests of a page. This class does not use the network."""

    subject: str
    explorer: Explorer
    search: Search

    @classmethod
    def create(cls, subject: str, explorer: Explorer, config: Config) -> Views:
        """Return the views of an explorer. On a CPU the search is smaller unless the config changes `planning`."""
        planning = config.planning
        if explorer.device.type == "cpu" and planning == PlanningConfig(limits=planning.limits):
            planning = planning.model_copy(update=_CPU_SEARCH)
        return cls(subject, explorer, Search(explorer, planning))

    def reply_to(self, request: PageRequest, progress: Progress, cancelled: Cancelled) -> bytes:
        """Return the encoded reply to a request.

        Args:
            request: The request of a page.
            progress: Called during a search.
            cancelled: Returns whether to cancel a search or a simulation.

        Raises:
            InputError: There is no such position, goal or model.
            SearchCancelledError: The search or simulation was cancelled.
        """
        if request.kind == "episode":
            return self._make_episode_reply(request)
        actions = tuple(tuple(action) for action in request.actions)
        position = self.explorer.validate(RolloutPosition(request.episode, request.start, actions))
        if request.kind == "predict":
            return self._make_prediction_reply(request, position, cancelled)
        return self._make_search_reply(request, position, progress, cancelled)

    def make_hello(self) -> bytes:
        """Return the first message to a page: models, episodes, units, moves, and a proposed start and goal."""
        explorer, space = self.explorer, self.explorer.spaces.state
        episode, goal = self._initial_episode_and_goal
        content = {
            "subject": self.subject,
            "notes": explorer.notes,
            "models": [{"id": model.name, "label": model.name} for model in explorer.evaluated_models],
            "truth": "recorded" if explorer.simulate is None else "simulated",
            "episodes": [
                {"name": name, "full": explorer.get_episode_name(index), "steps": explorer.get_num_steps(index)}
                for index, name in enumerate(self.episode_names[:_MAX_EPISODES])
            ],
            "stride": explorer.stride,
            "seconds_per_step": explorer.stride / explorer.dataset.control_rate_hz,
            "max_steps": MAX_STEPS,
            "device": explorer.device.type,
            "step_seconds": self.step_seconds,
            "action": self.numbers,
            "state": make_displayed_units(space),
            "is_pose": space.is_base_pose,
            "moves": self.moves,
            "position": {"episode": episode, "start": 0},
            "goal": {"episode": episode, "step": goal},
        }
        return encode_message("hello", None, content)

    @cached_property
    def episode_names(self) -> list[str]:
        """Names of the episodes, without the parts that all names share."""
        names = [self.explorer.get_episode_name(index) for index in range(len(self.explorer.episodes))]
        short = shorten_names(names)
        return [short[name] for name in names]

    # ---- actions and moves ----

    @cached_property
    def numbers(self) -> list[dict[str, Any]]:
        """The numbers of an action: name, unit, typical step size, and the largest value that can be selected."""
        space, typical_sizes = self.explorer.spaces.state, self._typical_step_sizes
        steps = []
        for number in range(len(space)):
            kind = {"m": 0, "rad": 1}.get(space.units[number], 2 if number == space.gripper else 3)
            steps.append(
                float(typical_sizes[number])
                if typical_sizes[number] > _DEFAULT_STEPS[kind] / 10
                else _DEFAULT_STEPS[kind]
            )
        for component_slice in (space.position, space.rotation):
            if component_slice is not None:
                steps[component_slice] = [max(steps[component_slice])] * len(steps[component_slice])
        return [
            {**unit, "name": name, "step": step, "most": 2 * step}
            for unit, name, step in zip(make_displayed_units(space), space.change_names, steps, strict=True)
        ]

    @property
    def moves(self) -> list[dict[str, Any]]:
        """The moves that a user can command: name, component of the action, and sign."""
        space, moves = self.explorer.spaces.state, _MOVES
        if not space.is_base_pose:
            names = enumerate(space.change_names)
            signs = [(f"{name} {word}", axis, sign) for axis, name in names for word, sign in (("+", 1), ("-", -1))]
            moves = (*signs, _MOVES[-1])
        return [{"id": name, "label": name, "axis": axis, "sign": sign} for name, axis, sign in moves]

    @cached_property
    def _recorded_changes(self) -> list[Float[np.ndarray, "steps dim"]]:
        """The changes of the state in each model step of some episodes."""
        explorer, changes = self.explorer, []
        for episode in explorer.episodes[:_MAX_SAMPLED_EPISODES]:
            states = np.asarray(explorer.dataset.source.read(episode).states, dtype=np.float64)
            changes.append(explorer.spaces.state.compute_differences(states[:: explorer.stride]))
        return changes

    @property
    def _typical_step_sizes(self) -> Float[np.ndarray, " dim"]:
        sizes = np.abs(np.concatenate(self._recorded_changes)).T
        return np.array([np.percentile(axis[axis >= _REST_SHARE * axis.max()], _STEP_PERCENTILE) for axis in sizes])

    @property
    def _initial_episode_and_goal(self) -> tuple[int, int]:
        """The proposed episode, which has the most motion, and the proposed goal, its last control step."""
        size = self.explorer.spaces.state.size_axes
        lengths = [float(np.linalg.norm(changes[:, size], axis=1).sum()) for changes in self._recorded_changes]
        episode = int(np.argmax(lengths))
        return episode, self.explorer.get_num_steps(episode) - 1

    @cached_property
    def step_seconds(self) -> float:
        """Time in seconds to predict and decode one step with all models, measured once after a warm-up."""
        zero_action = (0.0,) * len(self.explorer.spaces.state)
        for attempt in range(2):
            start_time, position = time.perf_counter(), RolloutPosition(0, 0, (zero_action,) * (attempt + 1))
            for model_index in range(len(self.explorer.evaluated_models)):
                self.explorer.decode(self.explorer.predict_latents(model_index, position))
        return time.perf_counter() - start_time

    # ---- replies ----

    def _make_episode_reply(self, request: PageRequest) -> bytes:
        explorer, index = self.explorer, request.episode
        explorer.validate(RolloutPosition(index, 0))
        last, stride = explorer.get_num_steps(index) - 1, explorer.stride
        steps = [index * stride for index in spread_indices_with_ends(last // stride + 1, _MAX_FRAMES)]
        images = [
            Image(f"frame-{number}", explorer.get_observation(index, step).pixels, f"recorded at control step {step}")
            for number, step in enumerate(steps)
        ]
        return encode_message("episode", request.seq, {"episode": index, "steps": steps}, images)

    def _make_prediction_reply(self, request: PageRequest, position: RolloutPosition, cancelled: Cancelled) -> bytes:
        explorer, start = self.explorer, self.explorer.get_observation(position.episode, position.start)
        goal = self._get_goal_observation(request)
        outcome, states = explorer.get_true_observation(position, cancelled), explorer.integrate_states(position)
        truth_kind = None if outcome is None else "simulated" if outcome.is_simulated else "recorded"
        images = [Image("start", start.pixels, f"start frame, recorded at control step {position.start}")]
        images += [] if outcome is None else [Image("truth", outcome.pixels, f"ground truth, {truth_kind}")]
        images += [] if goal is None else [Image("goal", goal.pixels, "goal frame")]
        model_results = []
        for number, evaluated_model in enumerate(explorer.evaluated_models):
            latents, name = explorer.predict_latents(number, position), evaluated_model.name
            images.append(Image(f"predicted-{name}", explorer.decode(latents), f"frame predicted by {name}"))
            errors = None if outcome is None or not position.actions else mean_difference(latents, outcome.latents)
            if errors is not None:
                images.append(Image(f"error-{name}", self._draw_error_map(errors), f"error map of {name}"))
            model_results.append({
                "id": name,
                "error": None if errors is None else float(errors.mean()),
                "spread": compute_relative_spread(latents, start.latents if outcome is None else outcome.latents),
                "energy": None if goal is None else self.search.compute_energy(latents, goal.latents),
            })  # fmt: skip
        position_axes = explorer.spaces.state.position
        content = {
            "episode": position.episode,
            "start": position.start,
            "actions": position.actions,
            "recorded": explorer.get_recorded_observation(position) is not None,
            "next_recorded": explorer.get_next_recorded_action(position),
            "state": states[-1],
            "path": None if position_axes is None else states[:, position_axes],
            "truth": truth_kind,
            "truth_state": None if outcome is None else outcome.state,
            "note": ""
            if outcome is None or outcome.has_reached_target
            else "The target is out of reach. The arm stopped on the way to it.",
            "models": model_results,
            "persistence_error": None
            if outcome is None
            else float(mean_difference(start.latents, outcome.latents).mean()),
        }
        return encode_message("predict", request.seq, content, images)

    def _get_goal_observation(self, request: PageRequest) -> Observation | None:
        """Return the goal frame of a request; None if there is none.

        Raises:
            InputError: There is no such frame.
        """
        explorer, goal = self.explorer, request.goal
        if goal is None:
            return None
        if goal.episode >= len(explorer.episodes) or goal.step >= explorer.get_num_steps(goal.episode):
            problem = f"step {goal.step} of episode {goal.episode}"
            raise InputError(where="goal", found=problem, needed="a frame of one of the listed episodes")
        return explorer.get_observation(goal.episode, goal.step)

    def _draw_error_map(self, errors: Float[Tensor, " tokens"]) -> Pixels:
        size = self.explorer.world_model.image_size
        grid = size // self.explorer.world_model.sizes.patch_size
        return colour_errors(errors.float().reshape(grid, grid).cpu().numpy(), (size, size)).astype(np.uint8)

    def _make_search_reply(
        self, request: PageRequest, position: RolloutPosition, progress: Progress, cancelled: Cancelled
    ) -> bytes:
        names = [evaluated_model.name for evaluated_model in self.explorer.evaluated_models]
        goal_observation = self._get_goal_observation(request)
        if goal_observation is None or request.model not in names:
            raise InputError(
                where=request.kind, found="no goal frame or no known model", needed="a goal frame and a model"
            )
        goal, model_index = goal_observation.latents, names.index(request.model)
        if request.kind == "plan":
            result = self.search.plan(model_index, position, goal, request.steps, progress, cancelled)
            iterations = [iteration for iteration in result.plan.iterations if len(iteration.elites)]
            content = {
                "actions": result.plan.actions.double(),
                "energy_now": result.energy_now,
                "energy_plan": result.plan.energy,
                "iterations": [{"lowest": iteration.lowest} for iteration in iterations],
            }
            images = [
                Image(f"best-{number}", self.explorer.decode(latents), f"best of iteration {number + 1}")
                for number, latents in enumerate(result.best)
            ]
            return encode_message("plan", request.seq, content, images)
        width = len(self.explorer.spaces.state)
        action = request.action if len(request.action) == width else [0.0] * width
        maps = self.search.compute_maps(model_index, position, goal, action, progress, cancelled)
        energy_maps = [
            {
                "across": plane.components[0], "up": plane.components[1],
                "across_values": plane.across, "up_values": plane.up, "energy": plane.energy,
            }
            for plane in maps
        ]  # fmt: skip
        energy_now = self.search.compute_energy(self.explorer.predict_latents(model_index, position), goal)
        return encode_message("energy", request.seq, {"maps": energy_maps, "energy_now": energy_now}, ())


# ---- message format: a request is JSON; a reply is a JSON header followed by images ----

MAX_REQUEST_BYTES = 1 << 16  # size limit of a request
_QUALITY = 90  # JPEG quality

Number = Annotated[float, Field(allow_inf_nan=False)]
Action = Annotated[list[Number], Field(max_length=64)]
Index = Annotated[int, Field(ge=0, le=1 << 40)]


@dataclass(frozen=True)
class GoalFrame:
    """A goal frame: an episode and a control step."""

    episode: Index
    step: Index  # control step


@dataclass(frozen=True)
class PageRequest:
    """A request of a page; `kind` determines which fields are used."""

    seq: Index  # number of the request, which its reply repeats
    kind: Literal["episode", "predict", "energy", "plan"]
    episode: Index = 0
    start: Index = 0  # control step of the start frame
    actions: Annotated[list[Action], Field(max_length=MAX_STEPS)] = field(default_factory=list)
    goal: GoalFrame | None = None
    model: Annotated[str, Field(max_length=200)] = ""  # name of the model, for energy and plan
    action: Action = field(default_factory=list)  # the action in the middle of the energy maps
    steps: Annotated[int, Field(ge=1, le=8)] = 1  # model steps of a plan


def read_request(text: str | bytes) -> PageRequest:
    """Parse a request.

    Raises:
        InputError: The text is not a valid request.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError(
            where="request", found="invalid JSON", needed="a request in the format of explore's page"
        ) from None
    return parse_record(PageRequest, values, where="request", needed="a request in the format of explore's page")


@dataclass(frozen=True)
class Image:
    """An image of a reply."""

    name: str
    pixels: UInt8[np.ndarray, "height width 3"]
    alt: str  # text description


def encode_message(kind: str, seq: int | None, values: dict[str, Any], images: Sequence[Image] = ()) -> bytes:
    """Encode a message to the page: the length of the header in 4 bytes, the JSON header, and the images as JPEG.

    Args:
        kind: The kind of the message.
        seq: The number of the request; None for a message without a request.
        values: Further values of the header; numbers that are not finite become null.
        images: The images after the header.
    """
    jpegs = [encode_jpeg(image.pixels, quality=_QUALITY) for image in images]
    image_headers = [
        {"name": image.name, "bytes": len(data), "alt": image.alt} for image, data in zip(images, jpegs, strict=True)
    ]
    text = json.dumps(to_plain({"kind": kind, "seq": seq, "images": image_headers, **values}), allow_nan=False).encode()
    return b"".join([len(text).to_bytes(4, "big"), text, *jpegs])


def make_displayed_units(space: Space) -> list[dict[str, Any]]:
    """Return the name, unit, displayed unit and conversion factor of each number of a state or an action."""
    display_units = {"m": ("cm", 100.0), "rad": ("°", 180 / math.pi)}
    units = [
        (name, unit, *display_units.get(unit, (unit, 1.0))) for name, unit in zip(space.names, space.units, strict=True)
    ]
    return [dict(zip(("name", "unit", "display_unit", "factor"), values, strict=True)) for values in units]
