"""Select the device, and coordinate data-parallel processes, which share the clips and sum their gradients.

Only the first process writes files. The processes are started by torchrun, by `accelerate launch`, or by any other
launcher that sets RANK, LOCAL_RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT. Gradients are summed once per optimizer
step, after the last micro-batch, and not by DistributedDataParallel: a process may have no clip in a micro-batch
(`data.broken_episodes: skip`), for which DistributedDataParallel would wait forever.

Work that only some processes do may take hours (an index, a checkpoint on a slow disk) or fail. `run_on_first`,
`run_first_per_machine` and `run_on_all` let the other processes wait without a timeout, and raise an error of the work
in all processes.
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
_BF16_CAPABILITY = (
    8,
    0,
)  # compute capability; PyTorch's is_bf16_supported includes emulation, which is slower than fp32
_TIMING_S = 0.2  # duration of the timing of a matrix product
_CUDA_MATRIX, _CPU_MATRIX = 8192, 512
_SLOW = 2.0  # bfloat16 is slow on a CPU if a matrix product takes this many times as long as in float32

_SHARED_STORE = "TORCH_DISABLE_SHARE_RDZV_TCP_STORE"

_T = TypeVar("_T")
_Result = TypeVar("_Result")

_UNSUPPORTED_MODES = ("FSDP", "DEEPSPEED", "MEGATRON_LM", "PARALLELISM_CONFIG")
_LAUNCHER = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
_UNSET = "Unset RANK and WORLD_SIZE if you did not start several processes"
_JOIN_TIMEOUT = timedelta(minutes=10)  # for all processes to join at the start
_REPORT_AFTER_S = 5.0  # time after which a warning names the processes that are missing
_COLLECTIVE_TIMEOUT = timedelta(hours=2)  # a stalled disk can delay a process this long
_NO_TIMEOUT = timedelta(days=7)  # for work of unknown duration


# ---- the device ----


def is_on_cpu(training: TrainingConfig) -> bool:
    """Return whether a config uses the CPU instead of CUDA.

    Raises:
        InputError: CUDA was requested but is not available.
    """
    has_cuda = torch.cuda.is_available()
    if training.device == "cuda" and not has_cuda:
        raise no_cuda_error(where="training.device", requested="cuda", instead="Set training.device=cpu")
    return training.device == "cpu" or not has_cuda


def no_cuda_error(*, where: str, requested: str, instead: str) -> InputError:
    """Return the error that a CUDA device was requested but is not available."""
    fix = f"{instead}, or install a CUDA build of PyTorch and a driver"
    return InputError(where=where, found=f"{requested}, but PyTorch finds no CUDA device", fix=fix)


def select_device(training: TrainingConfig) -> torch.device:
    """Return the device of this process, after checking that it supports the config.

    Logs a warning if the config uses bfloat16 on a CPU without instructions for it.

    Raises:
        InputError: CUDA was requested but is not available, or the device does not support the precision.
    """
    on_cpu = is_on_cpu(training)
    if training.precision == "fp16" and on_cpu:
        needed = "a CUDA device, since fp16 needs loss scaling"
        fix = "Set training.precision=fp32"
        raise InputError(where="training.precision", found="fp16 on a CPU", needed=needed, fix=fix)
    if training.cuda_graph and on_cpu:
        fix = "Set training.cuda_graph=false"
        raise InputError(where="training.cuda_graph", found="true on a CPU", needed="a CUDA device", fix=fix)
    device = torch.device("cpu") if on_cpu else torch.device("cuda", cuda_index())
    if training.precision == "bf16":  # fp32 is for float32 weights only, and fp16 casts any weights
        fix = f"Set training.precision={'fp32 with model.dtype=float32' if on_cpu else 'fp16'}"
        _require_bf16(device, where="training.precision", value="bf16", fix=fix)
    return device


def require_weight_dtype(model: ModelConfig, device: torch.device) -> None:
    """Check that the device supports the type of the weights, in which planning computes without autocast.

    Logs a warning for bfloat16 on a CPU without instructions for it.

    Raises:
        InputError: The type is bfloat16 and the GPU does not support it.
    """
    if model.dtype == "bfloat16":
        _require_bf16(device, where="model.dtype", value="bfloat16", fix="Set model.dtype=float32")


def bf16_slowdown() -> str | None:
    """Return a description of the slowdown of bfloat16 on this CPU relative to float32; None if it is not slow.

    It is measured, because the name of a CPU does not show which instructions PyTorch uses.
    """
    cpu = torch.device("cpu")
    bf16, fp32 = (2e3 * _CPU_MATRIX**3 / measure_matmul_speed(cpu, dtype) for dtype in (torch.bfloat16, torch.float32))
    if bf16 < _SLOW * fp32:
        return None
    return f"a matrix product takes {bf16:.3g} ms on this CPU, {bf16 / fp32:.0f} times as long as in float32"


@lru_cache(maxsize=8)
def measure_matmul_speed(device: torch.device, dtype: torch.dtype) -> float:
    """Return the FLOP/s of a large matrix product: the best of several repetitions.

    It is measured once per device and type; other programs on the machine affect it.
    """
    from torch.utils.benchmark import Timer  # imported late, since most commands do not need it

    size = _CUDA_MATRIX if device.type == "cuda" else _CPU_MATRIX
    generator = torch.Generator(device).manual_seed(0)  # does not change the random numbers of training
    matrix = torch.randn(size, size, device=device, generator=generator).to(dtype)
    timer = Timer("matrix @ matrix", globals={"matrix": matrix}, num_threads=torch.get_num_threads())
    return 2 * size**3 / min(timer.blocked_autorange(min_run_time=_TIMING_S).times)


def has_bf16(device: torch.device | None = None) -> bool:
    """Return whether a CUDA device supports bfloat16; without an index, whether the device of this process does."""
    return torch.cuda.get_device_capability(_index_of(device)) >= _BF16_CAPABILITY


def _index_of(device: torch.device | None) -> int:
    return cuda_index() if device is None or device.index is None else device.index


def cuda_index() -> int:
    """Return the index of this process's CUDA device on its machine."""
    return int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count()


