"""Progress begins at 0 and ends at 1, and its monotony says whether to trust it."""

from pathlib import Path

import numpy as np
import pytest

from vjepa2_ac.api import load_run, open_dataset
from vjepa2_ac.cli import main
from vjepa2_ac.config.planning import EnergyConfig
from vjepa2_ac.evaluation.policies.progress import EpisodeProgress, monotony_of, progress_of_episodes


def test_progress_is_0_at_the_start_and_1_at_the_end(whole_run: Path, data_folder: Path) -> None:
    dataset = open_dataset(data_folder, frames=4, stride=2, workers=0)
    model = load_run(whole_run, device="cpu").world_model
    for every in (1, 5):
        found = list(progress_of_episodes(model, dataset, EnergyConfig(), every=every))
        assert [one.index for one in found] == list(range(8))
        for one in found:
            assert one.steps.tolist() == sorted({*range(0, 23, every), 23})
            assert (one.progress[0], one.progress[-1]) == (0.0, 1.0)


def test_monotony_is_the_rank_correlation_with_time() -> None:
    steps = np.arange(4)
    grows, falls = (EpisodeProgress(str(k), k, steps, way) for k, way in enumerate((steps**2.0, -steps * 1.0)))
    still = EpisodeProgress("still", 2, steps, np.zeros(4))
    assert (grows.monotony, falls.monotony) == (1.0, -1.0)
    assert np.isnan(still.monotony)
    assert monotony_of([grows, falls, still]).value == 0.0


def test_the_command_writes_a_column_that_joins_a_lerobot_set(
    whole_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra `lerobot` is not installed")
    out = tmp_path / "progress.parquet"
    assert main(["progress", str(whole_run), "--out", str(out), "--every", "4"]) == 0
    table = parquet.read_table(out).to_pydict()
    assert set(table) == {"episode_index", "frame_index", "episode", "progress"}
    assert [table["frame_index"][row] for row in range(7)] == [0, 4, 8, 12, 16, 20, 23]
    assert "held-out episodes" in " ".join(capsys.readouterr().out.split())
