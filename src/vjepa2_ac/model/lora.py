"""Add, disable and merge trainable weights: a LoRA adapter on the predictor, or the whole predictor.

`adapter_folder` saves and loads the trained weights.
"""

from __future__ import annotations

import copy
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.config.model import PEFT_NAMES
from vjepa2_ac.errors import InputError, quiet_imports
from vjepa2_ac.model.low_rank import LowRankLayer, low_rank_linear
from vjepa2_ac.model.predictor import ActionConditionedPredictor
from vjepa2_ac.model.world_model import Adaptation, WorldModel, base_weights, require_trained_projections
from vjepa2_ac.storage.structured import parse_record, short_repr

with quiet_imports():
    from peft import LoraConfig, PeftModel, get_peft_model, get_peft_model_state_dict
    from peft.tuners.lora import Linear, LoraLayer

_SETS = {"attention": ("q", "k", "v", "o"), "mlp": ("fc1", "fc2")}
NEEDED = "a LoRA adapter of V-JEPA 2-AC's predictor in PEFT's format, as written by vjepa2-ac"
FIX = "Copy or train the adapter again; other methods of PEFT are not supported"
_INFORMATIONAL = frozenset({  # options that do not affect the adapter
    "auto_mapping", "base_model_name_or_path", "inference_mode", "megatron_core", "peft_type", "peft_version",
    "revision", "task_type",
})  # fmt: skip
_LITERAL = re.compile(r"[\w.]+")  # a plain layer name, which PEFT matches quickly as a regular expression
_MAX_RANK, _MAX_ALPHA = 1024, 1e6


class LoraLinear(Linear, LowRankLayer):  # type: ignore[misc]  # PEFT has no types
    """PEFT's linear layer with a low-rank adapter, with fewer passes over the tokens for plain LoRA.

    PEFT casts tokens to the adapter's float32, and autocast casts them back. Dropout, scaling, addition and their
    gradients are separate passes. Here only the two small matrices are cast, and the matrix products include scaling
    and addition. In float32 the result is the same up to rounding; in bfloat16 it is rounded less often.

    This class computes only plain LoRA on a frozen layer. PEFT computes all other cases: DoRA, a disabled or merged
    adapter, and data types that do not match. Hooks on the base layer and the matrices are not called, and second
    derivatives are not supported.
    """

    def forward(self, tokens: Float[Tensor, "*batch inputs"], *args: Any, **kwargs: Any) -> Tensor:
        """Return the output of the layer and its adapter for each token."""
        dtype = self._dtype_of_plain_lora(tokens)
        if dtype is None or args or kwargs:
            return super().forward(tokens, *args, **kwargs)  # type: ignore[no-any-return]
        name = self.active_adapters[0]
        dropout = self.lora_dropout[name]
        active_dropout = None if isinstance(dropout, nn.Identity) or not self.training else dropout
        return low_rank_linear(tokens.to(dtype), self.base_layer, self, active_dropout, self.scaling[name])

    def matrices(self) -> tuple[Tensor, ...]:
        """Return the two matrices of the active adapter; empty if there are several adapters."""
        names = self.active_adapters
        if len(names) != 1 or names[0] not in self.lora_A:
            return ()
        return self.lora_A[names[0]].weight, self.lora_B[names[0]].weight

    def _dtype_of_plain_lora(self, tokens: Tensor) -> torch.dtype | None:
        """Return the data type of the computation; None if PEFT's `forward` must be used."""
        adapters, layer = self.active_adapters, self.base_layer
        if self.disable_adapters or self.merged or len(adapters) != 1 or adapters[0] not in self.lora_A:
            return None
        if self.lora_variant or self.lora_bias.get(adapters[0]) or type(layer).forward is not nn.Linear.forward:
            return None
        if tokens.dim() < 2 or layer.weight.requires_grad or (layer.bias is not None and layer.bias.requires_grad):
            return None
        if torch.is_autocast_enabled(tokens.device.type):
            return torch.get_autocast_dtype(tokens.device.type)
        is_same = tokens.dtype == layer.weight.dtype == self.lora_A[adapters[0]].weight.dtype
        return tokens.dtype if is_same else None


