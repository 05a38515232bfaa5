"""An evaluation or validation shared by processes equals that of one process, and an error is raised in all."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from paths import ROOT
from ranks import run_ranks
from same_run import metrics
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.training.loop import train

pytestmark = pytest.mark.usefixtures("default_signals")
BROKEN = str(ROOT / "tests/support/broken_clips.py")
PROBES = [
    "--clips", "7", "--ranking-clips", "5", "--samples", "6", "--landscapes", "2", "--nodes", "3",
    "--examples", "2",
]  # fmt: skip


def numbers_of(value: Any, name: str = "") -> dict[str, float]:
    """Return every number of nested values by its path."""
    if isinstance(value, bool | str) or value is None:
        return {}
    if isinstance(value, int | float):
        return {name: float(value)}
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return {path: number for key, item in items for path, number in numbers_of(item, f"{name}/{key}").items()}


def assert_same(actual: dict[str, Any], expected: dict[str, Any]) -> None:
    first, second = numbers_of(actual), numbers_of(expected)
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_allclose(second[name], value, rtol=1e-6, atol=1e-9, err_msg=name)


def test_shared_evaluation_equals_single_process_evaluation(make_config, tmp_path: Path, reporter) -> None:
    """7 clips in batches of 3, two of them broken; one process has one clip and needs actions of other processes."""
    changes = {"frames": 6, "test_share": 0.4, "broken_episodes": "skip"}
    data = {f"data__{name}": value for name, value in changes.items()}
    config = make_config(**data, training__steps=2, validation__batch_size=3, validation__every=2)
    run = str(train(config, reporter))
    words = [BROKEN, "evaluate", run, *PROBES, "--out"]
    run_ranks([*words, str(tmp_path / "alone")], 1)
    outputs = run_ranks([*words, str(tmp_path / "together")], 3)
    assert "sensitive to actions" in outputs[0][0]
    assert [out for out, _ in outputs[1:]] == ["", ""], "only the first process may print"
    alone, together = (json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("alone", "together"))
    assert_same(alone["rows"], together["rows"])
    assert alone["clips"]["count"] == together["clips"]["count"] == 5


def test_shared_validation_equals_single_process_validation(make_config, tmp_path: Path) -> None:
    changes = {"training__steps": 2, "validation__clips": 7, "validation__batch_size": 2, "validation__every": 2}
    changes |= {"adapter__dropout": 0.0, "data__broken_episodes": "skip", "training__accumulation": 1}
    for processes in (1, 2):
        config = make_config(**changes, run_dir=str(tmp_path / f"{processes}"))
        (tmp_path / f"{processes}.yaml").write_text(config_as_yaml(config))
        run_ranks([BROKEN, "train", str(tmp_path / f"{processes}.yaml")], processes)
    first, second = ([row for row in metrics(tmp_path / name) if row["kind"] == "validation"] for name in ("1", "2"))
    np.testing.assert_array_equal(*(list(numbers_of(rows[0]).values()) for rows in (first, second)))


def test_error_in_shared_work_is_raised_in_all_processes(make_config, tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(config_as_yaml(make_config()))
    script = str(ROOT / "tests/support/disagreeing_ranks.py")
    outputs = [out for out, _ in run_ranks([script, str(path), "one_cannot_read_a_validation_clip"], status=3)]
    assert outputs == ["InputError: episode 3: its image is damaged.\n"] * 2
