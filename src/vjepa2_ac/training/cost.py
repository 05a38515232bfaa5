"""GPU memory of a run before it starts, part by part: a step on fake tensors, and arithmetic for the rest.

The predictor's part is the peak of one micro-step of the run on fake tensors, through the code that trains. Calculated
is what needs no such pass: weights and moments from the counts of parameters (bitsandbytes' kernels take no fake
tensors), the next batch from its sizes, and the encoder at work. On an H100 the peak that PyTorch's allocator reported
differed from the total by 1 %; the CUDA context was not compared.

Fake tensors are on the CPU, because fake CUDA tensors need a driver; three things are then computed as on CUDA:
autocast computes norms from a float32 copy where weights have another type than the arithmetic, a dropout mask takes
one byte, and `auto` attention is one operation (FlexAttention) that keeps no scores.

Blocks after the first are equal: models of two and of three blocks show what each further one needs, in each phase of
the step (a prediction, the losses, the backward pass of a prediction).
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

Kind = Literal["cpu", "cuda"]

GIGABYTE = 10**9
ALLOWANCE = 3 * GIGABYTE // 2  # CUDA context 0.5, cuBLAS workspaces, fragmentation: not computed but assumed
USUAL_GPU = 24 * GIGABYTE
FLOAT32 = 4
HALF = 2  # bfloat16 and float16

_BLOCKS = (2, 3)  # of the models that are measured
_BYTES_OF_CACHED = {"int8": 1, "bf16": HALF, "fp32": FLOAT32}
_SMALLEST_IN_8_BITS, _ELEMENTS_OF_A_SCALE = 4096, 256  # of bitsandbytes
_CHECKPOINTED = ", checkpointed"
_STANDING = (  # parts that are allocated all the time
    "encoder weights", "predictor weights", "trained weights", "optimizer state", "prefetched batch", "CUDA allowance",
)  # fmt: skip
_OF_LOSS = {"loss", "rollout_steps"}
_WITH_EFFECT: Any = {
    "plugins": True, "adapter": True, "model": {"dtype"}, "data": {"frames"}, "validation": {"batch_size"},
    "training": {"attention", "precision", "batch_size", *_OF_LOSS},
}  # fmt: skip


class StepBytes(NamedTuple):
    """Bytes that live at once, at most, in addition to weights, gradients and batch."""

    stored: int  # in a forward and backward pass, without checkpointing
    checkpointed: int
    casts: int  # matrices of adapters in the arithmetic's type, for all micro-steps
    predicting: int  # in a prediction of all steps of a batch of validation


_measured: dict[str, StepBytes] = {}


def meta_predictor(config: Config, sizes: ModelSizes) -> nn.Module:
    """Return the predictor with what a run trains, on the meta device, in float32; the rest is frozen.

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


def _batch(config: Config, sizes: ModelSizes, clips: int) -> LatentBatch:
    frames, predictor = config.data.frames, sizes.predictor
    latents = torch.empty(clips, frames, sizes.tokens_per_frame, sizes.encoder.width)
    states = torch.empty(clips, frames, predictor.state_dim)
    actions = torch.empty(clips, frames - 1, predictor.action_dim)
    extrinsics = torch.empty(clips, frames, 6) if predictor.use_extrinsics else None
    return LatentBatch(latents, states, actions, extrinsics, ("",) * clips, (0,) * clips)


def measure_step(config: Config, sizes: ModelSizes, device: Kind = "cuda") -> StepBytes:
    """Return what a micro-step of a run keeps in memory.

    Args:
        config: The run.
        sizes: Of its model.
        device: The device type whose rules for saved tensors apply.

    Raises:
        InputError: A key of the adapter does not fit the predictor.
    """
    key = f"{config.model_dump_json(include=_WITH_EFFECT)} {sizes} {device}"
    if key not in _measured:
        depth = sizes.predictor.depth
        if depth <= _BLOCKS[1] or config.adapter.peft:  # whose options may make blocks differ
            peaks = _measure(config, sizes, device)
        else:
            predictors = (sizes.predictor.model_copy(update={"depth": blocks}) for blocks in _BLOCKS)
            models = (sizes.model_copy(update={"predictor": predictor}) for predictor in predictors)
            fewer, more = (_measure(config, model, device) for model in models)
            further = depth - _BLOCKS[0]
            peaks = tree_map(lambda two, three: two + further * (three - two), fewer, more)
        _measured[key] = StepBytes(*map(max, peaks))
    return _measured[key]


