"""Decoded rollouts of several models on the same clips: PSNR, SSIM and LPIPS beside their neighbours.

Two references: the *truth* is what a user sees, the *decoded truth* (the same decoder on the true latents) tells what
the model did. PSNR and SSIM reward blur: an object that is smeared over every place where it may be scores better than
a sharp one in the wrong place. They are therefore given where something moves, too, and beside `spread`.

Every image comes out of one decoder, in float32 and without autocast, in batches of one shape: a perfect prediction
gives the bits of the decoded truth. Images are compared at the encoder's size, not rounded to 8 bits. One pass, batch
by batch: only numbers per clip are stored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from vjepa2_ac.decoding.decoder_folder import TrainedDecoder
from vjepa2_ac.decoding.network import as_images, as_pixels
from vjepa2_ac.distributed import gathered
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.evaluate import ClipName, Contender, FramesOfRow, RepeatableClips
from vjepa2_ac.evaluation.measure import prediction
from vjepa2_ac.evaluation.result import DecodedRollouts, DecodedStrip, Example
from vjepa2_ac.intervals import Estimate, ratios
from vjepa2_ac.media.image_similarity import mean_where, moving_region, psnr, ssim_map
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.storage import require_content

DECODED_TRUTH, DECODED_PERSISTENCE, RAW_PERSISTENCE = "decoded_truth", "decoded_persistence", "raw_persistence"
NEIGHBOURS = (DECODED_TRUTH, DECODED_PERSISTENCE, RAW_PERSISTENCE)
TRUE_FRAMES = "truth"
_LPIPS_AT_ONCE = 8  # images of each source: of VGG, 256 pixels and six sources they take 1.6 GB
_CACHE = "Nothing is compared with true frames: the latents come from a cache, which holds only small ones."
_LEFT_OUT = "clips are left out of the mean, since their images are identical or nothing moves."

Images = Float[Tensor, "batch horizon 3 size size"]


def measure_decoded(
    contenders: Sequence[Contender],
    clips: RepeatableClips,
    decoder: TrainedDecoder,
    examples: Sequence[Example] = (),
    *,
    lpips: Lpips | None = None,
    reporter: Reporter = SILENT,
) -> DecodedRollouts:
    """Decode the rollouts of all models under the true actions, and measure them beside their neighbours.

    Args:
        contenders: In the order of the table.
        clips: What to measure on; they are read once.
        decoder: Makes images of latents.
        examples: Clips whose images are returned, too.
        lpips: None: no files were named.
        reporter: Shows the progress.
    """
    progress = reporter.task("decoded rollouts")
    wanted = {(one.episode_id, one.start): one for one in examples}
    shown = [one.name for one in contenders if one.role != "other"]
    ids: list[str] = []
    values: dict[tuple[str, str], list[Float[np.ndarray, "batch horizon"]]] = {}  # by source and metric
    strips: dict[ClipName, DecodedStrip] = {}
    for batch, frames_of_row in clips.read(None):
        images = _decoded(batch, contenders, decoder, frames_of_row if clips.has_frames else None)
        ids += batch.episode_ids
        for key, metric in _measured(images, lpips).items():
            values.setdefault(key, []).append(metric.double().cpu().numpy())
        for row, clip in enumerate(zip(batch.episode_ids, batch.starts, strict=True)):
            if clip in wanted:
                strips[clip] = images.strip(row, wanted[clip], shown)
        progress(len(ids), len(clips.names))
    parts = gathered([values] if ids else [])
    arrays = {key: np.concatenate([array for part in parts for array in part[key]]) for key in parts[0]}
    ids, strips = gathered(ids), dict(gathered(list(strips.items())))
    left_out = {}
    for (source, name), array in arrays.items():
        count = int((~np.isfinite(array[:, -1])).sum())
        if count and not (name.endswith(DECODED_TRUTH) and source == DECODED_TRUTH):  # its own reference
            left_out[name] = f"{name}, at the last horizon: {count} {_LEFT_OUT}"
    card, sources = decoder.card, (*NEIGHBOURS, *(one.name for one in contenders))
    kept = ("encoder", "crop", "data", "cameras", "episodes", "frames", "steps", "held_out")
    return DecodedRollouts(
        decoder={"folder": decoder.name, "size": card.shape.size} | {name: asdict(card)[name] for name in kept},
        sources=tuple(one for one in sources if one in {source for source, _ in arrays}),
        curves={key: _means(found, ids) for key, found in arrays.items()},
        strips=tuple(strips[name] for name in wanted if name in strips),
        notes=(*([] if clips.has_frames else [_CACHE]), *left_out.values()),
    )


@dataclass(frozen=True, eq=False)
class _Images:
    """The images of a batch, in 0 .. 1."""

    sources: Mapping[str, Images]  # neighbours and models, after frame 0
    decoded_first: Float[Tensor, "batch 1 3 size size"]
    true: Float[Tensor, "batch time 3 size size"] | None  # as the encoder saw them; None: from a cache

    def strip(self, row: int, example: Example, models: Sequence[str]) -> DecodedStrip:
        """Return whole clips of one row, the given frame included."""
        rows = {} if self.true is None else {TRUE_FRAMES: as_pixels(self.true[row])}
        for source in (DECODED_TRUTH, *models):
            rows[source] = as_pixels(torch.cat([self.decoded_first[row], self.sources[source][row]]))
        return DecodedStrip(example.why, example.episode_id, example.start, rows)


@torch.no_grad()
def _decoded(
    batch: LatentBatch, contenders: Sequence[Contender], trained: TrainedDecoder, frames_of_row: FramesOfRow | None
) -> _Images:
    decoder, latents = trained.decoder, batch.latents
    rollouts = {DECODED_TRUTH: latents[:, 1:], DECODED_PERSISTENCE: latents[:, :1].expand_as(latents[:, 1:])}
    for one in contenders:
        with one.switched():
            rollouts[one.name] = prediction(one.model, batch)
    with torch.autocast(latents.device.type, enabled=False):
        sources = {source: decoder.decode(one.float()) for source, one in rollouts.items()}
        first = decoder.decode(latents[:, :1].float())
    if frames_of_row is None:
        return _Images(sources, first, None)
    rows = [frames_of_row(row) for row in range(len(batch.starts))]
    pixels = torch.from_numpy(np.stack([row for row in rows if row is not None])).to(latents.device)
    true = as_images(rearrange(pixels, "batch time h w c -> batch time c h w"))
    return _Images({**sources, RAW_PERSISTENCE: true[:, :1].expand_as(true[:, 1:])}, first, true)


@torch.no_grad()
def _measured(images: _Images, lpips: Lpips | None) -> dict[tuple[str, str], Float[Tensor, "batch horizon"]]:
    """Return every metric of every source and reference.

    PSNR of identical images is infinite; where nothing moves, the region's values are NaN.
    """
    references, moving = {DECODED_TRUTH: images.sources[DECODED_TRUTH]}, None
    if images.true is not None:
        references, moving = {TRUE_FRAMES: images.true[:, 1:], **references}, moving_region(images.true)
    regions = {"whole": None} if moving is None else {"whole": None, "moving": moving}
    found: dict[tuple[str, str], Tensor] = {}
    for reference, true in references.items():
        for source, shown in images.sources.items():
            similar = ssim_map(shown, true)
            for region, where in regions.items():
                found[source, f"psnr_db.{region}.{reference}"] = psnr(shown, true, where)
                found[source, f"ssim.{region}.{reference}"] = mean_where(similar, where)
    if moving is not None:
        found[TRUE_FRAMES, "moving_share"] = moving.float().mean(dim=(-2, -1))
    if lpips is not None:
        found |= lpips.of_pairs(images.sources, references)
    return found


def _means(values: Float[np.ndarray, "clips horizon"], ids: Sequence[str]) -> tuple[Estimate, ...]:
    """Return means over the clips that have a value."""
    finite = np.isfinite(values)
    return ratios(np.where(finite, values, 0.0), finite.astype(np.float64), ids)


Backbone = Literal["alex", "vgg"]
Features = list[Float[Tensor, "images channels rows columns"]]  # from fine to coarse
_COMPARED: dict[Backbone, tuple[tuple[int, ...], tuple[int, ...]]] = {  # ReLUs, and how many channels they have
    "alex": ((1, 4, 7, 9, 11), (64, 192, 384, 256, 256)),
    "vgg": ((3, 8, 15, 22, 29), (64, 128, 256, 512, 512)),
}


class Lpips(nn.Module):
    """How far apart two images look to a network trained on photographs; 0 is identical. Frozen, in float32.

    Squared differences of normalised features, weighted by channel, mean over places. It equals lpips 0.1.4 (version
    0.1), without torchvision: no weights are shipped or downloaded. `alex` is the metric that people compare.

    Source: Zhang et al. (2018), The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, equation 1;
    constants of richzhang/PerceptualSimilarity @ 082bb24, lpips/lpips.py.
    """

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone, (self.compared, widths) = backbone, _COMPARED[backbone]
        self.features = _alexnet() if backbone == "alex" else _vgg16()
        self.heads = nn.ParameterList([nn.Parameter(torch.zeros(width)) for width in widths])
        self.mean = nn.Buffer(torch.tensor([-0.030, -0.088, -0.188])[:, None, None])  # of images in -1 .. 1
        self.deviation = nn.Buffer(torch.tensor([0.458, 0.448, 0.450])[:, None, None])
        self.requires_grad_(False).eval()

    def seen(self, images: Float[Tensor, "images 3 height width"]) -> Features:
        """Return the compared features of images in 0 .. 1: each place of length 1 over channels."""
        with torch.autocast(images.device.type, enabled=False):
            values, found = (2 * images.float() - 1 - self.mean) / self.deviation, []
            for place, layer in enumerate(self.features):
                values = layer(values)
                if place in self.compared:
                    found.append(values / (torch.linalg.vector_norm(values, dim=1, keepdim=True) + 1e-10))
            return found

    def distance(self, one: Features, other: Features) -> Float[Tensor, " images"]:
        """Return the distance of each pair of images, from their features."""
        with torch.autocast(one[0].device.type, enabled=False):
            levels = [
                torch.einsum("nchw,c->nhw", (mine - its).square(), head).mean(dim=(1, 2))
                for mine, its, head in zip(one, other, self.heads, strict=True)
            ]
            return torch.stack(levels).sum(dim=0)

    def of_pairs(
        self, sources: Mapping[str, Images], references: Mapping[str, Images]
    ) -> dict[tuple[str, str], Float[Tensor, "batch horizon"]]:
        """Return the distance of every source to every reference; features are computed once of each."""
        images = {name: one.float().flatten(0, 1) for name, one in {**references, **sources}.items()}
        batch, horizon = next(iter(sources.values())).shape[:2]
        parts: dict[tuple[str, str], list[Tensor]] = {(one, other): [] for one in sources for other in references}
        for first in range(0, batch * horizon, _LPIPS_AT_ONCE):
            seen = {name: self.seen(one[first : first + _LPIPS_AT_ONCE]) for name, one in images.items()}
            for (one, other), found in parts.items():
                found.append(self.distance(seen[one], seen[other]))
        return {
            (one, f"lpips.whole.{other}"): torch.cat(found).reshape(batch, horizon)
            for (one, other), found in parts.items()
        }


def load_lpips(backbone: Path, heads: Path) -> Lpips:
    """Return LPIPS with the weights of two files, of which nothing is unpickled but tensors.

    Args:
        backbone: torchvision's alexnet-owt-7be5be79.pth or vgg16-397923af.pth.
        heads: Of lpips 0.1.4: weights/v0.1/alex.pth or vgg.pth.

    Raises:
        InputError: A file cannot be read, or is another one.
    """
    for path in (backbone, heads):
        require_content(path)
    try:
        weights, of_heads = (torch.load(path, map_location="cpu", weights_only=True) for path in (backbone, heads))
        network = Lpips("alex" if "features.10.bias" in weights and "features.28.bias" not in weights else "vgg")
        network.features.load_state_dict({
            name.removeprefix("features."): one for name, one in weights.items() if name.startswith("features")
        })  # fmt: skip
        found = {f"heads.{number}": one.flatten() for number, one in enumerate(of_heads.values())}
        network.load_state_dict(network.state_dict() | found)
    except Exception as error:  # damaged and other files raise errors of many kinds
        needed = "torchvision's AlexNet or VGG16, and the heads of LPIPS for the same one (docs/decoding.md)"
        where = f"--lpips {backbone} --lpips-heads {heads}"
        raise InputError(where=where, found=f"cannot be read ({error})", needed=needed) from None
    return network


def _alexnet() -> nn.Sequential:
    """Return the convolutions of torchvision's AlexNet, by its names."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(),
    )  # fmt: skip


def _vgg16() -> nn.Sequential:
    """Return the convolutions of torchvision's VGG16, by its names."""
    layers: list[nn.Module] = []
    inputs = 3
    for block, (count, outputs) in enumerate(((2, 64), (2, 128), (3, 256), (3, 512), (3, 512))):
        layers += [nn.MaxPool2d(2)] * bool(block)
        for _ in range(count):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
            inputs = outputs
    return nn.Sequential(*layers)
