"""The device of a run, and the processes that share its clips and sum their gradients; the first one writes.

Started by torchrun, by `accelerate launch`, or by anything else that sets RANK, LOCAL_RANK, WORLD_SIZE, MASTER_ADDR and
MASTER_PORT. Gradients are summed once per optimizer step, after the last micro-batch, and not by a wrapper around the
model: a process may have no clip in a micro-batch (`data.broken_episodes: skip`), and would leave a wrapper waiting.

What only some processes do may take hours (an index, a checkpoint on a slow disk) or fail: `run_on_first`,
`run_first_per_machine` and `run_on_all` let the others wait for it without a time-out, and raise its error in all.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, wait
from datetime import timedelta
from functools import cache, lru_cache
from typing import Any, Literal, TypeVar

import torch
import torch.distributed
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import InitProcessGroupKwargs
from torch import Tensor, nn
from torch.distributed.rendezvous import rendezvous

from vjepa2_ac.config import Config, ModelConfig, TrainingConfig
from vjepa2_ac.errors import InputError, UnreachableError, UserError, describe_error
from vjepa2_ac.process import StoppedError

_log = logging.getLogger(__name__)

PRECISIONS = {"bf16": torch.bfloat16, "fp16": torch.float16, "fp32": torch.float32}
_BF16_FROM = (8, 0)  # compute capability; PyTorch's is_bf16_supported includes emulation, which is slower than fp32
_CEILING_S = 0.2  # in which a matrix product is timed
_CUDA_MATRIX, _CPU_MATRIX = 8192, 512
_SLOW = 2.0  # times as long as in float32: of a CPU that computes bfloat16 without instructions for it

_SHARED_STORE = "TORCH_DISABLE_SHARE_RDZV_TCP_STORE"

_T = TypeVar("_T")
_Result = TypeVar("_Result")

_OTHER_LAUNCHES = ("FSDP", "DEEPSPEED", "MEGATRON_LM", "PARALLELISM_CONFIG")
_LAUNCHER = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
_UNSET = "Unset RANK and WORLD_SIZE if you did not start several processes"
_MEETING = timedelta(minutes=10)  # of all processes, before any work
_PATIENCE_S = 5.0  # until the others that are waited for are reported
_LONGEST_STEP = timedelta(hours=2)  # until a process is given up that does not come to a sum: its disk may have stalled
_AS_LONG_AS_IT_TAKES = timedelta(days=7)


# ---- the device, checked before anything is loaded ----


def is_on_cpu(training: TrainingConfig) -> bool:
    """Return whether a config computes on a CPU; else on CUDA.

    Raises:
        InputError: CUDA was requested and there is none.
    """
    has_cuda = torch.cuda.is_available()
    if training.device == "cuda" and not has_cuda:
        raise no_cuda_error(where="training.device", asked="cuda", instead="Set training.device=cpu")
    return training.device == "cpu" or not has_cuda


def no_cuda_error(*, where: str, asked: str, instead: str) -> InputError:
    """Return the error of a CUDA device where there is none."""
    fix = f"{instead}, or install a CUDA build of PyTorch and a driver"
    return InputError(where=where, found=f"{asked}, but this PyTorch sees no CUDA device", fix=fix)


def select_device(training: TrainingConfig) -> torch.device:
    """Return the device of this process, after checking that it supports the config.

    On a CPU without instructions for bfloat16 a config that asks for it is warned of.

    Raises:
        InputError: CUDA was requested and there is none, fp16 without CUDA, or bfloat16 on a GPU that has none.
    """
    on_cpu = is_on_cpu(training)
    if training.precision == "fp16" and on_cpu:
        needed = "a CUDA device: only there are losses scaled so that small gradients do not vanish"
        fix = "Set training.precision=fp32"
        raise InputError(where="training.precision", found="fp16 on a CPU", needed=needed, fix=fix)
    if training.cuda_graph and on_cpu:
        fix = "Set training.cuda_graph=false"
        raise InputError(where="training.cuda_graph", found="true on a CPU", needed="a CUDA device", fix=fix)
    device = torch.device("cpu") if on_cpu else torch.device("cuda", cuda_index())
    if training.precision == "bf16":  # fp32 is for float32 weights only, and fp16 casts any weights
        fix = f"Set training.precision={'fp32 with model.dtype=float32' if on_cpu else 'fp16'}"
        _require_bf16(device, where="training.precision", found="bf16", fix=fix)
    return device


def require_weight_dtype(model: ModelConfig, device: torch.device) -> None:
    """Refuse a weight type that the device does not support: planning computes in it, without autocast.

    On a CPU without instructions for bfloat16 it is warned of.

    Raises:
        InputError: They are bfloat16 on a GPU without it.
    """
    if model.dtype == "bfloat16":
        _require_bf16(device, where="model.dtype", found="bfloat16", fix="Set model.dtype=float32")


def bf16_slowdown() -> str | None:
    """Return what a product of matrices costs in bfloat16 on this CPU, if that is much slower than in float32.

    Measured here: which instructions a CPU has, and which of them PyTorch uses, no list of names tells.
    """
    cpu = torch.device("cpu")
    bf16, fp32 = (2e3 * _CPU_MATRIX**3 / measure_matmul_speed(cpu, dtype) for dtype in (torch.bfloat16, torch.float32))
    if bf16 < _SLOW * fp32:
        return None
    return f"a product of matrices takes {bf16:.3g} ms on this CPU, {fp32:.3g} ms in float32 ({bf16 / fp32:.0f} times)"


@lru_cache(maxsize=8)
def measure_matmul_speed(device: torch.device, dtype: torch.dtype) -> float:
    """Return the FLOPs per second of a large matrix product, the best within a fraction of a second.

    Measured once per device and type in a program: load by other programs affects it.
    """
    from torch.utils.benchmark import Timer  # many commands import this module and measure nothing

    size = _CUDA_MATRIX if device.type == "cuda" else _CPU_MATRIX
    generator = torch.Generator(device).manual_seed(0)  # its own, so that training's random numbers do not change
    matrix = torch.randn(size, size, device=device, generator=generator).to(dtype)
    timer = Timer("matrix @ matrix", globals={"matrix": matrix}, num_threads=torch.get_num_threads())
    return 2 * size**3 / min(timer.blocked_autorange(min_run_time=_CEILING_S).times)


def has_bf16(device: torch.device | None = None) -> bool:
    """Return whether a CUDA device computes in bfloat16; None, or one without an index: that of this process."""
    return torch.cuda.get_device_capability(_index_of(device)) >= _BF16_FROM


def _index_of(device: torch.device | None) -> int:
    return cuda_index() if device is None or device.index is None else device.index


def cuda_index() -> int:
    """Return the index of this process's CUDA device on its machine."""
    return int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count()


