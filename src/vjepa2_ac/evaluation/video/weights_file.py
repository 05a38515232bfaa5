"""Files of weights that a user names: read once, and used only if their SHA-256 is the known one."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from vjepa2_ac.errors import InputError


@dataclass(frozen=True)
class WeightsFile:
    """A file as it was named."""

    path: Path
    option: str  # that names it, for messages: --i3d
    what: str  # the file should be, for messages

    def known(self, hashes: Mapping[str, str]) -> tuple[str, BytesIO]:
        """Return which one of the known files it is, and its content.

        Args:
            hashes: What the SHA-256 of each known file begins with, by its name: all 64 hexadecimal digits; or the
                first ones, where a file's own name gives no more.

        Raises:
            InputError: There is no such file, or it is another one.
        """
        begins = " or ".join(digits[:16] for digits in hashes.values())
        fix = f"Give {self.option} the path of the file whose SHA-256 begins with {begins}; docs/decoding.md says where"
        try:
            content = self.path.read_bytes()
        except OSError as error:
            raise self.error(f"cannot be read ({error.strerror})", fix=fix) from None
        found = hashlib.sha256(content).hexdigest()
        for name, digits in hashes.items():
            if digits and found.startswith(digits.lower()):
                return name, BytesIO(content)
        raise self.error(f"a file of SHA-256 {found[:16]}", fix=fix)

    def error(self, found: str, *, needed: str = "", fix: str = "") -> InputError:
        """Return the error of a file that cannot be used."""
        return InputError(where=f"{self.option} {self.path}", found=found, needed=needed or self.what, fix=fix)
