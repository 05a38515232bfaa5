"""The run's folder: it belongs to a run from its first file on."""

import os
from pathlib import Path

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.folder import check_run_folder, open_run_folder
from vjepa2_ac.runs.lock import RunLock


class KilledError(BaseException):
    """Stands for the end of the process: nothing is tidied up."""


def test_a_start_that_was_killed_at_any_file_stands_in_nobodys_way(make_config, tmp_path, monkeypatch) -> None:
    done, dies_at = 0, 0

    def dying(real):
        def operation(*arguments, **options):
            nonlocal done
            done += 1
            if done == dies_at:
                raise KilledError
            return real(*arguments, **options)

        return operation

    for name in ("mkdir", "replace", "fsync"):
        monkeypatch.setattr(os, name, dying(getattr(os, name)))
    monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)
    for dies_at in range(1, 100):
        config, done = make_config(run_dir=str(tmp_path / str(dies_at) / "run")), 0
        try:
            with RunLock(Path(config.run_dir)) as lock:
                lock.take()
                open_run_folder(config, "name")
        except KilledError:
            check_run_folder(config)
        else:
            break
    assert dies_at > 9, "folders, two files that are flushed and renamed"
    check_run_folder(config)


def test_a_machine_that_had_but_a_later_process_may_have_the_first_one_next_time(make_config, tmp_path) -> None:
    """Clips of a step that could not be done are all that a process other than the first leaves in its folder."""
    (tmp_path / "run" / "not_finite" / "step-00000003").mkdir(parents=True)
    check_run_folder(make_config())


def test_a_folder_of_other_things_stays_refused_though_a_lock_lies_in_it(make_config, tmp_path) -> None:
    config = make_config()
    with RunLock(Path(config.run_dir)) as lock:
        lock.take()
    (tmp_path / "run" / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="other things"):
        check_run_folder(config)
