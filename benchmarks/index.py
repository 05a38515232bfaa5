"""Measure the time to index DROID on Google Cloud Storage, at a latency of 40 ms.

    python benchmarks/index.py [--shards 128] [--in-flight 64 128] [--latency-ms 40]

A part of DROID 1.0.1's 2,048 shards of 47 episodes is served by a process of this machine that answers as the storage
does, every answer a latency later; the client is the whole way from `RldsSource` to gcsfs. Features lie in two orders:
names first, as our own writer puts them, and orders drawn at random, as TFDS leaves them to a hash. Printed are seconds
measured, and for all 95,658 episodes: by the arithmetic of reads x latency / reads in flight, and by what was measured
here, which on few cores is the time that Python needs for as many requests.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import re
import struct
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote

import google_crc32c
import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.config import DiskCacheConfig, RldsData
from vjepa2_ac.data.sources import rlds_episode as rlds_index
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.data.sources.tfrecord import Kind, encode_entry
from vjepa2_ac.simulation.droid_writer import dataset_info

DROID_SHARDS, DROID_EPISODES, PER_SHARD = 2048, 95_658, 47
STEPS, PICTURE_BYTES, ORDERS = 290, 17_000, 32
NUMBER = b"0" * 12  # stands for the episode's own

WIDTHS = {
    "action": 7, "discount": 1, "reward": 1,
    **{f"action_dict/{kind}_{what}": {"cartesian": 6, "gripper": 1, "joint": 7}[kind]
       for kind in ("cartesian", "gripper", "joint") for what in ("position", "velocity")},
    "observation/cartesian_position": 6, "observation/gripper_position": 1, "observation/joint_position": 7,
}  # fmt: skip
CAMERAS = ("exterior_image_1_left", "exterior_image_2_left", "wrist_image_left")


def main(options: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shards", type=int, default=128, help="shards that are served (default: %(default)s)")
    parser.add_argument(
        "--in-flight", type=int, nargs="+", default=[64, 128], help="concurrent reads (default: %(default)s)"
    )
    parser.add_argument(
        "--latency-ms", type=float, default=40.0, help="latency of each response (default: %(default)s)"
    )
    arguments = parser.parse_args(options)
    latency_s = arguments.latency_ms / 1e3
    print(f"{arguments.shards} shards of {PER_SHARD} episodes, {arguments.latency_ms:g} ms a read\n")
    print(f"{'order':12}{'in flight':>10}{'reads':>8}{'KB':>8}{'seconds':>9}{'all: arithmetic':>26}{'measured':>10}")
    for order in ("names first", "a hash's"):
        for in_flight in arguments.in_flight:
            measure(order, arguments.shards, in_flight, latency_s)


def measure(order: str, shards: int, in_flight: int, latency_s: float) -> None:
    """Index what a process of its own serves, and print a line."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    server = context.Process(target=serve, args=(order, shards, latency_s, theirs), daemon=True)
    server.start()
    os.environ["STORAGE_EMULATOR_HOST"] = f"http://127.0.0.1:{ours.recv()}"
    rlds_index._IN_FLIGHT = in_flight
    with tempfile.TemporaryDirectory() as cache:
        source = RldsSource(RldsData(path="gs://droid/1.0.1", disk_cache=DiskCacheConfig(dir=cache)))
        before, start = storage.bytes_fetched(), time.perf_counter()
        found = len(source.infos())
        taken = time.perf_counter() - start
    ours.send("stop")
    reads = ours.recv()
    server.join()
    if found != shards * PER_SHARD:
        raise SystemExit(f"{found} episodes found")
    each, size = reads / found, (storage.bytes_fetched() - before) / found / 1e3
    arithmetic, scaled = each * DROID_EPISODES * latency_s / in_flight, taken * DROID_SHARDS / shards
    line = f"{order:12}{in_flight:10}{each:8.2f}{size:8.1f}{taken:9.1f}{arithmetic:24.0f} s{scaled:8.0f} s"
    print(line, flush=True)


@dataclass(frozen=True)
class Shards:
    """What the storage holds: records of equal length, of which only the features' heads and the names are true."""

    orders: list[list[tuple[bytes, int]]]  # of each order: parts of a record, each followed by so many zeros
    count: int

    @property
    def record_bytes(self) -> int:
        """Return the length of a record with its header and CRCs."""
        return sum(len(part) + zeros for part, zeros in self.orders[0])

    def read(self, shard: int, start: int, end: int) -> bytes:
        """Return bytes of a shard."""
        pieces, position = [], start
        while position < min(end, PER_SHARD * self.record_bytes):
            record, place = divmod(position, self.record_bytes)
            piece = self._part(shard * PER_SHARD + record, place, end - position)
            pieces.append(piece)
            position += len(piece)
        return b"".join(pieces)

    def _part(self, number: int, place: int, length: int) -> bytes:
        for part, zeros in self.orders[number % len(self.orders)]:
            if place < len(part):
                return part.replace(NUMBER, b"%012d" % number)[place : place + length]
            place -= len(part)
            if place < zeros:
                return bytes(min(zeros - place, length))
            place -= zeros
        raise ValueError(number)


