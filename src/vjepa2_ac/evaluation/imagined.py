"""Predict and decode frames: from a held-out clip, from an image with a state, or for a plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from vjepa2_ac.config import Config, LimitsConfig
from vjepa2_ac.data.dataset import Dataset, find_episode, open_dataset
from vjepa2_ac.data.loader import read_batches, validation_windows
from vjepa2_ac.data.sources.indexed_source import get_state_space
from vjepa2_ac.data.transforms import crop_frames, split_views, to_display_frames
from vjepa2_ac.data.windows import require_frames, spread_indices_with_ends
from vjepa2_ac.decoding.decoder import TrainedDecoder, load_decoder
from vjepa2_ac.decoding.imagine import (
    AS_RECORDED,
    DecodedRollout,
    RolloutComparison,
    Start,
    compute_rollout,
    decode_views,
    describe_poor_reconstruction,
)
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch, encode_frames
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError, UserError, counted
from vjepa2_ac.evaluation.evaluate_run import load_models
from vjepa2_ac.evaluation.request import EvaluationOptions, require_single_process, resolve_config
from vjepa2_ac.planning.controller import Decision
from vjepa2_ac.planning.counterfactual import ACTION_NAMES, STEP_M, make_named_actions, read_actions
from vjepa2_ac.planning.decision import PlanResult
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.spaces import StateSpace

_RATE_HZ = 15.0  # assumed control rate for an image without data: that of DROID
_NUM_CANDIDATES = 64  # number of clips from which the clip with the most motion is selected
_MAX_PLAN_FRAMES = 8  # maximum number of predicted frames of a plan that are decoded
Image = UInt8[np.ndarray, "height width 3"]
Frames = UInt8[np.ndarray, "time h w 3"]
Outcome = Callable[[Float[np.ndarray, "steps 7"]], tuple[Frames, Bool[np.ndarray, "time h w"]]]
"""Actions -> the simulated camera frames (start included), and a mask of the pixels that show the arm."""
Simulate = Callable[[Dataset, int, int], Outcome | None]
"""Data set, episode, control step -> a simulation from this step; None: the data were not recorded in a simulator."""
TRUE = "true"  # name of the recorded actions


@dataclass(frozen=True, eq=False)
class ImageObservation:
    """A camera image, and the state of the robot at the same time."""

    image: UInt8[np.ndarray, "height width 3"]
    state: Float[np.ndarray, " state_dim"]
    extrinsics: Float[np.ndarray, " 6"] | None = None  # pose of the camera, if the model uses it


@dataclass(frozen=True)
class ImagineOptions:
    """Options of a decoded rollout."""

    decoder: str
    actions: tuple[str, ...] = (TRUE, "none", "up", "left", "close")  # `true`, names of actions, or files
    steps: int = 7  # model steps
    size_m: float = STEP_M  # length of a named action in each step, clipped to `planning.limits`
    episode: str | None = None  # None: the held-out clip with the most motion
    start: int | None = None  # first control step; None: 0, or that of the clip with the most motion
    evaluation: EvaluationOptions = field(default_factory=EvaluationOptions)  # checkpoint, data, split


def require_actions(options: ImagineOptions, *, has_recorded: bool) -> None:
    """Check the names and files of actions, before a model is loaded.

    Args:
        options: The options, with the names.
        has_recorded: Whether there are recorded actions, so that the name `true` is allowed.

    Raises:
        InputError: A name is unknown, or a file has no valid actions or too few of them.
    """
    for name in options.actions:
        if not (has_recorded and name == TRUE):
            _load_actions(name, options.steps, options.size_m, limits=None)


def imagine_image(session: Subject, options: ImagineOptions, observation: ImageObservation) -> RolloutComparison:
    """Predict and decode the frames after an image, for named actions or actions from files.

    With `planning.views` above 1 the image contains the views of several cameras side by side.

    Args:
        session: The model, and the config with crop and limits.
        options: Decoder, actions, number of steps, and size of named actions.
        observation: The image and the state before the first action.

    Raises:
        InputError: Decoder, state or actions cannot be used.
    """
    require_single_process()
    model, config = session.world_model, session.config
    decoder = load_decoder(options.decoder)
    warnings = decoder.require_compatible(model, config.data, subject=session.name)
    decoder.to(model.device)
    space = get_state_space(config.data, len(observation.state))
    _require_directions(space, where="--state")
    limits = config.planning.limits
    actions_by_name = {name: _load_actions(name, options.steps, options.size_m, limits) for name in options.actions}
    camera = None
    if observation.extrinsics is not None:
        camera = torch.as_tensor(observation.extrinsics, dtype=torch.float32).to(model.device)
    views = config.planning.views
    latents = encode_frames(model, observation.image[None], config.data.crop, views=views)
    state = np.asarray(observation.state, dtype=np.float64)
    starts = [Start(view_latents, state, space, camera) for view_latents in latents[0].chunk(views)]
    cropped = crop_frames(split_views(observation.image[None], views), config.data.crop)
    first = np.concatenate(to_display_frames(cropped, model.image_size), axis=1)
    decoded_first = decode_views(decoder.decoder, latents, views)[0]

    def predict_and_decode(actions: Float[np.ndarray, "steps 7"]) -> Frames:
        rollout = torch.cat([compute_rollout(model.rollout, start, actions) for start in starts], dim=1)
        return decode_views(decoder.decoder, rollout, views)

    return RolloutComparison(
        subject=session.name,
        episode_id="",
        start=0,
        seconds_per_step=(config.data.model_stride if config.data.stride != "auto" else 1) / _RATE_HZ,
        first=first,
        decoded_first=decoded_first,
        rollouts=tuple(
            DecodedRollout("model", name, actions, predict_and_decode(actions))
            for name, actions in actions_by_name.items()
        ),
        notes=(
            f"Times in the video assume {_RATE_HZ:g} control steps per second.",
            *warnings,
            *describe_poor_reconstruction(decoder.card, first, decoded_first),
        ),
    )


def _require_directions(space: StateSpace, *, where: str, fix: str = "") -> None:
    """Check that named actions are defined, which needs poses in the robot base frame."""
    if not space.is_base_pose:
        problem = "states that are not poses in the robot base frame"
        needed = "poses, because names are directions in that frame"
        raise InputError(where=where, found=problem, needed=needed, fix=fix)


def _load_actions(word: str, steps: int, size_m: float, limits: LimitsConfig | None) -> Float[np.ndarray, "steps 7"]:
    """Return the named actions, or the actions in a file."""
    if word.lower().endswith((".npy", ".csv")):
        return read_actions(word, steps=steps)
    return make_named_actions(word, steps, size_m=size_m, limits=limits)


def imagine_clip(
    subject: str, options: ImagineOptions, *, simulate: Simulate | None = None, reporter: Reporter = SILENT
) -> RolloutComparison:
    """Predict and decode a held-out clip with each model, for the recorded actions and for counterfactual actions.

    Args:
        subject: The folder of a run, or a model with the data in `options.evaluation`.
        options: The options.
        simulate: Simulates the outcome of counterfactual actions; if the simulation fails, a note gives the reason.
        reporter: Shows the progress.

    Raises:
        InputError: Subject, data, decoder, clip or actions cannot be used.
    """
    decoder = load_decoder(options.decoder)
    require_single_process()
    config = resolve_config(subject, options.evaluation)
    config = config.model_copy(update={"data": config.data.model_copy(update={"frames": options.steps + 1})})
    accelerator = make_accelerator(config)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    require_frames(config.data, to="show what is true")
    window = _select_window(dataset, options)
    reporter.task(LOADING)
    models = load_models(subject, config, options.evaluation, dataset, decoder)
    models.move_to(accelerator.device)
    decoder.to(accelerator.device)
    (batch,) = read_batches(dataset, [window], batch_size=1)
    size = models.world_model.image_size
    actions_by_name = _select_actions(options, batch, dataset, limits=config.planning.limits)
    assert batch.frames is not None  # noqa: S101  # `require_frames` raises for cached latents
    frames = to_display_frames(batch.frames[0].numpy(), size)
    truths: dict[str, tuple[Frames, np.ndarray | None]] = {AS_RECORDED: (frames[1:], None)}
    notes: tuple[str, ...] = ()
    try:
        if simulate is not None and (outcome := simulate(dataset, *window)) is not None:
            for name in actions_by_name.keys() - truths:
                truths[name] = _crop_and_resize(*outcome(actions_by_name[name]), config=config, size=size)
    except UserError as error:
        notes = (f"The true outcome of other actions was not simulated: {error}",)
    rollouts: list[DecodedRollout] = []
    with accelerator.autocast():
        latents = encode_batch(models.world_model, batch, device=accelerator.device)
        start, states = Start.from_batch(latents, dataset.spaces.state), latents.states[0].double().cpu().numpy()[:-1]
        for name, actions in actions_by_name.items():
            for model in models.evaluated_models:
                with model.prediction_context():
                    rollout = compute_rollout(
                        model.model.rollout, start, actions, states if name == AS_RECORDED else None
                    )
                truth = truths.get(name, (None, None))
                rollouts.append(
                    DecodedRollout(model.name, name, actions, decode_views(decoder.decoder, rollout), *truth)
                )
        decoded = decode_views(decoder.decoder, latents.latents[0])
    return RolloutComparison(
        subject=subject,
        episode_id=batch.episode_ids[0],
        start=batch.starts[0],
        seconds_per_step=config.data.model_stride / dataset.control_rate_hz,
        first=frames[0],
        decoded_first=decoded[0],
        rollouts=tuple(rollouts),
        truth=frames[1:],
        decoded_truth=decoded[1:],
        notes=(*describe_poor_reconstruction(decoder.card, frames[0], decoded[0]), *notes),
    )


def _select_actions(
    options: ImagineOptions, batch: Batch, dataset: Dataset, limits: LimitsConfig
) -> dict[str, np.ndarray]:
    """Return the actions of each model step by name, as `options.actions` requests."""
    recorded = batch.actions[0].double().numpy()
    actions_by_name: dict[str, np.ndarray] = {}
    for word in options.actions:
        if word == TRUE:
            actions_by_name[AS_RECORDED] = recorded
            continue
        _require_directions(dataset.spaces.state, where=f"--actions {word}", fix="Use --actions true")
        name = (
            word if word in ACTION_NAMES else Path(word).name
        )  # with the suffix, so that it differs from action names
        actions = _load_actions(word, len(recorded), options.size_m, limits)
        actions_by_name[word if name in actions_by_name else name] = actions
    return actions_by_name


def _select_window(dataset: Dataset, options: ImagineOptions) -> tuple[int, int]:
    """Return the episode and the first control step of the clip to show."""
    lengths, clip, split = dataset.table.num_steps, dataset.config.clip_steps, options.evaluation.split
    if options.episode is None:
        is_in_split = dataset.split_mask(split)[dataset.episodes]
        longest = int(lengths[dataset.episodes[is_in_split]].max(initial=0))
        if 0 < longest < clip:
            max_steps = (longest - 1) // dataset.config.model_stride
            problem = f"{counted(options.steps, 'model step')}, and the longest {split} episode has {max_steps}"
            raise InputError(where="--steps", found=problem, needed=f"at most {max_steps}")
        windows = validation_windows(dataset, split, clips=_NUM_CANDIDATES)
        return max(windows, key=lambda window: _measure_path(dataset, *window))
    episode = find_episode(dataset, options.episode)
    start, last = options.start or 0, int(lengths[episode]) - clip
    if not 0 <= start <= last:
        needed = f"0 to {last}: a clip takes {counted(clip, 'control step')}" if last >= 0 else "a longer episode"
        problem, fix = f"{start}, in an episode of {counted(lengths[episode], 'step')}", "Lower --steps or --start"
        raise InputError(where="--start", found=problem, needed=needed, fix=fix)
    return episode, start


def _measure_path(dataset: Dataset, episode: int, start: int) -> float:
    """Return the length of the robot's path in a clip, summed over the model steps."""
    steps = range(start, start + dataset.config.clip_steps, dataset.config.model_stride)
    states = dataset.source.read(episode, None, dataset.needed_steps(episode)).states[list(steps)]
    return dataset.spaces.state.compute_path_length(states)


