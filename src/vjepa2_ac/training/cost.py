"""Estimate of the GPU memory that a run needs, before it starts.

The predictor's part is measured: it is the peak of one micro-step on fake tensors, executed by the training code. All
other parts are calculated: weights and optimizer moments from the parameter counts (bitsandbytes' kernels do not
accept fake tensors), the batch from its size, and the encoder's activations by formula. On an H100 the total
differed by 1 % from the peak that PyTorch's allocator reported; the CUDA context was not compared.

The fake tensors are on the CPU, because fake CUDA tensors need a driver. Three operations are replaced, so that they
keep as much memory as on CUDA: autocast computes norms from a float32 copy if the weights have another data type than
the computation, a dropout mask takes one byte per element, and `auto` attention is one operation (FlexAttention) that
keeps no scores.

All blocks after the first need the same memory. Models with two and with three blocks show how much each further block
needs, in each phase of the step (a prediction, the losses, the backward pass of a prediction).
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn.functional import layer_norm, scaled_dot_product_attention
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.distributed import PRECISIONS, autocast
from vjepa2_ac.encoding.latent_cache import FRAMES_AT_ONCE
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.attention import rotary_tables
from vjepa2_ac.model.encoder import ENCODE_CHUNK, Encoder
from vjepa2_ac.model.low_rank import CastMatrices
from vjepa2_ac.model.predictor import LatentDynamics, new_predictor
from vjepa2_ac.training.step import Objective

DeviceType = Literal["cpu", "cuda"]

GIGABYTE = 10**9
ALLOWANCE = 3 * GIGABYTE // 2  # assumed: 0.5 GB for the CUDA context, 1 GB for cuBLAS workspaces and fragmentation
USUAL_GPU = 24 * GIGABYTE
FLOAT32 = 4
HALF = 2  # bfloat16 and float16

_BLOCKS = (2, 3)  # numbers of blocks of the two measured models
_BYTES_PER_CACHED_NUMBER = {"int8": 1, "bf16": HALF, "fp32": FLOAT32}
_MIN_8_BIT_ELEMENTS, _ELEMENTS_PER_SCALE = 4096, 256  # as in bitsandbytes
_CHECKPOINTED = ", checkpointed"
_PERMANENT_PARTS = (  # parts that are allocated all the time
    "encoder weights", "predictor weights", "trained weights", "optimizer state", "CUDA allowance",
)  # fmt: skip
_LOSS_KEYS = {"loss", "rollout_steps"}
_RELEVANT_KEYS: Any = {  # config keys on which the memory of a step depends
    "plugins": True, "adapter": True, "model": {"dtype"}, "data": {"frames"}, "validation": {"batch_size"},
    "training": {"attention", "precision", "batch_size", *_LOSS_KEYS},
}  # fmt: skip


class StepBytes(NamedTuple):
    """Peak bytes of a step, in addition to weights, gradients and batch."""

    stored: int  # forward and backward pass, without gradient checkpointing
    checkpointed: int  # forward and backward pass, with gradient checkpointing
    casts: int  # copies of the adapter's matrices in the data type of the computation, for all micro-steps
    predicting: int  # prediction of all steps of a validation batch


_measured: dict[str, StepBytes] = {}  # results of `measure_step` by config, sizes and device


def meta_predictor(config: Config, sizes: ModelSizes) -> nn.Module:
    """Return the predictor with its adapter on the meta device, in float32; weights that are not trained are frozen.

    Raises:
        InputError: A key of the adapter does not fit the predictor.
    """
    with torch.device("meta"):
        predictor = new_predictor(sizes)
    if config.adapter.kind == "none":
        for name in predictor.unused_layers:
            predictor.get_submodule(name).requires_grad_(False)
        return predictor
    from vjepa2_ac.model.lora import with_adapter  # PEFT takes seconds

    with torch.device("meta"):
        return with_adapter(predictor.requires_grad_(False), config.adapter)


def _make_batch(config: Config, sizes: ModelSizes, clips: int) -> LatentBatch:
    frames, predictor = config.data.frames, sizes.predictor
    latents = torch.empty(clips, frames, sizes.tokens_per_frame, sizes.encoder.width)
    states = torch.empty(clips, frames, predictor.state_dim)
    actions = torch.empty(clips, frames - 1, predictor.action_dim)
    extrinsics = torch.empty(clips, frames, 6) if predictor.use_extrinsics else None
    return LatentBatch(latents, states, actions, extrinsics, ("",) * clips, (0,) * clips)


def measure_step(config: Config, sizes: ModelSizes, device: DeviceType = "cuda") -> StepBytes:
    """Return the peak memory of a micro-step of a run.

    Args:
        config: The config of the run.
        sizes: The sizes of the model.
        device: The device type whose rules for saved tensors apply.

    Raises:
        InputError: A key of the adapter does not fit the predictor.
    """
    key = f"{config.model_dump_json(include=_RELEVANT_KEYS)} {sizes} {device}"
    if key not in _measured:
        depth = sizes.predictor.depth
        if depth <= _BLOCKS[1] or config.adapter.peft:  # options of PEFT may make blocks differ
            peaks = _measure(config, sizes, device)
        else:
            predictors = (sizes.predictor.model_copy(update={"depth": blocks}) for blocks in _BLOCKS)
            models = (sizes.model_copy(update={"predictor": predictor}) for predictor in predictors)
            fewer, more = (_measure(config, model, device) for model in models)
            num_further = depth - _BLOCKS[0]
            peaks = tree_map(lambda two, three: two + num_further * (three - two), fewer, more)
        _measured[key] = StepBytes(*map(max, peaks))
    return _measured[key]


class LiveStorages:
    """A counter of the bytes of live tensor storages: from the first call of `count` until the storage is freed.

    Args:
        block: The size of each storage is rounded up to a multiple of this number of bytes, as an allocator does.
    """

    def __init__(self, block: int = 1) -> None:
        self.live = self.peak = 0
        self._block = block
        self._sizes: dict[int, int] = {}

    def reset_peak(self) -> None:
        """Set the peak to the number of bytes that are live now."""
        self.peak = self.live

    def forget(self) -> None:
        """Exclude all storages that are live now from the counts."""
        self._sizes = dict.fromkeys(self._sizes, 0)
        self.live = self.peak = 0

    def count(self, tensor: Tensor) -> None:
        """Count the storage of a tensor, unless it is counted already."""
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key not in self._sizes:
            self._sizes[key] = -(-storage.nbytes() // self._block) * self._block
            self.live += self._sizes[key]
            self.peak = max(self.peak, self.live)
            weakref.finalize(storage, self._release, key)

    def _release(self, key: int) -> None:
        self.live -= self._sizes.pop(key)


class _StorageCounter(TorchDispatchMode):  # type: ignore[no-untyped-call]  # torch
    """A dispatch mode that counts the storages of all tensors that operations return."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch
        self.storages = LiveStorages()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if "out" in kwargs:  # counted already; PyTorch would take milliseconds to check its shape
            return kwargs["out"]
        outputs = func(*args, **kwargs)
        for leaf in tree_leaves(outputs):
            if isinstance(leaf, Tensor):
                self.storages.count(leaf)
        return outputs

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled inside this mode, so that torch._dynamo need not be imported


