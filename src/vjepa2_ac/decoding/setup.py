"""What the training of a decoder needs before its first step, cheap failures first."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from vjepa2_ac.config import Config, DecoderConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.decoding.decoder_folder import CARD, LINEAR, WEIGHTS, read_card
from vjepa2_ac.decoding.frame_pairs import FramePairs, encode_pairs, require_space_for_pairs, wanted_frames
from vjepa2_ac.decoding.loss import SMALLEST
from vjepa2_ac.decoding.network import UPSAMPLED, DecoderShape
from vjepa2_ac.distributed.device import autocast, computing_device
from vjepa2_ac.distributed.signals import StoppedError, StopRequest
from vjepa2_ac.encoding.batch import encoding_of
from vjepa2_ac.encoding.cache_lookup import key_for
from vjepa2_ac.encoding.encode_dataset import encoder_on_device
from vjepa2_ac.encoding.pipeline import EncoderOnDevice
from vjepa2_ac.encoding.prefetch import FramesToEncode
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, Reporter
from vjepa2_ac.runs.checkpoint import CHECKPOINTS
from vjepa2_ac.runs.folder import LOCK, METRICS, RunLock
from vjepa2_ac.storage import try_writing_at, user_can_write, write_atomically
from vjepa2_ac.storage.structured import read_json_object

KEY, PAIRS = "key.json", "pairs"
_OF_A_KILLED_START = {WEIGHTS, LINEAR}  # which wrote them, and not yet the card
_OWN = {KEY, PAIRS, LOCK, CHECKPOINTS, METRICS} | _OF_A_KILLED_START


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
    autocast: Callable[[], AbstractContextManager[object]]
    is_done: bool  # the folder holds the decoder already

    @property
    def decoder(self) -> DecoderConfig:
        """How it is trained."""
        return self.config.decoder

    @property
    def pairs(self) -> Path:
        """Where frames and latents are, while it is trained."""
        return self.folder / PAIRS


def folder_of(config: Config) -> Path:
    """Return the folder of a config's decoder."""
    named = config.decoder.folder
    return Path(config.run_dir).parent / "decoder" if named is None else Path(named)


@contextlib.contextmanager
def setup(config: Config, reporter: Reporter, *, check_only: bool) -> Iterator[Setup]:
    """Check config, folder, data, model and disk, and hold the folder's lock to the end of the block.

    Raises:
        InputError: One of them cannot be used.
    """
    folder = folder_of(config)
    _require_frames(config)
    _require_own(folder)
    device = computing_device(config.training)
    with user_can_write(folder):
        try_writing_at(folder)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    wanted = _wanted(dataset, config.decoder)
    model = load_base(config.model, seed=config.seed)
    shape = _shape_for(model, config.decoder)
    on_device = encoder_on_device(config, model, device)
    if config.training.precision == "fp16":
        precision: Callable[[], AbstractContextManager[object]] = contextlib.nullcontext  # no loss scale here
    else:
        precision = partial(autocast, config.training, device)
    key = {
        "decoder": config.decoder.model_dump(mode="json", exclude={"folder", "checkpoint_every"}),
        "seed": config.seed,
        "latents": dict(key_for(dataset, encoding_of(model, config)).parts),
        "data": config.data.model_dump(mode="json", include={"validation_share", "test_share", "split_by"}),
    }
    is_done = _compare_key(folder, key)
    if not is_done:
        everything = [one for some in wanted.values() for one in some]
        taken = require_space_for_pairs(
            everything, folder / PAIRS, tokens=model.num_tokens, dim=model.latent_dim, image_size=model.image_size,
            kind=config.data.cache_dtype,
        )  # fmt: skip
        frames = sum(len(one.steps) for one in everything)
        reporter.note(f"{frames:,} frames; {taken / 1e9:.3g} GB of disk for them and their latents, while training")
    with RunLock(folder) as lock:
        if not check_only and not is_done:
            lock.take()
            with user_can_write(folder):
                write_atomically(folder / KEY, json.dumps(key, indent=1) + "\n")
        if is_done:
            reporter.note(f"The decoder is there already, in {folder}")
        fingerprint = str(key["latents"]["encoder"])  # type: ignore[index]
        yield Setup(
            config, folder, shape, fingerprint, device, dataset, on_device, wanted, precision, is_done
        )  # fmt: skip


