"""Estimates of decoded rollouts: means by horizon, and skill between the floor and the ceiling of the decoder."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from vjepa2_ac.evaluation.decoded.record import (
    DECODED_PERSISTENCE,
    DECODED_TRUTH,
    DecodedRollouts,
    Found,
    HandErrors,
    Reference,
    Region,
    Similarity,
)
from vjepa2_ac.evaluation.video.record import FrechetVideoDistance
from vjepa2_ac.intervals import Estimate, bootstrapped, mean_of

Curve = tuple[Found, ...]  # at horizon 1, 2, ...; index h - 1

_IDENTICAL = "all images are identical, and their PSNR is infinite"
_STILL = "nothing moves in any clip"
_LITTLE_APART = "decoded truth and decoded persistence do not clearly differ: the interval of their difference holds 0"
_ONE_EPISODE = "one episode has no interval, so nothing says that decoded truth and decoded persistence differ"


def similarity_of(
    found: DecodedRollouts, source: str, reference: Reference, region: Region, metric: Similarity
) -> Curve:
    """Return the mean similarity by horizon; clips with identical images and without motion are left out."""
    values = found.arrays.get((source, reference, region, metric))
    if values is None:
        return _absent(found, reference, region, metric)
    finite = np.isfinite(values)
    columns = np.stack([np.where(finite, values, 0.0), finite.astype(np.float64)])
    means = bootstrapped(lambda sums: sums[0] / sums[1], columns, found.episode_ids)
    return tuple(_found(mean, values[:, h]) for h, mean in enumerate(means))


def skill_of(found: DecodedRollouts, source: str, reference: Reference, region: Region, metric: Similarity) -> Curve:
    """Return where a source is between decoded persistence (0) and decoded truth (1), by horizon.

    Absent where these two do not clearly differ.
    """
    kinds = (source, DECODED_PERSISTENCE, DECODED_TRUTH)
    arrays = [found.arrays.get((kind, reference, region, metric)) for kind in kinds]
    if any(values is None for values in arrays):
        return _absent(found, reference, region, metric)
    if reference == DECODED_TRUTH and metric == "psnr_db":
        return (Found(None, "the decoded truth is its own reference, and its PSNR is infinite"),) * found.horizon
    values = np.stack([one for one in arrays if one is not None])
    counted = np.isfinite(values).all(axis=0)
    columns = np.where(counted, values, 0.0)
    skills = bootstrapped(lambda sums: (sums[0] - sums[1]) / (sums[2] - sums[1]), columns, found.episode_ids)
    return tuple(
        _skill(skill, _mean(columns[2, :, h] - columns[1, :, h], counted[:, h], found.episode_ids), values[:, :, h])
        for h, skill in enumerate(skills)
    )


def moving_share_of(found: DecodedRollouts) -> Curve:
    """Return the share of pixels in the moving region, by horizon."""
    if found.moving_share is None:
        return (Found(None, found.absent["truth"]),) * found.horizon
    return tuple(Found(mean_of(column, found.episode_ids)) for column in found.moving_share.T)


def cycle_of(found: DecodedRollouts, source: str) -> Curve:
    """Return the mean cycle error by horizon, of a model or the decoded truth."""
    if source not in found.cycle:
        return (Found(None, found.absent.get("cycle", "not measured of this one")),) * found.horizon
    return tuple(Found(mean_of(column, found.episode_ids)) for column in found.cycle[source].T)


def hand_of(found: DecodedRollouts, source: str) -> Curve:
    """Return the mean error of the hand's position in pixels by horizon."""
    hand = found.hand
    if hand is None or source not in hand.pixels:
        return (Found(None, found.absent.get("hand", "not measured of this one")),) * found.horizon
    return tuple(_known(hand, column, found.episode_ids) for column in hand.pixels[source].T)


def lpips_of(found: DecodedRollouts, source: str, reference: Reference) -> Curve:
    """Return the mean LPIPS of whole images by horizon; 0 is identical."""
    values = None if found.lpips is None else found.lpips.by_clip.get((source, reference))
    if values is None:
        reason = found.absent.get("truth") if reference == "truth" and found.lpips is not None else None
        return (Found(None, reason or found.absent.get("lpips", "not measured of this one")),) * found.horizon
    return tuple(Found(mean_of(column, found.episode_ids)) for column in values.T)


def fvd_of(found: DecodedRollouts, source: str, reference: Reference) -> FrechetVideoDistance:
    """Return FVD of whole clips, which is biased and has no interval."""
    if found.fvd is not None and source in found.fvd.against.get(reference, {}):
        return found.fvd.against[reference][source]
    reason = found.absent.get("truth") if reference == "truth" and found.fvd is not None else None
    reason = reason or found.absent.get("fvd", "not measured of this one")
    return FrechetVideoDistance(None, len(found.episode_ids), reason)


def _known(hand: HandErrors, column: Float[np.ndarray, " clips"], ids: Sequence[str]) -> Found:
    mean = _mean(column, np.isfinite(column), ids)
    return Found(mean) if mean is not None else Found(None, f"the hand is in no image of {hand.size} pixels")


def _absent(found: DecodedRollouts, reference: Reference, region: Region, metric: Similarity) -> Curve:
    needs_frames = reference == "truth" or region == "moving"
    reason = found.absent.get("truth") if needs_frames else None
    return (Found(None, reason or found.absent.get(metric, "not measured of this one")),) * found.horizon


def _found(mean: Estimate, values: Float[np.ndarray, " clips"]) -> Found:
    identical, still = int(np.isinf(values).sum()), int(np.isnan(values).sum())
    if not np.isfinite(values).any():
        return Found(None, _IDENTICAL if identical else _STILL, identical, still)
    return Found(mean, identical=identical, still=still)


def _skill(skill: Estimate, difference: Estimate | None, values: Float[np.ndarray, "kinds clips"]) -> Found:
    identical, still = int(np.isinf(values).any(axis=0).sum()), int(np.isnan(values).any(axis=0).sum())
    if difference is None:
        return Found(None, _IDENTICAL if identical else _STILL, identical, still)
    if not difference.has_interval:
        return Found(None, _ONE_EPISODE, identical, still)
    if difference.side(0.0) == 0:
        return Found(None, _LITTLE_APART, identical, still)
    return Found(skill, identical=identical, still=still)


def _mean(values: Float[np.ndarray, " clips"], counted: np.ndarray, ids: Sequence[str]) -> Estimate | None:
    """Return the mean over the clips that count; None: there are none."""
    if not counted.any():
        return None
    return mean_of(values[counted], [name for name, counts in zip(ids, counted, strict=True) if counts])
