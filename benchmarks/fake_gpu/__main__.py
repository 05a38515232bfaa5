"""How much would it take on a GPU? Our code at real sizes on one that is not there: memory, waits, FLOPs, and a time.

    python benchmarks/fake_gpu train --source cache pixels --batch 1 2 8 --checkpointing off on --attention per_step
    python benchmarks/fake_gpu train --source pixels --augment --waits
    python benchmarks/fake_gpu train --largest 24 --checkpointing on       # GB: what batch fits
    python benchmarks/fake_gpu train --source pixels --checkpointing on --official ../vjepa2   # beside its step
    python benchmarks/fake_gpu encode --batch 8 16 --top 10
    python benchmarks/fake_gpu decoder --batch 64 --size small medium      # a training step of a decoder
    python benchmarks/fake_gpu plan --horizon 1 2 --at-once 32 64 --samples 800 --iterations 10 --adapter

Needs a C++ compiler and a PyTorch without CUDA; no GPU. A row takes 10 to 30 seconds. Tensors are fake: they have a
shape, a type and a device, but no numbers, so what is done never depends on them. The code is ours as it is, on ViT-g
with 24 layers unless said otherwise; a second step is counted, after one that makes tables and the optimizer's moments.

Exact: what operations PyTorch is asked for, with what shapes and types; FLOPs of products of matrices; how many bytes
of tensors live at once, each rounded to 512 (`peak GB`, of 10^9); how often the host waits for the device (`waits`): it
reads a number of a tensor, all numbers of one at once counting once, or copies without non_blocking. What is told not
to block is believed, as if all memory of the host were pinned. Latents of a cache are there already, as in train_step.

Not seen, so the peak of a GPU is higher: what a kernel allocates within itself (cuBLAS's workspace, sums in float32 of
flash attention's backward pass), the CUDA context, holes between blocks. `doctor` is what `vjepa2-ac doctor` says less
its allowance for just this, and `off by` is how much more that is than the peak (encode: its parts for the encoder).
An operation whose shape depends on numbers (a mask as an index, nonzero) cannot be imagined, and is an error.

A model, so the time is a prediction: every operation is one kernel, none overlaps with another, and it takes the
longest of FLOPs / (ceiling x share), bytes / (bandwidth x share), and 2 us. The shares are 0.85 for products of
matrices and 0.27 for attention; 0.9 for bytes, 0.4 where types are mixed; products in float32 run at 50 TFLOP/s; bytes
are of all inputs and outputs, as if no cache helped, and a copy from the host is as fast as one within the device. All
were measured on one H100, as was `host`: 33 us for each kernel. `ms` is the longer of both, for a step whose host is
slower than its device. `floor`: model FLOPs (`training.cost.flops`) over the ceiling, and MFU is the floor over `ms`.
FlexAttention stands for one flash operation that has the arithmetic of the pairs its mask leaves, as `auto` takes it
where Triton is installed. Nothing is compiled. The official step keeps float32 weights under autocast and its dense
mask, for which PyTorch takes its efficient kernel, counted as fast as flash: kinder than it is. Of a decision two
iterations are computed, and the second counts for all others, which are alike.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import device

if TYPE_CHECKING:
    from count import Count, Machine
    from work import Work

QUICK = {
    "layers": 1, "width": 128, "latent_dim": 128, "encoder_layers": 1, "image_size": 64, "frames": [4], "batch": [1],
    "horizon": [2], "samples": 6, "iterations": 4, "at_once": [4],
}  # fmt: skip
_TITLES = ("peak GB", "doctor", "off by", "waits", "kernels", "GB moved", "TFLOP", "ms", "host", "floor", "MFU")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each setting."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(given)
    device.load()
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    from count import Machine
    from stand_ins import fake_gpu

    machine = Machine(options.tflops, options.bandwidth)
    print(f"imagined: {machine.tflops:g} TFLOP/s, {machine.bandwidth:g} TB/s; {options.layers} layers, {options.dtype}")
    print(f"{options.work:60}" + "".join(f"{title:>9}" for title in _TITLES))
    found = []
    with fake_gpu():
        for row, count in rows(options, machine):
            print(line(row), flush=True)
            print_more(options, count)
            found.append(row)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        about = {"arguments": given, "machine": asdict(machine), "rows": found}
        options.json.write_text(json.dumps(about, indent=1) + "\n")


def rows(options: argparse.Namespace, machine: Machine) -> Iterator[tuple[dict[str, Any], Count]]:
    """Yield what was counted for each setting."""
    import work

    gc.freeze()  # no look for garbage goes through what was imported
    if options.work != "train":
        works = {"encode": work.encoding, "plan": work.planning, "decoder": work.decoding}
        for one in works[options.work](options):
            yield measured(one, machine, with_places=bool(options.top))
        return
    for step_of in work.training(options):
        batches = options.batch
        if options.largest:
            batches = [work.largest_batch(peak_of(step_of, machine), options.largest)]
        for batch in filter(None, batches):
            yield measured(step_of(batch), machine, with_places=bool(options.top))


def measured(work: Work, machine: Machine, *, with_places: bool) -> tuple[dict[str, Any], Count]:
    """Do a piece of work, and return what it took; with places, operations of the backward pass know theirs."""
    import torch
    from count import Count

    count = Count(machine)
    with count:
        (work.warm_up or work.do)(count)
        gc.collect()
        count.reset()
        warnings.filterwarnings("ignore", "Anomaly Detection")
        with torch.autograd.set_detect_anomaly(True, check_nan=False) if with_places else nullcontext():
            work.do(count)
    total, floor = count.total, work.flops / machine.tflops / 1e12
    host_s = total.kernels * machine.launch_s
    seconds = max(total.seconds, host_s)
    row = {
        "work": work.name, **work.settings, "peak_gb": count.peak / 1e9, "doctor_gb": work.doctor_gb,
        "waits": dict(count.waits), "kernels": total.kernels, "moved_gb": total.bytes / 1e9,
        "tflop": total.flops / 1e12, "ms": seconds * 1e3, "host_ms": host_s * 1e3, "floor_ms": floor * 1e3,
        "mfu": floor / seconds,
    }  # fmt: skip
    return row, count


def peak_of(step_of: Callable[[int], Work], machine: Machine) -> Callable[[int], float]:
    """Return what gives the peak of a batch."""

    def peak_gb(batch: int) -> float:
        return float(measured(step_of(batch), machine, with_places=False)[0]["peak_gb"])

    return peak_gb


def line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    doctor, off = row["doctor_gb"], "-"
    if doctor is not None:
        off = f"{doctor / row['peak_gb'] - 1:+.1%}"
    cells = (
        f"{row['peak_gb']:.2f}", "-" if doctor is None else f"{doctor:.2f}", off, f"{sum(row['waits'].values()):.0f}",
        f"{row['kernels']:.0f}", f"{row['moved_gb']:.1f}", f"{row['tflop']:.2f}", f"{row['ms']:.1f}",
        f"{row['host_ms']:.1f}", f"{row['floor_ms']:.1f}", f"{row['mfu']:.1%}",
    )  # fmt: skip
    return f"{row['work']:60}" + "".join(f"{cell:>9}" for cell in cells)


def print_more(options: argparse.Namespace, count: Count) -> None:
    """Print where the host waits, and the dearest operations, if that is asked for."""
    if options.waits:
        for place, times in count.waits.items():
            print(f"  {times:6.0f} waits  {place}")
    dearest = sorted(count.costs.items(), key=lambda entry: -entry[1].seconds)[: options.top]
    for (name, place), cost in dearest:
        print(
            f"  {cost.seconds * 1e3:9.2f} ms {cost.kernels:7.0f} kernels {cost.bytes / 1e9:9.1f} GB"
            f" {cost.flops / 1e12:8.2f} TFLOP  {name}  {place}"
        )


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", choices=("train", "encode", "decoder", "plan"))
    parser.add_argument("--quick", action="store_true", help="tiny sizes: whether it works")
    parser.add_argument("--layers", type=int, default=24, help="of the predictor")
    parser.add_argument("--width", type=int, default=1024, help="of the predictor, 64 a head")
    parser.add_argument("--encoder-layers", type=int, default=40)
    parser.add_argument("--latent-dim", type=int, default=1408, help="width of the encoder, 64 a head")
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--dtype", choices=("float32", "bfloat16"), default="bfloat16")
    train = parser.add_argument_group("train")
    train.add_argument("--source", nargs="+", choices=("cache", "pixels"), default=["cache"])
    train.add_argument("--frames", type=int, nargs="+", default=[16])
    train.add_argument("--batch", type=int, nargs="+", default=[8], help="clips; with encode: frames at once")
    train.add_argument("--largest", type=float, metavar="GB", help="instead: the largest batch that fits")
    train.add_argument("--checkpointing", nargs="+", choices=("off", "on"), default=["off"])
    train.add_argument("--attention", nargs="+", choices=("auto", "flex", "per_step", "dense"), default=["auto"])
    train.add_argument("--augment", action="store_true", help="clips of pixels are cropped and jittered")
    train.add_argument("--rollout-steps", type=int, default=2)
    train.add_argument("--official", type=Path, help="a checkout of facebookresearch/vjepa2: its step, too")
    train.add_argument("--size", nargs="+", choices=("tiny", "small", "medium"), default=["small"], help="of a decoder")
    plan = parser.add_argument_group("plan")
    plan.add_argument("--horizon", type=int, nargs="+", default=[1, 2])
    plan.add_argument("--at-once", type=int, nargs="+", default=[64])
    plan.add_argument("--samples", type=int, default=800)
    plan.add_argument("--iterations", type=int, default=10)
    plan.add_argument("--adapter", action="store_true", help="each once more with a LoRA on, as a trained run has")
    told = parser.add_argument_group("what is imagined, and told")
    told.add_argument("--tflops", type=float, default=755.0, help="ceiling: of a large product in bfloat16")
    told.add_argument("--bandwidth", type=float, default=3.0, help="of the memory, TB/s")
    told.add_argument("--waits", action="store_true", help="say where the host waits for the device")
    told.add_argument("--top", type=int, default=0, help="say so many of the dearest operations, and their places")
    told.add_argument("--json", type=Path, help="file for all figures")
    options = parser.parse_args(arguments)
    if options.quick:
        vars(options).update(QUICK)
    if options.official and not (options.official / "src/models/ac_predictor.py").is_file():
        parser.error(f"--official: {options.official} is no checkout of facebookresearch/vjepa2")
    options.device, options.official = "cuda", options.official or Path("nowhere")
    return options


if __name__ == "__main__":
    main()
