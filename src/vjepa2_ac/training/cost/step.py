"""Measured step: the bytes that one micro-step of a run keeps in memory, on fake tensors, through the code that trains.

The predictor with its adapter is made on the meta device, and computes with tensors of shapes and types only. They are
on the CPU, because fake CUDA tensors need a driver; three things are then taken as they are on CUDA: autocast computes
norms from a float32 copy where weights have another type than the arithmetic, a dropout mask takes one byte, and `auto`
attention is one operation (FlexAttention) that keeps no scores.

Blocks after the first are alike: models of two and of three tell what each further one needs, in each phase of the step
(a prediction, the losses, the way back of a prediction).
"""

from __future__ import annotations

import weakref
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn.functional import layer_norm, scaled_dot_product_attention
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.distributed import PRECISIONS, autocast
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.adapter.low_rank import CastMatrices
from vjepa2_ac.model.network.attention import rotary_tables
from vjepa2_ac.model.network.predictor_network import LatentDynamics, PredictorNetwork, predictor_fields
from vjepa2_ac.training.loss import Objective

Kind = Literal["cpu", "cuda"]

_BLOCKS = (2, 3)  # of the models that are measured
_OF_LOSS = {"loss", "teacher_forcing_weight", "rollout_weight", "rollout_steps"}
_WITH_EFFECT: Any = {
    "plugins": True, "adapter": True, "model": {"dtype"}, "data": {"frames"}, "validation": {"batch_size"},
    "training": {"attention", "precision", "batch_size", *_OF_LOSS},
}  # fmt: skip

_measured: dict[str, StepBytes] = {}


class StepBytes(NamedTuple):
    """Bytes that live at once, at most, beside weights, gradients and batch."""

    stored: int  # in a forward and backward pass, without checkpointing
    checkpointed: int
    casts: int  # matrices of adapters in the arithmetic's type, for all micro-steps
    predicting: int  # in a prediction of all steps of a batch of validation


def measure_step(config: Config, sizes: ModelSizes, device: Kind = "cuda") -> StepBytes:
    """Return what a micro-step of a run keeps in memory.

    Args:
        config: The run.
        sizes: Of its model.
        device: The device type whose rules for saved tensors apply.

    Raises:
        InputError: A knob of the adapter does not fit the predictor.
    """
    key = f"{config.model_dump_json(include=_WITH_EFFECT)} {sizes} {device}"
    if key not in _measured:
        depth = sizes.predictor.depth
        if depth <= _BLOCKS[1] or config.adapter.peft:  # whose options may make blocks differ
            found = _measure(config, sizes, device)
        else:
            predictors = (sizes.predictor.model_copy(update={"depth": blocks}) for blocks in _BLOCKS)
            models = (sizes.model_copy(update={"predictor": predictor}) for predictor in predictors)
            fewer, more = (_measure(config, model, device) for model in models)
            further = depth - _BLOCKS[0]
            found = tree_map(lambda two, three: two + further * (three - two), fewer, more)
        _measured[key] = StepBytes(*map(max, found))
    return _measured[key]


def meta_network(sizes: ModelSizes) -> PredictorNetwork:
    """Return the network of a predictor on the meta device, in float32."""
    network = PredictorNetwork()
    network.config = SimpleNamespace(**predictor_fields(sizes))
    with torch.device("meta"):
        network.add_layers(network.config)
    return network


def meta_predictor(config: Config, sizes: ModelSizes) -> nn.Module:
    """Return the predictor with what a run trains, on the meta device, in float32; the rest is frozen.

    Raises:
        InputError: A knob of the adapter does not fit the predictor.
    """
    predictor = meta_network(sizes)
    if config.adapter.kind == "none":
        for name in predictor.unused_layers:
            predictor.get_submodule(name).requires_grad_(False)
        return predictor
    from vjepa2_ac.model.adapter.lora import with_adapter  # PEFT takes seconds

    with torch.device("meta"):
        return with_adapter(predictor.requires_grad_(False), config.adapter)