def draw_shards(order: str, count: int) -> Shards:
    """Return shards whose features lie in an order."""
    names = ("episode_metadata/file_path", "episode_metadata/recording_folderpath")
    folder = b"gs://bucket/lab/success/2023-07-07/" + NUMBER
    entries = [entry_of(name, "bytes_list", [folder + b"/trajectory.h5"]) for name in names]
    entries += [entry_of(f"steps/{name}", "float_list", np.zeros(STEPS * width)) for name, width in WIDTHS.items()]
    entries += [entry_of(f"steps/is_{name}", "int64_list", [0] * STEPS) for name in ("first", "last", "terminal")]
    entries += [
        entry_of(f"steps/language_instruction{end}", "bytes_list", [b"word " * 8] * STEPS) for end in ("", "_2", "_3")
    ]
    entries += [picture_entry(f"steps/observation/{name}", STEPS * PICTURE_BYTES) for name in CAMERAS]
    length = sum(len(part) + zeros for part, zeros in entries)
    generator = np.random.default_rng(0)
    orders = [[entries[place] for place in generator.permutation(len(entries))] for _ in range(ORDERS)]
    return Shards([framed(one, length) for one in ([entries] if order == "names first" else orders)], count)


def entry_of(name: str, kind: Kind, values: Sequence[Any] | np.ndarray) -> tuple[bytes, int]:
    """Return one feature as it lies in a record."""
    return encode_entry(name, kind, values), 0


def picture_entry(name: str, size: int) -> tuple[bytes, int]:
    """Return a feature of pictures, of which only the head is there."""
    inner = head(0x0A, size)
    feature = head(0x0A, len(inner) + size) + inner
    key = head(0x0A, len(name)) + name.encode()
    value = head(0x12, len(feature) + size) + feature
    return head(0x0A, len(key) + len(value) + size) + key + value, size


def framed(entries: list[tuple[bytes, int]], length: int) -> list[tuple[bytes, int]]:
    """Return entries as a TFRecord's record; the CRC of the data is not right, for nobody can check it."""
    features = head(0x0A, length)
    size = struct.pack("<Q", len(features) + length)
    crc = google_crc32c.value(size)
    masked = ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF
    return [(size + struct.pack("<I", masked) + features, 0), *entries, (b"\1\2\3\4", 0)]


def head(tag: int, length: int) -> bytes:
    """Return a tag and a length as protobuf writes them."""
    digits = bytearray([tag])
    while length >= 0x80:
        digits.append(length & 0x7F | 0x80)
        length >>= 7
    return bytes([*digits, length])


def serve(order: str, count: int, latency_s: float, pipe: object) -> None:
    """Answer as Google Cloud Storage does until told to stop; then tell how many reads of shards there were."""
    asyncio.run(_serve(draw_shards(order, count), latency_s, pipe))


async def _serve(shards: Shards, latency_s: float, pipe: object) -> None:
    reads = 0
    info = json.dumps(dataset_info("r2d2", "1.0.1", [PER_SHARD] * shards.count, 0)).encode()
    files = {"1.0.1/dataset_info.json": len(info)}
    for number in range(shards.count):
        files[f"1.0.1/r2d2-train.tfrecord-{number:05d}-of-{shards.count:05d}"] = PER_SHARD * shards.record_bytes

    def described(name: str) -> dict[str, str]:
        return {"kind": "storage#object", "name": name, "bucket": "droid", "size": str(files[name]), "generation": "1"}

    def answer(address: str, headers: str) -> tuple[int, bytes]:
        nonlocal reads
        path, _, query = address.partition("?")
        name = unquote(path.partition("/o/")[2])
        if not name:
            return 200, json.dumps({"kind": "storage#objects", "items": [described(one) for one in files]}).encode()
        if name not in files:
            return 404, b"{}"
        if "alt=media" not in query:
            return 200, json.dumps(described(name)).encode()
        asked = re.search(r"(?i)range: bytes=(\d+)-(\d+)", headers)
        start, end = (int(asked[1]), int(asked[2]) + 1) if asked else (0, files[name])
        if name.endswith(".json"):
            return 206, info[start:end]
        reads += 1
        return 206, shards.read(int(name.split("-")[-3]), start, end)

    async def connection(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            while True:
                first, _, headers = (await reader.readuntil(b"\r\n\r\n")).decode().partition("\r\n")
                await asyncio.sleep(latency_s)
                status, body = answer(first.split(" ")[1], headers)
                kind = "octet-stream" if status == 206 else "json"
                top = f"HTTP/1.1 {status} OK\r\nContent-Type: application/{kind}\r\nContent-Length: {len(body)}\r\n\r\n"
                writer.write(top.encode() + body)
        writer.close()

    server = await asyncio.start_server(connection, "127.0.0.1", 0, backlog=512)
    pipe.send(server.sockets[0].getsockname()[1])  # type: ignore[attr-defined]
    await asyncio.get_running_loop().run_in_executor(None, pipe.recv)  # type: ignore[attr-defined]
    pipe.send(reads)  # type: ignore[attr-defined]
    server.close()


if __name__ == "__main__":
    main()
