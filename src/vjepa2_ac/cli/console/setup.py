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
    from vjepa2_ac.model.model_files import Published
    from vjepa2_ac.training.cost import MemoryEstimate

_MILLION, _GIGABYTE = 10**6, 10**9
_LEAST_SHOWN = 500_000  # bytes: less would be shown as 0.000 GB
_COLUMNS = ("holds", "family", "encoder", "pixels", "file", "licence", "encoder's key")
UNTESTED = (
    "Estimated with fake tensors. On an H100 the estimate for training from frames was within 1 % of the peak that"
    " PyTorch measured. For training from cached latents it was not compared after its last change. The CUDA allowance"
    " was not measured."
)
PUBLISHED_NOTES = (
    "The column encoder has the number of parameters; pixels are the size of its images.",
    "The licence is that of Meta's repository. Sizes with 'about' are estimates.",
    "Meta publishes no hashes of these files: `download` checks their size.",
)
_INSTRUCTIONS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16", "asimd", "sve", "bf16")  # of products of matrices
_SETTINGS = re.compile("(ACCELERATE|CUDA|GOMP|MKL|MUJOCO|NCCL|OMP|PYTORCH|TORCH|VJEPA2_AC)_.*|.*RANK|WORLD_SIZE")


def report_lines() -> Iterator[str]:
    """Yield what a bug report needs of this machine: versions, CPU, GPU, settings; no secret, no path.

    PyTorch comes last, because its import may fail; the last line says what this machine can run.
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
    gpu = _output("nvidia-smi --query-gpu=name,memory.total,driver_version --format=csv,noheader")
    yield f"GPU: {gpu or 'none'}"

    import torch

    usable = counted(torch.cuda.device_count(), "usable GPU")
    yield f"PyTorch: CUDA {torch.version.cuda or 'not in this build'}, {usable}"
    if torch.cuda.is_available():
        yield "A GPU is usable. Whether a run fits is not measured here: `vjepa2-ac doctor CONFIG` estimates it."
    elif gpu:
        yield "The GPU is not usable: install a PyTorch build whose CUDA version the driver supports."
    else:
        yield "CPU only: the demo runs here; fine-tuning the released model needs a GPU."


def _output(command: str) -> str:
    """Return what a program prints; nothing where it is not there."""
    return subprocess.getoutput(f"{command} 2>/dev/null")  # noqa: S605 - our own words


def _with_version(requirement: str) -> str:
    name = re.split(r"[^\w.-]", requirement)[0]
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} (not installed)"


def memory_lines(estimate: MemoryEstimate) -> list[str]:
    """Return one line for every part of at least 0.001 GB, then both totals."""
    weights = estimate.parameters
    counts = f"encoder {weights.encoder:,}, predictor {weights.predictor:,}, trained {weights.trained:,}"
    lines = [f"Parameters: {counts}", "Estimated GPU memory, part by part (not all parts are needed at once):"]
    parts = {name: size for name, size in estimate.parts.items() if size >= _LEAST_SHOWN}
    lines += [f"  {name:<37}{size / _GIGABYTE:8.3f} GB" for name, size in parts.items()]
    for checkpointing, word in ((False, "without"), (True, "with")):
        chosen = "  <- this config" if checkpointing == estimate.checkpointing else ""
        total = estimate.total(checkpointing=checkpointing) / _GIGABYTE
        lines.append(f"  peak {word + ' checkpointing':<32}{total:8.3f} GB{chosen}")
    return [*lines, UNTESTED]


def verdict(needed: int, available: int, gpu: str | None, overrides: list[str] | None) -> str:
    """Return whether the run fits, or what to change.

    Args:
        needed: Bytes at the peak.
        available: Bytes of the GPU.
        gpu: Its name; None: there is none on this machine.
        overrides: Changes that make it fit, or None if none do.
    """
    fits, size, room = needed <= available, f"{needed / _GIGABYTE:.1f} GB", f"{available / _GIGABYTE:.1f} GB"
    text = f"{'Fits' if fits else 'Does not fit'}: the estimated peak is {size}; {gpu or 'a usual GPU'} has {room}."
    if not fits:
        text += f" It fits with {', '.join(overrides)}." if overrides else " It needs a larger GPU or a smaller model."
    return text if gpu else f"{text}\nThis machine: not measured; it needs a GPU, PyTorch finds none."


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


def published_summary(one: Published, url: str) -> str:
    """Return what a checkpoint is, its size and licence, and where it comes from; shown before it is fetched."""
    parts = (
        "encoder and action-conditioned predictor" if one.holds == "world model" else "without a predictor for actions"
    )
    return (
        f"{one.name}: {one.holds}, {parts}; V-JEPA {one.family.removeprefix('v')}, {one.encoder.name},"
        f" {one.image_size} px\n{one.size}, licence {one.licence}; from {url}; its size is checked"
    )
