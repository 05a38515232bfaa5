"""Silence what libraries log while transformers and PEFT import them, and pause garbage collection meanwhile.

The messages are about kernels for other devices that cannot be loaded, and about deprecations inside the libraries. The
imports create half a million objects that stay; searching them for garbage took a third of the time of a program that
does nothing else.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Iterator
from contextlib import contextmanager

_NAMES = ("bitsandbytes", "torchao", "torch.utils._pytree")


@contextmanager
def quiet_imports() -> Iterator[None]:
    """Let these libraries log errors only, and collect no garbage, within the context; then all is as it was."""
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in _NAMES}
    collects = gc.isenabled()
    gc.disable()
    for logger in levels:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)
        if collects:
            gc.enable()
