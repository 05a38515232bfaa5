"""Agreement of frames and states: correlation of their changes, step by step and shifted.

Where a robot moves faster, its frame changes more. The rank correlation of the two within an episode is 0.5 and more on
simulated arms at 15 Hz and on BridgeData at 5 Hz (docs/log.md); with the frames of another episode, at the best of 21
shifts, it is 0.1 to 0.4. So the shift with the highest correlation shows frames that are late, frames that fit
backwards are reversed, and frames that fit no better than another episode's belong to another episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.stats import rankdata

MOST_LAG = 10  # control steps
_LAG_SHARE = 4  # an excerpt is shifted by a quarter of its length at most
_FEWEST_CHANGES = 8  # of an excerpt
_SHIFTS = 20  # pairings with other episodes, each covering all episodes
FEWEST_EPISODES = 8  # with fewer, chance level is not known well enough
_SURE = 3.0  # standard errors, or deviations of chance
_GAIN = 0.25  # of the value above chance, that another shift must add
_ABOVE = 0.15  # minimum above chance for matching frames: 0.3 and more was measured

Verdict = Literal["together", "late", "reversed", "foreign", "unknown"]


@dataclass(frozen=True)
class Agreement:
    """Agreement of frames and states."""

    verdict: Verdict
    episodes: int
    lag: int = 0  # control steps by which frames lag behind states where they fit best; below 0: lead
    best: float = 0.0  # mean rank correlation there
    unshifted: float = 0.0
    backwards: float = 0.0  # with the frames in reverse, at the best shift
    chance: float = 0.0  # with frames of other episodes, at the best shift
    is_farthest: bool = False  # no wider shift was evaluated


def agreement_of(
    pairs: Sequence[tuple[Float[np.ndarray, " changes"], Float[np.ndarray, " changes"]]], stride: int
) -> Agreement:
    """Compare the change of frames with that of states.

    Args:
        pairs: Of some episodes: how far the state has moved at each step, and the frame has changed, in any unit.
        stride: Control steps per model step. A camera easily lags by one control step: that is late at stride 1 only.
    """
    pairs = [pair for pair in pairs if all(len(values) and np.ptp(values) > 0 for values in pair)]
    usual = float(np.median([len(one) for one, _ in pairs])) if pairs else 0.0
    pairs = [pair for pair in pairs if len(pair[0]) >= usual / 2]  # shorter ones would allow few shifts only
    most = min(MOST_LAG, int(usual) // _LAG_SHARE)
    if len(pairs) < FEWEST_EPISODES or usual < _FEWEST_CHANGES:
        return Agreement("unknown", len(pairs))
    lags = range(-most, most + 1)
    ways, seen = (_ranks([pair[which] for pair in pairs]) for which in (0, 1))
    turned = _ranks([change[::-1] for _, change in pairs])
    shifts = range(1, min(len(pairs), _SHIFTS + 1))
    chance = np.array([_profiles(ways, np.roll(seen, -shift, axis=0), lags).mean(axis=0).max() for shift in shifts])
    return _judged(_profiles(ways, seen, lags), _profiles(ways, turned, lags), chance, lags, min(2, stride))


def _judged(
    own: Float[np.ndarray, "episodes lags"],
    turned: Float[np.ndarray, "episodes lags"],
    chance: Float[np.ndarray, " shifts"],
    lags: range,
    least_lag: int,
) -> Agreement:
    mean, backwards = own.mean(axis=0), turned.mean(axis=0)
    best, turned_best, unshifted = int(mean.argmax()), int(backwards.argmax()), lags.index(0)
    limit = chance.mean() + _SURE * chance.std(ddof=1)
    gain = mean[best] - mean[unshifted]
    verdict: Verdict = "together"
    if backwards[turned_best] > limit and _surely_above(turned[:, turned_best], own[:, best]):
        verdict = "reversed"
    elif mean[best] <= limit:
        highest = mean[best] + 2 * own[:, best].std(ddof=1) / np.sqrt(len(own))
        verdict = "foreign" if highest < chance.mean() + _ABOVE else "unknown"
    elif (
        abs(lags[best]) >= least_lag
        and gain > _GAIN * (mean[best] - chance.mean())
        and _surely_above(own[:, best], own[:, unshifted])
    ):
        verdict = "late"
    return Agreement(
        verdict,
        len(own),
        lags[best],
        float(mean[best]),
        float(mean[unshifted]),
        float(backwards[turned_best]),
        float(chance.mean()),
        is_farthest=abs(lags[best]) == lags[-1],
    )


def _ranks(rows: Sequence[Float[np.ndarray, " _"]]) -> Float[np.ndarray, "rows longest"]:
    """Return the ranks of each row's values, from 0 to 1; NaN after the end of shorter ones."""
    ranks = np.full((len(rows), max(map(len, rows))), np.nan)
    for place, row in enumerate(rows):
        ranks[place, : len(row)] = rankdata(row) / len(row)
    return ranks


def _profiles(
    moved: Float[np.ndarray, "episodes longest"], seen: Float[np.ndarray, "episodes longest"], lags: range
) -> Float[np.ndarray, "episodes lags"]:
    """Return each row's correlation with frame changes taken so many steps later than motion."""
    length = moved.shape[1]
    columns = []
    for lag in lags:
        one = moved[:, max(-lag, 0) : length - max(lag, 0)]
        other = seen[:, max(lag, 0) : length - max(-lag, 0)]
        ends = np.isnan(one + other)
        first, second = (np.where(ends, np.nan, values) for values in (one, other))
        first, second = (values - np.nanmean(values, axis=1, keepdims=True) for values in (first, second))
        size = np.sqrt(np.nansum(first**2, axis=1) * np.nansum(second**2, axis=1))
        columns.append(np.nansum(first * second, axis=1) / np.where(size > 0, size, np.inf))
    return np.stack(columns, axis=1)


def _surely_above(one: Float[np.ndarray, " episodes"], other: Float[np.ndarray, " episodes"]) -> bool:
    difference = one - other
    return bool(difference.mean() > _SURE * difference.std(ddof=1) / np.sqrt(len(difference)))
