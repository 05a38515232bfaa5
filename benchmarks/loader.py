"""Measure the speed and memory of the loader: RLDS clips compared with TFDS, loader workers, an index of DROID's size.

    python benchmarks/loader.py [--path FOLDER] [--tfds-python /path/to/an/environment/bin/python]

One process reads clips of 16 frames of one camera, at random steps of random episodes, as in training. This package is
measured twice: the first read of a record, which checks its CRC, and all later reads. The baselines read the same
records: decoding of every frame of every camera; and TFDS with one thread, without shuffling and interleaving, once
with all images decoded, and once with SkipDecoding and 16 frames decoded afterwards. TFDS needs an interpreter that has
tensorflow_datasets. TFDS can only read in file order, so it reads a whole episode for each clip. The steps are selected
by `batch` and a slice, or by `skip` and `take`; the shorter time is reported.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import psutil  # type: ignore[import-untyped]
import simplejpeg
from synthetic_droid import draw_episodes

from vjepa2_ac.config import DataConfig, DiskCacheConfig, RldsData
from vjepa2_ac.data.clips import ClipRequest
from vjepa2_ac.data.dataset import open_dataset, read_clip
from vjepa2_ac.data.index import EpisodeTable, StepSelection, get_or_build_index
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.data.sources import rlds as rlds_source
from vjepa2_ac.data.windows import ClipOrder, find_clip_windows, select_split_windows
from vjepa2_ac.episode import EpisodeInfo
from vjepa2_ac.simulation.droid_writer import write_droid_rlds

DROID_EPISODES = 95_658

TFDS_SCRIPT = """
import random, sys, time
import tensorflow as tf, tensorflow_datasets as tfds
folder, skip = sys.argv[1], sys.argv[5] == "skip"
clips, frames, stride = map(int, sys.argv[2:5])
num_steps = int(sys.argv[6])
span = (frames - 1) * stride + 1
tf.config.threading.set_intra_op_parallelism_threads(1)
tf.config.threading.set_inter_op_parallelism_threads(1)
builder = tfds.builder_from_directory(folder)
cameras = ("exterior_image_1_left", "exterior_image_2_left", "wrist_image_left")
decoders = {"steps": {"observation": {name: tfds.decode.SkipDecoding() for name in cameras}}} if skip else None
config = tfds.ReadConfig(
    interleave_cycle_length=1, num_parallel_calls_for_decode=1, num_parallel_calls_for_interleave_files=1
)
dataset = builder.as_dataset(split="train", decoders=decoders, read_config=config, shuffle_files=False)
options = tf.data.Options()
options.threading.private_threadpool_size = 1
episodes = iter(dataset.repeat().with_options(options))
def clip(variant):
    first = random.randrange(num_steps - span + 1)
    steps = next(episodes)["steps"]
    steps = steps.batch(num_steps) if variant == "batch" else steps.skip(first).take(span).batch(span)
    for batch in steps:
        images = batch["observation"][cameras[0]]
        images = (images[first : first + span] if variant == "batch" else images)[::stride]
        return tf.stack([tf.io.decode_jpeg(image) for image in images]).numpy() if skip else images.numpy()
seconds = []
for variant in ("batch", "take"):
    clip(variant)
    start = time.perf_counter()
    for _ in range(clips):
        assert clip(variant).shape[0] == frames
    seconds.append((time.perf_counter() - start) / clips)
print(min(seconds))
"""


def main(options: Sequence[str] | None = None) -> None:
    """Measure and print all results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--path", help="a data set in DROID's RLDS schema; default: a synthetic data set")
    parser.add_argument("--clips", type=int, default=48, help="clips per measurement (default: %(default)s)")
    parser.add_argument("--stride", type=int, default=4, help="control steps per model step (default: %(default)s)")
    parser.add_argument("--tfds-python", help="interpreter that can import tensorflow_datasets")
    arguments = parser.parse_args(options)
    with tempfile.TemporaryDirectory() as scratch:
        path = arguments.path or str(write_droid_rlds(Path(scratch) / "droid", draw_episodes(), shards=4))
        cache = DiskCacheConfig(dir=str(Path(scratch) / "cache"))
        config = RldsData(
            path=path, stride=arguments.stride, disk_cache=cache, workers=0, validation_share=0.0, test_share=0.0
        )
        measure_clips(config, arguments.clips, arguments.tfds_python)
        measure_workers(config)
        measure_index(config)
    print()


