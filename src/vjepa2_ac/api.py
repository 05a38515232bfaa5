"""The public functions, which `vjepa2_ac` re-exports.

Modules for training and evaluation are imported inside of the functions, so that loading a model stays fast.
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

_MINIMAL_CONFIG = {  # required keys of a config for a data set alone
    "run_dir": "none",
    "data": {"source": "npz", "path": "none"},
    "model": {"base": "builtin:sim-tiny"},
    "training": {"rollout_steps": 1},
}


def open_dataset(data: str | Path | Config, **options: Any) -> Dataset:
    """Open a data set and select its usable episodes and steps.

    Args:
        data: A folder or URL in DROID's RLDS format, or in the format that `source` names; or a config, whose `data:`
            is used.
        options: Config keys of `data:`, such as `frames` and `stride`; `vjepa2-ac config schema` lists them.

    Returns:
        The data set. `len(dataset.table)` episodes, `dataset.control_rate_hz` control steps per second;
        `dataset.clips("train")` is a `torch.utils.data.Dataset` of clips; `dataset.source.read(0)` is an episode with
        its states, steps x 7.

    Raises:
        InputError: The data set does not exist or is damaged, an option is invalid, or no usable episode remains.

    Example:
        >>> dataset = open_dataset("demo/data", frames=4, stride=4)  # clips of 4 frames, 4 control steps apart
        >>> dataset = open_dataset(load_config("configs/lerobot.yaml"))
    """
    if isinstance(data, Config):
        values = config_as_dict(data)
        config = parse_config(values | {"data": values["data"] | options}, where="open_dataset") if options else data
        return datasets.open_dataset(config.data)
    if str(data).endswith((".yaml", ".yml")):
        fix = "Read it first: open_dataset(load_config(PATH))"
        raise InputError(where=str(data), found="a config", needed="the folder of a data set", fix=fix)
    return datasets.open_dataset(
        parse_config(_MINIMAL_CONFIG | {"data": {"path": str(data)} | options}, where="open_dataset").data
    )


def read_clips(dataset: Dataset, split: Split = "train", *, clips: int = 16, batch_size: int = 8) -> Iterator[Batch]:
    """Yield a fixed set of clips, spread evenly over a split, in batches. Each call yields the same clips.

    Args:
        dataset: The data set.
        split: train, validation or test: whole episodes, by the data set's own splits, or by a hash of their names
            and `validation_share`, `test_share` (`data.splits`).
        clips: Maximum number of clips.
        batch_size: Number of clips per batch; the last batch may have fewer.

    Yields:
        Batches of `frames` (clips x time x height x width x 3, uint8, RGB, cropped; None for cached latents), `states`
        (clips x time x 7: metres, radians, gripper position), `actions` (clips x time-1 x 7: the changes),
        `episode_ids` and `starts` (control steps). Axes, units and coordinate frames: `vjepa2_ac.episode`.

    Raises:
        InputError: The split has no clips, `data.stride` is auto, or a clip cannot be read.

    Example:
        >>> batch = next(read_clips(dataset, clips=8))
        >>> tuple(batch.frames.shape)
        (8, 4, 180, 243, 3)
    """
    return validation_batches(dataset, split, clips=clips, batch_size=batch_size)


@overload
def encode(model: WorldModel, clips: Batch, *, chunk: int = 16) -> LatentBatch: ...


@overload
def encode(
    model: WorldModel, clips: UInt8[np.ndarray, "*axes height width 3"], *, crop: Crop = "released", chunk: int = 16
) -> Float[Tensor, "*axes tokens dim"]: ...


def encode(
    model: WorldModel, clips: Batch | np.ndarray, *, crop: Crop = "released", chunk: int = 16
) -> LatentBatch | Tensor:
    """Return the latents of clips or frames, on the model's device; each frame is encoded independently.

    Args:
        model: The model whose encoder is used.
        clips: A batch from `read_clips`; or RGB frames, uint8, with any axes before height x width x 3.
        crop: Crop of the frames, as `data.crop`; a batch is already cropped.
        chunk: Number of frames that are encoded at once; limits the memory.

    Returns:
        For frames: latents with the same leading axes x tokens x dim, float32, layer-normalised. For a batch: a record
        with `latents` (clips x time x tokens x dim), and with the batch's `states` and `actions`, all on the device.

    Raises:
        InputError: The frames are invalid, or the model needs camera poses that the batch does not have.

    Example:
        >>> inputs = encode(model, batch)
        >>> future = model.rollout(inputs.latents[:, :1], inputs.actions, inputs.states[:, :-1])  # clips x time-1 x ...
        >>> encode(model, image).shape  # one image: tokens x dim
        torch.Size([36, 128])
    """
    if isinstance(clips, Batch):
        return encode_batch(model, clips, device=model.device, chunk=chunk)
    frames = np.asarray(clips)
    if frames.dtype != np.uint8 or frames.ndim < 3 or frames.shape[-1] != 3 or 0 in frames.shape:
        problem = f"{frames.dtype} with shape {' x '.join(map(str, frames.shape))}"
        raise InputError(where="encode", found=problem, needed="RGB frames: uint8, ... x height x width x 3")
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
        name: A model as in `model.base`: the official `.pt`, a folder from `vjepa2-ac export`, or `builtin:sim-tiny`.
        adapter: A folder from `vjepa2-ac export --to hub`, whose adapter is added to this model.
        device: A device such as cpu or cuda:1; auto: CUDA if available.
        dtype: Type of the weights; auto: bfloat16 on a GPU that supports it, otherwise float32. Trained weights of an
            adapter are float32, and so are latents.
        sizes: Sizes of an official `.pt`, which does not contain image size and heads; None: the released sizes.
        encoder: Encoder for a file that contains only a predictor: `model.encoder` or its path; None: the model's own.

    Raises:
        InputError: Model, adapter or device do not exist or cannot be used, or the adapter has another base model.

    Example:
        >>> model = load_model("builtin:sim-tiny")
        >>> model.image_size, model.num_tokens, model.latent_dim  # pixels, tokens of a frame, width of a token
        (96, 36, 128)
    """
    torch_device = _device(device)
    has_bfloat16 = torch_device.type == "cuda" and has_bf16(torch_device)
    model_values: dict[str, Any] = {
        "dtype": ("bfloat16" if has_bfloat16 else "float32") if dtype == "auto" else dtype,
        "sizes": (sizes or SizesConfig()).model_dump(),
        "encoder": encoder.model_dump() if isinstance(encoder, EncoderConfig) else encoder and {"path": str(encoder)},
    }
    config = config_of_model(str(name), where="load_model", **model_values).model
    require_weight_dtype(config, torch_device)
    model = load_base(config, seed=0)
    if adapter is not None:
        load_trained(model, adapter, trainable=False)
    return model.to(torch_device).eval()


