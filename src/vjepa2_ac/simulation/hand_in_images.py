"""Where the hand is in the images of a simulated data set, as the encoder sees them: from states alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.transforms import Crop, crop_box
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.decoded.hand import HandPositions
from vjepa2_ac.simulation.counterfactual import RECORDED_CAMERAS, camera_of
from vjepa2_ac.simulation.recording.simulation_file import SIMULATION_FILE, read_simulation
from vjepa2_ac.simulation.world.camera import FRAME_SIZE, HAND_MIDDLE_M, hand_pixels

_FIXED = "exterior"


def hand_positions(dataset: Dataset, size: int, *, along_m: float = HAND_MIDDLE_M) -> HandPositions | str:
    """Return where the hand is in images of the encoder's size; or why nobody knows.

    Args:
        dataset: Its clips are of the config's first camera.
        size: Height and width of an image, in pixels.
        along_m: Distance of the point from the flange, towards the fingers; the middle of the hand by default.
    """
    config = dataset.config
    if not (Path(config.path) / SIMULATION_FILE).is_file():
        return f"the data were not simulated: no {SIMULATION_FILE} beside them"
    if not dataset.spaces.state.is_base_pose:
        return "the states are not poses in the robot base frame"
    if (camera := config.cameras[0]) not in RECORDED_CAMERAS:
        return f"the simulator has no camera {camera}"
    try:
        simulation = read_simulation(config.path)
    except InputError as error:
        return str(error)
    seen_by = camera_of(simulation, camera)
    if not seen_by.startswith(_FIXED):
        return f"{camera} moves with the hand"

    def positions(episode_id: str, states: Float[np.ndarray, "time 7"]) -> Float[np.ndarray, "time 2"]:
        world = simulation.world_of(episode_id)
        found = hand_pixels(np.asarray(states, np.float64), world, seen_by, along_m=along_m)
        return as_seen(found, config.crop, size)

    return positions


def as_seen(positions: Float[np.ndarray, "time 2"], crop: Crop, size: int) -> Float[np.ndarray, "time 2"]:
    """Return positions in a recorded frame as positions in what the encoder sees of it: cropped, then squashed."""
    height, width = FRAME_SIZE
    if crop == "letterbox":
        side = max(height, width)
        left, top = -((side - width) // 2), -((side - height) // 2)
        seen = side, side
    else:
        box = crop_box(height, width, crop)
        left, top, seen = box.left, box.top, (box.width, box.height)
    return np.asarray((positions - (left, top)) * size / np.array(seen, dtype=np.float64))
