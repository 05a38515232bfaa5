"""Collective operations of a run's processes: they share the clips, sum their gradients, and the first one writes.

Started by torchrun, by `accelerate launch`, or by anything else that sets RANK, LOCAL_RANK, WORLD_SIZE, MASTER_ADDR and
MASTER_PORT. Gradients are summed once per optimizer step, after the last micro-batch, and not by a wrapper around the
model: a process may have no clip in a micro-batch (`data.broken_episodes: skip`), and would leave a wrapper waiting.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import torch
from accelerate import Accelerator
from accelerate.utils import broadcast_object_list, gather_object
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from vjepa2_ac.errors import InputError, UserError

_T = TypeVar("_T")


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
    """Replace the gradient of each parameter by its sum over all processes; no gradient counts as zero.

    The gradient of a sharded weight (`training.fsdp`) is such a sum already.
    """
    if accelerator.num_processes == 1:
        return
    under_way = []
    for parameter in parameters:
        if isinstance(parameter, DTensor):
            continue
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        under_way.append(torch.distributed.all_reduce(parameter.grad, async_op=True))
    for work in under_way:
        work.wait()


def broadcast_object(accelerator: Accelerator, value: _T) -> _T:
    """Return the value of the first process; the others' values are ignored."""
    if accelerator.num_processes == 1:
        return value
    holder: list[Any] = [value if accelerator.is_main_process else None]
    return broadcast_object_list(holder)[0]  # type: ignore[no-any-return]  # untyped


def value_of_first(accelerator: Accelerator, make: Callable[[], _T]) -> _T:
    """Return what the first process makes, in every process.

    Raises:
        UserError: In all processes, if the first one meets it: else the others would wait for a value.
    """
    made: _T | UserError | None = None
    if accelerator.is_main_process:
        try:
            made = make()
        except UserError as error:
            made = error
    made = broadcast_object(accelerator, made)
    if isinstance(made, UserError):
        raise made
    return made  # type: ignore[return-value]


def all_gather_object(accelerator: Accelerator, value: _T) -> list[_T]:
    """Return the values of all processes, in their order, in each process."""
    return [value] if accelerator.num_processes == 1 else list(gather_object([value]))


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