def load_run(
    folder: str | Path,
    checkpoint: str | int = "selected",
    *,
    device: Device = "auto",
    overrides: Iterable[str] = (),
) -> Subject:
    """Load the model of a trained run, in eval mode: the base model with the adapter of a checkpoint.

    Args:
        folder: The folder of the run, as `train` returns it.
        checkpoint: selected (the best by validation, else the newest), newest, best, or a number of optimizer steps.
        device: As for `load_model`. The weights of the base model have the type `model.dtype` of the run.
        overrides: New paths of a moved base model or encoder: model.base=PATH, model.encoder.path=PATH. The
            fingerprints of the weights must be those that the run was trained with.

    Returns:
        A record with `world_model` (the adapter is not merged), `config` of the run, and `checkpoint`, its folder.

    Raises:
        InputError: The folder is not a run, checkpoint or device do not exist, or the base model cannot be loaded.

    Example:
        >>> run = load_run("runs/droid-lora", "best")
        >>> controller = Controller.of_run(run)
    """
    torch_device, folder = _device(device), Path(folder)
    if not is_run(str(folder)) and (folder / ADAPTER_FILE).is_file():
        problem, fix = "an adapter without its run", "Load it with its base model: load_model(BASE, adapter=FOLDER)"
        raise InputError(where=str(folder), found=problem, needed="the folder of a run", fix=fix)
    run = load_subject(folder, str(checkpoint), config=read_config_of_moved_run(folder, overrides))
    run.world_model.to(torch_device)
    return run


def train(
    config: Config,
    *,
    note: Callable[[str], None] = logger.info,
    on_step: Callable[[int, dict[str, float]], None] | None = None,
    check_only: bool = False,
    allow_config_change: bool = False,
) -> Path:
    """Train a model as `vjepa2-ac train` does, and return the folder of the run.

    If the folder `run_dir` contains this run, training resumes from the newest checkpoint; a finished run is not
    changed. In the main thread SIGINT (Ctrl-C), SIGTERM and SIGUSR1 stop training after the current step, and a
    checkpoint is saved.

    Args:
        config: The config, from `load_config`.
        note: Called with each message, such as the result of a validation; for example `print`.
        on_step: Called after each optimizer step with its number, from 1, and its metrics: `loss`, `grad_norm` ...
        check_only: Check data, model, folder and disk, and stop before the first step. Nothing is written.
        allow_config_change: Resume the run even if its config differs.

    Raises:
        InputError: An input cannot be used; raised before the first step if possible.
        StoppedError: A signal stopped the training (see `process`); the same call resumes it.

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
        subject: The folder of a run, which is compared with its base model; or a model, as for `load_model`.
        data: A config with the data; None: the data of the run. Required for a model.
        out: Folder for metrics.json, report.html and evaluation.png; None: the run's folder. Required with `data`.
        clips: Maximum number of clips, spread over the test episodes.
        checkpoint: For a run: selected (the best, otherwise the newest), newest, best, or a number of steps.
        probes: Whether to measure action ranking and energy landscapes and to save example clips, which takes most of
            the time.

    Returns:
        `summary`, the verdicts (`str` formats them); `error_over_persistence` of each model by horizon (below 1: better
        than persistence); `files` that were written; `evaluation`, all arrays.

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
        needed = "a folder for the results: those in a run's folder belong to the run's own data"
        raise InputError(where="evaluate", found="data without out", needed=needed, fix="Pass out=FOLDER")
    options = EvaluationOptions(
        clips=clips,
        checkpoint=str(checkpoint),
        data=data,
        out=None if out is None else Path(out),
        probes=ProbeOptions() if probes else ProbeOptions(ranking_clips=0, landscape_clips=0, examples=0),
    )
    return write_evaluation(evaluate_subject(str(subject), options), options.out or Path(subject))


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
        result = torch.device(device)
    except (RuntimeError, TypeError):
        raise InputError(
            where="device", found=repr(device), needed="auto, cpu, cuda, or a device such as cuda:1"
        ) from None
    if result.type == "cuda" and not has_cuda:
        raise no_cuda_error(where="device", requested=str(device), instead="Use device='cpu'")
    if result.type == "cuda" and (result.index or 0) >= (count := torch.cuda.device_count()):
        needed = f"one of the {count} CUDA devices of this machine, cuda:0 to cuda:{count - 1}"
        raise InputError(where="device", found=str(device), needed=needed)
    return result
