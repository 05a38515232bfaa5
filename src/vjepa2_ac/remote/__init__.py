"""How is data read that lies elsewhere, when networks fail now and then? `files` reads, `retries` does not give up."""

from vjepa2_ac.remote.files import (
    Entry,
    bytes_fetched,
    exists,
    file_size,
    file_version,
    list_folder,
    open_to_read,
    read_range,
    read_ranges,
)
from vjepa2_ac.remote.retries import RetryPolicy, UnreachableError

__all__ = [
    "Entry",
    "RetryPolicy",
    "UnreachableError",
    "bytes_fetched",
    "exists",
    "file_size",
    "file_version",
    "list_folder",
    "open_to_read",
    "read_range",
    "read_ranges",
]