class TrainableReport(NamedTuple):
    """Numbers of parameters. The parameters of an adapter are counted in `trained` only."""

    trained: int
    predictor: int
    total: int  # predictor and encoder

    def __str__(self) -> str:
        fraction = f"{self.trained / self.predictor:.2%} of the predictor's {self.predictor:,}"
        return f"{self.trained:,} parameters are trained ({fraction}); the model has {self.total:,}"


def add_adapter(model: WorldModel, config: AdapterConfig, seed: int) -> None:
    """Add an adapter to the predictor of a model, or make the whole predictor trainable.

    Trained weights are float32. A new adapter does not change the output, because its second matrices are zero, unless
    `peft.init_lora_weights` is `false` or `orthogonal`.

    Args:
        model: The base model.
        config: The config of the adapter.
        seed: The seed of the adapter's initial weights.

    Raises:
        InputError: A target matches no layer, another key does not fit the predictor or PEFT, or a new input projection
            (`replace_input_projections`) would not be trained.
        ValueError: The model is already adapted.
    """
    if model.adaptation is not None:
        raise ValueError("this model is already adapted: call merge_adapter first, or load_trained to load weights")
    if config.kind == "none":
        train_all_weights(model)
        return
    if model.new_input_projections is not None:
        require_trained_projections(
            tuple(dict.fromkeys(name.split(".")[0] for name in model.new_input_projections.replaced)), config
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)  # for weights that PEFT initialises
        wrap_predictor(model, config, initialisation=config.peft.get("init_lora_weights", True))
    # Raises if the adapter could not be loaded again after it is saved.
    parse_adapter_config(lora_config(model).to_dict(), where="adapter.peft")
    layers = lora_layers(model)
    if config.peft.get("init_lora_weights", True) is True:
        _draw_first_matrices(layers, torch.Generator().manual_seed(seed))
    _measure_magnitudes(layers)


def with_adapter(
    predictor: ActionConditionedPredictor, config: AdapterConfig, initialisation: bool | str = True
) -> nn.Module:
    """Return a predictor with a LoRA adapter, whose matrices are initialised by PEFT.

    Args:
        predictor: The predictor, without an adapter.
        config: The config of the adapter.
        initialisation: PEFT's `init_lora_weights`.

    Raises:
        InputError: A key does not fit the predictor, or PEFT rejects it.
    """
    arguments = _peft_arguments(predictor, config) | {"init_lora_weights": initialisation}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # PEFT warns about a pattern that matches no layer
            peft_config = LoraConfig(**arguments)
            peft_config._register_custom_module({nn.Linear: LoraLinear})
            wrapped = get_peft_model(predictor, peft_config)
    except (ArithmeticError, AttributeError, RuntimeWarning, TypeError, ValueError, re.error) as error:
        needed = "options of PEFT's LoraConfig that fit the predictor"
        raise InputError(where="adapter.peft", found=str(error), needed=needed) from None
    wrapped.train(predictor.training)  # PEFT creates dropout in training mode
    for name, value in wrapped.named_parameters():
        if _is_trained_name(name):
            value.data = value.data.float()
    return wrapped  # type: ignore[no-any-return]  # PEFT has no types


def trainable_report(model: WorldModel) -> TrainableReport:
    """Count the parameters: trained (even if currently frozen), of the predictor without adapter, and in total."""
    trained = 0 if model.adaptation is None else sum(value.numel() for value in _iterate_trained_weights(model))
    predictor = sum(value.numel() for value in base_weights(model.base_predictor).values())
    encoder = sum(value.numel() for value in model.encoder.parameters())
    return TrainableReport(trained, predictor, predictor + encoder)


