"""Optimizer steps of a decoder: its loss, its weights, their moving average, and AdamW."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config import DecoderConfig
from vjepa2_ac.decoding.frame_pairs import Pairs
from vjepa2_ac.decoding.network import Decoder, DecoderShape, Images, as_images
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.image_similarity import ms_ssim

STRUCTURE, EDGES = 0.2, 0.1  # weights of the second and the third part of the loss
SMALLEST = 11  # pixels of an image's side: a window has to fit
_SCALES = 3
_BETAS = (0.9, 0.95)
_YOUNG = 9.0  # steps: the average of fewer forgets the first ones faster
Autocast = Callable[[], AbstractContextManager[object]]


def decoder_loss(images: Images, targets: Images) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
    """Return L1 + 0.2 (1 - MS-SSIM) + 0.1 L1 of the gradients along both axes; and the parts.

    Args:
        images: What the decoder gives, not clipped.
        targets: What the encoder saw, between 0 and 1.
    """
    scales = sum(images.shape[-1] >= SMALLEST << scale for scale in range(_SCALES))
    absolute = (images - targets).abs().mean()
    structure = 1.0 - ms_ssim(images, targets, scales=scales).mean()
    rows, columns = ((images.diff(dim=axis) - targets.diff(dim=axis)).abs().mean() for axis in (-2, -1))
    edges = rows + columns
    loss = absolute + STRUCTURE * structure + EDGES * edges
    return loss, {"l1": absolute, "structure": structure, "edges": edges}


def learning_rate_at(step: int, config: DecoderConfig) -> float:
    """Return the learning rate of step 1 .. steps: a linear warm-up, then half a cosine down to none."""
    warmup = min(config.warmup_steps, config.steps - 1)
    if step <= warmup:
        return config.learning_rate * step / warmup
    done = (step - warmup) / max(1, config.steps - warmup)
    return config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * done))


class DecoderSteps:
    """A decoder in training.

    Args:
        shape: Of the decoder.
        config: How it is trained.
        seed: Of fresh weights and of noise.
        device: Where.
        autocast: The arithmetic of the network.
        linear: What the decoder begins as; None: fresh weights.
    """

    def __init__(
        self,
        shape: DecoderShape,
        config: DecoderConfig,
        seed: int,
        device: torch.device,
        autocast: Autocast,
        linear: Decoder | None,
    ) -> None:
        self._config, self._seed, self._device, self._autocast = config, seed, device, autocast
        self.decoder = Decoder(shape)
        self.decoder.initialise(torch.Generator().manual_seed(seed))
        if linear is not None:
            self.decoder.start_from(linear)
        self.decoder.to(device)
        matrices = [one for one in self.decoder.parameters() if one.ndim > 1]
        others = [one for one in self.decoder.parameters() if one.ndim <= 1]
        groups = [{"params": matrices, "weight_decay": config.weight_decay}, {"params": others, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, betas=_BETAS)
        self.average = {name: one.detach().clone() for name, one in self.decoder.state_dict().items()}

    def do(self, step: int, pairs: Pairs) -> dict[str, float]:
        """Do one optimizer step, counted from 1, and return its metrics.

        Raises:
            InputError: Loss or gradients are not finite; nothing was changed.
        """
        latents, images = pairs.latents.to(self._device), as_images(pairs.images.to(self._device))
        if self._config.noise:
            latents = latents + self._noise(step, latents)
        learning_rate = learning_rate_at(step, self._config)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        with self._autocast():
            shown = self.decoder(latents)
        loss, parts = decoder_loss(shown, images)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch
        norm = torch.nn.utils.clip_grad_norm_(self.decoder.parameters(), self._config.max_grad_norm)
        numbers = {"loss": loss, **parts, "gradient_norm": norm}
        read = torch.stack([value.detach().float() for value in numbers.values()]).tolist()  # waits for the device once
        metrics = dict(zip(numbers, read, strict=True))
        if not math.isfinite(metrics["gradient_norm"]):
            found = f"{self._config.learning_rate:g}: loss or gradients of step {step} are not finite"
            fix = "Lower it, delete the newest checkpoint if it was written by then, and start again"
            raise InputError(where="decoder.learning_rate", found=found, fix=fix)
        self.optimizer.step()
        self._add_to_average(step)
        return metrics | {"learning_rate": learning_rate}

    def state(self) -> dict[str, Any]:
        """Return weights, their average and AdamW's moments, for a checkpoint."""
        return {"decoder": self.decoder.state_dict(), "average": self.average, "optimizer": self.optimizer.state_dict()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a checkpoint of the same decoder."""
        self.decoder.load_state_dict(state["decoder"])
        self.average = {name: state["average"][name].to(self._device) for name in self.average}
        self.optimizer.load_state_dict(state["optimizer"])

    def _noise(self, step: int, latents: Tensor) -> Tensor:
        """Return noise of a strength that is drawn for each frame, up to `decoder.noise`."""
        drawn = torch.Generator().manual_seed(self._seed * 2**31 + step)
        strength = self._config.noise * torch.rand(len(latents), 1, 1, generator=drawn)
        return (strength * torch.randn(latents.shape, generator=drawn)).to(latents.device)

    @torch.no_grad()
    def _add_to_average(self, step: int) -> None:
        decay = min(self._config.average, step / (step + _YOUNG))
        for name, one in self.decoder.state_dict().items():
            self.average[name].lerp_(one, 1.0 - decay)
