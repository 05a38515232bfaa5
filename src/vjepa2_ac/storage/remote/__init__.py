"""Remote storage: `ranged_reads` and `uploads` over networks that fail, with the policy of `retries`."""

from vjepa2_ac.storage.remote.ranged_reads import (
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
from vjepa2_ac.storage.remote.retries import RetryPolicy, quietly
from vjepa2_ac.storage.remote.uploads import file_sizes, remove_file, upload_file

__all__ = [
    "Entry",
    "RetryPolicy",
    "bytes_fetched",
    "exists",
    "file_size",
    "file_sizes",
    "file_version",
    "list_folder",
    "open_to_read",
    "quietly",
    "read_range",
    "read_ranges",
    "remove_file",
    "upload_file",
]
