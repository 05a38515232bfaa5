"""How many 16-frame clips of one camera come out of RLDS in a second, in one process?

    python benchmarks/loader.py [--path FOLDER] [--tfds-python /path/to/an/environment/bin/python]

Random clips of random episodes, as in training. Ours decodes 16 frames of one camera; the baseline, in the same run and
on the same records, decodes every frame of every camera, as a loader does that asks for whole episodes. With an
interpreter that has tensorflow_datasets, the same number of clips is taken from TFDS too, one from each episode that it
yields: with all pictures decoded, and with SkipDecoding and 16 frames decoded afterwards.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import simplejpeg

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.loader import clip_at
from vjepa2_ac.data.sources.dataset_info import find_shards, index_shards
from vjepa2_ac.data.sources.rlds import RldsSource
from vjepa2_ac.data.sources.rlds_writer import (
    CAMERAS,
    DroidCommands,
    DroidEpisode,
    DroidMeasurements,
    encode_jpeg,
    write_droid_rlds,
)
from vjepa2_ac.data.sources.tfrecord import decode_example, read_record
from vjepa2_ac.data.windows import ClipOrder, windows_of

TFDS_SCRIPT = """
import sys, time
import tensorflow as tf, tensorflow_datasets as tfds
folder, skip = sys.argv[1], sys.argv[5] == "skip"
clips, frames, stride = map(int, sys.argv[2:5])
longest = int(sys.argv[6])
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
def clip():
    for steps in next(episodes)["steps"].batch(longest):
        pictures = steps["observation"][cameras[0]][: (frames - 1) * stride + 1 : stride]
        return tf.stack([tf.io.decode_jpeg(one) for one in pictures]).numpy() if skip else pictures.numpy()
clip()
start = time.perf_counter()
for _ in range(clips):
    assert clip().shape[0] == frames
print((time.perf_counter() - start) / clips)
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--path", help="a data set in DROID's RLDS schema; default: one that is drawn for the purpose")
    parser.add_argument("--clips", type=int, default=24, help="clips per measurement (default: %(default)s)")
    parser.add_argument("--stride", type=int, default=4, help="control steps per model step (default: %(default)s)")
    parser.add_argument("--tfds-python", help="interpreter that can import tensorflow_datasets")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        path = arguments.path or str(write_droid_rlds(Path(scratch) / "droid", draw_episodes(), shards=4))
        config = DataConfig(path=path, stride=arguments.stride, validation_share=0.0, test_share=0.0, workers=0)
        measure(config, arguments.clips, arguments.tfds_python)


def measure(config: DataConfig, clips: int, tfds_python: str | None) -> None:
    """Time every way of reading the same number of clips, and print clips per second and ratios."""
    source, spans = RldsSource(config), index_shards(find_shards(config.path))
    start = time.perf_counter()
    infos = source.infos()
    order = ClipOrder(windows_of(infos, config, "train"), seed=0)
    taken = time.perf_counter() - start
    print(f"{config.path}: {len(infos)} episodes, {len(order.windows)} clips, indexed in {taken:.3f} s")
    print(f"{config.frames} frames at stride {config.stride}, {clips} random clips, medians (TFDS: mean):\n")

    def ours(position: int) -> None:
        forget_episodes(source)
        clip_at(source, *order.window(position), config)

    def everything(position: int) -> None:
        episode, first = order.window(position)
        features = decode_example(read_record(spans[episode]), where="")
        for name in config.fields.cameras.values():
            frames = np.stack([simplejpeg.decode_jpeg(picture, fastdct=True) for picture in features[name][1]])
            frames[first : first + config.clip_steps : config.stride].copy()

    seconds = dict(zip(("every frame of every camera", "ours"), alternate(clips, everything, ours), strict=True))
    if tfds_python:
        longest = max(info.num_steps for info in infos)
        seconds |= {
            "TFDS, full decode": run_tfds(tfds_python, config, clips, "full", longest),
            "TFDS, SkipDecoding, then 16 frames": run_tfds(tfds_python, config, clips, "skip", longest),
        }
    print(f"{'':38}{'ms a clip':>12}{'clips/s':>10}{'ours is':>12}")
    for name, each in seconds.items():
        print(f"{name:38}{each * 1e3:12.1f}{1 / each:10.1f}{each / seconds['ours']:11.1f}x")


def forget_episodes(source: RldsSource) -> None:
    """Empty what a source keeps, so that every clip pays for its record."""
    source.__dict__.update(source.__getstate__())


def alternate(count: int, *ways: Callable[[int], None]) -> list[float]:
    """Return the median seconds of each way; they take turns, so that a busy machine is busy for all of them."""
    seconds: list[list[float]] = [[] for _ in ways]
    for position in range(count):
        for way, taken in zip(ways, seconds, strict=True):
            start = time.perf_counter()
            way(position)
            taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in seconds]


def run_tfds(python: str, config: DataConfig, clips: int, mode: str, longest: int) -> float:
    """Return the mean seconds per clip that TFDS needs, in the given interpreter."""
    command = [python, "-c", TFDS_SCRIPT, config.path, str(clips), str(config.frames), str(config.stride), mode]
    command.append(str(longest))
    return float(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.split()[-1])  # noqa: S603


def draw_episodes(count: int = 12, steps: int = 290) -> Iterator[DroidEpisode]:
    """Yield episodes as long as DROID's, of noise as smooth as a camera's picture: 180x320 JPEGs of 10 to 25 KB."""
    generator = np.random.default_rng(0)
    pictures = [encode_jpeg(draw_picture(generator), quality=quality) for quality in range(78, 94) for _ in range(4)]
    sizes = sorted(len(picture) for picture in pictures)
    print(f"JPEGs of {sizes[0] / 1e3:.0f} to {sizes[-1] / 1e3:.0f} KB, {count} episodes of {steps} steps, 3 cameras")
    pose, gripper, joints = np.zeros((steps, 6)), np.zeros((steps, 1)), np.zeros((steps, 7))
    for number in range(count):
        folder = f"/data/success/episode_{number}"
        yield DroidEpisode(
            file_path=f"{folder}/trajectory.h5",
            recording_folderpath=f"{folder}/recordings",
            action=joints,
            action_dict=DroidCommands(pose, pose, gripper, gripper, joints, joints),
            observation=DroidMeasurements(pose, gripper, joints),
            images={
                camera: [pictures[place] for place in generator.integers(0, len(pictures), steps)] for camera in CAMERAS
            },
        )


def draw_picture(generator: np.random.Generator) -> np.ndarray:
    """Return a picture with detail of every size."""
    picture = np.full((180, 320, 3), 128.0)
    for cell in (1, 2, 4, 20, 60):
        noise = generator.normal(0, 3 + cell**0.7, (180 // cell + 1, 320 // cell + 1, 3))
        picture += noise.repeat(cell, axis=0).repeat(cell, axis=1)[:180, :320]
    return picture.clip(0, 255).astype(np.uint8)


if __name__ == "__main__":
    main()
