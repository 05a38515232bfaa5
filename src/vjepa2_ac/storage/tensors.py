"""Write and read safetensors files; names, shapes, types and values are checked on reading."""

from __future__ import annotations

import errno
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from vjepa2_ac import storage
from vjepa2_ac.errors import InputError

_FLOAT = "dense weights in float16, bfloat16, float32 or float64"
_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)


def save_tensors(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Write tensors to a new safetensors file, with the mode that the umask sets.

    Raises:
        OSError: The disk is full, or another error of the operating system.
    """
    path.touch()
    mode = stat.S_IMODE(path.stat().st_mode)
    try:
        contiguous = {name: value.detach().to("cpu").contiguous() for name, value in tensors.items()}
        save_file(contiguous, path, metadata={"format": "pt"})
        path.chmod(mode)  # safetensors 0.8 creates files with mode 0600
    except SafetensorError as error:  # only the text of the error contains the errno
        number = re.search(r"os error (\d+)", str(error))
        raise OSError(int(number[1]) if number else errno.EIO, str(error), str(path)) from None


def read_tensors(
    path: Path, like: Mapping[str, Tensor], *, needed: str, fix: str, dtype: torch.dtype | None = None
) -> dict[str, Tensor]:
    """Read a safetensors file and check names and shapes of its tensors.

    Args:
        path: The file.
        like: Tensors with the expected names and shapes.
        needed: The expected file, for messages.
        fix: The fix if the file contains other tensors or a number that is not finite, as a sentence.
        dtype: Type of the result; None: as in the file.

    Raises:
        InputError: The file is missing, truncated or of another format, or contains other tensors, NaN or infinity.
    """
    with open_safetensors(path, needed=needed) as file:
        shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118  # no iterator
        check_tensors(shapes, {name: value.shape for name, value in like.items()}, where=str(path), fix=fix)
        mapped = {name: file.get_tensor(name) for name in like}
        require_floats(mapped, where=str(path), fix=fix)
        # Copied, because the memory-mapped file may be replaced while the tensors are in use.
        weights = {name: value.to(dtype or value.dtype, copy=True) for name, value in mapped.items()}
    require_finite(weights, where=str(path), fix=fix)
    return weights


@contextmanager
def open_safetensors(path: Path, *, needed: str) -> Iterator[Any]:
    """Open a safetensors file with memory-mapped tensors.

    Raises:
        InputError: The file is missing, truncated, a git-lfs pointer, a pipe or of another format, or a tensor that is
            read in the `with` block is invalid.
        UnreachableError: The file cannot be read.
    """
    fix = "Copy or write the folder again"
    with storage.translate_read_errors(path, needed=needed, fix=fix):
        path.open("rb").close()  # safetensors reports a file without read permission as missing
        try:
            with safe_open(path, framework="pt") as file:
                yield file
        except (SafetensorError, OSError, TypeError) as error:  # TypeError: a dtype that torch does not have
            if storage.is_os_read_error(error):
                raise
            problem = f"not a complete safetensors file ({error})"
            raise InputError(where=str(path), found=problem, needed=needed, fix=fix) from None


def check_tensors(
    shapes: Mapping[str, tuple[int, ...]], expected: Mapping[str, tuple[int, ...]], *, where: str, fix: str
) -> None:
    """Refuse tensors that are missing, unknown or of another shape.

    Raises:
        InputError: Tensors do not match; the message names at most four of them.
    """
    problems = [f"missing: {name}" for name in expected.keys() - shapes.keys()]
    problems += [f"unexpected: {name}" for name in shapes.keys() - expected.keys()]
    for name in expected.keys() & shapes.keys():
        if shapes[name] != expected[name]:
            problems.append(f"{name} has shape {list(shapes[name])}, not {list(expected[name])}")
    if problems:
        shown = "; ".join(sorted(problems)[:4]) + (f"; and {len(problems) - 4} more" if len(problems) > 4 else "")
        problem = f"{len(problems)} tensors do not match ({shown})"
        raise InputError(where=where, found=problem, needed="exactly the tensors of the model", fix=fix)


def require_floats(tensors: Mapping[str, Tensor], *, where: str, fix: str) -> None:
    """Refuse weights whose type is not float16, bfloat16, float32 or float64, because casting would change them.

    Raises:
        InputError: A tensor has another type; the message names it.
    """
    for name, value in tensors.items():
        if value.dtype not in _FLOATS or value.layout is not torch.strided:
            raise InputError(
                where=where, found=f"{name} has type {value.dtype} and layout {value.layout}", needed=_FLOAT, fix=fix
            )


def require_finite(tensors: Mapping[str, Tensor], *, where: str, fix: str) -> None:
    """Refuse tensors that contain NaN or infinity.

    All values are finite if minimum and maximum are. This test needs one pass and no extra memory: about 1 s for 10^9
    numbers.

    Raises:
        InputError: A tensor contains such a value; the message names it.
    """
    for name, value in tensors.items():
        if value.is_floating_point() and value.numel() and not torch.stack(torch.aminmax(value)).isfinite().all():
            raise InputError(where=where, found=f"{name} contains NaN or infinity", needed="finite weights", fix=fix)