class _FakeModel(LatentDynamics):
    """The predictor of a run on fake tensors, in training mode. Usable only inside `FakeTensorMode`."""

    def __init__(self, config: Config, predictor: nn.Module, device: DeviceType, storages: LiveStorages) -> None:
        super().__init__()
        self.predictor, self._storages = predictor, storages
        self.peaks: list[int] = []  # bytes, one per phase
        frozen_dtype = torch.bfloat16 if config.model.dtype == "bfloat16" else torch.float32
        for module in predictor.modules():
            for name, old in module.named_parameters(recurse=False):
                is_float32 = old.requires_grad or config.adapter.kind == "none"
                values = torch.empty(old.shape, dtype=torch.float32 if is_float32 else frozen_dtype)
                new = nn.Parameter(values, old.requires_grad)
                new.grad = torch.empty_like(new) if new.requires_grad else None  # as after an earlier micro-step
                module.register_parameter(name, new)
            if device == "cuda":
                module.__class__ = _ON_CUDA.get(type(module), type(module))
        attention = config.training.attention
        self.set_attention(_fused_attention if device == "cuda" and attention == "auto" else attention)

    def predict(self, *args: Any, **kwargs: Any) -> Tensor:
        """Predict and end a phase; end another phase when the backward pass reaches this prediction."""
        predicted = super().predict(*args, **kwargs)
        self.end_phase()
        if predicted.requires_grad:
            predicted.register_hook(self.end_phase)  # type: ignore[no-untyped-call]  # torch
        return predicted

    def end_phase(self, _: object = None) -> None:
        """Append the peak since the previous phase to `peaks`."""
        self.peaks.append(self._storages.peak)
        self._storages.reset_peak()

    def run(self, config: Config, sizes: ModelSizes, clips: int, *, train: bool) -> tuple[int, ...]:
        """Return the peak of each phase of a micro-step; with `train=False`, of a prediction without gradients."""
        batch = _make_batch(config, sizes, clips)
        states, cameras = batch.states[:, :-1], None if batch.extrinsics is None else batch.extrinsics[:, :-1]
        self._storages.forget()
        self.peaks.clear()
        self.train(train)
        with torch.set_grad_enabled(train), autocast(config.training, torch.device("cpu")):
            if not train:
                self.predict(batch.latents[:, :-1], batch.actions, states, cameras)
                return (self.peaks[-1],)
            loss = torch.stack(Objective(self, config.training)(batch)).sum()
        self.end_phase()
        loss.backward()  # type: ignore[no-untyped-call]  # torch
        self.end_phase()
        return tuple(self.peaks)