class LiveStorages:
    """Counts the bytes of storages from the first sight of a tensor until nothing refers to its storage.

    Args:
        block: Each storage is rounded up to a multiple of this number of bytes, as an allocator does.
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

    def run(self, config: Config, sizes: ModelSizes, clips: int, *, train: bool) -> tuple[int, ...]:
        """Return the peak of each phase of a micro-step, or of a prediction without gradients."""
        batch = _batch(config, sizes, clips)
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


def _measure(config: Config, sizes: ModelSizes, device: Kind) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of `StepBytes`, phase by phase."""
    predictor = meta_predictor(config, sizes)
    rotary_tables.cache_clear()  # tables that are cached between calls do not get in or out
    try:
        with FakeTensorMode(), _Holding() as holding:
            model = _FakeModel(config, predictor, device, holding.storages)
            before = holding.storages.live
            matrices = CastMatrices(model, PRECISIONS[config.training.precision])
            casts = holding.storages.live - before
            with matrices.current():
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


def _flash(query: Tensor, key: Tensor, value: Tensor, tokens_per_step: int) -> Tensor:  # noqa: ARG001
    return scaled_dot_product_attention(query, key, value)


# ---- memory of a run ----


@dataclass(frozen=True)
class Parameters:
    """How many parameters there are, exactly."""

    encoder: int
    predictor: int
    trained_tensors: tuple[int, ...]  # elements of each: of an adapter and whole heads, or of the whole predictor

    @property
    def trained(self) -> int:
        """How many are trained."""
        return sum(self.trained_tensors)


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes on the GPU, part by part. `total` is the largest of five moments: they do not occur at once."""

    parameters: Parameters
    checkpointing: bool  # as the config requests
    parts: dict[str, int]  # by name, for people

    def total(self, *, checkpointing: bool) -> int:
        """Return the peak with or without gradient checkpointing."""
        parts = self.parts
        predicting = parts["adapter copies"] + parts[f"predictor activations{_CHECKPOINTED * checkpointing}"]
        old_weights = parts["trained weights"]  # `update_to_weight` needs them on logged steps
        computing = parts["latents"] + max(parts["encoder activations"], predicting)
        training = parts["gradients"] + max(computing, old_weights)
        standing = sum(parts[name] for name in _STANDING)
        return max(standing + max(training, parts["validation"]), parts["encoding the cache"])


def count_parameters(config: Config, sizes: ModelSizes) -> Parameters:
    """Return how many parameters a model of these sizes has, and how many of them the config trains. No weight is made.

    Raises:
        InputError: A key of the adapter does not fit the predictor.
    """
    every = list(meta_predictor(config, sizes).parameters())
    trained = tuple(one.numel() for one in every if one.requires_grad)
    total = sum(one.numel() for one in every)
    own = total if config.adapter.kind == "none" else total - sum(trained)
    with torch.device("meta"):
        encoder = sum(one.numel() for one in Encoder(sizes).parameters())  # of V-JEPA 2.1 both frame paths
    return Parameters(encoder, own, trained)


def estimate_memory(config: Config, sizes: ModelSizes) -> MemoryEstimate:
    """Return the memory that a run needs.

    Args:
        config: The run.
        sizes: Sizes of its model, such as `model.checkpoints.base_sizes` gives.

    Raises:
        InputError: A key of the adapter does not fit the predictor.
    """
    parameters, step = count_parameters(config, sizes), measure_step(config, sizes)
    number, trained = HALF if config.model.dtype == "bfloat16" else FLOAT32, parameters.trained * FLOAT32
    encoder = parameters.encoder * number
    parts = {
        "encoder weights": 0 if config.data.takes_latents else encoder,
        "predictor weights": parameters.predictor * number if config.adapter.kind == "lora" else 0,  # frozen
        "trained weights": trained,
        "gradients": trained,
        "optimizer state": sum(_moments(config, elements) for elements in parameters.trained_tensors),
        "prefetched batch": batch_bytes(config, sizes),
        "latents": _latents(config, sizes, config.training.batch_size),
        "encoder activations": _encoding(config, sizes, config.training.batch_size),  # before the predictor runs
        "validation": _validating(config, sizes, step),
        "encoding the cache": 0 if config.data.cache == "off" else encoder + _caching(config, sizes),
        "predictor activations": step.stored,
        f"predictor activations{_CHECKPOINTED}": step.checkpointed,
        "adapter copies": step.casts,
        "CUDA allowance": ALLOWANCE,
    }
    return MemoryEstimate(parameters, config.training.gradient_checkpointing, parts)


def ways_to_fit(config: Config, sizes: ModelSizes, available: int) -> list[str] | None:
    """Return the config keys to change, one after the other, until the run fits; None if all of them do not suffice."""
    turned, total = list[str](), _total(config, sizes)
    for knob, changes in _knobs(config):
        if total <= available:
            break
        sections = {name: getattr(config, name).model_copy(update=values) for name, values in changes.items()}
        lighter = config.model_copy(update=sections)
        if (less := _total(lighter, sizes)) < total:
            turned.append(f"{knob} replay.{knob}" if config.replay and knob.startswith("data.") else knob)
            config, total = lighter, less
    return turned if total <= available else None


def _total(config: Config, sizes: ModelSizes) -> int:
    return estimate_memory(config, sizes).total(checkpointing=config.training.gradient_checkpointing)


def _knobs(config: Config) -> Iterator[tuple[str, dict[str, dict[str, Any]]]]:
    """Yield what makes a run lighter, in this order: the knob, for people, and its value by section."""
    yield "training.gradient_checkpointing=true", {"training": {"gradient_checkpointing": True}}
    yield "training.batch_size=1 (and as much more accumulation)", {"training": {"batch_size": 1}}
    bf16 = {"model": {"dtype": "bfloat16"}, "training": {"precision": "bf16"}}
    yield "model.dtype=bfloat16 with training.precision=bf16", bf16
    if not (config.data.transforms or config.data.takes_latents):
        yield "data.cache=auto", {"data": {"cache": "auto"}}
    fewest = max(8, config.training.rollout_steps + 1)
    yield "data.frames=8", {"data": {"frames": min(config.data.frames, fewest)}}
    yield "training.optimizer=adamw_8bit", {"training": {"optimizer": "adamw_8bit"}}
    if not config.model.is_random:
        yield "adapter.kind=lora", {"adapter": {"kind": "lora"}}


def _moments(config: Config, elements: int) -> int:
    """Return the bytes of AdamW's two moments of one tensor.

    In 8 bits there is a float32 scale for every 256 elements; small tensors keep float32.

    Source: bitsandbytes 0.50, optim/optimizer.py, Optimizer2State.init_state.
    """
    if config.training.optimizer == "adamw" or elements < _SMALLEST_IN_8_BITS:
        return 2 * elements * FLOAT32
    return 2 * (elements + -(-elements // _ELEMENTS_OF_A_SCALE) * FLOAT32)


def batch_bytes(config: Config, sizes: ModelSizes) -> int:
    """Return the bytes of a batch as the loader sends it: latents, or frames, which may be larger or smaller."""
    frames = config.training.batch_size * config.data.frames
    if not config.data.takes_latents:
        return frames * 3 * sizes.image_size**2
    return frames * sizes.tokens_per_frame * sizes.encoder.width * _BYTES_OF_CACHED[config.data.cache_dtype]


def _latents(config: Config, sizes: ModelSizes, clips: int) -> int:
    return clips * config.data.frames * sizes.tokens_per_frame * sizes.encoder.width * FLOAT32


def _encoding(config: Config, sizes: ModelSizes, clips: int) -> int:
    """Return the bytes that live at once in the larger half of an encoder block, the frames, and the features."""
    return 0 if config.data.takes_latents else _at_work(config, sizes, clips * config.data.frames)


def _caching(config: Config, sizes: ModelSizes) -> int:
    """Return the bytes of encoding a cache beside the encoder's weights; a part of an episode waits as input."""
    waiting = FRAMES_AT_ONCE * 3 * sizes.image_size**2 * (FLOAT32 + 1)
    return ALLOWANCE + waiting + _at_work(config, sizes, ENCODE_CHUNK)


