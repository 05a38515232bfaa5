"""The sweep of ranks compares both rules at the same rates, goes on where it stopped, and shows what it found."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benches import imported

pytest.importorskip("mujoco")


@pytest.fixture
def rank_rule(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark."""
    yield from imported("rank_rule", monkeypatch)


def test_cells_differ_in_rank_alpha_and_rate_only(rank_rule: Any, tmp_path: Path) -> None:
    cells = list(rank_rule.all_cells())
    assert len({cell.name for cell in cells}) == len(cells) == 18
    configs = [rank_rule.config_of(cell, tmp_path, steps=200) for cell in cells]
    for cell, config in zip(cells, configs, strict=True):
        assert (config.adapter.rank, config.adapter.alpha) == (cell.rank, cell.alpha)
        assert config.training.learning_rate == cell.learning_rate
        assert config.adapter.rslora
    assert len({(str(config.data), str(config.model), config.seed) for config in configs}) == 1


def test_it_goes_on_where_it_stopped_and_shows_what_diverged(
    rank_rule: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data").mkdir()
    measured: list[str] = []

    def measure(cell: Any, folder: Path, steps: int) -> dict[str, float | None]:
        assert (folder, steps) == (tmp_path, 7)
        measured.append(cell.name)
        if len(measured) == 3:
            raise KeyboardInterrupt
        return {"one_step": 0.5, "last_horizon": None if cell.rank == 64 else 0.625}

    monkeypatch.setattr(rank_rule, "measure", measure)
    given = ["--folder", str(tmp_path), "--steps", "7"]
    with pytest.raises(KeyboardInterrupt):
        rank_rule.main(given)
    rank_rule.main(given)
    assert len(measured) == 18 + 1
    assert measured.count(measured[2]) == 2
    rank_rule.main([*given, "--table"])
    table = capsys.readouterr().out.splitlines()[-5:]
    assert table[0] == "| 4 | 0.625 | 0.625 | 0.625 | 0.625 |"
    assert table[-1] == "| 64 | diverged | diverged | diverged | diverged |"