def _measure(config: Config, sizes: ModelSizes, device: DeviceType) -> tuple[tuple[int, ...], ...]:
    """Return for each field of `StepBytes` the bytes of each phase."""
    predictor = meta_predictor(config, sizes)
    rotary_tables.cache_clear()  # earlier calls cached real tables, and later calls must not use fake ones
    try:
        with FakeTensorMode(), _StorageCounter() as counter:
            model = _FakeModel(config, predictor, device, counter.storages)
            before = counter.storages.live
            matrices = CastMatrices(model, PRECISIONS[config.training.precision])
            casts = counter.storages.live - before
            with matrices.use():
                stored = model.run(config, sizes, config.training.batch_size, train=True)
                model.set_gradient_checkpointing(True)
                checkpointed = model.run(config, sizes, config.training.batch_size, train=True)
            return stored, checkpointed, (casts,), model.run(config, sizes, config.validation.batch_size, train=False)
    finally:
        rotary_tables.cache_clear()


class _CudaNorm(nn.LayerNorm):
    def forward(self, tokens: Tensor) -> Tensor:
        if not torch.is_autocast_enabled("cpu"):
            return super().forward(tokens)
        return layer_norm(tokens.float(), self.normalized_shape, self.weight.float(), self.bias.float(), self.eps)


class _CudaDropout(nn.Dropout):
    def forward(self, tokens: Tensor) -> Tensor:
        return torch.native_dropout(tokens, self.p, self.training)[0]


_ON_CUDA: dict[type[nn.Module], type[nn.Module]] = {nn.LayerNorm: _CudaNorm, nn.Dropout: _CudaDropout}


