"""Training of a decoder: from the first frame encoded to a folder that `--decoder` takes.

The frames of a step and its noise are functions of (config, step), so what is saved on the way is weights, their
average, AdamW's moments and the step; a training that was killed goes on as if it had not been.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.sources.latents.cache_files import LatentFiles, bytes_per_frame
from vjepa2_ac.data.sources.latents.cache_key import CacheKey, Encoding, require_own_folder
from vjepa2_ac.data.splits import SPLIT
from vjepa2_ac.data.windows import permuted, require_frames, require_stride
from vjepa2_ac.decoding.decoder_folder import CARD, DecoderCard, read_card, save_decoder
from vjepa2_ac.decoding.frame_pairs import FramePairs, Pairs, fit_linear, mean_image, measure_decoders, wanted_frames
from vjepa2_ac.decoding.network import UPSAMPLED, Decoder, DecoderShape
from vjepa2_ac.decoding.steps import SMALLEST, DecoderSteps
from vjepa2_ac.distributed import autocast, computing_device
from vjepa2_ac.encoding.batch import encoding_of
from vjepa2_ac.encoding.latent_cache import LatentCache, frames_in, require_space
from vjepa2_ac.encoding.pipeline import EncoderOnDevice, FramesToEncode, encode_files
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.pretrained_folder import first_not_finite
from vjepa2_ac.process import StoppedError, StopRequest, stop_on_signals
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.runs.checkpoint import read_torch, write_torch
from vjepa2_ac.runs.folder import RunLock
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.storage import atomic_writer, try_writing_at, user_can_write, write_atomically
from vjepa2_ac.storage.structured import utc_now

KEY, PAIRS, STATE = "key.json", "pairs", "training.pt"
_LOG_EVERY = 50  # steps


def train_decoder(config: Config, reporter: Reporter = SILENT, *, check_only: bool = False) -> Path:
    """Train the decoder of a config's encoder and data; go on where a former start stopped.

    Args:
        config: Data, model and `decoder`.
        reporter: Receives messages and the progress of each part of the work.
        check_only: Do what can fail, and write nothing.

    Returns:
        The folder of the decoder.

    Raises:
        InputError: An input cannot be used, or the folder holds something else.
        StoppedError: A signal asked to stop; the same command goes on.
    """
    ready = _setup(config, reporter)
    folder = ready.folder
    with RunLock(folder) as lock:
        if is_done := (folder / CARD).is_file():
            read_card(folder)
            reporter.note(f"The decoder is there already, in {folder}")
        else:
            _require_space(ready, reporter)
        if check_only:
            return folder
        if not is_done:
            lock.take()
            with user_can_write(folder):
                write_atomically(folder / KEY, json.dumps({"key": dict(ready.key.parts)}, indent=1) + "\n")
            _try_one_step(ready)
            _make(ready, reporter)
            reporter.note(f"The decoder is in {folder}: {folder / CARD} says how good it is")
        shutil.rmtree(ready.files.folder, ignore_errors=True)  # also after a start that was killed by then
        (folder / STATE).unlink(missing_ok=True)
    return folder


def _make(ready: Setup, reporter: Reporter) -> None:
    """Encode, fit, train, measure, and write the decoder."""
    device, config = ready.encoder.device, ready.config
    with stop_on_signals() as stop:
        pairs, held_out = (_encoded(ready, split, reporter, stop) for split in ("train", "test"))
        linear = fit_linear(pairs, ready.shape, device, reporter.task("fitting the linear decoder"))
        steps = ready.steps_from(linear)
        _train(ready, steps, pairs, reporter, stop)
    if (name := first_not_finite(steps.average)) is not None:
        raise InputError(where=str(ready.folder), found=f"{name} holds NaN or infinity", fix="Lower the learning rate")
    decoder = Decoder(ready.shape).to(device).eval()
    decoder.load_state_dict(steps.average)
    found: dict[str, Any] = {}
    if len(held_out):
        decoders = {"decoder": decoder, "linear": linear.to(device)}
        found = measure_decoders(held_out, decoders, mean_image(pairs), reporter.task("measuring", "frames"))
    card = DecoderCard(
        format="vjepa2-ac decoder 1",
        shape=ready.shape,
        encoder=ready.encoding.encoder,
        crop=config.data.crop,
        precision=config.training.precision,
        data=config.data.path,
        cameras=tuple(config.data.cameras),
        episodes=len(set(pairs.episode_ids)),
        frames=len(pairs),
        steps=config.decoder.steps,
        held_out=found,
        time=utc_now(),
    )
    save_decoder(ready.folder, card, decoder.state_dict(), linear.state_dict())


@dataclass(frozen=True, eq=False)
class Setup:
    """A decoder that can be trained."""

    config: Config
    folder: Path
    shape: DecoderShape
    encoding: Encoding
    key: CacheKey
    dataset: Dataset
    encoder: EncoderOnDevice
    wanted: dict[Split, list[FramesToEncode]]

    @property
    def files(self) -> LatentFiles:
        """Frames and latents, while it is trained."""
        return LatentFiles(self.folder / PAIRS, self.key.digest)

    def steps_from(self, linear: Decoder | None) -> DecoderSteps:
        """Return its first optimizer steps, from the linear decoder or from fresh weights."""
        config, device = self.config, self.encoder.device
        needs_loss_scale = config.training.precision == "fp16"  # and there is none here
        arithmetic = contextlib.nullcontext if needs_loss_scale else partial(autocast, config.training, device)
        return DecoderSteps(self.shape, config.decoder, config.seed, device, arithmetic, linear)


def _setup(config: Config, reporter: Reporter) -> Setup:
    """Check config, folder, data and model.

    Raises:
        InputError: One of them cannot be used.
    """
    decoder = config.decoder
    folder = Path(config.run_dir).parent / "decoder" if decoder.folder is None else Path(decoder.folder)
    require_frames(config.data, to="learn from")
    require_stride(config.data, to="know which frames clips use")
    device = computing_device(config.training)
    with user_can_write(folder):
        try_writing_at(folder)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    wanted: dict[Split, list[FramesToEncode]] = {
        "train": wanted_frames(dataset, "train", frames=decoder.frames),
        "test": wanted_frames(dataset, "test", frames=decoder.held_out_frames),  # may be none
    }
    if not wanted["train"]:
        found, needed = "no frames of train episodes", "one episode or more that is as long as a clip"
        fix = "Lower data.validation_share or data.test_share"
        raise InputError(where=f"data.path: {config.data.path}", found=found, needed=needed, fix=fix)
    reporter.task(LOADING)
    model = load_base(config.model, seed=config.seed)
    encoding, size, patch = encoding_of(model, config), model.image_size, model.sizes.patch_size
    if patch % UPSAMPLED or size < SMALLEST:
        needed = f"{SMALLEST} px or more, and patches of a multiple of {UPSAMPLED} px"
        raise InputError(where="model", found=f"images of {size} px in patches of {patch} px", needed=needed)
    key = CacheKey({
        "decoder": decoder.model_dump(mode="json", exclude={"folder", "checkpoint_every"}),
        "seed": config.seed,
        "latents": dict(LatentCache.of(dataset, encoding).key.parts),
        "data": config.data.model_dump(mode="json", include={"validation_share", "test_share", "split_by"}),
        **({"data.splits": config.data.splits} if SPLIT in dataset.table.labels else {}),
    })  # fmt: skip
    require_own_folder(folder, KEY, key, where=f"decoder.folder {folder}")
    shape = DecoderShape(decoder.size, model.latent_dim, size // patch, patch)
    return Setup(config, folder, shape, encoding, key, dataset, EncoderOnDevice.of(config, model, device), wanted)


def _require_space(ready: Setup, reporter: Reporter) -> None:
    encoding, kind = ready.encoding, ready.config.data.cache_dtype
    per_frame = bytes_per_frame(encoding.tokens, encoding.dim, kind) + 3 * encoding.image_size**2
    everything = [one for some in ready.wanted.values() for one in some]
    left = frames_in([one for one in everything if not ready.files.has(one.episode, one.camera)])
    fix = "Lower decoder.frames, set data.cache_dtype: int8, or put decoder.folder on a larger disk"
    require_space(ready.folder, left, per_frame, fix=fix)
    size = f"{left * per_frame / 1e9:.3g} GB of disk for them and their latents, while training"
    reporter.note(f"{frames_in(everything):,} frames; {size}")


def _try_one_step(ready: Setup) -> None:
    """Run out of memory now, not after the frames are encoded."""
    if ready.encoder.device.type == "cuda":
        shape, count = ready.shape, ready.config.decoder.batch_size
        latents = torch.zeros(count, shape.grid**2, shape.dim)
        images = torch.zeros(count, 3, shape.image_size, shape.image_size).byte()
        ready.steps_from(None).do(1, Pairs(latents, images, ()))


def _encoded(ready: Setup, split: Split, reporter: Reporter, stop: StopRequest) -> FramePairs:
    """Encode the frames of a split that are not there yet; episodes that cannot be read are left out by policy."""
    shown, wanted, files = reporter.task(f"encoding {split} frames", "frames"), ready.wanted[split], ready.files

    def progress(done: int, total: int) -> None:
        shown(done, total)
        if stop.reason is not None:
            raise StoppedError(ready.folder, 0, stop.reason)

    left = [one for one in wanted if not files.is_done(one.episode, one.camera)]
    encode_files(ready.dataset, left, ready.encoder, files, progress, exact_pictures=True)
    pairs = FramePairs.of(ready.dataset, wanted, files)
    if wanted and not len(pairs):
        raise InputError(where=ready.config.data.path, found="no frame that can be read", needed="one or more")
    return pairs


def _train(ready: Setup, steps: DecoderSteps, pairs: FramePairs, reporter: Reporter, stop: StopRequest) -> None:
    """Do the steps that are left after those that were saved."""
    config, saved = ready.config.decoder, ready.folder / STATE
    first = 0
    if saved.is_file():
        state = read_torch(saved)
        steps.restore(state)
        first = int(state["step"])
    progress = reporter.task("training the decoder", "steps")
    with (
        MetricsLog(ready.folder, first_step=first) as log,
        contextlib.closing(_batches(pairs, ready.config, first)) as batches,
    ):
        for step, batch in batches:
            metrics = steps.do(step, batch)
            progress(step, config.steps)
            is_last = step == config.steps
            if step % _LOG_EVERY == 0 or is_last:
                log.write("train", step, metrics)
            if step % config.checkpoint_every == 0 or is_last or stop.reason is not None:
                with log.before_a_checkpoint(), user_can_write(saved), atomic_writer(saved) as file:
                    write_torch({"step": step, **steps.state()}, file)
            if stop.reason is not None and not is_last:
                raise StoppedError(ready.folder, step, stop.reason)


def _batches(pairs: FramePairs, config: Config, done: int) -> Generator[tuple[int, Pairs], None, None]:
    """Yield the frames of each further step; the next ones are read meanwhile."""
    size, count, seed = config.decoder.batch_size, len(pairs), config.seed

    def read(step: int) -> Pairs:
        places = range((step - 1) * size, step * size)
        return pairs.read([permuted(at % count, size=count, seed=seed, epoch=at // count) for at in places])

    with ThreadPoolExecutor(1, thread_name_prefix="pairs") as pool:
        ahead = pool.submit(read, done + 1)
        for step in range(done + 1, config.decoder.steps + 1):
            batch = ahead.result()
            ahead = pool.submit(read, step + 1)
            yield step, batch
