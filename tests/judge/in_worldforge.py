"""Run by test_contracts.py, in an environment with WorldForge and without us: its own facade, by our server."""

import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from worldforge import WorldForge
from worldforge.providers.base import ProviderError
from worldforge_cost import WorldModelCost

folder = Path(sys.argv[1])
given = dict(np.load(folder / "given.npz"))
forge = WorldForge(state_dir=Path(tempfile.mkdtemp()))
forge.register_cost(WorldModelCost(os.environ["SERVER"]))
info = {name: given[name].tolist() for name in ("image", "goal", "state")}
found: dict = {}
try:
    scores = forge.score_actions(cost="vjepa2-ac", info=info, action_candidates=given["chunks"].tolist())
    found |= {"scores": scores.scores, "best": scores.best_index, "lower_is_better": scores.lower_is_better}
except ProviderError as error:
    found["scores"] = str(error)
try:
    forge.score_actions(cost="vjepa2-ac", info=info, action_candidates=given["chunks"][:, :2].tolist())
except ProviderError as error:
    found["refused"] = str(error)
(folder / "found.json").write_text(json.dumps(found))
