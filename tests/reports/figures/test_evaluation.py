"""Figures of evaluations are drawn for any names and any number of runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from evaluation_results import decoded_strips, evaluation
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.comparison import Comparison
from vjepa2_ac.reports.evaluation_figures import draw_decoded, plot_comparison, plot_evaluation

NAMES = ("runs/lora", "_hidden", r"$\frac$", *(f"run {number}" for number in range(10)))


def test_every_run_is_drawn_under_its_own_name_and_style(tmp_path, monkeypatch) -> None:
    drawn: list[Figure] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (drawn.append(self), save(self, *a, **k))[1])
    curves = {name: (Estimate(0.9, 0.8, 1.0), Estimate(0.8, 0.7, 0.9)) for name in NAMES}
    comparison = Comparison("errors", (), np.array([0.5, 1.0]), curves, (), {}, {})
    assert plot_comparison(comparison, tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    (legend,) = drawn[0].legends
    assert [text.get_text() for text in legend.get_texts()] == ["persistence", *NAMES]
    lines = drawn[0].axes[0].get_lines()[1:]
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == len(NAMES)


def test_names_that_look_like_formulas_and_missing_images_do_not_stop_the_image_of_an_evaluation(tmp_path) -> None:
    one = evaluation(others=(r"$\frac$",))
    assert plot_evaluation(one, tmp_path / "plot.png").stat().st_size > 1000
    bare = replace(one, examples=tuple(replace(example, frames=None) for example in one.examples))
    assert plot_evaluation(bare, tmp_path / "bare.png").stat().st_size > 1000
    assert plot_evaluation(replace(one, examples=()), tmp_path / "none.png").stat().st_size > 1000


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_decoded_rollouts_without_a_finite_psnr_are_drawn_and_say_so(value: float) -> None:
    one = decoded_strips(evaluation())
    assert one.decoded is not None
    curves = {key: (Estimate(value, value, value),) * one.horizon for key in one.decoded.curves}
    figure = Figure()
    draw_decoded(figure, replace(one, decoded=replace(one.decoded, curves=curves)))
    figure.canvas.draw()
    assert figure.axes[0].get_title().endswith("no finite value")
