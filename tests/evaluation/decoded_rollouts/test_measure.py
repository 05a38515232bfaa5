"""A perfect predictor's images are the decoded truth bit for bit, persistence has skill 0; what is absent says why."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from decoded_worlds import Known, clips, contenders, decoder
from tiny_models import tiny_model
from vjepa2_ac.data.transforms import images_to_input
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.decoded.estimates import (
    cycle_of,
    fvd_of,
    hand_of,
    lpips_of,
    moving_share_of,
    similarity_of,
    skill_of,
)
from vjepa2_ac.evaluation.decoded.hand import HandProbe
from vjepa2_ac.evaluation.decoded.record import (
    DECODED_PERSISTENCE,
    DECODED_TRUTH,
    NEIGHBOURS,
    REFERENCES,
    REGIONS,
    SIMILARITIES,
    DecodedRollouts,
)
from vjepa2_ac.evaluation.decoded_rollouts.measure import Decoding, HandReader, measure_decoded
from vjepa2_ac.evaluation.decoded_rollouts.metric_networks import IMAGES, MetricNetworks, lpips_by_pair
from vjepa2_ac.evaluation.result import Example
from vjepa2_ac.evaluation.video.lpips import Lpips
from vjepa2_ac.reports.decoded_json import decoded_as_dict
from worlds import TIME, Copier, Halfway, Oracle, clips_batch

TRAINED = decoder()
BATCH = clips_batch(24)


@pytest.fixture(scope="module")
def oracle() -> DecodedRollouts:
    return measure_decoded(contenders(Oracle(), Copier()), clips(BATCH, TRAINED), Decoding(TRAINED))


def values(found: DecodedRollouts, source: str) -> dict[Any, np.ndarray]:
    return {key[1:]: one for key, one in found.arrays.items() if key[0] == source}


def leaves(values: Any) -> list[dict[str, Any]]:
    """Return everything with a value, wherever it is."""
    if isinstance(values, dict):
        return [values] if "value" in values else [leaf for one in values.values() for leaf in leaves(one)]
    return [leaf for one in values for leaf in leaves(one)] if isinstance(values, list | tuple) else []


def test_a_perfect_predictor_equals_the_decoded_truth_bit_for_bit_and_a_copier_decoded_persistence(
    oracle: DecodedRollouts,
) -> None:
    for source, neighbour in (("adapter", DECODED_TRUTH), ("base", DECODED_PERSISTENCE)):
        mine, other = values(oracle, source), values(oracle, neighbour)
        assert mine.keys() == other.keys()
        for key, one in mine.items():
            np.testing.assert_array_equal(one, other[key])


def test_perfect_latents_have_skill_one_and_persistence_none(oracle: DecodedRollouts) -> None:
    for region in REGIONS:
        for metric in SIMILARITIES:
            for source, expected in (("adapter", 1.0), ("base", 0.0), (DECODED_TRUTH, 1.0), (DECODED_PERSISTENCE, 0.0)):
                for one in skill_of(oracle, source, "truth", region, metric):
                    assert one.estimate is not None
                    assert (one.value, one.estimate.low, one.estimate.high) == (expected,) * 3


def test_what_goes_half_of_the_way_has_a_skill_in_between() -> None:
    found = measure_decoded(contenders(Halfway()), clips(BATCH, TRAINED), Decoding(TRAINED))
    for metric in SIMILARITIES:
        assert all(0.05 < one.value < 0.95 for one in skill_of(found, "adapter", "truth", "whole", metric))


def test_identical_images_are_left_out_of_a_psnr_and_counted(oracle: DecodedRollouts) -> None:
    (one, *_) = similarity_of(oracle, "adapter", "decoded_truth", "whole", "psnr_db")
    assert one.estimate is None
    assert one.identical == len(BATCH.starts)
    assert "infinite" in one.as_dict()["reason"]
    (ssim, *_) = similarity_of(oracle, "adapter", "decoded_truth", "whole", "ssim")
    assert ssim.value == pytest.approx(1.0, abs=1e-6)
    assert skill_of(oracle, "base", "decoded_truth", "whole", "psnr_db")[0].estimate is None


def test_a_clip_in_which_nothing_moves_does_not_count_in_the_moving_region() -> None:
    still = replace(BATCH, latents=BATCH.latents.clone(), actions=BATCH.actions.clone())
    still.latents[:3] = still.latents[:3, :1]
    found = measure_decoded(contenders(Copier()), clips(still, TRAINED), Decoding(TRAINED))
    (one, *_) = similarity_of(found, "adapter", "truth", "moving", "psnr_db")
    assert one.still == 3
    mine = found.arrays["adapter", "truth", "moving", "psnr_db"][3:, 0]
    assert one.value == pytest.approx(mine.mean())
    assert found.moving_share is not None
    assert (found.moving_share[:3] == 0).all()
    assert moving_share_of(found)[0].value == pytest.approx(found.moving_share[:, 0].mean())


def test_a_decoder_that_shows_nothing_gives_no_skill_but_the_reason() -> None:
    blind = decoder(strength=0.0)
    found = measure_decoded(contenders(Oracle()), clips(BATCH, TRAINED), Decoding(blind))
    for one in skill_of(found, "adapter", "truth", "whole", "psnr_db"):
        assert one.estimate is None
        assert "do not clearly differ" in one.reason
    alone = replace(found, episode_ids=("one",) * len(found.episode_ids))
    assert "one episode" in skill_of(alone, "adapter", "truth", "whole", "psnr_db")[0].reason


def test_the_size_of_a_batch_changes_nothing_but_rounding(oracle: DecodedRollouts) -> None:
    other = measure_decoded(contenders(Oracle(), Copier()), clips(BATCH, TRAINED, size=7), Decoding(TRAINED))
    for key, one in oracle.arrays.items():
        finite = np.isfinite(one)
        np.testing.assert_allclose(other.arrays[key][finite], one[finite], rtol=1e-4)


def test_from_a_cache_what_needs_frames_or_the_encoder_is_null_with_the_reason() -> None:
    found = measure_decoded(contenders(Oracle()), clips(BATCH, TRAINED), Decoding(TRAINED, has_frames=False))
    values = decoded_as_dict(found)
    adapter = values["models"]["adapter"]
    assert {one["value"] for one in leaves(adapter["against_truth"])} == {None}
    assert {one["value"] for one in leaves(adapter["cycle_error"])} == {None}
    assert adapter["against_decoded_truth"]["whole"]["ssim"][0]["value"] == pytest.approx(1.0, abs=1e-6)
    assert adapter["against_decoded_truth"]["moving"]["ssim"][0]["value"] is None
    assert all(one["reason"] for one in leaves(values) if one["value"] is None)
    assert "cache" in values["video_mmd"]["reason"]


def test_everything_in_the_file_is_a_number_or_has_a_reason(oracle: DecodedRollouts) -> None:
    values = decoded_as_dict(oracle)
    assert set(values["neighbours"]) == set(NEIGHBOURS)
    assert list(values["models"]) == ["base", "adapter"]
    found = leaves(values)
    assert len(found) > 200
    for one in found:
        assert (one["value"] is None) == bool(one.get("reason")), one


def test_examples_are_shown_with_the_frame_that_is_given_in_front() -> None:
    names = [(BATCH.episode_ids[clip], BATCH.starts[clip]) for clip in (9, 2)]
    empty = np.zeros((TIME, 2, 2, 3), np.uint8)
    examples = [Example("best", *name, None, {}, empty, {}) for name in names]
    found = measure_decoded(contenders(Oracle(), Copier()), clips(BATCH, TRAINED), Decoding(TRAINED), examples)
    assert [(one.episode_id, one.start) for one in found.strips] == names
    rows = found.strips[0].rows
    assert list(rows) == ["truth", "decoded_truth", "base", "adapter"]
    assert {one.shape for one in rows.values()} == {(TIME, 32, 32, 3)}
    np.testing.assert_array_equal(rows["adapter"], rows["decoded_truth"])
    assert (rows["base"] == rows["decoded_truth"][:1]).all()


MODEL = tiny_model()


def encoded(count: int = 24) -> LatentBatch:
    """Return clips of smooth images and the tiny encoder's latents of them; two clips an episode."""
    coarse = torch.rand(count * 4, 3, 4, 4, generator=torch.Generator().manual_seed(5))
    images = torch.nn.functional.interpolate(coarse, size=(48, 48), mode="bilinear").unflatten(0, (count, 4))
    latents = MODEL.encode(images_to_input(images))
    ids = tuple(f"episode {clip // 2:02d}" for clip in range(count))
    return LatentBatch(latents, torch.zeros(count, 4, 7), torch.zeros(count, 3, 7), None, ids, tuple(range(count)))


