"""What does work need of a GPU? Live bytes, waits of the host, kernels, bytes moved, FLOPs; and so a predicted time."""

from __future__ import annotations

import linecache
import re
import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import chain
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import torch
from stand_ins import share_seen
from torch import Tensor
from torch._ops import OpOverload
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from vjepa2_ac.training.cost.step import LiveStorages

_BLOCK = 512  # bytes: what the allocator rounds to
_OURS = ("vjepa2_ac", "peft", "transformers")
_ELSEWHERE = (str(Path(torch.__file__).parent), str(Path(__file__).parent), "<")  # no place of an operation
_IN_TRACEBACK = re.compile(r'File "([^"]+)", line (\d+)')
_aten = torch.ops.aten
_MAKE_NOTHING = {_aten.empty, _aten.empty_like, _aten.empty_strided, _aten.new_empty, _aten.new_empty_strided}


@dataclass(frozen=True)
class Machine:
    """A GPU, as far as a prediction knows of it: an H100 of 80 GB, with shares as measured there (docs/log.md)."""

    tflops: float = 755.0  # of a large product of matrices in bfloat16
    bandwidth: float = 3.0  # TB/s
    matmul: float = 0.85  # share of `tflops` that products of our sizes reach
    attention: float = 0.27  # FlexAttention's, forward and backward
    float32_tflops: float = 50.0
    moved: float = 0.9  # share of `bandwidth`
    moved_mixed: float = 0.4  # the same where types differ, as in a rotation: such kernels read number by number
    least_s: float = 2e-6  # of a kernel
    launch_s: float = 33e-6  # of the host, for each kernel: Python, PyTorch and autograd

    def seconds(self, name: str, flops: float, moved: float, dtypes: Sequence[torch.dtype]) -> float:
        """Return how long a kernel takes: what it computes or what it moves, whichever is slower."""
        share = self.attention if "attention" in name else self.matmul
        speed = self.float32_tflops if dtypes[0] == torch.float32 else self.tflops * share
        reached = self.moved if len(set(dtypes)) == 1 else self.moved_mixed
        return max(flops / (speed * 1e12), moved / (self.bandwidth * reached * 1e12), self.least_s)


class Cost(NamedTuple):
    """What kernels need together."""

    kernels: float = 0.0
    seconds: float = 0.0
    bytes: float = 0.0
    flops: float = 0.0

    def plus(self, other: Cost, times: float = 1.0) -> Cost:
        """Return what this needs, and another so many times."""
        return Cost(*(own + times * more for own, more in zip(self, other, strict=True)))


class Count(TorchDispatchMode):  # type: ignore[no-untyped-call]  # torch
    """Counts what is done on fake CUDA tensors while it is on; reads of numbers get 1.

    Args:
        machine: What time is predicted of.
    """

    def __init__(self, machine: Machine) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch
        self.machine = machine
        self.times = 1.0  # how often what comes now is counted
        self._storages = LiveStorages(_BLOCK)
        self.reset()

    def reset(self) -> None:
        """Forget all but what is live."""
        self._storages.reset_peak()
        self.waits: dict[str, float] = defaultdict(float)  # by place
        self.costs: dict[tuple[str, str], Cost] = defaultdict(Cost)  # by operation and place
        self._read: int | None = None  # the storage whose numbers were read last

    @property
    def live(self) -> int:
        """Bytes of tensors that exist now."""
        return self._storages.live

    @property
    def peak(self) -> int:
        """Bytes of tensors that existed at once, at most."""
        return self._storages.peak

    @property
    def total(self) -> Cost:
        """What all kernels need."""
        return reduce(Cost.plus, self.costs.values(), Cost())

    def __torch_dispatch__(
        self, func: OpOverload, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is torch.ops.prim.device.default:  # is asked thousands of times
            return args[0].fake_device
        if func.is_view:
            return func(*args, **kwargs)
        given = _tensors((args, kwargs))
        if torch.Tag.data_dependent_output in func.tags:
            return self._number(func, given, args, kwargs)
        out = func(*args, **kwargs)
        made = _tensors(out)
        on_device = [one for one in (*given, *made) if _device(one) == "cuda"]
        for tensor in on_device:
            self._storages.hold(tensor)
        known = {_storage(one) for one in given}
        if on_device and (func._schema.is_mutable or any(_storage(one) not in known for one in made)):
            self._launch(func, args, kwargs, out)
            if _copies_and_blocks(func, args, kwargs, set(map(_device, (*given, *made)))):
                self.waits[place(text=True)] += self.times
        return out

    def _launch(self, func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any], out: Any) -> None:
        if func._overloadpacket in _MAKE_NOTHING:
            return
        outputs = {argument.name for argument in func._schema.arguments if argument.is_out}  # are not read
        read = _tensors((args, [value for name, value in kwargs.items() if name not in outputs]))
        written = _tensors(out) or _written(func, args, kwargs)
        touched = [one for one in (*read, *written) if _device(one) == "cuda"]
        moved, flops = sum(map(_bytes, touched)), _flops(func, args, kwargs, out)
        seconds = self.machine.seconds(str(func), flops, moved, [one.dtype for one in touched])
        key = str(func), place()
        self.costs[key] = self.costs[key].plus(Cost(1.0, seconds, moved, flops), self.times)
        self._read = None

    def _number(self, func: OpOverload, given: list[Tensor], args: Any, kwargs: Any) -> Any:
        """Return a number of a tensor: the true one where it is known. Another of the same tensor is no more wait."""
        if _device(given[0]) == "cuda":
            if self._read != _storage(given[0]):
                self.waits[place(text=True)] += self.times
            self._read = _storage(given[0])
        try:
            return func(*args, **kwargs)
        except DataDependentOutputException:
            kind = given[0].dtype
            return True if kind == torch.bool or func is _aten.equal.default else 1.0 if kind.is_floating_point else 1


