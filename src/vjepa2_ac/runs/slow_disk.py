"""Messages while training waits for a disk that does not answer: a network disk may block for minutes.

A checkpoint and the metrics before it must be on the disk before training continues: the wait cannot be avoided. But a
run that stops without a message looks like one that hangs.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

logger = logging.getLogger(__name__)

STALLED_S = 60.0


@contextmanager
def warn_if_stalled(path: Path) -> Iterator[None]:
    """Warn if the block, which writes a file, lasts longer than a minute; and when it ends, how long it took."""
    patience_s, begun_s, is_over = STALLED_S, time.monotonic(), threading.Lock()

    def warn() -> None:
        if is_over.acquire(blocking=False):
            logger.warning("%s: the disk has not taken it for %g s; training waits for it", path, patience_s)

    timer = threading.Timer(patience_s, warn)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        if not is_over.acquire(blocking=False):
            timer.join()
            logger.warning("%s: the disk took it after %.0f s; training goes on", path, time.monotonic() - begun_s)
