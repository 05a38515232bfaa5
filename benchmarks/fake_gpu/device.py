"""How does PyTorch come to see a GPU that is not there? A small library is compiled, and loaded before PyTorch."""

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
_INSTEAD = "On a machine with a GPU, measure: python benchmarks/train_step.py --device cuda"


@cache
def load() -> None:
    """Compile the library if that was not done before, and load it. To be called before torch is imported.

    Raises:
        SystemExit: There is no compiler, PyTorch is missing or has a real CUDA, or it was imported already.
    """
    if "torch" in sys.modules:  # it asks once for hooks, and keeps what it was told
        raise SystemExit("torch was imported before the fake GPU was loaded: call load() first")
    ctypes.CDLL(str(_compiled(_torch_folder())), mode=ctypes.RTLD_GLOBAL)


def _torch_folder() -> Path:
    found = importlib.util.find_spec("torch")
    if found is None or found.origin is None:
        raise SystemExit("PyTorch is not installed. Run: pip install -c constraints.txt -e .")
    folder = Path(found.origin).parent
    if re.search(r"^(cuda|hip)\b.*=\s*['\"]", (folder / "version.py").read_text(), re.MULTILINE):
        raise SystemExit(
            "this PyTorch is built for GPUs, and an imagined one would take the place of its own. Install the CPU build"
            f" in another environment: pip install torch --index-url https://download.pytorch.org/whl/cpu. {_INSTEAD}"
        )
    return folder


def _compiled(torch: Path) -> Path:
    """Return the library for a PyTorch, compiled once for each version and place."""
    made_of = SOURCE.read_text() + (torch / "version.py").read_text() + str(torch)
    users = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vjepa2-ac"
    kept = Path(os.environ.get("VJEPA2_AC_CACHE") or users)
    library = kept / f"fake-gpu-{hashlib.sha256(made_of.encode()).hexdigest()[:16]}.so"
    if library.exists():
        return library
    kept.mkdir(parents=True, exist_ok=True)
    unfinished = library.with_suffix(f".{os.getpid()}")
    flags = ["-std=c++20", "-O0", "-shared", "-fPIC", f"-I{torch / 'include'}"]
    linked = [f"-L{torch / 'lib'}", "-lc10", "-ltorch_cpu", f"-Wl,-rpath,{torch / 'lib'}"]
    command = [*_compiler(), *flags, str(SOURCE), "-o", str(unfinished), *linked]
    done = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603
    if done.returncode:
        raise SystemExit(f"{shlex.join(command)}\n{done.stderr[-3000:]}\nThe fake GPU does not compile (above)")
    unfinished.replace(library)
    return library


def _compiler() -> list[str]:
    given = shlex.split(os.environ.get("CXX", ""))
    for command in (given,) if given else (["g++"], ["c++"]):
        if shutil.which(command[0]):
            return command
    looked_for = shlex.join(given) if given else "g++ or c++"
    raise SystemExit(f"{NO_COMPILER} ({looked_for}): install one (apt-get install g++), or set CXX. {_INSTEAD}")
