"""Compute the cost of each published encoder: parameters, FLOPs, size of latents, and training memory.

    python benchmarks/encoders.py               # all encoders
    python benchmarks/encoders.py --only ViT-B  # encoders whose name contains this text; writes no files
    python benchmarks/encoders.py --device cuda # measures frames per second instead, with random weights in bfloat16

No weights are loaded. The memory is the estimate of `vjepa2-ac doctor`. OUT/encoders.json contains the numbers,
OUT/encoders.md the table.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch
from memory import measure_peak_gb, release_memory
from rows import Rows, format_cell
from timing import (
    add_basics,
    add_repeats,
    apply_defaults,
    describe_machine,
    describe_run,
    set_up_torch,
    time_variants,
)

from vjepa2_ac.config import Config, EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.data.sources.latent_files import bytes_per_frame
from vjepa2_ac.distributed import measure_matmul_speed
from vjepa2_ac.encoding.latent_cache import image_bytes
from vjepa2_ac.model.model_files import PUBLISHED
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.training.cost import GIGABYTE, count_parameters, estimate_memory
from vjepa2_ac.training.flops import frame_flops

IMAGE_SIZES = (256, 384)  # pixels
QUICK = {"only": "ViT-B", "repeats": 1, "warm_up": 0, "threads": 1, "frames": 1}
FRAMES_PER_HOUR = 15 * 3600  # at the frame rate of DROID, 15 Hz
PREDICTORS = {
    "24x1024": PredictorSizes(width=1024, depth=24, heads=16),
    "12x768": PredictorSizes(width=768, depth=12, heads=12),
    "12x384": PredictorSizes(width=384, depth=12, heads=6),
}
RUN = {  # a run that trains the whole predictor from frames
    "run_dir": "run",
    "data": {"path": "set", "frames": 8},
    "model": {"base": "random"},
    "adapter": {"kind": "none"},
    "training": {"batch_size": 2, "gradient_checkpointing": True},
}


@dataclass(frozen=True)
class Cost:
    """The cost of an encoder."""

    encoder: str
    downloads: tuple[str, ...]  # names of `vjepa2-ac download`
    width: int  # width of a latent
    parameters: int
    gflop_per_frame: dict[str, float]  # by image size in pixels
    latents_gb_per_hour: float  # per hour of 15 Hz video, for all frames in bfloat16, at the first image size
    peak_gb: dict[str, dict[str, float]]  # GPU memory of training, by image size and predictor


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, default=Path("benchmarks/results"), help="folder for the table and the metrics"
    )
    parser.add_argument(
        "--only", default="", help="measure only encoders whose name contains this text, and write nothing"
    )
    parser.add_argument("--frames", type=int, default=16, help="frames per batch in the speed measurement")
    add_basics(parser)
    add_repeats(parser)
    options = apply_defaults(parser.parse_args(arguments), QUICK)
    if options.device != "cpu" or options.quick:
        print_speeds(options, list(sys.argv[1:] if arguments is None else arguments))
        return
    costs = [compute_cost(name, *encoder) for name, encoder in published_encoders().items() if options.only in name]
    text = format_table(costs)
    print(text)
    if not options.only:
        options.out.mkdir(parents=True, exist_ok=True)
        rows = json.dumps([asdict(cost) for cost in costs], indent=1)
        write_atomically(options.out / "encoders.json", (rows + "\n").encode())
        write_atomically(options.out / "encoders.md", (text + "\n").encode())


def print_speeds(options: argparse.Namespace, arguments: list[str]) -> None:
    """Measure and print the frames per second of each encoder with random weights, at the first image size."""
    set_up_torch(options)
    ceiling = measure_matmul_speed(torch.device(options.device), torch.bfloat16)
    print(
        f"{describe_machine(options)}; bfloat16, {options.frames} frames per batch, peak {ceiling / 1e12:.3g} TFLOP/s"
    )
    print(f"{'':12} {'frames/s':>9} {'MFU':>6} {'peak GB':>8}")
    rows = Rows(options.json, **describe_run(options, arguments))
    for name, (encoder, _) in published_encoders().items():
        if options.only in name:
            rows.attempt(partial(add_speed, options, name, encoder, ceiling, rows), encoder=name)
            release_memory(options.device)
    rows.finish()


def add_speed(options: argparse.Namespace, name: str, encoder: EncoderSizes, ceiling: float, rows: Rows) -> None:
    """Measure the speed of an encoder, and add and print its row."""
    sizes = ModelSizes(encoder=encoder, image_size=IMAGE_SIZES[0], predictor=PredictorSizes(width=64, depth=1, heads=1))
    model = WorldModel.random(sizes, seed=0, dtype=torch.bfloat16, device=options.device).eval()
    pixels = torch.randn(1, options.frames, 3, sizes.image_size, sizes.image_size, device=options.device)
    encode = partial(model.encode, pixels, options.frames)
    with torch.no_grad():
        peak = measure_peak_gb(encode, options.device)
        timings = time_variants({name: encode}, options)[name]
    speed = timings.median_s and options.frames / timings.median_s
    mfu = speed and speed * frame_flops(sizes) / ceiling
    rows.add({"encoder": name, **timings.metrics(), "frames_per_s": speed, "mfu": mfu, "peak_gb": peak})
    print(f"{name:12} {format_cell(speed, 9, '.0f')} {format_cell(mfu, 6, '.0%')} {peak:8.2f}", flush=True)


def published_encoders() -> dict[str, tuple[EncoderSizes, tuple[str, ...]]]:
    """Return the sizes of each published encoder, and the downloads that contain it, by the encoder's name."""
    encoders: dict[str, tuple[EncoderSizes, tuple[str, ...]]] = {}
    for model in sorted(PUBLISHED, key=lambda model: model.encoder.width):
        if model.model_kind != "encoder":
            continue
        sizes = model.encoder.sizes(model.family, "tubelet")
        name = f"{'2.1' if model.family == 'v2.1' else '2.0'} {model.encoder.name}"
        encoders[name] = (sizes, (*encoders.get(name, (sizes, ()))[1], model.name))
    return encoders


