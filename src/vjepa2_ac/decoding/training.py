"""Training of a decoder: from the first frame encoded to a folder that `--decoder` takes.

The frames of a step and its noise are functions of (config, step), so a checkpoint holds weights, their average,
AdamW's moments and the step; a training that was killed goes on as if it had not been.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from vjepa2_ac.config import Config, DecoderConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.clips.permutation import permuted
from vjepa2_ac.decoding.baselines import fit_linear, mean_image, measure_decoders
from vjepa2_ac.decoding.decoder_folder import CARD, DecoderCard, save_decoder
from vjepa2_ac.decoding.frame_pairs import FramePairs, Pairs
from vjepa2_ac.decoding.network import Decoder
from vjepa2_ac.decoding.setup import Setup, setup
from vjepa2_ac.decoding.steps import DecoderSteps
from vjepa2_ac.distributed.preemption import StoppedError, StopRequest, stop_on_signals
from vjepa2_ac.encoding.pipeline import encode_files
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.finite import first_not_finite
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.runs.checkpoint import RunState, newest_checkpoint, read_state, write_checkpoint
from vjepa2_ac.runs.folder import CHECKPOINTS
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.runs.torch_file import read_torch, write_torch
from vjepa2_ac.storage.structured import utc_now

_STATE = "decoder.pt"
_LOG_EVERY = 50  # steps
_KEEP = 2  # checkpoints


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
    with setup(config, reporter, check_only=check_only) as ready:
        if check_only:
            return ready.folder
        if not ready.is_done:
            with _out_of_memory_explained():
                _try_one_step(ready)
                _make(ready, reporter)
            reporter.note(f"The decoder is in {ready.folder}: {ready.folder / CARD} says how good it is")
        for temporary in (ready.pairs.folder, ready.folder / CHECKPOINTS):  # also of a start that was killed by then
            shutil.rmtree(temporary, ignore_errors=True)
    return ready.folder


def _make(ready: Setup, reporter: Reporter) -> None:
    """Encode, fit, train, measure, and write the decoder."""
    with stop_on_signals() as stop:
        pairs, held_out = (_encoded(ready, split, reporter, stop) for split in ("train", "test"))
        linear = fit_linear(pairs, ready.shape, ready.device, reporter.task("fitting the linear decoder"))
        steps = ready.steps_from(linear)
        _train(ready, steps, pairs, reporter, stop)
    if (name := first_not_finite(steps.average)) is not None:
        raise InputError(where=str(ready.folder), found=f"{name} holds NaN or infinity", fix="Lower the learning rate")
    decoder = Decoder(ready.shape).to(ready.device).eval()
    decoder.load_state_dict(steps.average)
    found: dict[str, Any] = {}
    if len(held_out):
        decoders = {"decoder": decoder, "linear": linear.to(ready.device)}
        found = measure_decoders(held_out, decoders, mean_image(pairs), reporter.task("measuring", "frames"))
    data = ready.config.data
    card = DecoderCard(
        format="vjepa2-ac decoder 1",
        shape=ready.shape,
        encoder=ready.encoder,
        crop=data.crop,
        precision=ready.config.training.precision,
        data=data.path,
        cameras=tuple(data.cameras),
        episodes=len(set(pairs.episode_ids)),
        frames=len(pairs),
        steps=ready.decoder.steps,
        held_out=found,
        time=utc_now(),
    )
    save_decoder(ready.folder, card, decoder.state_dict(), linear.state_dict())


def _try_one_step(ready: Setup) -> None:
    """Run out of memory now, not after the frames are encoded."""
    if ready.device.type == "cuda":
        shape, count = ready.shape, ready.decoder.batch_size
        latents = torch.zeros(count, shape.grid**2, shape.dim)
        images = torch.zeros(count, 3, shape.image_size, shape.image_size).byte()
        ready.steps_from(None).do(1, Pairs(latents, images, ()))


def _encoded(ready: Setup, split: Split, reporter: Reporter, stop: StopRequest) -> FramePairs:
    """Encode the frames of a split that are not there yet; episodes that cannot be read are left out by policy."""
    shown, wanted, files = reporter.task(f"encoding {split} frames", "frames"), ready.wanted[split], ready.pairs

    def progress(done: int, total: int) -> None:
        shown(done, total)
        if stop.reason is not None:
            raise StoppedError(ready.folder, 0, stop.reason)

    left = [one for one in wanted if not files.is_done(one.episode, one.camera)]
    encode_files(ready.dataset, left, ready.on_device, files, progress, exact_pictures=True)
    pairs = FramePairs.of(ready.dataset, wanted, files)
    if wanted and not len(pairs):
        raise InputError(where=ready.config.data.path, found="no frame that can be read", needed="one or more")
    return pairs


def _train(ready: Setup, steps: DecoderSteps, pairs: FramePairs, reporter: Reporter, stop: StopRequest) -> None:
    """Do the steps that are left after the newest checkpoint, if there is one."""
    config, checkpoints = ready.decoder, ready.folder / CHECKPOINTS
    newest = newest_checkpoint(checkpoints)
    first = 0 if newest is None else _restore(steps, newest)
    progress = reporter.task("training the decoder", "steps")
    with (
        MetricsLog(ready.folder, first_step=first) as log,
        contextlib.closing(_batches(pairs, config, ready.config.seed, first)) as batches,
    ):
        for step, batch in batches:
            metrics = steps.do(step, batch)
            progress(step, config.steps)
            is_last = step == config.steps
            if step % _LOG_EVERY == 0 or is_last:
                log.write("train", step, metrics)
            if step % config.checkpoint_every == 0 or is_last or stop.reason is not None:
                with log.before_a_checkpoint():
                    state = RunState(step=step, clips_done=step * config.batch_size)
                    write_checkpoint(checkpoints, state, lambda folder: _write(steps, folder), keep=_KEEP)
            if stop.reason is not None and not is_last:
                raise StoppedError(ready.folder, step, stop.reason)


def _write(steps: DecoderSteps, checkpoint: Path) -> None:
    with (checkpoint / _STATE).open("wb") as file:
        write_torch(steps.state(), file)


def _restore(steps: DecoderSteps, checkpoint: Path) -> int:
    """Continue from a checkpoint, and return how many steps were done."""
    try:
        steps.restore(read_torch(checkpoint / _STATE))
    except (KeyError, ValueError, RuntimeError, TypeError) as error:
        fix = "Delete this checkpoint, to use an older one"
        raise InputError(where=str(checkpoint), found=f"not this decoder's ({error})", fix=fix) from None
    return read_state(checkpoint).step


def _batches(
    pairs: FramePairs, config: DecoderConfig, seed: int, done: int
) -> Generator[tuple[int, Pairs], None, None]:
    """Yield the frames of each further step; the next ones are read meanwhile."""

    def read(step: int) -> Pairs:
        places = range((step - 1) * config.batch_size, step * config.batch_size)
        count = len(pairs)
        return pairs.read([permuted(at % count, size=count, seed=seed, epoch=at // count) for at in places])

    with ThreadPoolExecutor(1, thread_name_prefix="pairs") as pool:
        ahead = pool.submit(read, done + 1)
        for step in range(done + 1, config.steps + 1):
            batch = ahead.result()
            ahead = pool.submit(read, step + 1)
            yield step, batch


@contextlib.contextmanager
def _out_of_memory_explained() -> Iterator[None]:
    try:
        yield
    except torch.OutOfMemoryError as error:
        found = f"the GPU's memory is not enough ({str(error).splitlines()[0]})"
        fix = "Lower decoder.batch_size or model.encode_chunk, or set decoder.size: tiny"
        raise InputError(where="decoder", found=found, fix=fix) from error
