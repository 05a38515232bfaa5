"""How many frames a second does a decoder learn from, and show? The linear decoder beside it is the baseline.

    python benchmarks/decoder.py                                          # the demo's: 96 px, 128 numbers a token
    python benchmarks/decoder.py --device cuda --dtype bfloat16 --image-size 256 --latent-dim 1408 --batch 64 \
        --size small medium

A training step is forward, backward, optimizer and moving average, from latents that are there. Ways take turns; a
ratio under 1 is slower than the baseline, which is one matrix. On CUDA beside it the peak of memory, alone on the
device; `python benchmarks/fake_gpu decoder` counts that of a training step without a GPU.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

import torch
from memory import peak_alone, peak_gb
from rows import Rows, cell
from timing import about, add_basics, add_repeats, introduction, prepare, ratio, settle, timed

from vjepa2_ac.config import DecoderConfig
from vjepa2_ac.decoding.frame_pairs import Pairs
from vjepa2_ac.decoding.network import Decoder, DecoderShape
from vjepa2_ac.decoding.steps import DecoderSteps

QUICK = {"image_size": 32, "latent_dim": 8, "batch": 2, "size": ["tiny"], "repeats": 1, "warm_up": 0}
PATCH = 16


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each size, of learning and of showing."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = settle(_parse(given), QUICK)
    prepare(options)
    print(f"{introduction(options)}; {options.image_size} px, {options.latent_dim} numbers, batch {options.batch}")
    print(f"{'':10} {'work':8} {'ms':>9} {'frames/s':>9} {'ratio':>6}{'peak GB':>9}")
    rows = Rows(options.json, **about(options, given))
    for work, ways_of in (("show", _showing), ("learn", _learning)):
        peaks = {size: _peak(options, partial(ways_of, options), size) for size in ("linear", *options.size)}
        seen = timed(ways_of(options, "linear", *options.size), options)
        for way, turns in seen.items():
            seconds, gained = turns.median_s, ratio(seen["linear"], turns)
            rows.add({"work": work, "way": way, **turns.figures(), "ratio": gained, "peak_gb": peaks[way]})
            if seconds is None:
                print(f"{way:10} {work:8} {turns.problem}")
                continue
            shown = cell(gained, 6, ".2f") + cell(peaks[way], 9, ".2f")
            print(f"{way:10} {work:8} {seconds * 1e3:9.1f} {options.batch / seconds:9.1f} {shown}", flush=True)


def _peak(options: argparse.Namespace, ways_of: Callable[..., Any], size: str) -> float | None:
    """Return the peak of a size alone on the device, in 10^9 bytes; None on a CPU, where a process is no measure."""
    if options.device == "cpu":
        return None
    found = peak_alone(lambda: peak_gb(ways_of(size)[size], options.device), [], options.device)
    return None if found["problem"] else float(found["peak_gb"])


def _showing(options: argparse.Namespace, *sizes: str) -> dict[str, Callable[[], object]]:
    latents = torch.randn(options.batch, _grid(options) ** 2, options.latent_dim, device=options.device)
    decoders = {size: Decoder(_shape(options, size)) for size in sizes}
    ways: dict[str, Callable[[], object]] = {}
    for size, decoder in decoders.items():
        decoder.initialise(torch.Generator().manual_seed(0))
        ways[size] = partial(_shown, decoder.to(options.device).eval(), latents, options)
    return ways


@torch.no_grad()
def _shown(decoder: Decoder, latents: torch.Tensor, options: argparse.Namespace) -> None:
    with _autocast(options):
        decoder.decode(latents)


def _learning(options: argparse.Namespace, *sizes: str) -> dict[str, Callable[[], object]]:
    pixels = (options.batch, 3, options.image_size, options.image_size)
    images = torch.randint(0, 256, pixels, dtype=torch.uint8, device=options.device)
    latents = torch.randn(options.batch, _grid(options) ** 2, options.latent_dim, device=options.device)
    ways: dict[str, Callable[[], object]] = {}
    for size in sizes:
        config = DecoderConfig(size="tiny", batch_size=options.batch)  # the shape says the size
        steps = DecoderSteps(
            _shape(options, size), config, 0, torch.device(options.device), partial(_autocast, options), None
        )
        ways[size] = partial(steps.do, 1, Pairs(latents, images, ()))
    return ways


def _autocast(options: argparse.Namespace) -> torch.autocast | nullcontext[None]:
    kind = getattr(torch, options.dtype)
    return nullcontext() if kind == torch.float32 else torch.autocast(options.device.partition(":")[0], dtype=kind)


def _grid(options: argparse.Namespace) -> int:
    return int(options.image_size // PATCH)


def _shape(options: argparse.Namespace, size: str) -> DecoderShape:
    return DecoderShape(size, options.latent_dim, _grid(options), PATCH)  # type: ignore[arg-type]  # one of the sizes


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_basics(parser)
    add_repeats(parser)
    parser.add_argument("--image-size", type=int, default=96)
    parser.add_argument("--latent-dim", type=int, default=128)
    parser.add_argument("--batch", type=int, default=24, help="frames")
    parser.add_argument("--size", nargs="+", choices=("tiny", "small", "medium"), default=["tiny"])
    parser.add_argument("--dtype", choices=("float32", "bfloat16"), default="float32")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main(sys.argv[1:])
