"""Measured step: what one micro-step of a run keeps in memory, on fake tensors, through the code that trains.

Blocks after the first are alike: models of two and of three tell what each further one needs, and the rest follows
exactly, phase by phase of the step. Where `adapter.peft` makes blocks differ, all of them are measured.

Fake tensors are on the CPU, because fake CUDA tensors need a driver or a compiled guard. What CUDA does otherwise is in
`FakeModel`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.distributed.device import PRECISIONS
from vjepa2_ac.model.adapter.low_rank import CastMatrices
from vjepa2_ac.model.network.predictor_network import KeyValueCache
from vjepa2_ac.training.cost.fake_model import FakeModel, Kind, fake_tensors, meta_predictor
from vjepa2_ac.training.cost.live_storages import LiveStorages
from vjepa2_ac.training.loss import Objective

Measured = TypeVar("Measured")

_BLOCKS = (2, 3)  # of the models that are measured
_WITHOUT_EFFECT = {"training": {"gradient_checkpointing", "optimizer"}, "model": {"encode_chunk"}, "data": {"cache"}}

_measured: dict[str, StepBytes] = {}


class PassBytes(NamedTuple):
    """Bytes of a forward and backward pass, beside weights, gradients and batch."""

    teacher_forcing: int  # saved for the backward pass
    rollout: int
    losses: int
    peaks: tuple[int, ...]  # live at once: in each prediction, until the losses, on the way back of each prediction

    @property
    def saved(self) -> int:
        """What is saved when the losses are computed."""
        return self.teacher_forcing + self.rollout + self.losses

    @property
    def peak(self) -> int:
        """What lives at once, at most."""
        return max(self.peaks)


class StepBytes(NamedTuple):
    """Bytes of a micro-step, and of a prediction of its validation."""

    stored: PassBytes  # without checkpointing
    checkpointed: PassBytes
    casts: int  # matrices of adapters in the arithmetic's type, for all micro-steps
    cached: int  # keys and values of all steps but the last two, of a batch of validation
    predicting: int  # at most, beside what is cached, in a prediction of this batch


def measure_step(config: Config, sizes: ModelSizes, device: Kind = "cuda") -> StepBytes:
    """Return what a micro-step of a run keeps in memory.

    Args:
        config: The run.
        sizes: Of its model.
        device: The device type whose rules for saved tensors apply.

    Raises:
        InputError: A knob of the adapter does not fit the predictor.
    """
    key = f"{config.model_dump_json(exclude=_WITHOUT_EFFECT)} {sizes} {device}"
    if key not in _measured:

        def measure(sizes: ModelSizes) -> StepBytes:
            predictor = meta_predictor(config, sizes)
            with fake_tensors(), _Holding() as holding:
                model = FakeModel(config, sizes, predictor, device)
                return _Measuring(config, model, holding.storages).step()

        _measured[key] = over_depth(measure, config, sizes)
    return _measured[key]


def over_depth(measure: Callable[[ModelSizes], Measured], config: Config, sizes: ModelSizes) -> Measured:
    """Return what is measured of all blocks: exact from two and three of them, where blocks are alike.

    Args:
        measure: Returns numbers, or tuples of them, for a model of these sizes.
        config: The run.
        sizes: Of its model.
    """
    predictor = sizes.predictor
    if predictor.depth <= _BLOCKS[1] or config.adapter.peft:
        return measure(sizes)
    fewer, more = (
        measure(sizes.model_copy(update={"predictor": predictor.model_copy(update={"depth": depth})}))
        for depth in _BLOCKS
    )
    further = predictor.depth - _BLOCKS[0]
    return tree_map(lambda two, three: two + further * (three - two), fewer, more)  # type: ignore[no-any-return]


def autocast(config: Config) -> AbstractContextManager[object]:
    """Return the arithmetic of a run, for tensors on the CPU."""
    dtype = PRECISIONS[config.training.precision]
    return nullcontext() if dtype == torch.float32 else torch.autocast("cpu", dtype)


class _Measuring:
    """Does a step with a model, within `fake_tensors` and `_Holding`."""

    def __init__(self, config: Config, model: FakeModel, storages: LiveStorages) -> None:
        self._config, self._model, self._storages = config, model, storages
        for parameter in model.parameters():
            parameter.grad = torch.empty_like(parameter) if parameter.requires_grad else None  # of earlier micro-steps

    def step(self) -> StepBytes:
        """Return what is measured."""
        before = self._storages.live
        matrices = CastMatrices(self._model, PRECISIONS[self._config.training.precision])
        casts = self._storages.live - before
        with matrices.current():
            stored = self._forward_and_backward()
            self._model.set_gradient_checkpointing(True)
            checkpointed = self._forward_and_backward()
        return StepBytes(stored, checkpointed, casts, *self._prediction())

    def _forward_and_backward(self) -> PassBytes:
        storages, objective = self._storages, Objective(self._model, self._config.training)
        batch = self._model.batch(self._config.training.batch_size, self._config.data.frames)
        saved: list[int] = []
        peaks: list[int] = []

        def end_phase(_: object = None) -> None:
            peaks.append(storages.peak)
            storages.reset_peak()

        def after_prediction(predicted: Tensor) -> None:
            saved.append(storages.saved)
            end_phase()
            predicted.register_hook(end_phase)  # type: ignore[no-untyped-call]  # comes when the gradients of all later predictions are known

        storages.forget()
        self._model.after_prediction = after_prediction
        with autocast(self._config), saved_tensors_hooks(storages.save, lambda kept: kept):
            forced, rollout = objective(batch)
            loss = forced + rollout
        losses = storages.saved
        end_phase()
        self._model.after_prediction = None
        loss.backward()
        end_phase()
        return PassBytes(saved[0], saved[-1] - saved[0], losses - saved[-1], tuple(peaks))

    def _prediction(self) -> tuple[int, int]:
        """Return what a prediction without gradients caches, and what lives beside it."""
        batch, cache = self._model.batch(self._config.validation.batch_size, self._config.data.frames), KeyValueCache()
        self._storages.forget()
        self._model.eval()
        given = (batch.actions, batch.states[:, :-1], None if batch.extrinsics is None else batch.extrinsics[:, :-1])
        with torch.no_grad(), autocast(self._config):
            self._model.predict(batch.latents[:, :-1], *given, cache, keep=self._config.data.frames - 2)
        blocks = range(len(self._model.base_predictor.blocks))
        cached = sum(piece.nbytes for block in blocks for piece in cache.layer(block))
        return cached, self._storages.peak - cached


class _Holding(TorchDispatchMode):  # type: ignore[no-untyped-call]  # torch
    """Counts the storages of all tensors that operations return."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch
        self.storages = LiveStorages()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.ops.prim.device.default:  # asked thousands of times
            return args[0].fake_device
        kwargs = kwargs or {}
        if "out" in kwargs:  # there already; PyTorch takes milliseconds to see that it fits
            return kwargs["out"]
        made = func(*args, **kwargs)
        for leaf in (made,) if isinstance(made, Tensor) else tree_leaves(made):
            if isinstance(leaf, Tensor):
                self.storages.hold(leaf)
        return made

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled within: it need not be imported
