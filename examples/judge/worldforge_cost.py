"""V-JEPA 2-AC as a cost of WorldForge: what a policy proposes is scored by `vjepa2-ac serve`, wherever the GPU is.

    vjepa2-ac serve RUN --goals goals
    python3.13 -m pip install worldforge-ai==0.5.0 msgpack websockets numpy      # an environment of its own

    forge.register_cost(WorldModelCost("ws://127.0.0.1:8000"))
    info = {"image": image, "state": state, "goal": "cup"}
    forge.score_actions(cost="vjepa2-ac", info=info, action_candidates=chunks)

No import of vjepa2-ac: the protocol is openpi's (docs/serving_reference.md).
"""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
from websockets.sync.client import connect
from worldforge.models import ActionScoreResult, WorldForgeError


class WorldModelCost:
    """Energies of candidate actions, lower is better; where the model cannot tell actions apart, an error.

    Args:
        url: Of the server.
        key: Of the server, if it has one.
        form: What the candidates are, control step by control step: targets, deltas or offsets (docs/policies.md).
    """

    name, profile = "vjepa2-ac", None

    def __init__(self, url: str, key: str | None = None, form: str = "targets") -> None:
        self._url, self._form = url, form
        self._headers = {} if key is None else {"Authorization": f"Api-Key {key}"}

    def score_actions(self, *, info: dict[str, Any], action_candidates: object) -> ActionScoreResult:
        """Score chunks x control steps x 7 numbers.

        Args:
            info: `image` (height x width x 3, RGB), `state` (7 numbers), and as `goal` an image or a name.
            action_candidates: Nested lists or an array.

        Raises:
            WorldForgeError: The server refuses, or its model ranks true actions no better than chance.
        """
        goal = info["goal"]
        request = {
            "endpoint": "score",
            "observation/image": np.asarray(info["image"], dtype=np.uint8),
            "observation/state": np.asarray(info["state"], dtype=np.float64),
            "policy/chunks": np.asarray(action_candidates, dtype=np.float64),
            "policy/form": self._form,
            **({"goal/name": goal} if isinstance(goal, str) else {"goal/image": np.asarray(goal, dtype=np.uint8)}),
        }
        with connect(self._url, additional_headers=self._headers, max_size=None) as server:
            server.recv()  # what it is
            server.send(msgpack.packb(request, default=_packed))
            answer = server.recv()
        if isinstance(answer, str):
            raise WorldForgeError(answer)
        found = msgpack.unpackb(answer, object_hook=_unpacked, strict_map_key=False)
        if found["best"] is None:
            raise WorldForgeError("The model ranks true actions no better than chance: it orders nothing.")
        about = {name: found[name] for name in ("doing_nothing", "now", "spread", "tied")}
        return ActionScoreResult(self.name, [float(one) for one in found["energies"]], found["best"], metadata=about)


def _packed(array: np.ndarray) -> dict[bytes, Any]:
    return {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str, b"shape": array.shape}


def _unpacked(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in found:
        return found
    return np.frombuffer(found[b"data"], dtype=np.dtype(found[b"dtype"])).reshape(found[b"shape"])