class LiveStorages:
    """Counts the bytes of storages from the first sight of a tensor until nothing refers to its storage.

    Args:
        block: Each storage is rounded up to a multiple of so many bytes, as an allocator does.
    """

    def __init__(self, block: int = 1) -> None:
        self.live = self.peak = 0
        self._block = block
        self._sizes: dict[int, int] = {}

    def reset_peak(self) -> None:
        """Let the peak be what is live now."""
        self.peak = self.live

    def forget(self) -> None:
        """Leave out of all counts what is live now."""
        self._sizes = dict.fromkeys(self._sizes, 0)
        self.live = self.peak = 0

    def hold(self, tensor: Tensor) -> None:
        """Count the storage of a tensor, if it is new."""
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key not in self._sizes:
            self._sizes[key] = -(-storage.nbytes() // self._block) * self._block
            self.live += self._sizes[key]
            self.peak = max(self.peak, self.live)
            weakref.finalize(storage, self._let_go, key)

    def _let_go(self, key: int) -> None:
        self.live -= self._sizes.pop(key)


class _Holding(TorchDispatchMode):  # type: ignore[no-untyped-call]  # torch
    """Counts the storages of all tensors that operations return."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch
        self.storages = LiveStorages()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if "out" in kwargs:  # there already; PyTorch takes milliseconds to see that it fits
            return kwargs["out"]
        made = func(*args, **kwargs)
        for leaf in tree_leaves(made):
            if isinstance(leaf, Tensor):
                self.storages.hold(leaf)
        return made

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled within: it need not be imported


class _FakeModel(LatentDynamics):
    """The predictor of a run on fake tensors, in training mode; only within `FakeTensorMode`."""

    def __init__(self, config: Config, predictor: nn.Module, device: Kind, storages: LiveStorages) -> None:
        super().__init__()
        self.predictor, self._storages = predictor, storages
        self.peaks: list[int] = []  # of each phase
        frozen = torch.bfloat16 if config.model.dtype == "bfloat16" else torch.float32
        for part in predictor.modules():
            for name, old in part.named_parameters(recurse=False):
                is_float = old.requires_grad or config.adapter.kind == "none"
                values = torch.empty(old.shape, dtype=torch.float32 if is_float else frozen)
                new = nn.Parameter(values, old.requires_grad)
                new.grad = torch.empty_like(new) if new.requires_grad else None  # of earlier micro-steps
                part.register_parameter(name, new)
            if device == "cuda":
                part.__class__ = _ON_CUDA.get(type(part), type(part))
        kind = config.training.attention
        self.set_attention(_flash if device == "cuda" and kind == "auto" else kind)

    def predict(self, *given: Any, **named: Any) -> Tensor:
        """Predict; a phase ends, and another one when the gradients of all later predictions are known."""
        predicted = super().predict(*given, **named)
        self.end_phase()
        if predicted.requires_grad:
            predicted.register_hook(self.end_phase)  # type: ignore[no-untyped-call]  # torch
        return predicted

    def end_phase(self, _: object = None) -> None:
        """Note how much has lived at once since the phase before."""
        self.peaks.append(self._storages.peak)
        self._storages.reset_peak()


def _measure(config: Config, sizes: ModelSizes, device: Kind) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of `StepBytes`, phase by phase."""
    predictor = meta_predictor(config, sizes)
    rotary_tables.cache_clear()  # tables that are cached between calls do not get in or out
    try:
        with FakeTensorMode(), _Holding() as holding:
            storages = holding.storages
            model = _FakeModel(config, predictor, device, storages)
            before = storages.live
            matrices = CastMatrices(model, PRECISIONS[config.training.precision])
            casts = storages.live - before
            with matrices.current():
                stored = _pass(model, config, sizes, storages)
                model.set_gradient_checkpointing(True)
                checkpointed = _pass(model, config, sizes, storages)
            return stored, checkpointed, (casts,), _prediction(model, config, sizes, storages)
    finally:
        rotary_tables.cache_clear()


def _pass(model: _FakeModel, config: Config, sizes: ModelSizes, storages: LiveStorages) -> tuple[int, ...]:
    batch = _batch(config, sizes, config.training.batch_size)
    storages.forget()
    model.peaks.clear()
    with autocast(config.training, torch.device("cpu")):
        loss = torch.stack(Objective(model, config.training)(batch)).sum()
    model.end_phase()
    loss.backward()  # type: ignore[no-untyped-call]  # torch
    model.end_phase()
    return tuple(model.peaks)


def _prediction(model: _FakeModel, config: Config, sizes: ModelSizes, storages: LiveStorages) -> tuple[int, ...]:
    batch = _batch(config, sizes, config.validation.batch_size)
    states, cameras = batch.states[:, :-1], None if batch.extrinsics is None else batch.extrinsics[:, :-1]
    storages.forget()
    model.eval()
    with torch.no_grad(), autocast(config.training, torch.device("cpu")):
        model.predict(batch.latents[:, :-1], batch.actions, states, cameras)
    return (model.peaks[-1],)


def _batch(config: Config, sizes: ModelSizes, clips: int) -> LatentBatch:
    frames, predictor = config.data.frames, sizes.predictor
    latents = torch.empty(clips, frames, sizes.tokens_per_frame, sizes.encoder.width)
    states = torch.empty(clips, frames, predictor.state_dim)
    actions = torch.empty(clips, frames - 1, predictor.action_dim)
    extrinsics = torch.empty(clips, frames, 6) if predictor.use_extrinsics else None
    return LatentBatch(latents, states, actions, extrinsics, ("",) * clips, (0,) * clips)


class _CudaNorm(nn.LayerNorm):
    def forward(self, tokens: Tensor) -> Tensor:
        if not torch.is_autocast_enabled("cpu"):
            return super().forward(tokens)
        return layer_norm(tokens.float(), self.normalized_shape, self.weight.float(), self.bias.float(), self.eps)


class _CudaDropout(nn.Dropout):
    def forward(self, tokens: Tensor) -> Tensor:
        return torch.native_dropout(tokens, self.p, self.training)[0]


_ON_CUDA: dict[type[nn.Module], type[nn.Module]] = {nn.LayerNorm: _CudaNorm, nn.Dropout: _CudaDropout}


def _flash(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:  # noqa: ARG001
    return scaled_dot_product_attention(query, key, value)
