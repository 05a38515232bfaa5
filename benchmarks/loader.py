"""How fast and lean are clips: RLDS against TFDS, two workers, an index of DROID's size, MP4s against naive decoding?

    python benchmarks/loader.py [--path FOLDER] [--tfds-python /path/to/an/environment/bin/python]

One process, 16-frame clips of one camera, at random places of random episodes, as in training. Ours: the first clip of
each episode on this machine, which checks the CRC of the record, and all later ones. The baselines, in the same run on
the same records: decoding every frame of every camera; and TFDS in an interpreter that has tensorflow_datasets, with
one thread as ours, nothing shuffled and nothing interleaved, with all pictures decoded and with SkipDecoding and 16
frames decoded afterwards. TFDS reads in file order only: a clip costs it an episode. Its steps are taken from
the episode in two ways (`batch` it and slice; `skip` and `take`), and the faster one counts.
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
steps_of_all = int(sys.argv[6])
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
def clip(way):
    first = random.randrange(steps_of_all - span + 1)
    steps = next(episodes)["steps"]
    steps = steps.batch(steps_of_all) if way == "batch" else steps.skip(first).take(span).batch(span)
    for batch in steps:
        pictures = batch["observation"][cameras[0]]
        pictures = (pictures[first : first + span] if way == "batch" else pictures)[::stride]
        return tf.stack([tf.io.decode_jpeg(one) for one in pictures]).numpy() if skip else pictures.numpy()
seconds = []
for way in ("batch", "take"):
    clip(way)
    start = time.perf_counter()
    for _ in range(clips):
        assert clip(way).shape[0] == frames
    seconds.append((time.perf_counter() - start) / clips)
print(min(seconds))
"""


def main(options: Sequence[str] | None = None) -> None:
    """Measure and print."""
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
    """Time every way of reading the same number of clips, and print clips per second and ratios."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
    from tfrecords import decode_example, index_set, read_record

    spans = index_set(config.path)
    start = time.perf_counter()
    dataset = open_dataset(config)
    order = ClipOrder(dataset.windows("train"), seed=0)
    taken = time.perf_counter() - start
    print(f"{config.path}: {len(dataset.table)} episodes, {len(order.windows)} clips, indexed in {taken:.3f} s")
    print(f"{config.frames} frames at stride {config.stride}, {clips} random clips, medians (TFDS: mean):\n")

    def later_reads(position: int) -> None:
        read_clip(dataset, ClipRequest(*order.window(position)))

    def everything(position: int) -> None:
        episode, first = order.window(position)
        features = decode_example(read_record(spans[episode]))
        for name in config.fields.cameras.values():
            frames = np.stack([simplejpeg.decode_jpeg(picture, fastdct=True) for picture in features[name][1]])
            frames[first : first + config.clip_steps : config.model_stride].copy()

    for episode in range(len(spans)):
        read_clip(dataset, ClipRequest(episode, 0))
    names = ("every frame of every camera", "ours, first read of a record", "ours")

    def first_reads(position: int) -> None:
        with patch.object(rlds_source, "_is_checked", return_value=False):  # no record was checked before
            later_reads(position)

    ways = (everything, first_reads, later_reads)
    seconds = dict(zip(names, alternate(clips, *ways), strict=True))
    if tfds_python:
        steps = int(dataset.table.num_steps.min())
        seconds |= {
            "TFDS, full decode": run_tfds(tfds_python, config, clips, "full", steps),
            "TFDS, SkipDecoding, then 16 frames": run_tfds(tfds_python, config, clips, "skip", steps),
        }
    print(f"{'':38}{'ms a clip':>12}{'clips/s':>10}{'ours is':>12}")
    for name, each in seconds.items():
        print(f"{name:38}{each * 1e3:12.1f}{1 / each:10.1f}{each / seconds['ours']:11.1f}x")


def measure_workers(config: DataConfig, batch_size: int = 4, batches: int = 60) -> None:
    """Print clips per second of one worker and of two, and the memory of one."""
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
    one, two = (max(speeds[workers]) for workers in (1, 2))
    print(
        f"\ntraining_loader, batches of {batch_size}, the better of two runs: 1 worker {one:.0f} clips/s, 2 workers",
        end="",
    )
    print(f" {two:.0f} clips/s ({two / one:.2f}x); resident memory of a worker {largest:.0f} MB")


def measure_index(config: DataConfig) -> None:
    """Print what index and order of as many episodes as DROID has cost, opened from the cache."""
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
    with multiprocessing.get_context("spawn").Pool(1) as fresh:  # memory freed by this process would be used again
        clips, opened, taken, memory = fresh.apply(_open_index, (config,))
    size = (Path(str(config.disk_cache.dir)) / "index" / "synthetic.index").stat().st_size / 1e6
    print(f"\nindex of {DROID_EPISODES:,} episodes, {size:.1f} MB: opened in {opened:.2f} s;", end="")
    print(f" with the order of {clips:,} clips {taken:.2f} s, {memory:.0f} MB")


def _open_index(config: DataConfig) -> tuple[int, float, float, float]:
    process = psutil.Process()
    before, start = process.memory_info().rss, time.perf_counter()
    table = get_or_build_index(config.disk_cache, "synthetic", config.path, _never)
    opened = time.perf_counter() - start
    everyone = np.ones(len(table), bool)
    kept = StepSelection.all_steps(table, everyone)
    order = ClipOrder(
        select_split_windows(table, everyone, find_clip_windows(table, kept, config), config, "train"), seed=0
    )
    order.window(123_456)
    taken, memory = time.perf_counter() - start, (process.memory_info().rss - before) / 1e6
    return len(order.windows), opened, taken, memory


def _never() -> EpisodeTable:
    raise AssertionError("the index was not kept")


def alternate(count: int, *ways: Callable[[int], None]) -> list[float]:
    """Return the median seconds of each way; they take turns, so that a busy machine is busy for all of them."""
    seconds: list[list[float]] = [[] for _ in ways]
    for position in range(count):
        for way, taken in zip(ways, seconds, strict=True):
            start = time.perf_counter()
            way(position)
            taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in seconds]


def run_tfds(python: str, config: DataConfig, clips: int, mode: str, steps: int) -> float:
    """Return the mean seconds per clip that TFDS needs, in the given interpreter."""
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
