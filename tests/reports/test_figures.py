"""Plots are drawn for any names, any number of runs, and every outcome of a decision."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from decisions import image, make_plan_result
from evaluation_results import evaluation
from random_decoder import write_decoder
from tiny_models import tiny_model
from vjepa2_ac.decoding.decoder import load_decoder
from vjepa2_ac.evaluation.imagined import imagine_plan
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.media.figure import stack_horizontally
from vjepa2_ac.planning.decision import PlanResult
from vjepa2_ac.reports.comparison import Comparison
from vjepa2_ac.reports.evaluation_figures import plot_comparison, plot_evaluation
from vjepa2_ac.reports.planning_figures import plot_plan

pytestmark = pytest.mark.usefixtures("drawn")

NAMES = ("runs/lora", "_hidden", r"$\frac$", *(f"run {number}" for number in range(10)))


def test_each_run_has_its_name_and_a_distinct_line_style(tmp_path, monkeypatch) -> None:
    figures: list[Figure] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), save(self, *a, **k))[1])
    curves = {name: (Estimate(0.9, 0.8, 1.0), Estimate(0.8, 0.7, 0.9)) for name in NAMES}
    comparison = Comparison("errors", (), np.array([0.5, 1.0]), curves, (), {}, {})
    assert plot_comparison(comparison, tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    (legend,) = figures[0].legends
    assert [text.get_text() for text in legend.get_texts()] == ["persistence (copy the last frame)", *NAMES]
    lines = figures[0].axes[0].get_lines()[1:]
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == len(NAMES)


def test_formula_like_names_and_missing_images_are_plotted(tmp_path) -> None:
    result = evaluation(others=(r"$\frac$",))
    assert plot_evaluation(result, tmp_path / "plot.png").stat().st_size > 1000
    bare = replace(result, examples=tuple(replace(example, frames=None) for example in result.examples))
    assert plot_evaluation(bare, tmp_path / "bare.png").stat().st_size > 1000
    assert plot_evaluation(replace(result, examples=()), tmp_path / "none.png").stat().st_size > 1000


def pixels_of(result: PlanResult, folder: Path) -> np.ndarray:
    with Image.open(plot_plan(result, folder / "plan.png")) as image:
        return np.array(image.convert("RGB"))


def test_energy_slices_add_a_row_to_the_plan_plot(tmp_path: Path) -> None:
    heights = [pixels_of(result, tmp_path).shape[0] for result in (make_plan_result(), make_plan_result(start=100))]
    assert heights == sorted(set(heights), reverse=True)


def test_plan_without_finite_energies_is_plotted(tmp_path: Path) -> None:
    assert pixels_of(make_plan_result(broken=True), tmp_path).std() > 10


def test_many_goals_and_a_mask_are_shown(tmp_path: Path) -> None:
    result = make_plan_result(100, 101, 102, 103, nodes=0)
    plain = pixels_of(result, tmp_path)
    mask = np.zeros(image(0).shape[:2], bool)
    mask[:30] = True
    object.__setattr__(result.request, "mask", mask)
    masked = pixels_of(result, tmp_path)
    assert masked.shape == plain.shape
    assert not np.array_equal(masked, plain)


def test_decoded_plan_adds_a_row_even_without_a_plan(tmp_path: Path) -> None:
    decoder = load_decoder(write_decoder(tmp_path / "decoder", tiny_model()))
    result, path = make_plan_result(start=100), tmp_path / "imagined.png"
    with Image.open(plot_plan(result, path, imagine_plan(result, decoder))) as plot:
        assert plot.height > pixels_of(result, tmp_path).shape[0] + 100


def test_images_are_stacked_horizontally_below_their_captions() -> None:
    images = [np.full((20, 60, 3), shade, dtype=np.uint8) for shade in (50, 120)]
    frame = stack_horizontally(images, ["a", "b"], "both")
    body = frame[-40:]
    assert (body[:, :120] == 50).all()
    assert (body[:, -120:] == 120).all()
    head = frame[:-40]
    assert head.min() < 80 < head.max() == 255  # ink on white
    assert (stack_horizontally(images, ["a", "$x_{"], "both") != frame).any()  # dollars begin no formula
    assert (stack_horizontally(images, ["a", "b"], "other") != frame).any()
