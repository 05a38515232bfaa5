"""Remote reads: retries, errors and logins, tested with a real server that fails on request."""

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from google.auth.exceptions import RefreshError

from gcs import Failure, Gcs
from vjepa2_ac import storage
from vjepa2_ac.errors import InputError, UnreachableError, pip_install
from vjepa2_ac.storage import remote, retries
from vjepa2_ac.storage.retries import RetryPolicy, call_with_retries

DATA = bytes(range(256)) * 400
FILE = "gs://bucket/folder/file"


@pytest.fixture
def file(gcs: Gcs) -> str:
    gcs.put("bucket/folder/other", b"12345")
    return gcs.put("bucket/folder/file", DATA)


@pytest.mark.parametrize("failure", [408, 502, "reset", "cut"])
@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (lambda: storage.file_size(FILE), len(DATA)),
        (lambda: storage.exists(FILE), True),
        (lambda: storage.list_names("gs://bucket/folder"), ["file", "other"]),
        (lambda: [file.size for file in storage.list_files("gs://bucket/folder")], [len(DATA), 5]),
        (lambda: storage.read_bytes(FILE), DATA),
        (lambda: storage.read_ranges(FILE, [(0, 5), (256, 3)]), [DATA[:5], DATA[256:259]]),
        (lambda: storage.open_for_reading(FILE).read(), DATA),
    ],
    ids=["file_size", "exists", "list_names", "list_files", "read_bytes", "read_ranges", "open_for_reading"],
)
@pytest.mark.usefixtures("file")
def test_all_reads_survive_temporary_failures(
    gcs: Gcs, action: Callable[[], object], expected: object, failure: Failure
) -> None:
    gcs.fail_next(failure, times=2)
    assert action() == expected
    assert gcs.faults_left == 0