def autocast(training: TrainingConfig, device: torch.device) -> torch.autocast:
    """Return the arithmetic of `training.precision`, as Accelerate provides it."""
    kind = None if training.precision == "fp32" else PRECISIONS[training.precision]
    return torch.autocast(device.type, dtype=kind, enabled=kind is not None)


def _require_bf16(device: torch.device, *, where: str, found: str, fix: str) -> None:
    """Refuse bfloat16 where a GPU only emulates it; on a CPU that is slow in it, say so."""
    if device.type == "cpu":
        _warn(f"{where}: {found}", fix)
    if device.type != "cuda" or has_bf16(device):
        return
    index = _index_of(device)
    major, minor = torch.cuda.get_device_capability(index)
    found += f", on {torch.cuda.get_device_name(index)} of compute capability {major}.{minor}"
    needed = "8.0 or more (Ampere or later): earlier GPUs only emulate bfloat16"
    raise InputError(where=where, found=found, needed=needed, fix=fix)


@cache  # once
def _warn(found: str, fix: str) -> None:
    if slow := bf16_slowdown():
        _log.warning("%s: %s. %s", found, slow, fix)


# ---- processes ----


def make_accelerator(config: Config) -> Accelerator:
    """Return the device and precision of a run. With several processes it joins them.

    Raises:
        InputError: CUDA was requested and there is none, the device does not compute so (fp16 on a CPU, bf16 on an old
            GPU), the launch would share weights, or processes that it starts again would wait for those before.
        UnreachableError: Not all processes have come.
    """
    for name in _OTHER_LAUNCHES:
        if os.environ.get(f"ACCELERATE_USE_{name}", "false").lower() in {"1", "true", "yes", "on"}:
            found, needed = f"{name} is asked for", "processes that share the clips, each with the whole model"
            raise InputError(where="accelerate launch", found=found, needed=needed, fix="Start it without that")
    keeps_store = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    if keeps_store and os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0":
        found = "--max-restarts, and one store for all starts: a next one would wait for processes that have ended"
        fix = f"Set {_SHARED_STORE}=1 in the environment of torchrun, which needs --rdzv-backend=c10d"
        raise InputError(where="torchrun", found=found, needed="a store for each start", fix=fix)
    training, on_cpu = config.training, select_device(config.training).type == "cpu"
    _patient_group.cache_clear()
    _meet("gloo" if on_cpu else "nccl")
    AcceleratorState._reset_state(reset_partial_state=False)  # or a second run keeps the first's precision
    precision = "no" if training.precision == "fp32" else training.precision
    waits = InitProcessGroupKwargs(timeout=_LONGEST_STEP)
    return Accelerator(mixed_precision=precision, cpu=on_cpu, kwargs_handlers=[waits])


