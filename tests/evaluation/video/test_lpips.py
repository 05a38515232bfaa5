"""LPIPS equals lpips 0.1.4 (recorded values), passes gradients to the images, and takes known files only."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.video.lpips import Backbone, Lpips, LpipsFiles, load_lpips

# lpips 0.1.4 on torch 2.13.0, version 0.1, normalize=True, with plain stacks of the same convolutions in torchvision's
# place, on `images` and the weights of `write`: paler, shifted, unrelated.
RECORDED: dict[Backbone, list[float]] = {
    "alex": [0.002501914743334055, 0.008731486275792122, 0.14271697402000427],
    "vgg": [0.0026000658981502056, 0.007551541551947594, 0.09465347975492477],
}


def drawn(name: str, shape: tuple[int, ...]) -> Tensor:
    """Return weights that depend on a name only: NumPy's old generator promises never to change."""
    normal = np.random.RandomState(sum(map(ord, name))).standard_normal(shape)
    return torch.from_numpy((normal * np.sqrt(2 / max(1, int(np.prod(shape[1:]))))).astype(np.float32))


def write(folder: Path, backbone: Backbone) -> LpipsFiles:
    """Write a backbone, with a classifier that is of no use, and heads; return them with their hashes."""
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
    torch.save(weights | {"classifier.1.weight": torch.zeros(3)}, folder / "backbone.pth")
    torch.save(heads, folder / "heads.pth")
    hashes = [hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in ("backbone.pth", "heads.pth")]
    return LpipsFiles(folder / "backbone.pth", folder / "heads.pth", *hashes)


def images(size: int = 64) -> tuple[Tensor, Tensor]:
    """Return three images and the true one thrice, by formula."""
    rows, columns = (torch.arange(size, dtype=torch.float64).reshape(shape) for shape in ((-1, 1), (1, -1)))
    true = torch.stack([0.5 + 0.4 * torch.sin(rows * (0.11 + 0.03 * c) + columns * 0.07 + c) for c in range(3)])
    unrelated = 0.5 + 0.45 * torch.cos(rows * 0.9 + columns * 1.3 + torch.arange(3)[:, None, None])
    others = torch.stack([true * 0.8 + 0.1, torch.roll(true, 3, -1), unrelated])
    return others.clamp(0, 1).float(), true.expand(3, 3, size, size).clamp(0, 1).float()


@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_distances_equal_those_of_lpips(tmp_path: Path, backbone: Backbone) -> None:
    network = load_lpips(backbone, write(tmp_path, backbone))
    predicted, true = images()
    assert network(predicted, true).tolist() == pytest.approx(RECORDED[backbone], abs=1e-6, rel=1e-4)
    assert network(true, true).tolist() == [0.0] * 3
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert float(network(predicted[1], true[1])) == pytest.approx(RECORDED[backbone][1], rel=1e-4)


def test_gradients_reach_the_image_alone_and_are_finite_where_all_features_are_zero(tmp_path: Path) -> None:
    network = load_lpips("alex", write(tmp_path, "alex"))
    assert not any(value.requires_grad for value in network.parameters())
    predicted, true = images()
    predicted.requires_grad_()
    distance = network(predicted, true).sum()
    (gradient,) = torch.autograd.grad(distance, predicted)
    assert network(predicted - 0.01 * gradient / gradient.norm(), true).sum() < distance
    network.convolutions["0"].bias.fill_(-1e6)  # a ReLU lets nothing through
    (gradient,) = torch.autograd.grad(network(predicted, true).sum(), predicted)
    assert torch.isfinite(gradient).all()


def test_other_files_are_refused(tmp_path: Path) -> None:
    files = write(tmp_path, "alex")
    with pytest.raises(InputError, match="7be5be79"):
        load_lpips("alex", LpipsFiles(files.backbone, files.heads))
    with pytest.raises(InputError, match="df73285e"):
        load_lpips("alex", LpipsFiles(files.backbone, files.heads, files.backbone_sha256))
    with pytest.raises(InputError, match="cannot be read"):
        load_lpips("alex", LpipsFiles(tmp_path / "none.pth", files.heads))
    with pytest.raises(InputError, match=r"features\.0\.weight of shape \[64, 3, 3, 3\]"):
        load_lpips("vgg", files)
    files.heads.write_bytes(b"not weights")
    found = hashlib.sha256(b"not weights").hexdigest()
    with pytest.raises(InputError, match="no PyTorch weights"):
        load_lpips("alex", LpipsFiles(files.backbone, files.heads, files.backbone_sha256, found))


def test_images_that_are_too_small_or_of_another_range_are_refused() -> None:
    network = Lpips("alex")
    with pytest.raises(ValueError, match="needs 32 px"):
        network(torch.zeros(3, 31, 64), torch.zeros(3, 31, 64))
    for wrong in (torch.full((3, 64, 64), 255.0), torch.full((3, 64, 64), -1.0)):
        with pytest.raises(ValueError, match=r"outside 0 \.\. 1"):
            network(torch.zeros(3, 64, 64), wrong)