def _at_work(config: Config, sizes: ModelSizes, frames: int) -> int:
    width, hidden = sizes.encoder.width, int(sizes.encoder.width * sizes.encoder.mlp_ratio)
    number = FLOAT32 if config.training.precision == "fp32" else HALF
    tokens = min(ENCODE_CHUNK, frames) * sizes.tokens_per_frame
    attention = width * (4 * number + 5 * FLOAT32)  # residual, query, key, value; normed, and four while rotating
    mlp = width * (2 * number + 2 * FLOAT32) + 2 * hidden * number  # residual and output; normed, cast; around GELU
    pixels = frames * 3 * sizes.image_size**2 * FLOAT32
    features = frames * sizes.tokens_per_frame * width * 2 * FLOAT32  # as computed, and normalised
    return tokens * max(attention, mlp) + pixels + features


def _validating(config: Config, sizes: ModelSizes, step: StepBytes) -> int:
    """Return the bytes of a batch of validation, without gradients.

    Either it is encoded, or predicted: true latents, two predictions of them, and the larger of what a prediction of
    all steps at once takes and the keys and values that the rollout keeps of all steps but the last two.
    """
    clips, predictor = config.validation.batch_size, sizes.predictor
    latents, number = _latents(config, sizes, clips), FLOAT32 if config.training.precision == "fp32" else HALF
    tokens = sizes.tokens_per_frame + 1 + predictor.use_states + predictor.use_extrinsics
    cached = 2 * predictor.depth * clips * (config.data.frames - 2) * tokens * predictor.width * number
    return latents + max(_encoding(config, sizes, clips), 2 * latents + max(cached, step.predicting))