def lora_layers(model: WorldModel) -> dict[str, Any]:
    """Return the layers of the predictor that have an adapter (PEFT's LoraLayer), by name."""
    return {name: layer for name, layer in model.base_predictor.named_modules() if isinstance(layer, LoraLayer)}


def require_adaptation(model: WorldModel) -> Adaptation:
    """Return how a model was adapted.

    Raises:
        ValueError: The model is not adapted.
    """
    if model.adaptation is None:
        raise ValueError("this model is not adapted: call add_adapter or load_trained first")
    return model.adaptation


def train_all_weights(model: WorldModel) -> None:
    """Make every weight of the predictor trainable, except in layers without input."""
    weights = {name: value.detach().to("cpu", copy=True) for name, value in model.predictor.state_dict().items()}
    model.adaptation = Adaptation("none", model.predictor_fingerprint(), model.encoder_fingerprint(), weights)
    model.predictor.float()
    set_trainable(model, trainable=True)


def wrap_predictor(model: WorldModel, config: AdapterConfig, initialisation: bool | str = True) -> None:
    """Add a LoRA adapter to the predictor of a model; arguments and errors are those of `with_adapter`."""
    base = model.predictor_fingerprint()
    checkpointing = model.base_predictor.gradient_checkpointing
    # With gradient checkpointing PEFT would add an input hook, which only re-entrant checkpointing needs.
    model.set_gradient_checkpointing(False)
    model.predictor = with_adapter(model.base_predictor, config, initialisation)
    model.set_gradient_checkpointing(checkpointing)
    model.adaptation = Adaptation("lora", base, model.encoder_fingerprint())


def _draw_first_matrices(layers: Mapping[str, Any], generator: torch.Generator) -> None:
    """Draw the first matrix of each layer from PEFT's distribution with a generator; the second matrix stays zero."""
    for layer in layers.values():
        matrix = layer.lora_A["default"].weight
        values = torch.empty(matrix.shape)
        nn.init.kaiming_uniform_(values, a=math.sqrt(5), generator=generator)
        matrix.data.copy_(values)


def _measure_magnitudes(layers: Mapping[str, Any]) -> None:
    """Set DoRA's magnitudes to the current norms of the weights' rows, computed in float32 as in PEFT's forward."""
    for layer in layers.values():
        if "default" in layer.lora_magnitude_vector:
            update = layer.lora_B["default"].weight @ layer.lora_A["default"].weight
            weight = layer.get_base_layer().weight.float() + layer.scaling["default"] * update
            layer.lora_magnitude_vector["default"].weight.data.copy_(torch.linalg.norm(weight.detach(), dim=1))


def _is_trained_name(name: str) -> bool:
    return ".lora_" in name or ".modules_to_save." in name


def lora_weights(model: WorldModel) -> dict[str, Tensor]:
    """Return the weights of an adapter, by their names in PEFT's file format."""
    return dict(get_peft_model_state_dict(model.predictor, save_embedding_layers=False))


def lora_config(model: WorldModel) -> Any:
    """Return PEFT's config for a saved adapter, with layer names instead of the user's regular expressions."""
    predictor: Any = model.predictor
    options, layers = predictor.peft_config["default"], lora_layers(model)
    names = [name.removesuffix(".weight") for name in base_weights(model.base_predictor) if name.endswith(".weight")]
    kinds_without_adapter = {name.rpartition(".")[2] for name in names if name not in layers}
    kind_by_name = {name: name.rpartition(".")[2] for name in layers}
    resolved = {
        "inference_mode": True,
        "init_lora_weights": True,
        "target_modules": sorted(
            {name if kind in kinds_without_adapter else kind for name, kind in kind_by_name.items()}
        ),
        "exclude_modules": None,
        "layers_to_transform": None,
        "layers_pattern": None,
        "rank_pattern": {name: layer.r["default"] for name, layer in layers.items() if layer.r["default"] != options.r},
        "alpha_pattern": {
            name: layer.lora_alpha["default"]
            for name, layer in layers.items()
            if layer.lora_alpha["default"] != options.lora_alpha
        },
    }
    config = LoraConfig(**(options.to_dict() | resolved))
    config.target_modules = resolved["target_modules"]  # LoraConfig made a set of it, whose order can change
    return config


