"""What is done to a model before it is planned with? Eval mode; compiled or quantized blocks if they are asked for."""

from __future__ import annotations

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.compilation import require_compiler
from vjepa2_ac.model.lora import uses_dora
from vjepa2_ac.model.quantization import quantized_copy
from vjepa2_ac.model.world_model import WorldModel


def make_ready(world_model: WorldModel, config: PlanningConfig) -> WorldModel:
    """Return the model to plan with: the same, or a copy in 8 bits that shares its encoder.

    Raises:
        InputError: Its blocks shall be compiled or quantized and cannot be: a library or the device's ability is
            missing, or an adapter has DoRA.
    """
    if config.quantize != "off":
        world_model = quantized_copy(world_model, config.quantize, where="planning.quantize")
    if config.compile == "blocks":
        require_compiler(world_model.device.type, where="planning.compile")
        if uses_dora(world_model):
            raise InputError(
                where="planning.compile",
                found="blocks, and an adapter with DoRA, which cannot be traced",
                fix="Set planning.compile=off, or merge the adapter: `vjepa2-ac export RUN FOLDER --to merged`",
            )
    world_model.set_compiled("always" if config.compile == "blocks" else "never")
    return world_model.eval()
