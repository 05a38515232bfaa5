"""Quiet imports: what libraries log while transformers and PEFT import them is not for the user.

They tell of kernels for other devices that cannot be loaded, and of their own deprecations. They make half a million
objects that stay: nobody looks for garbage among them while they are imported, nor when the program ends. Looking there
took a third of the time of a program that does nothing else.
"""

from __future__ import annotations

import atexit
import gc
import logging
from collections.abc import Iterator
from contextlib import contextmanager

atexit.register(gc.freeze)


@contextmanager
def quiet_imports() -> Iterator[None]:
    """Let these libraries log errors only, from now on, and Python collect no garbage as long as the context lasts."""
    for name in ("bitsandbytes", "torchao", "torch.utils._pytree"):
        logging.getLogger(name).setLevel(logging.ERROR)
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
