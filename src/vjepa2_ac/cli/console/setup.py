"""Lines and tables of doctor and download: a run's memory part by part, this machine, the published checkpoints."""

from __future__ import annotations

import os
import platform
import re
import shlex
import subprocess
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from vjepa2_ac import __version__
from vjepa2_ac.errors import counted

if TYPE_CHECKING:
    from vjepa2_ac.model.checkpoints.published import Published
    from vjepa2_ac.training.cost.memory import MemoryEstimate

_MILLION, _GIGABYTE = 10**6, 10**9
_COLUMNS = ("holds", "family", "encoder", "pixels", "file", "licence", "encoder's key")
UNTESTED = (
    "Measured on tensors without numbers. On an H100 PyTorch's own peak was the same to 1 %; the CUDA context is"
    " estimated."
)
_INSTRUCTIONS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16", "asimd", "sve", "bf16")  # of products of matrices
_SETTINGS = re.compile("(ACCELERATE|CUDA|GOMP|MKL|MUJOCO|NCCL|OMP|PYTORCH|TORCH|VJEPA2_AC)_.*|.*RANK|WORLD_SIZE")


def report_lines() -> Iterator[str]:
    """Yield what a bug report needs of this machine: versions, CPU, GPU, settings; no secret, no path.

    What PyTorch sees comes last: importing it may be what fails.
    """
    root, about = Path(__file__).parents[4], Path("/proc/cpuinfo").read_text(encoding="utf-8")
    commit = _output(f"git -C {shlex.quote(str(root))} describe --always --dirty") if (root / ".git").exists() else ""
    yield f"vjepa2-ac {__version__} {commit}".rstrip()
    yield f"Python {platform.python_version()}, {platform.platform()}"
    name, has = re.search(r"model name\s*: (.*)", about), [one for one in _INSTRUCTIONS if one in about.split()]
    yield f"CPU: {name[1] if name else platform.machine()}, {counted(os.cpu_count() or 1, 'core')}, {' '.join(has)}"
    asked = [line for line in requires("vjepa2-ac") or [] if not re.search("extra == .(data|dev|docs)", line)]
    yield f"Libraries: {', '.join(dict.fromkeys(_with_version(line) for line in asked))}"
    for key, value in sorted(os.environ.items()):
        if _SETTINGS.fullmatch(key):
            yield f"{key}={'(a path)' if '/' in value else value}"
    yield f"GPU: {_output('nvidia-smi --query-gpu=name,memory.total,driver_version --format=csv,noheader') or 'none'}"

    import torch

    yield f"PyTorch: CUDA {torch.version.cuda}, sees {counted(torch.cuda.device_count(), 'GPU')}"


def _output(command: str) -> str:
    """Return what a program prints; nothing where it is not there."""
    return subprocess.getoutput(f"{command} 2>/dev/null")  # noqa: S605 - our own words


def _with_version(requirement: str) -> str:
    name = re.split(r"[^\w.-]", requirement)[0]
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} (not here)"


def memory_lines(estimate: MemoryEstimate) -> list[str]:
    """Return one line for every part, then both totals."""
    weights = estimate.parameters
    lines = [f"  weights: encoder {weights.encoder:,}, predictor {weights.predictor:,}, trained {weights.trained:,}"]
    lines += [f"  {name:<28}{size / _GIGABYTE:8.3f} GB  {about}" for name, size, about in estimate.parts]
    for checkpointing, word in ((False, "without"), (True, "with")):
        chosen = "  <- this config" if checkpointing == estimate.checkpointing else ""
        total = estimate.total(checkpointing=checkpointing) / _GIGABYTE
        lines.append(f"  peak {word + ' checkpointing':<23}{total:8.3f} GB{chosen}")
    return [*lines, UNTESTED]


def verdict(needed: int, available: int, gpu: str, knobs: list[str] | None) -> str:
    """Return whether the run fits, or what to change.

    Args:
        needed: Bytes at the peak.
        available: Bytes of the GPU.
        gpu: Its name.
        knobs: Changes that make it fit, or None if none do.
    """
    room = f"{gpu}, {available / _GIGABYTE:.1f} GB"
    if needed <= available:
        return f"It fits on {room}, with {(available - needed) / _GIGABYTE:.1f} GB to spare."
    short = f"It does not fit on {room}: {(needed - available) / _GIGABYTE:.1f} GB too much."
    if knobs is None:
        return f"{short} No knob makes it fit: it needs a larger GPU or a smaller model."
    return f"{short} It would with {', '.join(knobs)}."


def published_table(published: Sequence[Published]) -> Table:
    """Return a table with a row for each published checkpoint; names are not divided, however narrow it is."""
    table = Table(box=box.SIMPLE_HEAD, title="Published checkpoints", title_justify="left")
    table.add_column("name", no_wrap=True, min_width=max(len(one.name) for one in published))
    for column in _COLUMNS:
        table.add_column(column, overflow="fold")
    for one in published:
        encoder = f"{one.encoder.name}, {one.encoder.parameters / _MILLION:,.0f} M"
        pixels = str(one.image_size)
        table.add_row(one.name, one.holds, one.family, encoder, pixels, one.size, one.licence, one.key)
    return table


def published_notes() -> list[str]:
    """Return what the table does not say, a line each."""
    encoders = (
        "Beside an encoder: its parameters, and the key of its weights in the file; pixels are those of its images."
    )
    return [
        encoders,
        "The licence is that of Meta's repository. Sizes with 'about' are estimates.",
        "Meta publishes no hashes of these files: what is checked is the size.",
    ]


def published_summary(one: Published, url: str) -> str:
    """Return what a checkpoint is, its size and licence, and where it comes from; shown before it is fetched."""
    parts = (
        "encoder and action-conditioned predictor" if one.holds == "world model" else "without a predictor for actions"
    )
    return (
        f"{one.name}: {one.holds}, {parts}; V-JEPA {one.family.removeprefix('v')}, {one.encoder.name},"
        f" {one.image_size} px\n{one.size}, licence {one.licence}; from {url}; its size is checked"
    )
