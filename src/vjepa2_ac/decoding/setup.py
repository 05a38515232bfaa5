"""What the training of a decoder needs before its first step, cheap failures first."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from vjepa2_ac.config import Config, DecoderConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips.dataset import Dataset, open_dataset
from vjepa2_ac.data.clips.windows import require_stride
from vjepa2_ac.data.sources.latents.cache_files import LatentFiles, Layout, bytes_per_frame
from vjepa2_ac.data.sources.latents.cache_key import CacheKey, require_own_folder
from vjepa2_ac.decoding.decoder_folder import CARD, read_card
from vjepa2_ac.decoding.frame_pairs import wanted_frames
from vjepa2_ac.decoding.network import UPSAMPLED, Decoder, DecoderShape
from vjepa2_ac.decoding.steps import SMALLEST, Autocast, DecoderSteps
from vjepa2_ac.distributed.device import autocast, computing_device
from vjepa2_ac.encoding.batch import encoding_of
from vjepa2_ac.encoding.latent_cache import key_for, require_space
from vjepa2_ac.encoding.pipeline import EncoderOnDevice, FramesToEncode
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, Reporter
from vjepa2_ac.runs.lock import RunLock
from vjepa2_ac.storage import try_writing_at, user_can_write, write_atomically

KEY, PAIRS = "key.json", "pairs"


@dataclass(frozen=True, eq=False)
class Setup:
    """A decoder that can be trained."""

    config: Config
    folder: Path
    shape: DecoderShape
    encoder: str  # its fingerprint
    device: torch.device
    dataset: Dataset
    on_device: EncoderOnDevice
    wanted: dict[Split, list[FramesToEncode]]
    pairs: LatentFiles  # frames and latents, while it is trained
    autocast: Autocast
    is_done: bool  # the folder holds the decoder already

    @property
    def decoder(self) -> DecoderConfig:
        """How it is trained."""
        return self.config.decoder

    def steps_from(self, linear: Decoder | None) -> DecoderSteps:
        """Return its first optimizer steps, from the linear decoder or from fresh weights."""
        return DecoderSteps(self.shape, self.decoder, self.config.seed, self.device, self.autocast, linear)


@contextlib.contextmanager
def setup(config: Config, reporter: Reporter, *, check_only: bool) -> Iterator[Setup]:
    """Check config, folder, data, model and disk, and hold the folder's lock to the end of the block.

    Raises:
        InputError: One of them cannot be used.
    """
    named = config.decoder.folder
    folder = Path(config.run_dir).parent / "decoder" if named is None else Path(named)
    _require_frames(config)
    device = computing_device(config.training)
    with user_can_write(folder):
        try_writing_at(folder)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    wanted = _wanted(dataset, config.decoder)
    model = load_base(config.model, seed=config.seed)
    shape, encoding = _shape_for(model, config.decoder), encoding_of(model, config)
    key = CacheKey({
        "decoder": config.decoder.model_dump(mode="json", exclude={"folder", "checkpoint_every"}),
        "seed": config.seed,
        "latents": dict(key_for(dataset, encoding).parts),
        "data": config.data.model_dump(mode="json", include={"validation_share", "test_share", "split_by"}),
    })  # fmt: skip
    require_own_folder(folder / KEY, key, content="a decoder")
    layout = Layout(key.digest, config.data.cache_dtype, encoding.tokens, encoding.dim)
    ready = Setup(
        config=config,
        folder=folder,
        shape=shape,
        encoder=encoding.encoder,
        device=device,
        dataset=dataset,
        on_device=EncoderOnDevice.of(config, model, device),
        wanted=wanted,
        pairs=LatentFiles(folder / PAIRS, layout),
        autocast=_autocast(config, device),
        is_done=(folder / CARD).is_file(),
    )
    with RunLock(folder) as lock:
        if ready.is_done:
            read_card(folder)
            reporter.note(f"The decoder is there already, in {folder}")
        else:
            _require_space(ready, reporter)
            if not check_only:
                lock.take()
                with user_can_write(folder):
                    write_atomically(folder / KEY, json.dumps({"key": dict(key.parts)}, indent=1) + "\n")
        yield ready


def _wanted(dataset: Dataset, decoder: DecoderConfig) -> dict[Split, list[FramesToEncode]]:
    """Return the frames of each split; the test split may be empty."""
    found: dict[Split, list[FramesToEncode]] = {
        "train": wanted_frames(dataset, "train", frames=decoder.frames),
        "test": wanted_frames(dataset, "test", frames=decoder.held_out_frames),
    }
    if not found["train"]:
        raise InputError(
            where=f"data.path: {dataset.config.path}",
            found="no frames of train episodes",
            needed="one episode or more that is as long as a clip",
            fix="Lower data.validation_share or data.test_share",
        )
    return found


def _require_space(ready: Setup, reporter: Reporter) -> None:
    layout = ready.pairs.layout
    per_frame = bytes_per_frame(layout.tokens, layout.dim, layout.kind) + 3 * ready.shape.image_size**2
    everything = [one for some in ready.wanted.values() for one in some]
    frames, left = (
        sum(len(one.steps) for one in some)
        for some in (everything, [one for one in everything if not ready.pairs.has(one.episode, one.camera)])
    )
    fix = "Lower decoder.frames, set data.cache_dtype: int8, or put decoder.folder on a larger disk"
    require_space(ready.folder, left, per_frame, fix=fix)
    taken = left * per_frame / 1e9
    reporter.note(f"{frames:,} frames; {taken:.3g} GB of disk for them and their latents, while training")


def _autocast(config: Config, device: torch.device) -> Autocast:
    """Return the arithmetic of the network: fp16 needs a loss scale, and there is none here."""
    return contextlib.nullcontext if config.training.precision == "fp16" else partial(autocast, config.training, device)


def _require_frames(config: Config) -> None:
    if config.data.is_cache:
        raise InputError(
            where="data.source",
            found="latents: a cache has no frames to learn from, only JPEGs to look at",
            needed="the data set itself",
            fix="Use the config of the data set; data.cache does not matter here",
        )
    require_stride(config.data, to="know which frames clips use")


def _shape_for(model: WorldModel, decoder: DecoderConfig) -> DecoderShape:
    patch = model.sizes.patch_size
    if patch % UPSAMPLED or model.image_size < SMALLEST:
        raise InputError(
            where="model",
            found=f"images of {model.image_size} px in patches of {patch} px",
            needed=f"{SMALLEST} px or more, and patches of a multiple of {UPSAMPLED} px",
        )
    return DecoderShape(decoder.size, model.latent_dim, model.image_size // patch, patch)
