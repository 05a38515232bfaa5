"""How alike do two images look to a network trained on photographs: LPIPS, from files that the user names.

No weights are shipped or downloaded. Without the files the metric is absent, never computed with random weights. `alex`
is the metric that people compare, `vgg` the usual loss; do not report the one that was trained on.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.evaluation.video.weights_file import WeightsFile

Backbone = Literal["alex", "vgg"]
LEAST_SIDE = 32  # pixels: of fewer the pooled images have none
Features: TypeAlias = "list[Float[Tensor, 'images channels rows columns']]"  # from fine to coarse
_MEAN, _DEVIATION = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of images in -1 .. 1
_EPSILON = 1e-10


@dataclass(frozen=True)
class LpipsFiles:
    """The two files. Which backbone it is follows from its hash."""

    backbone: Path  # torchvision's weights: alexnet-owt-7be5be79.pth or vgg16-397923af.pth
    heads: Path  # of lpips 0.1.4: weights/v0.1/alex.pth or vgg.pth


class _Layer(NamedTuple):
    """A convolution followed by a ReLU."""

    place: int  # features.{place} in the file
    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    pool: int = 0  # window of the maximum before it, at stride 2; 0: none
    seen: bool = True  # whether its output is compared


_LAYERS: dict[Backbone, tuple[_Layer, ...]] = {
    "alex": (
        _Layer(0, 3, 64, kernel=11, stride=4),
        _Layer(3, 64, 192, kernel=5, pool=3),
        _Layer(6, 192, 384, pool=3),
        _Layer(8, 384, 256),
        _Layer(10, 256, 256),
    ),
    "vgg": (
        _Layer(0, 3, 64, seen=False),
        _Layer(2, 64, 64),
        _Layer(5, 64, 128, pool=2, seen=False),
        _Layer(7, 128, 128),
        _Layer(10, 128, 256, pool=2, seen=False),
        _Layer(12, 256, 256, seen=False),
        _Layer(14, 256, 256),
        _Layer(17, 256, 512, pool=2, seen=False),
        _Layer(19, 512, 512, seen=False),
        _Layer(21, 512, 512),
        _Layer(24, 512, 512, pool=2, seen=False),
        _Layer(26, 512, 512, seen=False),
        _Layer(28, 512, 512),
    ),
}
_PADDING = {11: 2, 5: 2, 3: 1}  # by kernel
BACKBONES: dict[str, str] = {"alex": "7be5be79", "vgg": "397923af"}
"""What the SHA-256 of torchvision's files begins with: the digits in their names."""

HEADS: dict[str, str] = {
    "alex": "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    "vgg": "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
}


