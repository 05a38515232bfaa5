"""Partial files: removed after a killed writer, never during writing. With real processes."""

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from run_fixtures import Popen
from vjepa2_ac import storage
from vjepa2_ac.distributed.signals import tidy_end
from vjepa2_ac.storage import partial

WRITING = """
import sys, time
from pathlib import Path
from vjepa2_ac import storage
from vjepa2_ac.distributed.signals import tidy_end
target = Path(sys.argv[1])
with tidy_end():
    if sys.argv[2] == "file":
        with storage.atomic_writer(target) as file:
            file.write(b"x" * 1000)
            file.flush()
            print("writing", flush=True)
            time.sleep(300)
    with storage.folder_writer(target, "manifest") as folder:
        storage.write_atomically(folder / "inner" / "a", "a")
        print("writing", flush=True)
        time.sleep(300)
"""


@pytest.fixture(autouse=True)
def _looks_again() -> None:
    """A process looks at a folder once: here each test is a new one."""
    partial._remove_abandoned_once.cache_clear()


@pytest.fixture
def writing(popen: Popen) -> Callable[[Path, str], subprocess.Popen]:
    def start(target: Path, kind: str) -> subprocess.Popen:
        process = popen([sys.executable, "-c", WRITING, str(target), kind], stdout=subprocess.PIPE)
        assert process.stdout.readline() == b"writing\n"
        return process

    return start


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_writer_that_is_told_to_end_leaves_nothing_and_dies_of_it(
    tmp_path: Path, writing, kind: str, number: int
) -> None:
    process = writing(tmp_path / "target", kind)
    assert len(names(tmp_path)) == 1
    process.send_signal(number)
    assert process.wait(timeout=120) == -number
    assert names(tmp_path) == []


@pytest.mark.usefixtures("default_signals")
def test_a_writer_under_nohup_outlives_its_terminal(tmp_path: Path) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with tidy_end():
        os.kill(os.getpid(), signal.SIGHUP)
        storage.write_atomically(tmp_path / "target", "a")
    assert names(tmp_path) == ["target"]


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_a_killed_writer_left_goes_with_the_next_one_and_not_before_it_is_dead(
    tmp_path: Path, writing, kind: str
) -> None:
    process = writing(tmp_path / "target", kind)
    (left,) = names(tmp_path)
    assert partial.is_partial(tmp_path / left)
    storage.write_atomically(tmp_path / "other", "while it is at work")
    assert names(tmp_path) == [left, "other"]
    process.kill()
    process.wait(timeout=120)
    storage.write_atomically(tmp_path / "other", "of this process, which has looked here before")
    assert names(tmp_path) == [left, "other"]
    partial._remove_abandoned_once.cache_clear()  # a new process
    with storage.folder_writer(tmp_path / "target", "manifest") as fresh:
        (fresh / "manifest").touch()
        assert names(tmp_path) == [fresh.name, "other"]
    assert names(tmp_path) == ["other", "target"]


def age(path: Path, days: float) -> None:
    for one in (path, *path.rglob("*")):
        os.utime(one, (time.time() - days * 86_400,) * 2)


@pytest.mark.parametrize("name", [".a.0123abcd-0123abcd.partial", ".a.0123abcd.partial", ".a.4711.partial"])
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_another_kernel_or_version_left_goes_when_nothing_in_it_changed_for_a_day(tmp_path, name, kind) -> None:
    left = tmp_path / name
    if kind == "folder":
        (left / "inner").mkdir(parents=True)
        (left / "inner" / "file").touch()
    else:
        left.touch()
    age(left, days=2)
    newest = left / "inner" / "file" if kind == "folder" else left
    age(newest, days=0.9)
    partial.remove_abandoned(tmp_path)
    assert left.exists(), "its writer may be alive on another machine"
    age(left, days=1.1)
    partial.remove_abandoned(tmp_path)
    assert not left.exists()


def test_names_of_others_and_links_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "file").touch()
    kernel = partial._kernel()
    for name in (".a.partial", "a.0123abcd.partial", ".a.0123abcd.part", f".a.{kernel}-xyz.partial", "partial"):
        (tmp_path / name).touch()
        age(tmp_path / name, days=9)
    (tmp_path / f".l.{kernel}-0123abcd.partial").symlink_to(tmp_path / "precious")
    before = names(tmp_path)
    partial.remove_abandoned(tmp_path)
    assert names(tmp_path) == before
    assert (tmp_path / "precious" / "file").exists()


def test_without_locks_only_age_tells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with storage.atomic_writer(tmp_path / "a") as file:
        partial.remove_abandoned(tmp_path)
        assert len(names(tmp_path)) == 1, "it is being written"
        file.write(b"a")
    left = tmp_path / f".b.{partial._kernel()}-0123abcd.partial"
    left.touch()
    age(left, days=2)
    partial.remove_abandoned(tmp_path)
    assert names(tmp_path) == ["a"]


def test_a_writer_whose_file_goes_before_it_is_locked_takes_another(tmp_path: Path, monkeypatch) -> None:
    lock, taken = fcntl.flock, []

    def late(handle: int, operation: int) -> None:
        if not taken:
            for path in tmp_path.iterdir():
                taken.append(path)
                path.rmdir() if path.is_dir() else path.unlink()
        lock(handle, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    storage.write_atomically(tmp_path / "a", "a")
    taken.clear()
    with storage.folder_writer(tmp_path / "b", "manifest") as fresh:
        (fresh / "manifest").touch()
    assert names(tmp_path) == ["b"], "the file went, too: nobody held it"
    assert (tmp_path / "b" / "manifest").exists()


def test_a_long_name_can_be_written(tmp_path: Path) -> None:
    storage.write_atomically(tmp_path / ("ü" * 127), "a")
    assert names(tmp_path) == ["ü" * 127]


def test_a_folder_with_leavings_alone_is_an_empty_one(tmp_path: Path) -> None:
    (tmp_path / f".a.{partial._kernel()}-0123abcd.partial").mkdir()
    assert storage.is_empty(tmp_path)
    (tmp_path / "a").touch()
    assert not storage.is_empty(tmp_path)
