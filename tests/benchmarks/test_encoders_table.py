"""The table of encoders counts as `doctor` does, and has every encoder that can be downloaded."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benches import imported
from paths import ROOT
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.model.checkpoints import base_sizes
from vjepa2_ac.model.model_files import PUBLISHED
from vjepa2_ac.training.cost import count_parameters, estimate_memory


@pytest.fixture
def encoders(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark."""
    yield from imported("encoders", monkeypatch)


def test_every_encoder_that_can_be_downloaded_has_a_row(encoders: Any) -> None:
    rows = encoders.published()
    assert {name for _, names in rows.values() for name in names} == {
        one.name for one in PUBLISHED if one.holds == "encoder"
    }
    written = (ROOT / "benchmarks/results/encoders.md").read_text()
    assert "](../benchmarks/results/encoders.md)" in (ROOT / "docs/encoders_reference.md").read_text()
    assert all(f"\n| {name} | {', '.join(names)} |" in written for name, (_, names) in rows.items())


def test_only_prints_and_writes_nothing(
    encoders: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(encoders, "peak_gb", lambda *_: 1.0)
    encoders.main(["--only", "ViT-B", "--out", str(tmp_path)])
    assert "2.1 ViT-B" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
    encoders.main(["--out", str(tmp_path)])
    assert {file.name for file in tmp_path.iterdir()} == {"encoders.json", "encoders.md"}


@pytest.mark.parametrize("published", [one for one in PUBLISHED if one.holds == "encoder"], ids=lambda one: one.name)
def test_parameters_of_a_published_encoder_are_those_of_its_name(published: Any) -> None:
    config = load_config(ROOT / "configs/scratch_vitb.yaml", [f"model.encoder.path=nowhere/{published.name}.pt"])
    found = count_parameters(config, base_sizes(config.model)).encoder
    assert found == pytest.approx(published.encoder.parameters, rel=0.02)


@pytest.mark.parametrize(("name", "gpu_gb"), [("scratch_vitl", 16)])
def test_a_predictor_from_scratch_fits_the_gpu_that_its_config_names(name: str, gpu_gb: int) -> None:
    config = load_config(ROOT / f"configs/{name}.yaml")
    assert f"{gpu_gb} GB GPU" in (ROOT / f"configs/{name}.yaml").read_text().splitlines()[0]
    sizes = base_sizes(config.model)
    assert sizes.predictor.width >= sizes.encoder.width, "else it cannot begin at copying"
    assert estimate_memory(config, sizes).total(checkpointing=True) < 0.9 * gpu_gb * 10**9