def _meet(backend: str) -> None:
    """Wait for all processes, but less long than for one that is slow later.

    Raises:
        InputError: The variables of a launcher are incomplete.
        UnreachableError: Not all have come.
    """
    rank, size, address, port = (os.environ.get(name, "") for name in _LAUNCHER)
    if (rank or "0", size or "1") == ("0", "1") or torch.distributed.is_initialized():
        return
    if not (rank.isdigit() and size.isdigit() and int(rank) < int(size) and address and port.isdigit()):
        found = " ".join(f"{name}={os.environ[name]}" for name in _LAUNCHER if name in os.environ)
        raise InputError(where="environment", found=found, needed=f"all of {', '.join(_LAUNCHER)}", fix=_UNSET)
    meeting: Future[Any] = Future()
    threading.Thread(target=_rendezvous, args=[meeting], daemon=True).start()  # signals are handled in this one
    if not wait([meeting], _PATIENCE_S).done:
        others = f"process {2 - int(rank)} of 2" if size == "2" else f"the other {int(size) - 1} of {size} processes"
        _log.warning("Waiting for %s at %s:%s. %s", others, address, port, _UNSET)
    try:
        store, number, processes = meeting.result()
    except RuntimeError as error:  # torch's DistError
        joined = re.search(r"(\d+)/\d+ clients joined", str(error))
        found = f"Only {joined[1]} of {size} processes" if joined else f"Not all {size} processes"
        found = f"{found} joined within {_MEETING.total_seconds() / 60:.3g} minutes ({error})"
        fix = "Look at what the others said, and whether they reach MASTER_ADDR"
        raise UnreachableError(where="processes of this run", found=found, fix=fix) from None
    store.set_timeout(_LONGEST_STEP)
    torch.distributed.init_process_group(backend, store=store, rank=number, world_size=processes, timeout=_LONGEST_STEP)


def _rendezvous(meeting: Future[Any]) -> None:
    try:
        meeting.set_result(next(rendezvous("env://", timeout=_MEETING)))
    except BaseException as error:  # or the other thread would wait for ever
        meeting.set_exception(error)