def _fused_attention(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:  # noqa: ARG001
    return scaled_dot_product_attention(query, key, value)


# ---- memory of a run ----


@dataclass(frozen=True)
class Parameters:
    """Numbers of parameters of a model."""

    encoder: int
    predictor: int  # without the trained parameters of an adapter
    trained_tensors: tuple[int, ...]  # elements of each trained tensor: adapter and whole layers, or whole predictor

    @property
    def trained(self) -> int:
        """The number of trained parameters."""
        return sum(self.trained_tensors)


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes on the GPU by part. Not all parts are allocated at once; `total` is the largest sum of those that are."""

    parameters: Parameters
    checkpointing: bool  # training.gradient_checkpointing
    parts: dict[str, int]  # bytes by the displayed name of the part

    def total(self, *, checkpointing: bool) -> int:
        """Return the peak in bytes, with or without gradient checkpointing."""
        parts = self.parts
        predicting = parts["adapter copies"] + parts[f"predictor activations{_CHECKPOINTED * checkpointing}"]
        old_weights = parts["trained weights"]  # `update_to_weight` needs them on logged steps
        encoding = parts["encoder activations"] + parts["batch"]  # the batch is freed when its latents are computed
        computing = parts["latents"] + max(encoding, predicting)
        training = parts["gradients"] + max(computing, old_weights)
        permanent = sum(parts[name] for name in _PERMANENT_PARTS)
        return max(permanent + max(training, parts["validation"]), parts["encoding the cache"])


def count_parameters(config: Config, sizes: ModelSizes) -> Parameters:
    """Return how many parameters a model of these sizes has, and how many of them the config trains.

    No weights are allocated.

    Raises:
        InputError: A key of the adapter does not fit the predictor.
    """
    weights = list(meta_predictor(config, sizes).parameters())
    trained = tuple(weight.numel() for weight in weights if weight.requires_grad)
    total = sum(weight.numel() for weight in weights)
    predictor = total if config.adapter.kind == "none" else total - sum(trained)
    with torch.device("meta"):
        encoder = sum(weight.numel() for weight in Encoder(sizes).parameters())  # 2.1 has two patch embeddings
    return Parameters(encoder, predictor, trained)


def estimate_memory(config: Config, sizes: ModelSizes) -> MemoryEstimate:
    """Return the memory that a run needs.

    Args:
        config: The config of the run.
        sizes: The sizes of the model, for example from `model.checkpoints.base_sizes`.

    Raises:
        InputError: A key of the adapter does not fit the predictor.
    """
    parameters, step = count_parameters(config, sizes), measure_step(config, sizes)
    number, trained = HALF if config.model.dtype == "bfloat16" else FLOAT32, parameters.trained * FLOAT32
    encoder = parameters.encoder * number
    parts = {
        "encoder weights": 0 if config.data.uses_cached_latents else encoder,
        "predictor weights": parameters.predictor * number if config.adapter.kind == "lora" else 0,  # frozen
        "trained weights": trained,
        "gradients": trained,
        "optimizer state": sum(_moment_bytes(config, elements) for elements in parameters.trained_tensors),
        "batch": batch_bytes(config, sizes, config.training.batch_size),
        "latents": _latent_bytes(config, sizes, config.training.batch_size),
        "encoder activations": _encoding_bytes(config, sizes, config.training.batch_size),  # before the predictor runs
        "validation": _validation_bytes(config, sizes, step),
        "encoding the cache": 0 if config.data.cache == "off" else encoder + _caching_bytes(config, sizes),
        "predictor activations": step.stored,
        f"predictor activations{_CHECKPOINTED}": step.checkpointed,
        "adapter copies": step.casts,
        "CUDA allowance": ALLOWANCE,
    }
    return MemoryEstimate(parameters, config.training.gradient_checkpointing, parts)


def suggest_memory_savings(config: Config, sizes: ModelSizes, available: int) -> list[str] | None:
    """Return the config changes after which a run fits into `available` bytes; None if all of them do not suffice."""
    applied, total = list[str](), _estimate_total(config, sizes)
    for override, changes in _list_memory_savings(config):
        if total <= available:
            break
        sections = {name: getattr(config, name).model_copy(update=values) for name, values in changes.items()}
        lighter = config.model_copy(update=sections)
        if (lighter_total := _estimate_total(lighter, sizes)) < total:
            applied.append(
                f"{override} replay.{override}" if config.replay and override.startswith("data.") else override
            )
            config, total = lighter, lighter_total
    return applied if total <= available else None


def _estimate_total(config: Config, sizes: ModelSizes) -> int:
    return estimate_memory(config, sizes).total(checkpointing=config.training.gradient_checkpointing)


def _list_memory_savings(config: Config) -> Iterator[tuple[str, dict[str, dict[str, Any]]]]:
    """Yield the changes that save memory, preferred ones first: the text to print, and the new values by section."""
    yield "training.gradient_checkpointing=true", {"training": {"gradient_checkpointing": True}}
    yield "training.batch_size=1 (and raise training.accumulation by the same factor)", {"training": {"batch_size": 1}}
    bf16 = {"model": {"dtype": "bfloat16"}, "training": {"precision": "bf16"}}
    yield "model.dtype=bfloat16 with training.precision=bf16", bf16
    if not (config.data.transforms or config.data.uses_cached_latents):
        yield "data.cache=auto", {"data": {"cache": "auto"}}
    frames = min(config.data.frames, max(8, config.training.rollout_steps + 1))
    yield f"data.frames={frames}", {"data": {"frames": frames}}
    yield "training.optimizer=adamw_8bit", {"training": {"optimizer": "adamw_8bit"}}
    if not config.model.is_random:
        yield "adapter.kind=lora", {"adapter": {"kind": "lora"}}


def _moment_bytes(config: Config, elements: int) -> int:
    """Return the bytes of AdamW's two moments for one tensor.

    With `adamw_8bit` there is one float32 scale for every 256 elements; moments of small tensors stay in float32.

    Source: bitsandbytes 0.50, optim/optimizer.py, Optimizer2State.init_state.
    """
    if config.training.optimizer == "adamw" or elements < _MIN_8_BIT_ELEMENTS:
        return 2 * elements * FLOAT32
    return 2 * (elements + -(-elements // _ELEMENTS_PER_SCALE) * FLOAT32)


def batch_bytes(config: Config, sizes: ModelSizes, clips: int) -> int:
    """Return the bytes of a batch from the loader: cached latents, or frames, if they have the model's image size."""
    frames = clips * config.data.frames
    if not config.data.uses_cached_latents:
        return frames * 3 * sizes.image_size**2
    return frames * sizes.tokens_per_frame * sizes.encoder.width * _BYTES_PER_CACHED_NUMBER[config.data.cache_dtype]


def _latent_bytes(config: Config, sizes: ModelSizes, clips: int) -> int:
    return clips * config.data.frames * sizes.tokens_per_frame * sizes.encoder.width * FLOAT32


def _encoding_bytes(config: Config, sizes: ModelSizes, clips: int) -> int:
    """Return the peak bytes of encoding clips: the larger half of an encoder block, the frames, and the features."""
    return 0 if config.data.uses_cached_latents else _encoder_bytes(config, sizes, clips * config.data.frames)


def _caching_bytes(config: Config, sizes: ModelSizes) -> int:
    """Return the peak bytes of encoding a cache, including the queued input frames, without the encoder's weights."""
    queued = FRAMES_AT_ONCE * 3 * sizes.image_size**2 * (FLOAT32 + 1)
    return ALLOWANCE + queued + _encoder_bytes(config, sizes, ENCODE_CHUNK)


def _encoder_bytes(config: Config, sizes: ModelSizes, frames: int) -> int:
    width, hidden = sizes.encoder.width, int(sizes.encoder.width * sizes.encoder.mlp_ratio)
    number = FLOAT32 if config.training.precision == "fp32" else HALF
    tokens = min(ENCODE_CHUNK, frames) * sizes.tokens_per_frame
    attention = width * (4 * number + 5 * FLOAT32)  # residual, query, key, value; normed and four while rotating
    mlp = width * (2 * number + 2 * FLOAT32) + 2 * hidden * number  # residual and output; normed, cast; around GELU
    pixels = frames * 3 * sizes.image_size**2 * FLOAT32
    features = frames * sizes.tokens_per_frame * width * 2 * FLOAT32  # as computed, and normalised
    return tokens * max(attention, mlp) + pixels + features


def _validation_bytes(config: Config, sizes: ModelSizes, step: StepBytes) -> int:
    """Return the peak bytes of a validation batch, without gradients.

    It is the larger of encoding and predicting. Predicting needs two predictions of all latents, and the larger of the
    activations of one prediction of all steps and the keys and values that a rollout keeps (all steps but the last 2).
    """
    clips, predictor = config.validation.batch_size, sizes.predictor
    latents, number = _latent_bytes(config, sizes, clips), FLOAT32 if config.training.precision == "fp32" else HALF
    tokens = sizes.tokens_per_frame + 1 + predictor.use_states + predictor.use_extrinsics
    cached = 2 * predictor.depth * clips * (config.data.frames - 2) * tokens * predictor.width * number
    encoding = _encoding_bytes(config, sizes, clips) + batch_bytes(config, sizes, clips)
    return latents + max(encoding, 2 * latents + max(cached, step.predicting))
