"""The public functions: short ways into the other packages. `vjepa2_ac` itself gives their names.

What trains and evaluates is imported where it is used: to load a model takes no second longer for it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vjepa2_ac.config import Config, EncoderConfig, SizesConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.loading import config_as_dict, config_of_model, parse_config
from vjepa2_ac.data import dataset as datasets
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import validation_batches
from vjepa2_ac.data.transforms import Crop
from vjepa2_ac.distributed import has_bf16, no_cuda_error, require_weight_dtype
from vjepa2_ac.encoding.batch import encode_batch, encode_frames
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter_folder import ADAPTER_FILE, load_trained
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.folder import is_run
from vjepa2_ac.runs.subject import Subject, load_subject, read_config_of_moved_run

if TYPE_CHECKING:
    from vjepa2_ac.evaluation.result import Validation
    from vjepa2_ac.reports.write import WrittenEvaluation

logger = logging.getLogger(__name__)

Device = str | torch.device
WeightType = Literal["auto", "float32", "bfloat16"]

_REST = {  # of a config
    "run_dir": "none",
    "data": {"source": "npz", "path": "none"},
    "model": {"base": "builtin:sim-tiny"},
    "training": {"rollout_steps": 1},
}


def open_dataset(data: str | Path | Config, **knobs: Any) -> Dataset:
    """Open a data set, and select the episodes and steps that clips come from.

    Args:
        data: A folder or URL, of DROID's RLDS form unless `source` says another; or a config, whose `data:` is used.
        knobs: Knobs of `data:` in a config, such as `frames` and `stride`; `vjepa2-ac config schema` lists them.

    Returns:
        The data set. `len(dataset.table)` episodes, `dataset.control_rate_hz` control steps a second;
        `dataset.clips("train")` is a `torch.utils.data.Dataset` of clips; `dataset.source.read(0)` is an episode with
        its states, steps x 7.

    Raises:
        InputError: There is no such data set, it is damaged, a knob is wrong, or no episode is left.

    Example:
        >>> dataset = open_dataset("demo/data", frames=4, stride=4)  # clips of 4 frames, 4 control steps apart
        >>> dataset = open_dataset(load_config("configs/lerobot.yaml"))
    """
    if isinstance(data, Config):
        values = config_as_dict(data)
        config = parse_config(values | {"data": values["data"] | knobs}, where="open_dataset") if knobs else data
        return datasets.open_dataset(config.data)
    if str(data).endswith((".yaml", ".yml")):
        fix = "Read it first: open_dataset(load_config(PATH))"
        raise InputError(where=str(data), found="a config", needed="the folder of a data set", fix=fix)
    return datasets.open_dataset(parse_config(_REST | {"data": {"path": str(data)} | knobs}, where="open_dataset").data)


def read_clips(dataset: Dataset, split: Split = "train", *, clips: int = 16, batch_size: int = 8) -> Iterator[Batch]:
    """Yield a fixed set of clips, spread evenly over a split, in batches; the same at each call.

    Args:
        dataset: The data set.
        split: train, validation or test: whole episodes, by the data set's own splits, or by a hash of their names
            and `validation_share`, `test_share` (`data.splits`).
        clips: How many, at most.
        batch_size: Clips of a batch; the last one may have fewer.

    Yields:
        Batches of `frames` (clips x time x height x width x 3, uint8, RGB, cropped; None of a latent cache), `states`
        (clips x time x 7: metres, radians, closedness), `actions` (clips x time-1 x 7: the changes), `episode_ids` and
        `starts` (control steps). Axes, units and coordinate frames: `vjepa2_ac.episode`.

    Raises:
        InputError: The split has no clips, `data.stride` is auto, or a clip cannot be read.

    Example:
        >>> batch = next(read_clips(dataset, clips=8))
        >>> tuple(batch.frames.shape)
        (8, 4, 180, 243, 3)
    """
    return validation_batches(dataset, split, clips=clips, batch_size=batch_size)


@overload
def encode(model: WorldModel, seen: Batch, *, chunk: int = 16) -> LatentBatch: ...


@overload
def encode(
    model: WorldModel, seen: UInt8[np.ndarray, "*axes height width 3"], *, crop: Crop = "released", chunk: int = 16
) -> Float[Tensor, "*axes tokens dim"]: ...


def encode(
    model: WorldModel, seen: Batch | np.ndarray, *, crop: Crop = "released", chunk: int = 16
) -> LatentBatch | Tensor:
    """Return the latents of clips or frames, on the model's device; each frame is encoded independently.

    Args:
        model: The model whose encoder is used.
        seen: A batch of `read_clips`; or RGB frames with any axes before height x width x 3, uint8.
        crop: Part of a frame that the model sees, as `data.crop`; a batch is already cropped.
        chunk: Frames that go through the encoder at once: bounds the memory.

    Returns:
        Of frames: latents, the axes before height x tokens x dim, float32, layer-normalised. Of a batch: a record of
        its `latents` (clips x time x tokens x dim), `states` and `actions`, all on the device.

    Raises:
        InputError: These are no such frames, or the model needs camera poses that the batch does not have.

    Example:
        >>> seen = encode(model, batch)
        >>> future = model.rollout(seen.latents[:, :1], seen.actions, seen.states[:, :-1])  # clips x time-1 x ...
        >>> encode(model, image).shape  # of one image: tokens x dim
        torch.Size([36, 128])
    """
    if isinstance(seen, Batch):
        return encode_batch(model, seen, device=model.device, chunk=chunk)
    frames = np.asarray(seen)
    if frames.dtype != np.uint8 or frames.ndim < 3 or frames.shape[-1] != 3 or 0 in frames.shape:
        found = f"{frames.dtype} of the shape {' x '.join(map(str, frames.shape))}"
        raise InputError(where="encode", found=found, needed="RGB frames: uint8, ... x height x width x 3")
    latents = encode_frames(model, frames.reshape(-1, *frames.shape[-3:]), crop, chunk=chunk)
    return latents.reshape(*frames.shape[:-3], *latents.shape[-2:])


def load_model(
    name: str | Path,
    *,
    adapter: str | Path | None = None,
    device: Device = "auto",
    dtype: WeightType = "auto",
    sizes: SizesConfig | None = None,
    encoder: str | Path | EncoderConfig | None = None,
) -> WorldModel:
    """Load a world model, in eval mode; no weight requires a gradient.

    Args:
        name: What `model.base` takes: the official `.pt`, a folder from `vjepa2-ac export`, or `builtin:sim-tiny`.
        adapter: A folder from `vjepa2-ac export --to hub`, whose adapter is put on this model.
        device: Such as cpu or cuda:1; auto: CUDA where there is one.
        dtype: Type of the weights; auto: bfloat16 on a GPU that computes in it, else float32. Trained weights of an
            adapter are float32, and so are latents.
        sizes: Of an official `.pt`, whose file has no image size and heads; None: the released ones.
        encoder: Of a file that holds a predictor alone: what `model.encoder` or its path takes; None: the model's own.

    Raises:
        InputError: There is no such model, adapter or device, it cannot be read, or the adapter is of another base.

    Example:
        >>> model = load_model("builtin:sim-tiny")
        >>> model.image_size, model.num_tokens, model.latent_dim  # pixels, tokens of a frame, width of a token
        (96, 36, 128)
    """
    place = _device(device)
    has_bfloat16 = place.type == "cuda" and has_bf16(place)
    model_values: dict[str, Any] = {
        "dtype": ("bfloat16" if has_bfloat16 else "float32") if dtype == "auto" else dtype,
        "sizes": (sizes or SizesConfig()).model_dump(),
        "encoder": encoder.model_dump() if isinstance(encoder, EncoderConfig) else encoder and {"path": str(encoder)},
    }
    config = config_of_model(str(name), where="load_model", **model_values).model
    require_weight_dtype(config, place)
    model = load_base(config, seed=0)
    if adapter is not None:
        load_trained(model, adapter, trainable=False)
    return model.to(place).eval()


def load_run(
    folder: str | Path,
    checkpoint: str | int = "selected",
    *,
    device: Device = "auto",
    overrides: Iterable[str] = (),
) -> Subject:
    """Load the model of a trained run, in eval mode: its base with the adapter of a complete checkpoint.

    Args:
        folder: The run, as `train` returns it.
        checkpoint: selected (the best by validation, else the newest), newest, best, or a number of optimizer steps.
        device: As of `load_model`. The type of the base's weights is the run's `model.dtype`.
        overrides: Where the base or the encoder was moved: model.base=PATH, model.encoder.path=PATH. The fingerprints
            of the weights must be those that the run was trained on.

    Returns:
        `world_model`, with the adapter beside its base; `config` of the run; `checkpoint`, the folder it is from.

    Raises:
        InputError: Not a run, no such checkpoint or device, or its base cannot be loaded.

    Example:
        >>> run = load_run("runs/droid-lora", "best")
        >>> controller = Controller.of_run(run)
    """
    place, folder = _device(device), Path(folder)
    if not is_run(str(folder)) and (folder / ADAPTER_FILE).is_file():
        found, fix = "an adapter without its run", "Name its base, too: load_model(BASE, adapter=FOLDER)"
        raise InputError(where=str(folder), found=found, needed="the folder of a run", fix=fix)
    run = load_subject(folder, str(checkpoint), config=read_config_of_moved_run(folder, overrides))
    run.world_model.to(place)
    return run


def train(
    config: Config,
    *,
    note: Callable[[str], None] = logger.info,
    on_step: Callable[[int, dict[str, float]], None] | None = None,
    check_only: bool = False,
    allow_config_change: bool = False,
) -> Path:
    """Train as a config says, as `vjepa2-ac train` does, and return the folder of the run.

    If the folder `run_dir` has this run already, training resumes from its newest checkpoint; a finished run is left
    as it is. In the main thread SIGINT (Ctrl-C), SIGTERM and SIGUSR1 end it after the current step, with a checkpoint.

    Args:
        config: The run, from `load_config`.
        note: Called with each message, such as the result of a validation; `print` shows them.
        on_step: Called after each optimizer step with its number, from 1, and its metrics: `loss`, `grad_norm` ...
        check_only: Do everything that can fail, and stop before the first step; nothing is written.
        allow_config_change: Resume a run whose folder has another config.

    Raises:
        InputError: Something cannot be used; raised before the first step wherever possible.
        StoppedError: A signal ended it, see `process`; the same call resumes.

    Example:
        >>> run = train(load_config("configs/demo.yaml", ["training.steps=200"]), note=print)
        >>> load_run(run, "best").world_model
    """
    from vjepa2_ac.training import loop

    reporter = _CallbackReporter(note, on_step)
    return loop.train(config, reporter, check_only=check_only, allow_config_change=allow_config_change)


def evaluate(
    subject: str | Path,
    *,
    data: Config | None = None,
    out: str | Path | None = None,
    clips: int = 256,
    checkpoint: str | int = "selected",
    probes: bool = True,
) -> WrittenEvaluation:
    """Measure a run or a model on held-out episodes, as `vjepa2-ac evaluate` does, and write the report.

    For more options, such as other models to compare with, see `vjepa2_ac.evaluation.evaluate_run.evaluate_subject`.

    Args:
        subject: The folder of a run, which is measured beside its base; or a model, as of `load_model`.
        data: A config with other data than the run's own; a model has none of its own.
        out: Folder for metrics.json, report.html and evaluation.png; None: the run's. Needed with `data`.
        clips: At most as many, spread over the test episodes.
        checkpoint: Of a run: selected (the best, else the newest), newest, best, or a number of steps.
        probes: Whether the use of the actions is measured in detail, which takes most of the time: other actions,
            energy landscapes, examples.

    Returns:
        `summary`, the verdicts, as lines by `str`; `error_over_persistence` of each model by horizon (below 1: better
        than copying the first frame); `files` that were written; `evaluation`, all arrays.

    Raises:
        InputError: The subject or the data cannot be used, there are no test episodes, or the folder cannot be written.

    Example:
        >>> result = evaluate("demo/run", clips=64)
        >>> result.error_over_persistence[result.evaluation.trained][-1]  # at the last horizon, with its 95 % interval
        Estimate(value=0.728, low=0.699, high=0.759)
    """
    from vjepa2_ac.evaluation.evaluate_run import evaluate_subject
    from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
    from vjepa2_ac.reports.write import write_evaluation

    if data is not None and out is None:
        needed = "a folder for the results: those in a run's own folder are of its own data"
        raise InputError(where="evaluate", found="data without out", needed=needed, fix="Name one: out=FOLDER")
    asked = EvaluationOptions(
        clips=clips,
        checkpoint=str(checkpoint),
        data=data,
        out=None if out is None else Path(out),
        probes=ProbeOptions() if probes else ProbeOptions(ranking_clips=0, landscape_clips=0, examples=0),
    )
    return write_evaluation(evaluate_subject(str(subject), asked), asked.out or Path(subject))


class _CallbackReporter(Reporter):
    """Passes messages and metrics to the callbacks of `train`."""

    def __init__(self, note: Callable[[str], None], on_step: Callable[[int, dict[str, float]], None] | None) -> None:
        self._note, self._on_step = note, on_step

    def note(self, text: str) -> None:
        self._note(text)

    def on_step(self, step: int, metrics: dict[str, float]) -> None:
        if self._on_step is not None:
            self._on_step(step, metrics)

    def on_validation(self, step: int, validation: Validation) -> None:
        from vjepa2_ac.evaluation.result import over_persistence

        by_horizon = ", ".join(f"{ratio.value:.3f}" for ratio in over_persistence(validation.errors, "rollout"))
        ranking = f"; action-ranking error {100 * validation.ranking.rank.value:.1f} %" if validation.ranking else ""
        self._note(f"Validation at step {step}: error over persistence by horizon {by_horizon}{ranking}")


def _device(device: Device) -> torch.device:
    has_cuda = torch.cuda.is_available()
    if device == "auto":
        return torch.device("cuda" if has_cuda else "cpu")
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError):
        raise InputError(where="device", found=repr(device), needed="auto, cpu, cuda, or one such as cuda:1") from None
    if found.type == "cuda" and not has_cuda:
        raise no_cuda_error(where="device", requested=str(device), instead="Take device='cpu'")
    if found.type == "cuda" and (found.index or 0) >= (count := torch.cuda.device_count()):
        needed = f"one of the {count} CUDA devices of this machine, cuda:0 to cuda:{count - 1}"
        raise InputError(where="device", found=str(device), needed=needed)
    return found
