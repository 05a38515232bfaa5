"""Measure the memory of a training step in isolation, and find the largest batch that fits."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from memory import limit_memory, measure_peak_alone, measure_peak_gb, release_memory
from rows import OUT_OF_MEMORY, Row, Rows, format_cell
from train_step_variants import OFFICIAL, OFFICIAL_FULL, Bench, Setting, our_variants

NAMES = f"{'frames':>6} {'batch':>5} {'checkpointing':>13} {'source':>6}  {'variant':18}"  # columns of `format_names`
MEMORY_TITLES = f"{NAMES}{'peak GB':>9}{'doctor':>9}{'off by':>9}"
_SCRIPT = Path(__file__).with_name("train_step.py")
_MAX_BATCH = 128  # clips; no larger batch is tried


def measure_memory_row(
    options: argparse.Namespace, arguments: list[str], dtype: str, setting: Setting, variant: str
) -> Row:
    """Return a row with the peak memory of a variant in a setting, and on CUDA with the estimate of `doctor`.

    On a CPU there is no estimate, because the peak includes PyTorch itself.
    """
    own_arguments = [
        "--frames", str(setting.frames), "--batch", str(setting.batch), "--dtype", dtype,
        "--checkpointing", "on" if setting.checkpointing else "off",
        "--source", "pixels" if setting.encoder else "cache", "--memory-of", variant,
    ]  # fmt: skip
    measure = partial(measure_variant_memory, options, dtype, setting, variant)
    command = [str(_SCRIPT), *arguments, *own_arguments]
    measured = measure_peak_alone(measure, command, options.device, options.cap_gb)
    has_estimate = variant not in {OFFICIAL, OFFICIAL_FULL} and options.device != "cpu"
    estimate = Bench(options, dtype).estimated_gb(setting) if has_estimate else None
    return {
        "measured": "memory", "dtype": dtype, **asdict(setting), "variant": variant, "cap_gb": options.cap_gb,
        **measured, "estimate_gb": estimate,
    }  # fmt: skip


def measure_variant_memory(options: argparse.Namespace, dtype: str, setting: Setting, variant: str) -> float:
    """Return the peak memory of two steps of one variant in 10^9 bytes, without the other variants in memory."""
    bench = Bench(options, dtype)
    step = bench.step(setting, variant)
    bench.keep_only(variant)
    if not setting.encoder and variant not in {OFFICIAL, OFFICIAL_FULL}:
        bench.model.remove_encoder()  # as in a run with cached latents
    return measure_peak_gb(step, options.device)


def format_memory_line(row: Row) -> str:
    """Return a line of the table of memory."""
    if row["problem"]:
        return f"{format_names(row)}{row['problem']}"
    peak, estimate = row["peak_gb"], row["estimate_gb"]
    off_by = estimate and estimate / peak - 1
    return f"{format_names(row)}{peak:9.2f}{format_cell(estimate, 9, '.2f')}{format_cell(off_by, 9, '+.0%')}"


def format_names(row: Row) -> str:
    """Return the first columns of a line: the setting and the variant."""
    checkpointing, source = "yes" if row["checkpointing"] else "no", "pixels" if row["encoder"] else "cache"
    return f"{row['frames']:6} {row['batch']:5} {checkpointing:>13} {source:>6}  {row['variant']:18}"


def list_settings(options: argparse.Namespace) -> Iterator[Setting]:
    """Yield all requested settings; the batch size 0 means the largest batch."""
    combinations = itertools.product(options.source, options.frames, options.checkpointing, options.batch)
    for source, frames, checkpointing, batch in combinations:
        yield Setting(frames, 0 if batch == "largest" else int(batch), checkpointing == "on", source == "pixels")


def resolve_batch(options: argparse.Namespace, dtype: str, setting: Setting, rows: Rows) -> list[Setting]:
    """Return a setting with a batch size; for the largest batch, search with the last variant and add a row.

    The list is empty if not even one clip fits.
    """
    if setting.batch:
        return [setting]
    variant = our_variants(options.attention, compiled=options.compile)[-1]
    about = {
        "measured": "largest batch",
        "dtype": dtype,
        **asdict(setting),
        "variant": variant,
        "cap_gb": options.cap_gb,
    }
    batch = rows.attempt(partial(find_largest, options, dtype, setting, variant, rows), **about)
    release_memory(options.device)
    if batch is None:
        return []
    rows.add({**about, "batch": batch, "problem": None if batch else OUT_OF_MEMORY})
    print(f"{format_names(about | {'batch': batch})}is the largest batch that fits", flush=True)
    return [replace(setting, batch=batch)] if batch else []


def find_largest(options: argparse.Namespace, dtype: str, setting: Setting, variant: str, rows: Rows) -> int:
    """Return the largest batch of which two steps fit into the memory."""
    if options.device == "cpu":
        return 2  # a CPU does not run out of memory in a test of the program
    bench = Bench(options, dtype)

    def does_fit(batch: int) -> bool:
        fits = do_steps_fit(bench, replace(setting, batch=batch), variant)
        print(f"  batch {batch} {'fits' if fits else 'does not fit'}", flush=True)
        row = {"measured": "largest batch", **asdict(setting), "batch": batch, "variant": variant, "fits": fits}
        rows.write_unfinished(row)
        return fits

    with limit_memory(options.cap_gb, options.device):
        return search_largest_batch(does_fit)


def search_largest_batch(does_fit: Callable[[int], bool]) -> int:
    """Return the largest batch that fits, at most 128 clips; 0 if not even one clip fits."""
    if not does_fit(1):
        return 0
    fitting, too_large = 1, _MAX_BATCH + 1
    while too_large - fitting > 1:
        batch = min(2 * fitting, (fitting + too_large) // 2)
        if does_fit(batch):
            fitting = batch
        else:
            too_large = batch
    return fitting


def do_steps_fit(bench: Bench, setting: Setting, variant: str) -> bool:
    """Return whether two steps fit into memory.

    Raises:
        RuntimeError: A step failed for another reason.
    """
    warm_up = bench.warm_up(setting, variant)
    if warm_up.problem not in {None, OUT_OF_MEMORY}:
        raise RuntimeError(f"batch {setting.batch}: {warm_up.problem}")
    return warm_up.problem is None
