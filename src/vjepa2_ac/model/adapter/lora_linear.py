"""Linear layer with a LoRA adapter: the update is added inside the matrix products, in the layer's own type."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.model.adapter.low_rank import LowRankLayer, low_rank_linear
from vjepa2_ac.model.quiet_imports import quiet_imports

with quiet_imports():
    from peft.tuners.lora import Linear


class LoraLinear(Linear, LowRankLayer):  # type: ignore[misc]  # PEFT has no types
    """PEFT's linear layer with a low-rank adapter; plain LoRA takes fewer passes over the tokens.

    PEFT casts tokens to the adapter's float32 and autocast casts them back; dropout, scaling and adding are separate
    passes, and so are their gradients. Here only the two small matrices are cast, and the matrix products scale and
    add. In float32 the result is the same to rounding; in bfloat16 it is rounded less often. Everything except plain
    LoRA on a frozen layer (DoRA, a disabled or merged adapter, types that do not match) is left to PEFT. Hooks on the
    layer and the matrices inside are not called, and there are no second derivatives.
    """

    def forward(self, tokens: Float[Tensor, "*batch inputs"], *args: Any, **kwargs: Any) -> Tensor:
        """Return the output of the layer and its adapter for each token."""
        dtype = self._dtype_of_plain_lora(tokens)
        if dtype is None or args or kwargs:
            return super().forward(tokens, *args, **kwargs)  # type: ignore[no-any-return]
        name = self.active_adapters[0]
        dropout = self.lora_dropout[name]
        masking = None if isinstance(dropout, nn.Identity) or not self.training else dropout
        return low_rank_linear(tokens.to(dtype), self.base_layer, self, masking, self.scaling[name])

    def matrices(self) -> tuple[Tensor, ...]:
        """Return the two matrices of the adapter that is computed here; none if there are several adapters."""
        names = self.active_adapters
        if len(names) != 1 or names[0] not in self.lora_A:
            return ()
        return self.lora_A[names[0]].weight, self.lora_B[names[0]].weight

    def _dtype_of_plain_lora(self, tokens: Tensor) -> torch.dtype | None:
        """Return the type to compute in; None if PEFT computes."""
        adapters, layer = self.active_adapters, self.base_layer
        if self.disable_adapters or self.merged or len(adapters) != 1 or adapters[0] not in self.lora_A:
            return None
        if self.lora_variant or self.lora_bias.get(adapters[0]) or type(layer).forward is not nn.Linear.forward:
            return None
        if tokens.dim() < 2 or any(own.requires_grad for own in layer.parameters()):
            return None
        if torch.is_autocast_enabled(tokens.device.type):
            return torch.get_autocast_dtype(tokens.device.type)
        same = tokens.dtype == layer.weight.dtype == self.lora_A[adapters[0]].weight.dtype
        return tokens.dtype if same else None
