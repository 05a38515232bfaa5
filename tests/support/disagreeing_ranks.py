"""One rank of a training run with a fault that only one of the ranks has; tests start two of them.

Arguments: a config, and the name of the fault, which is a function below.
"""

import os
import signal
import sys
import time
from dataclasses import replace
from datetime import timedelta
from unittest import mock

import numpy as np
import torch

from clips import some_clips
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.data.loader import training_loader
from vjepa2_ac.encoding import encode_dataset
from vjepa2_ac.errors import InputError, UnreachableError
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.training import loop, resume, setup, step, validation
from vjepa2_ac.training.loop import train

RANK = int(os.environ["RANK"])


def measures_otherwise() -> None:
    """The validation errors of the ranks differ in the last digits, so that only one rank measures an improvement."""
    measure, times = validation.prediction_errors, [0]

    def measured(*arguments: object, **options: object) -> object:
        errors = measure(*arguments, **options)
        times[0] += 1
        predicted = 0.5 * (1 - 1e-7 * RANK * times[0])
        arrays = {
            key: np.full_like(array, 1.0 if key[0] == "persistence" else predicted)
            for key, array in errors.arrays.items()
        }
        return replace(errors, arrays=arrays)

    validation.prediction_errors = measured


def disk_is_full() -> None:
    if RANK == 0:
        full = InputError(where="checkpoints", found="the checkpoint cannot be written (No space left on device)")
        resume.write_checkpoint = mock.Mock(side_effect=full)


def index_cannot_be_made() -> None:
    if RANK == 0:
        setup.open_dataset = mock.Mock(side_effect=InputError(where="data.path", found="no data set"))


def one_is_killed_once() -> None:
    """The launcher must restart all ranks."""
    step = loop.training_step

    def killed(run: object, batches: object, number: int, **options: object) -> object:
        if RANK == 1 and number == 3 and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
            os.kill(os.getpid(), signal.SIGKILL)
        return step(run, batches, number, **options)

    loop.training_step = killed


def one_cannot_read_a_validation_clip() -> None:
    if RANK == 1:
        damaged = InputError(where="episode 3", found="its image is damaged")
        validation.rank_actions = mock.Mock(side_effect=damaged)


def one_has_a_bug() -> None:
    if RANK == 1:
        loop.training_step = mock.Mock(side_effect=ValueError("a bug"))


def encoding_loses_its_connection() -> None:
    if RANK == 1:
        encode_dataset.encode_files = mock.Mock(side_effect=UnreachableError(where="gs://data", found="no answer"))


def indexing_takes_longer_than_the_time_out() -> None:
    torch.distributed.init_process_group("gloo", timeout=timedelta(seconds=6))
    if RANK == 0:
        make = setup.open_dataset
        setup.open_dataset = lambda *arguments, **options: (time.sleep(9), make(*arguments, **options))[1]


def each_meets_another_broken_episode() -> None:
    """Two broken episodes are allowed, four are not."""
    make = training_loader

    def loader(dataset: object, **options: object) -> object:
        for batch in make(dataset, **options):  # type: ignore[arg-type]
            for number in range(2):
                dataset.dataset.broken.record(f"episode {2 * RANK + number}", "damaged")  # type: ignore[attr-defined]
            yield some_clips(batch, [0])

    step.training_loader = loader


if __name__ == "__main__":
    globals()[sys.argv[2]]()
    try:
        train(load_config(sys.argv[1]), SILENT)
    except Exception as error:
        sys.stdout.write(f"{type(error).__name__}: {error}\n")
        sys.exit(3)
