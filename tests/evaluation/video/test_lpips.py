"""LPIPS equals lpips 0.1.4 (recorded values), passes gradients to the images, and takes known files only."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from metric_files import know_lpips, sha256_of, write_lpips
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.video.lpips import BACKBONES, Backbone, Lpips, LpipsFiles, load_lpips

# lpips 0.1.4 on torch 2.13.0, version 0.1, normalize=True, with plain stacks of the same convolutions in torchvision's
# place, on `images` and the weights of `write_lpips`: paler, shifted, unrelated.
RECORDED: dict[Backbone, list[float]] = {
    "alex": [0.002501914743334055, 0.008731486275792122, 0.14271697402000427],
    "vgg": [0.0026000658981502056, 0.007551541551947594, 0.09465347975492477],
}


def loaded(folder: Path, backbone: Backbone, monkeypatch: pytest.MonkeyPatch) -> Lpips:
    files = write_lpips(folder, backbone)
    know_lpips(monkeypatch, backbone, files)
    return load_lpips(files)


def images(size: int = 64) -> tuple[Tensor, Tensor]:
    """Return three images and the true one thrice, by formula."""
    rows, columns = (torch.arange(size, dtype=torch.float64).reshape(shape) for shape in ((-1, 1), (1, -1)))
    true = torch.stack([0.5 + 0.4 * torch.sin(rows * (0.11 + 0.03 * c) + columns * 0.07 + c) for c in range(3)])
    unrelated = 0.5 + 0.45 * torch.cos(rows * 0.9 + columns * 1.3 + torch.arange(3)[:, None, None])
    others = torch.stack([true * 0.8 + 0.1, torch.roll(true, 3, -1), unrelated])
    return others.clamp(0, 1).float(), true.expand(3, 3, size, size).clamp(0, 1).float()


@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_distances_equal_those_of_lpips(tmp_path: Path, backbone: Backbone, monkeypatch: pytest.MonkeyPatch) -> None:
    network = loaded(tmp_path, backbone, monkeypatch)
    assert network.backbone == backbone
    predicted, true = images()
    assert network(predicted, true).tolist() == pytest.approx(RECORDED[backbone], abs=1e-6, rel=1e-4)
    assert network(true, true).tolist() == [0.0] * 3
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert float(network(predicted[1], true[1])) == pytest.approx(RECORDED[backbone][1], rel=1e-4)


def test_gradients_reach_the_image_alone_and_are_finite_where_all_features_are_zero(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = loaded(tmp_path, "alex", monkeypatch)
    assert not any(value.requires_grad for value in network.parameters())
    predicted, true = images()
    predicted.requires_grad_()
    distance = network(predicted, true).sum()
    (gradient,) = torch.autograd.grad(distance, predicted)
    assert network(predicted - 0.01 * gradient / gradient.norm(), true).sum() < distance
    network.convolutions["0"].bias.fill_(-1e6)  # a ReLU lets nothing through
    (gradient,) = torch.autograd.grad(network(predicted, true).sum(), predicted)
    assert torch.isfinite(gradient).all()


def test_other_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = write_lpips(tmp_path, "alex")
    with pytest.raises(InputError, match=r"--lpips .*a file of SHA-256 .*begins with 7be5be79 or 397923af"):
        load_lpips(files)
    monkeypatch.setitem(BACKBONES, "alex", sha256_of(files.backbone)[:8])
    with pytest.raises(InputError, match=r"--lpips-heads .*begins with df73285e"):
        load_lpips(files)
    know_lpips(monkeypatch, "alex", files)
    with pytest.raises(InputError, match=r"--lpips .*a file of SHA-256"):
        load_lpips(LpipsFiles(files.heads, files.backbone))
    with pytest.raises(InputError, match=r"--lpips .*cannot be read"):
        load_lpips(LpipsFiles(tmp_path / "none.pth", files.heads))
    with pytest.raises(InputError, match=r"--lpips-heads .*cannot be read"):
        load_lpips(LpipsFiles(files.backbone, tmp_path))


def test_the_heads_of_another_backbone_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alex, vgg = write_lpips(tmp_path, "alex"), write_lpips(tmp_path, "vgg")
    know_lpips(monkeypatch, "alex", alex)
    know_lpips(monkeypatch, "vgg", vgg)
    with pytest.raises(InputError, match=r"--lpips-heads .*alex\.pth of weights"):
        load_lpips(LpipsFiles(alex.backbone, vgg.heads))


def test_known_files_without_the_weights_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = write_lpips(tmp_path, "alex")
    know_lpips(monkeypatch, "vgg", files)
    with pytest.raises(InputError, match=r"features\.0\.weight of shape \[64, 3, 3, 3\]"):
        load_lpips(files)
    files.heads.write_bytes(b"not weights")
    know_lpips(monkeypatch, "alex", files)
    monkeypatch.setitem(BACKBONES, "vgg", "none")
    with pytest.raises(InputError, match="no PyTorch weights"):
        load_lpips(files)


def test_images_that_are_too_small_or_of_another_range_are_refused() -> None:
    network = Lpips("alex")
    with pytest.raises(ValueError, match="needs 32 px"):
        network(torch.zeros(3, 31, 64), torch.zeros(3, 31, 64))
    for wrong in (torch.full((3, 64, 64), 255.0), torch.full((3, 64, 64), -1.0)):
        with pytest.raises(ValueError, match=r"outside 0 \.\. 1"):
            network(torch.zeros(3, 64, 64), wrong)
