"""Decoded rollouts from a held-out clip, from an image with a state, or of a plan."""

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

_RATE_HZ = 15.0  # control rate that is assumed for an image without data: DROID's
_SEARCHED = 64  # number of clips from which the clip with the most motion is selected
_MOST_PLAN_STEPS = 8
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
    actions: tuple[str, ...] = (TRUE, "none", "up", "left", "close")  # names, `true`, or files
    steps: int = 7  # model steps
    size_m: float = STEP_M  # length of a named action in each step, clipped to the limits
    episode: str | None = None  # None: the held-out clip with the most motion
    start: int | None = None  # first control step; None: 0, or that of the clip with the most motion
    evaluation: EvaluationOptions = field(default_factory=EvaluationOptions)  # checkpoint, data, split


def imagine_image(session: Subject, options: ImagineOptions, observation: ImageObservation) -> RolloutComparison:
    """Predict and decode the frames after an image, for actions by name or from files.

    With `planning.views` above 1 the image contains the views of several cameras, as for a planner.

    Args:
        session: The model, and the config with the crop and the limits.
        options: Decoder, actions (names of directions, or files), number of steps, and their size.
        observation: The image and the state before the first action.

    Raises:
        InputError: Decoder, state or actions cannot be used.
    """
    require_single_process()
    model, config = session.world_model, session.config
    decoder = load_decoder(options.decoder)
    warnings = decoder.require_fit(model, config.data, subject=session.name)
    decoder.to(model.device)
    space = get_state_space(config.data, len(observation.state))
    _require_directions(space, where="--state")
    limits = config.planning.limits
    chosen = {name: _actions_by_name(name, options.steps, options.size_m, limits) for name in options.actions}
    camera = (
        None
        if observation.extrinsics is None
        else torch.as_tensor(observation.extrinsics, dtype=torch.float32).to(model.device)
    )
    views = config.planning.views
    latents = encode_frames(model, observation.image[None], config.data.crop, views=views)
    state = np.asarray(observation.state, dtype=np.float64)
    starts = [Start(view_latents, state, space, camera) for view_latents in latents[0].chunk(views)]
    cut = crop_frames(split_views(observation.image[None], views), config.data.crop)
    first = np.concatenate(to_display_frames(cut, model.image_size), axis=1)
    decoded_first = decode_views(decoder.decoder, latents, views)[0]

    def predicted_frames(actions: Float[np.ndarray, "steps 7"]) -> Frames:
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
            DecodedRollout("model", name, actions, predicted_frames(actions)) for name, actions in chosen.items()
        ),
        notes=(
            f"Times in the video assume {_RATE_HZ:g} control steps per second.",
            *warnings,
            *describe_poor_reconstruction(decoder.card, first, decoded_first),
        ),
    )


def _require_directions(space: StateSpace, *, where: str, fix: str = "") -> None:
    """Check that named actions are defined: not for vectors, and not for poses in the camera frame."""
    if not space.is_base_pose:
        problem, needed = (
            "states that are not poses in the robot base frame",
            "poses, because names are directions in that frame",
        )
        raise InputError(where=where, found=problem, needed=needed, fix=fix)


def _actions_by_name(word: str, steps: int, size_m: float, limits: LimitsConfig) -> Float[np.ndarray, "steps 7"]:
    if word.lower().endswith((".npy", ".csv")):
        return read_actions(word, steps=steps)
    return make_named_actions(word, steps, size_m=size_m, limits=limits)


