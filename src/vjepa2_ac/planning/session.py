"""The planning session: a model or a run's adapter, loaded with its settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.distributed import has_bf16, is_on_cpu, require_type_of_weights
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.lora import merge_adapter
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import GoalFolder, SubGoal, with_shares
from vjepa2_ac.planning.model_setup import Fingerprints
from vjepa2_ac.planning.settings import planning_settings, warn_beyond_taught
from vjepa2_ac.runs.checkpoint import SELECTED
from vjepa2_ac.runs.folder import is_run
from vjepa2_ac.runs.loading import load_run
from vjepa2_ac.storage.structured import utc_now


@dataclass(frozen=True)
class PlanningSession:
    """A world model on its device, in eval mode, with trained weights merged; and its planning settings."""

    world_model: WorldModel
    config: Config  # of it: planning, seed, data.crop and data.stride are used
    subject: str  # the run or model as given
    checkpoint: str  # which one, as text; "" of a model
    warnings: tuple[str, ...] = ()  # that it is untrained; why its plans may exceed the motions in its training data

    def controller(self, *, seed: int | None = None, extrinsics: Float[np.ndarray, " 6"] | None = None) -> Controller:
        """Return a controller with these settings.

        Args:
            seed: Of all decisions; None: the config's.
            extrinsics: Pose of the camera, if the model uses it.

        Raises:
            InputError: As `Controller`.
        """
        return Controller.of_config(self.world_model, self.config, seed=seed, extrinsics=extrinsics)

    @property
    def encoder(self) -> str:
        """The hash of the encoder's weights."""
        return Fingerprints.of(self.world_model).encoder

    def goals_of(self, folder: GoalFolder) -> tuple[SubGoal, ...]:
        """Return the goals of a folder for this model, with their noise floor; what is changed is logged as a warning.

        Raises:
            InputError: A goal would never end, or the last one has a bound.
        """
        planning, has_noise = self.config.planning, folder.noise is not None  # else no weights need to be hashed
        goals = folder.for_model(self.encoder, planning.energy.distance) if has_noise else folder.goals
        with_shares(goals, planning.goals, first=1)
        return goals

    def as_dict(self) -> dict[str, Any]:
        """Return the identity of the model as plain values: its name, and hashes of the weights."""
        model = self.world_model
        return {
            "version": __version__,
            "time": utc_now(),
            "model": {
                "subject": self.subject,
                "checkpoint": self.checkpoint or None,
                **Fingerprints.of(model)._asdict(),
                "dtype": str(next(model.parameters()).dtype).removeprefix("torch."),
                "device": model.device.type,
                "image_size": model.image_size,
            },
            "warnings": list(self.warnings),
            "control_steps_of_a_model_step": self.config.data.stride,
            "frame_of_states": self.config.data.pose_frame,
        }


def load_to_plan(
    subject: str, *, checkpoint: str = SELECTED, config: str | Path | None = None, overrides: Sequence[str] = ()
) -> PlanningSession:
    """Load a run or a model for planning.

    The settings of a run are those of its config: planning, seed, crop, stride, type of the weights. Those of a model
    are the given config's; without one the defaults, and float32 weights if the device has no bfloat16, or is a CPU.
    Limits beyond what a run was taught, and narrow data, are warned of: logged, and in the session's `warnings`.
    Trained weights are merged before the model moves to the device (see `planning.model_setup`): it is there once.

    Args:
        subject: The folder of a run; or a model, as in `model.base`.
        checkpoint: Of a run: selected, newest, best, or a number of optimizer steps.
        config: A config file, for a model.
        overrides: Such as planning.horizon=2.

    Raises:
        InputError: It does not exist, cannot be used for planning, or a setting is invalid or has no effect.
    """
    dtype = "bfloat16" if torch.cuda.is_available() and has_bf16() else "float32"
    its = planning_settings(subject, config=config, overrides=overrides, dtype=dtype)
    device = torch.device("cpu" if is_on_cpu(its.training) else "cuda")
    require_type_of_weights(its.model, device)  # without autocast
    if is_run(subject):
        run = load_run(Path(subject), checkpoint, its)
        run.warn_if_untrained()
        model, chosen, warnings = run.world_model, run.chosen, warn_beyond_taught(its, Path(subject))
        warnings = (*([run.note] if run.note else []), *warnings)
        known = Fingerprints.of(model)
        merge_adapter(model)
        model.merged_from = known
    elif checkpoint == SELECTED:
        model, chosen, warnings = load_base(its.model, seed=its.seed), "", ()
    else:
        found, needed = f"{subject}, which is not the folder of a run", "a run: a model has no checkpoints"
        raise InputError(where=f"--checkpoint {checkpoint}", found=found, needed=needed)
    return PlanningSession(model.to(device).eval(), its, subject, chosen, warnings)