def compute_cost(
    name: str,
    encoder: EncoderSizes,
    downloads: tuple[str, ...] = (),
    predictors: Mapping[str, PredictorSizes] = PREDICTORS,
    image_sizes: Sequence[int] = IMAGE_SIZES,
) -> Cost:
    """Return the cost of an encoder."""
    run = parse_config(RUN, where="benchmarks/encoders.py")
    by_size = {
        str(side): {
            key: ModelSizes(image_size=side, encoder=encoder, predictor=predictor)
            for key, predictor in predictors.items()
        }
        for side in image_sizes
    }
    # For the costs of the encoder alone any predictor will do.
    encoder_sizes = {side: next(iter(by_predictor.values())) for side, by_predictor in by_size.items()}
    first = encoder_sizes[str(image_sizes[0])]
    per_frame = bytes_per_frame(first.tokens_per_frame, encoder.width, "bf16") + image_bytes(first.image_size)
    return Cost(
        encoder=name,
        downloads=downloads,
        width=encoder.width,
        parameters=count_parameters(run, first).encoder,
        gflop_per_frame={side: frame_flops(sizes) / 1e9 for side, sizes in encoder_sizes.items()},
        latents_gb_per_hour=FRAMES_PER_HOUR * per_frame / GIGABYTE,
        peak_gb={
            side: {key: estimate_peak_gb(run, sizes) for key, sizes in by_predictor.items()}
            for side, by_predictor in by_size.items()
        },
    )


def estimate_peak_gb(run: Config, sizes: ModelSizes) -> float:
    """Return the memory that `vjepa2-ac doctor` estimates for a run with a model of these sizes, in 10^9 bytes."""
    estimate = estimate_memory(run, sizes)
    return estimate.total(checkpointing=estimate.checkpointing) / GIGABYTE


def format_table(costs: Sequence[Cost]) -> str:
    """Return the table in Markdown."""
    predictors = list(costs[0].peak_gb[next(iter(costs[0].peak_gb))])
    sides = list(costs[0].gflop_per_frame)
    titles = ["encoder", "`vjepa2-ac download`", "latent", "million weights", f"GFLOP a frame, {' / '.join(sides)} px"]
    titles += [
        f"latents at {sides[0]} px, GB per hour",
        *(f"{name}, GB at {' / '.join(sides)} px" for name in predictors),
    ]
    lines = [f"| {' | '.join(titles)} |", "|---|---|" + "---:|" * (len(titles) - 2)]
    for cost in costs:
        cells = [cost.encoder, ", ".join(cost.downloads), str(cost.width), f"{cost.parameters / 1e6:,.1f}"]
        cells += [" / ".join(f"{cost.gflop_per_frame[side]:,.0f}" for side in sides), f"{cost.latents_gb_per_hour:.1f}"]
        cells += [" / ".join(f"{cost.peak_gb[side][key]:.1f}" for side in sides) for key in predictors]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
