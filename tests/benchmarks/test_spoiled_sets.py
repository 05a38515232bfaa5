"""The benchmark of faults spoils what it says it spoils, and its table tells refused, warned and missed apart."""

import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benches import imported
from moving_arms import RATE_HZ, STEPS, spot_frames, spot_states, write_spots
from vjepa2_ac.evaluation.calibration.data import VariantProbe
from vjepa2_ac.evaluation.calibration.variants import VariantResult
from vjepa2_ac.intervals import Estimate

EPISODES = 10


@pytest.fixture
def spoiled_sets(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark."""
    yield from imported("spoiled_sets", monkeypatch)


@pytest.fixture
def faults(spoiled_sets: Any) -> Any:
    """What it does to recordings."""
    return sys.modules[spoiled_sets.Fault.__module__]


def recordings(faults: Any) -> list[Any]:
    ways = [spot_states(number) for number in range(3)]
    return [faults.Recording(states, spot_frames(states), RATE_HZ) for states in ways]


def test_each_fault_changes_something_but_the_one_that_is_none(faults: Any) -> None:
    clean = recordings(faults)
    for fault in faults.FAULTS:
        one, before = faults.spoiled(fault, clean)[0], clean[0]
        assert len(one.states) == len(one.frames)
        same = one.rate_hz == before.rate_hz and all(
            np.array_equal(getattr(one, name), getattr(before, name)) for name in ("states", "frames")
        )
        assert same == (fault.name == faults.CLEAN), fault.name


def test_pictures_are_late_early_and_of_another_episode(faults: Any) -> None:
    clean, by_name = recordings(faults), {fault.name: fault for fault in faults.FAULTS}
    late, early, foreign = (
        faults.spoiled(by_name[name], clean)[0]
        for name in ("frames 8 steps late", "frames 2 steps early", "of another episode")
    )
    np.testing.assert_array_equal(late.frames[8:], spot_frames(late.states)[:-8])
    np.testing.assert_array_equal(early.frames[:-2], spot_frames(early.states)[2:])
    np.testing.assert_array_equal(foreign.frames, clean[1].frames)


def write_config(tmp_path: Path) -> str:
    ways = [spot_states(number) for number in range(EPISODES)]
    data = write_spots(tmp_path / "set", [(states, spot_frames(states)) for states in ways])
    values = {
        "run_dir": str(tmp_path / "run"), "model": {"base": "builtin:sim-tiny"},
        "data": {
            "path": str(data), "source": "npz", "frames": 3, "stride": 4, "workers": 0,
            "disk_cache": {"dir": str(tmp_path / "cache")},
        },
    }  # fmt: skip
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(values))
    return str(path)


def outcomes(printed: str) -> dict[str, tuple[str, str]]:
    """Return what the check and the probe made of each fault."""
    rows = re.findall(r"^(\S.{23})  ([a-z]+) +([a-z]+|-)  ", printed, re.MULTILINE)
    return {name.strip(): (checked, probed) for name, checked, probed in rows}


def test_a_table_says_what_was_refused_warned_and_missed(
    spoiled_sets: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = VariantResult("as they are", Estimate(0.5, 0.4, 0.6), 0.2, 0.4, 1.2, 16, 8)
    better = replace(plain, name="y negated", difference=Estimate(-0.4, -0.5, -0.3))
    probes = {False: VariantProbe(plain, ())}
    probes[True] = replace(probes[False], results=(better,))
    calls: list[object] = []

    def probe(config: object, dataset: object, **_: object) -> VariantProbe:
        del config
        calls.append(dataset)
        return probes[len(calls) in {2, 3}]  # of those in their order: clean, y, reversed, stale, BGR

    monkeypatch.setattr(spoiled_sets, "probe_config", probe)
    chosen = ["frames reversed", "stale poses, every 5th", "BGR", "y negated"]
    spoiled_sets.main(["--data", write_config(tmp_path), "--faults", *chosen])
    printed = capsys.readouterr().out
    assert f"{EPISODES} episodes, {EPISODES * STEPS} steps; stride 4" in printed
    assert outcomes(printed) == {
        "as it is": ("quiet", "quiet"), "y negated": ("missed", "named"), "frames reversed": ("refused", "misled"),
        "stale poses, every 5th": ("warned", "missed"), "BGR": ("missed", "missed"),
    }  # fmt: skip
    assert "error agreement: frames and states have opposite orders in time" in printed
    assert "0.500 with y negated" in printed


def test_the_probe_is_asked_with_a_model(spoiled_sets: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoiled_sets.main(["--data", write_config(tmp_path), "--clips", "4", "--faults", "as it is"])
    printed = capsys.readouterr().out
    assert outcomes(printed) == {"as it is": ("quiet", "quiet")}
    assert re.search(r"quiet +quiet +\d\.\d{3} \[", printed)


def test_a_set_that_cannot_be_opened_is_a_row(spoiled_sets: Any, capsys: pytest.CaptureFixture[str]) -> None:
    fault = spoiled_sets.Fault("millimetres", lambda one, *_: one)
    outcome = spoiled_sets.Outcome((), "set/000.npz: states in millimetres", None)
    spoiled_sets._print(fault, outcome, set())
    assert re.match(r"millimetres +refused +- +set/000\.npz", capsys.readouterr().out)