def autocast(training: TrainingConfig, device: torch.device) -> torch.autocast:
    """Return the autocast context of `training.precision`, as Accelerate creates it."""
    kind = None if training.precision == "fp32" else PRECISIONS[training.precision]
    return torch.autocast(device.type, dtype=kind, enabled=kind is not None)


def _require_bf16(device: torch.device, *, where: str, value: str, fix: str) -> None:
    """Raise if a GPU only emulates bfloat16; log a warning if a CPU is slow with it."""
    if device.type == "cpu":
        _warn_if_slow(f"{where}: {value}", fix)
    if device.type != "cuda" or has_bf16(device):
        return
    index = _index_of(device)
    major, minor = torch.cuda.get_device_capability(index)
    problem = f"{value}, on {torch.cuda.get_device_name(index)} of compute capability {major}.{minor}"
    needed = "8.0 or more (Ampere or later): earlier GPUs only emulate bfloat16"
    raise InputError(where=where, found=problem, needed=needed, fix=fix)


@cache  # warns once
def _warn_if_slow(setting: str, fix: str) -> None:
    if slow := bf16_slowdown():
        _log.warning("%s: %s. %s", setting, slow, fix)


# ---- processes ----


def make_accelerator(config: Config) -> Accelerator:
    """Return the accelerator of a run, with its device and precision; with several processes, join them.

    Raises:
        InputError: The device does not support the config, or the launcher uses an unsupported mode (sharded weights,
            or restarts with a shared store).
        UnreachableError: Not all processes joined.
    """
    for name in _UNSUPPORTED_MODES:
        if os.environ.get(f"ACCELERATE_USE_{name}", "false").lower() in {"1", "true", "yes", "on"}:
            raise InputError(
                where="accelerate launch",
                found=f"{name} is enabled",
                needed="data-parallel processes, each with the whole model",
                fix=f"Disable {name}",
            )
    keeps_store = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    if keeps_store and os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0":
        problem = (
            "--max-restarts with a store that all starts share, so a restart would wait for processes that have exited"
        )
        fix = f"Set {_SHARED_STORE}=1 in the environment of torchrun, which needs --rdzv-backend=c10d"
        raise InputError(where="torchrun", found=problem, needed="a separate store for each start", fix=fix)
    training, on_cpu = config.training, select_device(config.training).type == "cpu"
    _patient_group.cache_clear()
    _join_process_group("gloo" if on_cpu else "nccl")
    # Without this reset a second run in this process would keep the precision of the first one.
    AcceleratorState._reset_state(reset_partial_state=False)
    precision = "no" if training.precision == "fp32" else training.precision
    timeout = InitProcessGroupKwargs(timeout=_COLLECTIVE_TIMEOUT)
    return Accelerator(mixed_precision=precision, cpu=on_cpu, kwargs_handlers=[timeout])


