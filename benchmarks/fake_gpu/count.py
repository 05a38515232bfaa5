"""Count the bytes of all existing CUDA tensors, and how often the host waits for the device."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from vjepa2_ac.training.cost import LiveStorages

_BLOCK = 512  # bytes; the allocator rounds sizes up to multiples of this
_aten = torch.ops.aten


class UsageCounter(TorchDispatchMode):  # type: ignore[no-untyped-call]  # torch
    """Counts bytes and waits of operations on fake CUDA tensors within its context. Each number that is read is 1."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch
        self.storages = LiveStorages(_BLOCK)
        self.reset()

    def reset(self) -> None:
        """Set the peak to the current bytes, and the number of waits to zero."""
        self.storages.reset_peak()
        self.waits = 0
        self._last_read: int | None = None  # the storage whose numbers were read last

    def __torch_dispatch__(
        self, func: OpOverload, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is torch.ops.prim.device.default:  # called thousands of times
            return args[0].fake_device
        if func.is_view:
            return func(*args, **kwargs)
        inputs = _find_tensors((args, kwargs))
        if torch.Tag.data_dependent_output in func.tags:
            return self._read_number(func, inputs, args, kwargs)
        out = func(*args, **kwargs)
        tensors = [*inputs, *_find_tensors(out)]
        for tensor in tensors:
            if _device(tensor) == "cuda":
                self.storages.count(tensor)
                self._last_read = None
        self.waits += _is_blocking_copy(func, args, kwargs, set(map(_device, tensors)))
        return out

    def _read_number(self, func: OpOverload, inputs: list[Tensor], args: Any, kwargs: Any) -> Any:
        """Return a number of a tensor, or 1 if it is unknown. Reading all numbers of a tensor counts as one wait."""
        if _device(inputs[0]) == "cuda":
            storage = int(inputs[0].untyped_storage()._cdata)
            self.waits += self._last_read != storage
            self._last_read = storage
        try:
            return func(*args, **kwargs)
        except DataDependentOutputException:
            kind = inputs[0].dtype
            return True if kind == torch.bool or func is _aten.equal.default else 1.0 if kind.is_floating_point else 1


def _find_tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]


def _device(tensor: Tensor) -> str:
    """Return cpu or cuda. The property `device` of a fake tensor is not used, because it would call an operation."""
    return tensor.fake_device.type if isinstance(tensor, FakeTensor) else tensor.device.type


def _is_blocking_copy(func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any], devices: set[str]) -> bool:
    """Return whether an operation is a copy between host and device for which the host waits."""
    if len(devices) < 2 or func._overloadpacket not in {_aten._to_copy, _aten.copy_}:
        return False
    number = [argument.name for argument in func._schema.arguments].index("non_blocking")
    return not kwargs.get("non_blocking", args[number] if len(args) > number else False)
