"""Commands that a command recommends at its end: they keep the user's options, and long ones say how long they take."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from vjepa2_ac.errors import counted, shell_command

if TYPE_CHECKING:
    from vjepa2_ac.config.planning import PlanningConfig

QUICK = {"samples": 64, "iterations": 4}  # of `planning`, for a CPU; docs/planning.md says how good this planner is
QUICK_WORDS = tuple(f"planning.{key}={value}" for key, value in QUICK.items())
QUICK_SEQUENCES = 256


def option_words(options: argparse.Namespace, *names: str, **changes: Any) -> list[str]:
    """Return the words of a command line, without `key=value`, that give options their present values.

    Args:
        options: As their parser returned them.
        names: The options to include, by their destinations; none: all.
        changes: Values to have in place of the present ones.
    """
    words, values = list[str](), vars(options) | changes
    for action in options.parser._actions:
        value = values.get(action.dest)
        is_left_out = not action.option_strings or (names and action.dest not in names)
        if is_left_out or value in (None, action.default):
            continue
        for one in value if isinstance(value, list) and action.nargs is None else [value]:
            parts = [] if action.nargs == 0 else one if isinstance(one, list) else [one]
            words += [*action.option_strings[-1:], *map(str, parts)]
    return words


def next_simulation(
    words: Sequence[str], planning: PlanningConfig, decisions: int, prediction_s: float | None, *, on_cpu: bool
) -> list[str]:
    """Return the command `simulate` and how long it takes here, as lines.

    Args:
        words: The command's words. On a CPU those of the quick planner are added, if they do not set its size.
        planning: Of the model with these words.
        decisions: Of the model.
        prediction_s: Measured seconds for each model step of an action sequence; None: not measured.
        on_cpu: Whether the model computes on a CPU.
    """
    from vjepa2_ac.config.planning import ELITES
    from vjepa2_ac.planning.planner import samples_of_iterations
    from vjepa2_ac.reporter import duration

    time, where = "its time was not measured", "here"
    is_chosen = any(word.startswith(("planning.samples=", "planning.iterations=")) for word in words)
    is_sampled, elites = planning.planner.name != "gradient", planning.planner.options.get("elites", ELITES)
    is_long = sum(samples_of_iterations(planning)) > QUICK_SEQUENCES and is_sampled and planning.budget_s is None
    fits = elites <= QUICK["samples"]
    if on_cpu and is_long and fits and not is_chosen:
        words, where = [*words, *QUICK_WORDS], "on this CPU with the quick planner"
        planning = planning.model_copy(update=QUICK)
    count = sum(samples_of_iterations(planning))
    if prediction_s is not None:
        time = f"{duration(decisions * count * planning.horizon * prediction_s / 3600)} {where}"
    about = f"{counted(decisions, 'decision')} of {counted(count, 'action sequence')} each"
    return [f"Next: {shell_command('simulate', *words)}", f"  ({time}: {about})"]
