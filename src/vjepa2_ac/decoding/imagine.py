"""Decoded rollouts from one frame with any actions, as image strip, video and GIF; and image strips during training.

The inputs are the first frame, its state and the actions. With alternative actions the later states are integrated
from the first state, because the recorded states belong to the recorded actions.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vjepa2_ac.config import Config
from vjepa2_ac.data.dataset import Dataset, frames_for_display
from vjepa2_ac.data.transforms import to_display_frames
from vjepa2_ac.decoding.decoder import Decoder, DecoderCard, TrainedDecoder, load_decoder, to_pixels
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import UnreachableError
from vjepa2_ac.media.figure import FrameKind, RolloutStrip, StripRow, draw_strip, render_frames, schedule_loop
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.media.video import write_gif, write_video
from vjepa2_ac.model.lora import use_base_weights
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.runs.checkpoint import checkpoint_name
from vjepa2_ac.runs.folder import IMAGINED
from vjepa2_ac.spaces import StateSpace, clip_gripper_changes, integrate_states
from vjepa2_ac.storage import translate_write_errors, write_atomically

logger = logging.getLogger(__name__)

Actions = Float[np.ndarray, "steps action_dim"]
Image = UInt8[np.ndarray, "size size 3"]  # with the crop and size of the encoder's input
Frames = UInt8[np.ndarray, "steps size size 3"]

STRIP, VIDEO, GIF = "imagined.png", "imagined.mp4", "imagined.gif"
AS_RECORDED = "as recorded"
_GROUND_TRUTH, _TITLE = "ground truth", "Frames predicted from one input frame and the actions"
_MUCH_WORSE_DB = 5.0
_RATE_HZ = 15.0  # frame rate of the video
_MAX_NAME_LENGTH = 44  # characters
_MIN_SHOWN_CM, _MIN_SHOWN_GRIPPER = 0.15, 0.05  # captions omit smaller components of an action
_POSE = 7  # width of a pose
_DIRECTIONS = (("forward", "back"), ("left", "right"), ("up", "down"))  # names of +/- x, y, z in the robot base frame


@dataclass(frozen=True, eq=False)
class Start:
    """The start of a rollout: the model's input for the first frame."""

    latents: Float[Tensor, "tokens dim"]
    state: Float[np.ndarray, " state_dim"]
    space: StateSpace
    extrinsics: Float[Tensor, " 6"] | None = None

    @classmethod
    def from_batch(cls, batch: LatentBatch, space: StateSpace) -> Start:
        """Return the start of the first clip of a batch."""
        extrinsics = None if batch.extrinsics is None else batch.extrinsics[0, 0]
        return cls(batch.latents[0, 0], batch.states[0, 0].double().cpu().numpy(), space, extrinsics)


@dataclass(frozen=True, eq=False)
class DecodedRollout:
    """A decoded rollout, and the true frames if they are known."""

    model: str  # such as "base", "adapter" or "model"
    name: str  # name of the actions, such as "as recorded" or "up"
    actions: Actions
    frames: Frames  # predicted frame after each action
    truth: Frames | None = None
    outlines: Bool[np.ndarray, "time size size"] | None = None  # true masks of the arm, one per frame


@dataclass(frozen=True, eq=False)
class RolloutComparison:
    """All decoded rollouts from one start. All frames have the crop and size of the encoder's input."""

    subject: str  # title of the model, such as the run and its step
    episode_id: str  # "" for an image that is not from a data set
    start: int  # control step of the first frame
    seconds_per_step: float
    first: Image
    decoded_first: Image
    rollouts: tuple[DecodedRollout, ...]
    truth: Frames | None = None  # true frames for the recorded actions
    decoded_truth: Frames | None = None
    notes: tuple[str, ...] = ()


@torch.no_grad()
def compute_rollout(
    rollout: Callable[..., Tensor],
    start: Start,
    actions: Actions,
    states: Float[np.ndarray, "steps state_dim"] | None = None,
) -> Float[Tensor, "steps tokens dim"]:
    """Return the predicted latents after each action, in a rollout from one frame.

    Args:
        rollout: The prediction function, such as `WorldModel.rollout`.
        start: The first frame and its state.
        actions: One action for each step.
        states: The recorded states, for recorded actions. None: states are integrated from the first state, and gripper
            changes are clipped to the possible range (`clip_gripper_changes`), as in the training data.
    """
    if states is None:
        states = integrate_states(start.state, actions, start.space)[:-1]
        actions = clip_gripper_changes(start.state, actions, start.space)
    device = start.latents.device
    action_inputs, state_inputs = (
        torch.as_tensor(values, dtype=torch.float32, device=device)[None] for values in (actions, states)
    )
    extrinsics = None if start.extrinsics is None else start.extrinsics.expand(1, len(actions), -1)
    return rollout(start.latents[None, None], action_inputs, state_inputs, extrinsics)[0]


