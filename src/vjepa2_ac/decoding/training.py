"""Training of a decoder: from the first frame encoded to a folder that `--decoder` takes.

The frames of a step and its noise are functions of (config, step), so a checkpoint holds weights, their average,
AdamW's moments and the step; a training that was killed goes on as if it had not been.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from vjepa2_ac.config import Config, DecoderConfig
from vjepa2_ac.data.windows import permuted
from vjepa2_ac.decoding.decoder_folder import CARD, DecoderCard, save_decoder
from vjepa2_ac.decoding.frame_pairs import FramePairs, Pairs
from vjepa2_ac.decoding.held_out import mean_image, measure_decoders
from vjepa2_ac.decoding.linear_fit import fit_linear
from vjepa2_ac.decoding.network import Decoder
from vjepa2_ac.decoding.optimizer_steps import DecoderSteps
from vjepa2_ac.decoding.setup import Setup, prepare, setup
from vjepa2_ac.distributed.signals import StoppedError, StopRequest, stop_on_signals
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.network.pretrained_folder import first_not_finite
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.runs.checkpoint import CHECKPOINTS, OPTIMIZER, RunState, newest_checkpoint, read_state, write_checkpoint
from vjepa2_ac.runs.files import read_torch, write_torch
from vjepa2_ac.runs.metrics_log import MetricsLog
from vjepa2_ac.storage.structured import utc_now

_WEIGHTS = "decoder.pt"
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
        if ready.is_done:
            _remove_temporary(ready)  # of a start that was killed by then
            return ready.folder
        with _out_of_memory_explained():
            _try_one_step(ready)
            with stop_on_signals() as stop:
                train_pairs, held_out = prepare(ready, reporter, stop)
                linear = fit_linear(train_pairs, ready.shape, ready.device, reporter.task("fitting the linear decoder"))
                trained = _Training(ready, linear)
                _train(trained, train_pairs, reporter, stop)
            _finish(trained, linear, train_pairs, held_out, reporter)
    return ready.folder


def _try_one_step(ready: Setup) -> None:
    """Run out of memory now, not after the frames are encoded."""
    if ready.device.type == "cuda":
        steps = _steps_of(ready, None)
        shape, count = ready.shape, ready.decoder.batch_size
        latents = torch.zeros(count, shape.grid**2, shape.dim)
        steps.do(1, Pairs(latents, torch.zeros(count, 3, shape.image_size, shape.image_size).byte(), ()))


class _Training:
    """The steps of a decoder, from its newest checkpoint if there is one."""

    def __init__(self, ready: Setup, linear: Decoder) -> None:
        self.ready, self.done = ready, 0
        self.steps = _steps_of(ready, linear)
        newest = newest_checkpoint(ready.folder / CHECKPOINTS)
        if newest is not None:
            self._restore(newest)

    def save(self, step: int) -> None:
        """Write a checkpoint."""

        def write(folder: Path) -> None:
            for name, value in ((_WEIGHTS, self.steps.weights()), (OPTIMIZER, self.steps.optimizer.state_dict())):
                with (folder / name).open("wb") as file:
                    write_torch(value, file)

        state = RunState(step=step, clips_done=step * self.ready.decoder.batch_size)
        write_checkpoint(self.ready.folder / CHECKPOINTS, state, write, keep=_KEEP)

    def _restore(self, checkpoint: Path) -> None:
        try:
            self.steps.restore(read_torch(checkpoint / _WEIGHTS), read_torch(checkpoint / OPTIMIZER))
        except (KeyError, ValueError, RuntimeError, TypeError) as error:
            fix = "Delete this checkpoint, to use an older one"
            raise InputError(where=str(checkpoint), found=f"not this decoder's ({error})", fix=fix) from None
        self.done = read_state(checkpoint).step


def _steps_of(ready: Setup, linear: Decoder | None) -> DecoderSteps:
    return DecoderSteps(ready.shape, ready.decoder, ready.config.seed, ready.device, ready.autocast, linear)


def _train(training: _Training, pairs: FramePairs, reporter: Reporter, stop: StopRequest) -> None:
    config, first = training.ready.decoder, training.done
    progress = reporter.task("training the decoder", "steps")
    with (
        MetricsLog(training.ready.folder, first_step=first) as log,
        contextlib.closing(_batches(pairs, config, training.ready.config.seed, first)) as batches,
    ):
        for step, batch in batches:
            metrics = training.steps.do(step, batch)
            progress(step, config.steps)
            is_last = step == config.steps
            if step % _LOG_EVERY == 0 or is_last:
                log.write("train", step, metrics)
            if step % config.checkpoint_every == 0 or is_last or stop.number:
                with log.before_a_checkpoint():
                    training.save(step)
            if stop.number and not is_last:
                raise StoppedError(training.ready.folder, step, signal.Signals(stop.number).name)


def _batches(
    pairs: FramePairs, config: DecoderConfig, seed: int, done: int
) -> Generator[tuple[int, Pairs], None, None]:
    """Yield the frames of each further step; the next ones are read meanwhile."""

    def read(step: int) -> Pairs:
        places = range((step - 1) * config.batch_size, step * config.batch_size)
        count = len(pairs)
        return pairs.read([permuted(at % count, size=count, seed=seed, epoch=at // count) for at in places])

    with ThreadPoolExecutor(1, thread_name_prefix="pairs") as pool:
        ahead = pool.submit(read, done + 1) if done < config.steps else None
        for step in range(done + 1, config.steps + 1):
            batch = ahead.result() if ahead is not None else read(step)
            ahead = pool.submit(read, step + 1) if step < config.steps else None
            yield step, batch


def _finish(
    training: _Training, linear: Decoder, pairs: FramePairs, held_out: FramePairs | None, reporter: Reporter
) -> None:
    """Measure the averaged weights on held-out frames, write the decoder, and remove all else."""
    ready = training.ready
    if (name := first_not_finite(training.steps.average)) is not None:
        raise InputError(where=str(ready.folder), found=f"{name} holds NaN or infinity", fix="Lower the learning rate")
    decoder = Decoder(ready.shape).to(ready.device).eval()
    decoder.load_state_dict(training.steps.average)
    found: dict[str, Any] = {}
    if held_out is not None:
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
        episodes=len({file.episode_id for file in pairs.files}),
        frames=len(pairs),
        steps=training.ready.decoder.steps,
        held_out=found,
        time=utc_now(),
    )
    save_decoder(ready.folder, card, decoder.state_dict(), linear.state_dict())
    _remove_temporary(ready)
    reporter.note(f"The decoder is in {ready.folder}: {ready.folder / CARD} says how good it is")


def _remove_temporary(ready: Setup) -> None:
    """Remove what only training needs."""
    for temporary in (ready.pairs, ready.folder / CHECKPOINTS):
        shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def _out_of_memory_explained() -> Iterator[None]:
    try:
        yield
    except torch.OutOfMemoryError as error:
        found = f"the GPU's memory is not enough ({str(error).splitlines()[0]})"
        fix = "Lower decoder.batch_size or model.encode_chunk, or set decoder.size: tiny"
        raise InputError(where="decoder", found=found, fix=fix) from error
