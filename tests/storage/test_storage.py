"""Storage: files are complete or absent, and URLs read like local paths."""

import errno
import hashlib
from contextlib import closing
from pathlib import Path

import fsspec
import pytest

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError


def test_a_file_that_fails_while_being_written_leaves_the_old_one(tmp_path: Path) -> None:
    target = tmp_path / "inner" / "file"
    storage.write_atomically(target, b"old")

    def write_half() -> None:
        with storage.atomic_writer(target) as file:
            file.write(b"new, but not ")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert target.read_bytes() == b"old"
    assert list(target.parent.iterdir()) == [target]


def test_a_file_does_not_have_its_name_before_it_is_whole(tmp_path: Path) -> None:
    target = tmp_path / "file"
    with storage.atomic_writer(target) as file:
        file.write(b"half")
        file.flush()
        assert not target.exists()
    assert target.read_bytes() == b"half"
    assert list(tmp_path.iterdir()) == [target]


def fill(folder: Path, *names: str) -> None:
    with storage.folder_writer(folder, "manifest") as partial:
        for name in names:
            storage.write_atomically(partial / name, name)


def test_a_folder_is_filled_whole_and_nothing_is_left_where_that_fails(tmp_path: Path) -> None:
    def fail() -> None:
        with storage.folder_writer(tmp_path / "new", "manifest") as partial:
            (partial / "a").touch()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert list(tmp_path.iterdir()) == []
    fill(tmp_path / "deep" / "new", "a", "inner/b", "manifest")
    assert storage.list_names(tmp_path / "deep" / "new") == ["a", "inner", "manifest"]


def test_a_folder_that_is_there_stays_itself_and_keeps_its_other_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine").write_text("precious")
    (tmp_path / "manifest").write_text("old")
    before = tmp_path.stat().st_ino
    monkeypatch.chdir(tmp_path)
    fill(Path(), "inner/b", "manifest")
    assert tmp_path.stat().st_ino == before
    assert storage.list_names(tmp_path) == ["inner", "manifest", "mine"]
    assert (tmp_path / "manifest").read_text() == "manifest"


def test_a_folder_in_which_moving_fails_has_no_manifest(tmp_path: Path) -> None:
    (tmp_path / "manifest").write_text("old")
    (tmp_path / "a").mkdir()  # where a file is to go
    (tmp_path / "a" / "mine").write_text("precious")
    with pytest.raises(InputError, match=r"cannot be written: .*directory"):
        fill(tmp_path, "a", "manifest")
    assert storage.list_names(tmp_path) == ["a"]


@pytest.mark.parametrize("place", ["file", "file/inner", "/proc/inner"])
def test_a_place_that_cannot_be_a_folder_is_named(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=rf"{place}: cannot be written: .*Name a place") as caught:
        fill(tmp_path / place, "manifest")
    assert caught.value.where == str(tmp_path / place)


def test_a_full_disk_is_called_one() -> None:
    with (
        pytest.raises(InputError, match=r"^a: cannot be written: No space left.*Free some space"),
        storage.user_can_write("a"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(ConnectionResetError), storage.user_can_write("a"):
        raise ConnectionResetError(errno.ECONNRESET, "not about writing")


def test_text_is_written_as_utf8(tmp_path: Path) -> None:
    storage.write_atomically(tmp_path / "file", "Grüße")
    assert (tmp_path / "file").read_text(encoding="utf-8") == "Grüße"


def test_a_hash_is_that_of_the_whole_file(tmp_path: Path) -> None:
    data = bytes(range(256)) * 10_000
    (tmp_path / "file").write_bytes(data)
    assert storage.sha256_of_file(tmp_path / "file") == hashlib.sha256(data).hexdigest()


@pytest.fixture(params=["local", "memory"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A folder with two files, on this machine and behind a URL."""
    place = str(tmp_path) if request.param == "local" else f"memory://{tmp_path.name}"
    filesystem = fsspec.filesystem("file" if request.param == "local" else "memory")
    for name, data in (("b", b"0123456789"), ("a", b"")):
        filesystem.pipe_file(storage.join(place, name), data)
    return place


def test_a_url_is_read_like_a_local_folder(folder: str) -> None:
    assert storage.list_names(folder) == ["a", "b"]
    file = storage.join(folder, "b")
    assert storage.exists(file)
    assert not storage.exists(storage.join(folder, "c"))
    assert storage.file_size(file) == 10
    assert storage.read_bytes(file) == b"0123456789"
    assert storage.read_range(file, 3, 4) == b"3456"
    assert storage.read_range(file, 8, 4) == b"89"
    assert storage.read_ranges(file, [(3, 4), (0, 1)]) == [b"3456", b"0"]
    with pytest.raises(storage.ShortReadError, match="2 of 4 bytes at 8"):
        storage.read_ranges(file, [(0, 1), (8, 4)])
    assert [(info.name, info.size) for info in storage.list_files(folder)] == [("a", 0), ("b", 10)]
    with closing(storage.open_to_read(file)) as opened:
        opened.seek(4)
        assert (opened.read(2), opened.read()) == (b"45", b"6789")
    for read in (storage.read_bytes, storage.open_to_read, storage.file_size):
        with pytest.raises(FileNotFoundError):
            read(storage.join(folder, "c"))


def test_a_file_that_changes_has_another_version(folder: str) -> None:
    before = storage.list_files(folder)
    assert storage.list_files(folder) == before
    filesystem, file = fsspec.core.url_to_fs(storage.join(folder, "a"))
    filesystem.pipe_file(file, b"")
    assert [old.name for old, new in zip(before, storage.list_files(folder), strict=True) if old != new] == ["a"]


def test_a_folder_that_is_not_there_has_no_files(tmp_path: Path) -> None:
    assert storage.list_names(tmp_path / "none") == []
    assert storage.list_names("memory://none-at-all") == []


def test_a_full_disk_says_of_which_file(tmp_path: Path) -> None:
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*figures\.json'"),
        storage.atomic_writer(tmp_path / "figures.json"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
