"""The processes of a run: they share its clips and sum their gradients; the first one writes.

Started by torchrun, by `accelerate launch`, or by anything else that sets RANK, LOCAL_RANK, WORLD_SIZE, MASTER_ADDR and
MASTER_PORT. Gradients are summed once per optimizer step, after the last micro-batch, and not by a wrapper around the
model: a process may have no clip in a micro-batch (`data.broken_episodes: skip`), and would leave a wrapper waiting.

What only some processes do may take hours (an index, a checkpoint on a slow disk) or fail: `first_only`,
`first_of_machine` and `agreed` let the others wait for it without a time-out, and raise its error in all.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from datetime import timedelta
from functools import cache
from typing import Any, TypeVar

import torch
import torch.distributed
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import InitProcessGroupKwargs
from torch import Tensor, nn

from vjepa2_ac.config import Config
from vjepa2_ac.distributed.device import computing_device
from vjepa2_ac.errors import InputError

_T = TypeVar("_T")

_OTHER_LAUNCHES = ("FSDP", "DEEPSPEED", "MEGATRON_LM", "PARALLELISM_CONFIG")
_LONGEST_STEP = timedelta(hours=2)  # until a process is given up that does not come to a sum: its disk may have stalled
_AS_LONG_AS_IT_TAKES = timedelta(days=7)


def make_accelerator(config: Config) -> Accelerator:
    """Return the device and precision of a run. With several processes it joins them.

    Raises:
        InputError: CUDA was requested and there is none, the device does not compute so (fp16 on a CPU, bf16 on an old
            GPU), or the launch would share weights.
    """
    for name in _OTHER_LAUNCHES:
        if os.environ.get(f"ACCELERATE_USE_{name}", "false").lower() in {"1", "true", "yes", "on"}:
            found, needed = f"{name} is asked for", "processes that share the clips, each with the whole model"
            raise InputError(where="accelerate launch", found=found, needed=needed, fix="Start it without that")
    training, on_cpu = config.training, computing_device(config.training).type == "cpu"
    _patient_group.cache_clear()
    AcceleratorState._reset_state(reset_partial_state=False)  # or a second run keeps the first's precision
    precision = "no" if training.precision == "fp32" else training.precision
    waits = InitProcessGroupKwargs(timeout=_LONGEST_STEP)
    return Accelerator(mixed_precision=precision, cpu=on_cpu, kwargs_handlers=[waits])


def first_only(accelerator: Accelerator, work: Callable[[], _T]) -> _T | None:
    """Let the first process do something that may fail, and take any time; return its result there, None elsewhere.

    Raises:
        Exception: What it raised; in all processes.
    """
    return agreed(accelerator, work if accelerator.is_main_process else lambda: None)


def first_of_machine(accelerator: Accelerator, work: Callable[[], _T]) -> _T:
    """Let all processes do the same, first one of each machine: the others find the files that it has written.

    Raises:
        Exception: What one of them raised; in all processes.
    """
    done: list[_T] = []
    if accelerator.num_processes > 1:
        agreed(accelerator, lambda: done.append(work()) if accelerator.is_local_main_process else None)
    return agreed(accelerator, lambda: done[0] if done else work())


def agreed(accelerator: Accelerator, work: Callable[[], _T]) -> _T:
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
    raise_first(accelerator, error)
    return result  # type: ignore[return-value]  # without an error it is set


def raise_first(accelerator: Accelerator, error: Exception | None) -> None:
    """Raise, in all processes, the error of the first of them that has one. All have to call."""
    told = error if error is None or isinstance(error, InputError) else RuntimeError(f"{type(error).__name__}: {error}")
    rank, first = next(
        ((rank, one) for rank, one in enumerate(all_gather_object(accelerator, told)) if one is not None), (0, None)
    )
    if error is not None and rank == accelerator.process_index:
        raise error
    if first is not None:
        raise first


def all_reduce_sum(accelerator: Accelerator, values: Sequence[float | int]) -> list[float]:
    """Return the sums over all processes, bit-identical in each."""
    if accelerator.num_processes == 1:
        return [float(value) for value in values]
    added = torch.tensor(values, dtype=torch.float64, device=accelerator.device)
    torch.distributed.all_reduce(added)
    return [float(value) for value in added.tolist()]


def all_reduce_max(accelerator: Accelerator, values: Sequence[int | bool]) -> list[int]:
    """Return the largest of each value over all processes."""
    if accelerator.num_processes == 1:
        return [int(value) for value in values]
    compared = torch.tensor(values, dtype=torch.int64, device=accelerator.device)
    torch.distributed.all_reduce(compared, torch.distributed.ReduceOp.MAX)
    return [int(value) for value in compared.tolist()]


def all_reduce_gradients(accelerator: Accelerator, parameters: Iterable[nn.Parameter]) -> None:
    """Replace the gradient of each parameter by its sum over all processes; no gradient counts as zero."""
    if accelerator.num_processes == 1:
        return
    under_way = []
    for parameter in parameters:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        under_way.append(torch.distributed.all_reduce(parameter.grad, async_op=True))
    for work in under_way:
        work.wait()


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


def broadcast_tensors(accelerator: Accelerator, tensors: Iterable[Tensor]) -> None:
    """Give every process the first one's values, in place."""
    if accelerator.num_processes == 1:
        return
    for tensor in tensors:
        torch.distributed.broadcast(tensor.detach(), 0)


def require_same(accelerator: Accelerator, value: object, *, what: str, fix: str) -> None:
    """Check that all processes have the same values.

    Raises:
        InputError: In all processes, if one differs; names the processes.
    """
    values = all_gather_object(accelerator, value)
    differing = [str(rank) for rank, other in enumerate(values) if other != values[0]]
    if differing:
        raise InputError(
            where=what, found=f"another one in process {', '.join(differing)} than in process 0",
            needed="the same for all processes of a run", fix=fix,
        )  # fmt: skip


@cache
def _patient_group() -> torch.distributed.ProcessGroup:
    """Return a group without a time-out: NCCL's is minutes. A process that dies breaks the others' connections."""
    group: torch.distributed.ProcessGroup = torch.distributed.new_group(backend="gloo", timeout=_AS_LONG_AS_IT_TAKES)
    return group
