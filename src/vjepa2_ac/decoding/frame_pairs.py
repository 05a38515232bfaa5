"""The training data of a decoder (pairs of frame and latents), the linear and mean-image baselines, and metrics.

Frames and latents are stored in files of a latent cache. The frames have the crop and size of the encoder's input.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.sources.latent_files import LatentFiles, unpack_latents
from vjepa2_ac.data.windows import spread_indices
from vjepa2_ac.decoding.decoder import Decoder, DecoderShape, to_images
from vjepa2_ac.encoding.latent_cache import FramesToEncode, needed_frames
from vjepa2_ac.episode import Progress
from vjepa2_ac.intervals import estimate_mean
from vjepa2_ac.media.image_similarity import psnr, ssim


@dataclass(frozen=True)
class PairBatch:
    """Frames with their latents, and the episode of each frame."""

    latents: Float[Tensor, "frames tokens dim"]
    images: UInt8[Tensor, "frames 3 size size"]  # the encoder's input
    episode_ids: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class FramePairs:
    """Pairs of frame and latents in files, read by index."""

    files: LatentFiles
    frames: tuple[FramesToEncode, ...]  # frames of each file, at least one per file
    episode_ids: tuple[str, ...]  # episode of each file

    @classmethod
    def from_files(cls, dataset: Dataset, selected: Sequence[FramesToEncode], files: LatentFiles) -> FramePairs:
        """Return pairs for those selected frames whose file exists."""
        encoded = tuple(frames for frames in selected if files.has_file(frames.episode, frames.camera))
        return cls(files, encoded, tuple(dataset.table.identity(frames.episode) for frames in encoded))

    @cached_property
    def _ends(self) -> Int[np.ndarray, " files"]:
        return np.cumsum([len(frames.steps) for frames in self.frames])

    def __len__(self) -> int:
        return int(self._ends[-1]) if self.frames else 0

    def read(self, indices: Sequence[int]) -> PairBatch:
        """Read the pairs with these indices, in this order.

        Raises:
            InputError: A file is missing or damaged.
        """
        file_indices = np.searchsorted(self._ends, indices, side="right").tolist()
        files = {
            file_index: self.files.open(self.frames[file_index].episode, self.frames[file_index].camera)
            for file_index in set(file_indices)
        }
        latents, images = list[Tensor](), list[Tensor]()
        for index, file_index in zip(indices, file_indices, strict=True):
            row = int(index - self._ends[file_index]) + len(self.frames[file_index].steps)
            latents.append(unpack_latents(files[file_index].read_latents([row])))
            images.append(torch.from_numpy(files[file_index].read_images([row])).permute(0, 3, 1, 2))
        ids = tuple(self.episode_ids[file_index] for file_index in file_indices)
        return PairBatch(torch.cat(latents), torch.cat(images).contiguous(), ids)


def select_frames(dataset: Dataset, split: Split, *, frames: int) -> list[FramesToEncode]:
    """Select up to `frames` frames of a split, spread evenly over its episodes and cameras.

    Only frames that clips use are selected. The list is empty if the split has no clips.
    """
    is_member = dataset.split_mask(split)
    candidates = [entry for entry in needed_frames(dataset) if is_member[entry.episode]]
    total = sum(len(entry.steps) for entry in candidates)
    positions, first = np.linspace(0, total, min(frames, total), endpoint=False).astype(int), 0
    selected = []
    for entry in candidates:
        count = int(((positions >= first) & (positions < first + len(entry.steps))).sum())
        first += len(entry.steps)
        if count:
            steps = entry.steps[spread_indices(len(entry.steps), count)]
            selected.append(FramesToEncode(entry.episode, entry.camera, steps))
    return selected


_FIT_FRAMES = 4_000  # maximum number of frames for the linear fit; enough for a matrix of 1,408 x 768 numbers
_MEAN_IMAGE_FRAMES = 1_000
_FIT_BATCH_SIZE, _MEASURE_BATCH_SIZE = 64, 32
_RIDGE = 1e-4  # ridge, relative to the mean second moment of the latents' components


@torch.no_grad()
def fit_linear(pairs: FramePairs, shape: DecoderShape, device: torch.device, progress: Progress) -> Decoder:
    """Fit the linear decoder by least squares with a small ridge penalty.

    The fit is a linear probe: everything that the decoder reconstructs is linearly decodable from single tokens.

    Args:
        pairs: Frames and their latents.
        shape: Shape of the decoder; its `size` is not used.
        device: Device of the matrix products.
        progress: Called with (done, total) in frames.
    """
    decoder = Decoder(DecoderShape("linear", shape.dim, shape.grid, shape.patch_size))
    indices = spread_indices(len(pairs), _FIT_FRAMES)
    # The normal equations: moments @ solution = products.
    moments: Float[Tensor, "dim+1 dim+1"] = torch.zeros(shape.dim + 1, shape.dim + 1, dtype=torch.float64)
    products: Float[Tensor, "dim+1 pixels"] = torch.zeros(shape.dim + 1, 3 * shape.patch_size**2, dtype=torch.float64)
    num_read = 0
    for batch in _read_batches(pairs, indices, _FIT_BATCH_SIZE):
        tokens = batch.latents.to(device).flatten(0, 1)
        tokens = torch.cat([tokens, torch.ones_like(tokens[:, :1])], dim=1)
        outputs = decoder.to_outputs(to_images(batch.images.to(device)))
        patches = rearrange(
            outputs, "n c (rows p) (columns q) -> (n rows columns) (c p q)", p=shape.patch_size, q=shape.patch_size
        )
        moments += (tokens.T @ tokens).cpu()
        products += (tokens.T @ patches).cpu()
        num_read += len(batch.episode_ids)
        progress(num_read, len(indices))
    ridge = _RIDGE * moments.diagonal()[:-1].mean()
    moments.diagonal()[:-1] += ridge
    solution = torch.linalg.solve(moments, products).float()
    weight, bias = solution[:-1].T.contiguous(), solution[-1].contiguous()
    decoder.linear.load_state_dict({"weight": weight, "bias": bias})
    return decoder.eval().requires_grad_(False)


@torch.no_grad()
def compute_mean_image(pairs: FramePairs) -> Float[Tensor, "3 size size"]:
    """Return the mean of up to 1,000 frames, a baseline that ignores the latents."""
    indices = spread_indices(len(pairs), _MEAN_IMAGE_FRAMES)
    total = sum(to_images(batch.images).sum(dim=0) for batch in _read_batches(pairs, indices, _MEASURE_BATCH_SIZE))
    return torch.as_tensor(total / len(indices))


@torch.no_grad()
def measure_decoders(
    pairs: FramePairs, decoders: dict[str, Decoder], mean: Float[Tensor, "3 size size"], progress: Progress
) -> dict[str, Any]:
    """Measure PSNR (dB) and SSIM of each decoder and of the mean image, with intervals over episodes.

    The PSNR of an exactly reconstructed frame is infinite. Such frames are left out of the mean PSNR, but counted.

    Args:
        pairs: Held-out frames.
        decoders: Decoders by name, on one device.
        mean: Mean image of the training frames.
        progress: Called with (done, total) in frames.
    """
    metrics_by_name: dict[str, list[np.ndarray]] = defaultdict(list)
    ids: list[str] = []
    device = next(next(iter(decoders.values())).parameters()).device
    for batch in _read_batches(pairs, range(len(pairs)), _MEASURE_BATCH_SIZE):
        latents, true = batch.latents.to(device), to_images(batch.images.to(device))
        decoded = {name: decoder.decode(latents) for name, decoder in decoders.items()}
        decoded["mean_image"] = mean.to(device).expand_as(true)
        for name, images in decoded.items():
            metrics_by_name[name].append(torch.stack([psnr(images, true), ssim(images, true)]).double().cpu().numpy())
        ids += batch.episode_ids
        progress(len(ids), len(pairs))
    means: dict[str, Any] = {"frames": len(ids), "episodes": len(set(ids))}
    for name, batches in metrics_by_name.items():
        psnr_db, similarity = np.concatenate(batches, axis=1)
        is_finite = np.isfinite(psnr_db)
        means[name] = {
            "psnr_db": estimate_mean(psnr_db[is_finite], np.array(ids)[is_finite].tolist()).as_dict(),
            "ssim": estimate_mean(similarity, ids).as_dict(),
            "exact_frames": int((~is_finite).sum()),
        }
    return means


def _read_batches(pairs: FramePairs, indices: Sequence[int], size: int) -> Iterator[PairBatch]:
    """Yield batches of at most `size` pairs."""
    for first in range(0, len(indices), size):
        yield pairs.read(indices[first : first + size])
