"""The official predictor with plain PEFT LoRA and the official training step, as a baseline for training.

The code is imported from a checkout of facebookresearch/vjepa2. The step is computed as upstream: float32 weights under
autocast, rotary tables in every layer, a dense mask that is copied to the device in every pass, all steps computed
again for each predicted frame of a rollout, a gradient scaler on CUDA, and no clipping. Two changes make the baseline
faster: the mask has the size of the longest clip (upstream: 256 frames, 4.4 GB), and DDP is omitted.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import types
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from peft import LoraConfig, get_peft_model
from peft.tuners.lora import LoraLayer
from torch import Tensor, nn
from torch.nn.functional import layer_norm

from vjepa2_ac.config import AdapterConfig, ModelSizes, TrainingConfig
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.blocks import NORM_EPSILON
from vjepa2_ac.model.checkpoints import to_official_name
from vjepa2_ac.model.lora import lora_layers
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.step import Objective

TARGETS = ["qkv", "proj", "fc1", "fc2"]
PREDICTOR = Path("src/models/ac_predictor.py")  # path in a checkout

_LOSS_TOLERANCE, _GRADIENT_TOLERANCE = 1e-5, 1e-3  # float32; relative to the loss, and to the largest gradient


class OfficialStep:
    """The official predictor, optionally with the encoder, with the weights of a model of this package.

    Args:
        checkout: A checkout of facebookresearch/vjepa2.
        weights: The result of `to_official`.
        sizes: Sizes of the model.
        adapter: Rank, alpha and dropout; None: full fine-tuning.
        training: Optimizer and rollout.
        frames: Length of the longest clip.
        encoder: Whether latents are computed in the step.
        device: The device.
    """

    def __init__(
        self, checkout: Path, weights: Mapping[str, Any], sizes: ModelSizes, adapter: AdapterConfig | None,
        training: TrainingConfig, *, frames: int, encoder: bool, device: torch.device,
    ) -> None:  # fmt: skip
        self._device, self._rollout_steps = device, training.rollout_steps
        module = import_from_checkout(checkout, "src.models.ac_predictor")
        self._inner = predictor = self._build(partial(build_predictor, module, sizes, frames))
        self._load(predictor, weights, "predictor")
        self.predictor = self._to_device(predictor if adapter is None else _add_lora(predictor, adapter)).train()
        self._encoder = self._build_frozen_encoder(checkout, weights, sizes) if encoder else None
        self.trained = [parameter for parameter in self.predictor.parameters() if parameter.requires_grad]
        self._optimizer = torch.optim.AdamW(self.trained, lr=training.learning_rate, weight_decay=training.weight_decay)
        self._scaler = torch.amp.GradScaler(device.type, enabled=device.type == "cuda")

    def step(self, batch: LatentBatch, pixels: Tensor | None, dtype: torch.dtype, *, checkpointing: bool) -> None:
        """Compute one optimizer step.

        Args:
            batch: Clips. The latents are ignored if `pixels` is given.
            pixels: Normalised frames, [batch, 3, time, height, width], for a step with the encoder.
            dtype: Type of autocast; float32: no autocast.
            checkpointing: Whether blocks are computed again in the backward pass.
        """
        setattr(self._inner, "use_activation_checkpointing", checkpointing)  # noqa: B010 - an official module
        uses_autocast = dtype != torch.float32
        with torch.autocast(self._device.type, dtype if uses_autocast else None, enabled=uses_autocast):
            latents = batch.latents if pixels is None else self.encode(pixels)
            forced, rolled = self.losses(latents, batch.actions, batch.states)
            loss = forced + rolled
        scaler = self._scaler if uses_autocast else torch.amp.GradScaler(self._device.type, enabled=False)
        scaler.scale(loss).backward()
        scaler.unscale_(self._optimizer)
        scaler.step(self._optimizer)
        scaler.update()
        self._optimizer.zero_grad()
        loss.item()

    def losses(self, latents: Tensor, actions: Tensor, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses of teacher forcing and of the rollout."""
        forced = self._predict(latents[:, :-1], actions, states[:, :-1])
        rollout = torch.cat([latents[:, :1], forced[:, :1]], dim=1)
        for end in range(2, self._rollout_steps + 1):
            next_frame = self._predict(rollout, actions[:, :end], states[:, :end])[:, -1:]
            rollout = torch.cat([rollout, next_frame], dim=1)
        true = latents[:, 1 : self._rollout_steps + 1]
        return (forced - latents[:, 1:]).abs().mean(), (rollout[:, 1:] - true).abs().mean()

    @torch.no_grad()
    def encode(self, pixels: Tensor) -> Tensor:
        """Return the latents of frames. Each frame is encoded independently, as a tubelet that contains it twice."""
        assert self._encoder is not None, "built without an encoder"
        tubelets = pixels.transpose(1, 2).flatten(0, 1).unsqueeze(2).repeat(1, 1, 2, 1, 1)
        features = self._encoder(tubelets)
        return layer_norm(features, features.shape[-1:]).unflatten(0, (len(pixels), -1))

    def layers(self) -> dict[str, Any]:
        """Return the layers with an adapter, by name within the predictor."""
        return {name: layer for name, layer in self._inner.named_modules() if isinstance(layer, LoraLayer)}

    def _predict(self, latents: Tensor, actions: Tensor, states: Tensor) -> Tensor:
        predicted = self.predictor(latents.flatten(1, 2), actions, states)
        return layer_norm(predicted, predicted.shape[-1:]).unflatten(1, latents.shape[1:3])

    def _build_frozen_encoder(self, checkout: Path, weights: Mapping[str, Any], sizes: ModelSizes) -> nn.Module:
        module = import_from_checkout(checkout, "src.models.vision_transformer")
        network = self._build(partial(_build_vision_transformer, module, sizes))
        self._load(network, weights, "encoder")
        return self._to_device(network.requires_grad_(False))

    def _build(self, build: Callable[[], nn.Module]) -> nn.Module:
        return build_on_device(self._device, build)

    def _load(self, module: nn.Module, weights: Mapping[str, Any], part: str) -> None:
        module.load_state_dict(strip_prefixes(weights[part]))

    def _to_device(self, module: nn.Module) -> nn.Module:
        return module.to(self._device)