def imagine_clip(
    subject: str, options: ImagineOptions, *, simulate: Simulate | None = None, reporter: Reporter = SILENT
) -> RolloutComparison:
    """Predict and decode a held-out clip with each model, for the recorded actions and for counterfactual actions.

    Args:
        subject: The folder of a run; or a model, with data in `evaluation`.
        options: The options.
        simulate: Simulates the outcome of other actions; if this fails, a note gives the reason.
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
    window = _window(dataset, options)
    reporter.task(LOADING)
    models = load_models(subject, config, options.evaluation, dataset, decoder)
    models.move_to(accelerator.device)
    decoder.to(accelerator.device)
    (batch,) = read_batches(dataset, [window], batch_size=1)
    size = models.world_model.image_size
    chosen = _actions_of(options, batch, dataset, limits=config.planning.limits)
    assert batch.frames is not None  # noqa: S101  # `require_frames` refuses cached latents
    frames = to_display_frames(batch.frames[0].numpy(), size)
    truths: dict[str, tuple[Frames, np.ndarray | None]] = {AS_RECORDED: (frames[1:], None)}
    notes: tuple[str, ...] = ()
    try:
        if simulate is not None and (outcome := simulate(dataset, *window)) is not None:
            for name in chosen.keys() - truths:
                truths[name] = _crop_and_resize(*outcome(chosen[name]), config=config, size=size)
    except UserError as error:
        notes = (f"The true outcome of other actions was not simulated: {error}",)
    rollouts: list[DecodedRollout] = []
    with accelerator.autocast():
        latents = encode_batch(models.world_model, batch, device=accelerator.device)
        start, states = Start.from_batch(latents, dataset.spaces.state), latents.states[0].double().cpu().numpy()[:-1]
        for name, actions in chosen.items():
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


def _actions_of(options: ImagineOptions, batch: Batch, dataset: Dataset, limits: LimitsConfig) -> dict[str, np.ndarray]:
    recorded = batch.actions[0].double().numpy()
    chosen: dict[str, np.ndarray] = {}
    for word in options.actions:
        if word == TRUE:
            chosen[AS_RECORDED] = recorded
            continue
        _require_directions(dataset.spaces.state, where=f"--actions {word}", fix="Use --actions true")
        name = word if word in ACTION_NAMES else Path(word).name  # with its suffix, so that it equals no action name
        chosen[word if name in chosen else name] = _actions_by_name(word, len(recorded), options.size_m, limits)
    return chosen


def _window(dataset: Dataset, options: ImagineOptions) -> tuple[int, int]:
    """Return the episode and the first control step of the clip to show."""
    lengths, clip, split = dataset.table.num_steps, dataset.config.clip_steps, options.evaluation.split
    if options.episode is None:
        members = dataset.split_mask(split)[dataset.episodes]
        longest = int(lengths[dataset.episodes[members]].max(initial=0))
        if 0 < longest < clip:
            most = (longest - 1) // dataset.config.model_stride
            problem = f"{counted(options.steps, 'model step')}, and the longest {split} episode has {most}"
            raise InputError(where="--steps", found=problem, needed=f"at most {most}")
        windows = validation_windows(dataset, split, clips=_SEARCHED)
        return max(windows, key=lambda window: _motion(dataset, *window))
    episode = find_episode(dataset, options.episode)
    start, last = options.start or 0, int(lengths[episode]) - clip
    if not 0 <= start <= last:
        needed = f"0 to {last}: a clip takes {counted(clip, 'control step')}" if last >= 0 else "a longer episode"
        problem, fix = f"{start}, in an episode of {counted(lengths[episode], 'step')}", "Lower --steps or --start"
        raise InputError(where="--start", found=problem, needed=needed, fix=fix)
    return episode, start


def _motion(dataset: Dataset, episode: int, start: int) -> float:
    """Return the length of the robot's path in a clip, added up over its model steps."""
    steps = range(start, start + dataset.config.clip_steps, dataset.config.model_stride)
    states = dataset.source.read(episode, None, dataset.needed_steps(episode)).states[list(steps)]
    return dataset.spaces.state.compute_path_length(states)


def _crop_and_resize(
    frames: Frames, arm: Bool[np.ndarray, "time h w"], *, config: Config, size: int
) -> tuple[Frames, Bool[np.ndarray, "time size size"]]:
    """Return the frames after the first one, and the arm's silhouettes in all frames, cropped and resized as inputs."""
    silhouettes = np.repeat(np.uint8(255) * arm[..., None], 3, axis=-1)
    inputs, outlines = (
        to_display_frames(crop_frames(images, config.data.crop), size) for images in (frames, silhouettes)
    )
    return inputs[1:], outlines[..., 0] > 127


# ---- of a plan ----


@dataclass(frozen=True, eq=False)
class ImaginedPlan:
    """Images of a plan, all with the crop and size of the encoder's input."""

    start: Image  # decoded current frame
    steps: dict[int, Image]  # number of model steps -> predicted frame, decoded; empty without a plan
    goal: Image  # the goal that applies at the end of the plan
    decoded_goal: Image


def imagine_plan(answer: PlanResult, decoder: TrainedDecoder) -> ImaginedPlan:
    """Decode the start, the goal and the predicted frames of a plan; at most eight frames, equally spaced.

    Args:
        answer: The decision.
        decoder: A decoder for the model's encoder; it is moved to the model's device.
    """
    controller, goal = answer.controller, answer.request.goals[answer.decision.goals[-1]].image
    decoder.to(controller.device)
    latents = torch.stack([controller.encode(image) for image in (answer.request.start, goal)])
    start, decoded_goal = decode_views(decoder.decoder, latents, controller.config.views)
    frames = _rollout(answer.decision, decoder)
    shown_steps = spread_indices_with_ends(len(frames), _MOST_PLAN_STEPS)
    views = crop_frames(split_views(goal[None], controller.config.views), controller.crop)
    goal_input = np.concatenate(to_display_frames(views, decoder.card.shape.image_size), axis=1)
    return ImaginedPlan(start, {step + 1: frames[step] for step in shown_steps}, goal_input, decoded_goal)


@torch.no_grad()
def _rollout(decision: Decision, decoder: TrainedDecoder) -> Frames:
    """Return the decoded frames after each step of a plan; empty without a plan or finite predictions."""
    side = decoder.card.shape.image_size
    no_frames = np.zeros((0, side, side, 3), np.uint8)
    if decision.plan is None or decision.cost is None:
        return no_frames
    latents: Float[torch.Tensor, "steps tokens dim"] = decision.cost.rollout(decision.plan.actions[None])[0][0]
    return (
        decode_views(decoder.decoder, latents, decision.cost.views)
        if bool(torch.isfinite(latents).all())
        else no_frames
    )
