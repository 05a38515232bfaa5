"""A run whose clock jumps by a day is unchanged, with the same checkpoints."""

import itertools
import time
from pathlib import Path

import pytest

from same_run import assert_same_run
from vjepa2_ac.training.loop import train


def test_a_run_whose_clock_jumps_to_and_fro_is_the_same_run(
    make_config, reporter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = {
        "training__steps": 4, "checkpoint__every": 3, "checkpoint__every_minutes": 60.0, "checkpoint__keep_best": False,
        "checkpoint__remote_every_minutes": 60.0,
    }  # fmt: skip
    train(make_config(run_dir=str(tmp_path / "whole"), **changes), reporter)
    real, jumps = time.time, itertools.cycle([0.0, 86_400.0, -86_400.0])
    monkeypatch.setattr(time, "time", lambda: real() + next(jumps))
    changes["checkpoint__remote"] = str(tmp_path / "disk")
    run = train(make_config(run_dir=str(tmp_path / "jumping"), **changes), reporter)
    assert_same_run(tmp_path / "whole", run)
    names = ["step-00000003", "step-00000004"]
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == names
    mirrored = sorted(path.name for path in (tmp_path / "disk/checkpoints").iterdir())
    assert mirrored in (names, names[1:])  # in the background: the first may be outdated before its turn comes
