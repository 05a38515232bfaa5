"""Quiet imports: what libraries log while transformers and PEFT import them is not for the user.

They tell of kernels for other devices that cannot be loaded, and of their own deprecations. They make half a million
objects that stay: nobody looks for garbage among them while they are imported, nor when the program ends, where the
memory is given back as a whole. Looking there took a third of the time of a program that does nothing else.
"""

from __future__ import annotations

import atexit
import gc
import logging
from collections.abc import Iterator
from contextlib import contextmanager

_NOISY = ("bitsandbytes", "torchao", "torch.utils._pytree")

atexit.register(gc.freeze)


@contextmanager
def quiet_imports() -> Iterator[None]:
    """Let these libraries log errors only, and Python collect no garbage, as long as the context lasts."""
    collects = gc.isenabled()
    gc.disable()
    loggers = [logging.getLogger(name) for name in _NOISY]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
        if collects:
            gc.enable()
