"""Make PyTorch behave as on a GPU for fake tensors: attention kernels, optimizer updates, and a fake model."""

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

FAKE = FakeTensorMode()  # shared by all rows, because the model caches tables between calls
_MASK_ALIGNMENT = 16  # numbers per row of a mask
_replaced: list[tuple[object, str, Any]] = []


@contextmanager
def fake_gpu() -> Iterator[None]:
    """Within the context, create fake tensors and use the kernels of a GPU.

    Functions are replaced. A function mode would not apply in the thread in which autograd computes blocks again.
    """
    changes: list[tuple[object, str, Any]] = [
        (torch.nn.functional, "scaled_dot_product_attention", _attention),
        (attention, "scaled_dot_product_attention", _attention),
        (attention, "_IMPLEMENTATIONS", attention._IMPLEMENTATIONS | {"flex": _flex_attention}),
        (attention, "has_triton", lambda: True),
        (torch.cuda.amp.common, "amp_definitely_not_available", lambda: False),
        (torch.cuda, "is_bf16_supported", lambda *_, **__: True),
        (import_module("torch.optim.optimizer"), "_foreach_supported_types", [FakeTensor]),
        (torch.utils._foreach_utils, "_foreach_supported_types", [FakeTensor]),
        (nn.Module, "_apply", _replace_weights),
    ]
    _replaced[:] = [(module, name, getattr(module, name)) for module, name, _ in changes]
    with _patch_all(changes), FAKE:
        yield
    _replaced.clear()


@contextmanager
def no_fake_gpu() -> Iterator[None]:
    """Within the context, restore what `fake_gpu` replaced. `training.cost` uses its own fake tensors."""
    with _patch_all(_replaced), _disable_current_modes():
        yield


@contextmanager
def _patch_all(changes: list[tuple[object, str, Any]]) -> Iterator[None]:
    with ExitStack() as stack:
        for module, name, replacement in changes:
            stack.enter_context(mock.patch.object(module, name, replacement))
        yield


def _replace_weights(module: nn.Module, change: Callable[[Tensor], Tensor], recurse: bool = True) -> nn.Module:
    """Move or cast the weights of a module, as `Module._apply`, by replacing them: fake weights cannot be changed."""
    for child in module.children() if recurse else ():
        _replace_weights(child, change)
    for name, parameter in module._parameters.items():
        if parameter is not None:
            module._parameters[name] = nn.Parameter(change(parameter.detach()), parameter.requires_grad)
    for name, buffer in module._buffers.items():
        module._buffers[name] = None if buffer is None else change(buffer)
    return module


def _attention(
    query: Tensor, key: Tensor, value: Tensor, attn_mask: Tensor | None = None, dropout_p: float = 0.0,
    is_causal: bool = False, scale: float | None = None, enable_gqa: bool = False,
) -> Tensor:  # fmt: skip
    """Compute attention as on a GPU: the flash kernel, or the efficient kernel with a mask or in float32."""
    assert not is_causal
    assert not enable_gqa
    query, key, value = _cast_by_autocast(query, key, value)
    if attn_mask is None and query.dtype != torch.float32:
        flash = torch.ops.aten._scaled_dot_product_flash_attention
        return flash(query, key, value, dropout_p, scale=scale)[0]  # type: ignore[no-any-return]  # ops have no types
    mask = None if attn_mask is None else _make_additive_mask(attn_mask, query, key)
    backward = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (query, key, value))
    efficient = torch.ops.aten._scaled_dot_product_efficient_attention
    return efficient(query, key, value, mask, backward, dropout_p, scale=scale)[0]  # type: ignore[no-any-return]


def _cast_by_autocast(*tensors: Tensor) -> tuple[Tensor, ...]:
    if not torch.is_autocast_enabled("cuda"):
        return tensors
    return tuple(tensor.to(torch.get_autocast_dtype("cuda")) for tensor in tensors)


def _make_additive_mask(mask: Tensor, query: Tensor, key: Tensor) -> Tensor:
    """Return a mask as the efficient kernel needs it: numbers to add, with aligned rows, for every batch and head.

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


def _flex_attention(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:  # noqa: ARG001
    """Compute attention by one flash operation. FlexAttention without a compiler would allocate the whole matrix."""
    query, key, value = _cast_by_autocast(query, key, value)
    return torch.ops.aten._scaled_dot_product_flash_attention(query, key, value)[0]  # type: ignore[no-any-return]


class FakeBench(Bench):
    """The training step of `train_step.py` on the fake GPU."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__(options, options.dtype)

    def _model(self) -> WorldModel:
        return fake_model(self.sizes, self.dtype, encoder="pixels" in self.options.source)

    def _draw(self, shape: tuple[int, ...]) -> Tensor:
        return torch.empty(shape, device=self.device)

    def _accelerator(self, config: Config) -> Any:  # noqa: ARG002  # the accelerator of Accelerate needs a driver
        return SimpleNamespace(
            device=self.device, process_index=0, num_processes=1,
            autocast=lambda: torch.autocast("cuda", self.dtype, enabled=self.dtype != torch.float32),
        )  # fmt: skip


def fake_model(sizes: ModelSizes, dtype: torch.dtype, *, encoder: bool) -> WorldModel:
    """Return a model with an adapter on the fake GPU: frozen weights have type `dtype`, trained weights float32.

    The model is built on the meta device, and its weights are then replaced, because `Module.to` cannot change fake
    weights.
    """
    with _disable_current_modes(), no_fingerprints(), torch.device("meta"):
        model = WorldModel.empty(sizes)
        add_adapter(model, AdapterConfig(), seed=0)
        if not encoder:
            model.remove_encoder()
    for part in model.modules():
        for name, parameter in part._parameters.items():
            if parameter is not None:
                kind = torch.float32 if parameter.requires_grad else dtype
                part._parameters[name] = nn.Parameter(
                    torch.empty(parameter.shape, dtype=kind, device="cuda"), parameter.requires_grad
                )
        for name, value in vars(part).items():
            if isinstance(value, Tensor):
                setattr(part, name, torch.empty(value.shape, dtype=value.dtype))
    return model
