"""Broken episodes: one policy for all sources: stop, or skip and count them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.filters.exclusion import named, with_way_out
from vjepa2_ac.data.index import EpisodeProblem
from vjepa2_ac.errors import InputError

logger = logging.getLogger(__name__)

MOST_BROKEN = 0.01  # share of the episodes


class BrokenEpisodes:
    """The broken episodes of an opened data set: those found while opening it, and those found by clips since.

    It is in the process that opened the data set; loader workers report to it.
    """

    def __init__(self, config: DataConfig, episodes: int) -> None:
        self._config, self._episodes = config, episodes
        self._reasons: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._reasons)

    @property
    def reasons(self) -> dict[str, str]:
        """The broken episodes and their errors, in the order in which they were found."""
        return dict(self._reasons)

    def found(self, problems: Sequence[EpisodeProblem]) -> None:
        """Record the problems found while the data set was opened or indexed.

        Raises:
            InputError: `data.broken_episodes` is error: the first of them; or too many are broken.
        """
        if not problems:
            return
        if self._config.broken_episodes == "error":
            raise with_way_out(as_error(problems[0]), [problem.name for problem in problems])
        self._reasons |= {problem.name: str(as_error(problem)) for problem in problems}
        logger.warning(
            "%s: %d of %d episodes are broken and left out: %s; the first: %s",
            self._config.path, len(problems), self._episodes, named([problem.name for problem in problems]),
            as_error(problems[0]),
        )  # fmt: skip
        self._refuse_too_many()

    def recall(self, reasons: Mapping[str, str]) -> None:
        """Count the broken episodes from before a resume: the allowed share is that of the whole run."""
        excluded = frozenset(self._config.exclude)
        self._reasons = {name: why for name, why in reasons.items() if name not in excluded} | self._reasons

    def met(self, name: str, reason: str) -> None:
        """Record an episode of which a clip could not be read.

        Raises:
            InputError: Now too many are broken.
        """
        if name in self._reasons:
            return
        self._reasons[name] = reason
        logger.warning("A clip is left out, %d of %d episodes are broken: %s", len(self), self._episodes, reason)
        self._refuse_too_many()

    def _refuse_too_many(self) -> None:
        if len(self) <= MOST_BROKEN * self._episodes:
            return
        name, reason = next(iter(self._reasons.items()))
        raise InputError(
            where=f"data.path: {self._config.path}",
            found=f"{len(self)} of {self._episodes} episodes are broken: {named(tuple(self._reasons))}."
            f" The first, {name}: {reason.rstrip('.')}",
            needed=f"{MOST_BROKEN:.0%} at most: data.broken_episodes is skip",
            fix="Repair or fetch them again, or add them to data.exclude",
        )


def as_error(problem: EpisodeProblem) -> InputError:
    """Return the error of an unusable episode."""
    return InputError(where=problem.where, found=problem.found, needed=problem.needed, fix=problem.fix)


def as_problem(error: InputError, name: str) -> EpisodeProblem:
    """Return the record of an unusable episode."""
    return EpisodeProblem(name=name, where=error.where, found=error.found, needed=error.needed, fix=error.fix)
