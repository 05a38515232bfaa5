"""The official predictor with plain PEFT LoRA and the official training step, as a baseline for training.

A checkout of facebookresearch/vjepa2 is imported; nothing of it is here. Its own ways are kept: float32 weights under
autocast, rotary tables in every layer, a dense mask that is brought to the device in every pass, all steps computed
again for each prediction that is fed back, a gradient scaler on CUDA, and no clipping. Kinder than it is: the mask is
made for the longest clip asked for (upstream makes one for 256 frames, 4.4 GB), and there is no DDP around it.
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
PREDICTOR = Path("src/models/ac_predictor.py")  # of a checkout

_SAME_LOSS, _SAME_GRADIENTS = 1e-5, 1e-3  # float32, relative; of gradients, to the largest


class Official:
    """The official predictor, and where asked for encoder, with the weights of one of our models.

    Args:
        checkout: A checkout of facebookresearch/vjepa2.
        weights: What `to_official` gives.
        sizes: Of the model.
        adapter: Rank, alpha and dropout; None: every weight is trained, and there is no adapter.
        training: Optimizer and rollout.
        frames: Of the longest clip.
        encoder: Whether latents are computed in the step.
        device: Where.
    """

    def __init__(
        self, checkout: Path, weights: Mapping[str, Any], sizes: ModelSizes, adapter: AdapterConfig | None,
        training: TrainingConfig, *, frames: int, encoder: bool, device: torch.device,
    ) -> None:  # fmt: skip
        self._device, self._rollout_steps = device, training.rollout_steps
        module = imported(checkout, "src.models.ac_predictor")
        self._inner = predictor = self._built(partial(build_predictor, module, sizes, frames))
        self._load(predictor, weights, "predictor")
        self.predictor = self._placed(predictor if adapter is None else _with_lora(predictor, adapter)).train()
        self._encoder = self._frozen_encoder(checkout, weights, sizes) if encoder else None
        self.trained = [parameter for parameter in self.predictor.parameters() if parameter.requires_grad]
        self._optimizer = torch.optim.AdamW(self.trained, lr=training.learning_rate, weight_decay=training.weight_decay)
        self._scaler = torch.amp.GradScaler(device.type, enabled=device.type == "cuda")

    def step(self, batch: LatentBatch, pixels: Tensor | None, dtype: torch.dtype, *, checkpointing: bool) -> None:
        """Do one optimizer step.

        Args:
            batch: Clips; their latents where there is no encoder.
            pixels: Normalised frames, [batch, 3, time, height, width], where there is one.
            dtype: Of autocast; float32: none.
            checkpointing: Whether blocks are computed again in the backward pass.
        """
        setattr(self._inner, "use_activation_checkpointing", checkpointing)  # noqa: B010 - a module of theirs
        mixed = dtype != torch.float32
        with torch.autocast(self._device.type, dtype if mixed else None, enabled=mixed):
            latents = batch.latents if pixels is None else self.encode(pixels)
            forced, rolled = self.losses(latents, batch.actions, batch.states)
            loss = forced + rolled
        scaler = self._scaler if mixed else torch.amp.GradScaler(self._device.type, enabled=False)
        scaler.scale(loss).backward()
        scaler.unscale_(self._optimizer)
        scaler.step(self._optimizer)
        scaler.update()
        self._optimizer.zero_grad()
        loss.item()

    def losses(self, latents: Tensor, actions: Tensor, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return (teacher forcing, rollout)."""
        forced = self._predict(latents[:, :-1], actions, states[:, :-1])
        seen = torch.cat([latents[:, :1], forced[:, :1]], dim=1)
        for end in range(2, self._rollout_steps + 1):
            following = self._predict(seen, actions[:, :end], states[:, :end])[:, -1:]
            seen = torch.cat([seen, following], dim=1)
        rolled, rest = seen[:, 1:], latents[:, 1 : self._rollout_steps + 1]
        return (forced - latents[:, 1:]).abs().mean(), (rolled - rest).abs().mean()

    @torch.no_grad()
    def encode(self, pixels: Tensor) -> Tensor:
        """Return latents, each frame encoded by itself, as a tubelet of the same frame twice, all of them at once."""
        assert self._encoder is not None, "built without an encoder"
        twice = pixels.transpose(1, 2).flatten(0, 1).unsqueeze(2).repeat(1, 1, 2, 1, 1)
        features = self._encoder(twice)
        return layer_norm(features, features.shape[-1:]).unflatten(0, (len(pixels), -1))

    def layers(self) -> dict[str, Any]:
        """Return the layers with an adapter, by their name in the predictor."""
        return {name: layer for name, layer in self._inner.named_modules() if isinstance(layer, LoraLayer)}

    def _predict(self, latents: Tensor, actions: Tensor, states: Tensor) -> Tensor:
        following = self.predictor(latents.flatten(1, 2), actions, states)
        return layer_norm(following, following.shape[-1:]).unflatten(1, latents.shape[1:3])

    def _frozen_encoder(self, checkout: Path, weights: Mapping[str, Any], sizes: ModelSizes) -> nn.Module:
        module = imported(checkout, "src.models.vision_transformer")
        network = self._built(partial(_encoder, module, sizes))
        self._load(network, weights, "encoder")
        return self._placed(network.requires_grad_(False))

    def _built(self, build: Callable[[], nn.Module]) -> nn.Module:
        return built_on(self._device, build)

    def _load(self, module: nn.Module, weights: Mapping[str, Any], part: str) -> None:
        module.load_state_dict(plain_names(weights[part]))

    def _placed(self, module: nn.Module) -> nn.Module:
        return module.to(self._device)


