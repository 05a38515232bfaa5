"""A written file is complete or absent, even after SIGKILL; URLs are read like local paths."""

import errno
import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import fsspec
import pytest

from run_fixtures import Popen
from vjepa2_ac import storage
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.files import remove_abandoned

WRITING = """
import sys, time
from pathlib import Path
from vjepa2_ac import storage
from vjepa2_ac.process import exit_on_signals
target = Path(sys.argv[1])
with exit_on_signals():
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


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def age(path: Path, days: float) -> None:
    for entry in (path, *path.rglob("*")):
        os.utime(entry, (time.time() - days * 86_400,) * 2)


# ---- one file ----


def test_file_appears_when_complete_and_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "inner" / "file"
    with storage.atomic_writer(target) as file:
        file.write("Grüße".encode())
        file.flush()
        assert not target.exists()

    def write_incompletely() -> None:
        with storage.atomic_writer(target) as file:
            file.write(b"new, but not ")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_incompletely()
    assert target.read_text(encoding="utf-8") == "Grüße"
    assert names(target.parent) == ["file"]
    storage.write_atomically(tmp_path / ("ü" * 127), "a long name")


def test_full_disk_error_names_the_file(tmp_path: Path) -> None:
    disk_full = OSError(errno.ENOSPC, "No space left on device")
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*a\.json'"),
        storage.atomic_writer(tmp_path / "a.json"),
    ):
        raise disk_full
    with (
        pytest.raises(InputError, match=r"^a: cannot be written: .*Free some space"),
        storage.translate_write_errors("a"),
    ):
        raise disk_full
    with pytest.raises(ConnectionResetError), storage.translate_write_errors("a"):
        raise ConnectionResetError(errno.ECONNRESET, "an error that is not related to writing")


# ---- a folder ----


def fill(folder: Path, *names: str) -> None:
    with storage.folder_writer(folder, "manifest") as partial:
        for name in names:
            storage.write_atomically(partial / name, name)


def test_new_folder_appears_complete_or_not_at_all(tmp_path: Path) -> None:
    def fail() -> None:
        with storage.folder_writer(tmp_path / "new", "manifest") as partial:
            (partial / "a").touch()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert names(tmp_path) == []
    fill(tmp_path / "deep" / "new", "a", "inner/b", "manifest")
    assert names(tmp_path / "deep" / "new") == ["a", "inner", "manifest"]


def test_existing_folder_keeps_its_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine").write_text("precious")
    (tmp_path / "manifest").write_text("old")
    before = tmp_path.stat().st_ino
    monkeypatch.chdir(tmp_path)
    fill(Path(), "inner/b", "manifest")
    assert tmp_path.stat().st_ino == before
    assert names(tmp_path) == ["inner", "manifest", "mine"]
    assert (tmp_path / "manifest").read_text() == "manifest"


def test_failed_move_leaves_no_manifest(tmp_path: Path) -> None:
    (tmp_path / "manifest").write_text("old")
    (tmp_path / "a").mkdir()  # in the way of the file `a`
    (tmp_path / "a" / "mine").write_text("precious")
    with pytest.raises(InputError, match=r"cannot be written: .*directory"):
        fill(tmp_path, "a", "manifest")
    assert names(tmp_path) == ["a"]


@pytest.mark.parametrize("name", ["file", "file/inner", "/proc/inner"])
def test_path_that_cannot_be_a_folder_raises(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=rf"{name}: cannot be written: .*Choose a path") as caught:
        fill(tmp_path / name, "manifest")
    assert caught.value.where == str(tmp_path / name)


# ---- interrupted writers ----


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_incomplete_file_never_has_its_final_name(tmp_path: Path, popen: Popen, kind: str, number: int) -> None:
    process = popen([sys.executable, "-c", WRITING, str(tmp_path / "target"), kind], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"writing\n"
    process.send_signal(number)
    assert process.wait(timeout=120) == -number
    remaining = names(tmp_path)
    assert len(remaining) == (number == signal.SIGKILL), "a writer that receives another signal removes its files"
    assert storage.is_empty(tmp_path)
    remove_abandoned.__wrapped__(tmp_path)
    assert names(tmp_path) == remaining, "another process may still write a recent file"
    for path in tmp_path.iterdir():
        age(path, days=1.1)
    remove_abandoned.__wrapped__(tmp_path)
    assert names(tmp_path) == []


def test_recent_folders_foreign_names_and_links_are_not_removed(tmp_path: Path) -> None:
    precious = tmp_path / ".f.0123abcd.partial"
    (precious / "inner").mkdir(parents=True)
    for name in (".a.partial", "a.0123abcd.partial", ".a.0123abcd.part", ".a.xyz.partial", "partial"):
        (tmp_path / name).touch()
    for path in tmp_path.iterdir():
        age(path, days=9)
    (precious / "inner" / "file").touch()
    (tmp_path / ".l.0123abcd.partial").symlink_to(precious / "inner")
    before = names(tmp_path)
    remove_abandoned.__wrapped__(tmp_path)
    assert names(tmp_path) == before
    assert (precious / "inner" / "file").exists()
    assert not storage.is_empty(tmp_path)


@pytest.mark.parametrize("jump_s", [-86_400.0, 0.9 * 86_400.0])
def test_partial_file_of_another_machine_survives_a_clock_jump(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jump_s: float
) -> None:
    path = tmp_path / ".file.abcdef01.partial"
    path.write_bytes(b"half")
    current_time_s = time.time()
    os.utime(path, (current_time_s, current_time_s))
    monkeypatch.setattr(time, "time", lambda: current_time_s + jump_s)
    remove_abandoned(tmp_path)
    assert path.exists()


# ---- reading ----


@pytest.fixture(params=["local", "memory"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Return a folder with two files, local or behind a URL."""
    path = str(tmp_path) if request.param == "local" else f"memory://{tmp_path.name}"
    filesystem = fsspec.filesystem("file" if request.param == "local" else "memory")
    for name, data in (("b", b"0123456789"), ("a", b"")):
        filesystem.pipe_file(storage.join(path, name), data)
    return path


