"""Train a decoder: encode frames, train, measure, and write a folder for `--decoder`.

The frames of a step are a function of (config, step), so a checkpoint contains only the weights, their average, AdamW's
moments and the step. A killed training resumes exactly.
"""

from __future__ import annotations

import contextlib
import json
import math
import shutil
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config import Config, DecoderConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.selection import SPLIT_LABEL
from vjepa2_ac.data.sources.latent_files import LatentFiles, bytes_per_frame
from vjepa2_ac.data.sources.latents import CacheKey, Encoding, require_matching_folder
from vjepa2_ac.data.windows import permute_index, require_frames, require_stride
from vjepa2_ac.decoding.decoder import (
    CARD,
    UPSAMPLED,
    Decoder,
    DecoderCard,
    DecoderShape,
    Images,
    read_card,
    save_decoder,
    to_images,
)
from vjepa2_ac.decoding.frame_pairs import (
    FramePairs,
    PairBatch,
    compute_mean_image,
    fit_linear,
    measure_decoders,
    select_frames,
)
from vjepa2_ac.distributed import autocast, select_device
from vjepa2_ac.encoding.batch import get_encoding
from vjepa2_ac.encoding.latent_cache import (
    EncoderOnDevice,
    FramesToEncode,
    LatentCache,
    count_frames,
    encode_files,
    require_space,
)
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.image_similarity import ms_ssim
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.process import StoppedError, StopRequest, stop_on_signals
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.runs.checkpoint import read_torch, write_torch
from vjepa2_ac.runs.folder import RunLock
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.storage import atomic_writer, check_local_writable, translate_write_errors, write_atomically
from vjepa2_ac.storage.structured import utc_now

KEY, PAIRS, STATE = "key.json", "pairs", "training.pt"
_LOG_EVERY, _CHECKPOINT_EVERY = 50, 500  # steps; a shorter training saves a checkpoint after each third
_HELD_OUT_FRAMES = 1_000
_STRUCTURE, _EDGES = 0.2, 0.1  # weights of the second and the third term of the loss
_MIN_SIDE = 11  # minimum side of an image in pixels: the window of MS-SSIM must fit
_SCALES = 3
_WARMUP, _WARMUP_SHARE = 500, 15  # the warm-up has at most 500 steps, and at most 1/15 of all steps
_WEIGHT_DECAY, _BETAS, _MAX_GRAD_NORM = 0.05, (0.9, 0.95), 1.0
# The decay of the weights' moving average has three limits. A short training has at most 1 - 4.5 / steps, so that it
# averages over about its last 22 %. The limit step / (step + 9) lets the initial weights lose influence quickly.
_MAX_DECAY, _AVERAGED_SHARE, _AVERAGE_DELAY = 0.999, 4.5, 9.0


def train_decoder(config: Config, reporter: Reporter = SILENT, *, check_only: bool = False) -> Path:
    """Train a decoder for the encoder and the data of a config, or resume a training that was stopped.

    Args:
        config: Config with the sections `data`, `model` and `decoder`.
        reporter: Receives messages and the progress of each part of the work.
        check_only: Run all checks, but write nothing.

    Returns:
        The folder of the decoder.

    Raises:
        InputError: An input cannot be used, or the folder contains something else.
        StoppedError: A signal stopped the training; the same command resumes.
    """
    setup = _prepare(config, reporter)
    folder = setup.folder
    with RunLock(folder) as lock:
        if is_finished := (folder / CARD).is_file():
            read_card(folder)
            reporter.note(f"{folder} contains a trained decoder; nothing to do.")
        else:
            _require_disk_space(setup, reporter)
        if check_only:
            return folder
        if not is_finished:
            lock.take()
            with translate_write_errors(folder):
                write_atomically(folder / KEY, json.dumps({"key": dict(setup.key.parts)}, indent=1) + "\n")
            _run_trial_step(setup)
            _encode_and_train(setup, reporter)
            reporter.note(f"Saved the decoder to {folder} (PSNR and SSIM: {folder / CARD})")
        shutil.rmtree(setup.files.folder, ignore_errors=True)  # may remain if a finished training was killed here
        (folder / STATE).unlink(missing_ok=True)
    return folder


