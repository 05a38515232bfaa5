"""Activation memory of the training objective: what autograd saves for teacher forcing, rollout and losses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.training.cost.block_activations import FLOAT32, Kind, Setting, adapter_casts, block_bytes, layer_bytes

_CONDITIONS = ("action_encoder", "state_encoder", "extrinsics_encoder")
_HEADS = ("predictor_embed", *_CONDITIONS)


@dataclass(frozen=True)
class Activations:
    """Counts what autograd saves for one micro-batch of a run, on one kind of device.

    Args:
        config: The run.
        sizes: Sizes of its model.
        device: The device type.
    """

    config: Config
    sizes: ModelSizes
    device: Kind = "cuda"

    def without_checkpointing(self) -> int:
        """Return the bytes of teacher forcing and of every further pass of the rollout, heads and losses included."""
        return self.teacher_forcing() + self.rollout() + self.losses() + self.cast_cache()

    def with_checkpointing(self) -> int:
        """Return the peak when blocks save only their inputs, and are recomputed.

        When the longest pass recomputes its blocks, its losses and later parts are already freed; remaining inputs of
        trained heads are small, and left out. The casts that autocast caches (`cast_cache`) are extra: autograd does
        not save them.
        """
        return self._inputs() + max(self._ends(), self.recomputed())

    def after_forward(self) -> int:
        """Return what is saved, with checkpointing, when the losses are computed."""
        return self._inputs() + self._ends()

    def teacher_forcing(self) -> int:
        """Return the bytes of the pass over all true frames but the last."""
        return self._pass(self._steps, fed_back=False)

    def rollout(self) -> int:
        """Return the bytes of the rollout's passes after the first prediction: one step each, on those before it."""
        return sum(self._pass(1, past, fed_back=True) for past in self._past_of_passes)

    def losses(self) -> int:
        """Return the bytes of the differences between predictions and true latents, or of the predictions."""
        predicted = self._steps + len(self._past_of_passes) + 1
        return self._setting.patches(predicted) * self.sizes.encoder.width * FLOAT32

    def recomputed(self) -> int:
        """Return the bytes of the block that saves most, with its weights as they are cast."""
        blocks = [self._block(index, self._steps) for index in range(self.sizes.predictor.depth)]
        return max(size + self._casts(index) for index, size in enumerate(blocks))

    def cast_cache(self) -> int:
        """Return the bytes of trained weights cast to the arithmetic's type: once for all passes of a micro-batch.

        Autocast remembers casts of what is trained only; a frozen weight of another type is cast by each pass.
        """
        return sum(adapter_casts(self._setting, name) for name in self._setting.layers)

    def _inputs(self) -> int:
        """Return the bytes of the inputs of blocks."""
        given = self._tokens(self._steps) if self._heads_are_trained or self._block_is_trained else 0
        given += len(self._past_of_passes) * self._tokens(1) * 3  # and keys and values that the rollout reuses
        return self.sizes.predictor.depth * given * self._setting.width * self._setting.number

    def _ends(self) -> int:
        """Return the bytes of all parts before and after the blocks of all passes, losses included."""
        passes = len(self._past_of_passes)
        heads = self._head(self._steps, fed_back=False) + passes * self._head(1, fed_back=True)
        casts = adapter_casts(self._setting, "predictor_proj")
        casts += adapter_casts(self._setting, "predictor_embed") if passes else 0
        return heads + self.losses() + casts

    def _pass(self, steps: int, past: int = 0, *, fed_back: bool) -> int:
        reached, kept = fed_back or self._heads_are_trained, 0
        for index in range(self.sizes.predictor.depth):
            kept += self._block(index, steps, past, reached=reached)
            reached = reached or self._block_is_trained
        tables = self._tables(steps) if reached else 0
        return kept + tables + self._head(steps, fed_back=fed_back)

    def _block(self, index: int, steps: int, past: int = 0, *, reached: bool = True) -> int:
        return block_bytes(self._setting, index, steps, past, reached=reached)

    def _head(self, steps: int, *, fed_back: bool) -> int:
        """Return the bytes of the parts before and after the blocks."""
        setting = self._setting
        patches, latent = setting.patches(steps), self.sizes.encoder.width
        reached = fed_back or self._heads_are_trained or self._block_is_trained
        read = patches if setting.copies_for_norms else setting.tokens(steps)  # a copy is of the patches alone
        norm = (read * setting.width + 2 * patches) * setting.norm_number
        normalised = patches * (latent + 2) * FLOAT32
        embedded = layer_bytes(setting, "predictor_embed", patches, reached=fed_back)
        given = self.config.training.batch_size * steps
        conditions = sum(layer_bytes(setting, name, given, reached=False) for name in self._conditions)
        projected = layer_bytes(setting, "predictor_proj", patches, reached=reached)
        return reached * norm + normalised + embedded + conditions + projected

    def _casts(self, index: int) -> int:
        block = f"blocks.{index}."
        return sum(adapter_casts(self._setting, name) for name in self._setting.layers if name.startswith(block))

    def _tables(self, steps: int) -> int:
        """Return the bytes of the rotary tables: cosine and sine for each token of a clip."""
        head_dim = self._setting.width // self.sizes.predictor.heads
        return 2 * self._tokens(steps) // self.config.training.batch_size * head_dim * FLOAT32

    def _tokens(self, steps: int) -> int:
        return self._setting.tokens(steps)

    @property
    def _conditions(self) -> tuple[str, ...]:
        return _CONDITIONS if self.sizes.predictor.use_extrinsics else _CONDITIONS[:2]

    @property
    def _heads_are_trained(self) -> bool:
        trained = {*self._setting.ranks, *self.config.adapter.modules_to_save}
        return self._setting.trains_everything or bool(trained & set(_HEADS))

    @property
    def _block_is_trained(self) -> bool:
        return self._setting.trains_everything or any(name.startswith("blocks.") for name in self._setting.ranks)

    @cached_property
    def _setting(self) -> Setting:
        return Setting(self.config, self.sizes, self.device)

    @property
    def _steps(self) -> int:
        return self.config.data.frames - 1

    @property
    def _past_of_passes(self) -> range:
        """The number of cached steps for each pass of the rollout after the first prediction."""
        training = self.config.training
        return range(1, training.rollout_steps if training.rollout_weight else 1)
