"""Reading parts of a shard that may change meanwhile."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from vjepa2_ac import storage
from vjepa2_ac.data.sources.rlds.dataset_info import Shard
from vjepa2_ac.data.sources.rlds.wire_format import Read
from vjepa2_ac.errors import InputError, UserError


@contextmanager
def open_shard(shard: Shard) -> Iterator[Read]:
    """Open a local shard for random access, also from several threads.

    Nothing is mapped into memory: a file that is truncated during use gives short reads, not a crash.

    Raises:
        InputError: The file cannot be read, or has changed since the data set was opened.
    """
    try:
        handle = os.open(shard.path, os.O_RDONLY)
    except OSError as error:
        raise unreadable(shard, error) from None
    try:
        found = os.fstat(handle)
        if (found.st_size, str(found.st_mtime_ns)) != (shard.size, shard.version):
            raise InputError(
                where=shard.path,
                found=f"{found.st_size:,} bytes: it has changed since the data set was opened",
                needed=f"the file of {shard.size:,} bytes that was there",
                fix="Start again",
            )
        yield lambda offset, length: os.pread(handle, length, offset)
    except OSError as error:
        raise unreadable(shard, error) from None
    finally:
        os.close(handle)


def unreadable(shard: Shard, error: OSError) -> UserError:
    """Return the error of a file that the system refuses to read."""
    return storage.unreadable(shard.path, error, needed="a TFRecord file")
