"""How sure is a share of successes? An estimate with its 95 % interval, from counting."""

from __future__ import annotations

import math

from scipy import stats

from vjepa2_ac.evaluation.bootstrap import Estimate

_DEVIATIONS = float(stats.norm.ppf(0.975))  # of a normal distribution, that 95 % lie within


def share_of(successes: int, tries: int) -> Estimate:
    """Return the share of tries that succeeded, with Wilson's interval: it stays within 0 .. 1, and is no point at 0.

    Raises:
        ValueError: No tries, or more successes than tries.

    Source: Wilson (1927), Probable Inference, the Law of Succession, and Statistical Inference.
    """
    if not 0 <= successes <= tries or not tries:
        raise ValueError(f"{successes} of {tries} tries succeeded")
    share, weight = successes / tries, _DEVIATIONS**2 / tries
    middle = (share + weight / 2) / (1 + weight)
    reach = _DEVIATIONS / (1 + weight) * math.sqrt(share * (1 - share) / tries + weight / (4 * tries))
    return Estimate(share, max(0.0, middle - reach), min(1.0, middle + reach))
