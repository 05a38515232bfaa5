"""V-JEPA 2-AC as a cost function (`Costable`) for the solvers of stable-worldmodel.

    from stable_worldmodel.solver import CEMSolver
    solver = CEMSolver(WorldModelCost(Controller.of_run(load_run("demo/run"))), num_samples=64)

Actions are changes per model step in metres, radians and gripper position (`vjepa2_ac.episode`); they are not
normalised.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from vjepa2_ac import Controller


class WorldModelCost:
    """Compute the energies of candidate actions with the controller that plans with the model.

    Args:
        controller: Controller of a run or a model; each call resets it.
        pixels: Key of the current image in `info`: environments x (time x) height x width x 3, uint8, RGB.
        goal: Key of the goal image, with the same shape.
        state: Key of the measured state, environments x (time x) numbers.
    """

    def __init__(
        self, controller: Controller, pixels: str = "pixels", goal: str = "goal", state: str = "state"
    ) -> None:
        self._controller, self._keys = controller, (pixels, goal, state)

    def get_cost(self, info_dict: dict[str, Any], action_candidates: torch.Tensor) -> torch.Tensor:
        """Return costs, environments x samples, for actions, environments x samples x model steps x components.

        Args:
            info_dict: The solver's input; each value is repeated for every sample, and the first copy is read.
            action_candidates: The actions to score.
        """
        costs = []
        for environment, chunks in enumerate(action_candidates):
            image, goal, state = (_latest(info_dict[key][environment][0], key == self._keys[2]) for key in self._keys)
            self._controller.reset(goal.astype(np.uint8))
            result = self._controller.score(image.astype(np.uint8), state, chunks.detach().cpu().double().numpy())
            costs.append(torch.from_numpy(result.energies))
        return torch.stack(costs).to(action_candidates)

    criterion = get_cost


def _latest(value: Any, is_state: bool) -> np.ndarray:
    """Return the latest entry of a time axis, or the value itself without a time axis."""
    values = np.asarray(value.cpu() if isinstance(value, torch.Tensor) else value)
    return values[-1] if values.ndim > (1 if is_state else 3) else values
