"""Clips of a step that is not finite are saved for inspection, and saving never hides the error."""

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from run_fixtures import set_up
from vjepa2_ac.data.clips import loader
from vjepa2_ac.episode import Batch, Clip
from vjepa2_ac.errors import InputError
from vjepa2_ac.training import step as nonfinite_clips
from vjepa2_ac.training.loop import train
from vjepa2_ac.training.setup import batches_from
from vjepa2_ac.training.step import MOST_CLIPS, ClipRecorder


def batch(first: int, clips: int = 2, bad: int | None = None) -> Batch:
    states = torch.linspace(0, 1, clips * 4 * 7).reshape(clips, 4, 7)
    if bad is not None:
        states[bad, 2, 3] = float("nan")
    starts = tuple(range(first, first + clips))
    return Batch(
        frames=torch.randint(0, 255, (clips, 4, 12, 16, 3), dtype=torch.uint8), states=states,
        actions=torch.zeros(clips, 3, 7), extrinsics=None, episode_ids=tuple(f"/data/{n}" for n in starts),
        starts=starts,
    )  # fmt: skip


def looking_back(*batches: tuple[Batch, float]) -> ClipRecorder:
    look_back = ClipRecorder()
    for one, loss in batches:
        look_back.add(one, torch.tensor(loss))
    return look_back


def saved_starts(folder: Path) -> list[int]:
    return [int(np.load(path)["start"]) for path in sorted(folder.glob("process0-clip*.npz"))]


def test_a_clip_reads_back_as_it_was(tmp_path: Path) -> None:
    one = batch(5, clips=1)
    reported = looking_back((one, float("inf"))).save(tmp_path / "step", process=0)
    assert reported == f"1 of them are saved in {tmp_path / 'step'}"
    clip = np.load(tmp_path / "step/process0-clip00.npz")
    assert (clip["frames"] == one.frames[0].numpy()).all()
    assert (clip["states"] == one.states[0].numpy()).all()
    assert (clip["actions"] == one.actions[0].numpy()).all()
    assert (str(clip["episode_id"]), int(clip["start"])) == ("/data/5", 5)
    assert (tmp_path / "step/process0.png").read_bytes().startswith(b"\x89PNG")


def test_the_suspicious_come_first(tmp_path: Path) -> None:
    sound, broken, poisoned = (batch(0), 1.0), (batch(10), float("nan")), (batch(20, bad=1), float("nan"))
    looking_back(sound, broken, poisoned).save(tmp_path, process=0)
    assert saved_starts(tmp_path) == [21, 10, 11, 20, 0, 1]


def test_no_more_than_a_few_are_kept_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nonfinite_clips, "_draw", lambda *_: None)
    looking_back(*[(batch(10 * n), 1.0) for n in range(MOST_CLIPS)]).save(tmp_path / "many", process=0)
    assert len(saved_starts(tmp_path / "many")) == MOST_CLIPS
    monkeypatch.setattr(nonfinite_clips, "MOST_BYTES", 3 * batch(0).frames.nbytes)
    looking_back(*[(batch(10 * n), 1.0) for n in range(5)]).save(tmp_path / "large", process=0)
    assert saved_starts(tmp_path / "large") == [0, 1, 10, 11, 20, 21]


def test_each_process_writes_under_a_name_of_its_own(tmp_path: Path) -> None:
    for process in (0, 1):
        looking_back((batch(0, clips=1), 1.0)).save(tmp_path, process)
    assert len(list(tmp_path.glob("*.npz"))) == len(list(tmp_path.glob("*.png"))) == 2


def test_a_full_disk_is_reported_and_not_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    reported = looking_back((batch(0), 1.0)).save(tmp_path / "step", process=0)
    assert "could not all be saved" in reported
    assert "No space left" in reported
    assert not list((tmp_path / "step").iterdir())


@pytest.fixture
def bad_clip(make_config: Any, reporter: Any, monkeypatch: pytest.MonkeyPatch) -> tuple[str, int]:
    """The second clip of a run is poisoned where it is read: a state is not a number."""
    read, batch = loader.read_clip, next(batches_from(set_up(make_config(), reporter)))
    bad = (batch.episode_ids[1], batch.starts[1])

    def poisoned(*arguments: Any) -> Clip:
        clip = read(*arguments)
        if (clip.episode_id, clip.start) == bad:
            clip.states[1, 0] = np.nan
        return clip

    monkeypatch.setattr(loader, "read_clip", poisoned)
    return bad


def test_a_run_that_meets_what_is_not_a_number_saves_it_before_it_stops(make_config, reporter, bad_clip) -> None:
    config = make_config()
    folder = Path(config.run_dir) / "not_finite/step-00000001"
    with pytest.raises(InputError, match="not finite") as caught:
        train(config, reporter)
    assert reporter.steps == []
    assert f"4 of them are saved in {folder}" in str(caught.value)
    assert f"{bad_clip[0]} from step {bad_clip[1]}" in str(caught.value)
    worst = np.load(folder / "process0-clip00.npz")
    assert (str(worst["episode_id"]), int(worst["start"])) == bad_clip
    assert np.isnan(worst["states"]).any()
    assert (folder / "process0.png").is_file()


def test_a_trial_that_meets_what_is_not_a_number_writes_nothing(make_config, reporter, bad_clip) -> None:
    config = make_config()
    with pytest.raises(InputError, match="not finite") as caught:
        train(config, reporter, check_only=True)
    assert bad_clip[0] in str(caught.value)
    assert not Path(config.run_dir).exists()


def test_a_disk_that_is_full_does_not_hide_what_was_wrong(make_config, reporter, bad_clip, monkeypatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(InputError, match=r"not finite.*could not all be saved.*No space left") as caught:
        train(make_config(), reporter)
    assert bad_clip[0] in str(caught.value)