def _encode_and_train(setup: Setup, reporter: Reporter) -> None:
    """Encode the frames, fit the linear decoder, train the decoder from it, measure both, and write the folder."""
    device, config = setup.encoder.device, setup.config
    with stop_on_signals() as stop:
        pairs, held_out = (_encode_split(setup, split, reporter, stop) for split in ("train", "test"))
        linear = fit_linear(pairs, setup.shape, device, reporter.task("fitting the linear decoder"))
        steps = DecoderSteps(setup, linear)
        _train(setup, steps, pairs, reporter, stop)
    decoder = Decoder(setup.shape).to(device).eval()
    decoder.load_state_dict(steps.average)
    measured: dict[str, Any] = {}
    if len(held_out):
        decoders = {"decoder": decoder, "linear": linear.to(device)}
        measured = measure_decoders(held_out, decoders, compute_mean_image(pairs), reporter.task("measuring", "frames"))
    card = DecoderCard(
        format="vjepa2-ac decoder 1",
        shape=setup.shape,
        encoder=setup.encoding.parts["encoder"],
        crop=config.data.crop,
        precision=config.training.precision,
        data=config.data.path,
        cameras=tuple(config.data.cameras),
        episodes=len(set(pairs.episode_ids)),
        frames=len(pairs),
        steps=config.decoder.steps,
        held_out=measured,
        time=utc_now(),
    )
    save_decoder(setup.folder, card, decoder.state_dict())


@dataclass(frozen=True, eq=False)
class Setup:
    """The checked inputs of a decoder's training."""

    config: Config
    folder: Path
    shape: DecoderShape
    encoding: Encoding
    key: CacheKey
    dataset: Dataset
    encoder: EncoderOnDevice
    frames: dict[Split, list[FramesToEncode]]

    @property
    def files(self) -> LatentFiles:
        """Files of the frames and latents, which exist during training only."""
        return LatentFiles(self.folder / PAIRS, self.key.digest)


