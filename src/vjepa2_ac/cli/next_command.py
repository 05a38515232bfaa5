"""Commands that a command recommends at its end: they keep the user's options."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vjepa2_ac.config.planning import PlanningConfig

QUICK = {"samples": 64, "iterations": 4}  # of `planning`, for a CPU; docs/planning.md says how good this planner is
QUICK_WORDS = tuple(f"planning.{key}={value}" for key, value in QUICK.items())
_QUICK_SEQUENCES = 256


def option_words(options: argparse.Namespace, *names: str) -> list[str]:
    """Return the words of a command line that give some options their present values.

    Args:
        options: As their parser returned them.
        names: The options to include, by their destinations.
    """
    words, values = list[str](), vars(options)
    for action in options.parser._actions:
        value = values.get(action.dest)
        if action.dest in names and action.option_strings and value not in (None, action.default):
            for one in value if isinstance(value, list) else [value]:
                words += [action.option_strings[-1], str(one)]
    return words


def quick_words(words: Sequence[str], planning: PlanningConfig, *, on_cpu: bool) -> list[str]:
    """Return the overrides for the quick planner if a search on a CPU would be long; none if `words` set its size."""
    from vjepa2_ac.config.planning import ELITES
    from vjepa2_ac.planning.planner import samples_of_iterations

    is_chosen = any(word.startswith(("planning.samples=", "planning.iterations=")) for word in words)
    is_sampled, elites = planning.planner.name != "gradient", planning.planner.options.get("elites", ELITES)
    is_long = is_sampled and planning.budget_s is None and sum(samples_of_iterations(planning)) > _QUICK_SEQUENCES
    return [*QUICK_WORDS] if on_cpu and is_long and not is_chosen and elites <= QUICK["samples"] else []