def describe_poor_reconstruction(card: DecoderCard, first: Image, decoded_first: Image) -> tuple[str, ...]:
    """Return a note if the decoder reconstructs the start frame much worse than the decoder's held-out frames."""
    usual_db = card.held_out.get("decoder", {}).get("psnr_db", {}).get("value")
    error = np.square(first.astype(np.float64) - decoded_first).mean() / 255**2
    psnr_db = -10 * np.log10(max(error, 1e-10))
    if usual_db is None or psnr_db > usual_db - _MUCH_WORSE_DB:
        return ()
    note = (
        f"The decoder reconstructs the start frame with a PSNR of {psnr_db:.1f} dB, compared with {usual_db:.1f} dB on"
        " its held-out frames. The latents may contain details that are not visible in the decoded images."
        " Train a decoder on this scene."
    )
    return (note,)


def decode_views(
    decoder: Decoder, latents: Float[Tensor, "steps tokens dim"], views: int = 1
) -> UInt8[np.ndarray, "steps size total_width 3"]:
    """Decode latents to 8-bit images. With several views the images are side by side."""
    images = to_pixels(decoder.decode(latents.float().reshape(len(latents) * views, -1, latents.shape[-1])))
    return np.concatenate([images[number::views] for number in range(views)], axis=2)


def make_strip(comparison: RolloutComparison) -> RolloutStrip:
    """Return the image strip of a comparison: for each action sequence the true frames, then the frames of each model.

    The recorded action sequence is first.
    """
    first, decoded_first = comparison.first[None], comparison.decoded_first[None]
    rows: list[StripRow] = []
    ordered = sorted(comparison.rollouts, key=lambda rollout: rollout.name != AS_RECORDED)
    for name, rollouts in groupby(ordered, key=lambda rollout: rollout.name):
        for number, rollout in enumerate(rollouts):
            sequence, is_recorded = _describe_actions(rollout), name == AS_RECORDED
            if not number and (truth := comparison.truth if is_recorded else rollout.truth) is not None:
                captions = ("", *map(_describe_action, rollout.actions)) if is_recorded else ()
                frames = np.concatenate([first, truth])
                rows.append(
                    StripRow(_GROUND_TRUTH, "recorded" if is_recorded else "simulated", frames, captions, sequence)
                )
            if not number and is_recorded and comparison.decoded_truth is not None:
                frames = np.concatenate([decoded_first, comparison.decoded_truth])
                rows.append(StripRow("ground truth,\ndecoded", "decoded", frames, sequence=sequence))
            frames = np.concatenate([decoded_first, rollout.frames])
            kind: FrameKind = "predicted_base" if rollout.model == "base" else "predicted"
            label = f"prediction of\n{rollout.model}"
            rows.append(StripRow(label, kind, frames, sequence=sequence, outlines=rollout.outlines))
    clip = (
        f"{_shorten_name(comparison.episode_id)} from control step {comparison.start}"
        if comparison.episode_id
        else "from an image"
    )
    seconds = tuple(time * comparison.seconds_per_step for time in range(len(rows[0].frames) if rows else 0))
    return RolloutStrip(_TITLE, tuple(rows), seconds, source=f"{comparison.subject}, {clip}")


def _describe_actions(rollout: DecodedRollout) -> str:
    """Return a short label of a rollout's actions."""
    if rollout.name == AS_RECORDED:
        return AS_RECORDED
    length = 100 * float(np.linalg.norm(rollout.actions[0, :3])) if rollout.actions.shape[1] == _POSE else 0.0
    name = "zero action" if rollout.name == "none" else rollout.name
    return name + (f", {length:.3g} cm per step" if length >= _MIN_SHOWN_CM else "")


def _describe_action(action: Float[np.ndarray, " action_dim"]) -> str:
    """Return a description of a change of the pose, such as "left 2.0, up 1.0 cm, close"; "" for other actions."""
    if len(action) != _POSE:
        return ""
    components = []
    for amount, (plus, minus) in zip(100 * action[:3], _DIRECTIONS, strict=True):
        if abs(amount) >= _MIN_SHOWN_CM:
            components.append((abs(amount), f"{plus if amount > 0 else minus} {abs(amount):.1f}"))
    largest = [text for _, text in sorted(components, reverse=True)[:2]]
    parts = [f"{', '.join(largest)} cm"] if largest else []
    if abs(action[6]) >= _MIN_SHOWN_GRIPPER:
        parts.append("close" if action[6] > 0 else "open")
    return ", ".join(parts) or "still"


def _shorten_name(name: str) -> str:
    """Return the end of an episode's name; for DROID, whose names contain several paths, the end of the first path."""
    short = name.split("--", maxsplit=1)[0].removesuffix("/recordings/MP4").rstrip("/")
    return short if len(short) <= _MAX_NAME_LENGTH else f"...{short[-_MAX_NAME_LENGTH:]}"


