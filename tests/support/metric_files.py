"""Files of metrics in the published formats, with weights that nothing was learned by, and their hashes as known."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from vjepa2_ac.evaluation.video import frechet, lpips
from vjepa2_ac.evaluation.video.lpips import Backbone, Lpips, LpipsFiles


def drawn(name: str, shape: tuple[int, ...]) -> Tensor:
    """Return weights that depend on a name only: NumPy's old generator promises never to change."""
    normal = np.random.RandomState(sum(map(ord, name))).standard_normal(shape)
    return torch.from_numpy((normal * np.sqrt(2 / max(1, int(np.prod(shape[1:]))))).astype(np.float32))


def sha256_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_lpips(folder: Path, backbone: Backbone) -> LpipsFiles:
    """Write a backbone, with a classifier that is of no use, and heads."""
    network = Lpips(backbone)
    weights = {
        f"features.{index}.{kind}": drawn(f"{index}.{kind}", tuple(value.shape))
        for index, convolution in network.convolutions.items()
        for kind, value in convolution.named_parameters()
    }
    heads = {
        f"lin{number}.model.1.weight": drawn(f"lin{number}", (1, len(head), 1, 1)).abs()
        for number, head in enumerate(network.heads)
    }
    torch.save(weights | {"classifier.1.weight": torch.zeros(3)}, folder / f"{backbone}-backbone.pth")
    torch.save(heads, folder / f"{backbone}-heads.pth")
    return LpipsFiles(folder / f"{backbone}-backbone.pth", folder / f"{backbone}-heads.pth")


class TinyI3d(nn.Module):
    """Stands in for I3D: takes its arguments, and says what it was given."""

    def forward(self, videos: Tensor, rescale: bool, resize: bool, return_features: bool) -> Tensor:
        """Return the mean of each channel at the first and the last time, which no flag may change."""
        if rescale or resize or not return_features or videos.shape[-1] != 224 or videos.shape[1] != 3:
            return videos
        return torch.cat([videos[:, :, 0].mean(dim=[2, 3]), videos[:, :, -1].mean(dim=[2, 3])], dim=1)


def write_i3d(folder: Path) -> Path:
    """Write a network in the format and with the arguments of i3d_torchscript.pt."""
    path = folder / "i3d_torchscript.pt"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of TorchScript itself
        torch.jit.save(torch.jit.script(TinyI3d()), str(path))
    return path


def know_lpips(monkeypatch: pytest.MonkeyPatch, backbone: Backbone, files: LpipsFiles) -> None:
    """Let the hashes of these files be those of the published ones."""
    monkeypatch.setitem(lpips.BACKBONES, backbone, sha256_of(files.backbone)[:8])
    monkeypatch.setitem(lpips.HEADS, backbone, sha256_of(files.heads))


def know_i3d(monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
    """Let the hash of this file be that of the published one."""
    monkeypatch.setattr(frechet, "I3D_SHA256", sha256_of(path))
