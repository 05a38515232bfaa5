"""Files of weights that a user names: read once, and used only if their SHA-256 is the known one."""

from __future__ import annotations

import hashlib
from io import BytesIO
from pathlib import Path

from vjepa2_ac.errors import InputError


def checked_file(path: Path, sha256: str, what: str) -> BytesIO:
    """Return the content of a file whose SHA-256 begins with the given digits.

    Args:
        path: The file.
        sha256: All 64 hexadecimal digits; or the first ones, where a file's own name gives no more.
        what: What the file should be, for the message.

    Raises:
        InputError: There is no such file, or it is another one.
    """
    fix = f"Give the path of {what}, whose SHA-256 begins with {sha256[:16]}"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(where=str(path), found=f"cannot be read ({error.strerror})", needed=what, fix=fix) from None
    found = hashlib.sha256(content).hexdigest()
    if not sha256 or not found.startswith(sha256.lower()):
        raise InputError(where=str(path), found=f"a file of SHA-256 {found[:16]}", needed=what, fix=fix)
    return BytesIO(content)
