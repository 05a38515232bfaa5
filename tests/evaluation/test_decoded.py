"""Decoded rollouts of predictors with known errors have the expected metrics, images and notes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from vjepa2_ac.decoding.decoder import Decoder, DecoderCard, DecoderShape, TrainedDecoder, to_pixels
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.decoded import (
    BASELINES,
    DECODED_PERSISTENCE,
    DECODED_TRUTH,
    measure_decoded,
)
from vjepa2_ac.evaluation.evaluate import EvaluatedModel, RepeatableClips
from vjepa2_ac.evaluation.result import DecodedRollouts, Example
from worlds import DIM, TIME, TOKENS, Copier, Halfway, Oracle, clips_batch, in_batches, rows


def decoder(*, dim: int = DIM, tokens: int = TOKENS, strength: float = 0.25) -> TrainedDecoder:
    """Return a linear decoder of smooth patches; with strength 0 all images are grey."""
    shape = DecoderShape("linear", dim, round(tokens**0.5), 16)
    model = Decoder(shape).eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(3)
    coarse = torch.randn(dim * 3, 1, 4, 4, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, size=(16, 16), mode="bilinear").reshape(dim, -1)
    model.linear.weight.copy_(strength * smooth.T)
    model.linear.bias.zero_()
    card = DecoderCard("vjepa2-ac decoder 1", shape, "an encoder", "released", "fp32", "data", ("camera",), 3, 30, 100)
    return TrainedDecoder(card, model, Path("decoder"))


def clips(batch: LatentBatch, trained: TrainedDecoder, size: int = 4, noise: float = 0.03) -> RepeatableClips:
    """Return clips whose true frames are decoded images plus noise that the decoder cannot draw."""
    images = trained.decoder.decode(batch.latents)
    fixed_noise = torch.randn(images.shape[-3:], generator=torch.Generator().manual_seed(4))
    frames = to_pixels(images + noise * fixed_noise)
    indices = {name: index for index, name in enumerate(zip(batch.episode_ids, batch.starts, strict=True))}

    def read(names):  # type: ignore[no-untyped-def]
        chosen = list(indices.values()) if names is None else [indices[name] for name in names]
        for number, part in enumerate(in_batches(rows(batch, chosen), size)):
            yield part, lambda row, first=number * size: frames[chosen[first + row]]

    return RepeatableClips(tuple(indices), read)


def evaluated_models(trained: object, base: object | None = None) -> Sequence[EvaluatedModel]:
    """Return the trained model, and before it the base model if there is one."""
    base_models = [] if base is None else [EvaluatedModel("base", "base", base)]  # type: ignore[arg-type]
    return [*base_models, EvaluatedModel("adapter", "trained", trained)]  # type: ignore[arg-type]


TRAINED = decoder()
BATCH = clips_batch(24)


def measured(*models: object, size: int = 4, **options: object) -> DecodedRollouts:
    return measure_decoded(evaluated_models(*models), clips(BATCH, TRAINED, size), TRAINED, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def oracle() -> DecodedRollouts:
    return measured(Oracle(), Copier())


def values_of(decoded: DecodedRollouts, source: str) -> dict[str, list[float]]:
    curves = {metric: curve for (name, metric), curve in decoded.curves.items() if name == source}
    return {metric: [estimate.value for estimate in curve] for metric, curve in curves.items()}


def test_perfect_predictor_equals_decoded_truth_and_copying_equals_decoded_persistence(
    oracle: DecodedRollouts,
) -> None:
    assert oracle.sources == (*BASELINES, "base", "adapter")
    for source, baseline in (("adapter", DECODED_TRUTH), ("base", DECODED_PERSISTENCE)):
        model_values, baseline_values = values_of(oracle, source), values_of(oracle, baseline)
        assert model_values.keys() == baseline_values.keys() >= {"psnr_db.moving.truth", "ssim.whole.decoded_truth"}
        for metric, values in model_values.items():
            np.testing.assert_array_equal(values, baseline_values[metric])
    assert all(np.isnan(values_of(oracle, "adapter")["psnr_db.whole.decoded_truth"])), "identical images: infinite"
    assert values_of(oracle, "adapter")["ssim.whole.decoded_truth"] == pytest.approx([1.0] * (TIME - 1), abs=1e-6)


def test_half_motion_predictor_scores_between_persistence_and_truth() -> None:
    decoded = measured(Halfway())
    for metric in ("psnr_db.whole.truth", "ssim.moving.truth"):
        low, middle, high = (
            values_of(decoded, source)[metric] for source in (DECODED_PERSISTENCE, "adapter", DECODED_TRUTH)
        )
        assert all(a < b < c for a, b, c in zip(low, middle, high, strict=True))


def test_static_clip_is_excluded_from_moving_region_metrics() -> None:
    static = replace(BATCH, latents=BATCH.latents.clone(), actions=BATCH.actions.clone())
    static.latents[:3] = static.latents[:3, :1]
    decoded = measure_decoded(evaluated_models(Copier()), clips(static, TRAINED), TRAINED)
    moving = replace(BATCH, **{
        name: getattr(BATCH, name)[3:] for name in ("latents", "actions", "states", "episode_ids", "starts")
    })  # fmt: skip
    without = measure_decoded(evaluated_models(Copier()), clips(moving, TRAINED), TRAINED)
    key = ("adapter", "psnr_db.moving.truth")
    assert decoded.curves[key][0].value == pytest.approx(without.curves[key][0].value, rel=1e-5)
    assert any("3 clips are left out" in note for note in decoded.notes)


def test_cached_latents_are_not_compared_with_true_frames() -> None:
    decoded = measure_decoded(evaluated_models(Oracle()), replace(clips(BATCH, TRAINED), has_frames=False), TRAINED)
    assert not [metric for _, metric in decoded.curves if metric.endswith(".truth") or ".moving." in metric]
    assert "come from a cache" in decoded.notes[0]
    assert decoded.sources == (DECODED_TRUTH, DECODED_PERSISTENCE, "adapter")


def test_decoded_strips_start_with_the_input_frame() -> None:
    example = Example("best", BATCH.episode_ids[3], BATCH.starts[3], None, {})
    decoded = measure_decoded(evaluated_models(Oracle()), clips(BATCH, TRAINED), TRAINED, [example])
    (strip,) = decoded.strips
    assert list(strip.rows) == ["truth", "decoded_truth", "adapter"]
    np.testing.assert_array_equal(strip.rows["adapter"], strip.rows["decoded_truth"])
    assert len(strip.rows["truth"]) == TIME


def test_fvd_of_images_is_lowest_for_the_decoded_truth_and_needs_the_encoder() -> None:
    assert measured(Oracle()).fvd == {}

    def encode(images: Tensor) -> Tensor:
        return images.mean(dim=(-2, -1)).repeat(1, 1, 2)[:, :, None]

    decoded = measure_decoded(evaluated_models(Oracle(), Copier()), clips(BATCH, TRAINED), TRAINED, encode=encode)
    assert list(decoded.fvd) == [DECODED_TRUTH, DECODED_PERSISTENCE, "base", "adapter"]
    assert decoded.fvd["adapter"] == decoded.fvd[DECODED_TRUTH]
    assert decoded.fvd["base"] == decoded.fvd[DECODED_PERSISTENCE]
