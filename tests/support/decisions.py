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


def controller(model: WorldModel | None = None, seed: int = 0, **changes: object) -> Controller:
    """Return a controller whose search is over at once."""
    config = QUICK.model_copy(update={"iterations": 2, **changes})
    return Controller(model or tiny_model(), config, seed=seed)


def vector_controller(joined: str, *, states: bool = True) -> Controller:
    """Return a controller of eight joints, whose recorded commands were joined so."""
    config = QUICK.model_copy(update={"iterations": 2, "limits": LimitsConfig(axes=(0.1,))})
    return Controller(vector_model(8, states=states), config, spaces=Spaces.from_widths(Widths(8, 8), joined))


def asked(*goals: int, nodes: int | None = 3, broken: bool = False, start: int = 0, **changes: object) -> PlanResult:
    model = tiny_model()
    if broken:
        with torch.no_grad():
            model.base_predictor.predictor_proj.weight.fill_(float("nan"))
    config = QUICK.model_copy(update=changes)
    images = [image(goal) for goal in goals or (100,)]
    question = PlanRequest(image(start), STATE, make_timed_goals(images, split_horizon(config.horizon, len(images))))
    return decide(Controller(model, config, seed=5), question, nodes=nodes)
