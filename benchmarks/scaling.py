"""How far does a run scale? Clips, bytes, cores and all-reduce of 1 to 512 GPUs, from what one process measured.

    python benchmarks/scaling.py [CONFIG] [key=value ...]
    python benchmarks/scaling.py --check [--processes 1 2 4]

Sizes follow from the config: latents, trained parameters, FLOPs, memory by doctor's arithmetic. Speeds are options: the
defaults are measured (an H100: docs/IMPLEMENTATION_NOTES.md; loader and bytes: docs/log.md), or as published for links
and prices. The model, not confirmed by two GPUs: a process takes its time alone; then gradients are summed in a ring,
2 (N-1) / N of their bytes through the slowest link, and 2 messages a tensor and doubling of N, small tensors as one.
Nothing overlaps.

--check trains a tiny model here (gloo, a thread a process): N processes on C cores take N / min(C, N) times as long.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.config.loading import config_as_yaml, load_config
from vjepa2_ac.data.sources.latents.cache_files import bytes_per_frame
from vjepa2_ac.distributed import LARGE
from vjepa2_ac.training.cost.flops import clip_flops, frame_flops
from vjepa2_ac.training.cost.memory import count_parameters, estimate_memory

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
FLOAT32, MOMENTS, GPUS_OF_A_NODE, DROID = 4, 2, 8, 27_000_000  # DROID's frames of one camera
HEAD = (
    "GPUs | pixels: clips/s | GB/s | reads/s | cores | latents: clips/s | GB/s | reads/s |"
    " all-reduce: LoRA, ms | full, ms | of ideal, latents: LoRA | full | encode DROID, h"
)
OPTIONS: tuple[tuple[str, float, str], ...] = (
    ("clip-ms", 308 / 8, "a LoRA clip from latents: 308 ms for 8, compiled, H100"),
    ("encoder-fps", 400.0, "frames/s of ViT-g, H100: 300 to 500"),
    ("decode-ms", 4.3 / 16, "a core's time for a frame: 4.3 ms a clip of 16, benchmarks/loader.py"),
    ("clip-kb", 265.0, "that a clip of pixels fetches without a disk cache, benchmarks/clip_bytes.py"),
    ("clip-reads", 22.0, "requests of that clip"),
    ("node-gb-s", 450.0, "NVLink of an H100, each way, as published"),
    ("network-gb-s", 12.5, "of a node of 8 GPUs: 100 Gbit/s"),
    ("message-us", 5.0, "latency of a message; assumed"),
    ("dollars-gb", 0.02, "a month of storage, list price"),
    ("loopback-gb-s", 1.0, "of --check; assumed"),
    ("loopback-us", 100.0, "of --check; assumed"),
)
ENCODER, PREDICTOR = {"width": 96, "depth": 2, "heads": 2}, {"width": 192, "depth": 6, "heads": 3}  # of --check


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, or the check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", nargs="?", default="builtin:default")
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    for name, value, text in OPTIONS:
        parser.add_argument(f"--{name}", type=float, default=value, help=f"{text} (default: %(default).4g)")
    parser.add_argument("--check", action="store_true", help="train here, and print predicted beside measured")
    parser.add_argument(
        "--processes", type=int, nargs="+", default=[1, 2, 4], help="of --check; the first one is alone"
    )
    parser.add_argument("--steps", type=int, default=20, help="of --check")
    options = parser.parse_intermixed_args(arguments)
    check(options) if options.check else predict(load_config(options.config, options.overrides), options)


def all_reduce_s(processes: int, tensors: Sequence[int], gb_s: float, message_us: float) -> float:
    """Return the seconds in which gradients are summed, a large tensor after the other."""
    moved = 2 * (processes - 1) / processes * FLOAT32 * sum(tensors)
    messages = 1 + sum(one >= LARGE for one in tensors)
    return moved / gb_s / 1e9 + messages * 2 * math.ceil(math.log2(processes)) * message_us / 1e6


def predict(config: Config, options: argparse.Namespace) -> None:
    """Print what follows from a config and measured speeds."""
    sizes, frames, stride = ModelSizes(), config.data.frames, config.data.stride
    latent = bytes_per_frame(sizes.tokens_per_frame, sizes.encoder.width, config.data.cache_dtype)
    clips = config.training.batch_size * config.training.accumulation
    print(
        f"A clip has {options.clip_kb / 1e3:.2f} MB of pixels or {frames * latent / 1e6:.1f} MB of latents; {clips} are"
    )
    print(f"a step of a process; encoding one of its {frames} frames takes {frame_flops(sizes) / 1e9:.0f} GFLOP.\n")
    tensors, flops = dict[str, Sequence[int]](), dict[str, int]()
    for kind in ("lora", "none"):
        one = config.model_copy(update={"adapter": config.adapter.model_copy(update={"kind": kind})})
        tensors[kind], flops[kind] = count_parameters(one, sizes).trained_tensors, clip_flops(one, sizes).predictor
        memory = estimate_memory(one, sizes).total(checkpointing=config.training.gradient_checkpointing)
        gradients, minutes = FLOAT32 * sum(tensors[kind]) / 1e6, config.checkpoint.remote_every_minutes
        mirrored = gradients * (1 + MOMENTS)
        print(f"adapter.kind={kind}: {memory / 1e9:.1f} GB a GPU; gradients {gradients:,.0f} MB, {len(tensors[kind])}")
        print(f"tensors; a checkpoint {mirrored:,.0f} MB, {mirrored / 60 / minutes:.2f} MB/s to the mirror.\n")
    hours, stored = DROID / options.encoder_fps / 3600, DROID * latent / 1e9
    print(f"DROID encoded: {hours:.1f} GPU hours, {stored / 1e3:.1f} TB, {stored * options.dollars_gb:,.0f} dollars a")
    print(f"month; a {stride}th with data.start_every={stride}.\n\n| {HEAD} |\n|{'---|' * len(HEAD.split('|'))}")
    alone = {kind: clips * options.clip_ms / 1e3 * flops[kind] / flops["lora"] for kind in tensors}
    for count in (2**power for power in range(10)):
        link = options.node_gb_s if count <= GPUS_OF_A_NODE else options.network_gb_s
        sums = {kind: all_reduce_s(count, tensors[kind], link, options.message_us) for kind in tensors}
        latents = count * clips / (alone["lora"] + sums["lora"])
        pixels = count * clips / (alone["lora"] + clips * frames / options.encoder_fps + sums["lora"])
        cells = [f"{count}", f"{pixels:,.0f}", f"{pixels * options.clip_kb / 1e6:.3f}"]
        cells += [f"{pixels * options.clip_reads:,.0f}", f"{pixels * frames * options.decode_ms / 1e3:.1f}"]
        cells += [f"{latents:,.0f}", f"{latents * frames * latent / 1e9:.1f}", f"{latents * frames:,.0f}"]
        shares = [f"{alone[kind] / (alone[kind] + sums[kind]):.1%}" for kind in sums]
        cells += [*(f"{1e3 * one:.1f}" for one in sums.values()), *shares]
        print(f"| {' | '.join([*cells, f'{hours / count:.2f}'])} |")


def check(options: argparse.Namespace) -> None:
    """Train a tiny model on this machine, and print predicted beside measured times of a step."""
    from run_fixtures import tiny_config
    from synthetic import write_synthetic_droid
    from vjepa2_ac.model.network.world_model import WorldModel

    cores, alone = len(os.sched_getaffinity(0)), 0.0
    sizes = ModelSizes.model_validate({"image_size": 64, "encoder": ENCODER, "predictor": PREDICTOR})
    print(f"{cores} cores, load {os.getloadavg()[0]:.1f}\n")
    print(f"| processes | predicted, ms | of it all-reduce | measured, ms | ratio |\n|{'---|' * 5}")
    with tempfile.TemporaryDirectory() as scratch:
        data = write_synthetic_droid(Path(scratch) / "set", episodes=8, steps=24, size=(36, 64))
        WorldModel.random(sizes, seed=3).save_pretrained(Path(scratch) / "model")
        every = dict.fromkeys(("training__steps", "validation__every", "checkpoint__every"), options.steps)
        for count in options.processes:
            config = tiny_config(Path(scratch) / f"run-{count}", data, Path(scratch) / "model", **every)
            measured = step_s(config, count)
            alone = alone or measured
            tensors = count_parameters(config, sizes).trained_tensors
            summed = all_reduce_s(count, tensors, options.loopback_gb_s, options.loopback_us)
            predicted = alone * count / min(cores, count) + summed
            times = " | ".join(f"{1e3 * one:.1f}" for one in (predicted, summed, measured))
            print(f"| {count} | {times} | {predicted / measured:.2f} |", flush=True)


def step_s(config: Config, processes: int) -> float:
    """Return the median seconds of a step of a run of the command line."""
    from ranks import finish, free_port, start_rank
    from vjepa2_ac.runs.metrics_log import read_metrics_log

    file, port = Path(f"{config.run_dir}.yaml"), free_port()
    file.write_text(config_as_yaml(config))
    train = ["-m", "vjepa2_ac.cli", "train", str(file)]
    finish([start_rank(train, rank, processes, port) for rank in range(processes)], timeout=250.0)
    rows = [row for row in read_metrics_log(Path(config.run_dir) / "metrics.jsonl") if row["kind"] == "train"]
    clips = processes * config.training.batch_size * config.training.accumulation
    return statistics.median(clips / row["samples_per_second"] for row in rows[3:])  # the first ones warm up


if __name__ == "__main__":
    main()
