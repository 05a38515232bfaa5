"""The example's column begins at 0 and ends at 1 in every episode, and joins a LeRobot set."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from paths import ROOT
from tiny_models import tiny_model
from vjepa2_ac.config.loading import parse_config


@pytest.mark.parametrize("every", [1, 5])
def test_progress_is_0_at_the_start_and_1_at_the_end(
    whole_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], every: int
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra `lerobot` is not installed")
    example = runpy.run_path(str(ROOT / "examples/judge/progress.py"))
    example["main"](str(whole_run), str(tmp_path / "progress.parquet"), str(every))
    rows = parquet.read_table(tmp_path / "progress.parquet").to_pylist()
    assert {tuple(row) for row in rows} == {("episode_index", "frame_index", "episode", "progress")}
    for episode in range(8):
        own = [row for row in rows if row["episode_index"] == episode]
        assert [row["frame_index"] for row in own] == sorted({*range(0, 23, every), 23})
        assert (own[0]["progress"], own[-1]["progress"]) == (0.0, 1.0)
    assert "held-out episodes (1: always)" in capsys.readouterr().out


@pytest.mark.parametrize("version", ["v30", "v21"])
def test_the_episode_index_is_lerobots_where_an_episode_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra `lerobot` is not installed")
    import lerobot_sets

    episodes = [lerobot_sets.recorded(number, 12) for number in range(4)]
    episodes[1].columns["observation.state.cartesian_position"][:] = np.nan
    getattr(lerobot_sets, f"write_{version}")(tmp_path / "set", episodes, pictures="png")
    data = {
        "source": "lerobot", "path": str(tmp_path / "set"), "camera": "exterior_1_left", "broken_episodes": "skip",
        "disk_cache": {"dir": str(tmp_path / "cache")}, "validation_share": 0, "test_share": 0,
    }  # fmt: skip
    config = parse_config({"run_dir": "none", "data": data, "model": {"base": "builtin:sim-tiny"}}, where="a config")
    main = runpy.run_path(str(ROOT / "examples/judge/progress.py"))["main"]
    run = SimpleNamespace(world_model=tiny_model(), config=config)
    monkeypatch.setitem(main.__globals__, "load_run", lambda _: run)
    main("run", str(tmp_path / "progress.parquet"), "5")
    rows = parquet.read_table(tmp_path / "progress.parquet").to_pylist()
    found = {(row["episode_index"], row["episode"]) for row in rows}
    assert found == {(number, f"episode_{number:06d}") for number in (0, 2, 3)}
    assert [row["frame_index"] for row in rows if row["episode_index"] == 2] == [0, 5, 10, 11]
