"""A perfect predictor's images are the decoded truth bit for bit; LPIPS equals lpips 0.1.4 (recorded values)."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from decoded_worlds import clips, contenders, decoder
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.decoded import (
    DECODED_PERSISTENCE,
    DECODED_TRUTH,
    NEIGHBOURS,
    Backbone,
    Lpips,
    load_lpips,
    measure_decoded,
)
from vjepa2_ac.evaluation.result import DecodedRollouts, Example
from worlds import TIME, Copier, Halfway, Oracle, clips_batch

TRAINED = decoder()
BATCH = clips_batch(24)
# lpips 0.1.4 on torch 2.13.0, version 0.1, normalize=True, with plain stacks of the same convolutions in torchvision's
# place, on `images` and the weights of `write_lpips`: paler, shifted, unrelated.
RECORDED: dict[Backbone, list[float]] = {
    "alex": [0.002501914743334055, 0.008731486275792122, 0.14271697402000427],
    "vgg": [0.0026000658981502056, 0.007551541551947594, 0.09465347975492477],
}


def measured(*models: object, size: int = 4, **how: object) -> DecodedRollouts:
    return measure_decoded(contenders(*models), clips(BATCH, TRAINED, size), TRAINED, **how)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def oracle() -> DecodedRollouts:
    return measured(Oracle(), Copier())


def of(found: DecodedRollouts, source: str) -> dict[str, list[float]]:
    curves = {metric: curve for (one, metric), curve in found.curves.items() if one == source}
    return {metric: [one.value for one in curve] for metric, curve in curves.items()}


def test_a_perfect_predictor_equals_the_decoded_truth_bit_for_bit_and_a_copier_decoded_persistence(
    oracle: DecodedRollouts,
) -> None:
    assert oracle.sources == (*NEIGHBOURS, "base", "adapter")
    for source, neighbour in (("adapter", DECODED_TRUTH), ("base", DECODED_PERSISTENCE)):
        mine, other = of(oracle, source), of(oracle, neighbour)
        assert mine.keys() == other.keys() >= {"psnr_db.moving.truth", "ssim.whole.decoded_truth"}
        for metric, one in mine.items():
            np.testing.assert_array_equal(one, other[metric])
    assert all(np.isnan(of(oracle, "adapter")["psnr_db.whole.decoded_truth"])), "identical images: infinite"
    assert of(oracle, "adapter")["ssim.whole.decoded_truth"] == pytest.approx([1.0] * (TIME - 1), abs=1e-6)


def test_what_goes_half_of_the_way_is_between_its_neighbours() -> None:
    found = measured(Halfway())
    for metric in ("psnr_db.whole.truth", "ssim.moving.truth"):
        low, mine, high = (of(found, one)[metric] for one in (DECODED_PERSISTENCE, "adapter", DECODED_TRUTH))
        assert all(a < b < c for a, b, c in zip(low, mine, high, strict=True))


def test_a_clip_in_which_nothing_moves_does_not_count_in_the_moving_region() -> None:
    still = replace(BATCH, latents=BATCH.latents.clone(), actions=BATCH.actions.clone())
    still.latents[:3] = still.latents[:3, :1]
    found = measure_decoded(contenders(Copier()), clips(still, TRAINED), TRAINED)
    rest = replace(BATCH, **{
        name: getattr(BATCH, name)[3:] for name in ("latents", "actions", "states", "episode_ids", "starts")
    })  # fmt: skip
    without = measure_decoded(contenders(Copier()), clips(rest, TRAINED), TRAINED)
    key = ("adapter", "psnr_db.moving.truth")
    assert found.curves[key][0].value == pytest.approx(without.curves[key][0].value, rel=1e-5)
    assert any("3 clips are left out" in note for note in found.notes)


def test_from_a_cache_nothing_is_compared_with_true_frames() -> None:
    found = measure_decoded(contenders(Oracle()), replace(clips(BATCH, TRAINED), has_frames=False), TRAINED)
    assert not [metric for _, metric in found.curves if metric.endswith(".truth") or ".moving." in metric]
    assert "come from a cache" in found.notes[0]
    assert found.sources == (DECODED_TRUTH, DECODED_PERSISTENCE, "adapter")


def test_the_images_of_examples_begin_with_the_given_frame() -> None:
    colours = np.zeros((TIME, 2, 2, 3), np.uint8)
    example = Example("best", BATCH.episode_ids[3], BATCH.starts[3], None, {}, colours, {})
    found = measure_decoded(contenders(Oracle()), clips(BATCH, TRAINED), TRAINED, [example])
    (strip,) = found.strips
    assert list(strip.rows) == ["truth", "decoded_truth", "adapter"]
    np.testing.assert_array_equal(strip.rows["adapter"], strip.rows["decoded_truth"])
    assert len(strip.rows["truth"]) == TIME


def drawn(name: str, shape: tuple[int, ...]) -> Tensor:
    """Return weights that depend on a name only: NumPy's old generator promises never to change."""
    normal = np.random.RandomState(sum(map(ord, name))).standard_normal(shape)
    return torch.from_numpy((normal * np.sqrt(2 / max(1, int(np.prod(shape[1:]))))).astype(np.float32))


