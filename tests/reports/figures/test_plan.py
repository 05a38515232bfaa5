"""The figure of a plan is drawn for every outcome of a decision."""

from pathlib import Path

import numpy as np
from PIL import Image

from decisions import asked, image
from random_decoder import write_decoder
from tiny_models import tiny_model
from vjepa2_ac.decoding.decoder import load_decoder
from vjepa2_ac.evaluation.imagined import imagine_plan
from vjepa2_ac.planning.decision import PlanResult
from vjepa2_ac.reports.planning_figures import plot_plan


def drawn(found: PlanResult, folder: Path) -> np.ndarray:
    with Image.open(plot_plan(found, folder / "plan.png")) as image:
        return np.array(image.convert("RGB"))


def test_slices_are_a_row_of_their_own(tmp_path: Path) -> None:
    heights = [drawn(found, tmp_path).shape[0] for found in (asked(), asked(start=100))]
    assert heights == sorted(set(heights), reverse=True)


def test_a_plan_without_energies_is_drawn_as_well(tmp_path: Path) -> None:
    assert drawn(asked(broken=True), tmp_path).std() > 10


def test_many_goals_and_a_mask_are_shown(tmp_path: Path) -> None:
    found = asked(100, 101, 102, 103, nodes=0)
    plain = drawn(found, tmp_path)
    mask = np.zeros(image(0).shape[:2], bool)
    mask[:30] = True
    object.__setattr__(found.question, "mask", mask)
    masked = drawn(found, tmp_path)
    assert masked.shape == plain.shape
    assert not np.array_equal(masked, plain)


def test_what_was_imagined_is_a_row_of_its_own_also_of_a_decision_without_a_plan(tmp_path: Path) -> None:
    decoder = load_decoder(write_decoder(tmp_path / "decoder", tiny_model()))
    found, path = asked(start=100), tmp_path / "imagined.png"
    with Image.open(plot_plan(found, path, imagine_plan(found, decoder))) as picture:
        assert picture.height > drawn(found, tmp_path).shape[0] + 100
