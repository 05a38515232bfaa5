"""The table of encoders counts as `doctor` does, and has every encoder that can be downloaded."""

from collections.abc import Iterator
from typing import Any

import pytest

from benches import imported
from paths import ROOT
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.model.checkpoints import base_sizes
from vjepa2_ac.model.model_files import PUBLISHED
from vjepa2_ac.training.cost import count_parameters


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


@pytest.mark.parametrize("published", [one for one in PUBLISHED if one.holds == "encoder"], ids=lambda one: one.name)
def test_parameters_of_a_published_encoder_are_those_of_its_name(published: Any) -> None:
    config = load_config(ROOT / "configs/scratch_vitb.yaml", [f"model.encoder.path=nowhere/{published.name}.pt"])
    found = count_parameters(config, base_sizes(config.model)).encoder
    assert found == pytest.approx(published.encoder.parameters, rel=0.02)