def write_lpips(folder: Path, backbone: Backbone) -> tuple[Path, Path]:
    """Write a backbone, with a classifier that is of no use, and heads, in the published formats."""
    network = Lpips(backbone)
    weights = {
        f"features.{name}": drawn(name, tuple(value.shape)) for name, value in network.features.named_parameters()
    }
    heads = {
        f"lin{number}.model.1.weight": drawn(f"lin{number}", (1, len(head), 1, 1)).abs()
        for number, head in enumerate(network.heads)
    }
    files = folder / f"{backbone}-backbone.pth", folder / f"{backbone}-heads.pth"
    torch.save(weights | {"classifier.1.weight": torch.zeros(3)}, files[0])
    torch.save(heads, files[1])
    return files


def images(size: int = 64) -> tuple[Tensor, Tensor]:
    """Return three images and the true one thrice, by formula."""
    rows, columns = (torch.arange(size, dtype=torch.float64).reshape(shape) for shape in ((-1, 1), (1, -1)))
    true = torch.stack([0.5 + 0.4 * torch.sin(rows * (0.11 + 0.03 * c) + columns * 0.07 + c) for c in range(3)])
    unrelated = 0.5 + 0.45 * torch.cos(rows * 0.9 + columns * 1.3 + torch.arange(3)[:, None, None])
    others = torch.stack([true * 0.8 + 0.1, torch.roll(true, 3, -1), unrelated])
    return others.clamp(0, 1).float(), true.expand(3, 3, size, size).clamp(0, 1).float()


@pytest.mark.parametrize("backbone", ["alex", "vgg"])
def test_distances_equal_those_of_lpips(tmp_path: Path, backbone: Backbone) -> None:
    network = load_lpips(*write_lpips(tmp_path, backbone))
    assert network.backbone == backbone
    predicted, true = (one[None] for one in images())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = network.of_pairs({"shown": predicted, "same": true}, {"truth": true})
    assert found["shown", "lpips.whole.truth"][0].tolist() == pytest.approx(RECORDED[backbone], abs=1e-6, rel=1e-4)
    assert found["same", "lpips.whole.truth"][0].tolist() == [0.0] * 3


def test_other_files_are_refused(tmp_path: Path) -> None:
    (alex, heads), (_, of_vgg) = write_lpips(tmp_path, "alex"), write_lpips(tmp_path, "vgg")
    for files in ((heads, alex), (alex, of_vgg)):
        with pytest.raises(InputError, match="the heads of LPIPS for the same one"):
            load_lpips(*files)
    (tmp_path / "damaged.pth").write_bytes(b"not weights")
    for path in (tmp_path / "none.pth", tmp_path / "damaged.pth"):
        with pytest.raises(InputError, match=r"--lpips .*cannot be read"):
            load_lpips(path, heads)