def run_on_first(accelerator: Accelerator, work: Callable[[], _T]) -> _T | None:
    """Let the first process do something that may fail, and take any time; return its result there, None elsewhere.

    Raises:
        Exception: What it raised; in all processes.
    """
    return run_on_all(accelerator, work if accelerator.is_main_process else lambda: None)


def run_first_per_machine(accelerator: Accelerator, work: Callable[[], _T]) -> _T:
    """Let all processes do the same, first one of each machine: the others find the files that it has written.

    Raises:
        Exception: What one of them raised; in all processes.
    """
    done: list[_T] = []
    if accelerator.num_processes > 1:
        run_on_all(accelerator, lambda: done.append(work()) if accelerator.is_local_main_process else None)
    return run_on_all(accelerator, lambda: done[0] if done else work())


def run_on_all(accelerator: Accelerator, work: Callable[[], _T]) -> _T:
    """Do something in this process, and wait until all have done their part; return the result.

    Raises:
        Exception: What the first process that failed raised; in all of them.
    """
    if accelerator.num_processes == 1:
        return work()
    result, error = None, None
    try:
        result = work()
    except Exception as own:
        error = own
    raise_first_error(accelerator, error)
    return result  # type: ignore[return-value]  # without an error it is set


def raise_first_error(accelerator: Accelerator, error: Exception | None) -> None:
    """Raise, in all processes, the error of the first of them that has one. All have to call."""
    told = error if error is None or isinstance(error, UserError) else _ToldError(f"{type(error).__name__}: {error}")
    _raise_first_of(all_gather_object(accelerator, told), accelerator.process_index, error)


class _ToldError(RuntimeError):
    """What another process, which has told it, met unexpectedly."""


def _raise_first_of(values: Iterable[object], own: int, error: Exception | None = None) -> None:
    for rank, first in enumerate(values):
        if isinstance(first, Exception):
            if error is not None and rank == own:
                raise error
            if isinstance(first, UserError):
                first.is_reported = True
            raise first


def all_reduce(accelerator: Accelerator, values: Sequence[float], kind: Literal["sum", "max"]) -> list[float]:
    """Return the sum or the largest of each value over all processes, bit-identical in each."""
    if accelerator.num_processes == 1:
        return [float(value) for value in values]
    own = torch.tensor(values, dtype=torch.float64, device=accelerator.device)
    torch.distributed.all_reduce(
        own, torch.distributed.ReduceOp.MAX if kind == "max" else torch.distributed.ReduceOp.SUM
    )
    return own.tolist()


def all_reduce_gradients(accelerator: Accelerator, parameters: Iterable[nn.Parameter]) -> None:
    """Replace the gradient of each parameter by its sum over all processes; no gradient counts as zero.

    They go together: hundreds of messages would each wait for the network. Each gradient keeps its memory, to which a
    CUDA graph writes.
    """
    if accelerator.num_processes == 1:
        return
    gradients: list[Tensor] = []
    for parameter in parameters:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        gradients.append(parameter.grad)
    together = torch.cat([gradient.flatten() for gradient in gradients])
    torch.distributed.all_reduce(together)
    sums = together.split([one.numel() for one in gradients])  # type: ignore[no-untyped-call]  # torch
    for gradient, summed in zip(gradients, sums, strict=True):
        gradient.copy_(summed.view_as(gradient))


def broadcast_object(accelerator: Accelerator, value: _T) -> _T:
    """Return the value of the first process, however long it takes; the others' values are ignored."""
    if accelerator.num_processes == 1:
        return value
    holder: list[Any] = [value if accelerator.is_main_process else None]
    torch.distributed.broadcast_object_list(holder, group=_patient_group())
    return holder[0]  # type: ignore[no-any-return]  # untyped


def all_gather_object(accelerator: Accelerator, value: _T) -> list[_T]:
    """Return the values of all processes, in their order, in each process, however long one takes."""
    values: list[Any] = [value] * accelerator.num_processes
    if accelerator.num_processes > 1:
        torch.distributed.all_gather_object(values, value, group=_patient_group())
    return values