class Lpips(nn.Module):
    """The distance of two images: squared differences of normalised features, weighted by channel, mean over places.

    Frozen; gradients pass to the images, in float32 and without autocast. It equals lpips 0.1.4 (version 0.1).

    Source: Zhang et al. (2018), The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, equation 1;
    constants of richzhang/PerceptualSimilarity @ 082bb24, lpips/lpips.py.
    """

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone = backbone
        self.layers = _LAYERS[backbone]
        self.convolutions = nn.ModuleDict({
            str(one.place): nn.Conv2d(one.inputs, one.outputs, one.kernel, one.stride, _PADDING[one.kernel])
            for one in self.layers
        })  # fmt: skip
        widths = [one.outputs for one in self.layers if one.seen]
        self.heads = nn.ParameterList([nn.Parameter(torch.zeros(width)) for width in widths])
        self.requires_grad_(False)
        self.eval()

    def forward(
        self, predicted: Float[Tensor, "*batch 3 height width"], true: Float[Tensor, "*batch 3 height width"]
    ) -> Float[Tensor, "*batch"]:
        """Return the distance of each pair of images in 0 .. 1; 0 is identical.

        Raises:
            ValueError: Images of fewer than 32 pixels a side, or true ones outside 0 .. 1.
        """
        if min(predicted.shape[-2:]) < LEAST_SIDE:
            size = " x ".join(map(str, predicted.shape[-2:]))
            raise ValueError(f"images of {size} px; LPIPS needs {LEAST_SIDE} px a side")
        if float(true.detach().amin()) < 0 or float(true.detach().amax()) > 1:  # a prediction may be outside
            raise ValueError("true images outside 0 .. 1; LPIPS scales them to -1 .. 1 itself")
        flat = (images.reshape(-1, *images.shape[-3:]) for images in (predicted, true))
        return self.distance(*map(self.features, flat)).reshape(predicted.shape[:-3])

    def distance(self, one: Features, other: Features) -> Float[Tensor, " images"]:
        """Return the distance of each pair of images, from their features."""
        with torch.autocast(one[0].device.type, enabled=False):
            levels = [
                torch.einsum("nchw,c->nhw", (mine - its).square(), head).mean(dim=(1, 2))
                for mine, its, head in zip(one, other, self.heads, strict=True)
            ]
            return torch.stack(levels).sum(dim=0)

    def features(self, images: Float[Tensor, "images 3 height width"]) -> Features:
        """Return the compared features of images in 0 .. 1: each place of length 1 over channels.

        To compare images with several others, compute their features once.
        """
        with torch.autocast(images.device.type, enabled=False):
            return self._features(images)

    def _features(self, images: Float[Tensor, "images 3 height width"]) -> Features:
        mean, deviation = (torch.tensor(one, device=images.device)[:, None, None] for one in (_MEAN, _DEVIATION))
        features = (2 * images.float() - 1 - mean) / deviation
        found = []
        for layer in self.layers:
            if layer.pool:
                features = nn.functional.max_pool2d(features, layer.pool, stride=2)
            features = self.convolutions[str(layer.place)](features).relu()
            if layer.seen:
                length = torch.linalg.vector_norm(features, dim=1, keepdim=True)  # has a gradient at 0, a root has none
                found.append(features / (length + _EPSILON))
        return found


def load_lpips(files: LpipsFiles) -> Lpips:
    """Return LPIPS with the weights of two files, of which nothing is unpickled but tensors.

    Raises:
        InputError: A file is missing, another one than was published, the heads of another backbone, or lacks weights.
    """
    names = "torchvision's backbone of LPIPS, alexnet-owt-7be5be79.pth or vgg16-397923af.pth"
    backbone_file = WeightsFile(files.backbone, "--lpips", names)
    name, content = backbone_file.known(BACKBONES)
    backbone: Backbone = "alex" if name == "alex" else "vgg"
    heads_name = f"the heads of LPIPS for this backbone, {backbone}.pth of weights/v0.1"
    heads_file = WeightsFile(files.heads, "--lpips-heads", heads_name)
    weights, heads = (
        _tensors(backbone_file, content),
        _tensors(heads_file, heads_file.known({name: HEADS[backbone]})[1]),
    )
    network = Lpips(backbone)
    with torch.no_grad():
        for index, convolution in network.convolutions.items():
            for kind, value in convolution.named_parameters():
                _copy(value, weights, f"features.{index}.{kind}", backbone_file)
        for number, head in enumerate(network.heads):
            _copy(head.view(1, -1, 1, 1), heads, f"lin{number}.model.1.weight", heads_file)
    return network


def _tensors(file: WeightsFile, content: BytesIO) -> dict[str, Tensor]:
    try:
        found = torch.load(content, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError):
        found = None
    if not isinstance(found, dict):
        raise file.error("no PyTorch weights")
    return found


def _copy(into: Tensor, weights: dict[str, Tensor], name: str, file: WeightsFile) -> None:
    value = weights.get(name)
    if not isinstance(value, Tensor) or value.shape != into.shape:
        found = f"{name} of shape {list(value.shape)}" if isinstance(value, Tensor) else f"no {name}"
        raise file.error(found, needed=f"{name} of shape {list(into.shape)}")
    into.copy_(value)
