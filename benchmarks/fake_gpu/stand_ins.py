"""Replace what differs on a GPU: attention kernels, updates of many tensors at once, and a model without numbers."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch
from random_models import no_fingerprints
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.nn.functional import pad
from torch.utils._python_dispatch import _disable_current_modes
from train_step_variants import Bench

from vjepa2_ac.config import AdapterConfig, Config, ModelSizes
from vjepa2_ac.model import attention
from vjepa2_ac.model.lora import add_adapter
from vjepa2_ac.model.world_model import WorldModel

FAKE = FakeTensorMode()  # one for all rows: our code keeps tables from one call to the next
_MASK_ALIGNMENT = 16  # numbers
_replaced: list[tuple[object, str, Any]] = []


@contextmanager
def fake_gpu() -> Iterator[None]:
    """Make tensors that have no numbers, and take what a GPU takes.

    Functions are replaced: a function mode would not be there in the thread in which autograd computes blocks again.
    """
    changes: list[tuple[object, str, Any]] = [
        (torch.nn.functional, "scaled_dot_product_attention", _attention),
        (attention, "scaled_dot_product_attention", _attention),
        (attention, "_IMPLEMENTATIONS", attention._IMPLEMENTATIONS | {"flex": _flex}),
        (attention, "has_triton", lambda: True),
        (torch.cuda.amp.common, "amp_definitely_not_available", lambda: False),
        (torch.cuda, "is_bf16_supported", lambda *_, **__: True),
        (import_module("torch.optim.optimizer"), "_foreach_supported_types", [FakeTensor]),
        (torch.utils._foreach_utils, "_foreach_supported_types", [FakeTensor]),
        (nn.Module, "_apply", _applied),
    ]
    _replaced[:] = [(place, name, getattr(place, name)) for place, name, _ in changes]
    with _replacing(changes), FAKE:
        yield
    _replaced.clear()


@contextmanager
def no_fake_gpu() -> Iterator[None]:
    """Put back what `fake_gpu` replaced: `training.cost` measures on fake tensors of its own."""
    with _replacing(_replaced), _disable_current_modes():
        yield


@contextmanager
def _replacing(changes: list[tuple[object, str, Any]]) -> Iterator[None]:
    with ExitStack() as stack:
        for place, name, instead in changes:
            stack.enter_context(mock.patch.object(place, name, instead))
        yield


def _applied(module: nn.Module, change: Callable[[Tensor], Tensor], recurse: bool = True) -> nn.Module:
    """Do what moves and casts weights, by replacing them: PyTorch cannot change fake ones where they are."""
    for child in module.children() if recurse else ():
        _applied(child, change)
    for name, own in module._parameters.items():
        if own is not None:
            module._parameters[name] = nn.Parameter(change(own.detach()), own.requires_grad)
    for name, held in module._buffers.items():
        module._buffers[name] = None if held is None else change(held)
    return module


def _attention(
    query: Tensor, key: Tensor, value: Tensor, attn_mask: Tensor | None = None, dropout_p: float = 0.0,
    is_causal: bool = False, scale: float | None = None, enable_gqa: bool = False,
) -> Tensor:  # fmt: skip
    """Return what `scaled_dot_product_attention` takes on a GPU: flash, or efficient with a mask or in float32."""
    assert not is_causal
    assert not enable_gqa
    query, key, value = _as_autocast(query, key, value)
    if attn_mask is None and query.dtype != torch.float32:
        flash = torch.ops.aten._scaled_dot_product_flash_attention
        return flash(query, key, value, dropout_p, scale=scale)[0]  # type: ignore[no-any-return]  # ops have no types
    mask = None if attn_mask is None else _added(attn_mask, query, key)
    backward = torch.is_grad_enabled() and any(given.requires_grad for given in (query, key, value))
    efficient = torch.ops.aten._scaled_dot_product_efficient_attention
    return efficient(query, key, value, mask, backward, dropout_p, scale=scale)[0]  # type: ignore[no-any-return]


def _as_autocast(*given: Tensor) -> tuple[Tensor, ...]:
    if not torch.is_autocast_enabled("cuda"):
        return given
    return tuple(one.to(torch.get_autocast_dtype("cuda")) for one in given)


def _added(mask: Tensor, query: Tensor, key: Tensor) -> Tensor:
    """Return a mask as the efficient kernel wants it: numbers to add, rows aligned, for every batch and head.

    Source: pytorch @ v2.13, aten/src/ATen/native/transformers/attention.cpp, convert_boolean_attn_mask and
    preprocess_mask.
    """
    if mask.dtype == torch.bool:
        zero, minus_infinity = (query.new_full((), number) for number in (0.0, float("-inf")))
        mask = torch.where(mask, zero, minus_infinity)
    keys = key.shape[2]
    if keys % _MASK_ALIGNMENT:
        mask = pad(mask, (0, -keys % _MASK_ALIGNMENT))[..., :keys]
    return mask.expand(*query.shape[:3], keys)


def _flex(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:  # noqa: ARG001
    """Return one flash operation: FlexAttention without a compiler would make the whole matrix."""
    query, key, value = _as_autocast(query, key, value)
    return torch.ops.aten._scaled_dot_product_flash_attention(query, key, value)[0]  # type: ignore[no-any-return]


class FakeSteps(Bench):
    """The training step of `train_step.py` on the fake GPU."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__(options, options.dtype)

    def _model(self) -> WorldModel:
        return fake_model(self.sizes, self.dtype, encoder="pixels" in self.options.source)

    def _drawn(self, shape: tuple[int, ...]) -> Tensor:
        return torch.empty(shape, device=self.device)

    def _accelerator(self, config: Config) -> Any:  # noqa: ARG002  # Accelerate's own needs a driver
        return SimpleNamespace(
            device=self.device, process_index=0, num_processes=1,
            autocast=lambda: torch.autocast("cuda", self.dtype, enabled=self.dtype != torch.float32),
        )  # fmt: skip


def fake_model(sizes: ModelSizes, dtype: torch.dtype, *, encoder: bool) -> WorldModel:
    """Return a model with an adapter on the fake GPU: frozen weights in a type, trained ones in float32.

    It is made without memory, and its weights are replaced then: `Module.to` cannot replace fake ones.
    """
    with _disable_current_modes(), no_fingerprints(), torch.device("meta"):
        model = WorldModel.empty(sizes)
        add_adapter(model, AdapterConfig(), seed=0)
        if not encoder:
            model.remove_encoder()
    for part in model.modules():
        for name, old in part._parameters.items():
            if old is not None:
                kind = torch.float32 if old.requires_grad else dtype
                part._parameters[name] = nn.Parameter(
                    torch.empty(old.shape, dtype=kind, device="cuda"), old.requires_grad
                )
        for name, value in vars(part).items():
            if isinstance(value, Tensor):
                setattr(part, name, torch.empty(value.shape, dtype=value.dtype))
    return model
