"""Addresses in a run of unknown origin: listed before one of them is contacted."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from vjepa2_ac.cli import main
from vjepa2_ac.config.loading import config_as_yaml, parse_config
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.folder import places_elsewhere

ELSEWHERE = {
    "run_dir": "r",
    "data": {"path": "gs://bucket/set", "idle": {"rule": "published", "ranges": "https://example.org/ranges.json"}},
    "model": {"base": "b.pt"},
    "checkpoint": {"remote": "s3://bucket/run"},
    "tracking": {"wandb": "online"},
}
LINES = [
    "data.path: gs://bucket/set",
    "data.idle.ranges: https://example.org/ranges.json",
    "checkpoint.remote: s3://bucket/run",
    "tracking.wandb: online",
]


def test_every_address_of_a_config_is_named_with_its_knob() -> None:
    assert places_elsewhere(parse_config(ELSEWHERE, where="")) == LINES
    here = {"run_dir": "r", "data": {"path": "d", "exclude": ["gs://is-but-a-name"]}, "model": {"base": "b.pt"}}
    assert places_elsewhere(parse_config(here, where="")) == []


@pytest.mark.parametrize(
    ("command", "contacts"),
    [
        (["train", "RUN", "--resume"], "vjepa2_ac.training.loop.train"),
        (["evaluate", "RUN"], "vjepa2_ac.reports.write.evaluate_subject"),
        (
            ["plan", "RUN", "--start", "a.png", "--goal", "a.png", "--state", "0.4,0,0.3,3.1,0,0.1,0.2", "--out", "p"],
            "vjepa2_ac.planning.session.load_to_plan",
        ),
    ],
    ids=["train", "evaluate", "plan"],
)
def test_a_run_that_leads_elsewhere_says_so_before_it_goes_there(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: list[str],
    contacts: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save("a.png")
    run = tmp_path / "[b]run"  # no markup
    run.mkdir()
    (run / "config.yaml").write_text(config_as_yaml(parse_config(ELSEWHERE, where="")))
    said: list[str] = []

    def contact(*_: Any, **__: Any) -> None:
        said.append(capsys.readouterr().out)
        raise InputError(where="here", found="the end")

    monkeypatch.setattr(contacts, contact)
    monkeypatch.setattr("vjepa2_ac.runs.checkpoint_selection.select_checkpoint", lambda *_: None)  # the run has none
    assert main([str(run) if word == "RUN" else word for word in command]) == 2
    for line in LINES:
        assert f"{run} names a place elsewhere: {line}" in said[0]
