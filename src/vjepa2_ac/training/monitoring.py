"""Monitoring of a training run: throughput, and warnings when training diverges.

Metrics of one optimizer step, for the metrics log and the console:

update_to_weight    norm of the update divided by the norm of the weights before it, over all trained parameters
data_wait_share     share of the step's wall time spent waiting for the loader; on CUDA only the device's idle time,
                    because the device computes queued work while the host waits
samples_per_second  clips per second, summed over all processes
mfu                 model FLOPs per second (`training.flops`) divided by the ceiling: the rate of this device in a large
                    matrix product in the run's precision, measured for a fraction of a second at the start. NaN (null)
                    above 1, because other programs then used the device during the measurement of the ceiling
ceiling_tflops      this ceiling in 10^12 FLOPs per second, summed over all processes
memory_gb           peak so far in 10^9 bytes: PyTorch's allocator on CUDA, resident memory on other devices
"""

from __future__ import annotations

import math
import resource
import statistics
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator

from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.distributed import PRECISIONS, measure_matmul_speed
from vjepa2_ac.episode import Batch
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.metrics_log import WARNING, MetricsLog, Trackers, read_metrics_log
from vjepa2_ac.training.flops import clip_flops

MACHINE_METRICS = frozenset({"data_wait_share", "samples_per_second", "mfu", "ceiling_tflops", "memory_gb"})
"""Metrics that depend on the machine and therefore differ between identical runs."""

_ERRORS = {
    "error_over_persistence": "one-step error",
    "rollout_over_persistence_last": "rollout error at the last horizon",
}
_MIN_INCREASE = 1.01  # factor; smaller increases of a validation error are ignored
_NUM_LOSSES = 10  # number of `train` rows whose median is compared
_MIN_LOSSES = 5
_LOSS_RATIO = 2.0  # a median above this multiple of the lowest median causes a warning