def _join_process_group(backend: str) -> None:
    """Join the process group, with a shorter timeout than that of collectives.

    Raises:
        InputError: Environment variables of a launcher are missing or invalid.
        UnreachableError: Not all processes joined.
    """
    rank, size, address, port = (os.environ.get(name, "") for name in _LAUNCHER)
    if (rank or "0", size or "1") == ("0", "1") or torch.distributed.is_initialized():
        return
    if not (rank.isdigit() and size.isdigit() and int(rank) < int(size) and address and port.isdigit()):
        variables = " ".join(f"{name}={os.environ[name]}" for name in _LAUNCHER if name in os.environ)
        raise InputError(where="environment", found=variables, needed=f"all of {', '.join(_LAUNCHER)}", fix=_UNSET)
    joining: Future[Any] = Future()
    # A separate thread, so that this one can handle signals.
    threading.Thread(target=_rendezvous, args=[joining], daemon=True).start()
    if not wait([joining], _REPORT_AFTER_S).done:
        missing = f"process {2 - int(rank)} of 2" if size == "2" else f"the other {int(size) - 1} of {size} processes"
        _log.warning("Waiting for %s at %s:%s. %s", missing, address, port, _UNSET)
    try:
        store, number, processes = joining.result()
    except RuntimeError as error:  # torch's DistError
        joined = re.search(r"(\d+)/\d+ clients joined", str(error))
        count = f"Only {joined[1]} of {size} processes" if joined else f"Not all {size} processes"
        problem = f"{count} joined within {_JOIN_TIMEOUT.total_seconds() / 60:.3g} minutes ({error})"
        fix = "Check the output of the other processes, and whether they can reach MASTER_ADDR"
        raise UnreachableError(where="processes of this run", found=problem, fix=fix) from None
    store.set_timeout(_COLLECTIVE_TIMEOUT)
    torch.distributed.init_process_group(
        backend, store=store, rank=number, world_size=processes, timeout=_COLLECTIVE_TIMEOUT
    )


def _rendezvous(joining: Future[Any]) -> None:
    try:
        joining.set_result(next(rendezvous("env://", timeout=_JOIN_TIMEOUT)))
    except BaseException as error:  # otherwise the main thread would wait forever
        joining.set_exception(error)


def run_on_first(accelerator: Accelerator, work: Callable[[], _T]) -> _T | None:
    """Run a function in the first process while the others wait, without a timeout; return None in the others.

    Raises:
        Exception: The error of the first process, in all processes.
    """
    return run_on_all(accelerator, work if accelerator.is_main_process else lambda: None)


