"""Controllers of a tiny model, and their decisions."""

import numpy as np
import torch

from tiny_models import tiny_model, vector_model
from vjepa2_ac.config.planning import LimitsConfig, PlanningConfig
from vjepa2_ac.episode import Widths
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.decision import PlanRequest, PlanResult, decide
from vjepa2_ac.planning.goals import make_timed_goals, split_horizon
from vjepa2_ac.spaces import Spaces

STATE = np.array([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2])
QUICK = PlanningConfig(samples=12, iterations=3, horizon=2, planner={"name": "cem", "options": {"elites": 4}})


def image(seed: int, height: int = 60, width: int = 48) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def make_controller(model: WorldModel | None = None, seed: int = 0, **changes: object) -> Controller:
    """Return a controller of a tiny model with a short search."""
    config = QUICK.model_copy(update={"iterations": 2, **changes})
    return Controller(model or tiny_model(), config, seed=seed)


def make_vector_controller(joined: str, *, states: bool = True) -> Controller:
    """Return a controller of eight joints; `joined` as in `Spaces.from_widths`."""
    config = QUICK.model_copy(update={"iterations": 2, "limits": LimitsConfig(axes=(0.1,))})
    return Controller(vector_model(8, states=states), config, spaces=Spaces.from_widths(Widths(8, 8), joined))


def make_plan_result(
    *goals: int, nodes: int | None = 3, broken: bool = False, start: int = 0, **changes: object
) -> PlanResult:
    """Return a decision of a tiny model; goals and start are seeds of images."""
    model = tiny_model()
    if broken:
        with torch.no_grad():
            model.base_predictor.predictor_proj.weight.fill_(float("nan"))
    config = QUICK.model_copy(update=changes)
    images = [image(goal) for goal in goals or (100,)]
    request = PlanRequest(image(start), STATE, make_timed_goals(images, split_horizon(config.horizon, len(images))))
    return decide(Controller(model, config, seed=5), request, nodes=nodes)
