"""Read and write the results of both studies, and select and reduce them for the tables.

While a study runs, every measurement is a JSON file with all numbers in the work folder. What the page needs of them is
kept in the repository: `results/methods.json` and `results/selection.json`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from methods import METHODS, Cell

from vjepa2_ac.intervals import Estimate, estimate_share
from vjepa2_ac.storage import write_atomically

KEPT = Path(__file__).with_name("results")
REACHED_CM = 5.0
CHANGES = {
    "look": "camera and appearance changed",
    "motion": "robot mounting rotated",
    "randomized": "fully randomised scenes",
}
BASE_MODELS = {
    "one camera": "one-camera base model",
    "many cameras": "multi-camera base model",
    "none": "no base model",
}
SHIFTED = ("one_step", "one_step_zero_actions", "one_step_shuffled_actions")
Figures = dict[str, Any]


def read_all(
    folder: Path, kept: Path, compact: Callable[[Figures], Figures], name_of: Callable[[Figures], str]
) -> list[Figures]:
    """Return the results of a work folder, and the stored results that it lacks, ordered by name."""
    known = json.loads(kept.read_text()) if kept.exists() else []
    measured = [compact(json.loads(path.read_text())) for path in folder.glob("*.json")]
    by_name = {name_of(one): one for one in (*known, *measured)}
    return [by_name[name] for name in sorted(by_name)]


def write_all(path: Path, results: Sequence[Figures]) -> None:
    """Write one result per line, so that a diff shows which results changed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(json.dumps(one, separators=(",", ":")) for one in results)
    write_atomically(path, f"[\n{lines}\n]\n".encode())


def rounded(value: Any) -> Any:
    """Return numbers with eight significant digits, within lists and mappings too."""
    if isinstance(value, float):
        return float(f"{value:.8g}")
    if isinstance(value, dict):
        return {key: rounded(one) for key, one in value.items()}
    return [rounded(one) for one in value] if isinstance(value, list) else value


def name_of(one: Figures) -> str:
    """Return the name of the cell that a result of the methods study belongs to."""
    return Cell(**one["cell"]).name


def compact(measured: Figures) -> Figures:
    """Return the values of a measurement that the tables and plots of the methods study need."""
    kept: Figures = {"cell": {key: value for key, value in measured["cell"].items() if key != "name"}}
    kept |= {
        key: measured[key] for key in ("trained_share", "adapter_mb", "cpu_minutes", "made_with") if key in measured
    }
    if "shifted" in measured:
        errors = measured["shifted"]
        kept["shifted"] = {key: errors[key] for key in ("rollout_over_persistence", *SHIFTED)}
    if "offline" in measured:
        kept["offline"] = {name: value for name, value in measured["offline"].items() if "inverse" not in name}
    kept["reach"] = {distance: _episodes(one) for distance, one in measured["reach"].items()}
    if "baselines" in measured:
        kept["baselines"] = {name: _episodes(one) for name, one in measured["baselines"].items()}
    return rounded(kept)  # type: ignore[no-any-return]  # a mapping stays one


def _episodes(measured: Figures) -> Figures:
    """Return the final distances of closed-loop episodes, and which of them were solved."""
    kept: Figures = {"ends_cm": [way[-1] for way in measured["distance_cm"]]}
    if "visited" in measured:
        kept["visited"] = measured["visited"]
    if "solved" in measured:
        kept["solved"] = [int(flag) for flag in measured["solved"]]
    if "hand_cm" in measured:
        kept["arrived"] = [int(distance < REACHED_CM) for distance in measured["hand_cm"]]
    return kept


def pick(results: Sequence[Figures], **wanted: Any) -> list[Figures]:
    """Return the results whose cells have these values, by seed."""
    chosen = [one for one in results if all(one["cell"][key] == value for key, value in wanted.items())]
    return sorted(chosen, key=lambda one: one["cell"]["seed"])


def label(method: str) -> str:
    """Return the name of a method in tables and plots."""
    for stored, shown in (
        ("zero-shot", "base model"),
        ("before the change", "before the domain shift"),
        ("LoRA r", "LoRA, rank "),
        (" + in/out", " + projections"),
        ("in/out only", "projections only"),
        ("DoRA r", "DoRA, rank "),
        ("scratch", "from scratch"),
        ("3x steps", "3 times the steps"),
    ):
        method = method.replace(stored, shown)
    return "full fine-tuning" if method == "full" else method


def main_cells(results: Sequence[Figures], base: str, method: str, shift: str = "look") -> list[Figures]:
    """Return a row of a main table: zero-shot needs no demonstrations, other methods have 20; some have no base."""
    episodes = 0 if METHODS[method].kind == "zero-shot" else 20
    base = base if METHODS[method].has_base else "none"
    return pick(results, shift=shift, base=base, method=method, episodes=episodes)


def of_policy(results: Sequence[Figures], base: str, name: str, shift: str = "look") -> list[Figures]:
    """Return the results of a policy without a model on the goals of a base model's cells."""
    chosen = pick(results, shift=shift, base=base, method="zero-shot")
    return [{"reach": {"l1": one["baselines"][name]}} for one in chosen if "baselines" in one]


def reached(one: Figures) -> list[bool]:
    """Return which goals were reached; in third-party environments, which problems were solved."""
    episodes = one["reach"]["l1"]
    if "solved" in episodes:
        return [bool(flag) for flag in episodes["solved"]]
    return [end < REACHED_CM for end in episodes["ends_cm"]]


def share_reached(results: Sequence[Figures]) -> Estimate:
    """Return the share of all goals that were reached, with Wilson's interval."""
    flags = [flag for one in results for flag in reached(one)]
    return estimate_share(sum(flags), len(flags))