def test_url_is_read_like_a_local_folder(folder: str) -> None:
    assert storage.list_names(folder) == ["a", "b"]
    file = storage.join(folder, "b")
    assert storage.exists(file)
    assert not storage.exists(storage.join(folder, "c"))
    assert storage.file_size(file) == 10
    assert storage.read_bytes(file) == storage.read_small_file(file, 10) == b"0123456789"
    with pytest.raises(InputError, match=r"too large.*at most 9 bytes"):
        storage.read_small_file(file, 9)
    assert storage.read_range(file, 3, 4) == b"3456"
    assert storage.read_range(file, 8, 4) == b"89"
    assert [(info.name, info.size) for info in storage.list_files(folder)] == [("a", 0), ("b", 10)]
    with closing(storage.open_for_reading(file)) as opened:
        opened.seek(4)
        assert (opened.read(2), opened.read()) == (b"45", b"6789")
    for read in (storage.read_bytes, storage.open_for_reading, storage.file_size):
        with pytest.raises(FileNotFoundError):
            read(storage.join(folder, "c"))
    assert storage.list_names(storage.join(folder, "none")) == []


def test_version_changes_with_the_file(folder: str) -> None:
    before = storage.list_files(folder)
    assert storage.list_files(folder) == before
    filesystem, file = fsspec.core.url_to_fs(storage.join(folder, "a"))
    filesystem.pipe_file(file, b"")
    assert [old.name for old, new in zip(before, storage.list_files(folder), strict=True) if old != new] == ["a"]


def test_pipe_or_device_raises_without_blocking(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="a pipe"):
        storage.read_small_file(tmp_path / "pipe", 10)
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match=r"too large.*at most 10 bytes"):
        storage.read_small_file(tmp_path / "sparse", 10)
