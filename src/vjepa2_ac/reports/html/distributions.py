"""Distribution charts: ranks of the true action against chance, and all episodes from best to worst."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from vjepa2_ac.evaluation.result import EpisodeScore, Ranking
from vjepa2_ac.reports.html.charts import Line, axis_at, line_chart, nice_axis
from vjepa2_ac.reports.html.series import Series

_POINTS = 51


def rank_chart(rankings: Sequence[tuple[Series, Ranking]]) -> Markup:
    """Return the cumulative distribution of the true action's rank over clips, for each model and by chance."""
    reached = np.linspace(0, 1, _POINTS).tolist()
    by_chance = Line("chance", [0.0, 1.0], [0.0, 100.0], "s-persistence")
    lines = [by_chance, *(Line(one.label, reached, _shares(ranking, reached), one.style) for one, ranking in rankings)]
    x_axis = nice_axis("rank of the true action (0: best)", [0.0, 1.0], most=5)
    description = "Share of clips by rank of the true action: " + "; ".join(
        f"{line.name} {line.y[_POINTS // 10]:.0f} % among the best tenth" for line in lines[1:]
    )
    return line_chart(f"{description}.", lines, x_axis, nice_axis("share of clips (%)", [0.0, 100.0]), key=lines)


def episode_chart(scores: Sequence[EpisodeScore]) -> Markup:
    """Return the error over persistence of every episode, best first."""
    places = [float(place + 1) for place in range(len(scores))]
    line = Line("episode", places, [score.over_persistence for score in scores], "s-trained")
    y_axis = nice_axis("L1 error / persistence", [*line.y, 1.0], from_zero=True)
    x_axis = axis_at("episodes, best first", places, [f"{place:.0f}" for place in places])
    better = sum(score.over_persistence < 1 for score in scores)
    description = f"Error over persistence of {len(scores)} episodes, best first: {better} of them are below 1."
    return line_chart(description, [line], x_axis, y_axis, level=1.0)


def _shares(ranking: Ranking, reached: Sequence[float]) -> list[float]:
    ranks = np.sort(ranking.rank)
    return [float(100 * np.searchsorted(ranks, each, side="right") / max(len(ranks), 1)) for each in reached]
