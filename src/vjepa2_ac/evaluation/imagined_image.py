"""What a run or a model imagines from an image and a state, that of a robot for example: nobody knows what happens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from vjepa2_ac.config import LimitsConfig
from vjepa2_ac.data.sources.configured_spaces import measured_space
from vjepa2_ac.data.transforms import frames_as_seen, view
from vjepa2_ac.decoding.decoder_folder import load_decoder
from vjepa2_ac.decoding.imagine import Imagination, Imagined, Start, imagined_latents, shown, worth_knowing
from vjepa2_ac.encoding.batch import encode_frames
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.counterfactual import ACTION_NAMES, STEP_M, named_actions, read_actions
from vjepa2_ac.planning.session import PlanningSession
from vjepa2_ac.spaces import StateSpace

_RATE_HZ = 15.0  # of a robot, where nobody says: DROID's


@dataclass(frozen=True, eq=False)
class Seen:
    """What a camera sees, and the robot's state then."""

    image: UInt8[np.ndarray, "height width 3"]
    state: Float[np.ndarray, " state_dim"]
    extrinsics: Float[np.ndarray, " 6"] | None = None  # where the model uses it


def imagine_image(
    session: PlanningSession,
    decoder_name: str,
    seen: Seen,
    actions: Sequence[str],
    *,
    steps: int,
    size_m: float = STEP_M,
) -> Imagination:
    """Imagine what follows from an image under actions by name, or from files.

    Args:
        session: The model, and the config whose crop and limits count.
        decoder_name: As `load_decoder` takes.
        seen: The start.
        actions: Names of directions, or files; see `planning.counterfactual`.
        steps: Model steps.
        size_m: Length of a named action in each step, if the limits allow it.

    Raises:
        InputError: Decoder, state or actions cannot be used.
    """
    model, config = session.world_model, session.config
    decoder = load_decoder(decoder_name)
    decoder.require_fit(model, config.data.crop, subject=session.subject)
    decoder.to(model.device)
    space = measured_space(config.data, len(seen.state))
    require_directions(space, where="--state")
    chosen = {name: actions_by_name(name, steps, size_m, config.planning.limits) for name in actions}
    camera = None if seen.extrinsics is None else torch.as_tensor(seen.extrinsics, dtype=torch.float32)
    start = Start(
        latents=encode_frames(model, seen.image[None], config.data.crop)[0],
        state=np.asarray(seen.state, dtype=np.float64),
        space=space,
        extrinsics=None if camera is None else camera.to(model.device),
    )
    first = frames_as_seen(view(seen.image[None], config.data.crop), model.image_size)[0]
    decoded_first = shown(decoder.decoder, start.latents[None])[0]
    return Imagination(
        subject=session.subject,
        episode_id="",
        start=0,
        seconds_per_step=(config.data.model_stride if config.data.stride != "auto" else 1) / _RATE_HZ,
        first=first,
        decoded_first=decoded_first,
        rollouts=tuple(
            Imagined("model", word, taken, shown(decoder.decoder, imagined_latents(model, start, taken)))
            for word, taken in chosen.items()
        ),
        notes=(
            f"Times in the film suppose {_RATE_HZ:g} control steps in a second.",
            *worth_knowing(decoder.card, first, decoded_first),
        ),
    )


def require_directions(space: StateSpace, *, where: str, fix: str = "") -> None:
    """Refuse states in which actions by name, which are directions in the robot base frame, mean nothing.

    Raises:
        InputError: They are no poses, or poses in the camera's frame.
    """
    if not space.is_base_pose:
        raise InputError(
            where=where,
            found="states that are no poses in the robot base frame",
            needed="poses: actions by name are directions in that frame",
            fix=fix,
        )


def actions_by_name(word: str, steps: int, size_m: float, limits: LimitsConfig) -> Float[np.ndarray, "steps 7"]:
    """Return actions by their name or from a file.

    Raises:
        InputError: No such name, or a file of other actions than one for each step.
    """
    if word in ACTION_NAMES:
        return named_actions(word, steps, size_m=size_m, limits=limits)
    if word.lower().endswith((".npy", ".csv")):
        return read_actions(word, steps=steps)
    needed = f"true (of a recorded clip), {', '.join(ACTION_NAMES)}, or a file"
    raise InputError(where=f"--actions {word}", found="no such actions", needed=needed)
