"""The section on decoded rollouts: its cells are the estimates, what is absent has a reason, and it stays small."""

from dataclasses import replace
from functools import cache

import numpy as np
from markupsafe import escape

from evaluation_results import evaluation
from vjepa2_ac.evaluation.decoded.estimates import hand_of, similarity_of
from vjepa2_ac.evaluation.decoded.record import (
    ABSENT,
    NEIGHBOURS,
    REFERENCES,
    REGIONS,
    SIMILARITIES,
    DecodedRollouts,
    DecodedStrip,
    HandErrors,
)
from vjepa2_ac.evaluation.video.record import FrechetVideoDistance, FrechetVideoDistances, LpipsDistances
from vjepa2_ac.intervals import mean_of
from vjepa2_ac.reports.html.decoded import decoded_section
from vjepa2_ac.reports.html.formatting import value
from vjepa2_ac.reports.html.page import report_page

USUAL = evaluation()


@cache
def decoded(size: int = 64, strips: int = 2) -> DecodedRollouts:
    """Return decoded rollouts of which everything but the encoder's part was measured."""
    drawn, ids = np.random.default_rng(0), USUAL.clips.episode_ids
    sources, shape = (*NEIGHBOURS, *USUAL.models), (len(ids), USUAL.horizon)
    level = {source: 20 + 2 * place for place, source in enumerate(reversed(sources))}
    arrays = {
        (source, reference, region, metric): level[source] + drawn.normal(size=shape)
        for source in sources
        for reference in REFERENCES
        for region in REGIONS
        for metric in SIMILARITIES
    }
    hand = {source: drawn.uniform(1, 5, shape) for source in ("truth", "adapter")}
    rows = ("truth", "decoded_truth", "base", "adapter")
    images = {row: drawn.integers(0, 256, (USUAL.horizon + 1, size, size, 3)).astype(np.uint8) for row in rows}
    return DecodedRollouts(
        decoder={"folder": "decoder"},
        episode_ids=ids,
        models=tuple(USUAL.models),
        horizon=USUAL.horizon,
        arrays=arrays,
        moving_share=drawn.uniform(0, 1, shape),
        cycle={},
        hand=HandErrors(hand, size, mean_of(hand["truth"][:, 0], ids), (1000, 25), 9.0),
        strips=tuple(DecodedStrip("best", f"<b>{number}", 0, images) for number in range(strips)),
        absent={"cycle": "the encoder was set aside", "video": "of few clips"},
    )


def test_without_a_decoder_it_says_how_to_get_one() -> None:
    assert "--decoder FOLDER" in decoded_section(USUAL)


def test_the_table_shows_the_estimates_of_the_last_horizon_beside_the_neighbours() -> None:
    section = decoded_section(replace(USUAL, decoded=decoded()))
    for source in (*NEIGHBOURS, "base", "adapter"):
        last = similarity_of(decoded(), source, "truth", "moving", "psnr_db")[-1]
        assert last.estimate is not None
        assert value(last.estimate, 1) in section
    of_hand = hand_of(decoded(), "adapter")[-1].estimate
    assert of_hand is not None
    assert value(of_hand, 1) in section
    for words in ("decoded persistence", "raw persistence", "Cycle error: not measured, the encoder was set aside."):
        assert words in section
    assert "Not JEDi" not in section, "there is no such metric here"
    assert "no evidence of" in section


def test_images_are_shown_with_what_they_are_and_names_are_escaped() -> None:
    section = decoded_section(replace(USUAL, decoded=decoded()))
    assert section.count("data:image/jpeg") == 2
    assert "row by row: truth, decoded truth, base, adapter" in section
    assert "<b>" not in section


def test_from_a_cache_it_shows_what_is_known_against_the_decoded_truth() -> None:
    full = decoded()
    arrays = {key: one for key, one in full.arrays.items() if key[1] == "decoded_truth" and key[2] == "whole"}
    some = replace(full, arrays=arrays, moving_share=None, hand=None, absent={"truth": "a cache", "hand": "a cache"})
    section = decoded_section(replace(USUAL, decoded=some))
    assert "SSIM of the whole image, against the decoded truth" in section
    assert "Against the truth: not measured, a cache." in section


def test_with_large_noisy_images_the_page_stays_small() -> None:
    page = report_page(replace(USUAL, decoded=decoded(size=256, strips=6)), "verdict")
    assert len(page) < 5_000_000
    assert "<script" not in page


def test_each_absent_metric_has_a_name_and_an_unknown_one_is_shown_as_it_is() -> None:
    absent = {what: f"reason {number}" for number, what in enumerate([*ABSENT, "new"])}
    section = decoded_section(replace(USUAL, decoded=replace(decoded(), hand=None, absent=absent)))
    for what, reason in absent.items():
        assert f"{value_of_name(what)}: not measured, {reason}." in section


def value_of_name(what: str) -> str:
    return str(escape(ABSENT.get(what, what)))


def test_lpips_and_fvd_have_columns_and_their_meaning_if_they_were_measured() -> None:
    full, shape = decoded(), (len(USUAL.clips.episode_ids), USUAL.horizon)
    by_clip = {(source, "truth"): np.full(shape, 0.123) for source in (*NEIGHBOURS, *USUAL.models)}
    fvd = FrechetVideoDistances({"truth": {"adapter": FrechetVideoDistance(87.65, 48)}}, 48, 400)
    measured = replace(full, lpips=LpipsDistances("vgg", by_clip), fvd=fvd)
    section = decoded_section(replace(USUAL, decoded=measured))
    for words in ("LPIPS (vgg)</th>", "FVD (biased)</th>", "0.123", "<td>87.7</td>", "covariance is singular"):
        assert words in section
    assert "LPIPS (" not in decoded_section(replace(USUAL, decoded=full))
