"""Decoded rollouts of several models on the same clips: one pass, batch by batch; only numbers per clip are stored.

Every image comes out of one decoder, in float32 and without autocast, in batches of one shape: a perfect prediction
gives the bits of the decoded truth. Images are compared at the encoder's size, not rounded to 8 bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.data.transforms import images_to_input
from vjepa2_ac.decoding.decoder_folder import TrainedDecoder
from vjepa2_ac.decoding.frame_pairs import as_images, as_pixels
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.decoded.hand import HandPositions, HandProbe
from vjepa2_ac.evaluation.decoded.record import (
    DECODED_PERSISTENCE,
    DECODED_TRUTH,
    RAW_PERSISTENCE,
    TRUE_FRAMES,
    DecodedRollouts,
    DecodedStrip,
    HandErrors,
    Reference,
    VideoDiscrepancy,
)
from vjepa2_ac.evaluation.decoded.similarity import cycle_error, scales_for, similarities
from vjepa2_ac.evaluation.decoded_rollouts.metric_networks import MetricNetworks, frechet_of, lpips_by_pair
from vjepa2_ac.evaluation.distribution.mmd import discrepancy, noise_floor
from vjepa2_ac.evaluation.evaluate import ClipName, Contender, FramesOfRow, RepeatableClips
from vjepa2_ac.evaluation.measure import prediction
from vjepa2_ac.evaluation.result import Example
from vjepa2_ac.evaluation.video.features import MOST_FRAMES, frames_used, video_features
from vjepa2_ac.evaluation.video.record import FrechetVideoDistances, LpipsDistances
from vjepa2_ac.intervals import mean_of
from vjepa2_ac.media.image_similarity import moving_region
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import SILENT, Reporter

LEAST_CLIPS, LEAST_EPISODES = 20, 5
"""Of a video MMD and FVD: of fewer, pairs of episodes say nothing."""

CACHE = "the latents come from a cache, which holds only small frames"
_NO_ENCODER = "the latents come from a cache, and the encoder was set aside"
_TOO_SMALL = "images of {} pixels are too small for its window"
_NOT_ASKED = "no hand positions are known: the data were not simulated, or nobody was asked"


@dataclass(frozen=True, eq=False)
class HandReader:
    """A probe and what it is measured by."""

    probe: HandProbe
    positions: HandPositions


@dataclass(frozen=True, eq=False)
class Decoding:
    """How latents become images, and what the images are measured by."""

    decoder: TrainedDecoder
    has_frames: bool = True  # False: of cached latents there are only small ones
    encoder: WorldModel | None = None  # whose frozen encoder sees the images; None: it was set aside
    chunk: int = 16  # frames that go through the encoder at once
    hand: HandReader | str = _NOT_ASKED  # or the reason why there is none
    networks: MetricNetworks = field(default_factory=MetricNetworks)


def measure_decoded(
    contenders: Sequence[Contender],
    clips: RepeatableClips,
    decoding: Decoding,
    examples: Sequence[Example] = (),
    *,
    reporter: Reporter = SILENT,
) -> DecodedRollouts:
    """Decode the rollouts of all models under the true actions, and measure them beside their neighbours.

    Args:
        contenders: In the order of the table.
        clips: What to measure on; they are read once.
        decoding: The decoder and what else is needed.
        examples: Clips whose images are returned, too.
        reporter: Shows the progress.

    Raises:
        ValueError: No clips.
    """
    wanted = {(one.episode_id, one.start): one for one in examples}
    names = tuple(one.name for one in contenders)
    seen = _Seen(decoding, names, wanted)
    progress = reporter.task("decoded rollouts")
    for batch, frames_of_row in clips.read(None):
        predicted = {one.name: _rollout(one, batch) for one in contenders}
        images = _decoded(batch, predicted, decoding, frames_of_row)
        seen.add(images, batch, predicted)
        seen.keep_strips(images, batch, _shown_models(contenders))
        progress(len(seen.ids), clips.count)
    return seen.result()


@dataclass(frozen=True, eq=False)
class _Images:
    """The images of a batch, in 0 .. 1."""

    sources: Mapping[str, Float[Tensor, "batch horizon 3 size size"]]  # models and neighbours, after frame 0
    decoded_first: Float[Tensor, "batch 1 3 size size"]
    true: Float[Tensor, "batch time 3 size size"] | None  # as the encoder saw them; None: from a cache

    @property
    def references(self) -> dict[Reference, Float[Tensor, "batch horizon 3 size size"]]:
        found: dict[Reference, Tensor] = {"decoded_truth": self.sources[DECODED_TRUTH]}
        return found if self.true is None else {"truth": self.true[:, 1:], **found}

    def video_of(self, source: str) -> Float[Tensor, "batch time 3 size size"]:
        """Return whole clips, the given frame included."""
        if source == TRUE_FRAMES and self.true is not None:
            return self.true
        return torch.cat([self.decoded_first, self.sources[source]], dim=1)


class _Seen:
    """The numbers of each clip so far."""

    def __init__(self, decoding: Decoding, models: tuple[str, ...], wanted: Mapping[ClipName, Example]) -> None:
        self.decoding, self.models, self.wanted = decoding, models, wanted
        self.ids: list[str] = []
        self._arrays: dict[Any, list[np.ndarray]] = {}  # by what it is; [clips, ...]
        self._strips: dict[ClipName, DecodedStrip] = {}
        self._size, self._frames = decoding.decoder.card.shape.image_size, 0

    @torch.no_grad()
    def add(self, images: _Images, batch: LatentBatch, predicted: Mapping[str, Tensor]) -> None:
        """Measure a batch of clips."""
        self.ids += batch.episode_ids
        self._frames = batch.latents.shape[1]
        moving = None if images.true is None else moving_region(images.true)
        if moving is not None:
            self._add(("moving",), moving.float().mean(dim=(-2, -1)).double().cpu().numpy())
        for source, shown in images.sources.items():
            for reference, true in images.references.items():
                for (region, metric), values in similarities(shown, true, moving).items():
                    self._add((source, reference, region, metric), values)
        self._measure_by_networks(images)
        if self.decoding.encoder is not None:
            self._encode(self.decoding.encoder, images, {**predicted, DECODED_TRUTH: batch.latents[:, 1:]})
        if isinstance(self.decoding.hand, HandReader):
            self._read_hands(self.decoding.hand, images, batch)

    def keep_strips(self, images: _Images, batch: LatentBatch, models: Sequence[str]) -> None:
        """Store the images of the clips that are shown."""
        for row, name in enumerate(zip(batch.episode_ids, batch.starts, strict=True)):
            if name in self.wanted:
                kinds = [*((TRUE_FRAMES,) * (images.true is not None)), DECODED_TRUTH, *models]
                rows = {kind: as_pixels(images.video_of(kind)[row]) for kind in kinds}
                self._strips[name] = DecodedStrip(self.wanted[name].why, *name, rows)

    def result(self) -> DecodedRollouts:
        """Return what was measured.

        Raises:
            ValueError: No clips.
        """
        if not self.ids:
            raise ValueError("no clips to decode")
        arrays = {key: np.concatenate(parts) for key, parts in self._arrays.items()}
        video, why_no_video = self._video(arrays)
        hand, why_no_hand = self._hand(arrays)
        lpips, why_no_lpips = self._lpips(arrays)
        fvd, why_no_fvd = self._fvd(arrays)
        return DecodedRollouts(
            decoder=_description(self.decoding.decoder),
            episode_ids=tuple(self.ids),
            models=self.models,
            horizon=self._frames - 1,
            arrays={key: values for key, values in arrays.items() if len(key) == 4},
            moving_share=arrays.get(("moving",)),
            cycle=_by_source(arrays, "cycle"),
            video=video,
            hand=hand,
            lpips=lpips,
            fvd=fvd,
            strips=tuple(self._strips[name] for name in self.wanted if name in self._strips),
            absent=self._absent() | why_no_video | why_no_hand | why_no_lpips | why_no_fvd,
        )

    def _add(self, key: tuple[str, ...], values: np.ndarray) -> None:
        self._arrays.setdefault(key, []).append(values)

    def _encode(self, world_model: WorldModel, images: _Images, latents: Mapping[str, Tensor]) -> None:
        """Encode images again: frame by frame for the cycle error, whole clips for the features of the video MMD."""
        for source, true in latents.items():
            again = world_model.encode(images_to_input(images.sources[source]), chunk=self.decoding.chunk)
            self._add(("cycle", source), cycle_error(again, true))
        if self._frames > MOST_FRAMES:
            return
        for source in self._videos(images):
            inputs = images_to_input(images.video_of(source))
            features = video_features(world_model.present_encoder, inputs, self.decoding.chunk)
            self._add(("video", source), features.double().cpu().numpy())

    def _videos(self, images: _Images) -> list[str]:
        """Return of which sources whole clips are compared."""
        return [*self.models, DECODED_TRUTH, DECODED_PERSISTENCE, *((TRUE_FRAMES,) * (images.true is not None))]

    def _measure_by_networks(self, images: _Images) -> None:
        """Measure images by LPIPS, and clips by I3D, if there are files of them."""
        networks = self.decoding.networks
        if networks.lpips is not None and not networks.why_no_lpips(self._size):
            for pair, values in lpips_by_pair(networks.lpips, images.sources, images.references).items():
                self._add(("lpips", *pair), values)
        if networks.i3d is not None and not networks.why_no_features(self._frames):
            for source in self._videos(images):
                self._add(("i3d", source), networks.i3d.features(images.video_of(source)))

    def _read_hands(self, hand: HandReader, images: _Images, batch: LatentBatch) -> None:
        states = batch.states[:, 1:].double().cpu().numpy()
        true = np.stack([hand.positions(*pair) for pair in zip(batch.episode_ids, states, strict=True)])
        shown = dict(images.sources) | ({} if images.true is None else {TRUE_FRAMES: images.true[:, 1:]})
        shown.pop(RAW_PERSISTENCE, None)
        for source, one in shown.items():
            self._add(("hand", source), np.linalg.norm(hand.probe.read(one) - true, axis=-1))
        self._add(("hand_mean",), np.linalg.norm(hand.probe.offset.numpy() - true, axis=-1))

    def _video(self, arrays: Mapping[Any, np.ndarray]) -> tuple[VideoDiscrepancy | None, dict[str, str]]:
        features = _by_source(arrays, "video")
        if self.decoding.encoder is None:
            return None, {"video": _NO_ENCODER}
        if not features:
            return None, {"video": f"clips of {self._frames} frames; the encoder takes {MOST_FRAMES} at most"}
        if reason := _too_few(self.ids):
            return None, {"video": reason}
        used = frames_used(self._frames)
        against = {
            reference: {
                source: discrepancy(values, features[reference], self.ids)
                for source, values in features.items()
                if source not in {reference, TRUE_FRAMES}
            }
            for reference in (TRUE_FRAMES, DECODED_TRUTH)
            if reference in features
        }
        floors = {name: noise_floor(features[name], self.ids) for name in against}
        notes = (
            () if used == self._frames else (f"The last of {self._frames} frames is left out: tubelets are of two.",)
        )
        found_of_truth = against.get(TRUE_FRAMES, {})
        return VideoDiscrepancy(found_of_truth, against[DECODED_TRUTH], floors, used, notes), {}

    def _hand(self, arrays: Mapping[Any, np.ndarray]) -> tuple[HandErrors | None, dict[str, str]]:
        hand = self.decoding.hand
        if isinstance(hand, str):
            return None, {"hand": hand}
        pixels = _by_source(arrays, "hand")
        if TRUE_FRAMES not in pixels:
            return None, {"hand": CACHE}
        by_clip, mean = np.nanmean(pixels[TRUE_FRAMES], axis=1), float(np.nanmean(arrays["hand_mean",]))
        return HandErrors(pixels, self._size, mean_of(by_clip, self.ids), hand.probe.fitted_on, mean), {}

    def _lpips(self, arrays: Mapping[Any, np.ndarray]) -> tuple[LpipsDistances | None, dict[str, str]]:
        networks = self.decoding.networks
        reason = networks.why_no_lpips(self._size)
        if networks.lpips is None or reason:
            return None, {"lpips": reason}
        by_clip = {key[1:]: values for key, values in arrays.items() if len(key) == 3}
        return LpipsDistances(networks.lpips.backbone, by_clip), {}

    def _fvd(self, arrays: Mapping[Any, np.ndarray]) -> tuple[FrechetVideoDistances | None, dict[str, str]]:
        reason = self.decoding.networks.why_no_features(self._frames) or _too_few(self.ids)
        if reason:
            return None, {"fvd": reason}
        return frechet_of(_by_source(arrays, "i3d"), (TRUE_FRAMES, DECODED_TRUTH), TRUE_FRAMES), {}

    def _absent(self) -> dict[str, str]:
        found = {} if self.decoding.has_frames else {"truth": CACHE}
        if self.decoding.encoder is None:
            found["cycle"] = _NO_ENCODER
        if not scales_for(self._size):
            found |= dict.fromkeys(("ssim", "ms_ssim"), _TOO_SMALL.format(self._size))
        return found


def _rollout(contender: Contender, batch: LatentBatch) -> Float[Tensor, "batch horizon tokens dim"]:
    """Return the frames after the first under the true actions; states are the recorded ones."""
    with contender.switched(), torch.no_grad():
        return prediction(contender.model, batch)


def _by_source(arrays: Mapping[Any, np.ndarray], kind: str) -> dict[str, np.ndarray]:
    """Return what was measured of whole sources; a model may have the name of a kind."""
    return {key[1]: values for key, values in arrays.items() if len(key) == 2 and key[0] == kind}


def _too_few(episode_ids: Sequence[str]) -> str:
    """Return why distributions of clips are not compared; "": there are enough."""
    clips, episodes = len(episode_ids), len(set(episode_ids))
    if clips >= LEAST_CLIPS and episodes >= LEAST_EPISODES:
        return ""
    found = f"{clips} clips of {episodes} episodes"
    return f"{found}; it needs {LEAST_CLIPS} clips and {LEAST_EPISODES} episodes"


@torch.no_grad()
def _decoded(
    batch: LatentBatch, predicted: Mapping[str, Tensor], decoding: Decoding, frames_of_row: FramesOfRow
) -> _Images:
    decoder, latents = decoding.decoder.decoder, batch.latents
    true = _true_frames(batch, frames_of_row, latents.device) if decoding.has_frames else None
    rollouts = {
        **predicted,
        DECODED_TRUTH: latents[:, 1:],
        DECODED_PERSISTENCE: latents[:, :1].expand_as(latents[:, 1:]),
    }
    with torch.autocast(latents.device.type, enabled=False):
        sources = {source: decoder.decode(one.float()) for source, one in rollouts.items()}
        first = decoder.decode(latents[:, :1].float())
    if true is not None:
        sources[RAW_PERSISTENCE] = true[:, :1].expand_as(true[:, 1:])
    return _Images(sources, first, true)


def _true_frames(
    batch: LatentBatch, frames_of_row: FramesOfRow, device: torch.device
) -> Float[Tensor, "batch time 3 size size"]:
    rows = [frames_of_row(row) for row in range(len(batch.starts))]
    pixels = torch.from_numpy(np.stack([row for row in rows if row is not None])).to(device)
    return as_images(rearrange(pixels, "batch time h w c -> batch time c h w"))


def _shown_models(contenders: Sequence[Contender]) -> list[str]:
    """Return the models whose images are shown: base and trained."""
    return [one.name for one in contenders if one.role != "other"]


def _description(trained: TrainedDecoder) -> dict[str, Any]:
    card = trained.card
    kept = ("encoder", "crop", "data", "cameras", "episodes", "frames", "steps", "held_out")
    return {"folder": trained.name, "size": card.shape.size} | {name: asdict(card)[name] for name in kept}
