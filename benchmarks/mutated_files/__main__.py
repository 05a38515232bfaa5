"""Does a file of anybody ever end in a traceback, a wait, a flood or a crash? Files of each form, spoiled at random.

    python benchmarks/mutated_files --mutations 300            # each form 300 times; 5,000 take hours
    python benchmarks/mutated_files --only TFRecord --first 17 --mutations 1 --show

Each spoiled file is read in a process that imports once and is killed when one takes too long or too much. Counted are
files that are read (damage may be where nothing looks, or be no damage), refused with an InputError, and what must not
be: other errors, hangs, memory, crashes, messages without end. These are listed with the number that makes them again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import select
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
FINE = ("read", "refused")
BAD = ("traceback", "memory", "flood", "hang", "crash")
_LONGEST_MESSAGE = 10_000


def main() -> int:
    """Print a table; return 1 where something was neither read nor refused."""
    options = _options()
    if options.worker:
        _work(options)
        return 0
    names = options.only or _names()
    bad = 0
    print(f"{'':28} " + " ".join(f"{outcome:>9}" for outcome in (*FINE, *BAD)))
    with ThreadPoolExecutor(options.processes) as pool:
        for name, found in zip(names, pool.map(lambda name: _count(name, options), names), strict=True):
            counted = Counter(outcome for _, outcome, _ in found)
            print(f"{name:28} " + " ".join(f"{counted[outcome]:9}" for outcome in (*FINE, *BAD)), flush=True)
            wrong = [one for one in found if one[1] in BAD]
            bad += len(wrong)
            for number, outcome, detail in wrong[: options.listed]:
                print(f"    {number}: {outcome}: {detail}", flush=True)
    return int(bad > 0)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--mutations", type=int, default=300, help="of each form (300)")
    parser.add_argument("--first", type=int, default=0, help="number of the first (0)")
    parser.add_argument("--only", nargs="+", metavar="FORM", help="these forms")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=20.0, help="of computing that a file may take (20)")
    parser.add_argument("--memory-gb", type=float, default=3.0, help="that a file may take (3)")
    parser.add_argument("--listed", type=int, default=20, help="of each form (20)")
    parser.add_argument("--show", action="store_true", help="the whole traceback")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    return parser.parse_args()


def _names() -> list[str]:
    code = "import sys; sys.path[:0] = sys.argv[1:]; import readers; print('\\n'.join(readers.READERS))"
    run = subprocess.run(  # noqa: S603 - this Python, this folder
        [sys.executable, "-W", "ignore", "-c", code, str(Path(__file__).parent), str(ROOT / "tests" / "support")],
        check=True, capture_output=True, text=True, env=_environment(),
    )  # fmt: skip
    return run.stdout.splitlines()


def _environment() -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1"}


def _count(name: str, options: argparse.Namespace) -> list[tuple[int, str, str]]:
    """Return number, outcome and detail of each spoiled file of a form; a process that dies is started again."""
    found: list[tuple[int, str, str]] = []
    number, end = options.first, options.first + options.mutations
    while number < end:
        for one in _outcomes(name, number, end, options):
            found.append(one)
            number = one[0] + 1
            if options.show:
                print(*one, sep="\n", flush=True)
    return found


def _outcomes(name: str, first: int, end: int, options: argparse.Namespace) -> Iterator[tuple[int, str, str]]:
    command = [sys.executable, "-W", "ignore", __file__, "--worker", name, "--first", str(first)]
    command += ["--mutations", str(end - first), "--memory-gb", str(options.memory_gb)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=_environment()) as worker:  # noqa: S603
        number = first
        ready = _line(worker, seconds=600.0)
        if ready is None:
            raise RuntimeError(f"{name}: the process did not begin")
        while number < end:
            line = _line(worker, seconds=options.seconds)
            if line is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    worker.wait(5)  # one that ends itself closes its pipe first
                hangs = worker.poll() is None
                worker.kill()
                yield number, "hang" if hangs else "crash", f"status {worker.wait()}"
                return
            told = json.loads(line)
            yield number, told["outcome"], told["detail"]
            number += 1


def _line(worker: subprocess.Popen[bytes], *, seconds: float) -> bytes | None:
    """Return the next line; None where the process ends, or computes for so long without one."""
    if worker.stdout is None:
        raise ValueError("no pipe")
    begun, asked = _computed_s(worker.pid), time.monotonic()
    while not select.select([worker.stdout], [], [], 0.5)[0]:
        if _computed_s(worker.pid) - begun > seconds or time.monotonic() - asked > 30 * seconds:
            return None
    return worker.stdout.readline() or None


def _computed_s(process: int) -> float:
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _work(options: argparse.Namespace) -> None:
    """Spoil and read file after file, a line of JSON for each."""
    sys.path[:0] = [str(Path(__file__).parent), str(ROOT / "tests" / "support")]
    import readers
    from numpy.random import default_rng

    warnings.simplefilter("ignore")
    reader = readers.READERS[options.worker]
    with tempfile.TemporaryDirectory() as temporary:
        os.environ["VJEPA2_AC_CACHE"] = str(Path(temporary) / "kept")
        valid, spoiled = Path(temporary) / "valid", Path(temporary) / "spoiled"
        valid.mkdir()
        reader.write(valid)
        shutil.copytree(valid, spoiled)
        reader.read(spoiled)  # or the example itself is none
        _limit_memory(options.memory_gb)
        _tell({"ready": True})
        for number in range(options.first, options.first + options.mutations):
            shutil.rmtree(spoiled)
            shutil.rmtree(os.environ["VJEPA2_AC_CACHE"], ignore_errors=True)
            shutil.copytree(valid, spoiled)
            random = default_rng([zlib.crc32(options.worker.encode()), number])
            files = sorted(path for path in spoiled.glob(reader.files) if path.is_file())
            path = files[int(random.integers(len(files)))]
            path.write_bytes(reader.mutators[number % len(reader.mutators)](path.read_bytes(), random))
            if random.random() < 0.8:
                reader.reseal(spoiled)
            outcome, detail = _read(reader.read, spoiled, options.memory_gb)
            _tell({"outcome": outcome, "detail": detail})


def _limit_memory(gigabytes: float) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + int(gigabytes * 2**30)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _read(read: Any, folder: Path, gigabytes: float) -> tuple[str, str]:
    from vjepa2_ac.errors import InputError

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        read(folder)
        outcome, detail = "read", ""
    except InputError as error:
        outcome, detail = ("refused", str(error)) if len(str(error)) < _LONGEST_MESSAGE else ("flood", str(error)[:300])
    except MemoryError:
        outcome, detail = "memory", _where()
    except Exception:
        outcome, detail = "traceback", _where()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if grown > gigabytes * 2**20 / 2:
        return "memory", f"{grown / 2**20:.1f} GB: {outcome} {detail}"
    return outcome, detail


def _where() -> str:
    kind, error, _ = sys.exc_info()
    frames = [frame for frame in traceback.extract_tb(sys.exc_info()[2]) if "vjepa2_ac" in frame.filename]
    places = [f"{Path(frame.filename).name}:{frame.lineno} {frame.name}" for frame in frames[-3:]]
    return f"{kind.__name__ if kind else ''}: {str(error)[:150]!r} at {' > '.join(places)}"


def _tell(line: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def _main(arguments: Sequence[str]) -> int:
    sys.argv[1:] = arguments
    return main()


if __name__ == "__main__":
    sys.exit(main())
