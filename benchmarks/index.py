"""Measure the time to index DROID on Google Cloud Storage, at a latency of 40 ms.

    python benchmarks/index.py [--shards 128] [--in-flight 64 128] [--latency-ms 40]

A local process serves some of DROID 1.0.1's 2,048 shards with 47 episodes each. It answers like Google Cloud Storage,
each request after the latency. The client is `RldsSource` with gcsfs. The features of a record have one of two orders:
names first, as this package writes them, or random orders, as TFDS writes them by a hash. The table shows the measured
seconds, and two estimates for all 95,658 episodes: reads x latency / reads in flight, and the measured time scaled to
all shards. On few cores the measured time is mostly Python's time for the requests.
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
STEPS, IMAGE_BYTES, ORDERS = 290, 17_000, 32  # steps per episode, bytes per image, number of random orders
NUMBER = b"0" * 12  # placeholder that `Shards` replaces by the number of the episode

WIDTHS = {
    "action": 7, "discount": 1, "reward": 1,
    **{f"action_dict/{kind}_{what}": {"cartesian": 6, "gripper": 1, "joint": 7}[kind]
       for kind in ("cartesian", "gripper", "joint") for what in ("position", "velocity")},
    "observation/cartesian_position": 6, "observation/gripper_position": 1, "observation/joint_position": 7,
}  # fmt: skip
CAMERAS = ("exterior_image_1_left", "exterior_image_2_left", "wrist_image_left")


def main(options: Sequence[str] | None = None) -> None:
    """Measure and print the table."""
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
    print(f"{arguments.shards} shards of {PER_SHARD} episodes, latency {arguments.latency_ms:g} ms")
    print("reads and KB are per episode; the last two columns are estimates for all episodes of DROID\n")
    print(f"{'order':12}{'in flight':>10}{'reads':>8}{'KB':>8}{'seconds':>9}{'by latency':>26}{'by time':>10}")
    for order in ("names first", "a hash's"):
        for in_flight in arguments.in_flight:
            measure(order, arguments.shards, in_flight, latency_s)


def measure(order: str, shards: int, in_flight: int, latency_s: float) -> None:
    """Index the shards that a server process provides, and print a line."""
    context = multiprocessing.get_context("spawn")
    pipe, server_pipe = context.Pipe()
    server = context.Process(target=serve, args=(order, shards, latency_s, server_pipe), daemon=True)
    server.start()
    os.environ["STORAGE_EMULATOR_HOST"] = f"http://127.0.0.1:{pipe.recv()}"
    rlds_index._IN_FLIGHT = in_flight
    with tempfile.TemporaryDirectory() as cache:
        source = RldsSource(RldsData(path="gs://droid/1.0.1", disk_cache=DiskCacheConfig(dir=cache)))
        before, start = storage.bytes_fetched(), time.perf_counter()
        episodes = len(source.infos())
        seconds = time.perf_counter() - start
    pipe.send("stop")
    reads = pipe.recv()
    server.join()
    if episodes != shards * PER_SHARD:
        raise SystemExit(f"index: {episodes} episodes. Expected {shards * PER_SHARD}.")
    reads_per_episode, kilobytes = reads / episodes, (storage.bytes_fetched() - before) / episodes / 1e3
    by_latency = reads_per_episode * DROID_EPISODES * latency_s / in_flight
    by_time = seconds * DROID_SHARDS / shards
    line = f"{order:12}{in_flight:10}{reads_per_episode:8.2f}{kilobytes:8.1f}{seconds:9.1f}"
    print(f"{line}{by_latency:24.0f} s{by_time:8.0f} s", flush=True)


@dataclass(frozen=True)
class Shards:
    """The stored shards: records of equal length with the headers of all features, the names, and zeros as values."""

    orders: list[list[tuple[bytes, int]]]  # per order: the parts of a record, each with the number of zeros after it
    count: int

    @property
    def record_bytes(self) -> int:
        """The length of a record with its header and CRCs."""
        return sum(len(part) + zeros for part, zeros in self.orders[0])

    def read(self, shard: int, start: int, end: int) -> bytes:
        """Return bytes of a shard."""
        pieces, position = [], start
        while position < min(end, PER_SHARD * self.record_bytes):
            record, offset = divmod(position, self.record_bytes)
            piece = self._read_part(shard * PER_SHARD + record, offset, end - position)
            pieces.append(piece)
            position += len(piece)
        return b"".join(pieces)

    def _read_part(self, number: int, offset: int, length: int) -> bytes:
        """Return at most `length` bytes of a record, from an offset to the end of the part or its zeros."""
        for part, zeros in self.orders[number % len(self.orders)]:
            if offset < len(part):
                return part.replace(NUMBER, b"%012d" % number)[offset : offset + length]
            offset -= len(part)
            if offset < zeros:
                return bytes(min(zeros - offset, length))
            offset -= zeros
        raise ValueError(f"the offset is beyond the end of record {number}")


def draw_shards(order: str, count: int) -> Shards:
    """Return shards whose features have a given order: "names first" or "a hash's"."""
    names = ("episode_metadata/file_path", "episode_metadata/recording_folderpath")
    folder = b"gs://bucket/lab/success/2023-07-07/" + NUMBER
    entries = [make_entry(name, "bytes_list", [folder + b"/trajectory.h5"]) for name in names]
    entries += [make_entry(f"steps/{name}", "float_list", np.zeros(STEPS * width)) for name, width in WIDTHS.items()]
    entries += [make_entry(f"steps/is_{name}", "int64_list", [0] * STEPS) for name in ("first", "last", "terminal")]
    entries += [
        make_entry(f"steps/language_instruction{end}", "bytes_list", [b"word " * 8] * STEPS) for end in ("", "_2", "_3")
    ]
    entries += [image_entry(f"steps/observation/{name}", STEPS * IMAGE_BYTES) for name in CAMERAS]
    length = sum(len(part) + zeros for part, zeros in entries)
    generator = np.random.default_rng(0)
    orders = [[entries[index] for index in generator.permutation(len(entries))] for _ in range(ORDERS)]
    used = [entries] if order == "names first" else orders
    return Shards([frame_record(entries_in_order, length) for entries_in_order in used], count)


def make_entry(name: str, kind: Kind, values: Sequence[Any] | np.ndarray) -> tuple[bytes, int]:
    """Return the entry of one feature, as stored in a record, followed by no zeros."""
    return encode_entry(name, kind, values), 0


def image_entry(name: str, size: int) -> tuple[bytes, int]:
    """Return the header of the entry of an image feature, and the number of zeros in place of the images."""
    inner = encode_header(0x0A, size)
    feature = encode_header(0x0A, len(inner) + size) + inner
    key = encode_header(0x0A, len(name)) + name.encode()
    value = encode_header(0x12, len(feature) + size) + feature
    return encode_header(0x0A, len(key) + len(value) + size) + key + value, size


def frame_record(entries: list[tuple[bytes, int]], length: int) -> list[tuple[bytes, int]]:
    """Return entries as a record of a TFRecord file. The CRC of the data is a dummy, because the index skips it."""
    features = encode_header(0x0A, length)
    size = struct.pack("<Q", len(features) + length)
    crc = google_crc32c.value(size)
    masked = ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF
    return [(size + struct.pack("<I", masked) + features, 0), *entries, (b"\1\2\3\4", 0)]


def encode_header(tag: int, length: int) -> bytes:
    """Return a tag and a length in protobuf's encoding."""
    digits = bytearray([tag])
    while length >= 0x80:
        digits.append(length & 0x7F | 0x80)
        length >>= 7
    return bytes([*digits, length])