def set_trainable(model: WorldModel, trainable: bool) -> None:
    """Unfreeze or freeze the trained weights, and freeze all other weights of the predictor."""
    model.predictor.requires_grad_(False)
    for value in _iterate_trained_weights(model):
        value.requires_grad_(trainable)


def _iterate_trained_weights(model: WorldModel) -> Iterator[nn.Parameter]:
    """Yield the trained weights: those of an adapter, or all of the predictor except in layers without input."""
    has_adapter = isinstance(model.predictor, PeftModel)
    for name, value in model.predictor.named_parameters():
        if _is_trained_name(name) if has_adapter else name.split(".", 1)[0] not in model.base_predictor.unused_layers:
            yield value


def parse_adapter_config(values: Mapping[str, Any], *, where: str) -> AdapterConfig:
    """Convert a saved adapter's options of PEFT's LoraConfig to this project's adapter config.

    The file may be untrusted, so PEFT does not read it. Layers must be selected by name, not by a regular expression,
    and options must have plain values. Therefore no option can run code, take long, or need more memory than an adapter
    of rank 1,024.

    Raises:
        InputError: The values describe another kind of adapter, or contain an option that is not supported.
    """
    defaults: dict[str, Any] = LoraConfig().to_dict()
    fields: dict[str, Any] = {"kind": "lora", "rslora": False}  # False is PEFT's default, not this project's
    fields |= {key: values[peft_key] for peft_key, key in PEFT_NAMES.items() if values.get(peft_key) is not None}
    options = {name: value for name, value in values.items() if name not in _INFORMATIONAL and name not in PEFT_NAMES}
    options = {name: value for name, value in options.items() if not _is_off(value, defaults.get(name))}
    unsupported = {name: value for name, value in options.items() if not _is_supported(name, value, defaults.get(name))}
    if values.get("peft_type") != "LORA":
        unsupported = {"peft_type": values.get("peft_type")}
    unsupported |= {key: None for key in ("r", "lora_alpha", "target_modules") if values.get(key) is None}
    if unsupported:
        listed = ", ".join(f"{short_repr(name)} {short_repr(value)}" for name, value in unsupported.items())
        problem = f"an adapter with unsupported options: {listed}"
        raise InputError(where=where, found=problem, needed=NEEDED, fix=FIX)
    return parse_record(AdapterConfig, {**fields, "peft": options}, where=where, needed=NEEDED, fix=FIX)


def _is_off(value: object, default: object) -> bool:
    return value is None or value is False or value in ([], {}) or value == default


def _is_supported(name: str, value: object, default: object) -> bool:
    """Return whether an option is supported: numbers by plain layer name, an initialisation, or a number."""
    if name in {"rank_pattern", "alpha_pattern"}:
        types, limit = ((int,), _MAX_RANK) if name == "rank_pattern" else ((int, float), _MAX_ALPHA)
        return isinstance(value, dict) and all(
            _LITERAL.fullmatch(layer) and type(number) in types and 0 < number <= limit
            for layer, number in value.items()
        )
    return name == "init_lora_weights" or (isinstance(value, bool | int | float) and type(value) is type(default))


