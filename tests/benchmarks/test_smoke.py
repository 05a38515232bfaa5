"""Every benchmark runs to its end with small sizes; larger ones have files of their own."""

from pathlib import Path

import pytest

from benches import imported
from vjepa2_ac.config.loading import config_as_yaml


@pytest.mark.parametrize(
    ("name", "options", "printed"),
    [
        ("index", "--shards 2 --in-flight 4 --latency-ms 1", "a hash's"),
        ("loader", "--clips 4", "index of 2,000 episodes"),
    ],
)
def test_it_runs_to_its_end(
    name: str,
    options: str,
    printed: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    for module in imported(name, monkeypatch):
        if name == "index":  # it changes these itself, for a process of its own
            monkeypatch.setattr(module.rlds_index, "_IN_FLIGHT", module.rlds_index._IN_FLIGHT)
            monkeypatch.setenv("STORAGE_EMULATOR_HOST", "")
        if name == "loader":
            monkeypatch.setattr(module, "DROID_EPISODES", 2_000)
            monkeypatch.setattr(module.measure_workers, "__defaults__", (2, 2))
        module.main(options.split())
    assert printed in capfd.readouterr().out


def test_the_action_score_is_printed(make_config, tmp_path: Path, monkeypatch, capsys) -> None:
    config = make_config(data__frames=4, data__test_share=0.4)
    (tmp_path / "data.yaml").write_text(config_as_yaml(config))
    for module in imported("action_score", monkeypatch):
        module.main([str(config.model.base), str(tmp_path / "data.yaml"), "--clips", "2", "--samples", "12"])
    assert capsys.readouterr().out.startswith("plans: Action Score ")