def test_unresponsive_server_is_retried(gcs: Gcs, file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Further attempts, because a busy machine may exceed the time-out.
    monkeypatch.setattr(retries, "DEFAULT", retries.RetryPolicy(attempts=100, first_wait_s=0.0, timeout_s=0.3))
    gcs.fail_next("hang", match="/download/")
    assert storage.read_range(file, 0, 5) == DATA[:5]
    monkeypatch.setattr(retries, "DEFAULT", retries.RetryPolicy(attempts=2, first_wait_s=0.0, timeout_s=0.3))
    gcs.fail_next("hang", times=100, match="/download/")
    with pytest.raises(UnreachableError, match=r"2 attempts in \d s failed\. Last error: time-out"):
        storage.read_range(file, 0, 5)


@pytest.mark.parametrize(
    ("failure", "message"), [(503, "HTTP 503: made to fail"), (429, "HTTP 429"), ("reset", "Disconnected")]
)
def test_failed_retries_raise_with_attempts_url_and_reason(gcs: Gcs, file: str, failure: Failure, message: str) -> None:
    gcs.fail_next(failure, times=100, match="/download/")
    with pytest.raises(UnreachableError, match=rf"^{file}: 5 attempts in .* failed.*{message}.*Check the net"):
        storage.read_range(file, 0, 5)
    attempts = 5 if failure != "reset" else 10  # aiohttp retries at once if a reused connection was closed
    assert len(gcs.reads()) <= attempts, "gcsfs does not retry each attempt six times"


@pytest.mark.parametrize("status", [401, 403])
def test_missing_permission_raises_at_once_with_the_login_command(gcs: Gcs, file: str, status: int) -> None:
    gcs.fail_next(status, times=100)
    with pytest.raises(UnreachableError, match=rf"no permission \(HTTP {status}.*gcloud auth application-def"):
        storage.read_range(file, 0, 5)
    assert len(gcs.requests) == 1


def test_missing_file_raises_without_retry(gcs: Gcs, file: str) -> None:
    with pytest.raises(FileNotFoundError):
        storage.read_range(f"{file}.none", 0, 5)
    assert len(gcs.reads()) == 1
    assert not storage.exists(f"{file}.none")
    assert storage.exists("gs://bucket/folder")
    assert storage.list_names("gs://bucket/none") == []
    assert storage.list_files("gs://bucket/none") == []
    with pytest.raises(FileNotFoundError):
        storage.open_for_reading(f"{file}.none")


def test_read_past_the_end_returns_the_rest(gcs: Gcs, file: str) -> None:
    size = len(DATA)
    assert storage.read_range(file, size - 3, 10) == DATA[-3:]
    assert storage.read_range(file, size + 3, 10) == b""
    gcs.fail_next(416, match="/download/")  # as Google Cloud Storage responds
    assert storage.read_range(file, size, 10) == b""
    assert storage.read_range(file, 0, 0) == b""
    with pytest.raises(remote.ShortReadError, match=f"3 of 10 bytes at {size - 3}"):
        storage.read_ranges(file, [(0, 4), (size - 3, 10)])


def test_ranges_are_read_concurrently_and_returned_in_order(gcs: Gcs, file: str) -> None:
    ranges = [(start, 3) for start in range(0, 9600, 100)]
    gcs.hold(33, match="/download/")
    assert storage.read_ranges(file, ranges) == [DATA[start : start + 3] for start, _ in ranges]
    assert gcs.most_in_flight >= 33
    assert len(gcs.reads()) == len(ranges)


def test_long_read_is_split_into_parts(gcs: Gcs, file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vjepa2_ac.storage.remote._PART_BYTES", 1000)
    assert storage.read_bytes(file) == DATA
    assert len(gcs.reads()) == -(-len(DATA) // 1000)
    assert storage.read_ranges(file, [(5, 2500), (7, 3)]) == [DATA[5:2505], DATA[7:10]]


def test_folder_listing_has_sizes_and_versions(gcs: Gcs) -> None:
    for number in range(100):
        gcs.put(f"bucket/set/{number:03d}", bytes(number))
    gcs.put("bucket/set/inner/file", b"1")
    files = storage.list_files("gs://bucket/set/")
    assert [(file.name, file.size) for file in files] == [(f"{number:03d}", number) for number in range(100)]
    assert storage.list_names("gs://bucket/set")[-1] == "inner"
    assert len(gcs.requests) == 2
    gcs.put("bucket/set/007", bytes(7))
    changed = [new.name for old, new in zip(files, storage.list_files("gs://bucket/set"), strict=True) if old != new]
    assert changed == ["007"]


def test_forked_process_opens_its_own_file_system(file: str) -> None:
    code = (
        "import multiprocessing, sys; from vjepa2_ac import storage\n"
        "def read(start): return storage.read_range(sys.argv[1], start, 3)\n"
        "if __name__ == '__main__':\n"
        "    assert read(0) == bytes([0, 1, 2])\n"
        "    import concurrent.futures as futures\n"
        "    for method in ('forkserver', 'fork'):\n"
        "        with futures.ProcessPoolExecutor(1, multiprocessing.get_context(method)) as pool:\n"
        "            assert pool.submit(storage.read_range, sys.argv[1], 5, 3).result(30) == bytes([5, 6, 7]), method\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code, file], check=True, timeout=120)


def test_unknown_protocol_raises() -> None:
    with pytest.raises(InputError, match=r"unknown protocol ftpx://.*gs://, hf:// or s3://"):
        storage.exists("ftpx://host/file")


@pytest.mark.parametrize(("url", "extra"), [("gs://bucket/set", "gcs"), ("hf://datasets/one/set", "")])
def test_missing_protocol_library_raises_with_the_extra(url: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.import_module("fsspec.registry"), "registry", {})
    monkeypatch.setattr(remote, "_filesystems", {})
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(InputError, match=rf"is not installed\. Install it: {re.escape(pip_install(extra))}"):
        storage.exists(url)


# ---- logins ----


@pytest.fixture
def no_google_login(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Simulate a machine without any login, and return the folder of its files."""
    for name in ("STORAGE_EMULATOR_HOST", "GOOGLE_APPLICATION_CREDENTIALS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CLOUDSDK_CONFIG", str(tmp_path))
    monkeypatch.setattr(remote, "_PRODUCT_NAME_FILE", tmp_path / "product_name")
    return tmp_path


def test_google_token_is_user_machine_or_anonymous(no_google_login: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert remote.google_token() == "anon"
    assert remote.login_hint("gs://a/b").startswith("You are not logged in. Log in with `gcloud auth application-de")
    (no_google_login / "product_name").write_text("Some other machine\n")
    assert remote.google_token() == "anon"
    (no_google_login / "product_name").write_text("Google Compute Engine\n")
    assert remote.google_token() == "cloud"
    (no_google_login / "application_default_credentials.json").write_text("{}")
    assert remote.google_token() == "google_default"
    assert remote.login_hint("gcs://a/b").startswith("Log in with `gcloud")
    (no_google_login / "application_default_credentials.json").unlink()
    monkeypatch.setenv("GOOGLE_APPLICATION_CREDENTIALS", "key.json")
    assert remote.google_token() == "google_default"
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", "http://127.0.0.1:1")
    assert remote.google_token() == "anon", "an emulator never receives a login"


def test_login_hint_matches_the_protocol() -> None:
    assert "hf auth login" in remote.login_hint("hf://datasets/owner/name")
    assert remote.login_hint("https://host/file") == "Check your login"


NO_WAIT = RetryPolicy(attempts=3, first_wait_s=0.0, longest_wait_s=0.0)


@pytest.mark.parametrize("error", [TypeError("ours"), KeyError("ours"), AssertionError("ours")])
def test_programming_error_is_not_retried(error: Exception) -> None:
    calls = []

    def action(timeout_s: float) -> None:
        calls.append(timeout_s)
        raise error

    with pytest.raises(type(error), match="ours"):
        call_with_retries("gs://a", action, policy=NO_WAIT, access="")
    assert calls == [NO_WAIT.timeout_s]


class StatusError(Exception):
    def __init__(self, status: int) -> None:
        super().__init__("text of another library")
        self.response = type("Response", (), {"status_code": status})()


class NoCredentialsError(Exception):
    """The error of botocore for missing credentials."""


@pytest.mark.parametrize(
    ("error", "attempts", "message"),
    [
        (ConnectionResetError("gone"), 3, "3 attempts in .* failed"),
        (OSError(5, "text of an unknown library"), 3, "3 attempts in .* failed"),
        (TimeoutError(), 3, "Last error: time-out"),
        (StatusError(503), 3, "HTTP 503: text of another library"),
        (json.JSONDecodeError("Unterminated string", '{"items": [{"na', 12), 3, "JSONDecodeError: Unterminated"),
        (RefreshError("the login service is down", retryable=True), 3, "the login service is down"),
        (RefreshError("invalid_grant: expired"), 1, "no permission.*expired.*Log in so"),
        (NoCredentialsError("none found"), 1, "no permission.*none found.*Log in so"),
        (StatusError(403), 1, r"no permission \(HTTP 403"),
        (PermissionError("not yours"), 1, "no permission.*Log in so"),
        (OSError("Forbidden: https://somewhere\nno"), 1, r"no permission \(HTTP 403: Forbidden.*Log in so"),
        (ValueError("Bad Request"), 1, "cannot be read.*Bad Request.*Check the URL"),
    ],
)
def test_library_errors_are_classified(error: Exception, attempts: int, message: str) -> None:
    calls = []

    def action(timeout_s: float) -> None:
        calls.append(timeout_s)
        raise error

    with pytest.raises(UnreachableError, match=message) as caught:
        call_with_retries("gs://a", action, policy=NO_WAIT, access="Log in so")
    assert len(calls) == attempts
    assert caught.value.__cause__ is error
    assert "\n" not in str(caught.value)


def test_lasting_network_failure_logs_one_warning(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def action(_timeout_s: float) -> None:
        raise ConnectionResetError("gone")

    def count_warnings(attempts: int) -> int:
        caplog.clear()
        policy = RetryPolicy(attempts=attempts, first_wait_s=0.0, longest_wait_s=0.0)
        with pytest.raises(UnreachableError):
            call_with_retries("gs://a/b", action, policy=policy, access="")
        return sum(record.levelname == "WARNING" for record in caplog.records)

    monkeypatch.setattr(retries, "_last_warning_s", [float("-inf")])
    assert count_warnings(attempts=3) == 0  # two failures cause no warning
    with retries.suppress_retry_warnings():
        assert count_warnings(attempts=6) == 0  # within `suppress_retry_warnings`
    assert count_warnings(attempts=6) == 1
    assert count_warnings(attempts=6) == 0  # the warning was logged less than 30 s ago
