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
from vjepa2_ac.planning.energy import compute_patch_weights
from vjepa2_ac.spaces import StateSpace

Image = UInt8[np.ndarray, "rows columns 3"]
Fault = Literal["uniform frame", "frozen frame"]


@dataclass
class Cameras:
    """One camera, or several whose images are side by side, as a world model receives them."""

    model: WorldModel
    crop: Crop
    views: int = 1
    latest_frames: tuple[CameraFrame, ...] = field(default=(), init=False)  # one per camera; empty after a reset

    def require_contrast(self, image: Image, *, where: str) -> None:
        """Refuse an image in which the view of a camera has no contrast (`images.is_uniform`).

        Raises:
            InputError: The view of a camera is uniform.
        """
        require_contrast(self._crop_views(image), where=where)

    def check_frame(
        self,
        frame: Image,
        state: Float[np.ndarray, " numbers"],
        space: StateSpace,
        max_change: Float[np.ndarray, " numbers"],
    ) -> tuple[tuple[CameraFrame, ...], Fault | None]:
        """Return the latest frame of each camera, and a fault that forbids motion (None: no camera has a fault).

        This method does not change `latest_frames`; the controller sets it after a decision.

        Args:
            frame: The current frame, with the views of all cameras side by side.
            state: The measured state.
            space: The meaning of the state's numbers.
            max_change: The largest change of each number in a model step.
        """
        latest_frames = newest_frames(split_views(frame[None], self.views), state, self.latest_frames)
        if any(map(is_uniform, self._crop_views(frame))):
            return latest_frames, "uniform frame"
        is_frozen = any(has_moved(frame_state, state, space, max_change) for _, frame_state in latest_frames)
        return latest_frames, "frozen frame" if is_frozen else None

    def compute_patch_weights(self, mask: np.ndarray | None, like: Image) -> Float[Tensor, " tokens"] | None:
        """Return the weight of each patch for a mask over an image; None: no mask.

        Raises:
            InputError: The mask is invalid, or is empty in the part of the image that the model receives.
        """
        if mask is None:
            return None
        require_mask(mask, where="mask", like=like)
        pixels = np.repeat((mask > 0).astype(np.uint8)[None, ..., None], 3, axis=-1)
        cropped = np.ascontiguousarray(crop_frames(split_views(pixels, self.views), self.crop)[..., 0])
        grid = self.model.image_size // self.model.sizes.patch_size
        try:
            return compute_patch_weights(torch.from_numpy(cropped) > 0, grid).to(self.model.device)
        except ValueError:
            needed = "a mask that overlaps the part of the image that the model receives (data.crop)"
            raise InputError(where="mask", found="no pixel inside the cropped image", needed=needed) from None

    def _crop_views(self, image: Image) -> UInt8[np.ndarray, "views height width 3"]:
        """Return the part of each camera's image that the model receives, without the bars of a letterbox."""
        views = split_views(image[None], self.views)
        return views if self.crop == "letterbox" else crop_frames(views, self.crop)


def require_views(config: DataConfig, views: int, *, to: str = "make goals") -> None:
    """Refuse data without frames, or with fewer cameras than the model receives side by side.

    Raises:
        InputError: The data have no frames or too few cameras.
    """
    require_frames(config, to=to)
    if len(config.cameras) < views:
        raise InputError(
            where="data.camera",
            found=", ".join(config.cameras),
            needed=f"{views} cameras, from left to right, because planning.views is {views}",
        )


def read_views(
    dataset: Dataset, index: int, views: int, frames: Sequence[int]
) -> UInt8[np.ndarray, "frames height width 3"]:
    """Return frames of an episode, with the images of its first `views` cameras side by side.

    Raises:
        InputError: The episode cannot be read.
    """
    cameras = dataset.config.cameras[:views]
    return np.concatenate([dataset.source.read(index, camera).read_frames(frames) for camera in cameras], axis=2)
