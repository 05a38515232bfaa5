"""A captured and replayed micro-step equals the plain one."""

import itertools
from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from clips import some_clips
from run_fixtures import set_up
from vjepa2_ac.config import Config
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.episode import Batch
from vjepa2_ac.errors import InputError
from vjepa2_ac.training.cuda_graph import Body, GraphedMicroStep
from vjepa2_ac.training.step import Run, encode, iterate_batches, micro_step, training_step

STEPS = 3
NEEDS_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


class Recorder:
    """Simulates a CUDA graph: a replay repeats the recorded body, and needs gradients at their addresses."""

    def __init__(self, run: Run) -> None:
        self.run, self.captures, self.replays = run, 0, 0

    def __call__(self, body: Body) -> Body:
        for _ in range(2):  # warm-up runs, which add gradients
            body()
        self.captures += 1
        addresses = self.gradient_addresses()

        def replay() -> None:
            assert self.gradient_addresses() == addresses
            self.replays += 1
            body()

        return replay

    def gradient_addresses(self) -> list[int | None]:
        return [None if weight.grad is None else weight.grad.data_ptr() for weight in self.run.trained]


def skip_some_clips(batches: Iterator[Batch]) -> Iterator[Batch]:
    """Simulate unreadable clips: all but one clip of the third micro-batch, and all clips of the fifth."""
    for number, batch in enumerate(batches):
        yield some_clips(batch, list(range({2: 1, 4: 0}.get(number, len(batch.starts)))))


def train_steps(run: Run, batches: Iterator[Batch]) -> list[Tensor]:
    metrics = [training_step(run, batches, step) for step in range(1, STEPS + 1)]
    losses = torch.tensor([[row["loss"], row["grad_norm"]] for row in metrics], dtype=torch.float64)
    return [losses, *(parameter.detach().clone() for parameter in run.trained)]


@pytest.fixture
def make_run(make_config: Callable[..., Config], reporter) -> Callable[..., Run]:
    def make(**changes: object) -> Run:
        config = make_config(
            adapter__dropout=0.0, training__batch_size=2, training__accumulation=2, training__learning_rate=1e-2,
            training__warmup_steps=0, **changes,
        )  # fmt: skip
        return set_up(config, reporter)

    return make


def record_micro_step(run: Run) -> Recorder:
    """Make a run capture its micro-step with a `Recorder`, on any device."""
    recorder = Recorder(run)
    run.micro_step = GraphedMicroStep(recorder)
    return recorder


@pytest.mark.parametrize("order", [lambda batches: batches, skip_some_clips], ids=["even", "uneven"])
def test_training_with_a_captured_micro_step_equals_training_without(make_run, order) -> None:
    plain, captured = (make_run() for _ in range(2))
    expected = train_steps(plain, order(iterate_batches(plain)))
    recorder = record_micro_step(captured)
    actual = train_steps(captured, order(iterate_batches(captured)))
    assert all(map(torch.equal, actual, expected))
    assert recorder.captures == 1
    assert recorder.replays == 2 * STEPS - (2 if order is skip_some_clips else 0)


def test_capture_adds_to_existing_gradients(make_run) -> None:
    run = make_run()
    run.world_model.train()
    first, second = (encode(run, batch) for batch in itertools.islice(iterate_batches(run), 2))
    recorder = record_micro_step(run)

    def gradients(*steps: Callable[..., Tensor]) -> list[Tensor]:
        run.optimizer.zero_grad()
        for step, latents in zip(steps, (first, second), strict=True):
            step(run, latents, 2.0)
        return [parameter.grad.clone() for parameter in run.trained]

    expected = gradients(micro_step, micro_step)
    assert all(map(torch.equal, gradients(micro_step, run.micro_step), expected))
    assert (recorder.captures, recorder.replays) == (1, 1)


@NEEDS_CUDA
def test_training_with_a_cuda_graph_equals_training_without(make_run) -> None:
    runs = [make_run(training__device="cuda", training__cuda_graph=graph) for graph in (False, True)]
    expected, actual = (train_steps(run, iterate_batches(run)) for run in runs)
    assert isinstance(runs[1].micro_step, GraphedMicroStep)
    for value, reference in zip(actual, expected, strict=True):
        torch.testing.assert_close(value, reference, rtol=1e-3, atol=1e-5)


def test_cuda_graph_on_a_cpu_raises(make_config) -> None:
    with pytest.raises(InputError, match=r"training.cuda_graph.*a CUDA device"):
        make_accelerator(make_config(training__cuda_graph=True, training__device="cpu", adapter__dropout=0.0))


@pytest.mark.parametrize("changes", [{"training__precision": "fp16"}, {"adapter__dropout": 0.1}])
def test_cuda_graph_with_dropout_or_fp16_raises(make_config, changes) -> None:
    with pytest.raises(InputError, match=r"training.cuda_graph needs adapter.dropout 0, and bf16 or fp32"):
        make_config(training__cuda_graph=True, **({"adapter__dropout": 0.0} | changes))