def measure_clips(config: RldsData, clips: int, tfds_python: str | None) -> None:
    """Time each method of reading the same number of clips, and print clips per second and ratios."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
    from tfrecords import decode_example, index_set, read_record

    spans = index_set(config.path)
    start = time.perf_counter()
    dataset = open_dataset(config)
    order = ClipOrder(dataset.windows("train"), seed=0)
    seconds = time.perf_counter() - start
    print(f"{config.path}: {len(dataset.table)} episodes, {len(order.windows)} clips, indexed in {seconds:.3f} s")
    print(f"{config.frames} frames at stride {config.stride}, {clips} random clips, medians (TFDS: mean):\n")

    def read_again(position: int) -> None:
        read_clip(dataset, ClipRequest(*order.window(position)))

    def decode_all(position: int) -> None:
        episode, first = order.window(position)
        features = decode_example(read_record(spans[episode]))
        for name in config.fields.cameras.values():
            frames = np.stack([simplejpeg.decode_jpeg(image, fastdct=True) for image in features[name][1]])
            frames[first : first + config.clip_steps : config.model_stride].copy()

    for episode in range(len(spans)):
        read_clip(dataset, ClipRequest(episode, 0))
    names = ("every frame of every camera", "ours, first read of a record", "ours")

    def read_first(position: int) -> None:
        with patch.object(rlds_source, "_is_checked", return_value=False):  # no record was checked before
            read_again(position)

    clip_seconds = dict(zip(names, time_alternately(clips, decode_all, read_first, read_again), strict=True))
    if tfds_python:
        steps = int(dataset.table.num_steps.min())
        clip_seconds |= {
            "TFDS, full decode": run_tfds(tfds_python, config, clips, "full", steps),
            "TFDS, SkipDecoding, then 16 frames": run_tfds(tfds_python, config, clips, "skip", steps),
        }
    print(f"{'':38}{'ms per clip':>12}{'clips/s':>10}{'time / ours':>12}")
    for name, seconds in clip_seconds.items():
        print(f"{name:38}{seconds * 1e3:12.1f}{1 / seconds:10.1f}{seconds / clip_seconds['ours']:11.1f}x")


def measure_workers(config: DataConfig, batch_size: int = 4, batches: int = 60) -> None:
    """Print clips per second with one and with two workers, and the memory of a worker."""
    speeds: dict[int, list[float]] = {1: [], 2: []}
    largest = 0.0
    for workers in (1, 2, 1, 2):
        dataset = open_dataset(config.model_copy(update={"workers": workers}))
        loader = training_loader(dataset, seed=0, batch_size=batch_size)
        for _ in range(2 * workers):
            next(loader)
        start = time.perf_counter()
        for _ in range(batches):
            next(loader)
        speeds[workers].append(batches * batch_size / (time.perf_counter() - start))
        children = psutil.Process().children(recursive=True)
        largest = max([largest, *(child.memory_info().rss / 1e6 for child in children)])
        del loader
    speed_1, speed_2 = (max(speeds[workers]) for workers in (1, 2))
    print(
        f"\ntraining_loader, batches of {batch_size}, the better of two runs: 1 worker {speed_1:.0f} clips/s,", end=""
    )
    print(f" 2 workers {speed_2:.0f} clips/s ({speed_2 / speed_1:.2f}x);", end="")
    print(f" resident memory of a worker {largest:.0f} MB")


def measure_index(config: DataConfig) -> None:
    """Print the time and memory to open an index of DROID's size from the cache, and to order its clips."""
    generator = np.random.default_rng(0)
    steps = generator.integers(61, 520, DROID_EPISODES)
    infos = [
        EpisodeInfo(
            f"gs://bucket/lab/success/2023-07-0{n % 9}/{n:08d}/recordings--trajectory_{n:08d}.h5", int(count), True
        )
        for n, count in enumerate(steps)
    ]
    columns = {"shard": np.int32, "record": np.int32, "offset": np.int64, "length": np.int64}
    locators = {name: np.arange(DROID_EPISODES, dtype=kind) for name, kind in columns.items()}
    table = replace(EpisodeTable.from_infos(infos), locators=locators)
    get_or_build_index(config.disk_cache, "synthetic", config.path, lambda: table)
    del infos, table
    # In a new process, because memory that this process has freed would be reused.
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        clips, open_s, total_s, memory_mb = pool.apply(_open_index, (config,))
    size = (Path(str(config.disk_cache.dir)) / "index" / "synthetic.index").stat().st_size / 1e6
    print(f"\nindex of {DROID_EPISODES:,} episodes, {size:.1f} MB: opened in {open_s:.2f} s;", end="")
    print(f" with the order of {clips:,} clips {total_s:.2f} s, {memory_mb:.0f} MB")


def _open_index(config: DataConfig) -> tuple[int, float, float, float]:
    """Return the number of clips, the seconds to open the index and with the order, and the memory in MB."""
    process = psutil.Process()
    before, start = process.memory_info().rss, time.perf_counter()
    table = get_or_build_index(config.disk_cache, "synthetic", config.path, _refuse_to_build)
    open_s = time.perf_counter() - start
    all_episodes = np.ones(len(table), bool)
    all_steps = StepSelection.all_steps(table, all_episodes)
    windows = find_clip_windows(table, all_steps, config)
    order = ClipOrder(select_split_windows(table, all_episodes, windows, config, "train"), seed=0)
    order.window(123_456)
    total_s, memory_mb = time.perf_counter() - start, (process.memory_info().rss - before) / 1e6
    return len(order.windows), open_s, total_s, memory_mb


def _refuse_to_build() -> EpisodeTable:
    raise AssertionError("the index is not in the cache")


def time_alternately(count: int, *methods: Callable[[int], None]) -> list[float]:
    """Return the median seconds of each method. The methods take turns, so that load slows all of them equally."""
    seconds: list[list[float]] = [[] for _ in methods]
    for position in range(count):
        for method, method_seconds in zip(methods, seconds, strict=True):
            start = time.perf_counter()
            method(position)
            method_seconds.append(time.perf_counter() - start)
    return [statistics.median(method_seconds) for method_seconds in seconds]


def run_tfds(python: str, config: DataConfig, clips: int, mode: str, steps: int) -> float:
    """Return the mean seconds per clip of TFDS in another Python interpreter.

    Args:
        python: The interpreter.
        config: The data set.
        clips: Number of clips.
        mode: "full", or "skip" for SkipDecoding.
        steps: Number of steps of the shortest episode.
    """
    command = [
        python,
        "-c",
        TFDS_SCRIPT,
        config.path,
        str(clips),
        str(config.frames),
        str(config.stride),
        mode,
        str(steps),
    ]
    return float(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.split()[-1])  # noqa: S603


if __name__ == "__main__":
    main()
