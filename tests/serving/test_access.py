"""Access to a server: only from this machine, or with the key."""

import logging
from pathlib import Path

import pytest

from vjepa2_ac.errors import InputError
from vjepa2_ac.serving.access import Access, is_loopback, read_key

KEY = "correct-horse-battery-staple"


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "robot.lab", ""])  # noqa: S104 - rejection
def test_reachable_address_requires_a_key_or_insecure(host: str) -> None:
    with pytest.raises(InputError, match="any of them could move the robot"):
        Access(host)
    assert Access(host, KEY).find_rejection("192.168.1.7:8000", f"Api-Key {KEY}") is None
    assert Access(host, is_insecure=True).find_rejection("192.168.1.7:8000", None) is None


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_loopback_address_requires_no_key(host: str) -> None:
    assert is_loopback(host)
    assert Access(host).find_rejection("127.0.0.1:8000", None) is None


@pytest.mark.parametrize(
    ("authorization", "status"),
    [
        (f"Api-Key {KEY}", None), (f"api-key {KEY}", None), (f"Bearer {KEY}", None), (f"Api-Key  {KEY} ", None),
        (None, 401), ("", 401), (KEY, 401), (f"Basic {KEY}", 401), (f"Api-Key {KEY}x", 401), ("Api-Key", 401),
        (f"Api-Key {KEY[:-1]}", 401), ("Api-Key \udcff", 401), (f"Api-Key {KEY.upper()}", 401),
    ],
)  # fmt: skip
def test_only_the_exact_key_is_accepted(authorization: str | None, status: int | None) -> None:
    rejection = Access("127.0.0.1", KEY).find_rejection("localhost:8000", authorization)
    assert (rejection and rejection[0]) == status
    assert KEY not in str(rejection)


@pytest.mark.parametrize(
    ("name", "is_known"),
    [
        ("localhost", True), ("localhost:8000", True), ("LOCALHOST:1", True), ("127.0.0.1:8000", True),
        ("[::1]:8000", True), ("[::1]", True), ("localhost:", True), ("[::1].evil.example", False), ("[::1", False),
        ("[::1]8000", False), ("[::1]:8000.evil", False), ("[localhost]", False), ("evil@127.0.0.1", False),
        ("localhost:80:80", False), ("localhost:evil", False), ("[evil.example]:80", False), ("[]", False),
        ("::1", True), ("10.0.0.3:80", True), ("robot.example:443", True), ("evil.example", False), (None, False),
        ("evil.example:8000", False), ("localhost.evil.example", False), ("", False), ("127.0.0.1.evil.example", False),
    ],
)  # fmt: skip
def test_unknown_host_name_is_rejected(name: str | None, is_known: bool) -> None:
    """A web page's domain may resolve to this machine; the header Host then contains its name."""
    rejection = Access("127.0.0.1", names=["Robot.example"]).find_rejection(name, None)
    assert (rejection is None) == is_known
    assert is_known or rejection[0] == 403


def test_key_is_the_first_line_of_its_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "key"
    file.write_text(f"{KEY}\nmore\n")
    file.chmod(0o600)
    assert read_key(file) == KEY
    assert not caplog.text
    file.chmod(0o644)
    with caplog.at_level(logging.WARNING):
        assert read_key(file) == KEY
    assert "other users of this machine can read the key" in caplog.text


@pytest.mark.parametrize(
    "content", [b"", b"\n", b"short\n", b"two words are not a key\n", "schlüsselschlüssel".encode(), b"\0" * 20]
)
def test_file_without_a_valid_key_raises(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "key").write_bytes(content)
    with pytest.raises(InputError, match="--key-file"):
        read_key(tmp_path / "key")
    with pytest.raises(InputError, match="No such file"):
        read_key(tmp_path / "none")