def compare_with_official(ours: Objective, official: OfficialStep, batch: LatentBatch) -> str | None:
    """Return how the loss or the gradients differ in float32 with the same weights; None if they are the same.

    Both models receive the same nonzero adapters and keep them. The gradients are compared because with random weights
    even wrong computations have similar losses.
    """
    pairs = _share_adapter_weights(ours, official)
    modules = (ours.world_model, official.predictor)
    for module in modules:
        module.eval()  # no dropout
    loss = torch.stack(list(ours(batch))).sum()
    official_loss = torch.stack(list(official.losses(batch.latents, batch.actions, batch.states))).sum()
    loss.backward()
    official_loss.backward()
    difference = None
    if not torch.isclose(loss, official_loss, rtol=_LOSS_TOLERANCE):
        difference = f"loss {loss.item():.7f}, official loss {official_loss.item():.7f}"
    for name, matrix, expected in pairs:
        gap = (matrix.grad - expected()).abs().max() / expected().abs().max()
        if not gap < _GRADIENT_TOLERANCE:
            difference = difference or f"gradients of {name} differ by {float(gap):.1%} of the largest gradient"
    for module in modules:
        module.zero_grad(set_to_none=True)
        module.train()
    return difference


def _share_adapter_weights(ours: Objective, official: OfficialStep) -> list[tuple[str, Tensor, Any]]:
    """Set the same adapter weights in both models.

    Returns the name of each layer, its second matrix in the model of this package, and a function that returns the
    official gradient of this matrix.
    """
    official_layers = official.layers()
    generator = torch.Generator().manual_seed(1)
    for layer in official_layers.values():
        second = layer.lora_B["default"].weight
        second.data.copy_(torch.randn(second.shape, generator=generator) * 0.01)
    pairs = []
    for name, layer in lora_layers(cast("WorldModel", ours.world_model)).items():
        fused, third = to_official_name(f"{name}.weight", "predictor")
        official_layer = official_layers[fused.removesuffix(".weight")]
        part = slice(None) if third is None else third  # q, k and v share the first matrix of a fused layer
        first, second = official_layer.lora_A["default"].weight, official_layer.lora_B["default"].weight
        parts = second.data if third is None else second.data.unflatten(0, (3, -1))
        layer.lora_A["default"].weight.data.copy_(first.data)
        layer.lora_B["default"].weight.data.copy_(parts[part])
        pairs.append((name, layer.lora_B["default"].weight, partial(_gradient, second, third)))
    return pairs