def _prepare(config: Config, reporter: Reporter) -> Setup:
    """Load data and model, and check all inputs of the training.

    Raises:
        InputError: The config, the folder, the data or the model cannot be used.
    """
    decoder = config.decoder
    folder = Path(config.run_dir).parent / "decoder" if decoder.folder is None else Path(decoder.folder)
    require_frames(config.data, to="train a decoder")
    require_stride(config.data, to="select the frames that clips use")
    device = select_device(config.training)
    with translate_write_errors(folder):
        check_local_writable(folder)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    frames: dict[Split, list[FramesToEncode]] = {
        "train": select_frames(dataset, "train", frames=decoder.frames),
        "test": select_frames(dataset, "test", frames=_HELD_OUT_FRAMES),  # may be none
    }
    if not frames["train"]:
        problem, needed = "no training frames", "at least one training episode that is as long as a clip"
        fix = "Lower data.validation_share or data.test_share"
        raise InputError(where=f"data.path: {config.data.path}", found=problem, needed=needed, fix=fix)
    reporter.task(LOADING)
    model = load_base(config.model, seed=config.seed)
    encoding, size, patch = get_encoding(model, config), model.image_size, model.sizes.patch_size
    if patch % UPSAMPLED or size < _MIN_SIDE:
        needed = f"images of at least {_MIN_SIDE} px, and a patch size that is a multiple of {UPSAMPLED} px"
        raise InputError(where="model", found=f"images of {size} px in patches of {patch} px", needed=needed)
    key = CacheKey({
        "decoder": decoder.model_dump(mode="json", exclude={"folder"}),
        "seed": config.seed,
        "latents": dict(LatentCache.for_dataset(dataset, encoding).key.parts),
        "data": config.data.model_dump(mode="json", include={"validation_share", "test_share", "split_by"}),
        **({"data.splits": config.data.splits} if SPLIT_LABEL in dataset.table.labels else {}),
    })  # fmt: skip
    require_matching_folder(folder, KEY, key, where=f"decoder.folder {folder}")
    shape = DecoderShape(decoder.size, model.latent_dim, size // patch, patch)
    return Setup(
        config, folder, shape, encoding, key, dataset, EncoderOnDevice.from_model(config, model, device), frames
    )


def _require_disk_space(setup: Setup, reporter: Reporter) -> None:
    encoding, kind = setup.encoding, setup.config.data.cache_dtype
    per_frame = bytes_per_frame(encoding.tokens, encoding.dim, kind) + 3 * encoding.image_size**2
    all_frames = [entry for entries in setup.frames.values() for entry in entries]
    num_missing = count_frames([entry for entry in all_frames if not setup.files.has_file(entry.episode, entry.camera)])
    fix = "Lower decoder.frames, set data.cache_dtype: int8, or put decoder.folder on a larger disk"
    require_space(setup.folder, num_missing, per_frame, fix=fix)
    size = f"{num_missing * per_frame / 1e9:.3g} GB"
    reporter.note(
        f"Training with {count_frames(all_frames):,} frames. Their images and latents need {size} of disk space."
    )


def _run_trial_step(setup: Setup) -> None:
    """Run one step on zeros on a GPU, so that missing memory is reported before the frames are encoded."""
    if setup.encoder.device.type == "cuda":
        shape, batch_size = setup.shape, setup.config.decoder.batch_size
        latents = torch.zeros(batch_size, shape.grid**2, shape.dim)
        images = torch.zeros(batch_size, 3, shape.image_size, shape.image_size).byte()
        DecoderSteps(setup, None).run(1, PairBatch(latents, images, ()))


def _encode_split(setup: Setup, split: Split, reporter: Reporter, stop: StopRequest) -> FramePairs:
    """Encode the frames of a split that are not encoded yet; `data.broken_episodes` applies to unreadable episodes."""
    report, frames, files = reporter.task(f"encoding {split} frames", "frames"), setup.frames[split], setup.files

    def progress(done: int, total: int) -> None:
        report(done, total)
        if stop.reason is not None:
            raise StoppedError(setup.folder, 0, stop.reason)

    missing = [entry for entry in frames if not files.is_done(entry.episode, entry.camera)]
    encode_files(setup.dataset, missing, setup.encoder, files, progress, lossless_images=True)
    pairs = FramePairs.from_files(setup.dataset, frames, files)
    if frames and not len(pairs):
        raise InputError(where=setup.config.data.path, found=f"no readable {split} frame", needed="at least one")
    return pairs


def _train(setup: Setup, steps: DecoderSteps, pairs: FramePairs, reporter: Reporter, stop: StopRequest) -> None:
    """Run all steps after the newest checkpoint, and save checkpoints."""
    config, path = setup.config.decoder, setup.folder / STATE
    num_done = 0  # steps before the newest checkpoint
    if path.is_file():
        state = read_torch(path)
        num_done = int(state["step"])
        steps.decoder.load_state_dict(state["decoder"])
        steps.optimizer.load_state_dict(state["optimizer"])
        for name, value in steps.average.items():
            value.copy_(state["average"][name])
    progress = reporter.task("training the decoder", "steps")
    with (
        MetricsLog(setup.folder, first_step=num_done) as log,
        contextlib.closing(_iterate_batches(pairs, setup.config, num_done)) as batches,
    ):
        checkpoint_every = max(1, min(_CHECKPOINT_EVERY, config.steps // 3))
        for step, batch in batches:
            metrics = steps.run(step, batch)
            progress(step, config.steps)
            is_last = step == config.steps
            if step % _LOG_EVERY == 0 or is_last:
                log.write("train", step, metrics)
            if step % checkpoint_every == 0 or is_last or stop.reason is not None:
                with log.flush_before_checkpoint(), translate_write_errors(path), atomic_writer(path) as file:
                    states = {"decoder": steps.decoder.state_dict(), "optimizer": steps.optimizer.state_dict()}
                    write_torch({"step": step, "average": steps.average, **states}, file)
            if stop.reason is not None and not is_last:
                raise StoppedError(setup.folder, step, stop.reason)


def _iterate_batches(pairs: FramePairs, config: Config, num_done: int) -> Generator[tuple[int, PairBatch], None, None]:
    """Yield (step, batch) for each step after step `num_done`; the next batch is read in the background."""
    size, num_pairs, seed = config.decoder.batch_size, len(pairs), config.seed

    def read(step: int) -> PairBatch:
        positions = range((step - 1) * size, step * size)
        return pairs.read([
            permute_index(position % num_pairs, size=num_pairs, seed=seed, epoch=position // num_pairs)
            for position in positions
        ])  # fmt: skip

    with ThreadPoolExecutor(1, thread_name_prefix="pairs") as pool:
        next_batch = pool.submit(read, num_done + 1)
        for step in range(num_done + 1, config.decoder.steps + 1):
            batch = next_batch.result()
            next_batch = pool.submit(read, step + 1)
            yield step, batch


# ---- one optimizer step ----


def decoder_loss(images: Images, targets: Images) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
    """Return the loss and its terms: L1 + 0.2 (1 - MS-SSIM) + 0.1 (L1 of the image gradients along both axes).

    Args:
        images: Outputs of the decoder, not clipped.
        targets: The encoder's input, between 0 and 1.
    """
    scales = sum(images.shape[-1] >= _MIN_SIDE << scale for scale in range(_SCALES))
    absolute = (images - targets).abs().mean()
    structure = 1.0 - ms_ssim(images, targets, scales=scales).mean()
    rows, columns = ((images.diff(dim=axis) - targets.diff(dim=axis)).abs().mean() for axis in (-2, -1))
    edges = rows + columns
    loss = absolute + _STRUCTURE * structure + _EDGES * edges
    return loss, {"l1": absolute, "structure": structure, "edges": edges}


def learning_rate_at(step: int, config: DecoderConfig) -> float:
    """Return the learning rate of step 1 .. steps: a linear warm-up, then half a cosine down to zero."""
    warmup = min(_WARMUP, config.steps // _WARMUP_SHARE)
    if step <= warmup:
        return config.learning_rate * step / warmup
    progress = (step - warmup) / max(1, config.steps - warmup)
    return config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * progress))


class DecoderSteps:
    """A decoder in training: its weights, their moving average, and AdamW.

    Args:
        setup: The inputs of the training.
        linear: The linear decoder to start from; None: random weights.
    """

    def __init__(self, setup: Setup, linear: Decoder | None) -> None:
        self._config, self._device = setup.config, setup.encoder.device
        self.decoder = Decoder(setup.shape)
        self.decoder.initialise(torch.Generator().manual_seed(setup.config.seed))
        if linear is not None:
            self.decoder.copy_linear(linear)
        self.decoder.to(self._device)
        decayed = [parameter for parameter in self.decoder.parameters() if parameter.ndim > 1]
        not_decayed = [parameter for parameter in self.decoder.parameters() if parameter.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": _WEIGHT_DECAY}, {"params": not_decayed, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=setup.config.decoder.learning_rate, betas=_BETAS)
        self.average = {name: tensor.detach().clone() for name, tensor in self.decoder.state_dict().items()}

    def run(self, step: int, pairs: PairBatch) -> dict[str, float]:
        """Run one optimizer step, counted from 1, and return its metrics.

        Raises:
            InputError: Loss or gradients are not finite; the weights are unchanged.
        """
        latents, images = pairs.latents.to(self._device), to_images(pairs.images.to(self._device))
        learning_rate = learning_rate_at(step, self._config.decoder)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        needs_loss_scale = self._config.training.precision == "fp16"  # not implemented here, so float32 is used
        with contextlib.nullcontext() if needs_loss_scale else autocast(self._config.training, self._device):
            decoded = self.decoder(latents)
        loss, terms = decoder_loss(decoded, images)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch
        norm = torch.nn.utils.clip_grad_norm_(self.decoder.parameters(), _MAX_GRAD_NORM)
        tensors = {"loss": loss, **terms, "gradient_norm": norm}
        values = torch.stack([value.detach().float() for value in tensors.values()]).tolist()  # one synchronisation
        metrics = dict(zip(tensors, values, strict=True))
        if not math.isfinite(metrics["gradient_norm"]):
            problem = f"{self._config.decoder.learning_rate:g}; loss or gradients of step {step} are not finite"
            fix = f"Lower it and start again; delete {STATE} if it was saved after the loss had diverged"
            raise InputError(where="decoder.learning_rate", found=problem, fix=fix)
        self.optimizer.step()
        decay = min(_MAX_DECAY, 1 - _AVERAGED_SHARE / self._config.decoder.steps, step / (step + _AVERAGE_DELAY))
        for name, tensor in self.decoder.state_dict().items():  # detached tensors
            self.average[name].lerp_(tensor, 1.0 - decay)
        return metrics | {"learning_rate": learning_rate}
