"""Measure the cost of each published encoder, and compare with the estimates of `vjepa2-ac doctor`.

    python benchmarks/encoders.py               # all of them
    python benchmarks/encoders.py --only ViT-B  # those whose name has this in it; writes nothing
    python benchmarks/encoders.py --device cuda # frames a second on a GPU, instead, with random weights in bfloat16

Nothing is loaded: parameters and operations are counted, memory is measured on tensors without numbers.
OUT/encoders.json has the numbers, OUT/encoders.md the table.
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
from memory import let_go
from memory import peak_gb as peak_of
from rows import Rows, cell
from timing import about, add_basics, add_repeats, introduction, prepare, settle, timed

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
FRAMES_PER_HOUR = 15 * 3600  # of DROID's rate
PREDICTORS = {
    "24x1024": PredictorSizes(width=1024, depth=24, heads=16),
    "12x768": PredictorSizes(width=768, depth=12, heads=12),
    "12x384": PredictorSizes(width=384, depth=12, heads=6),
}
RUN = {  # a predictor that is trained whole, from frames
    "run_dir": "run",
    "data": {"path": "set", "frames": 8},
    "model": {"base": "random"},
    "adapter": {"kind": "none"},
    "training": {"batch_size": 2, "gradient_checkpointing": True},
}


@dataclass(frozen=True)
class Cost:
    """What an encoder costs."""

    encoder: str
    downloads: tuple[str, ...]  # names of `vjepa2-ac download`
    width: int  # of a latent
    parameters: int
    gflop_per_frame: dict[str, float]  # by image size in pixels
    latents_gb_per_hour: float  # of 15 Hz video, every frame, bfloat16, at the first image size
    peak_gb: dict[str, dict[str, float]]  # of training, by image size and predictor


def main(given: Sequence[str] | None = None) -> None:
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
    options = settle(parser.parse_args(given), QUICK)
    if options.device != "cpu" or options.quick:
        print_speeds(options, list(sys.argv[1:] if given is None else given))
        return
    costs = [cost_of(name, *about) for name, about in published().items() if options.only in name]
    text = table(costs)
    print(text)
    if not options.only:
        options.out.mkdir(parents=True, exist_ok=True)
        rows = json.dumps([asdict(one) for one in costs], indent=1)
        write_atomically(options.out / "encoders.json", (rows + "\n").encode())
        write_atomically(options.out / "encoders.md", (text + "\n").encode())


def print_speeds(options: argparse.Namespace, given: list[str]) -> None:
    """Print and add the frames a second of each encoder, of random weights, at the first image size."""
    prepare(options)
    ceiling = measure_matmul_speed(torch.device(options.device), torch.bfloat16)
    print(f"{introduction(options)}; bfloat16, {options.frames} frames per batch, peak {ceiling / 1e12:.3g} TFLOP/s")
    print(f"{'':12} {'frames/s':>9} {'MFU':>6} {'peak GB':>8}")
    rows = Rows(options.json, **about(options, given))
    for name, (encoder, _) in published().items():
        if options.only in name:
            rows.attempt(partial(add_speed, options, name, encoder, ceiling, rows), encoder=name)
            let_go(options.device)
    rows.finish()


def add_speed(options: argparse.Namespace, name: str, encoder: EncoderSizes, ceiling: float, rows: Rows) -> None:
    """Print and add the row of an encoder."""
    sizes = ModelSizes(encoder=encoder, image_size=IMAGE_SIZES[0], predictor=PredictorSizes(width=64, depth=1, heads=1))
    model = WorldModel.random(sizes, seed=0, dtype=torch.bfloat16, device=options.device).eval()
    pixels = torch.randn(1, options.frames, 3, sizes.image_size, sizes.image_size, device=options.device)
    encode = partial(model.encode, pixels, options.frames)
    with torch.no_grad():
        peak = peak_of(encode, options.device)
        turns = timed({name: encode}, options)[name]
    speed = turns.median_s and options.frames / turns.median_s
    mfu = speed and speed * frame_flops(sizes) / ceiling
    rows.add({"encoder": name, **turns.figures(), "frames_per_s": speed, "mfu": mfu, "peak_gb": peak})
    print(f"{name:12} {cell(speed, 9, '.0f')} {cell(mfu, 6, '.0%')} {peak:8.2f}", flush=True)


def published() -> dict[str, tuple[EncoderSizes, tuple[str, ...]]]:
    """Return the published encoders by name: sizes, and the downloads that have them, whatever they were trained at."""
    found: dict[str, tuple[EncoderSizes, tuple[str, ...]]] = {}
    for one in sorted(PUBLISHED, key=lambda one: one.encoder.width):
        if one.model_kind != "encoder":
            continue
        sizes = one.encoder.sizes(one.family, "tubelet")
        name = f"{'2.1' if one.family == 'v2.1' else '2.0'} {one.encoder.name}"
        found[name] = (sizes, (*found.get(name, (sizes, ()))[1], one.name))
    return found


def cost_of(
    name: str,
    encoder: EncoderSizes,
    downloads: tuple[str, ...] = (),
    predictors: Mapping[str, PredictorSizes] = PREDICTORS,
    image_sizes: Sequence[int] = IMAGE_SIZES,
) -> Cost:
    """Return what an encoder costs."""
    run = parse_config(RUN, where="benchmarks/encoders.py")
    by_size = {
        str(side): {key: ModelSizes(image_size=side, encoder=encoder, predictor=one) for key, one in predictors.items()}
        for side in image_sizes
    }
    any_of = {side: next(iter(by_predictor.values())) for side, by_predictor in by_size.items()}
    first = any_of[str(image_sizes[0])]
    per_frame = bytes_per_frame(first.tokens_per_frame, encoder.width, "bf16") + image_bytes(first.image_size)
    return Cost(
        encoder=name,
        downloads=downloads,
        width=encoder.width,
        parameters=count_parameters(run, first).encoder,
        gflop_per_frame={side: frame_flops(sizes) / 1e9 for side, sizes in any_of.items()},
        latents_gb_per_hour=FRAMES_PER_HOUR * per_frame / GIGABYTE,
        peak_gb={
            side: {key: peak_gb(run, sizes) for key, sizes in by_predictor.items()}
            for side, by_predictor in by_size.items()
        },
    )


def peak_gb(run: Config, sizes: ModelSizes) -> float:
    """Return what `vjepa2-ac doctor` says of a run on such a model, in 10^9 bytes."""
    estimate = estimate_memory(run, sizes)
    return estimate.total(checkpointing=estimate.checkpointing) / GIGABYTE


def table(costs: Sequence[Cost]) -> str:
    """Return the table in Markdown."""
    predictors = list(costs[0].peak_gb[next(iter(costs[0].peak_gb))])
    sides = list(costs[0].gflop_per_frame)
    titles = ["encoder", "`vjepa2-ac download`", "latent", "million weights", f"GFLOP a frame, {' / '.join(sides)} px"]
    titles += [
        f"latents at {sides[0]} px, GB per hour",
        *(f"{one}, GB at {' / '.join(sides)} px" for one in predictors),
    ]
    lines = [f"| {' | '.join(titles)} |", "|---|---|" + "---:|" * (len(titles) - 2)]
    for one in costs:
        cells = [one.encoder, ", ".join(one.downloads), str(one.width), f"{one.parameters / 1e6:,.1f}"]
        cells += [" / ".join(f"{one.gflop_per_frame[side]:,.0f}" for side in sides), f"{one.latents_gb_per_hour:.1f}"]
        cells += [" / ".join(f"{one.peak_gb[side][key]:.1f}" for side in sides) for key in predictors]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