def difference(ours: Objective, official: Official, batch: LatentBatch) -> str | None:
    """Return how loss or gradients differ in float32 on the same weights, adapters included; None where they do not.

    Both get the same adapters, which are not zero, and keep them. Losses of random weights are much alike whatever is
    computed; the gradients of the adapters are not.
    """
    pairs = _share_adapters(ours, official)
    modules = (ours.world_model, official.predictor)
    for module in modules:
        module.eval()  # no dropout
    loss = torch.stack(list(ours(batch))).sum()
    other = torch.stack(list(official.losses(batch.latents, batch.actions, batch.states))).sum()
    loss.backward()
    other.backward()
    found = None
    if not torch.isclose(loss, other, rtol=_SAME_LOSS):
        found = f"loss {loss.item():.7f}, the official one {other.item():.7f}"
    for name, matrix, expected in pairs:
        gap = (matrix.grad - expected()).abs().max() / expected().abs().max()
        if not gap < _SAME_GRADIENTS:
            found = found or f"gradients of {name} differ by {float(gap):.1%} of the largest"
    for module in modules:
        module.zero_grad(set_to_none=True)
        module.train()
    return found


def _share_adapters(ours: Objective, official: Official) -> list[tuple[str, Tensor, Any]]:
    """Give both the same adapters; return name, second matrix, and what gives the official gradient of it."""
    theirs = official.layers()
    generator = torch.Generator().manual_seed(1)
    for layer in theirs.values():
        second = layer.lora_B["default"].weight
        second.data.copy_(torch.randn(second.shape, generator=generator) * 0.01)
    pairs = []
    for name, layer in lora_layers(cast("WorldModel", ours.world_model)).items():
        fused, third = to_official_name(f"{name}.weight", "predictor")
        other = theirs[fused.removesuffix(".weight")]
        part = slice(None) if third is None else third  # q, k and v share the first matrix of a fused layer
        first, second = other.lora_A["default"].weight, other.lora_B["default"].weight
        parts = second.data if third is None else second.data.unflatten(0, (3, -1))
        layer.lora_A["default"].weight.data.copy_(first.data)
        layer.lora_B["default"].weight.data.copy_(parts[part])
        pairs.append((name, layer.lora_B["default"].weight, partial(_gradient, second, third)))
    return pairs


def _gradient(matrix: Tensor, third: int | None) -> Tensor:
    assert matrix.grad is not None
    return matrix.grad if third is None else matrix.grad.chunk(3)[third]


def _with_lora(predictor: nn.Module, adapter: AdapterConfig) -> nn.Module:
    lora = LoraConfig(
        r=adapter.rank, lora_alpha=adapter.alpha, use_rslora=adapter.rslora, lora_dropout=adapter.dropout,
        target_modules=TARGETS,
    )  # fmt: skip
    return get_peft_model(predictor, lora)


def plain_names(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return float32 weights by the names that the official modules give them."""
    return {name.removeprefix("module."): value.float() for name, value in weights.items()}


def built_on(device: torch.device, build: Callable[[], nn.Module]) -> nn.Module:
    """Return a module whose first weights are drawn on a device: they are replaced, and shall cost no time.

    What it holds besides, such as its mask, is made on the host, as without this.
    """
    with device:
        module = build()
    for part in module.modules():
        for name, value in list(vars(part).items()):
            if isinstance(value, Tensor):
                setattr(part, name, value.cpu())
    return module


def build_predictor(module: Any, sizes: ModelSizes, frames: int) -> nn.Module:
    """Return the official predictor with random weights, for clips of so many frames."""
    predictor = sizes.predictor
    return module.VisionTransformerPredictorAC(
        img_size=sizes.image_size, patch_size=sizes.patch_size, tubelet_size=2, num_frames=2 * frames,
        embed_dim=sizes.encoder.width, predictor_embed_dim=predictor.width, depth=predictor.depth,
        num_heads=predictor.heads, mlp_ratio=predictor.mlp_ratio, norm_layer=partial(nn.LayerNorm, eps=NORM_EPSILON),
    )  # fmt: skip


def _encoder(module: Any, sizes: ModelSizes) -> nn.Module:
    encoder = sizes.encoder
    return module.VisionTransformer(
        img_size=sizes.image_size, patch_size=sizes.patch_size, tubelet_size=2, num_frames=512,
        embed_dim=encoder.width, depth=encoder.depth, num_heads=encoder.heads, mlp_ratio=encoder.mlp_ratio,
        norm_layer=partial(nn.LayerNorm, eps=NORM_EPSILON), use_rope=True, use_sdpa=True, uniform_power=True,
    )  # fmt: skip


def imported(checkout: Path, name: str) -> Any:
    """Import a module of a checkout. It wants one function of timm, for stochastic depth, which the recipe has not."""
    warnings.filterwarnings("ignore", message=".*sdp_kernel.*")  # deprecated in PyTorch, called by every layer
    if str(checkout) not in sys.path:
        sys.path.insert(0, str(checkout))
    stand_ins = {} if importlib.util.find_spec("timm") else _empty("timm", "timm.models", "timm.models.layers")
    sys.modules.update(stand_ins)
    try:
        return importlib.import_module(name)
    finally:
        for stand_in in stand_ins:
            del sys.modules[stand_in]  # others ask whether timm is there


def _empty(*names: str) -> dict[str, types.ModuleType]:
    modules = {name: types.ModuleType(name) for name in names}
    for module in modules.values():
        module.drop_path = None  # type: ignore[attr-defined]  # never called
    return modules