def write_rollouts(comparison: RolloutComparison, folder: Path, *, reporter: Reporter = SILENT) -> list[Path]:
    """Write image strip, video and GIF, and return their paths; without PyAV only the strip and the GIF.

    Raises:
        InputError: The folder cannot be written.
    """
    strip = make_strip(comparison)
    with translate_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / STRIP, encode_png(draw_strip(strip)))
        images, loop = list(render_frames(strip)), schedule_loop(strip)
        frames, seconds = [images[index] for index, _ in loop], [duration_s for _, duration_s in loop]
        repeats = [max(1, round(duration_s * _RATE_HZ)) for duration_s in seconds]
        written = [folder / STRIP, write_gif(folder / GIF, frames, seconds=seconds)]
        try:
            written.append(write_video(folder / VIDEO, np.repeat(frames, repeats, axis=0), rate_hz=_RATE_HZ))
        except UnreachableError as error:  # PyAV is not installed
            reporter.note(f"{VIDEO} was not written: {error}")
    return written


class ValidationStrip:
    """A training hook that draws an image strip at each validation, with predictions of the base and the current model.

    The clip is always the one with the most motion among the validation clips of the first process. An error while
    drawing does not end the run: it is logged as a warning, and there is no strip.

    Args:
        config: Config of the run, with `validation.decoder`.

    Raises:
        InputError: `validation.decoder` is not a decoder.
    """

    def __init__(self, config: Config) -> None:
        self._decoder: TrainedDecoder = load_decoder(str(config.validation.decoder), where="validation.decoder:")
        self._max_motion = -1.0  # path length of the selected clip
        self._clip: tuple[Batch, int, LatentBatch] | None = None  # the batch of the clip, its row, and its latents
        self._frames: UInt8[np.ndarray, "time size size 3"] | None = None  # the clip's true frames, read once

    def require_compatible(self, world_model: WorldModel, config: Config) -> None:
        """Refuse a decoder for another encoder or crop.

        Raises:
            InputError: The decoder does not fit the model.
        """
        self._decoder.require_compatible(world_model, config.data, subject=config.model.base)

    def update(self, dataset: Dataset, batch: Batch, encoded: LatentBatch) -> None:
        """Select the clip with the most motion among this batch of validation clips and earlier batches."""
        self._dataset = dataset
        for row, states in enumerate(encoded.states.double().cpu().numpy()):
            motion = dataset.spaces.state.compute_path_length(states)
            if motion > self._max_motion:
                clip = encoded.select_clip(row)
                # A copy, so the memory of the other clips can be freed.
                copied = replace(clip, latents=clip.latents.detach().float().cpu().clone())
                self._max_motion, self._clip = motion, (replace(batch, latents=None), row, copied)

    def draw(self, world_model: WorldModel, device: torch.device, run: Path, step: int) -> np.ndarray | None:
        """Write RUN/imagined/step-XXXXXXXX.png, and return the image; None if drawing failed."""
        try:
            image = draw_strip(make_strip(self.rollout(world_model, device, f"{run.name}, step {step:,}")))
            (run / IMAGINED).mkdir(exist_ok=True)
            write_atomically(run / IMAGINED / f"{checkpoint_name(step)}.png", encode_png(image))
        except Exception as error:  # an error in this image must not end the run
            logger.warning("validation.decoder: the image strip of step %d could not be drawn (%s)", step, error)
            return None
        return image

    @torch.no_grad()
    def rollout(self, world_model: WorldModel, device: torch.device, subject: str) -> RolloutComparison:
        """Return the decoded rollout of the model, and of the base model if the adapter can be switched off.

        Raises:
            ValueError: `update` was not called before.
        """
        if self._clip is None:
            raise ValueError("no validation clip: call update first")
        batch, row, clip = self._clip
        if self._frames is None:
            self._frames = to_display_frames(frames_for_display(self._dataset, batch, row), world_model.image_size)
        decoder, latents = self._decoder.to(device).decoder, clip.latents.to(device)
        actions, states = (values[0].double().cpu().numpy() for values in (clip.actions, clip.states))
        start = Start.from_batch(replace(clip, latents=latents), self._dataset.spaces.state)
        world_model.eval()

        def predict(name: str) -> DecodedRollout:
            predicted = compute_rollout(world_model.rollout, start, actions, states[:-1])
            return DecodedRollout(name, AS_RECORDED, actions, decode_views(decoder, predicted))

        rollouts, adaptation = [predict("current model")], world_model.adaptation
        if adaptation is not None and adaptation.kind == "lora" and world_model.new_input_projections is None:
            with use_base_weights(world_model):
                rollouts.insert(0, predict("base"))
        decoded = decode_views(decoder, latents[0])
        return RolloutComparison(
            subject=subject,
            episode_id=batch.episode_ids[row],
            start=batch.starts[row],
            seconds_per_step=self._dataset.config.model_stride / self._dataset.control_rate_hz,
            first=self._frames[0],
            decoded_first=decoded[0],
            rollouts=tuple(rollouts),
            truth=self._frames[1:],
            decoded_truth=decoded[1:],
        )
