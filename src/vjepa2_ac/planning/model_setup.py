"""Model setup for planning: merged, in eval mode; on request compiled."""

from __future__ import annotations

from typing import NamedTuple

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.model.adapter.lora import unadapted_copy
from vjepa2_ac.model.network.compilation import require_compiler
from vjepa2_ac.model.network.world_model import WorldModel, fingerprint


class Fingerprints(NamedTuple):
    """Hashes of a model's weights."""

    encoder: str
    base: str  # of the predictor before it was adapted
    predictor: str  # with the trained weights

    @classmethod
    def of(cls, model: WorldModel) -> Fingerprints:
        """Hash a model, with its adapter separate from its base; of one that was merged, what it was before."""
        if model.merged_from is not None:
            return cls(*model.merged_from)
        known, whole = model.adaptation, fingerprint(model.predictor.state_dict())
        if known is not None:
            return cls(known.encoder, known.base, whole)
        return cls(model.encoder_fingerprint(), model.predictor_fingerprint(), whole)


def prepare_for_planning(world_model: WorldModel, config: PlanningConfig) -> WorldModel:
    """Return the model for planning: the same, or a copy that shares its encoder, for an adapted one.

    Trained weights are float32, and planning does not use autocast as training does: unmerged, PEFT computes an
    adapter in float32, and a predictor that was trained whole takes float32 throughout. So it is merged and computes in
    the base's type. On a fake GPU a decision at the released sizes in bfloat16 takes 7.5 s unmerged, 3.7 s with
    adapters in bfloat16 beside their layers, and 3.0 s merged. Merging costs no accuracy: after 200 steps of the demo
    predictions are off by 2.5 % of the adapter's effect, by 2.7 % without merging, and the base's by 2.4 %. The updates
    lost to rounding (below 0.2 % of a weight) are below bfloat16's noise in the output of a layer.

    Raises:
        InputError: Its blocks are to be compiled, and there is no compiler.
    """
    if world_model.adaptation is not None:
        world_model = unadapted_copy(world_model)
    if config.compile == "blocks":
        require_compiler(world_model.device.type, where="planning.compile")
    world_model.set_compiled("always" if config.compile == "blocks" else "never")
    return world_model.eval()
