"""How far apart are two sets of features as Gaussians: the Frechet distance, and FVD from a file that the user names.

FVD is off by default and labelled biased. With few clips two samples of one distribution are far apart (at 256 clips of
400 features more than 100), and a smoothed set is nearer to the truth than another sample of the truth is. Report the
V-JEPA 2 MMD instead; FVD is for comparison with published numbers, of as many clips.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.evaluation.video.record import FrechetVideoDistance
from vjepa2_ac.evaluation.video.weights_file import WeightsFile

I3D_SHA256 = "bec6519f66ea534e953026b4ae2c65553c17bf105611c746d904657e5860a5e2"  # i3d_torchscript.pt, 51,235,320 bytes
LEAST_FRAMES = 11  # of fewer, I3D's last pooling over time has none
_SIDE = 224  # pixels


def frechet_distance(one: Float[np.ndarray, "clips dim"], other: Float[np.ndarray, "others dim"]) -> float:
    """Return |m1 - m2|^2 + tr(S1 + S2 - 2 (S1 S2)^(1/2)) of the means and covariances (over n - 1) of two sets.

    The trace of the root is the sum of the roots of the eigenvalues of S1^(1/2) S2 S1^(1/2), which is symmetric.

    Raises:
        ValueError: Fewer than two rows in a set, or sets of different width.

    Source: Dowson and Landau (1982), The Frechet distance between multivariate normal distributions.
    """
    if min(len(one), len(other)) < 2 or one.shape[1] != other.shape[1]:
        raise ValueError(f"features of shapes {one.shape} and {other.shape}; needed: two rows or more, of one width")
    first, second = one.astype(np.float64), other.astype(np.float64)
    covariance, other_covariance = (np.atleast_2d(np.cov(rows, rowvar=False)) for rows in (first, second))
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(values.clip(min=0))) @ vectors.T
    of_product = np.linalg.eigvalsh(root @ other_covariance @ root)
    shift = first.mean(axis=0) - second.mean(axis=0)
    trace = np.trace(covariance) + np.trace(other_covariance) - 2 * np.sqrt(of_product.clip(min=0)).sum()
    return float(shift @ shift + trace)


class I3d:
    """The I3D network as TorchScript: 400 numbers of a video. Loading it executes its code, so its hash is checked.

    Args:
        path: The file `i3d_torchscript.pt`.
        device: Where to compute.

    Raises:
        InputError: The file is missing, another one, or this version of PyTorch cannot load it.
    """

    def __init__(self, path: Path, *, device: torch.device | str = "cpu") -> None:
        file = WeightsFile(path, "--i3d", "the I3D network of FVD as TorchScript, i3d_torchscript.pt")
        _, content = file.known({"i3d": I3D_SHA256})
        with warnings.catch_warnings():
            # PyTorch 2.13 deprecates TorchScript, and this network exists in no other form with a known hash.
            warnings.filterwarnings("ignore", message=".*torch.jit.*", category=DeprecationWarning)
            load = cast("Any", torch.jit.load)
            try:
                self._network = load(content, map_location=device).eval()
            except RuntimeError as error:
                reason = (str(error).splitlines() or [type(error).__name__])[0]
                found = f"PyTorch {torch.__version__} cannot load it ({reason})"
                raise file.error(found, fix="Leave --i3d out, or use another version of PyTorch") from None
        self._device = torch.device(device)

    def to(self, device: torch.device) -> I3d:
        """Move the network to a device."""
        self._network.to(device)
        self._device = device
        return self

    @torch.no_grad()
    def features(
        self, videos: Float[Tensor, "batch time 3 height width"], chunk: int = 4
    ) -> Float[np.ndarray, "batch dim"]:
        """Return the features of videos in 0 .. 1, resized bilinearly to 224 pixels and scaled to -1 .. 1.

        Args:
            videos: All frames are used, the given ones included.
            chunk: Videos that go through the network at once.

        Raises:
            ValueError: Fewer than 11 frames.
        """
        if videos.shape[1] < LEAST_FRAMES:
            raise ValueError(f"videos of {videos.shape[1]} frames; I3D needs {LEAST_FRAMES}")
        parts = [self._features(part) for part in torch.split(videos, chunk)]
        return np.concatenate(parts)

    def _features(self, videos: Tensor) -> np.ndarray:
        flat = videos.to(self._device).float().flatten(0, 1)
        resized = torch.nn.functional.interpolate(flat, size=(_SIDE, _SIDE), mode="bilinear", align_corners=False)
        scaled = (2 * resized - 1).reshape(*videos.shape[:3], _SIDE, _SIDE).transpose(1, 2)
        with torch.autocast(self._device.type, enabled=False):
            found = self._network(scaled, rescale=False, resize=False, return_features=True)
        return np.asarray(found.double().cpu().numpy())


def frechet_video_distance(
    imagined: Float[np.ndarray, "clips dim"], true: Float[np.ndarray, "clips dim"]
) -> FrechetVideoDistance:
    """Return FVD of two sets of I3D features; of fewer than two clips, or features that are not finite, the reason.

    Args:
        imagined: Of predicted videos, by `I3d.features`.
        true: Of as many true ones.
    """
    clips = len(imagined)
    if clips < 2:
        return FrechetVideoDistance(None, clips, "it needs two clips or more")
    if not (np.isfinite(imagined).all() and np.isfinite(true).all()):
        return FrechetVideoDistance(None, clips, "some features are not finite")
    return FrechetVideoDistance(frechet_distance(imagined, true), clips)
