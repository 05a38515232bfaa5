"""Shares of successes have intervals with the stated coverage."""

import pytest
from scipy import stats

from vjepa2_ac.intervals import share_of


def test_published_intervals_come_out() -> None:
    # Brown, Cai, DasGupta (2001) and any table: Wilson's 95 % intervals.
    middle, none, all_of_it = share_of(10, 20), share_of(0, 20), share_of(50, 50)
    assert middle.value == 0.5
    assert (middle.low, middle.high) == pytest.approx((0.2993, 0.7007), abs=1e-4)
    assert (none.value, none.low, none.high) == pytest.approx((0.0, 0.0, 0.1611), abs=1e-4)
    assert (all_of_it.value, all_of_it.low, all_of_it.high) == pytest.approx((1.0, 0.9287, 1.0), abs=1e-4)


def test_intervals_cover_the_true_share_about_as_often_as_they_say() -> None:
    for true in (0.1, 0.5, 0.8):
        found = [share_of(successes, 50) for successes in range(51)]
        chances = stats.binom.pmf(range(51), 50, true)
        covered = sum(chance for chance, one in zip(chances, found, strict=True) if one.low <= true <= one.high)
        assert 0.92 < covered < 0.98


def test_a_share_of_nothing_is_refused() -> None:
    for successes, tries in ((0, 0), (3, 2), (-1, 2)):
        with pytest.raises(ValueError, match="must"):
            share_of(successes, tries)
