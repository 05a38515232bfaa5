"""A machine killed during its first upload: any machine can resume from the place."""

import logging
from pathlib import Path

import pytest

from same_run import assert_same_run
from vjepa2_ac import storage
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import checkpoint_name
from vjepa2_ac.runs.mirror.background_sync import Mirror
from vjepa2_ac.runs.mirror.remote_checkpoints import RemoteCheckpoints, complete
from vjepa2_ac.runs.mirror.upload import SMALL_FILES
from vjepa2_ac.training.loop import train

STEPS = 3
FILES = 4  # the manifest under another name, state.json and two more come before the manifest


class KilledError(BaseException):
    """Stands for SIGKILL: nobody sees to anything any more."""


@pytest.fixture
def place(tmp_path: Path) -> str:
    return str(tmp_path / "disk/run")


@pytest.fixture
def config_on(make_config, tmp_path: Path, place: str):
    def config(machine: str, **changes: object):
        return make_config(
            run_dir=str(tmp_path / machine), checkpoint__remote=place, checkpoint__remote_every_minutes=0.0,
            checkpoint__keep_best=False, training__steps=STEPS, **changes,
        )  # fmt: skip

    return config


@pytest.fixture
def whole(make_config, reporter, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that nobody killed: the same one for all tests."""
    if not _whole:
        folder = tmp_path_factory.mktemp("whole") / "run"
        _whole.append(
            train(
                make_config(run_dir=str(folder), checkpoint__keep_best=False, training__steps=STEPS), type(reporter)()
            )
        )
    return _whole[0]


_whole: list[Path] = []


def die_in_first_upload(config: object, reporter, monkeypatch: pytest.MonkeyPatch, *, before_file: int) -> None:
    """Train until so many files of the first checkpoint are at the place; then nothing happens any more."""
    sent: list[str] = []

    def upload(source: Path, target: str) -> None:
        if len(sent) == before_file:
            raise KilledError
        storage.upload(source, target)
        sent.append(target)

    with monkeypatch.context() as dying:
        dying.setattr("vjepa2_ac.runs.mirror.remote_checkpoints.upload", upload)
        dying.setattr(Mirror, "_begin", Mirror._send)  # at once, and its death is everybody's
        with pytest.raises(KilledError):
            train(config, reporter)
    assert len(sent) == before_file


def there(place: str) -> list[str]:
    return sorted(complete(RemoteCheckpoints(place).listing()))


@pytest.mark.parametrize(("before_file", "machine"), [(2, "another"), (FILES, "another"), (2, "this")])
def test_a_run_killed_in_its_first_upload_is_mirrored_by_the_next_start(
    config_on, reporter, monkeypatch, tmp_path: Path, place: str, before_file: int, machine: str, caplog, whole: Path
) -> None:
    die_in_first_upload(config_on("this"), reporter, monkeypatch, before_file=before_file)
    assert there(place) == []
    train(config_on(machine), reporter)
    assert there(place)[-1] == checkpoint_name(STEPS)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert_same_run(whole, tmp_path / machine)


def test_half_a_checkpoint_of_another_run_is_refused_before_the_first_step(
    config_on, reporter, monkeypatch, tmp_path: Path
) -> None:
    die_in_first_upload(config_on("this"), reporter, monkeypatch, before_file=2)
    reporter.steps.clear()
    with pytest.raises(InputError, match=r"differs in training\.learning_rate.*Set another checkpoint.remote"):
        train(config_on("other", training__learning_rate=0.5), reporter)
    assert not (tmp_path / "other").exists()
    assert reporter.steps == []


def test_small_files_alone_keep_nobody_out(config_on, reporter, place: str) -> None:
    """Who removes the checkpoints of a place starts a run anew there, with another config if need be."""
    train(config_on("this"), reporter)
    for name in there(place):
        RemoteCheckpoints(place).remove(name)
    assert {"config.yaml", "run_id"} <= {name for name in SMALL_FILES if storage.exists(storage.join(place, name))}
    train(config_on("other", training__learning_rate=0.5), reporter)
    assert there(place)[-1] == checkpoint_name(STEPS)
