"""Read and write the results of the studies, and select and reduce those of the methods study for its tables.

While a study runs, every measurement is a JSON file with all numbers in the work folder. What the page needs of them is
stored in the repository, as `results/STUDY.json`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from environments import SAME
from methods import METHODS

from vjepa2_ac.evaluation.summary import CHANCE
from vjepa2_ac.intervals import Estimate, estimate_share
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.storage import write_atomically

RESULTS = Path(__file__).with_name("results")
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
DESCRIBED = ("cell", "made_with", "goals", "core_minutes")  # what `work.measure_cell` adds to each result
Figures = dict[str, Any]


def read_all(
    folder: Path, stored: Path, compact: Callable[[Figures], Figures], make_cell: Callable[..., Any]
) -> list[Figures]:
    """Return the results of a work folder, and the stored results that it lacks, ordered by name.

    Args:
        folder: The work folder of a study, with a file for each cell.
        stored: The stored results.
        compact: Returns the values that the tables need.
        make_cell: Returns a cell, which has a name, from the field `cell` of a result.
    """
    previous = json.loads(stored.read_text()) if stored.exists() else []
    measured = [_reduce(json.loads(path.read_text()), compact) for path in folder.glob("*.json")]
    by_name = {make_cell(**result["cell"]).name: result for result in (*previous, *measured)}
    return [by_name[name] for name in sorted(by_name)]


def _reduce(measured: Figures, compact: Callable[[Figures], Figures]) -> Figures:
    described = {key: measured[key] for key in DESCRIBED if key in measured}
    return rounded(described | compact(measured))  # type: ignore[no-any-return]  # a mapping stays a mapping


def write_result(path: Path, result: Figures) -> None:
    """Write the result of a cell."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(result, indent=1).encode())


def write_all(path: Path, results: Sequence[Figures]) -> None:
    """Write one result per line, so that a diff shows which results changed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(json.dumps(result, separators=(",", ":")) for result in results)
    write_atomically(path, f"[\n{lines}\n]\n".encode())


def rounded(value: Any) -> Any:
    """Return numbers with eight significant digits, also within lists and mappings."""
    if isinstance(value, float):
        return float(f"{value:.8g}")
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    return [rounded(item) for item in value] if isinstance(value, list) else value


def as_file_name(words: str) -> str:
    """Return words without commas and spaces, for the name of a file."""
    return words.replace(", ", "-").replace(" ", "-")


def compact(measured: Figures) -> Figures:
    """Return the values of a measurement that the tables and plots of the methods study need."""
    stored: Figures = {key: measured[key] for key in ("trained_share", "adapter_mb", "cpu_minutes") if key in measured}
    if "shifted" in measured:
        errors = measured["shifted"]
        stored["shifted"] = {key: errors[key] for key in ("rollout_over_persistence", *SHIFTED)}
    if "offline" in measured:
        stored["offline"] = {name: value for name, value in measured["offline"].items() if "inverse" not in name}
    stored["reach"] = {distance: _episodes(result) for distance, result in measured["reach"].items()}
    if "baselines" in measured:
        stored["baselines"] = {name: _episodes(result) for name, result in measured["baselines"].items()}
    return stored


def _episodes(measured: Figures) -> Figures:
    """Return the final distances of closed-loop episodes, and which of them were solved."""
    stored: Figures = {"ends_cm": [distances[-1] for distances in measured["distance_cm"]]}
    stored |= {key: measured[key] for key in ("visited", "versions") if key in measured}
    if "solved" in measured:
        stored["solved"] = [int(flag) for flag in measured["solved"]]
    if "hand_cm" in measured:
        stored["arrived"] = [int(distance < REACHED_CM) for distance in measured["hand_cm"]]
    return stored


def select_step(validations: Sequence[Figures], *, is_former_rule: bool = False) -> int | None:
    """Return the step that `checkpoint.keep_best: ranking` selects, also for a run that did not use it.

    The former rule did not require that a checkpoint is shown to rank actions better than chance.

    Args:
        validations: The step, the rollout error and the action-ranking error with its interval (`ranking`).
        is_former_rule: Whether to use the former rule.
    """
    state = RunState(step=0)
    for each in validations:
        if is_former_rule or each["step"] == 0 or Estimate(*each["ranking"]).is_below(CHANCE):
            state = replace(state, step=each["step"]).with_validation(each["rollout_error"], each["ranking"][0])
    return state.best_step


def select_results(results: Sequence[Figures], **values: Any) -> list[Figures]:
    """Return the results whose cells have these values, by seed."""
    selected = [result for result in results if all(result["cell"][key] == value for key, value in values.items())]
    return sorted(selected, key=lambda result: result["cell"]["seed"])


def describe_method(method: str) -> str:
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


def select_main_cells(results: Sequence[Figures], base: str, method: str, shift: str = "look") -> list[Figures]:
    """Return a row of a main table: zero-shot needs no demonstrations, other methods have 20; some have no base."""
    episodes = 0 if METHODS[method].kind == "zero-shot" else 20
    base = base if METHODS[method].has_base else "none"
    return select_results(results, shift=shift, base=base, method=method, episodes=episodes)


def select_policy(results: Sequence[Figures], base: str, name: str, shift: str = "look") -> list[Figures]:
    """Return the results of a policy without a model on the goals of a base model's cells."""
    zero_shot = select_results(results, shift=shift, base=base, method="zero-shot")
    return [{"reach": {"l1": result["baselines"][name]}} for result in zero_shot if "baselines" in result]


def list_reached(result: Figures, goals: str = SAME) -> list[bool]:
    """Return which goals were reached; in third-party environments, which problems were solved with a kind of goals."""
    episodes = result["reach"][goals]
    if "solved" in episodes:
        return [bool(flag) for flag in episodes["solved"]]
    return [end < REACHED_CM for end in episodes["ends_cm"]]


def estimate_success(results: Sequence[Figures], goals: str = SAME) -> Estimate:
    """Return the share of all goals that were reached, with Wilson's interval."""
    flags = [flag for result in results for flag in list_reached(result, goals)]
    return estimate_share(sum(flags), len(flags))