def _gradient(matrix: Tensor, third: int | None) -> Tensor:
    assert matrix.grad is not None
    return matrix.grad if third is None else matrix.grad.chunk(3)[third]


def _add_lora(predictor: nn.Module, adapter: AdapterConfig) -> nn.Module:
    lora = LoraConfig(
        r=adapter.rank, lora_alpha=adapter.alpha, use_rslora=adapter.rslora, lora_dropout=adapter.dropout,
        target_modules=TARGETS,
    )  # fmt: skip
    return get_peft_model(predictor, lora)


def strip_prefixes(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights in float32, named as in the official modules."""
    return {name.removeprefix("module."): value.float() for name, value in weights.items()}


def build_on_device(device: torch.device, build: Callable[[], nn.Module]) -> nn.Module:
    """Build a module with its initial weights on a device, which is faster; the weights are replaced afterwards.

    Other tensors, such as the mask, are moved to the host, as upstream.
    """
    with device:
        module = build()
    for part in module.modules():
        for name, value in list(vars(part).items()):
            if isinstance(value, Tensor):
                setattr(part, name, value.cpu())
    return module


def build_predictor(module: Any, sizes: ModelSizes, frames: int) -> nn.Module:
    """Return the official predictor with random weights, for clips of at most `frames` frames."""
    predictor = sizes.predictor
    return module.VisionTransformerPredictorAC(
        img_size=sizes.image_size, patch_size=sizes.patch_size, tubelet_size=2, num_frames=2 * frames,
        embed_dim=sizes.encoder.width, predictor_embed_dim=predictor.width, depth=predictor.depth,
        num_heads=predictor.heads, mlp_ratio=predictor.mlp_ratio, norm_layer=partial(nn.LayerNorm, eps=NORM_EPSILON),
    )  # fmt: skip


def _build_vision_transformer(module: Any, sizes: ModelSizes) -> nn.Module:
    encoder = sizes.encoder
    return module.VisionTransformer(
        img_size=sizes.image_size, patch_size=sizes.patch_size, tubelet_size=2, num_frames=512,
        embed_dim=encoder.width, depth=encoder.depth, num_heads=encoder.heads, mlp_ratio=encoder.mlp_ratio,
        norm_layer=partial(nn.LayerNorm, eps=NORM_EPSILON), use_rope=True, use_sdpa=True, uniform_power=True,
    )  # fmt: skip


def import_from_checkout(checkout: Path, name: str) -> Any:
    """Import a module from a checkout, with an empty stand-in for timm, whose stochastic depth is never used."""
    warnings.filterwarnings("ignore", message=".*sdp_kernel.*")  # deprecated in PyTorch, called by every layer
    if str(checkout) not in sys.path:
        sys.path.insert(0, str(checkout))
    stand_ins = (
        {} if importlib.util.find_spec("timm") else _make_empty_modules("timm", "timm.models", "timm.models.layers")
    )
    sys.modules.update(stand_ins)
    try:
        return importlib.import_module(name)
    finally:
        for stand_in in stand_ins:
            del sys.modules[stand_in]  # other libraries test whether timm is installed


def _make_empty_modules(*names: str) -> dict[str, types.ModuleType]:
    modules = {name: types.ModuleType(name) for name in names}
    for module in modules.values():
        module.drop_path = None  # type: ignore[attr-defined]  # never called
    return modules