def run_first_per_machine(accelerator: Accelerator, work: Callable[[], _T]) -> _T:
    """Run a function in all processes, in one process of each machine first, so that the others find its files.

    Raises:
        Exception: The first error of any process, in all processes.
    """
    done: list[_T] = []
    if accelerator.num_processes > 1:
        run_on_all(accelerator, lambda: done.append(work()) if accelerator.is_local_main_process else None)
    return run_on_all(accelerator, lambda: done[0] if done else work())


def run_on_all(accelerator: Accelerator, work: Callable[[], _T]) -> _T:
    """Run a function in all processes, wait for all of them without a timeout, and return this process's result.

    Raises:
        Exception: The error of the first process that failed, in all processes.
    """
    if accelerator.num_processes == 1:
        return work()
    result, error = None, None
    try:
        result = work()
    except Exception as raised:
        error = raised
    raise_first_error(accelerator, error)
    return result  # type: ignore[return-value]  # without an error it is set


def raise_first_error(accelerator: Accelerator, error: Exception | None) -> None:
    """Raise the error of the first process that has one, in all processes. All processes must call this."""
    is_unexpected = error is not None and not isinstance(error, UserError)
    message = _OtherProcessError(f"{type(error).__name__}: {error}") if is_unexpected else error
    _raise_first_of(all_gather_object(accelerator, message), accelerator.process_index, error)


class _OtherProcessError(RuntimeError):
    """An unexpected error of another process, which prints it."""


def _raise_first_of(values: Iterable[object], own_rank: int, error: Exception | None = None) -> None:
    for rank, first in enumerate(values):
        if isinstance(first, Exception):
            if error is not None and rank == own_rank:
                raise error
            if isinstance(first, UserError):
                first.is_reported = True
            raise first


def all_reduce(accelerator: Accelerator, values: Sequence[float], kind: Literal["sum", "max"]) -> list[float]:
    """Return the sum or the maximum of each value over all processes, bit-identical in each process."""
    if accelerator.num_processes == 1:
        return [float(value) for value in values]
    tensor = torch.tensor(values, dtype=torch.float64, device=accelerator.device)
    torch.distributed.all_reduce(
        tensor, torch.distributed.ReduceOp.MAX if kind == "max" else torch.distributed.ReduceOp.SUM
    )
    return tensor.tolist()


def all_reduce_gradients(accelerator: Accelerator, parameters: Iterable[nn.Parameter]) -> None:
    """Replace the gradient of each parameter by its sum over all processes; no gradient counts as zero.

    All gradients are sent in one message. Each gradient keeps its memory, because a CUDA graph writes to it.
    """
    if accelerator.num_processes == 1:
        return
    gradients: list[Tensor] = []
    for parameter in parameters:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        gradients.append(parameter.grad)
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    torch.distributed.all_reduce(flat)
    sums = flat.split([gradient.numel() for gradient in gradients])  # type: ignore[no-untyped-call]  # torch
    for gradient, summed in zip(gradients, sums, strict=True):
        gradient.copy_(summed.view_as(gradient))


def broadcast_object(accelerator: Accelerator, value: _T) -> _T:
    """Return the value of the first process, without a timeout; the values of the others are ignored."""
    if accelerator.num_processes == 1:
        return value
    holder: list[Any] = [value if accelerator.is_main_process else None]
    torch.distributed.broadcast_object_list(holder, group=_patient_group())
    return holder[0]  # type: ignore[no-any-return]  # untyped


def all_gather_object(accelerator: Accelerator, value: _T) -> list[_T]:
    """Return the values of all processes by rank, without a timeout."""
    values: list[Any] = [value] * accelerator.num_processes
    if accelerator.num_processes > 1:
        torch.distributed.all_gather_object(values, value, group=_patient_group())
    return values


