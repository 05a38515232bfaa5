"""What does autograd keep of a forward pass until the backward pass? Counted operation by operation, in bytes.

Only what a gradient needs is kept. A frozen linear layer keeps nothing of its input; its adapter keeps it, cast to the
arithmetic's type. A norm keeps its input and two statistics a token, attention keeps query, key, value, output and a
log-sum-exp a head, GELU its input, dropout its mask, the loss its difference.

Devices differ in two of these. CUDA's autocast computes norms in float32 and so keeps a float32 copy of their input,
where the CPU's leaves the input in bfloat16; and CUDA keeps a mask of one byte, the CPU a float32 one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vjepa2_ac.config import Config, ModelSizes

Kind = Literal["cpu", "cuda"]

FLOAT32 = 4
CONDITIONS = 2  # tokens of a step besides its patches: action and state

_ATTENTION, _MLP = ("q", "k", "v", "o"), ("fc1", "fc2")
_OUTER = ("predictor_embed", "predictor_proj", "action_encoder", "state_encoder", "extrinsics_encoder")
_SETS = {"attention": _ATTENTION, "mlp": _MLP, "all": _ATTENTION + _MLP + _OUTER}


def adapted_layers(config: Config, sizes: ModelSizes) -> frozenset[str]:
    """Return the layers that get an adapter, by the last part of their name; a name may stand for a set of them."""
    named = frozenset(layer for target in config.adapter.targets for layer in _SETS.get(target, (target,)))
    return named if sizes.predictor.use_extrinsics else named - {"extrinsics_encoder"}


@dataclass(frozen=True)
class Kept:
    """Counts what is kept for one micro-batch of a run, on one kind of device.

    Args:
        config: The run.
        sizes: Sizes of its model.
        device: Where it runs.
    """

    config: Config
    sizes: ModelSizes
    device: Kind = "cuda"

    def without_checkpointing(self) -> int:
        """Return the bytes of teacher forcing and of every further pass of the rollout, heads and losses included."""
        return self.teacher_forcing() + self.rollout() + self.losses() + self.cast_cache()

    def with_checkpointing(self) -> int:
        """Return what is kept when blocks keep only their input, plus one block as it is computed again.

        The casts that autocast holds on to (`cast_cache`) come on top: autograd does not keep them.
        """
        passes = [self._steps, *self._rollout_passes]
        inputs = sum(self._layers * self._tokens(steps) * self._width * self.number for steps in passes)
        heads = sum(self._head(steps) for steps in passes)
        casts = self._cast_weights() if self._trains_everything else 0
        return inputs + heads + self.losses() + self.block(self._steps) + casts

    def teacher_forcing(self) -> int:
        """Return the bytes of the pass over all true frames but the last."""
        return self._pass(self._steps, fed_back=False)

    def rollout(self) -> int:
        """Return the bytes of the rollout's passes after the first prediction: over 2 steps, 3 steps, and so on."""
        return sum(self._pass(steps, fed_back=True) for steps in self._rollout_passes)

    def losses(self) -> int:
        """Return the bytes of the differences between predictions and true latents."""
        predicted = self._steps + self._rollout_steps
        return self._patches(predicted) * self.sizes.encoder.width * FLOAT32

    def block(self, steps: int, *, first: bool = False) -> int:
        """Return the bytes of one predictor block over a clip of so many steps.

        Args:
            steps: Steps of the sequence.
            first: Whether no gradient goes further back than this block, so that its first norm and the masks of
                query, key and value are not needed.
        """
        tokens, width, hidden = self._tokens(steps), self._width, self._hidden
        norms = (1 if first else 2) * tokens * (width * self._norm_number + 2 * self._norm_statistic)
        attention = tokens * (4 * width * self.number + self.sizes.predictor.heads * FLOAT32)
        activation = tokens * hidden * self.number
        layers = {"q": width, "k": width, "v": width, "o": width, "fc1": width, "fc2": hidden}
        inputs = self._block_inputs(tokens, layers, first=first)
        casts = 0 if self._trains_everything else self._cast_weights()
        return norms + attention + activation + inputs + casts

    def cast_cache(self) -> int:
        """Return the bytes of trained weights cast to the arithmetic's type: once for all passes of a micro-batch.

        Autocast remembers casts of what is trained only; a frozen float32 weight is cast, and kept, by each pass.
        """
        return self._layers * self._cast_weights() if self._trains_everything else 0

    @property
    def number(self) -> int:
        """Bytes of a number in the networks' arithmetic."""
        return 2 if self.config.training.precision == "bf16" else FLOAT32

    def _block_inputs(self, tokens: int, layers: dict[str, int], *, first: bool) -> int:
        """Return the bytes of the inputs of linear layers that something trained needs."""
        if self._trains_everything:
            shared = 0 if self._casts_each_input else 2 * layers["q"]  # query, key and value read one tensor
            return tokens * (sum(layers.values()) - shared) * self.number
        adapted = [name for name in layers if name in self._adapted_layers]
        kept = sum(
            self._adapted(tokens, layers[name], mask=not (first and name in {"q", "k", "v"})) for name in adapted
        )
        if not self.config.adapter.dropout and self.number == FLOAT32:  # nothing is cast or masked: one tensor for all
            kept -= max(0, len({"q", "k", "v"} & set(adapted)) - 1) * tokens * layers["q"] * self.number
        return kept

    def _adapted(self, tokens: int, width: int, *, mask: bool) -> int:
        """Return the bytes of an adapter on a layer of so wide an input: its input, the mask, and between A and B."""
        dropped = self._mask if mask and self.config.adapter.dropout else 0
        return tokens * (width * (self.number + dropped) + self.config.adapter.rank * self.number)

    def _pass(self, steps: int, *, fed_back: bool) -> int:
        first = not fed_back and not self._embedding_is_trained
        blocks = self.block(steps, first=first) + (self._layers - 1) * self.block(steps)
        return blocks + self._head(steps)

    def _head(self, steps: int) -> int:
        """Return the bytes of what comes before and after the blocks."""
        patches, latent, width = self._patches(steps), self.sizes.encoder.width, self._width
        norm = self._tokens(steps) * width * self._norm_number + patches * 2 * self._norm_statistic
        normalised = patches * (latent + 2) * FLOAT32
        outer = {"predictor_embed": latent, "predictor_proj": width}
        if self._trains_everything:
            inputs = patches * (latent + width) * self.number
        else:
            adapted = [name for name in outer if name in self._adapted_layers]
            inputs = sum(self._adapted(patches, outer[name], mask=True) for name in adapted)
        return norm + normalised + inputs

    def _cast_weights(self) -> int:
        """Return the bytes of a block's weights cast from float32 to the arithmetic's type."""
        if self.number == FLOAT32 or (not self._trains_everything and self.config.model.dtype == "bfloat16"):
            return 0
        return (4 * self._width**2 + 2 * self._width * self._hidden) * self.number

    @property
    def _adapted_layers(self) -> frozenset[str]:
        return adapted_layers(self.config, self.sizes)

    @property
    def _trains_everything(self) -> bool:
        return self.config.adapter.kind == "none"

    @property
    def _embedding_is_trained(self) -> bool:
        outer = {"predictor_embed", "action_encoder", "state_encoder"}
        return self._trains_everything or bool(outer & self._adapted_layers)

    @property
    def _casts_each_input(self) -> bool:
        return self.device == "cuda" and self.number != FLOAT32

    @property
    def _norm_number(self) -> int:
        return FLOAT32 if self.device == "cuda" else self.number

    @property
    def _norm_statistic(self) -> int:
        return FLOAT32 if self.device == "cuda" else self.number

    @property
    def _mask(self) -> int:
        return 1 if self.device == "cuda" else FLOAT32

    @property
    def _steps(self) -> int:
        return self.config.data.frames - 1

    @property
    def _rollout_passes(self) -> range:
        return range(2, self._rollout_steps + 1)

    @property
    def _rollout_steps(self) -> int:
        training = self.config.training
        return training.rollout_steps if training.rollout_weight else 1

    @property
    def _width(self) -> int:
        return self.sizes.predictor.width

    @property
    def _hidden(self) -> int:
        return int(self._width * self.sizes.predictor.mlp_ratio)

    @property
    def _layers(self) -> int:
        return self.sizes.predictor.depth

    def _patches(self, steps: int) -> int:
        return self.config.training.batch_size * steps * (self.sizes.image_size // self.sizes.patch_size) ** 2

    def _tokens(self, steps: int) -> int:
        conditions = CONDITIONS + self.sizes.predictor.use_extrinsics
        return self._patches(steps) + self.config.training.batch_size * steps * conditions