def _crop_and_resize(
    frames: Frames, arm: Bool[np.ndarray, "time h w"], *, config: Config, size: int
) -> tuple[Frames, Bool[np.ndarray, "time size size"]]:
    """Crop and resize frames and masks of the arm like the model's input; return the frames after the first one."""
    silhouettes = np.repeat(np.uint8(255) * arm[..., None], 3, axis=-1)
    inputs, masks = (to_display_frames(crop_frames(images, config.data.crop), size) for images in (frames, silhouettes))
    return inputs[1:], masks[..., 0] > 127


# ---- the predicted frames of a plan ----


@dataclass(frozen=True, eq=False)
class ImaginedPlan:
    """The images that a plan predicts, all with the crop and size of the encoder's input."""

    start: Image  # decoded current frame
    steps: dict[int, Image]  # number of model steps -> predicted frame, decoded; empty without a plan
    goal: Image  # the goal that applies at the end of the plan
    decoded_goal: Image


def imagine_plan(result: PlanResult, decoder: TrainedDecoder) -> ImaginedPlan:
    """Decode the start, the goal and at most eight equally spaced predicted frames of a plan.

    Args:
        result: The result of the planner.
        decoder: A decoder for the model's encoder; it is moved to the model's device.
    """
    controller, goal = result.controller, result.request.goals[result.decision.goals[-1]].image
    decoder.to(controller.device)
    latents = torch.stack([controller.encode(image) for image in (result.request.start, goal)])
    start, decoded_goal = decode_views(decoder.decoder, latents, controller.config.views)
    frames = _decode_plan(result.decision, decoder)
    shown_steps = spread_indices_with_ends(len(frames), _MAX_PLAN_FRAMES)
    views = crop_frames(split_views(goal[None], controller.config.views), controller.crop)
    goal_input = np.concatenate(to_display_frames(views, decoder.card.shape.image_size), axis=1)
    return ImaginedPlan(start, {step + 1: frames[step] for step in shown_steps}, goal_input, decoded_goal)


@torch.no_grad()
def _decode_plan(decision: Decision, decoder: TrainedDecoder) -> Frames:
    """Return the decoded frames after each step of a plan; empty without a plan or finite predictions."""
    side = decoder.card.shape.image_size
    no_frames = np.zeros((0, side, side, 3), np.uint8)
    if decision.plan is None or decision.cost is None:
        return no_frames
    latents: Float[torch.Tensor, "steps tokens dim"] = decision.cost.rollout(decision.plan.actions[None])[0][0]
    is_finite = bool(torch.isfinite(latents).all())
    return decode_views(decoder.decoder, latents, decision.cost.views) if is_finite else no_frames
