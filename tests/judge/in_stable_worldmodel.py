"""Run stable-worldmodel's CEM with our cost (called by test_contracts.py). Nothing imports torchvision."""

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import torch

package = ModuleType("stable_worldmodel")
package.__path__ = [
    str(Path(path) / "stable_worldmodel") for path in sys.path if (Path(path) / "stable_worldmodel").is_dir()
]
sys.modules["stable_worldmodel"] = package

from gymnasium.spaces import Box  # noqa: E402
from stable_worldmodel.protocols import Costable  # noqa: E402
from stable_worldmodel.solver.cem import CEMSolver  # noqa: E402
from stable_worldmodel_cost import WorldModelCost  # noqa: E402

from served import make_controller  # noqa: E402

folder = Path(sys.argv[1])
protocol_methods = {name for name in vars(Costable) if not name.startswith("_")}
assert protocol_methods, "a protocol with methods"
inputs = dict(np.load(folder / "given.npz"))
cost, chunks = WorldModelCost(make_controller()), torch.from_numpy(inputs["chunks"]).float()
info = {"pixels": inputs["image"], "goal": inputs["goal"], "state": inputs["state"]}
views = {name: np.stack([value, value]) for name, value in info.items()}
repeated_views = {name: np.repeat(value[:, None], 5, axis=1) for name, value in views.items()}  # as its solvers give it
costs = cost.get_cost(repeated_views, torch.stack([torch.zeros_like(chunks), chunks]))
solver = CEMSolver(cost, num_samples=24, n_steps=3, topk=5, var_scale=0.05)
solver.configure(action_space=Box(-1, 1, (1, 7)), n_envs=1, config=SimpleNamespace(horizon=2, action_block=1))
plan = solver.solve({name: value[None] for name, value in info.items()})["actions"]
single_view = {name: value[:1, :2] for name, value in repeated_views.items()}
solved, zero_cost = cost.get_cost(single_view, torch.stack([plan[0], torch.zeros_like(plan[0])])[None])[0].tolist()
results = {
    "costs": costs.tolist(), "shape": list(costs.shape), "is_costable": protocol_methods <= set(dir(cost)),
    "solved": solved, "nothing": zero_cost,
}  # fmt: skip
(folder / "found.json").write_text(json.dumps(results))
