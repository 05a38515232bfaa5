"""The Frechet distance has its closed form and its bias; FVD takes one known file, or says why there is none."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import linalg

from metric_files import know_i3d, write_i3d
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.video.frechet import I3d, frechet_distance, frechet_video_distance


@pytest.fixture
def network(tmp_path: Path) -> Path:
    return write_i3d(tmp_path)


def with_moments(mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return rows of exactly this mean and covariance (over n - 1)."""
    rows = np.random.default_rng(0).standard_normal((50, len(mean)))
    rows -= rows.mean(axis=0)
    white = rows @ np.linalg.inv(np.linalg.cholesky(np.cov(rows, rowvar=False))).T
    return mean + white @ np.linalg.cholesky(covariance).T


def test_distance_of_gaussians_that_commute_is_that_of_means_and_deviations() -> None:
    one = with_moments(np.array([1.0, 2.0, 3.0]), np.diag([1.0, 4.0, 9.0]))
    other = with_moments(np.array([1.0, 0.0, 3.5]), np.diag([4.0, 4.0, 1.0]))
    assert frechet_distance(one, other) == pytest.approx(4 + 0.25 + (1 - 2) ** 2 + (3 - 1) ** 2)
    assert frechet_distance(one, one) == pytest.approx(0, abs=1e-9)


def test_distance_equals_the_form_with_the_root_of_the_product() -> None:
    rng = np.random.default_rng(1)
    one, other = rng.standard_normal((40, 6)) @ rng.standard_normal((6, 6)), 1 + rng.standard_normal((30, 6))
    covariances = np.cov(one, rowvar=False), np.cov(other, rowvar=False)
    root = linalg.sqrtm(covariances[0] @ covariances[1]).real
    shift = one.mean(axis=0) - other.mean(axis=0)
    expected = shift @ shift + np.trace(covariances[0] + covariances[1] - 2 * root)
    assert frechet_distance(one, other) == pytest.approx(expected)
    assert frechet_distance(other, one) == pytest.approx(expected)


def test_with_few_clips_a_smoothed_set_is_nearer_than_the_truth_itself() -> None:
    """The bias that its label names: covariances of 64 clips of 100 features are singular."""
    rng = np.random.default_rng(2)
    true, again, other = rng.standard_normal((3, 64, 100)) / np.sqrt(np.arange(1, 101))
    assert frechet_distance(0.8 * other, true) < frechet_distance(again, true)
    assert frechet_distance(again, true) > 1


def test_one_row_and_other_widths_are_refused() -> None:
    for one, other in ((np.zeros((1, 3)), np.zeros((5, 3))), (np.zeros((5, 2)), np.zeros((5, 3)))):
        with pytest.raises(ValueError, match="two rows or more"):
            frechet_distance(one, other)


def test_fvd_is_the_distance_of_the_networks_features(network: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    know_i3d(monkeypatch, network)
    generator = torch.Generator().manual_seed(0)
    imagined, true = torch.rand(2, 5, 12, 3, 16, 16, generator=generator)
    i3d = I3d(network)
    found = i3d.features(true, chunk=2)
    resized = torch.nn.functional.interpolate(true[:, 11], size=(224, 224), mode="bilinear", align_corners=False)
    np.testing.assert_allclose(found[:, 3:], (2 * resized - 1).mean(dim=(2, 3)).numpy(), rtol=1e-4, atol=1e-5)
    distance = frechet_video_distance(i3d.features(imagined), found)
    assert distance.value == pytest.approx(frechet_distance(i3d.features(imagined), found))
    assert distance.as_dict()["label"] == "FVD (biased)"
    with pytest.raises(ValueError, match="10 frames; I3D needs 11"):
        i3d.features(true[:, :10])


def test_absent_fvd_is_none_with_its_reason() -> None:
    assert frechet_video_distance(np.zeros((1, 3)), np.zeros((1, 3))).as_dict() == {
        "value": None, "clips": 1, "reason": "it needs two clips or more", "label": "FVD (biased)",
    }  # fmt: skip
    broken = np.array([[0.0, np.nan], [1.0, 2.0]])
    assert frechet_video_distance(broken, np.eye(2)).reason == "some features are not finite"


def test_a_file_of_another_hash_is_not_loaded(network: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"--i3d .*a file of SHA-256 .*begins with bec6519f66ea534e"):
        I3d(network)
    with pytest.raises(InputError, match=r"--i3d .*cannot be read"):
        I3d(network.with_name("none.pt"))
    network.write_bytes(b"no network")
    know_i3d(monkeypatch, network)
    with pytest.raises(InputError, match="cannot load it"):
        I3d(network)
