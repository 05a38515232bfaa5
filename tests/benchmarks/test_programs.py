"""The programs in `benchmarks` run to completion, their tables are complete, and the commands for a GPU are valid."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest

from paths import ROOT
from vjepa2_ac.config.loading import config_as_yaml, load_config
from vjepa2_ac.model.attention import AttentionKind
from vjepa2_ac.model.checkpoints import base_sizes
from vjepa2_ac.model.model_files import PUBLISHED
from vjepa2_ac.training.cost import count_parameters

Load = Callable[[str], Any]
SECTION = (ROOT / "docs/IMPLEMENTATION_NOTES.md").read_text().split("\n## GPU measurements\n")[1].split("\n## ")[0]
ENCODERS = [model for model in PUBLISHED if model.model_kind == "encoder"]


@pytest.mark.parametrize(
    ("name", "options", "printed"),
    [
        ("index", "--shards 2 --in-flight 4 --latency-ms 1", "a hash's"),
        ("loader", "--clips 4", "index of 2,000 episodes"),
        ("planning", "--quick --no-memory --official {none} --profile", "official: skipped, needs "),
        (
            "train_step",
            "--quick --no-memory --official {none} --source cache pixels --attention per_step --profile --json {json}",
            "official: skipped, needs ",
        ),
    ],
)
def test_benchmark_program_runs_to_completion(
    name: str,
    options: str,
    printed: str,
    load: Load,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    module = load(name)
    if name == "index":  # the program changes these values; they are restored after the test
        monkeypatch.setattr(module.rlds_index, "_IN_FLIGHT", module.rlds_index._IN_FLIGHT)
        monkeypatch.setenv("STORAGE_EMULATOR_HOST", "")
    if name == "loader":
        monkeypatch.setattr(module, "DROID_EPISODES", 2_000)
        monkeypatch.setattr(module.measure_workers, "__defaults__", (2, 2))
    module.main(options.format(none=tmp_path / "none", json=tmp_path / "rows.json").split())
    assert printed in capfd.readouterr().out


def test_action_score_is_printed(make_config, tmp_path: Path, load: Load, capsys) -> None:
    config = make_config(data__frames=4, data__test_share=0.4)
    (tmp_path / "data.yaml").write_text(config_as_yaml(config))
    words = [str(config.model.base), str(tmp_path / "data.yaml"), "--clips", "2", "--samples", "12"]
    load("action_score").main(words)
    assert capsys.readouterr().out.startswith("plans: Action Score ")


def test_every_downloadable_encoder_has_a_row(load: Load) -> None:
    rows = load("encoders").published_encoders()
    assert {name for _, names in rows.values() for name in names} == {model.name for model in ENCODERS}
    table = (ROOT / "benchmarks/results/encoders.md").read_text()
    assert "](../benchmarks/results/encoders.md)" in (ROOT / "docs/encoders_reference.md").read_text()
    assert all(f"\n| {name} | {', '.join(names)} |" in table for name, (_, names) in rows.items())


@pytest.mark.parametrize("published", ENCODERS, ids=lambda model: model.name)
def test_parameter_count_of_encoder_equals_published_number(published: Any) -> None:
    config = load_config(ROOT / "configs/scratch_vitb.yaml", [f"model.encoder.path=nowhere/{published.name}.pt"])
    count = count_parameters(config, base_sizes(config.model)).encoder
    assert count == pytest.approx(published.encoder.parameters, rel=0.02)


def test_arguments_of_every_part_are_valid(load: Load) -> None:
    on_gpu = load("on_gpu")
    assert len({part.name for part in on_gpu.PARTS}) == len(on_gpu.PARTS)
    for part in on_gpu.PARTS:
        if parse := getattr(load(part.benchmark), "parse", None):
            variants = getattr(parse(part.arguments.split()), "attention", [])
            assert {variant.split("+")[0] for variant in variants} <= set(get_args(AttentionKind))


def test_commands_in_the_implementation_notes_are_valid(load: Load) -> None:
    commands = re.findall(r"python (benchmarks/\w+\.py[^`]*)`", SECTION)
    assert len(commands) > 1
    for script, *arguments in map(shlex.split, commands):
        load(Path(script).stem).parse(arguments)
