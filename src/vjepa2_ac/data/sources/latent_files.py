"""The files of a latent cache, and the precision of its latents.

cache.json     the full key of the cache
episodes.npz   all episodes of the encoded data set, in its order, as `EpisodeTable.to_bytes` writes them
kept.npz       the steps that `data.idle` keeps, as `StepSelection.to_bytes` writes them; absent without an idle rule
episodes/000/000123-CAMERA.safetensors   the latents of an episode, by its index, and a camera
episodes/000/000123-CAMERA.broken        instead of latents, the reason why the episode cannot be read (see
                                         `data.broken_episodes`)

All files are written atomically, also behind a URL. A cache is finished when each episode that clips need has a file
for each camera. A file of latents has these tensors (`steps`: control steps of the episode; `frames`: encoded steps):

latents        [frames, tokens, dim] bfloat16, float32 or int8
scales         [frames, tokens] float32, with int8 only: latent = value * scale of the token
frame_steps    [frames] int32: the control step of each frame, ascending
states         [steps, state_dim], and if the source has them commands, extrinsics, joint_velocities
pictures       the encoder's input images: [bytes] uint8, concatenated JPEGs for display; or [frames, size, size, 3]
               uint8, lossless, to train a decoder
picture_ends   [frames] int64: the end of each JPEG in `pictures`

The header's metadata (strings): id, camera, metadata (JSON), key (the digest of the cache's key).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from math import prod
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from safetensors.torch import save
from torch import Tensor

from vjepa2_ac import storage
from vjepa2_ac.episode import Episode, StoredLatents
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import decode_images, encode_jpeg
from vjepa2_ac.storage.block_file import DiskCache, cached_ranges
from vjepa2_ac.storage.structured import MAX_BYTES, parse_json_object

CacheType = Literal["bf16", "fp32", "int8"]

DTYPES: dict[CacheType, torch.dtype] = {"bf16": torch.bfloat16, "fp32": torch.float32, "int8": torch.int8}
OPTIONAL = ("commands", "extrinsics", "joint_velocities")
Ranges = Sequence[tuple[int, int]]  # (start, length) in bytes

_MAX_INT8 = 127  # largest quantised value
_JPEG_QUALITY = 85
_HEAD_BYTES = 32 << 10  # bytes read when a file is opened: the header and most small tensors
_LENGTH_BYTES = 8  # size of the number that precedes the header and states the header's length
_TENSOR_TYPES = {
    "BF16": torch.bfloat16, "F16": torch.float16, "F32": torch.float32, "F64": torch.float64, "BOOL": torch.bool,
    "U8": torch.uint8, "I8": torch.int8, "I16": torch.int16, "I32": torch.int32, "I64": torch.int64,
}  # fmt: skip
_LATENTS_SUFFIX, _BROKEN_SUFFIX = ".safetensors", ".broken"
FIX = "Delete this file and run the `vjepa2-ac encode` command of this cache again, or copy the file again"


def pack_latents(latents: Float[Tensor, "*batch tokens dim"], kind: CacheType) -> StoredLatents:
    """Convert latents to a storage type.

    bf16 rounds to nearest, with an error of at most 2**-8 of the value. int8 divides each token by a scale, its largest
    absolute value over 127, with an error of at most half a scale. fp32 is exact.
    """
    if kind != "int8":
        return StoredLatents(latents.to(DTYPES[kind]))
    latents = latents.float()
    scales = latents.abs().amax(dim=-1) / _MAX_INT8
    divisor = torch.where(scales > 0, scales, torch.ones_like(scales))  # a token of zeros stays zero
    values = (latents / divisor[..., None]).round().clamp(-_MAX_INT8, _MAX_INT8)
    return StoredLatents(values.to(torch.int8), scales)


def unpack_latents(stored: StoredLatents) -> Float[Tensor, "*batch tokens dim"]:
    """Convert stored latents to float32, which equals the encoder's output up to the rounding of `pack_latents`."""
    values = stored.values.float()
    return values if stored.scales is None else values * stored.scales[..., None]


def bytes_per_frame(tokens: int, dim: int, kind: CacheType) -> int:
    """Return the size of a frame's latents in bytes."""
    return tokens * dim * DTYPES[kind].itemsize + (tokens * 4 if kind == "int8" else 0)


@dataclass(frozen=True, eq=False)
class EncodedEpisode:
    """An episode with the latents of frames of one camera."""

    episode: Episode  # provides states and other data of clips; its frames are not read
    camera: str
    steps: Sequence[int]  # control steps of the frames, ascending; may be empty
    latents: StoredLatents  # latents of these frames, from `pack_latents`
    images: UInt8[np.ndarray, "frames size size 3"]  # the encoder's input images of these frames


