"""How is a file spoiled? By bits, bytes, pieces and numbers; by values in its structure; with checksums made to fit."""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.random import Generator
from safetensors import SafetensorError
from safetensors.torch import load, save

from vjepa2_ac.data.sources.rlds.tfrecord import HEADER_BYTES, write_record

Mutator = Callable[[bytes, Generator], bytes]

_ODD_NUMBERS = (0, 1, -1, 127, 255, 65_535, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, -(2**63))
_DEEP: Any = []
for _ in range(200):
    _DEEP = [_DEEP]
_ODD_VALUES: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 1.5, -0.0, 1e308, 2**31, 2**63, 10**30, "", "1", "x", "x" * 10_000,
    "../../../etc/passwd", "/dev/zero", "\x1b[2J", "\x00", "NaN", "(a+)+$", [], {}, [[]], [None],
    {"": {}}, {"a": 1}, _DEEP, float("nan"),
    float("inf"),
)  # fmt: skip
_ODD_WORDS = (
    "010", "1:30", "1e400", "-1", "9" * 5_000, ".nan", ".inf", "null", "~", "[]", "{}", "{{ NAME }}", "*a", "&a",
    "<<: *a", "!!int x", "!!python/object:os.system x", "- ", ": ", "? ", "#", "'", '"', "|", ">", "%", "@", "\t",
    "\x00", "\x1b[2J", "\ud83d", "2024-13-45", "yes", "0x" + "f" * 40, "[" * 300, "{" * 300, "(a|a)*",
)  # fmt: skip


def of_bytes(data: bytes, random: Generator) -> bytes:
    """Return bytes with a few changes of random kinds, most of them where headers are."""
    for _ in range(int(random.integers(1, 4))):
        place = _place(len(data), random)
        length = int(random.integers(1, 65))
        other = int(random.integers(len(data) + 1))
        change = int(random.integers(9))
        if change == 0:  # bits
            flipped = data[place] ^ (1 << int(random.integers(8))) if place < len(data) else 0
            data = data[:place] + bytes([flipped]) + data[place + 1 :]
        elif change == 1:
            data = data[:place]
        elif change == 2:
            data = data[:place] + random.bytes(length) + data[place + length :]
        elif change == 3:
            data = data[:place] + data[other : other + length] + data[place:]
        elif change == 4:
            data = data[:place] + data[place + length :]
        elif change == 5:
            data = data[:place] + bytes([int(random.choice([0, 255]))]) * length + data[place + length :]
        elif change in {6, 7}:
            data = _with_number(data, place, random)
        else:
            data = data[:place] + data[other:] + data[place:other]
    return data


def of_text(data: bytes, random: Generator) -> bytes:
    """Return text with changed words and lines, or of changed bytes."""
    if random.random() < 0.2:
        return of_bytes(data, random)
    lines = data.decode(errors="surrogateescape").split("\n")
    for _ in range(int(random.integers(1, 4))):
        line, other = (int(number) for number in random.integers(len(lines), size=2))
        change = int(random.integers(6))
        if change == 0:
            lines[line] = lines[other]
        elif change == 1:
            lines.insert(line, lines[other])
        elif change == 2:
            lines[line] = " " * int(random.integers(1, 4)) + lines[line]
        else:
            lines[line] = _with_word(lines[line], random)
    return "\n".join(lines).encode(errors="surrogatepass")


def of_json(data: bytes, random: Generator) -> bytes:
    """Return JSON with another value somewhere, a key less, more or twice; or as text."""
    if random.random() < 0.3:
        return of_text(data, random)
    value = json.loads(data)
    for _ in range(int(random.integers(1, 3))):
        value = _with_value(value, random)
    return json.dumps(value).encode()


def of_json_lines(data: bytes, random: Generator) -> bytes:
    """Return lines of JSON, one of them changed."""
    lines = data.splitlines()
    line = int(random.integers(len(lines)))
    lines[line] = of_json(lines[line], random)
    return b"\n".join(lines) + b"\n"


def of_records(data: bytes, random: Generator) -> bytes:
    """Return a TFRecord file, what is in one of its records changed, and its checksums those of what it then holds."""
    records, place = [], 0
    while place < len(data):
        (length,) = struct.unpack_from("<Q", data, place)
        records.append(data[place + HEADER_BYTES : place + HEADER_BYTES + length])
        place += HEADER_BYTES + length + 4
    number = int(random.integers(len(records)))
    records[number] = of_bytes(records[number], random)
    file = io.BytesIO()
    for record in records:
        write_record(file, record)
    return file.getvalue()