def require_same(accelerator: Accelerator, value: object, *, what: str, fix: str) -> None:
    """Check that all processes have the same values.

    Raises:
        InputError: The values differ; raised in all processes, with the ranks that differ.
    """
    values = all_gather_object(accelerator, value)
    differing = [str(rank) for rank, value in enumerate(values) if value != values[0]]
    if differing:
        differences = f"a different value in process {', '.join(differing)} than in process 0"
        raise InputError(where=what, found=differences, needed="the same for all processes of a run", fix=fix)


@cache
def _patient_group() -> torch.distributed.ProcessGroup:
    """Return a process group without a timeout. If a process dies, the connections of the others fail at once."""
    group: torch.distributed.ProcessGroup = torch.distributed.new_group(backend="gloo", timeout=_NO_TIMEOUT)
    return group


# ---- work that processes share ----

_sharing: Accelerator | None = None


@contextlib.contextmanager
def share_work(accelerator: Accelerator) -> Iterator[None]:
    """Within this context the processes share the work of `own_share` and `map_shared`; outside each does all of it.

    Raises:
        Exception: The error of the first process that failed, in all processes.
    """
    global _sharing
    if accelerator.num_processes == 1:
        yield
        return
    _sharing, error = accelerator, None
    try:
        yield
    except _GatheredError as gathered:  # all processes have it
        raise gathered.error from None
    except Exception as raised:
        error = raised
    finally:
        _sharing = None
    raise_first_error(accelerator, error)


class _GatheredError(Exception):
    """An error of another process, received instead of its results."""

    def __init__(self, error: Exception) -> None:
        self.error = error
        super().__init__(str(error))


def own_share(count: int, at_once: int = 1) -> range:
    """Return the range of the `count` items that this process handles, in whole batches of `at_once`."""
    rank, processes = (_sharing.process_index, _sharing.num_processes) if _sharing else (0, 1)
    batches = math.ceil(count / at_once)
    first, last = (at_once * -(-batches * index // processes) for index in (rank, rank + 1))
    return range(first, min(count, last))


def gather_shared(values: Sequence[_T]) -> list[_T]:
    """Return the values of all processes that share work, in the order of their ranks."""
    if _sharing is None:
        return list(values)
    parts: list[Any] = all_gather_object(_sharing, list(values))
    try:
        _raise_first_of(parts, own_rank=-1)
    except Exception as error:
        raise _GatheredError(error) from None
    return [value for part in parts for value in part]


def map_shared(
    items: Sequence[_T], work: Callable[[_T], _Result], progress: Callable[[int, int], None]
) -> list[_Result]:
    """Apply a function to each item and return the results in order; processes that share work handle a part each.

    Args:
        items: The items, the same in all processes.
        work: The function.
        progress: Called with (done, total), counted over the items of this process.
    """
    share, results = own_share(len(items)), list[_Result]()
    for index in share:
        results.append(work(items[index]))
        progress(len(results), len(share))
    return gather_shared(results)


# ---- start and end of a run ----


@contextlib.contextmanager
def join_processes(config: Config) -> Iterator[Accelerator]:
    """Create the accelerator of a run, and report lost connections to other processes as such.

    The launcher (torchrun, `accelerate launch`, or srun with `--kill-on-bad-exit=1`) ends all processes when one fails.

    Raises:
        UnreachableError: The connection to another process was lost.
    """
    accelerator = make_accelerator(config)
    try:
        yield accelerator
    except StoppedError:  # raised in all processes
        leave_processes()
        raise
    except RuntimeError as error:
        if accelerator.num_processes == 1 or not _is_lost_connection(error):
            raise
        fix = "Check the output of the other processes. Run the same command again to resume from the newest checkpoint"
        raise UnreachableError(where="another process of this run", found=describe_error(error), fix=fix) from error


def leave_processes() -> None:
    """End the process group, if there is one; all processes call it after success."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def _is_lost_connection(error: RuntimeError) -> bool:
    return isinstance(error, torch.distributed.DistError) or "gloo" in str(error)
