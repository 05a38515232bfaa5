"""The official notebook's planner and predictor, called as in the notebook, as a baseline for decisions.

The code is imported from a checkout of facebookresearch/vjepa2. A decision is computed as upstream: all samples at
once, the whole sequence again for every step, a dense mask, rotary tables in every layer, and the predicted poses by
SciPy on the CPU, sample by sample. These changes make the baseline faster: gradients are disabled, types other than
float32 are used by autocast (the official attention cannot be cast), the mask has the length of the plan, and
iterations are not logged.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from official_predictor import build_on_device, build_predictor, import_from_checkout, strip_prefixes
from torch import Tensor

from vjepa2_ac.config import ModelSizes
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.planning.energy import Goal, Scene
from vjepa2_ac.planning.solvers import CemSolver

PLANNER = Path("notebooks/utils/world_model_wrapper.py")  # path in a checkout


class OfficialPlanner:
    """The official predictor and planner, with the weights of a model of this package.

    Args:
        checkout: A checkout of facebookresearch/vjepa2.
        weights: The predictor's weights from `to_official`.
        sizes: Sizes of the model.
        steps: Length of the longest plan.
        device: The device.
    """

    def __init__(
        self, checkout: Path, weights: Mapping[str, Any], sizes: ModelSizes, *, steps: int, device: torch.device
    ) -> None:
        module = import_from_checkout(checkout, "src.models.ac_predictor")
        predictor = build_on_device(device, partial(build_predictor, module, sizes, steps))
        predictor.load_state_dict(strip_prefixes(weights))
        self._predictor, self._device = predictor.to(device).eval(), device
        with mock.patch("logging.basicConfig"):  # the import would change the logging of this program
            self._module = import_from_checkout(checkout, ".".join(PLANNER.with_suffix("").parts))

    @torch.no_grad()
    def decide(self, scene: Scene, goal: Goal, config: PlanningConfig, dtype: torch.dtype, seed: int) -> Tensor:
        """Return the actions of a plan, [steps, 7]."""
        cem, max_step_m = CemSolver.Config.model_validate(config.planner.options), config.limits.xyz_m[0]
        arguments = {
            "rollout": config.horizon, "samples": config.samples, "cem_steps": config.iterations, "topk": cem.elites,
            "momentum_mean": cem.momentum_mean, "momentum_std": cem.momentum_std, "maxnorm": max_step_m,
            "momentum_mean_gripper": cem.momentum_mean_gripper, "momentum_std_gripper": cem.momentum_std_gripper,
        }  # fmt: skip
        world = self._module.WorldModel(
            encoder=None, predictor=self._predictor, tokens_per_frame=scene.latents.shape[0], transform=None,
            mpc_args=arguments, device=self._device,
        )  # fmt: skip
        torch.manual_seed(seed)
        inputs = (value.to(self._device) for value in (scene.latents[None], scene.state[None, None], goal.latents))
        uses_autocast = dtype != torch.float32
        with torch.autocast(self._device.type, dtype if uses_autocast else None, enabled=uses_autocast):
            actions: Tensor = world.infer_next_action(*inputs)
        return actions.cpu()
