"""A tiny run on synthetic episodes."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import killable
from killable import ForkServer
from synthetic import write_synthetic_droid
from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import config_as_dict, parse_config
from vjepa2_ac.episode import Progress
from vjepa2_ac.process import HANG_UP, SIGNALS
from vjepa2_ac.reporter import SILENT, Reporter

if TYPE_CHECKING:  # the main process of pytest-xdist does not need PyTorch, whose import takes seconds
    import torch
    from accelerate import Accelerator

    from vjepa2_ac.model.world_model import WorldModel
    from vjepa2_ac.training.step import Run

TINY = {
    "image_size": 32,
    "patch_size": 16,
    "encoder": {"width": 24, "depth": 1, "heads": 2, "mlp_ratio": 2.0},
    "predictor": {"width": 24, "depth": 2, "heads": 2},
}
TINY_CONFIG = {  # `model.sizes` of a model that is trained from scratch
    "image_size": 32,
    "encoder": {"width": 24, "depth": 1, "heads": 2},
    "predictor": TINY["predictor"],
}


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread within the context: tiny tensors are slower with more, and results depend on the number."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class SilentReporter(Reporter):
    """Records all messages and progress."""

    def __init__(self) -> None:
        self.tasks: dict[str, list[tuple[int, int]]] = {}
        self.notes: list[str] = []
        self.steps: list[int] = []
        self.actions: dict[int, Callable[[], object]] = {}  # by the step after which they are called

    def note(self, text: str) -> None:
        self.notes.append(text)

    def task(self, title: str, unit: str = "") -> Progress:
        del unit
        reported = self.tasks[title] = []
        return lambda done, total: reported.append((done, total))

    def on_step(self, step: int, figures: object) -> None:
        del figures
        self.steps.append(step)
        self.actions.get(step, lambda: None)()


class KilledError(Exception):
    """Simulates the end of the process."""


def at_step(reporter: SilentReporter, step: int, action: Callable[[], object]) -> SilentReporter:
    """Return a reporter that calls a function after a step, before the checkpoint of the step is written."""
    reporter.actions[step] = action
    return reporter


def dying_reporter(reporter: SilentReporter, last_step: int) -> SilentReporter:
    """Return a reporter that raises KilledError after a step."""

    def die() -> None:
        raise KilledError

    return at_step(reporter, last_step, die)


def signalled_reporter(reporter: SilentReporter, last_step: int, number: int) -> SilentReporter:
    """Return a reporter that sends a signal to this process after a step."""
    return at_step(reporter, last_step, lambda: os.kill(os.getpid(), number))


def set_up(config: Config, reporter: Reporter = SILENT, accelerator: Accelerator | None = None) -> Run:
    """Return a run as `train` has it before its first step."""
    from vjepa2_ac.training import setup
    from vjepa2_ac.training.resume import restore

    return restore(setup.set_up(config, reporter, accelerator), reporter)


@pytest.fixture(scope="session")
def data_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_droid(tmp_path_factory.mktemp("data") / "set", episodes=8, steps=24, size=(36, 64))


@pytest.fixture(scope="session")
def base_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from vjepa2_ac.config import ModelSizes
    from vjepa2_ac.model.world_model import WorldModel

    folder = tmp_path_factory.mktemp("base") / "model"
    WorldModel.random(ModelSizes.model_validate(TINY), seed=3).save_pretrained(folder)
    return folder


@pytest.fixture
def default_signals() -> Iterator[None]:
    """Give stop signals their default effect, even if the tests were started with `nohup`, which ignores SIGHUP."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (*SIGNALS, HANG_UP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


Popen = Callable[..., "subprocess.Popen[Any]"]


@pytest.fixture
def popen() -> Iterator[Popen]:
    """A function that starts processes, which are killed after the test, even after a failure.

    Otherwise the warning about their open pipes would appear in a later test.
    """
    with ExitStack() as ending:

        def start(*arguments: Any, **options: Any) -> subprocess.Popen[Any]:
            process = ending.enter_context(subprocess.Popen(*arguments, **options))
            ending.callback(process.kill)
            return process

        yield start


@pytest.fixture(scope="session")
def fork_server() -> ForkServer:
    """Starts real processes without importing libraries again."""
    return killable.fork_server()


MakeConfig = Callable[..., Config]


def tiny_config(run_dir: Path, data_folder: Path, base_folder: Path, **changes: object) -> Config:
    """Return a config of a tiny LoRA run; dotted keys, with two underscores for a dot, change it."""
    values: dict[str, object] = {
        "run_dir": str(run_dir),
        "data": {
            "path": str(data_folder), "frames": 4, "stride": 2, "validation_share": 0.3, "test_share": 0.2,
            "workers": 0,
        },
        "model": {"base": str(base_folder), "dtype": "float32"},
        "adapter": {"rank": 4, "alpha": 8},
        "training": {
            "steps": 6, "batch_size": 2, "accumulation": 2, "learning_rate": 1e-3, "warmup_steps": 1,
            "precision": "fp32", "device": "cpu", "log_every": 1, "allow_weak_base": True,
        },
        "validation": {"every": 3, "clips": 4, "batch_size": 2, "ranking_samples": 4},
        "checkpoint": {"every": 2, "keep": 5},
        "tracking": {"tensorboard": False},
    }  # fmt: skip
    for key, value in changes.items():
        *sections, name = key.split("__")
        inner = values
        for section in sections:
            inner = inner.setdefault(section, {})  # type: ignore[assignment]
        inner[name] = value
    return parse_config(values, where="test")


@pytest.fixture
def make_config(tmp_path: Path, data_folder: Path, base_folder: Path) -> MakeConfig:
    """Return a config of a tiny LoRA run; dotted keys change it."""

    def make(**changes: object) -> Config:
        return tiny_config(
            **{"run_dir": tmp_path / "run", "data_folder": data_folder, "base_folder": base_folder, **changes}
        )

    return make


@pytest.fixture(scope="session")
def whole_run(tmp_path_factory: pytest.TempPathFactory, data_folder: Path, base_folder: Path) -> Path:
    """The folder of the run of `make_config()`, trained without interruption. Shared by all tests, read only."""
    from vjepa2_ac.training.loop import train

    config = tiny_config(tmp_path_factory.mktemp("whole") / "run", data_folder, base_folder)
    with one_thread():
        return train(config, SilentReporter())


@pytest.fixture
def reporter() -> SilentReporter:
    return SilentReporter()


def as_yaml(config: Config) -> str:
    import yaml

    return yaml.safe_dump(config_as_dict(config))


@pytest.fixture
def encoded_frames(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of frames that were encoded, for each call of the encoder."""
    from vjepa2_ac.model.world_model import WorldModel

    counted: list[int] = []
    encode = WorldModel.encode

    def counting(model: WorldModel, frames: torch.Tensor, chunk: int = 16) -> torch.Tensor:
        counted.append(frames.shape[0] * frames.shape[1])
        return encode(model, frames, chunk)

    monkeypatch.setattr(WorldModel, "encode", counting)
    return counted
