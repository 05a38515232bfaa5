"""Measure the memory of a training step in isolation, and find the largest batch that fits."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from memory import capped, let_go, peak_alone, peak_gb
from rows import OUT_OF_MEMORY, Row, Rows, cell
from train_step_variants import OFFICIAL, OFFICIAL_FULL, Bench, Setting, our_ways

NAMES = f"{'frames':>6} {'batch':>5} {'checkpointing':>13} {'source':>6}  {'way':18}"
MEMORY_TITLES = f"{NAMES}{'peak GB':>9}{'doctor':>9}{'off by':>9}"
_SCRIPT = Path(__file__).with_name("train_step.py")
_LARGEST = 128  # clips


def memory_row(options: argparse.Namespace, given: list[str], dtype: str, setting: Setting, way: str) -> Row:
    """Return the peak of a way in a setting, and on CUDA what doctor says of it; elsewhere all of PyTorch counts."""
    own = [
        "--frames", str(setting.frames), "--batch", str(setting.batch), "--dtype", dtype,
        "--checkpointing", "on" if setting.checkpointing else "off",
        "--source", "pixels" if setting.encoder else "cache", "--memory-of", way,
    ]  # fmt: skip
    alone = partial(memory_of_way, options, dtype, setting, way)
    measured = peak_alone(alone, [str(_SCRIPT), *given, *own], options.device, options.cap_gb)
    has_estimate = way not in {OFFICIAL, OFFICIAL_FULL} and options.device != "cpu"
    estimate = Bench(options, dtype).estimated_gb(setting) if has_estimate else None
    return {
        "measured": "memory", "dtype": dtype, **asdict(setting), "way": way, "cap_gb": options.cap_gb, **measured,
        "estimate_gb": estimate,
    }  # fmt: skip


def memory_of_way(options: argparse.Namespace, dtype: str, setting: Setting, way: str) -> float:
    """Return the peak in 10^9 bytes of two steps of one way, with nothing of the others in memory."""
    bench = Bench(options, dtype)
    step = bench.step(setting, way)
    bench.keep_only(way)
    if not setting.encoder and way not in {OFFICIAL, OFFICIAL_FULL}:
        bench.model.remove_encoder()  # as a run from a cache does
    return peak_gb(step, options.device)


def memory_line(row: Row) -> str:
    """Return a row of the table of memory."""
    if row["problem"]:
        return f"{names_of(row)}{row['problem']}"
    peak, estimate = row["peak_gb"], row["estimate_gb"]
    off_by = estimate and estimate / peak - 1
    return f"{names_of(row)}{peak:9.2f}{cell(estimate, 9, '.2f')}{cell(off_by, 9, '+.0%')}"


def names_of(row: Row) -> str:
    """Return the beginning of a row of a table: what setting, and which way."""
    again, source = "yes" if row["checkpointing"] else "no", "pixels" if row["encoder"] else "cache"
    return f"{row['frames']:6} {row['batch']:5} {again:>13} {source:>6}  {row['way']:18}"


def asked(options: argparse.Namespace) -> Iterator[Setting]:
    """Yield all settings; where the largest batch is asked for, it is still 0."""
    all_of_them = itertools.product(options.source, options.frames, options.checkpointing, options.batch)
    for source, frames, again, batch in all_of_them:
        yield Setting(frames, 0 if batch == "largest" else int(batch), again == "on", source == "pixels")


def found(options: argparse.Namespace, dtype: str, setting: Setting, rows: Rows) -> list[Setting]:
    """Return a setting with its batch; the largest is looked for with the last way, and what was found is a row."""
    if setting.batch:
        return [setting]
    way = our_ways(options.attention, compiled=options.compile)[-1]
    named = {"measured": "largest batch", "dtype": dtype, **asdict(setting), "way": way, "cap_gb": options.cap_gb}
    batch = rows.attempt(partial(find_largest, options, dtype, setting, way, rows), **named)
    let_go(options.device)
    if batch is None:
        return []
    rows.add({**named, "batch": batch, "problem": None if batch else OUT_OF_MEMORY})
    print(f"{names_of(named | {'batch': batch})}is the largest batch that fits", flush=True)
    return [replace(setting, batch=batch)] if batch else []


def find_largest(options: argparse.Namespace, dtype: str, setting: Setting, way: str, rows: Rows) -> int:
    """Return the largest batch of which two steps fit with nothing else in memory; on a CPU nothing runs out: 2."""
    if options.device == "cpu":
        return 2
    bench = Bench(options, dtype)

    def does_fit(batch: int) -> bool:
        tried = fits(bench, replace(setting, batch=batch), way)
        print(f"  batch {batch} {'fits' if tried else 'does not fit'}", flush=True)
        rows.so_far({"measured": "largest batch", **asdict(setting), "batch": batch, "way": way, "fits": tried})
        return tried

    with capped(options.cap_gb, options.device):
        return largest_batch(does_fit)


def largest_batch(does_fit: Callable[[int], bool]) -> int:
    """Return the largest batch that fits, of at most 128; 0 where not even one clip does."""
    if not does_fit(1):
        return 0
    fitting, too_large = 1, _LARGEST + 1
    while too_large - fitting > 1:
        tried = min(2 * fitting, (fitting + too_large) // 2)
        if does_fit(tried):
            fitting = tried
        else:
            too_large = tried
    return fitting


def fits(bench: Bench, setting: Setting, way: str) -> bool:
    """Return whether two steps fit into memory.

    Raises:
        RuntimeError: They fail otherwise; says how.
    """
    started = bench.start(setting, way)
    if started.problem not in {None, OUT_OF_MEMORY}:
        raise RuntimeError(f"batch {setting.batch}: {started.problem}")
    return started.problem is None
