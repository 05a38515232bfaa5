"""Count the memory of a training step without a GPU, at real sizes, and compare it with the estimate of `doctor`.

    python benchmarks/fake_gpu --source cache pixels --batch 1 2 8 --checkpointing off on

Needs a C++ compiler and a PyTorch without CUDA. A row takes 10 to 30 seconds. Tensors are fake: they have a shape, a
type and a device, but no values. The training code is not changed. The default model has ViT-g and 24 layers. The
second step is counted, because the first step creates tables and the optimizer's moments.

`peak GB` (10^9 bytes) is the maximum of the sizes of all existing tensors, each rounded up to 512 bytes. The peak on a
GPU is higher because of memory that cannot be counted: memory that a kernel allocates internally, the CUDA context, and
fragmentation. `doctor` is the estimate of `vjepa2-ac doctor` without its allowance for these. `waits` is the number of
times that the host waits for the device; copies with non_blocking are not counted. FlexAttention is replaced by one
flash operation, and nothing is compiled. On an H100 the peaks were 0.1 to 1.1 % higher than the count.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import device

QUICK = {"layers": 1, "width": 128, "latent_dim": 128, "encoder_layers": 1, "image_size": 64, "frames": 4, "batch": [1]}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each setting."""
    options = parse(arguments)
    device.load()
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    from stand_ins import fake_gpu

    print(f"{'training step':48}{'peak GB':>10}{'doctor':>10}{'off by':>10}{'waits':>8}")
    rows = []
    with fake_gpu():
        for row in measure_rows(options):
            off_by = row["doctor_gb"] / row["peak_gb"] - 1
            print(
                f"{row['work']:48}{row['peak_gb']:10.2f}{row['doctor_gb']:10.2f}{off_by:+10.1%}{row['waits']:8}",
                flush=True,
            )
            rows.append(row)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def measure_rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the memory of a training step for each setting."""
    from count import UsageCounter
    from stand_ins import FakeBench, no_fake_gpu
    from train_step_variants import Setting

    gc.freeze()
    for source in options.source:
        bench = FakeBench(argparse.Namespace(**vars(options) | {"source": [source], "frames": [options.frames]}))
        for checkpointing, batch in itertools.product(options.checkpointing, options.batch):
            setting = Setting(options.frames, batch, checkpointing == "on", source == "pixels")
            step, count = bench.step(setting, options.attention), UsageCounter()
            with count:
                step()
                gc.collect()
                count.reset()
                step()
            with no_fake_gpu():
                doctor_gb = bench.estimated_gb(setting)
            yield {
                "work": f"{source}, {options.frames} frames, batch {batch}, checkpointing {checkpointing}",
                "source": source, "batch": batch, "checkpointing": checkpointing, "peak_gb": count.storages.peak / 1e9,
                "doctor_gb": doctor_gb, "waits": count.waits,
            }  # fmt: skip


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to test the program")
    parser.add_argument("--layers", type=int, default=24, help="layers of the predictor")
    parser.add_argument("--width", type=int, default=1024, help="width of the predictor, a multiple of 64")
    parser.add_argument("--encoder-layers", type=int, default=40, help="layers of the encoder")
    parser.add_argument("--latent-dim", type=int, default=1408, help="width of the encoder, a multiple of 64")
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--dtype", choices=("float32", "bfloat16"), default="bfloat16")
    parser.add_argument("--source", nargs="+", choices=("cache", "pixels"), default=["cache"])
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--batch", type=int, nargs="+", default=[8], help="clips per batch")
    parser.add_argument("--checkpointing", nargs="+", choices=("off", "on"), default=["off"])
    parser.add_argument("--attention", choices=("auto", "flex", "per_step", "dense"), default="auto")
    parser.add_argument("--rollout-steps", type=int, default=2)
    parser.add_argument("--json", type=Path, help="file for all rows")
    options = parser.parse_args(arguments)
    if options.quick:
        vars(options).update(QUICK)
    options.device, options.official = "cuda", Path("nowhere")
    return options


if __name__ == "__main__":
    main()