def serve(order: str, count: int, latency_s: float, pipe: object) -> None:
    """Answer like Google Cloud Storage until a message arrives on the pipe; then send the number of shard reads."""
    asyncio.run(_serve(draw_shards(order, count), latency_s, pipe))


async def _serve(shards: Shards, latency_s: float, pipe: object) -> None:
    reads = 0
    info = json.dumps(dataset_info("r2d2", "1.0.1", [PER_SHARD] * shards.count, 0)).encode()
    files = {"1.0.1/dataset_info.json": len(info)}
    for number in range(shards.count):
        files[f"1.0.1/r2d2-train.tfrecord-{number:05d}-of-{shards.count:05d}"] = PER_SHARD * shards.record_bytes

    def describe(name: str) -> dict[str, str]:
        return {"kind": "storage#object", "name": name, "bucket": "droid", "size": str(files[name]), "generation": "1"}

    def answer(address: str, headers: str) -> tuple[int, bytes]:
        nonlocal reads
        path, _, query = address.partition("?")
        name = unquote(path.partition("/o/")[2])
        if not name:
            return 200, json.dumps({"kind": "storage#objects", "items": [describe(name) for name in files]}).encode()
        if name not in files:
            return 404, b"{}"
        if "alt=media" not in query:
            return 200, json.dumps(describe(name)).encode()
        byte_range = re.search(r"(?i)range: bytes=(\d+)-(\d+)", headers)
        start, end = (int(byte_range[1]), int(byte_range[2]) + 1) if byte_range else (0, files[name])
        if name.endswith(".json"):
            return 206, info[start:end]
        reads += 1
        return 206, shards.read(int(name.split("-")[-3]), start, end)

    async def connection(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            while True:
                request_line, _, headers = (await reader.readuntil(b"\r\n\r\n")).decode().partition("\r\n")
                await asyncio.sleep(latency_s)
                status, body = answer(request_line.split(" ")[1], headers)
                kind = "octet-stream" if status == 206 else "json"
                head = (
                    f"HTTP/1.1 {status} OK\r\nContent-Type: application/{kind}\r\nContent-Length: {len(body)}\r\n\r\n"
                )
                writer.write(head.encode() + body)
        writer.close()

    server = await asyncio.start_server(connection, "127.0.0.1", 0, backlog=512)
    pipe.send(server.sockets[0].getsockname()[1])  # type: ignore[attr-defined]
    await asyncio.get_running_loop().run_in_executor(None, pipe.recv)  # type: ignore[attr-defined]
    pipe.send(reads)  # type: ignore[attr-defined]
    server.close()


if __name__ == "__main__":
    main()
