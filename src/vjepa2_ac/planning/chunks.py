"""Chunks: what a policy would do next, at control rate, as changes of model steps that a planner's energy can score."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int

from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.model.state_integration import apply_actions, states_along
from vjepa2_ac.spaces import POSE, StateSpace

ChunkForm = Literal["targets", "deltas", "offsets"]
"""targets: states to be reached, one after another. deltas: the change from each target to the next. offsets: of all
targets from the present state."""
_SAME = 1e-6  # relative difference below which energies are equal: rounding decides nothing


@dataclass(frozen=True)
class ChunkScores:
    """Energies of chunks towards a goal: lower is better."""

    energies: Float[np.ndarray, " chunks"]  # predicted, of each chunk
    doing_nothing: float  # predicted, of no motion for as long
    now: float  # of the current image, as it is
    goal: int  # index of the goal that applies

    @property
    def order(self) -> Int[np.ndarray, " chunks"]:
        """The chunks, best first; of equal ones the first comes first."""
        return np.argsort(self.energies, kind="stable")

    @property
    def best(self) -> int:
        """The chunk of lowest energy."""
        return int(self.order[0])

    @property
    def tied(self) -> int:
        """How many chunks share the lowest energy, up to rounding."""
        lowest = self.energies.min()
        return int((self.energies <= lowest + _SAME * abs(lowest)).sum())

    @property
    def spread(self) -> float:
        """Standard deviation of the energies over the energy now; 0: the model sees no difference."""
        return float(self.energies.std() / max(self.now, 1e-12))

    def as_dict(self, *, is_blind: bool) -> dict[str, Any]:
        """Return what is told of them; no best one of a model that cannot tell actions apart."""
        told = {name: getattr(self, name) for name in ("energies", "doing_nothing", "now", "spread", "tied")}
        return {**told, "best": None if is_blind else self.best, "is_blind": is_blind}


def changes_of_chunks(
    chunks: np.ndarray,
    state: Float[np.ndarray, " dim"],
    *,
    form: ChunkForm,
    control_steps: int,
    space: StateSpace = POSE,
) -> Float[np.ndarray, "chunks model_steps dim"]:
    """Return the change of each model step, as the planner's actions are.

    Rotations act on the left (R' = R_delta @ R), as in `vjepa2_ac.episode`. Control steps at the end that fill no model
    step are left out.

    Args:
        chunks: What the policy would do, chunks x control steps x dim: poses in metres, radians and closedness, or
            vectors.
        state: Where the robot is.
        form: What the numbers mean.
        control_steps: Of a model step, in steps of the chunk: `data.stride` where both have one rate.
        space: What a state is.

    Raises:
        InputError: A chunk has other numbers than a state, one that no robot has, or is shorter than a model step; or
            the state is none.
    """
    state = np.array(state, dtype=np.float64)
    space.require_state(state, "state")
    found = np.array(chunks, dtype=np.float64)
    if found.ndim != 3 or not len(found) or found.shape[2] != len(space) or not np.isfinite(found).all():
        needed = f"finite numbers, chunks x control steps x {len(space)}: {', '.join(space.names)}"
        raise InputError(where="chunks", found=f"an array of the shape {found.shape}", needed=needed)
    if found.shape[1] < control_steps:
        needed = f"{control_steps} at least, which are one model step"
        raise InputError(where="chunks", found=counted(found.shape[1], "control step"), needed=needed)
    now, given = torch.from_numpy(state), torch.from_numpy(found)
    if form == "deltas":
        targets = states_along(now, given, space)[:, 1:].numpy()
    else:
        targets = found if form == "targets" else apply_actions(now.expand_as(given), given, space).numpy()
    space.require_plausible(targets.reshape(-1, len(space)), "chunks")
    ends = targets[:, control_steps - 1 :: control_steps]
    return np.stack([space.differences(np.concatenate([state[None], one])) for one in ends])
