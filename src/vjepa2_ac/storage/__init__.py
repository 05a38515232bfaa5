"""File access on this machine and behind URLs: listing, reading, writing and hashing."""

from vjepa2_ac.storage.files import (
    ByteReader,
    atomic_writer,
    canonical_path,
    check_local_writable,
    exists,
    file_size,
    file_version,
    folder_writer,
    free_bytes,
    is_empty,
    is_os_read_error,
    join,
    list_files,
    list_folder,
    list_names,
    open_for_reading,
    read_bytes,
    read_error,
    read_range,
    read_ranges,
    read_small_file,
    require_new_folder,
    require_regular_file,
    sha256_of_file,
    sync,
    translate_read_errors,
    translate_write_errors,
    write_atomically,
)
from vjepa2_ac.storage.paths import is_url, parse_folder
from vjepa2_ac.storage.remote import FileInfo, bytes_fetched
from vjepa2_ac.storage.transfer import (
    check_writable,
    download,
    file_sizes,
    list_files_below,
    remove,
    remove_folder,
    upload,
    write,
)
