"""The official notebook's planner and predictor, called as in the notebook, as a baseline for decisions.

A checkout of facebookresearch/vjepa2 is imported; nothing of it is here. Its own ways are kept: all samples at once,
the whole sequence again for every step, a dense mask, rotary tables in every layer, a predicted pose of one sample
after the other by SciPy on the CPU. Kinder than it is: no gradients are kept, a type other than float32 comes by
autocast (its attention refuses to be cast), the mask is made for the plan's length, and no iteration is logged.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from official_predictor import build_predictor, built_on, imported, plain_names
from torch import Tensor

from vjepa2_ac.config import ModelSizes
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.planning.energy import Goal, Scene
from vjepa2_ac.planning.solvers import CemSolver

PLANNER = Path("notebooks/utils/world_model_wrapper.py")  # of a checkout


class OfficialPlanner:
    """The official predictor and planner, with the weights of one of our models.

    Args:
        checkout: A checkout of facebookresearch/vjepa2.
        weights: What `to_official` gives, of the predictor.
        sizes: Of the model.
        steps: Of the longest plan.
        device: Where.
    """

    def __init__(
        self, checkout: Path, weights: Mapping[str, Any], sizes: ModelSizes, *, steps: int, device: torch.device
    ) -> None:
        module = imported(checkout, "src.models.ac_predictor")
        predictor = built_on(device, partial(build_predictor, module, sizes, steps))
        predictor.load_state_dict(plain_names(weights))
        self._predictor, self._device = predictor.to(device).eval(), device
        with mock.patch("logging.basicConfig"):  # it would take every message of this program
            self._module = imported(checkout, ".".join(PLANNER.with_suffix("").parts))

    @torch.no_grad()
    def decide(self, scene: Scene, goal: Goal, config: PlanningConfig, dtype: torch.dtype, seed: int) -> Tensor:
        """Return the actions of a plan, [steps, 7]."""
        cem, most = CemSolver.Config.model_validate(config.planner.options), config.limits.xyz_m[0]
        arguments = {
            "rollout": config.horizon, "samples": config.samples, "cem_steps": config.iterations, "topk": cem.elites,
            "momentum_mean": cem.momentum_mean, "momentum_std": cem.momentum_std, "maxnorm": most,
            "momentum_mean_gripper": cem.momentum_mean_gripper, "momentum_std_gripper": cem.momentum_std_gripper,
        }  # fmt: skip
        world = self._module.WorldModel(
            encoder=None, predictor=self._predictor, tokens_per_frame=scene.latents.shape[0], transform=None,
            mpc_args=arguments, device=self._device,
        )  # fmt: skip
        torch.manual_seed(seed)
        here = (value.to(self._device) for value in (scene.latents[None], scene.state[None, None], goal.latents))
        mixed = dtype != torch.float32
        with torch.autocast(self._device.type, dtype if mixed else None, enabled=mixed):
            actions: Tensor = world.infer_next_action(*here)
        return actions.cpu()