@dataclass(frozen=True)
class LatentFiles:
    """The files of the episodes in a cache's folder. Several processes may write into the folder.

    A folder behind a URL is listed once, when the first file is looked up.
    """

    folder: Path | str  # local folder or URL
    key: str  # digest of the cache's key
    cache: DiskCache | None = None  # disk cache of remote data, required for a URL

    def path(self, number: int, camera: str) -> str:
        """Return the path of the file of an episode (by its index in the data set) and a camera."""
        return storage.join(self.folder, _file_name(number, camera))

    def has_file(self, number: int, camera: str) -> bool:
        """Return whether a file exists, is complete and belongs to this cache, by reading its header.

        Raises:
            UnreachableError: The file cannot be read now.
        """
        try:
            self.open(number, camera)
        except InputError:
            return False
        return True

    def get_file_size(self, number: int, camera: str) -> int:
        """Return the size of a file in bytes; 0 if the file is missing."""
        file = self._find_file(_file_name(number, camera))
        return 0 if file is None else file.size

    def find_missing(self, numbers: Sequence[int], cameras: Sequence[str]) -> list[int]:
        """Return the episodes that have neither a file of latents nor a `.broken` file for some camera.

        The folder is listed once and no file is opened, so a damaged file is reported when it is first read.

        Raises:
            UnreachableError: The folder cannot be listed now.
        """
        sizes = self._list_sizes()
        stems = {name.rpartition(".")[0] for name, size in sizes.items() if size > 0 or name.endswith(_BROKEN_SUFFIX)}
        return [number for number in numbers if any(_file_name(number, camera, "") not in stems for camera in cameras)]

    def is_done(self, number: int, camera: str) -> bool:
        """Return whether a file of latents or a `.broken` file exists; behind a URL only the listing is checked."""
        is_present = (
            self.get_file_size(number, camera) > 0 if storage.is_url(self.folder) else self.has_file(number, camera)
        )
        return is_present or self._find_file(_file_name(number, camera, _BROKEN_SUFFIX)) is not None

    def open(self, number: int, camera: str) -> EpisodeFile:
        """Open the file of an episode and camera.

        Raises:
            InputError: The file is missing, damaged, or belongs to another cache; or the episode could not be read.
            UnreachableError: The file cannot be read now.
        """
        path, file = self.path(number, camera), self._find_file(_file_name(number, camera))
        broken_file = _file_name(number, camera, _BROKEN_SUFFIX)
        if file is None and self._find_file(broken_file) is not None:
            reason = self._read_reason(broken_file).rstrip(".")
            raise InputError(where=path, found=f"no latents, because encoding could not read the episode ({reason})")
        if file is None:
            raise InputError(where=path, found="no such file", needed="latents of an episode", fix=FIX)
        if self.cache is None:
            return EpisodeFile(path, self.key, file.size, partial(storage.read_ranges, path))
        key = f"{path} {file.version} {file.size}"
        return EpisodeFile(path, self.key, file.size, partial(cached_ranges, path, key=key, cache=self.cache))

    def write(self, number: int, encoded: EncodedEpisode, *, lossless_images: bool = False) -> None:
        """Write the file of an episode and camera.

        Raises:
            InputError: The file cannot be written, or the disk is full.
            UnreachableError: The URL cannot be written.
        """
        episode, latents, camera = encoded.episode, encoded.latents, encoded.camera
        arrays = {
            "frame_steps": np.array(encoded.steps, np.int32),
            "states": episode.states,
            **{name: getattr(episode, name) for name in OPTIONAL},
        }
        if lossless_images:
            arrays["pictures"] = encoded.images
        else:
            jpegs = [encode_jpeg(frame, quality=_JPEG_QUALITY) for frame in encoded.images]
            arrays["pictures"] = np.frombuffer(b"".join(jpegs), np.uint8)
            arrays["picture_ends"] = np.cumsum([len(jpeg) for jpeg in jpegs], dtype=np.int64)
        tensors = {
            name: torch.from_numpy(np.array(array, order="C")) for name, array in arrays.items() if array is not None
        }
        tensors["latents"] = latents.values.contiguous()
        if latents.scales is not None:
            tensors["scales"] = latents.scales.contiguous()
        metadata = json.dumps(dict(episode.metadata), sort_keys=True)
        header = {"id": episode.info.id, "camera": encoded.camera, "metadata": metadata, "key": self.key}
        storage.write(self.path(number, camera), save(tensors, metadata=header))
        if self._find_file(broken_file := _file_name(number, camera, _BROKEN_SUFFIX)) is not None:
            storage.remove(storage.join(self.folder, broken_file))

    def record_broken(self, number: int, camera: str, reason: str) -> None:
        """Record that an episode cannot be read, for other processes and for readers of the cache."""
        storage.write(storage.join(self.folder, _file_name(number, camera, _BROKEN_SUFFIX)), reason)

    @property
    def broken_reasons(self) -> dict[int, str]:
        """The reason why each broken episode could not be read, by the index of the episode."""
        sizes = self._list_sizes()
        names = sorted(name for name in sizes if name.endswith(_BROKEN_SUFFIX))
        # A `.broken` file next to latents is outdated, because the episode was encoded later.
        broken = [name for name in names if name.removesuffix(_BROKEN_SUFFIX) + _LATENTS_SUFFIX not in sizes]
        return {int(name.rpartition("/")[2].partition("-")[0]): self._read_reason(name) for name in broken}

    def _list_sizes(self) -> Mapping[str, int]:
        """Return the size of every file in bytes, by its path in the folder; a local folder is listed on every call."""
        if storage.is_url(self.folder):
            return {name: file.size for name, file in self._remote_files.items()}
        return storage.file_sizes(str(self.folder))

    @cached_property
    def _remote_files(self) -> Mapping[str, storage.FileInfo]:
        return storage.list_files_below(str(self.folder))

    def _find_file(self, name: str) -> storage.FileInfo | None:
        if storage.is_url(self.folder):
            return self._remote_files.get(name)
        with suppress(FileNotFoundError, NotADirectoryError):
            return storage.FileInfo(name, Path(self.folder, name).stat().st_size, "")
        return None

    def _read_reason(self, name: str) -> str:
        return storage.read_bytes(storage.join(self.folder, name)).decode(errors="replace")