def test_of_perfect_latents_cycle_error_and_video_mmd_are_those_of_the_decoded_truth() -> None:
    batch, trained = encoded(), decoder(dim=24, tokens=9)
    models = contenders(Known(batch.latents), Copier())
    found = measure_decoded(models, clips(batch, trained, size=24), Decoding(trained, encoder=MODEL))
    np.testing.assert_array_equal(found.cycle["adapter"], found.cycle[DECODED_TRUTH])
    assert cycle_of(found, "adapter")[0].value == pytest.approx(float(found.cycle["adapter"][:, 0].mean()))
    assert found.video is not None
    assert found.video.against_decoded_truth["adapter"].squared.value == pytest.approx(0.0, abs=1e-9)
    assert found.video.against_truth["adapter"] == found.video.against_truth[DECODED_TRUTH]
    assert found.video.against_truth["base"] == found.video.against_truth[DECODED_PERSISTENCE]
    assert set(found.video.noise_floor) == {"truth", "decoded_truth"}
    assert "Not JEDi" in decoded_as_dict(found)["video_mmd"]["meaning"]


def test_of_few_clips_there_is_no_video_mmd() -> None:
    batch, trained = encoded(8), decoder(dim=24, tokens=9)
    found = measure_decoded(contenders(Copier()), clips(batch, trained), Decoding(trained, encoder=MODEL))
    assert found.video is None
    assert found.absent["video"] == "8 clips of 4 episodes; it needs 20 clips and 5 episodes"


