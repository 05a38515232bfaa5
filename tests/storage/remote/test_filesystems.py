"""Google login: the user where there is one, anonymous otherwise."""

import re
from pathlib import Path

import pytest

from vjepa2_ac.errors import InputError, pip_install
from vjepa2_ac.storage.remote import filesystems


@pytest.fixture(autouse=True)
def nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A machine without any login."""
    for name in ("STORAGE_EMULATOR_HOST", "GOOGLE_APPLICATION_CREDENTIALS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CLOUDSDK_CONFIG", str(tmp_path))
    monkeypatch.setattr(filesystems, "_MACHINE", tmp_path / "product_name")


def test_without_a_login_google_is_asked_anonymously() -> None:
    assert filesystems.google_token() == "anon"
    assert filesystems.login_hint("gs://a/b").startswith(
        "You are not logged in. Log in with `gcloud auth application-de"
    )


def test_a_default_login_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "application_default_credentials.json").write_text("{}")
    assert filesystems.google_token() == "google_default"
    assert filesystems.login_hint("gcs://a/b").startswith("Log in with `gcloud")
    (tmp_path / "application_default_credentials.json").unlink()
    monkeypatch.setenv("GOOGLE_APPLICATION_CREDENTIALS", "key.json")
    assert filesystems.google_token() == "google_default"


def test_a_machine_of_google_asks_as_itself(tmp_path: Path) -> None:
    (tmp_path / "product_name").write_text("Google Compute Engine\n")
    assert filesystems.google_token() == "cloud"
    (tmp_path / "product_name").write_text("Some other machine\n")
    assert filesystems.google_token() == "anon"


def test_an_emulator_is_shown_no_login(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GOOGLE_APPLICATION_CREDENTIALS", "key.json")
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", "http://127.0.0.1:1")
    assert filesystems.google_token() == "anon"


def test_the_way_in_is_that_of_the_place() -> None:
    assert "hf auth login" in filesystems.login_hint("hf://datasets/owner/name")
    assert filesystems.login_hint("https://host/file") == "Check the login"


@pytest.mark.parametrize(("url", "extra"), [("gs://bucket/set", "gcs"), ("hf://datasets/one/set", "")])
def test_a_missing_library_is_named_with_the_extra_that_brings_it(
    url: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(protocol: str) -> None:
        raise ImportError(f"Unable to load filesystem from EntryPoint(name={protocol!r})")

    monkeypatch.setattr("fsspec.get_filesystem_class", absent)
    monkeypatch.setattr(filesystems, "_filesystems", {})
    with pytest.raises(InputError, match=rf"is not installed\. Install it: {re.escape(pip_install(extra))}"):
        filesystems.ask(url, "info", 1.0)
