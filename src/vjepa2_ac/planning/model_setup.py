"""Loading of a run or a model for planning: adapter merged, in eval mode, and compiled on request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.distributed import has_bf16, is_on_cpu, require_weight_dtype
from vjepa2_ac.model.compilation import require_compiler
from vjepa2_ac.model.lora import copy_with_merged_adapter, merge_adapter
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.settings import load_planning_config, warn_if_limits_exceed_data
from vjepa2_ac.runs.checkpoint import SELECTED
from vjepa2_ac.runs.subject import Subject, load_subject


def load_for_planning(
    subject: str, *, checkpoint: str = SELECTED, config: str | Path | None = None, overrides: Sequence[str] = ()
) -> Subject:
    """Load a run or a model for planning, on its device.

    The settings of a run (planning, seed, crop, stride, dtype of the weights) are read from its config. The settings of
    a model are those of `config`, or the defaults; the default dtype is bfloat16 on a GPU that supports it, otherwise
    float32. If limits exceed the motions in the training data, or these have a low diversity, a warning is logged and
    added to the subject's `warnings`. An adapter is merged before the model moves to the device, so that the device
    stores only one copy (see `prepare_for_planning`).

    Args:
        subject: The folder of a run; or a model, as in `model.base`.
        checkpoint: For a run: selected, newest, best, or a number of optimizer steps.
        config: A config file, for a model.
        overrides: For example planning.horizon=2.

    Raises:
        InputError: The run or model does not exist or cannot be used for planning, or a setting is invalid or has no
            effect.
    """
    dtype = "bfloat16" if torch.cuda.is_available() and has_bf16() else "float32"
    settings = load_planning_config(subject, config=config, overrides=overrides, dtype=dtype)
    device = torch.device("cpu" if is_on_cpu(settings.training) else "cuda")
    require_weight_dtype(settings.model, device)  # without autocast
    loaded = load_subject(subject, checkpoint, config=settings)
    warnings = loaded.warnings
    if loaded.checkpoint is not None:
        warnings += warn_if_limits_exceed_data(settings, Path(subject))
        loaded.world_model.merged_from = loaded.world_model.fingerprints()
        merge_adapter(loaded.world_model)
    loaded.world_model.to(device)
    return replace(loaded, warnings=warnings)


def prepare_for_planning(world_model: WorldModel, config: PlanningConfig) -> WorldModel:
    """Return the model for planning: the same model, or a merged copy of a model with an adapter.

    Trained weights are float32, and planning, unlike training, does not use autocast. Without merging, PEFT computes an
    adapter in float32, and a fully fine-tuned predictor computes everything in float32. The merged copy computes in the
    dtype of the base model, and shares the encoder. On a simulated GPU a decision at the released sizes in bfloat16
    takes 7.5 s unmerged, 3.7 s with unmerged bfloat16 adapters, and 3.0 s merged. Merging costs no accuracy: after 200
    steps of the demo, the rounding error of bfloat16 predictions is 2.5 % of the adapter's effect when merged, 2.7 %
    unmerged, and 2.4 % for the base model. The updates lost to rounding (below 0.2 % of a weight) are below bfloat16's
    noise in the output of a layer.

    Raises:
        InputError: `planning.compile` is `blocks`, and no compiler is installed.
    """
    if world_model.adaptation is not None:
        world_model = copy_with_merged_adapter(world_model)
    if config.compile == "blocks":
        require_compiler(world_model.device.type, where="planning.compile")
    world_model.set_compiled("always" if config.compile == "blocks" else "never")
    return world_model.eval()
