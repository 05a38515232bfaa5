"""Decoded rollouts as plain values for metrics.json, by the schema in docs/evaluation.md."""

from __future__ import annotations

from typing import Any

from vjepa2_ac.evaluation.decoded.estimates import (
    Curve,
    cycle_of,
    fvd_of,
    hand_of,
    lpips_of,
    moving_share_of,
    similarity_of,
    skill_of,
)
from vjepa2_ac.evaluation.decoded.record import (
    MEANING,
    NEIGHBOURS,
    REFERENCES,
    REGIONS,
    SIMILARITIES,
    TRUE_FRAMES,
    DecodedRollouts,
)
from vjepa2_ac.evaluation.video.record import FVD_LABEL, FVD_MEANING, LPIPS_MEANING, NO_I3D, NO_LPIPS


def decoded_as_dict(found: DecodedRollouts) -> dict[str, Any]:
    """Return everything that was measured of decoded rollouts."""
    return {
        "decoder": found.decoder,
        "moving_share": _curve(moving_share_of(found)),
        "models": {name: _source(found, name) for name in found.models},
        "neighbours": {name: _source(found, name) for name in NEIGHBOURS},
        "hand": _hand(found),
        "video_mmd": _video(found),
        "lpips": _absent_lpips(found) if found.lpips is None else found.lpips.about(),
        "fvd": _absent_fvd(found) if found.fvd is None else found.fvd.about(),
    }


def _source(found: DecodedRollouts, name: str) -> dict[str, Any]:
    return {
        **{
            f"against_{reference}": {
                region: {
                    metric: _curve(similarity_of(found, name, reference, region, metric)) for metric in SIMILARITIES
                }
                for region in REGIONS
            }
            for reference in REFERENCES
        },
        "skill": {
            f"against_{reference}": {
                region: {metric: _curve(skill_of(found, name, reference, region, metric)) for metric in SIMILARITIES}
                for region in REGIONS
            }
            for reference in REFERENCES
        },
        "cycle_error": _curve(cycle_of(found, name)),
        "hand_error_px": _curve(hand_of(found, name)),
        "video_mmd": _video_of(found, name),
        "lpips": {f"against_{reference}": _curve(lpips_of(found, name, reference)) for reference in REFERENCES},
        "fvd": {f"against_{reference}": fvd_of(found, name, reference).as_dict() for reference in REFERENCES},
    }


def _video_of(found: DecodedRollouts, name: str) -> dict[str, Any]:
    video = found.video
    against = {} if video is None else {"truth": video.against_truth, "decoded_truth": video.against_decoded_truth}
    reason = found.absent.get("video") or "not measured of this one"
    return {
        f"against_{reference}": against[reference][name].as_dict()
        if name in against.get(reference, {})
        else {"value": None, "reason": reason}
        for reference in REFERENCES
    }


def _hand(found: DecodedRollouts) -> dict[str, Any]:
    hand = found.hand
    if hand is None:
        return {"value": None, "reason": found.absent["hand"]}
    frames, episodes = hand.fitted_on
    return {
        "image_px": hand.size,
        "fitted_on": {"frames": frames, "episodes": episodes, "split": "train"},
        "held_out_error_px": hand.held_out.as_dict(),
        "mean_position_error_px": hand.mean_position,
        "of_true_frames_px": _curve(hand_of(found, TRUE_FRAMES)),
    }


def _video(found: DecodedRollouts) -> dict[str, Any]:
    video = found.video
    if video is None:
        return {"value": None, "reason": found.absent["video"], "meaning": MEANING}
    return {"meaning": MEANING, "frames": video.frames, "noise_floor": video.noise_floor, "notes": video.notes}


def _absent_lpips(found: DecodedRollouts) -> dict[str, Any]:
    return {"value": None, "reason": found.absent.get("lpips", NO_LPIPS), "meaning": LPIPS_MEANING}


def _absent_fvd(found: DecodedRollouts) -> dict[str, Any]:
    reason = found.absent.get("fvd", NO_I3D)
    return {"value": None, "reason": reason, "label": FVD_LABEL, "meaning": FVD_MEANING}


def _curve(curve: Curve) -> list[dict[str, Any]]:
    return [one.as_dict() for one in curve]