class DivergenceWarningLog(MetricsLog):
    """A metrics log that adds a warning to its rows and to the console when the metrics show that training diverges.

    Warnings depend only on the rows of the log, so that a resumed run neither loses nor repeats a warning.

    Args:
        config: The config of the run.
        reporter: Receives messages for the user.
        first_step: As for `MetricsLog`.
        trackers: As for `MetricsLog`.
    """

    def __init__(self, config: Config, reporter: Reporter, *, first_step: int, trackers: Trackers) -> None:
        super().__init__(Path(config.run_dir), first_step=first_step, trackers=trackers)
        self._detector, self._reporter = DivergenceDetector(config), reporter
        for row in read_metrics_log(self.path):
            self._detector(str(row.get("kind")), row["step"], row)

    def write(self, kind: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Append a row, and a warning if the row shows that training diverges."""
        super().write(kind, step, metrics)
        if text := self._detector(kind, step, metrics):
            super().write(WARNING, step, {"text": text})
            self._reporter.note(f"Warning: {text}")


class DivergenceDetector:
    """A check of the rows of a metrics log in their order; each cause is reported only once."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._reported: set[str] = set()
        self._initial_metrics: Mapping[str, Any] = {}  # metrics of the validation before the first step
        self._losses: deque[float] = deque(maxlen=_NUM_LOSSES)
        self._lowest_median = math.inf

    def __call__(self, kind: str, step: int, metrics: Mapping[str, Any]) -> str:
        """Return the warning for a row; empty if there is no cause, or if the cause was reported before."""
        causes: Iterable[tuple[str, str]] = ()
        if kind == "train":
            causes = self._check_loss(_number(metrics, "loss"))
        elif kind == "validation" and step == 0:
            self._initial_metrics = metrics
        elif kind == "validation":
            causes = self._check_validation(metrics)
        new_causes = {cause: text for cause, text in causes if cause not in self._reported}
        self._reported |= set(new_causes)
        training = self._config.training
        fix = (
            f"If this persists, lower training.learning_rate ({training.learning_rate:g}) or adapter.alpha, or raise"
            f" training.warmup_steps ({training.warmup_steps:,})"
        )
        return f"at step {step:,} {'; '.join(new_causes.values())}. {fix}" if new_causes else ""

    def _check_validation(self, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        is_better = True
        for key, name in _ERRORS.items():
            now, before = _number(metrics, key), _number(self._initial_metrics, key)
            is_better &= now < before
            if not math.isfinite(now):
                yield "not finite", "an error of the validation is not a finite number"
            elif now > _MIN_INCREASE * before:
                copying = "; copying the last frame would be better" if now > 1.0 > before else ""
                text = f"the {name} in validation is {now:.3f} of persistence's (before training {before:.3f})"
                yield name + copying, text + copying
        error = "action_ranking_error"
        low, initial_high = _number(metrics, f"{error}_low"), _number(self._initial_metrics, f"{error}_high")
        if low > initial_high:
            now, before = (100 * _number(row, error) for row in (metrics, self._initial_metrics))
            text = f"the action-ranking error is {now:.1f} % (before training {before:.1f} %, chance 50 %)"
            text += ", although predictions are better than the base model's" if is_better else ""
            yield "rank", f"{text}. `vjepa2-ac data check` measures how diverse the motions of the data are"

    def _check_loss(self, loss: float) -> Iterator[tuple[str, str]]:
        if not math.isfinite(loss):  # a step without readable clips
            return
        self._losses.append(loss)
        median = statistics.median(self._losses)
        if len(self._losses) >= _MIN_LOSSES:
            self._lowest_median = min(self._lowest_median, median)
        if median > _LOSS_RATIO * self._lowest_median:
            yield (
                "loss",
                f"the loss is {median:.4g}, its minimum was {self._lowest_median:.4g} (medians of {_NUM_LOSSES} rows)",
            )


class TimedBatches(Iterator[Batch]):
    """An iterator over batches that measures the time spent waiting for the loader.

    On CUDA only the idle time of the device counts, from the end of the queued work to the next work.

    Args:
        batches: The batches from the loader.
        device: The device of the run.
    """

    def __init__(self, batches: Iterator[Batch], device: torch.device) -> None:
        self._batches, self._waited_s = batches, 0.0
        self._device = device
        self._spans: deque[tuple[Any, Any]] = deque()  # start and end events, not necessarily reached by the device

    @property
    def waited_s(self) -> float:
        """The waiting time in seconds, up to the last event that the device has reached; does not synchronize."""
        while self._spans and self._spans[0][1].query():
            start, end = self._spans.popleft()
            self._waited_s += start.elapsed_time(end) / 1000  # milliseconds to seconds
        return self._waited_s

    def __next__(self) -> Batch:
        """Return the next batch."""
        start_s = time.perf_counter()
        start_event = self._timestamp()
        try:
            return next(self._batches)
        finally:
            if start_event is None:
                self._waited_s += time.perf_counter() - start_s
            else:
                self._spans.append((start_event, self._timestamp()))

    def _timestamp(self) -> Any:
        """Record and return a CUDA event with timing; return None on other devices."""
        if self._device.type != "cuda":
            return None
        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]  # torch
        event.record(torch.cuda.current_stream(self._device))
        return event


@dataclass(frozen=True)
class Throughput:
    """The constants needed to compute the throughput metrics of a step."""

    flops_per_clip: int
    ceiling: float  # FLOPs per second of all processes
    device: torch.device

    @classmethod
    def measure(cls, config: Config, sizes: ModelSizes, accelerator: Accelerator) -> Throughput:
        """Measure the ceiling (once per process, device and precision), and count the FLOPs of a clip.

        The FLOPs include the encoder unless latents are cached.
        """
        device = accelerator.device
        ceiling = accelerator.num_processes * measure_matmul_speed(device, PRECISIONS[config.training.precision])
        flops = clip_flops(config, sizes)
        return cls(flops.predictor if config.data.uses_cached_latents else flops.total, ceiling, device)

    def compute_metrics(self, clips: float, seconds: float, waited_s: float) -> dict[str, float]:
        """Return the metrics of one step.

        Args:
            clips: Number of clips, summed over all processes.
            seconds: The wall time of the step.
            waited_s: The part of this time spent waiting for the loader.
        """
        mfu = clips * self.flops_per_clip / seconds / self.ceiling
        if self.device.type == "cuda":
            peak_bytes = torch.cuda.max_memory_allocated(self.device)
        else:
            peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # Linux counts in KiB
        return {
            "samples_per_second": clips / seconds,
            "data_wait_share": min(1.0, waited_s / seconds),
            "mfu": mfu if mfu <= 1.0 else math.nan,
            "ceiling_tflops": self.ceiling / 1e12,
            "memory_gb": peak_bytes / 1e9,
        }


def _number(metrics: Mapping[str, Any], key: str) -> float:
    """Return a metric as a float; NaN if it is absent or None (JSON has no NaN)."""
    value = metrics.get(key)
    return float(value) if isinstance(value, int | float) else math.nan