def place(*, text: bool = False) -> str:
    """Return the line, of ours or of PEFT or transformers if there is one, that an operation comes from.

    In the backward pass it is the line of the operation whose gradient is computed, if autograd's anomaly mode is on.
    """
    found, backward = [], ""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        found.append((frame.f_code.co_filename, frame.f_lineno))
        frame = frame.f_back
    outside = [one for one in found if not one[0].startswith(_ELSEWHERE)]
    if not outside:
        backward, node = "backward of ", torch._C._current_autograd_node()
        metadata: Any = {} if node is None else node.metadata
        lines = "".join(metadata.get("traceback_", ()))
        found = [(file, int(line)) for file, line in reversed(_IN_TRACEBACK.findall(lines))]
        outside = [one for one in found if not one[0].startswith(_ELSEWHERE)]
    named = (one for one in outside if any(f"/{package}/" in one[0] for package in _OURS))
    file, line = next(named, outside[0] if outside else ("the backward pass", 0))
    if not line:
        return file
    package = next((name for name in _OURS if f"/{name}/" in file), None)
    short = Path(file).name if package is None else package + file.rpartition(f"/{package}")[2]
    return f"{backward}{short}:{line}" + (f" {linecache.getline(file, line).strip()}" if text else "")


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]


def _device(tensor: Tensor) -> str:
    """Return cpu or cuda; asking a fake tensor for its device would be an operation of its own, and take as long."""
    return tensor.fake_device.type if isinstance(tensor, FakeTensor) else tensor.device.type


def _storage(tensor: Tensor) -> int:
    return int(tensor.untyped_storage()._cdata)


def _bytes(tensor: Tensor) -> int:
    """Return the bytes of a tensor, what it repeats once."""
    count = tensor.element_size()
    for size, stride in zip(tensor.shape, tensor.stride(), strict=True):
        count *= size if stride else min(size, 1)
    return count


def _written(func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Tensor]:
    """Return what an operation writes that returns nothing."""
    pairs = zip(func._schema.arguments, chain(args, kwargs.values()), strict=False)
    return _tensors([value for argument, value in pairs if argument.alias_info and argument.alias_info.is_write])


def _copies_and_blocks(func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any], devices: set[str]) -> bool:
    """Return whether an operation carries numbers between host and device, and the host waits until they are there."""
    if len(devices) < 2 or func._overloadpacket not in {_aten._to_copy, _aten.copy_}:
        return False
    number = [argument.name for argument in func._schema.arguments].index("non_blocking")
    return not kwargs.get("non_blocking", args[number] if len(args) > number else False)


def _flops(func: OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any], out: Any) -> float:
    """Return the FLOPs of products of matrices; of what stands in for FlexAttention, the share that its mask leaves."""
    formula = flop_registry.get(func._overloadpacket)
    if formula is None:
        return 0.0
    flops = float(formula(*args, **kwargs, out_val=out))
    if "flash_attention" in str(func) and any(one is True for one in args):  # is_causal: nothing else of ours is
        query, key = args[1:3] if "backward" in str(func) else args[:2]
        flops *= share_seen(query.shape[2], key.shape[2])
    return flops