def of_arrays(data: bytes, random: Generator) -> bytes:
    """Return an .npz file, the header or the values of one of its arrays changed, and its checksums made to fit."""
    with zipfile.ZipFile(io.BytesIO(data)) as old:
        members = {info.filename: old.read(info) for info in old.infolist()}
    name = str(random.choice(list(members)))
    if random.random() < 0.5:
        header = members[name][:128].decode("latin-1")
        members[name] = _with_word(header, random).encode("latin-1", errors="replace") + members[name][128:]
    else:
        members[name] = of_bytes(members[name], random)
    file = io.BytesIO()
    packed = zipfile.ZIP_DEFLATED if random.random() < 0.3 else zipfile.ZIP_STORED
    with zipfile.ZipFile(file, "w", packed) as new:
        for member, content in members.items():
            new.writestr(member, content)
    return file.getvalue()


def of_tensors(data: bytes, random: Generator) -> bytes:
    """Return a file of a latent cache with other tensors or texts."""
    length = int.from_bytes(data[:8], "little")
    about = dict(json.loads(data[8 : 8 + length]).get("__metadata__", {}))
    tensors = load(data)
    name = str(random.choice(sorted(tensors)))
    change = int(random.integers(6))
    if change == 0:
        del tensors[name]
    elif change == 1:
        kinds = (torch.float64, torch.float32, torch.bfloat16, torch.int64, torch.int32, torch.uint8, torch.bool)
        tensors[name] = tensors[name].to(kinds[int(random.integers(len(kinds)))])
    elif change == 2:
        tensors[name] = tensors[name].flatten()[: int(random.integers(tensors[name].numel() + 1))].clone()
    elif change == 3:
        flat = tensors[name].flatten().clone()
        if len(flat):
            flat[int(random.integers(len(flat)))] = _odd_of(tensors[name].dtype, random)
        tensors[name] = flat.reshape(tensors[name].shape)
    elif change == 4:
        tensors[f"{name}x"] = tensors.pop(name)
    else:
        key = str(random.choice(sorted(about)))
        about[key] = str(_ODD_VALUES[int(random.integers(len(_ODD_VALUES)))])
    try:
        return save({key: one.contiguous() for key, one in tensors.items()}, metadata=about)
    except SafetensorError:  # of text that it does not write
        return data[: len(data) // 2]


def _place(size: int, random: Generator) -> int:
    area = random.random()
    if area < 0.4:
        return int(random.integers(min(size, 512) + 1))
    return size - int(random.integers(min(size, 2048) + 1)) if area < 0.6 else int(random.integers(size + 1))


def _with_number(data: bytes, place: int, random: Generator) -> bytes:
    size, order = int(random.choice([1, 2, 4, 8])), "big" if random.random() < 0.5 else "little"
    number = int(_ODD_NUMBERS[int(random.integers(len(_ODD_NUMBERS)))]) % (1 << 8 * size)
    place -= place % size
    return data[:place] + number.to_bytes(size, order) + data[place + size :]


def _with_word(line: str, random: Generator) -> str:
    words = list(re.finditer(r"[-\w.]+", line))
    odd = _ODD_WORDS[int(random.integers(len(_ODD_WORDS)))]
    if not words:
        return odd
    word = words[int(random.integers(len(words)))]
    return line[: word.start()] + odd + line[word.end() :]


def _with_value(value: Any, random: Generator) -> Any:
    """Return a value with something else at a random place in it."""
    if isinstance(value, dict) and value and random.random() < 0.9:
        key = list(value)[int(random.integers(len(value)))]
        if random.random() < 0.1:
            return {other: one for other, one in value.items() if other != key}
        return {**value, key: _with_value(value[key], random)}
    if isinstance(value, list) and value and random.random() < 0.8:
        place = int(random.integers(len(value)))
        return [*value[:place], _with_value(value[place], random), *value[place + 1 :]]
    return _ODD_VALUES[int(random.integers(len(_ODD_VALUES)))]


def _odd_of(kind: torch.dtype, random: Generator) -> float | int:
    if kind.is_floating_point:
        return float(random.choice([np.nan, np.inf, -np.inf, 1e38, 0.0]))
    if kind == torch.bool:
        return 1
    bounds = torch.iinfo(kind)
    return int(random.choice([bounds.min, bounds.max, 0, 1]))
