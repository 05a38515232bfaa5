"""Libraries of extras: imported where data needs them, with the way out where they are missing."""

from __future__ import annotations

import importlib
from typing import Any

from vjepa2_ac.errors import UnreachableError, pip_install


def require_library(module: str, *, where: str, called: str, extra: str) -> Any:
    """Return a module that reads data.

    Args:
        module: Its name.
        where: What is read, for the message.
        called: What the library is called and does, such as "PyAV, which decodes video".
        extra: Of this package, which installs it.

    Raises:
        UnreachableError: It is not installed, which says nothing of the data: they are not broken.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise UnreachableError(where=where, found=f"{called}, is not installed", fix=pip_install(extra)) from None
