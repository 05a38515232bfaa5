"""Missing libraries raise an error and mark no episode as broken."""

import json
import sys
from pathlib import Path

import pytest

from lerobot_sets import recorded, write_v21
from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import UnreachableError


def dataset_of(folder: Path, progress: Progress | None = None) -> Dataset:
    values = {
        "source": "lerobot", "path": str(folder), "frames": 3, "stride": 2, "validation_share": 0.0, "test_share": 0.0,
        "broken_episodes": "skip", "lerobot": {"cameras": {"wrist_left": "observation.images.wrist_left"}},
        "disk_cache": {"dir": str(folder.parent / "cache")},
    }  # fmt: skip
    return open_dataset(DataConfig.model_validate_json(json.dumps(values)), progress=progress)


def test_missing_reader_library_does_not_mark_episodes_as_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_v21(tmp_path / "set", [recorded(0, 20)])
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(
        UnreachableError, match="pyarrow, which reads and writes LeRobot data sets, is not installed"
    ) as raised:
        dataset_of(folder)
    assert "broken" not in str(raised.value)


def test_missing_video_decoder_prevents_indexing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the check, the states of 100,000 episodes would be read before the first frame fails."""
    folder, progress_calls = write_v21(tmp_path / "set", [recorded(0, 20)]), []
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UnreachableError, match=r"PyAV, which decodes and writes video, is not installed.*pip install"):
        dataset_of(folder, lambda *progress: progress_calls.append(progress))
    assert progress_calls == []
