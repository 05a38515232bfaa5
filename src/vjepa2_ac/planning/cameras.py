"""Cameras: the part of an image that the model receives, patch weights of a mask, and detection of faulty frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.transforms import Crop, crop_frames, split_views
from vjepa2_ac.data.windows import require_frames
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import (
    CameraFrame,
    has_moved,
    is_uniform,
    newest_frames,
    require_contrast,
    require_mask,
)
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.energy import patch_weights
from vjepa2_ac.spaces import StateSpace

Image = UInt8[np.ndarray, "rows columns 3"]
Fault = Literal["uniform frame", "frozen frame"]


@dataclass
class Cameras:
    """One camera, or several whose images are side by side, as a world model receives them."""

    model: WorldModel
    crop: Crop
    views: int = 1
    newest: tuple[CameraFrame, ...] = field(default=(), init=False)  # of each camera; empty after a reset

    def require_contrast(self, image: Image, *, where: str) -> None:
        """Refuse an image in which the view of a camera has no contrast; see `images.is_uniform`.

        Raises:
            InputError: The view of a camera is uniform.
        """
        require_contrast(self._received(image), where=where)

    def checked(
        self,
        frame: Image,
        state: Float[np.ndarray, " numbers"],
        space: StateSpace,
        largest: Float[np.ndarray, " numbers"],
    ) -> tuple[tuple[CameraFrame, ...], Fault | None]:
        """Return the newest frame of each camera, and the fault for which the robot must not move; None: no fault.

        A fault of one camera is enough. This method does not set `newest`; the controller sets it after the decision.

        Args:
            frame: The current frame, with the views of all cameras side by side.
            state: The measured state.
            space: The meaning of the state's numbers.
            largest: The largest change of each number in a model step.
        """
        newest = newest_frames(split_views(frame[None], self.views), state, self.newest)
        if any(map(is_uniform, self._received(frame))):
            return newest, "uniform frame"
        is_frozen = any(has_moved(before, state, space, largest) for _, before in newest)
        return newest, "frozen frame" if is_frozen else None

    def weights(self, mask: np.ndarray | None, like: Image) -> Float[Tensor, " tokens"] | None:
        """Return the weight of each patch for a mask over an image; None: no mask.

        Raises:
            InputError: The mask is invalid, or is empty in the part of the image that the model receives.
        """
        if mask is None:
            return None
        require_mask(mask, where="mask", like=like)
        pixels = np.repeat((mask > 0).astype(np.uint8)[None, ..., None], 3, axis=-1)
        received = np.ascontiguousarray(crop_frames(split_views(pixels, self.views), self.crop)[..., 0])
        grid = self.model.image_size // self.model.sizes.patch_size
        try:
            return patch_weights(torch.from_numpy(received) > 0, grid).to(self.model.device)
        except ValueError:
            raise InputError(where="mask", found="nothing of what the model sees counts") from None

    def _received(self, image: Image) -> UInt8[np.ndarray, "views height width 3"]:
        """Return the part of each camera's image that the model receives, without the bars of a letterbox."""
        views = split_views(image[None], self.views)
        return views if self.crop == "letterbox" else crop_frames(views, self.crop)


def require_views(config: DataConfig, views: int, *, to: str = "make goals of") -> None:
    """Refuse data without frames, or with fewer cameras than the model receives side by side.

    Raises:
        InputError: The data have no frames or too few cameras.
    """
    require_frames(config, to=to)
    if len(config.cameras) < views:
        found, needed = ", ".join(config.cameras), f"{views} cameras, from left to right, as planning.views says"
        raise InputError(where="data.camera", found=found, needed=needed)


def read_views(
    dataset: Dataset, index: int, views: int, frames: Sequence[int]
) -> UInt8[np.ndarray, "frames height width 3"]:
    """Return frames of an episode, with the images of its first `views` cameras side by side.

    Raises:
        InputError: The episode cannot be read.
    """
    cameras = dataset.config.cameras[:views]
    return np.concatenate([dataset.source.read(index, camera).read_frames(frames) for camera in cameras], axis=2)
