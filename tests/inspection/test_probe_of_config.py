"""`data check --model` measures the data with a model, unchanged and in variants, for every source."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from latent_sets import encode_for
from vjepa2_ac.cli import main
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.inspection.probe import VariantProbe, probe_config
from vjepa2_ac.model.checkpoints import load_base

MakeConfig = Callable[..., Config]
Printed = pytest.CaptureFixture[str]


def write_config(config: Config, tmp_path: Path) -> str:
    path = tmp_path / "config.yaml"
    path.write_text(config_as_yaml(config))
    return str(path)


def check(config: Config, tmp_path: Path, model: str) -> int:
    return main(["data", "check", write_config(config, tmp_path), "--limit", "4", "--model", model])


def probed(config: Config, model: str, clips: int = 4) -> VariantProbe:
    return probe_config(config, open_dataset(config.data), model=model, clips=clips)


def names(probe: VariantProbe) -> set[str]:
    return {result.name for result in probe.results}


def test_probe_prints_a_table_and_a_verdict_after_the_findings(
    make_config: MakeConfig, tmp_path: Path, capsys: Printed
) -> None:
    assert check(make_config(), tmp_path, "builtin:sim-tiny") == 0
    printed = capsys.readouterr().out
    findings, table = printed.split("One-step error relative to persistence, by variant of the data")
    assert "\nskipped  agreement" in findings
    for variant in ("unchanged", "frames 1 step late", "states reversed", "y negated", "red and blue"):
        assert variant in table
    summary, probe = table.splitlines()[-1], " ".join(table.split())
    assert "skipped probe needs a model that predicts these data better" in probe  # no drawings
    assert "on 8 clips from 5 episodes" in probe
    assert re.fullmatch(r"0 errors, \d warnings?, [1-9] skipped", summary)


def test_probe_without_a_validation_split_uses_training_episodes(
    make_config: MakeConfig, tmp_path: Path, capsys: Printed
) -> None:
    config = make_config(data__validation_share=0.0, data__test_share=0.0)
    assert probed(config, str(config.model.base), clips=16).plain.episodes == 8
    assert check(config, tmp_path, str(config.model.base)) == 1  # training could not validate
    printed = capsys.readouterr().out
    assert "error    validation" in printed
    assert [line for line in printed.splitlines() if not line.startswith(" ")][-2].split()[1] == "probe"
    assert printed.splitlines()[-1].startswith("1 error, ")


def test_latent_cache_is_probed_with_its_encoder_and_without_frame_variants(
    make_config: MakeConfig, tmp_path: Path, capsys: Printed
) -> None:
    frame_config = make_config(data__frames=10, data__start_every=2)
    base = str(frame_config.model.base)
    cache = encode_for(frame_config, load_base(frame_config.model, seed=0), open_dataset(frame_config.data))
    config = make_config(
        data__source="latents", data__path=str(cache), data__camera=None, data__frames=10, data__start_every=2
    )
    probe, expected = probed(config, base), probed(frame_config, base)
    assert probe.plain.ratio.value == pytest.approx(expected.plain.ratio.value, rel=2e-3)  # kept in bfloat16
    assert names(probe) == names(expected) - {"red and blue exchanged", "frames mirrored"}
    differences = {result.name: result.difference.value for result in expected.results}
    for result in probe.results:
        assert result.difference.value == pytest.approx(differences[result.name], rel=0.02, abs=0.02)
    assert check(config, tmp_path, "builtin:sim-tiny") == 2
    assert "encoder" in capsys.readouterr().err
