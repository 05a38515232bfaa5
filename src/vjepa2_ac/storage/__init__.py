"""File access on this machine and behind URLs: listing, reading, writing and hashing."""

from vjepa2_ac.storage.files import (
    ByteReader,
    absolute,
    atomic_writer,
    exists,
    file_size,
    file_version,
    folder_writer,
    free_bytes,
    is_empty,
    is_refusal,
    join,
    list_files,
    list_folder,
    list_names,
    open_to_read,
    read_bounded,
    read_bytes,
    read_range,
    read_ranges,
    require_content,
    require_new_folder,
    sha256_of_file,
    sync,
    try_writing_at,
    unreadable,
    user_can_read,
    user_can_write,
    write_atomically,
)
from vjepa2_ac.storage.places import folder_at, is_url
from vjepa2_ac.storage.remote import FileInfo, bytes_fetched
from vjepa2_ac.storage.transfer import (
    download,
    file_sizes,
    files_below,
    remove,
    remove_folder,
    try_writing,
    upload,
    write,
)
