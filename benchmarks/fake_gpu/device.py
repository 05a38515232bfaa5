"""Make PyTorch report a fake GPU: compile a small library, and load it before PyTorch is imported."""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

SOURCE = Path(__file__).with_suffix(".cpp")
NO_COMPILER = "no C++ compiler"
_ALTERNATIVE = "On a machine with a GPU, measure: python benchmarks/train_step.py --device cuda"


@cache
def load() -> None:
    """Load the library; compile it first if it is not cached. Must be called before torch is imported.

    Raises:
        SystemExit: There is no compiler, PyTorch is missing or was built for GPUs, or it was imported already.
    """
    if "torch" in sys.modules:  # PyTorch registers the hooks only once, at its import
        raise SystemExit("torch was imported before the fake GPU was loaded. Call load() first.")
    ctypes.CDLL(str(_compile_library(_find_torch_folder())), mode=ctypes.RTLD_GLOBAL)


def _find_torch_folder() -> Path:
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        raise SystemExit("PyTorch is not installed. Run: pip install -c constraints.txt -e .")
    folder = Path(spec.origin).parent
    if re.search(r"^(cuda|hip)\b.*=\s*['\"]", (folder / "version.py").read_text(), re.MULTILINE):
        raise SystemExit(
            "this PyTorch is built for GPUs, and a fake GPU would replace the real ones. Install the CPU build"
            " in another environment: pip install torch --index-url https://download.pytorch.org/whl/cpu."
            f" {_ALTERNATIVE}"
        )
    return folder


def _compile_library(torch: Path) -> Path:
    """Return the path of the library, which is compiled once for each version and location of PyTorch."""
    inputs = SOURCE.read_text() + (torch / "version.py").read_text() + str(torch)
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vjepa2-ac"
    cache_folder = Path(os.environ.get("VJEPA2_AC_CACHE") or user_cache)
    library = cache_folder / f"fake-gpu-{hashlib.sha256(inputs.encode()).hexdigest()[:16]}.so"
    if library.exists():
        return library
    cache_folder.mkdir(parents=True, exist_ok=True)
    partial = library.with_suffix(f".{os.getpid()}")
    flags = ["-std=c++20", "-O0", "-shared", "-fPIC", f"-I{torch / 'include'}"]
    libraries = [f"-L{torch / 'lib'}", "-lc10", "-ltorch_cpu", f"-Wl,-rpath,{torch / 'lib'}"]
    command = [*_find_compiler(), *flags, str(SOURCE), "-o", str(partial), *libraries]
    process = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603
    if process.returncode:
        raise SystemExit(f"{shlex.join(command)}\n{process.stderr[-3000:]}\nThe fake GPU does not compile (see above)")
    partial.replace(library)
    return library


def _find_compiler() -> list[str]:
    user_command = shlex.split(os.environ.get("CXX", ""))
    for command in (user_command,) if user_command else (["g++"], ["c++"]):
        if shutil.which(command[0]):
            return command
    names = shlex.join(user_command) if user_command else "g++ or c++"
    raise SystemExit(f"{NO_COMPILER} ({names}): install one (apt-get install g++), or set CXX. {_ALTERNATIVE}")
