"""File access on this machine and behind URLs: listing, reading, writing and hashing."""

from vjepa2_ac.places import is_url
from vjepa2_ac.storage.reading import (
    ByteReader,
    ShortReadError,
    absolute,
    exists,
    file_size,
    file_version,
    join,
    list_files,
    list_names,
    open_to_read,
    read_bounded,
    read_bytes,
    read_range,
    read_ranges,
    sha256_of_file,
    unreadable,
)
from vjepa2_ac.storage.remote.ranged_reads import FileInfo, bytes_fetched
from vjepa2_ac.storage.transfer import download, file_sizes, place, remove, remove_folder, try_writing, upload
from vjepa2_ac.storage.writing import (
    atomic_writer,
    folder_writer,
    free_bytes,
    is_empty,
    require_new_folder,
    sync,
    try_writing_at,
    user_can_write,
    write_atomically,
)
