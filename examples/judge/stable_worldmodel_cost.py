"""V-JEPA 2-AC as a cost of stable-worldmodel (its `Costable`): its solvers search, our model predicts.

    from stable_worldmodel.solver import CEMSolver
    solver = CEMSolver(WorldModelCost(Controller.of_run(load_run("demo/run"))), num_samples=64)

Actions are changes of a model step: metres, radians, closedness (`vjepa2_ac.episode`), not normalised.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from vjepa2_ac import Controller


class WorldModelCost:
    """Energies of candidate actions, by the controller that plans with the model.

    Args:
        controller: Of a run or a model; it is reset.
        pixels: Key of the present image in `info`: environments x (time x) height x width x 3, uint8, RGB.
        goal: Key of the goal image, likewise.
        state: Key of the measured state, environments x (time x) numbers.
    """

    def __init__(
        self, controller: Controller, pixels: str = "pixels", goal: str = "goal", state: str = "state"
    ) -> None:
        self._controller, self._keys = controller, (pixels, goal, state)

    def get_cost(self, info_dict: dict[str, Any], action_candidates: torch.Tensor) -> torch.Tensor:
        """Return costs, environments x samples, of actions, environments x samples x model steps x numbers.

        Args:
            info_dict: As a solver gives it: each value repeated for every sample, of which the first is read.
            action_candidates: What is to be scored.
        """
        costs = []
        for place, chunks in enumerate(action_candidates):
            image, goal, state = (_latest(info_dict[key][place][0], key == self._keys[2]) for key in self._keys)
            self._controller.reset(goal.astype(np.uint8))
            found = self._controller.score(image.astype(np.uint8), state, chunks.detach().cpu().double().numpy())
            costs.append(torch.from_numpy(found.energies))
        return torch.stack(costs).to(action_candidates)

    criterion = get_cost


def _latest(found: Any, is_state: bool) -> np.ndarray:
    """Return the newest of several moments, or the only one."""
    values = np.asarray(found.cpu() if isinstance(found, torch.Tensor) else found)
    return values[-1] if values.ndim > (1 if is_state else 3) else values
