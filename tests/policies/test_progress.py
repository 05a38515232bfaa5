"""The example's progress column is 0 at the start and 1 at the end of an episode, and is added to a LeRobot set."""

import runpy
from pathlib import Path

import pytest

from paths import ROOT


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
        episode_rows = [row for row in rows if row["episode_index"] == episode]
        assert [row["frame_index"] for row in episode_rows] == sorted({*range(0, 23, every), 23})
        assert (episode_rows[0]["progress"], episode_rows[-1]["progress"]) == (0.0, pytest.approx(1.0, abs=1e-5))
    assert "held-out episodes (1 is best)" in capsys.readouterr().out