def test_hands_are_read_from_every_source_and_measured_against_where_they_are() -> None:
    size = TRAINED.card.shape.image_size
    nothing = torch.zeros(3 * 32 * 32, 2).double()
    always_there = HandProbe(nothing[:, 0], nothing, torch.tensor([5.0, 6.0]).double(), (10, 2))
    reader = HandReader(always_there, lambda _, states: np.tile([5.0, 9.0], (len(states), 1)))
    found = measure_decoded(contenders(Copier()), clips(BATCH, TRAINED), Decoding(TRAINED, hand=reader))
    assert found.hand is not None
    assert set(found.hand.pixels) == {"truth", "adapter", DECODED_TRUTH, DECODED_PERSISTENCE}
    assert [one.value for one in hand_of(found, "adapter")] == pytest.approx([3.0] * (TIME - 1))
    assert (found.hand.size, found.hand.mean_position) == (size, 3.0)
    assert hand_of(found, "raw_persistence")[0].reason


def random_lpips() -> Lpips:
    network = Lpips("alex")
    for number, value in enumerate(network.parameters()):
        drawn = torch.rand(value.shape, generator=torch.Generator().manual_seed(number))
        value.copy_(drawn - 0.5 if value.ndim == 4 else drawn)
    return network


NETWORKS = MetricNetworks(lpips=random_lpips())


def test_lpips_of_a_perfect_predictor_is_that_of_the_decoded_truth_and_of_a_copier_that_of_persistence() -> None:
    models = contenders(Oracle(), Copier())
    found = measure_decoded(models, clips(clips_batch(6), TRAINED), Decoding(TRAINED, networks=NETWORKS))
    assert found.lpips is not None
    for reference in REFERENCES:
        for source, neighbour in (("adapter", DECODED_TRUTH), ("base", DECODED_PERSISTENCE)):
            np.testing.assert_array_equal(
                found.lpips.by_clip[source, reference], found.lpips.by_clip[neighbour, reference]
            )
    assert (found.lpips.by_clip["adapter", "decoded_truth"] == 0).all()
    (one, *_) = lpips_of(found, "base", "truth")
    assert one.value == pytest.approx(found.lpips.by_clip["base", "truth"][:, 0].mean())
    assert one.estimate is not None
    assert one.estimate.low < one.value < one.estimate.high
    assert "lpips" not in found.absent


def test_lpips_of_parts_is_that_of_the_images_one_by_one() -> None:
    shown, true = torch.rand(2, 2, IMAGES - 1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    network = random_lpips()
    values = lpips_by_pair(network, {"adapter": shown}, {"truth": true})["adapter", "truth"]
    np.testing.assert_allclose(values, network(shown, true).numpy(), rtol=1e-4)


def test_of_images_below_32_pixels_there_is_no_lpips_but_the_reason() -> None:
    batch = replace(BATCH, latents=BATCH.latents[:, :, :1])
    small = decoder(tokens=1)
    found = measure_decoded(contenders(Copier()), clips(batch, small), Decoding(small, networks=NETWORKS))
    assert found.lpips is None
    reason = decoded_as_dict(found)["models"]["adapter"]["lpips"]["against_truth"][0]["reason"]
    assert reason == "images of 16 pixels; it needs 32 a side"


def test_from_a_cache_lpips_is_against_the_decoded_truth_alone() -> None:
    decoding = Decoding(TRAINED, has_frames=False, networks=NETWORKS)
    found = measure_decoded(contenders(Copier()), clips(clips_batch(6), TRAINED), decoding)
    assert lpips_of(found, "adapter", "decoded_truth")[0].value > 0
    assert "cache" in lpips_of(found, "adapter", "truth")[0].reason
    assert fvd_of(found, "adapter", "truth").value is None


def test_a_model_may_have_the_name_of_a_metric() -> None:
    models = [replace(contenders(Copier())[0], name=name) for name in ("hand", "cycle", "video", "i3d", "lpips")]
    found = measure_decoded(models, clips(clips_batch(6), TRAINED), Decoding(TRAINED))
    assert dict(found.cycle) == {}
    assert similarity_of(found, "cycle", "truth", "whole", "ssim")[0].estimate is not None