def require_same(accelerator: Accelerator, value: object, *, what: str, fix: str) -> None:
    """Check that all processes have the same values.

    Raises:
        InputError: In all processes, if one differs; names the processes.
    """
    values = all_gather_object(accelerator, value)
    differing = [str(rank) for rank, other in enumerate(values) if other != values[0]]
    if differing:
        found = f"another one in process {', '.join(differing)} than in process 0"
        raise InputError(where=what, found=found, needed="the same for all processes of a run", fix=fix)


@cache
def _patient_group() -> torch.distributed.ProcessGroup:
    """Return a group without a time-out: NCCL's is minutes. A process that dies breaks the others' connections."""
    group: torch.distributed.ProcessGroup = torch.distributed.new_group(backend="gloo", timeout=_AS_LONG_AS_IT_TAKES)
    return group


# ---- work that processes share ----

_sharing: Accelerator | None = None


@contextlib.contextmanager
def share_work(accelerator: Accelerator) -> Iterator[None]:
    """Let the processes share the work of `own_share` and `map_shared` within the context; they do the same otherwise.

    Raises:
        Exception: What the first process that failed raised; in all of them.
    """
    global _sharing
    if accelerator.num_processes == 1:
        yield
        return
    _sharing, error = accelerator, None
    try:
        yield
    except _OthersError as others:  # all have it
        raise others.error from None
    except Exception as own:
        error = own
    finally:
        _sharing = None
    raise_first_error(accelerator, error)


class _OthersError(Exception):
    """What another process has raised where this one waited for its results."""

    def __init__(self, error: Exception) -> None:
        self.error = error
        super().__init__(str(error))


def own_share(count: int, at_once: int = 1) -> range:
    """Return which of so many things this process does: neighbours, in whole batches of `at_once`."""
    rank, processes = (_sharing.process_index, _sharing.num_processes) if _sharing else (0, 1)
    batches = math.ceil(count / at_once)
    first, last = (at_once * -(-batches * place // processes) for place in (rank, rank + 1))
    return range(first, min(count, last))


def gather_shared(values: Sequence[_T]) -> list[_T]:
    """Return the values of all processes that share work, those of the first process first."""
    if _sharing is None:
        return list(values)
    parts: list[Any] = all_gather_object(_sharing, list(values))
    try:
        _raise_first_of(parts, own=-1)
    except Exception as error:
        raise _OthersError(error) from None
    return [value for part in parts for value in part]


def map_shared(
    items: Sequence[_T], work: Callable[[_T], _Result], progress: Callable[[int, int], None]
) -> list[_Result]:
    """Return the result of some work on each item, in their order; processes that share it have a part of them each.

    Args:
        items: The same in all processes.
        work: What is done with one.
        progress: Called with (done, total) in those of this process.
    """
    own, found = own_share(len(items)), list[_Result]()
    for number in own:
        found.append(work(items[number]))
        progress(len(found), len(own))
    return gather_shared(found)


# ---- a whole run ----


@contextlib.contextmanager
def join_processes(config: Config) -> Iterator[Accelerator]:
    """Join the processes of a run, as `make_accelerator`.

    The launcher (torchrun, `accelerate launch`, or srun with `--kill-on-bad-exit=1`) ends all processes when one fails.

    Raises:
        UnreachableError: The connection to another process was lost.
    """
    accelerator = make_accelerator(config)
    try:
        yield accelerator
    except StoppedError:  # in all processes
        leave_processes()
        raise
    except RuntimeError as error:
        if accelerator.num_processes == 1 or not _is_lost_connection(error):
            raise
        fix = "Look at the output of the other processes. The same command resumes from the newest checkpoint"
        raise UnreachableError(where="another process of this run", found=describe_error(error), fix=fix) from error


def leave_processes() -> None:
    """End the process group, if there is one; all processes call it after success."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def _is_lost_connection(error: RuntimeError) -> bool:
    return isinstance(error, torch.distributed.DistError) or "gloo" in str(error)