def _peft_arguments(predictor: ActionConditionedPredictor, config: AdapterConfig) -> dict[str, Any]:
    """Return the arguments of PEFT's LoraConfig, with sets of targets (such as `attention`) replaced by layer names.

    Layers without input cannot have an adapter. The set `all` excludes layers that are trained directly.

    Raises:
        InputError: An entry of `targets` or `modules_to_save` matches no layer, or a layer is in both.
    """
    directly_trained = config.modules_to_save
    if missing := [name for name in directly_trained if not hasattr(predictor, name)]:
        problem = f"{', '.join(missing)}, which a predictor without states does not have"
        raise InputError(where="adapter.modules_to_save", found=problem, fix="Remove it")
    layers = {name for name, layer in predictor.named_modules() if isinstance(layer, nn.Linear)}
    layers -= set(predictor.unused_layers)
    kinds = {name.rpartition(".")[2] for name in layers}
    sets = {**_SETS, "all": tuple(sorted(kinds - set(directly_trained)))}
    targets = list(dict.fromkeys(layer for target in config.targets for layer in sets.get(target, (target,))))
    unknown = [target for target in targets if target not in kinds | layers]
    if unknown or not targets:
        problem = ", ".join(unknown) + " matches no layer of the predictor" if unknown else "no target"
        needed = f"some of {', '.join(sorted(kinds))}; or {', '.join(sets)}"
        raise InputError(where="adapter.targets", found=problem, needed=needed)
    if in_both := sorted(set(targets) & set(directly_trained)):
        problem = (
            f"{', '.join(in_both)}, which adapter.targets contains, too: a layer is trained directly or with an adapter"
        )
        raise InputError(where="adapter.modules_to_save", found=problem, fix="Remove it from one of the two keys")
    arguments = {peft_key: getattr(config, key) for peft_key, key in PEFT_NAMES.items()}
    return arguments | {"target_modules": targets, "modules_to_save": list(directly_trained) or None} | config.peft


# ---- disable or merge an adapter ----


@contextmanager
def use_base_weights(model: WorldModel) -> Iterator[None]:
    """Make the model predict with the weights of its base model within the `with` block.

    New input projections (`replace_input_projections`) then have their untrained initial weights. Such a model must not
    serve as the base model in a comparison.
    """
    if model.adaptation is None:
        yield
        return
    previous = [(value, value.requires_grad) for value in model.predictor.parameters()]
    predictor: Any = model.predictor
    weights = model.adaptation.initial_weights
    try:
        with predictor.disable_adapter() if weights is None else _use_weights(predictor, weights):
            yield
    finally:
        for value, requires_grad in previous:  # PEFT enables gradients when it enables an adapter
            value.requires_grad_(requires_grad)


def merge_adapter(model: WorldModel) -> None:
    """Merge the adapter into the predictor in float32, cast it to the base model's data type, and freeze it.

    A fully fine-tuned predictor is only cast and frozen. A surrounding autocast has no effect.

    Raises:
        ValueError: The model is not adapted.
    """
    adaptation = require_adaptation(model)
    norm_weight = model.base_predictor.predictor_norm.weight  # adapters do not change its data type
    dtype = (adaptation.initial_weights or {}).get("predictor_norm.weight", norm_weight).dtype
    if adaptation.kind == "lora":
        with torch.autocast(model.device.type, enabled=False):  # otherwise the merge would have autocast's data type
            model.predictor = model.predictor.float().merge_and_unload()  # type: ignore[operator]  # PEFT is untyped
    model.predictor.to(dtype).requires_grad_(False)
    model.adaptation = model.new_input_projections = None


def copy_with_merged_adapter(model: WorldModel) -> WorldModel:
    """Return a copy for inference with the adapter merged into its predictor; the encoder is shared, not copied.

    The original model is not changed.
    """
    merged = WorldModel.empty(model.sizes)
    merged.encoder, merged.predictor = model.encoder, copy.deepcopy(model.predictor)
    merged.adaptation, merged.new_input_projections = model.adaptation, model.new_input_projections
    merged.encoder_origin = model.encoder_origin  # part of the encoder's fingerprint
    if merged.adaptation is not None:
        merge_adapter(merged)
    return merged.eval()


@contextmanager
def _use_weights(predictor: Any, weights: Mapping[str, Tensor]) -> Iterator[None]:
    current = {name: value.detach().clone() for name, value in predictor.state_dict().items()}
    predictor.load_state_dict(weights)
    try:
        yield
    finally:
        predictor.load_state_dict(current)
