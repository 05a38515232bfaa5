"""The file of one episode and camera in a latent cache: safetensors, with random access by frame.

Tensors (control steps as in `episode`; `frames` are the steps whose frames were encoded):
    latents            [frames, tokens, dim] bfloat16, float32 or int8
    scales             [frames, tokens] float32, with int8 only: a latent is its value times the scale of its token
    frame_steps        [frames] int32: the control step of each frame, ascending
    frame_crc          [frames] int64: CRC-32 of the frame's latents followed by its scales
    states             [steps, state_dim], and where the source has them commands, extrinsics, joint_velocities
    pictures           [bytes] uint8: the frames as small JPEGs, concatenated; for people to look at
    picture_ends       [frames] int64: where each of them ends; picture_crc likewise: its CRC-32
The header's metadata (texts): format, id, camera, num_steps, control_rate_hz, metadata (JSON), key (of the cache), and
crc: CRC-32 of all these texts and of every tensor but latents, scales and pictures.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from vjepa2_ac import storage
from vjepa2_ac.data.sources.latents.dtypes import DTYPES, CacheType
from vjepa2_ac.episode import Episode, StoredLatents
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.jpeg import decode_jpegs, encode_jpeg
from vjepa2_ac.storage.structured import json_object, shown

FORMAT = "vjepa2-ac latents 1"

_OPTIONAL = ("commands", "extrinsics", "joint_velocities")
_BY_FRAME = frozenset({"latents", "scales", "pictures"})  # read and checked by frame, on request
_JPEG_QUALITY = 85
_FIX = "Delete this file, and then run `vjepa2-ac encode` again, as the cache was made; or copy the file again"


@dataclass(frozen=True)
class EpisodeLayout:
    """The properties that all files of a cache share."""

    key: str  # of the cache
    kind: CacheType
    tokens: int
    dim: int


@dataclass(frozen=True, eq=False)
class EncodedEpisode:
    """An episode with latents of frames of one camera."""

    episode: Episode  # its states and other data for clips; no frame is read
    camera: str
    steps: Sequence[int]  # control steps of the frames, ascending; there may be none
    latents: StoredLatents  # of these frames, see `dtypes.pack_latents`
    pictures: UInt8[np.ndarray, "frames height width 3"]  # these frames, square as the encoder sees them and small


def write_episode_file(path: str | Path, layout: EpisodeLayout, encoded: EncodedEpisode) -> int:
    """Write the file of an episode and camera atomically, and return its size.

    Args:
        path: The file; missing folders are created.
        layout: The layout of the cache, which says the type of the latents.
        encoded: Its content.

    Raises:
        InputError: The file cannot be written, or the disk is full.
        ValueError: The arguments do not fit together.
    """
    episode, steps, latents, pictures = encoded.episode, encoded.steps, encoded.latents, encoded.pictures
    latents = latents.mapped(lambda tensor: tensor.detach().cpu().contiguous())
    if list(latents.values.shape) != [len(steps), layout.tokens, layout.dim] or len(pictures) != len(steps):
        raise ValueError(f"{len(steps)} steps, latents {tuple(latents.values.shape)}, pictures {pictures.shape}")
    if latents.values.dtype != DTYPES[layout.kind]:
        raise ValueError(f"latents of {latents.values.dtype} for a cache of {layout.kind}")
    if any(after <= before for before, after in zip([-1, *steps], [*steps, episode.info.num_steps], strict=True)):
        raise ValueError(f"steps {list(steps)} of {episode.info.num_steps}")
    jpegs = [encode_jpeg(frame, quality=_JPEG_QUALITY) for frame in pictures]
    tensors = _small_tensors(episode, steps, latents, jpegs)
    about = {
        "format": FORMAT,
        "id": episode.info.id,
        "camera": encoded.camera,
        "num_steps": str(episode.info.num_steps),
        "control_rate_hz": repr(float(episode.control_rate_hz)),
        "metadata": json.dumps(dict(episode.metadata), sort_keys=True),
        "key": layout.key,
    }
    about["crc"] = str(_crc_of_rest(about, tensors))
    tensors["latents"] = latents.values
    tensors["pictures"] = torch.from_numpy(np.array(np.frombuffer(b"".join(jpegs), np.uint8)))
    if latents.scales is not None:
        tensors["scales"] = latents.scales
    content = save(tensors, metadata=about)
    with storage.user_can_write(path), storage.atomic_writer(path) as file:
        file.write(content)
    return len(content)


def _small_tensors(
    episode: Episode, steps: Sequence[int], latents: StoredLatents, jpegs: Sequence[bytes]
) -> dict[str, Tensor]:
    arrays: dict[str, np.ndarray | None] = {
        "states": episode.states,
        **{name: getattr(episode, name) for name in _OPTIONAL},
        "frame_steps": np.array(steps, np.int32),
        "frame_crc": np.array([_crc_of_frame(latents, place) for place in range(len(steps))], np.int64),
        "picture_ends": np.cumsum([len(jpeg) for jpeg in jpegs], dtype=np.int64),
        "picture_crc": np.array([zlib.crc32(jpeg) for jpeg in jpegs], np.int64),
    }
    return {name: torch.from_numpy(np.array(array, order="C")) for name, array in arrays.items() if array is not None}


class EpisodeFile:
    """An open file: everything except latents and images is in memory and checked.

    Args:
        path: The file.
        layout: The layout of the cache.

    Raises:
        InputError: The file is missing, damaged, or belongs to another cache.
    """

    def __init__(self, path: str | Path, layout: EpisodeLayout) -> None:
        self.path = str(path)
        with _reading(self.path):
            self._file: Any = safe_open(self.path, framework="pt").__enter__()  # type: ignore[no-untyped-call] # mapped until nobody has it any more
            self.about: Mapping[str, str] = self._file.metadata() or {}
            self._names = frozenset(self._file.keys())
            if unknown := self._names - _BY_FRAME - _SMALL.keys():
                raise _damaged(self.path, f"the unknown tensors {shown(sorted(unknown))}")
            tensors = {name: self._file.get_tensor(name) for name in self._names - _BY_FRAME}
        if self.about.get("format") != FORMAT:
            raise _damaged(self.path, f"the format {shown(self.about.get('format'))}", FORMAT)
        if self.about.get("crc") != str(_crc_of_rest(self.about, tensors)):
            raise _damaged(self.path, "damaged: its CRC is wrong")
        if self.about.get("key") != layout.key:
            raise _damaged(self.path, "a file of another cache", "a file that was made with this one's cache.json")
        _require_fitting(self.path, tensors)
        self._arrays = {name: np.array(tensor.numpy()) for name, tensor in tensors.items()}
        self.frame_steps: Int[np.ndarray, " frames"] = self._arrays["frame_steps"]
        self.id, self.camera, self.metadata = self._read_identity()
        self._require_shapes(layout)

    def __getitem__(self, name: str) -> Any:
        """Return states, commands, extrinsics or joint_velocities; None if there are none."""
        return self._arrays.get(name)

    def _read_identity(self) -> tuple[str, str, dict[str, str]]:
        """Return identity, camera, and metadata such as the language instruction."""
        if absent := [name for name in ("id", "camera", "metadata") if name not in self.about]:
            raise _damaged(self.path, f"no {absent[0]} in its header")
        metadata = json_object(self.about["metadata"], where=f"{self.path}: metadata", fix=_FIX)
        return self.about["id"], self.about["camera"], {name: str(text) for name, text in metadata.items()}

    def places_of(self, steps: Sequence[int]) -> list[int]:
        """Return the indices of the frames at these control steps.

        Raises:
            InputError: The cache has no frame of one of them.
        """
        places = np.searchsorted(self.frame_steps, np.asarray(steps))
        for place, step in zip(places.tolist(), steps, strict=True):
            if place == len(self.frame_steps) or self.frame_steps[place] != step:
                raise InputError(
                    where=f"{self.path} ({self.id})",
                    found=f"no frame of control step {step}",
                    needed=f"one; there are {len(self.frame_steps)}, of every step that a clip needed",
                    fix="Encode with the same data.stride, data.frames, data.start_every and data.idle as are used now",
                )
        return [int(place) for place in places]

    def latents(self, places: Sequence[int], *, check: Sequence[int]) -> StoredLatents:
        """Return the latents of frames, read by frame.

        Args:
            places: Indices of the frames.
            check: Indices of those whose CRC is checked.

        Raises:
            InputError: A frame is damaged.
        """
        with _reading(self.path):
            frames = StoredLatents(*(self._rows(name, places) for name in ("latents", "scales")))
        for place in check:
            if _crc_of_frame(frames, list(places).index(place)) != self._arrays["frame_crc"][place]:
                raise _damaged(self.path, f"damaged: the CRC of control step {self.frame_steps[place]} is wrong")
        return frames

    def pictures(self, places: Sequence[int]) -> UInt8[np.ndarray, "frames height width 3"]:
        """Return the small frames.

        Raises:
            InputError: One is damaged.
        """
        ends, steps = self._arrays["picture_ends"].tolist(), self.frame_steps[list(places)].tolist()
        with _reading(self.path):
            data = self._file.get_slice("pictures")
            jpegs = [bytes(data[ends[place - 1] if place else 0 : ends[place]].numpy()) for place in places]
        for place, step, jpeg in zip(places, steps, jpegs, strict=True):
            if zlib.crc32(jpeg) != self._arrays["picture_crc"][place]:
                raise _damaged(self.path, f"damaged: the CRC of the image of control step {step} is wrong")
        return decode_jpegs(jpegs, steps, self.path)

    def _rows(self, name: str, places: Sequence[int]) -> Any:
        if name not in self._names:
            return None
        rows = self._file.get_slice(name)
        return torch.stack([rows[place] for place in places])

    def _require_shapes(self, layout: EpisodeLayout) -> None:
        """Refuse latents of another type or shape: their bytes would be misread."""
        frames, tokens = len(self.frame_steps), layout.tokens
        wanted = {"latents": (_SAFETENSORS_NAMES[layout.kind], [frames, tokens, layout.dim])}
        if layout.kind == "int8":
            wanted["scales"] = ("F32", [frames, tokens])
        wanted["pictures"] = ("U8", [max(self._arrays["picture_ends"].tolist(), default=0)])  # as many bytes
        with _reading(self.path):
            slices = {name: self._file.get_slice(name) for name in wanted}
            found = {name: (one.get_dtype(), list(one.get_shape())) for name, one in slices.items()}
        for name, (kind, shape) in wanted.items():
            if found[name] != (kind, shape):
                text = f"{name} of {found[name][1]} values of {found[name][0]}"
                raise _damaged(self.path, text, f"{name} of {shape} values of {kind}")


_NUMBERS = (torch.float32, torch.float64)
_SMALL: dict[str, tuple[int, tuple[torch.dtype, ...]]] = {  # axes and types
    "states": (2, _NUMBERS),
    **dict.fromkeys(_OPTIONAL, (2, _NUMBERS)),
    "frame_steps": (1, (torch.int32,)),
    **dict.fromkeys(("frame_crc", "picture_ends", "picture_crc"), (1, (torch.int64,))),
}


def _require_fitting(path: str, tensors: Mapping[str, Tensor]) -> None:
    """Refuse inconsistent content, even with a correct CRC: the file is untrusted."""
    if absent := _SMALL.keys() - set(_OPTIONAL) - tensors.keys():
        raise _damaged(path, f"no {', '.join(sorted(absent))}")
    frames, steps = (len(tensors[name]) if tensors[name].ndim else -1 for name in ("frame_steps", "states"))
    for name, tensor in tensors.items():
        axes, types = _SMALL[name]
        rows = steps if axes == 2 else frames
        if tensor.ndim != axes or tensor.dtype not in types or len(tensor) != rows:
            raise _damaged(path, f"{name} of {tensor.dtype} and shape {list(tensor.shape)}", f"{rows} rows")
    within = torch.cat([torch.tensor([-1]), tensors["frame_steps"], torch.tensor([steps])])
    ends = torch.cat([torch.tensor([0]), tensors["picture_ends"]])
    if (within.diff() <= 0).any() or (ends.diff() < 0).any():
        raise _damaged(path, f"frames that are not in the order of the {steps} steps, or images that overlap")


_SAFETENSORS_NAMES: dict[CacheType, str] = {"bf16": "BF16", "fp32": "F32", "int8": "I8"}


@contextmanager
def _reading(path: str) -> Iterator[None]:
    """Raise an error for the user if a file is missing, truncated, or no safetensors file."""
    try:
        yield
    except FileNotFoundError:
        raise InputError(where=path, found="no such file", needed="latents of an episode", fix=_FIX) from None
    except (SafetensorError, OSError) as error:
        raise _damaged(path, f"not a whole safetensors file ({error})") from None


def _damaged(path: str, found: str, needed: str = "") -> InputError:
    return InputError(where=path, found=found, needed=needed, fix=_FIX)


def _crc_of_frame(latents: StoredLatents, place: int) -> int:
    crc = zlib.crc32(_bytes_of(latents.values[place]))
    return crc if latents.scales is None else zlib.crc32(_bytes_of(latents.scales[place]), crc)


def _crc_of_rest(about: Mapping[str, str], tensors: Mapping[str, Tensor]) -> int:
    """Return the CRC-32 of everything in a file except latents, scales and images."""
    crc = zlib.crc32(json.dumps({name: text for name, text in about.items() if name != "crc"}, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        crc = zlib.crc32(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode(), crc)
        crc = zlib.crc32(_bytes_of(tensor), crc)
    return crc


def _bytes_of(tensor: Tensor) -> memoryview:
    return tensor.contiguous().flatten().view(torch.uint8).numpy().data
