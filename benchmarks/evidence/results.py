"""Which figures are there of the cells that are done, and which of them belong together?"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cells import METHODS

from vjepa2_ac.intervals import Estimate, share_of

REACHED_CM = 5.0
CHANGES = {
    "look": "camera and look",
    "motion": "robot turned",
    "randomized": "all anew",
}
Figures = dict[str, Any]


def read_results(results: Path, done: Path | None = None) -> list[Figures]:
    """Return the figures of every cell that is done: in a folder, or else in an evidence.json that was made before."""
    before = [] if done is None else json.loads(done.read_text())
    found = {one["cell"]["name"]: one for one in before}
    files = (json.loads(path.read_text()) for path in results.glob("*.json"))
    found |= {one["cell"]["name"]: one for one in files}
    return [found[name] for name in sorted(found)]


def pick(results: Sequence[Figures], **wanted: Any) -> list[Figures]:
    """Return the cells of which these are true, by seed."""
    found = [one for one in results if all(one["cell"][key] == value for key, value in wanted.items())]
    return sorted(found, key=lambda one: one["cell"]["seed"])


def of_policy(results: Sequence[Figures], base: str, name: str, shift: str = "look") -> list[Figures]:
    """Return how far those got who need no model, on the goals of a base's cells."""
    found = pick(results, shift=shift, base=base, method="zero-shot")
    return [{"reach": {"l1": one["baselines"][name]}} for one in found if "baselines" in one]


def reached(one: Figures, distance: str = "l1") -> list[bool]:
    """Return which goals a cell reached, by which energy; in worlds of others, what was done at the end."""
    found = one["reach"][distance]
    return list(found["solved"]) if "solved" in found else [row[-1] < REACHED_CM for row in found["distance_cm"]]


def share_reached(found: Sequence[Figures]) -> Estimate:
    """Return the share of all goals of some cells that were reached, with Wilson's interval."""
    flags = [flag for one in found for flag in reached(one)]
    return share_of(sum(flags), len(flags))


def arrived(one: Figures) -> list[bool]:
    """Return in which problems of a world of others the hand ended where the expert's does; none: not measured."""
    return [distance < REACHED_CM for distance in one["reach"]["l1"].get("hand_cm", ())]


def last(one: Figures) -> float:
    """Return the error at the farthest horizon over persistence."""
    return float(one["shifted"]["rollout_over_persistence"][-1])


def main_cells(results: Sequence[Figures], base: str, method: str, shift: str = "look") -> list[Figures]:
    """Return a row of a main table: zero-shot needs no demonstrations, the others have 20; some have no base."""
    episodes = 0 if METHODS[method].kind == "zero-shot" else 20
    base = base if METHODS[method].has_base else "none"
    return pick(results, shift=shift, base=base, method=method, episodes=episodes)