def prepare(ready: Setup, reporter: Reporter, stop: StopRequest) -> tuple[FramePairs, FramePairs | None]:
    """Encode the frames to learn from, and the held-out ones, if there are any.

    Raises:
        InputError: A frame cannot be read, or written.
        StoppedError: A signal asked to stop.
    """
    found: dict[Split, FramePairs] = {}
    for split, wanted in ready.wanted.items():
        progress = _interruptible(reporter.task(f"encoding {split} frames", "frames"), ready.folder, stop)
        found[split] = encode_pairs(ready.dataset, wanted, ready.on_device, ready.pairs, progress)
    return found["train"], found.get("test")


def _interruptible(progress: Progress, folder: Path, stop: StopRequest) -> Progress:
    def or_stop(done: int, total: int) -> None:
        progress(done, total)
        if stop.reason is not None:
            raise StoppedError(folder, 0, stop.reason)

    return or_stop


def _wanted(dataset: Dataset, decoder: DecoderConfig) -> dict[Split, list[FramesToEncode]]:
    """Return the frames of each split; the test split may be empty."""
    found: dict[Split, list[FramesToEncode]] = {"train": wanted_frames(dataset, "train", frames=decoder.frames)}
    if held_out := wanted_frames(dataset, "test", frames=decoder.held_out_frames):
        found["test"] = held_out
    if not found["train"]:
        raise InputError(
            where=f"data.path: {dataset.config.path}",
            found="no frames of train episodes",
            needed="one episode or more that is as long as a clip",
            fix="Lower data.validation_share or data.test_share",
        )
    return found


def _require_frames(config: Config) -> None:
    if config.data.is_cache:
        raise InputError(
            where="data.source",
            found="latents: a cache has no frames to learn from, only small ones to look at",
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


def _require_own(folder: Path) -> None:
    """Refuse a folder with other contents."""
    if folder.is_dir():
        strange = sorted(path.name for path in folder.iterdir() if path.name not in _OWN and path.name[0] != ".")
        if strange and not (folder / CARD).is_file():
            raise InputError(
                where=f"decoder.folder {folder}",
                found=f"a folder with other things in it, such as {strange[0]}",
                needed="a new or empty one, or that of a decoder",
                fix="Set another decoder.folder",
            )


def _compare_key(folder: Path, key: dict[str, Any]) -> bool:
    """Return whether the folder holds this decoder, trained.

    Raises:
        InputError: It holds another one.
    """
    path = folder / KEY
    if not path.is_file():
        if any((folder / name).exists() for name in (CARD, PAIRS, CHECKPOINTS)):
            raise _another(folder, "of unknown origin")
        return False
    there = read_json_object(path, fix="Delete this folder")
    if differing := _differing(there, json.loads(json.dumps(key))):
        raise _another(folder, f"made otherwise: {'; '.join(differing)}")
    if (folder / CARD).is_file():
        read_card(folder)
        return True
    return False


def _differing(there: Any, key: Any, name: str = "") -> list[str]:
    """Return what differs, by dotted names."""
    if isinstance(there, dict) and isinstance(key, dict):
        names = sorted(there.keys() | key.keys())
        return [one for each in names for one in _differing(there.get(each), key.get(each), f"{name}.{each}")]
    return [] if there == key else [f"{name[1:]}: {there}, not {key}"]


def _another(folder: Path, how: str) -> InputError:
    return InputError(
        where=f"decoder.folder {folder}",
        found=f"another decoder, {how}",
        needed="a new folder, or the same decoder",
        fix="Set another decoder.folder, or delete this one",
    )
