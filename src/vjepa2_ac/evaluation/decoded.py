"""Measure decoded rollouts of several models on the same clips, and baselines: PSNR, SSIM and Fréchet distance.

Images are compared with two references: the camera's frames (*truth*), and the decoded true latents (*decoded truth*),
which exclude the decoder's error. PSNR and SSIM reward blur: an object that is smeared over all possible positions is
rated better than a sharp object in a wrong position. Both metrics are therefore also computed for the moving region
only, and should be read together with `spread`.

All images are decoded by the same decoder in float32, without autocast and in batches of equal shape, so that a perfect
prediction equals the decoded truth bit for bit. Images are compared at the encoder's input size, without rounding to 8
bits. The clips are read once, batch by batch, and only the values per clip are stored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TypeVar

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.decoding.decoder import TrainedDecoder, to_images, to_pixels
from vjepa2_ac.distributed import gather_shared
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.distribution import frechet_distance
from vjepa2_ac.evaluation.evaluate import ClipName, EvaluatedModel, FramesOfRow, RepeatableClips
from vjepa2_ac.evaluation.measure import predict_frames
from vjepa2_ac.evaluation.result import DecodedRollouts, DecodedStrip, Example
from vjepa2_ac.intervals import Estimate, estimate_ratios
from vjepa2_ac.media.image_similarity import masked_mean, moving_region, psnr, ssim_map
from vjepa2_ac.reporter import SILENT, Reporter

DECODED_TRUTH, DECODED_PERSISTENCE, RAW_PERSISTENCE = "decoded_truth", "decoded_persistence", "raw_persistence"
BASELINES = (DECODED_TRUTH, DECODED_PERSISTENCE, RAW_PERSISTENCE)
TRUE_FRAMES = "truth"
_CACHE = "Nothing is compared with true frames: the latents come from a cache, which contains only small frames."
_LEFT_OUT = "clips are left out of the mean, since their images are identical or nothing moves."

Images = Float[Tensor, "batch horizon 3 size size"]
_Key = TypeVar("_Key")
Encode = Callable[[Images], Float[Tensor, "batch horizon tokens dim"]]


@torch.no_grad()
def measure_decoded(
    evaluated_models: Sequence[EvaluatedModel],
    clips: RepeatableClips,
    decoder: TrainedDecoder,
    examples: Sequence[Example] = (),
    *,
    encode: Encode | None = None,
    reporter: Reporter = SILENT,
) -> DecodedRollouts:
    """Decode the rollouts of all models with the true actions, and measure them and the baselines in `BASELINES`.

    Args:
        evaluated_models: The models, in the order of the table.
        clips: The clips, which are read once.
        decoder: Decodes latents to images.
        examples: Clips whose images are returned in addition.
        encode: The frozen encoder, for the Fréchet distance of images; None: it is not measured.
        reporter: Shows the progress.
    """
    progress = reporter.task("decoded rollouts")
    examples_by_clip = {(example.episode_id, example.start): example for example in examples}
    strip_models = [each.name for each in evaluated_models if each.role != "other"]
    ids: list[str] = []
    values: dict[tuple[str, str], list[Float[np.ndarray, "batch horizon"]]] = {}  # by source and metric
    strips: dict[ClipName, DecodedStrip] = {}
    features: dict[str, list[Float[np.ndarray, "batch dim"]]] = {}  # by source
    for batch, frames_of_row in clips.read(None):
        images = _decode_batch(batch, evaluated_models, decoder, frames_of_row if clips.has_frames else None)
        ids += batch.episode_ids
        for key, batch_values in _measure_images(images).items():
            values.setdefault(key, []).append(batch_values.double().cpu().numpy())
        if encode is not None:
            encoded = {name: encode(decoded) for name, decoded in images.sources.items() if name != RAW_PERSISTENCE}
            for source, latents in {TRUE_FRAMES: batch.latents[:, 1:], **encoded}.items():
                features.setdefault(source, []).append(latents.mean(dim=(1, 2)).double().cpu().numpy())
        for row, clip in enumerate(zip(batch.episode_ids, batch.starts, strict=True)):
            if clip in examples_by_clip:
                strips[clip] = images.make_strip(row, examples_by_clip[clip], strip_models)
        progress(len(ids), len(clips.names))
    arrays, features_by_source = (_concatenate(gather_shared([each] if ids else [])) for each in (values, features))
    ids, strips = gather_shared(ids), dict(gather_shared(list(strips.items())))
    left_out = {}
    for (source, name), array in arrays.items():
        count = int((~np.isfinite(array[:, -1])).sum())
        if count and not (name.endswith(DECODED_TRUTH) and source == DECODED_TRUTH):  # always identical to itself
            left_out[name] = f"{name}, at the last horizon: {count} {_LEFT_OUT}"
    card, sources = decoder.card, (*BASELINES, *(evaluated_model.name for evaluated_model in evaluated_models))
    card_keys = ("encoder", "crop", "data", "cameras", "episodes", "frames", "steps", "held_out")
    return DecodedRollouts(
        decoder={"folder": decoder.name, "size": card.shape.size} | {name: asdict(card)[name] for name in card_keys},
        sources=tuple(name for name in sources if name in {source for source, _ in arrays}),
        curves={key: _average(array, ids) for key, array in arrays.items()},
        fvd={
            source: frechet_distance(array, features_by_source[TRUE_FRAMES])
            for source, array in features_by_source.items()
            if source != TRUE_FRAMES
        },
        strips=tuple(strips[name] for name in examples_by_clip if name in strips),
        notes=(*([] if clips.has_frames else [_CACHE]), *left_out.values()),
    )


@dataclass(frozen=True, eq=False)
class _Images:
    """The decoded and true images of a batch of clips, with values from 0 to 1."""

    sources: Mapping[str, Images]  # baselines and models, without frame 0
    decoded_first: Float[Tensor, "batch 1 3 size size"]
    true: Float[Tensor, "batch time 3 size size"] | None  # the encoder's input; None for cached latents

    def make_strip(self, row: int, example: Example, models: Sequence[str]) -> DecodedStrip:
        """Return the images of one clip of the batch, frame 0 included."""
        rows = {} if self.true is None else {TRUE_FRAMES: to_pixels(self.true[row])}
        for source in (DECODED_TRUTH, *models):
            rows[source] = to_pixels(torch.cat([self.decoded_first[row], self.sources[source][row]]))
        return DecodedStrip(example.why, example.episode_id, example.start, rows)


def _decode_batch(
    batch: LatentBatch,
    evaluated_models: Sequence[EvaluatedModel],
    trained: TrainedDecoder,
    frames_of_row: FramesOfRow | None,
) -> _Images:
    decoder, latents = trained.decoder, batch.latents
    rollouts = {DECODED_TRUTH: latents[:, 1:], DECODED_PERSISTENCE: latents[:, :1].expand_as(latents[:, 1:])}
    for evaluated_model in evaluated_models:
        with evaluated_model.prediction_context():
            rollouts[evaluated_model.name] = predict_frames(evaluated_model.model, batch)
    with torch.autocast(latents.device.type, enabled=False):
        sources = {source: decoder.decode(rollout.float()) for source, rollout in rollouts.items()}
        first = decoder.decode(latents[:, :1].float())
    if frames_of_row is None:
        return _Images(sources, first, None)
    rows = [frames_of_row(row) for row in range(len(batch.starts))]
    pixels = torch.from_numpy(np.stack([row for row in rows if row is not None])).to(latents.device)
    true = to_images(rearrange(pixels, "batch time h w c -> batch time c h w"))
    return _Images({**sources, RAW_PERSISTENCE: true[:, :1].expand_as(true[:, 1:])}, first, true)


def _measure_images(images: _Images) -> dict[tuple[str, str], Float[Tensor, "batch horizon"]]:
    """Return the values of all metrics; the key is a source, and a metric such as psnr_db.moving.truth.

    The PSNR of identical images is infinite. If nothing moves, the values of the moving region are NaN.
    """
    references, moving = {DECODED_TRUTH: images.sources[DECODED_TRUTH]}, None
    if images.true is not None:
        references, moving = {TRUE_FRAMES: images.true[:, 1:], **references}, moving_region(images.true)
    regions = {"whole": None} if moving is None else {"whole": None, "moving": moving}
    metrics: dict[tuple[str, str], Tensor] = {}
    for reference, true in references.items():
        for source, decoded in images.sources.items():
            similarity = ssim_map(decoded, true)
            for region, mask in regions.items():
                metrics[source, f"psnr_db.{region}.{reference}"] = psnr(decoded, true, mask)
                metrics[source, f"ssim.{region}.{reference}"] = masked_mean(similarity, mask)
    return metrics


def _concatenate(parts: Sequence[Mapping[_Key, Sequence[np.ndarray]]]) -> dict[_Key, np.ndarray]:
    """Concatenate the arrays of all processes and batches."""
    return {key: np.concatenate([array for part in parts for array in part[key]]) for key in parts[0]}


def _average(values: Float[np.ndarray, "clips horizon"], ids: Sequence[str]) -> tuple[Estimate, ...]:
    """Return the mean at each horizon, over the clips whose value is finite."""
    finite = np.isfinite(values)
    return estimate_ratios(np.where(finite, values, 0.0), finite.astype(np.float64), ids)