def _file_name(number: int, camera: str, ending: str = _LATENTS_SUFFIX) -> str:
    return f"episodes/{number // 1000:03d}/{number:06d}-{quote(camera, safe='')}{ending}"


class EpisodeFile:
    """An open file of latents, of which only the requested frames are read.

    The safetensors format is parsed here, because the library cannot read parts of remote files.

    Args:
        path: The file.
        key: Digest of the key of its cache.
        size: Size of the file in bytes.
        read: Returns the bytes of several ranges (start, length) of the file, all complete.

    Raises:
        InputError: The file is missing, damaged, or belongs to another cache.
        UnreachableError: The file cannot be read now.
    """

    def __init__(self, path: str, key: str, size: int, read: Callable[[Ranges], list[bytes]]) -> None:
        self.path, self._read, self._head = path, read, b""
        with self._translate_errors():
            self._head = self._read_pieces([(0, min(size, _HEAD_BYTES))])[0]
            begin = _LENGTH_BYTES + int.from_bytes(self._head[:_LENGTH_BYTES], "little")
            if not _LENGTH_BYTES < begin <= min(size, MAX_BYTES):
                raise ValueError("the header is missing")
            header = parse_json_object(self._read_pieces([(_LENGTH_BYTES, begin - _LENGTH_BYTES)])[0], where=path)
            metadata = header.pop("__metadata__", {})
            self._tensors = {name: _Tensor.from_header(entry, begin) for name, entry in header.items()}
            if (end := max([begin, *(tensor.end for tensor in self._tensors.values())])) != size:
                raise ValueError(f"{size:,} bytes instead of {end:,}")
            self.metadata = {
                name: str(text) for name, text in parse_json_object(metadata["metadata"], where=path).items()
            }
        self.names = self._tensors.keys()
        if metadata.get("key") != key:
            raise self._damage_error("the file belongs to another cache", "a file with the key of this cache.json")

    @cached_property
    def frame_steps(self) -> Int[np.ndarray, " frames"]:
        """The control steps that have a frame, ascending."""
        return self.read_array("frame_steps")

    def read_array(self, name: str) -> np.ndarray:
        """Read a whole tensor, such as states.

        Raises:
            InputError: There is no tensor of this name.
        """
        with self._translate_errors():
            tensor = self._tensors[name]
            pieces = self._read_pieces([(tensor.start, tensor.end - tensor.start)])
            return np.asarray(tensor.to_tensor(pieces, tensor.shape).numpy())

    def find_frames(self, steps: Sequence[int]) -> list[int]:
        """Return the indices of the frames at these control steps.

        Raises:
            InputError: The cache has no frame at one of the steps.
        """
        indices = {step: index for index, step in enumerate(self.frame_steps.tolist())}
        if missing := [step for step in steps if step not in indices]:
            needed = (
                f"one of the {len(indices)} steps that clips with the data.stride and data.frames of the cache need"
            )
            raise InputError(where=self.path, found=f"no frame of control step {missing[0]}", needed=needed)
        return [indices[step] for step in steps]

    def read_latents(self, indices: Sequence[int]) -> StoredLatents:
        """Read the latents of frames, given by their indices.

        Raises:
            InputError: The file does not have these frames.
        """
        names = [name for name in ("latents", "scales") if name == "latents" or name in self.names]
        with self._translate_errors():
            return StoredLatents(*self._read_rows(names, indices))

    def read_images(self, indices: Sequence[int]) -> UInt8[np.ndarray, "frames size size 3"]:
        """Read the encoder's input images of frames, given by their indices.

        Raises:
            InputError: An image is damaged.
        """
        with self._translate_errors():
            stored = self._tensors["pictures"]
            if len(stored.shape) > 1:
                return np.asarray(self._read_rows(["pictures"], indices)[0].numpy())
            ends = [0, *self.read_array("picture_ends").tolist()]
            jpegs = self._read_pieces([stored.get_row_range(ends[index], ends[index + 1]) for index in indices])
        return decode_images(jpegs, self.frame_steps[list(indices)].tolist(), self.path)

    def _read_rows(self, names: Sequence[str], indices: Sequence[int]) -> list[Tensor]:
        """Read the same rows of several tensors together."""
        tensors, count = [self._tensors[name] for name in names], len(indices)
        pieces = self._read_pieces([tensor.get_row_range(i, i + 1) for tensor in tensors for i in indices])
        parts = (pieces[number * count : (number + 1) * count] for number in range(len(tensors)))
        return [tensor.to_tensor(part, (count, *tensor.shape[1:])) for tensor, part in zip(tensors, parts, strict=True)]

    def _read_pieces(self, ranges: Ranges) -> list[bytes]:
        pieces: dict[tuple[int, int], bytes] = {}
        for start, length in ranges:
            if start + length <= len(self._head) or not length:
                pieces[start, length] = self._head[start : start + length]
        missing = [byte_range for byte_range in dict.fromkeys(ranges) if byte_range not in pieces]
        pieces |= zip(missing, self._read(missing), strict=True) if missing else ()
        return [pieces[byte_range] for byte_range in ranges]

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """Raise an error for the user if the file is missing, truncated, not safetensors, or lacks a tensor."""
        try:
            with storage.translate_read_errors(self.path, needed="latents of an episode", fix=FIX):
                yield
        except (AttributeError, KeyError, IndexError, RuntimeError, ValueError, TypeError) as error:
            raise self._damage_error(f"not a complete file of latents ({error})") from None

    def _damage_error(self, problem: str, needed: str = "") -> InputError:
        return InputError(where=self.path, found=problem, needed=needed, fix=FIX)


@dataclass(frozen=True)
class _Tensor:
    """The description of a tensor in the header of a safetensors file."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    start: int  # position in the file

    @classmethod
    def from_header(cls, entry: Mapping[str, Any], begin: int) -> _Tensor:
        """Create a tensor from its entry in the header; `begin` is the position after the header."""
        start, end = entry["data_offsets"]
        tensor = cls(_TENSOR_TYPES[entry["dtype"]], tuple(entry["shape"]), begin + start)
        if min(start, *tensor.shape) < 0 or tensor.end != begin + end:
            raise ValueError(f"shape {tensor.shape} does not match bytes {start} to {end}")
        return tensor

    @property
    def end(self) -> int:
        """The position of the byte after the tensor in the file."""
        return self.start + prod(self.shape) * self.dtype.itemsize

    def get_row_range(self, start: int, stop: int) -> tuple[int, int]:
        """Return the range of bytes (start, length) of the rows from `start` to `stop` in the file."""
        if not 0 <= start <= stop <= self.shape[0]:
            raise IndexError(f"rows {start} to {stop} of {self.shape[0]}")
        row = prod(self.shape[1:]) * self.dtype.itemsize
        return self.start + start * row, (stop - start) * row

    def to_tensor(self, pieces: Sequence[bytes], shape: tuple[int, ...]) -> Tensor:
        """Create a tensor of a shape from pieces of this tensor's bytes."""
        data = bytearray().join(pieces)  # torch requires a writable buffer
        return torch.frombuffer(data, dtype=self.dtype).reshape(shape) if data else torch.empty(shape, dtype=self.dtype)
