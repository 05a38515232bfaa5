"""Draft a complete config: values with reasons, a batch size that fits into GPU memory, and the estimated cost."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from vjepa2_ac import storage
from vjepa2_ac.config import Config, EncoderConfig, ModelConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.config.model import RANDOM, ModelSizes
from vjepa2_ac.errors import counted
from vjepa2_ac.init.dataset_properties import DatasetProperties
from vjepa2_ac.init.draft_values import DraftValue, DraftValues, format_yaml, list_guesses, plain_values
from vjepa2_ac.intervals import MIN_EPISODES
from vjepa2_ac.model.checkpoints import base_sizes
from vjepa2_ac.model.model_files import OFFICIAL, PUBLISHED
from vjepa2_ac.storage.paths import BUILTIN
from vjepa2_ac.training.config_warnings import list_config_warnings
from vjepa2_ac.training.cost import GIGABYTE, USUAL_GPU, estimate_memory

RELEASED = "checkpoints/vjepa2-ac-vitg.pt"
SCRATCH_ENCODER = "checkpoints/vjepa2.1-vitb-384.pt"
TINY = f"{BUILTIN}sim-tiny"
_BATCHES_WITHOUT_GPU = ((4, False), (4, True), (2, True), (1, True))  # candidates: batch size, gradient checkpointing
_BATCHES_ON_GPU = ((16, False), (8, False), *_BATCHES_WITHOUT_GPU)
_CLIPS_PER_STEP = 32  # clips per optimizer step, except for the tiny model
_MODEL_STEP_S = 4 / 15  # shortest of the likely model steps of the released model: 0.27, 0.53 and 1 s
_FEW_EPISODES = 500  # with more episodes, clips have 16 frames instead of 8
_MAX_TEST_SHARE = 0.35
_SHARES = ((5_000, 0.02), (500, 0.05), (100, 0.1), (0, 0.15))  # (episodes, held-out share with more episodes than this)
_MIN_FRAMES = 3  # two rollout steps and the first frame
_CLIPS_PER_CONTROL_STEP = 3  # training clips per control step of the data; determines the number of steps
_MIN_STEPS, _MAX_STEPS = 200, 100_000
_MIN_STEPS_FOR_IDLE_FILTER = 100  # control steps; the filter for idle steps is not used for shorter episodes
_CACHE_SHARE = 1 / 3  # share of the free disk space that a latent cache may use
_INPUT_OUTPUT_PROJECTIONS = ["predictor_embed", "predictor_proj", "action_encoder", "state_encoder"]


@dataclass(frozen=True)
class Machine:
    """The hardware of a machine: GPU, CPU cores and disk space."""

    gpu: str | None
    gpu_bytes: int  # memory of the GPU; without a GPU, the memory that is assumed for the training machine
    has_bf16: bool  # whether the GPU supports bfloat16
    cores: int
    free_bytes: int  # free disk space in the working directory

    @property
    def precision(self) -> Literal["bf16", "fp16", "fp32"]:
        """The preferred precision; fp32 on a CPU, because most CPUs emulate bf16, which is many times slower."""
        if self.gpu is None:
            return "fp32"
        return "bf16" if self.has_bf16 else "fp16"

    @property
    def memory_text(self) -> str:
        """The GPU memory that a batch may use, as text."""
        return f"{self.gpu_bytes / GIGABYTE:.1f} GB of GPU memory{'' if self.gpu else ' (assumed)'}"

    @property
    def description(self) -> str:
        """A one-line description."""
        gpu = f"{self.gpu} with {self.memory_text}" if self.gpu else "no GPU"
        cores = counted(self.cores, "CPU core")
        return f"{gpu}, {cores}, {self.free_bytes / GIGABYTE:.0f} GB of free disk space"


def detect_machine() -> Machine:
    """Return the hardware of this machine."""
    import torch

    from vjepa2_ac.distributed import cuda_index, has_bf16

    cores, free = len(os.sched_getaffinity(0)), storage.free_bytes(Path.cwd())
    if not torch.cuda.is_available():
        return Machine(None, USUAL_GPU, False, cores, free)
    device = torch.device("cuda", cuda_index())
    gpu = torch.cuda.get_device_properties(device)
    return Machine(gpu.name, gpu.total_memory, has_bf16(), cores, free)


@dataclass(frozen=True)
class ModelChoice:
    """The model to train: a pre-trained predictor, or a new predictor on an encoder."""

    path: str
    is_scratch: bool  # whether a new predictor is trained; `path` is then the path of the encoder
    sizes: ModelSizes

    @property
    def bytes_per_frame(self) -> int:
        """Bytes of one frame's latents in bfloat16."""
        return 2 * self.sizes.tokens_per_frame * self.sizes.encoder.width

    @property
    def is_tiny(self) -> bool:
        """Whether the model is included in the package."""
        return self.path.startswith(BUILTIN)

    @property
    def download(self) -> tuple[str, str] | None:
        """The command that downloads the model, and its size; None if the model is not a published one."""
        for model in PUBLISHED:
            if Path(self.path) == Path("checkpoints", model.file):
                command = "vjepa2-ac download" if model.name == OFFICIAL else f"vjepa2-ac download {model.name}"
                return command, f"{model.gigabytes:g} GB"
        return None


def choose_model(path: str | None, is_scratch: bool = False) -> ModelChoice:
    """Return the model to train, with its sizes.

    Args:
        path: The value of `model.base` or `model.encoder.path`; None: the released model.
        is_scratch: Whether to train a new predictor on an encoder.

    Raises:
        InputError: There is no model at the path.
    """
    path = path or (SCRATCH_ENCODER if is_scratch else RELEASED)
    config = ModelConfig(base=path)
    if is_scratch and not path.startswith(BUILTIN):
        config = ModelConfig(base=RANDOM, encoder=EncoderConfig(path=path))
    return ModelChoice(path, is_scratch, base_sizes(config))


@dataclass(frozen=True)
class Draft:
    """A drafted config, with the reasons of its values and the estimated costs."""

    config_values: DraftValues
    config: Config
    costs: list[str]  # lines of text: memory and disk space
    warnings: list[str] = field(default_factory=list)  # sentences; see `training.config_warnings`

    def to_yaml(self, data: DatasetProperties, machine: Machine) -> str:
        """Return the config as commented YAML."""
        header = [
            f"Written by `vjepa2-ac init` for {data.path}: {'; '.join(data.descriptions)}.",
            f"Machine: {machine.description}.",
            *self.costs,
            *(f"Warning: {text}." for text in self.warnings),
            "All other config keys keep their defaults: `vjepa2-ac config show CONFIG` prints every value, and",
            "`vjepa2-ac config schema` describes every key. docs/training.md explains the choices for training.",
        ]
        if "(sim)" in format_yaml([], self.config_values):
            header.append("(sim) marks results that were measured on the simulated arm with its tiny model.")
        if guessed_keys := list_guesses(self.config_values):
            header.append(f"Check the values marked GUESSED: {', '.join(guessed_keys)}.")
        return format_yaml(header, self.config_values)


def make_draft(data: DatasetProperties, machine: Machine, model: ModelChoice, *, run_dir: str) -> Draft:
    """Draft a config for a data set and a machine.

    Args:
        data: The properties of the data set.
        machine: The hardware.
        model: The model to train.
        run_dir: Folder of the run.

    Raises:
        InputError: The values are not a valid config.
    """
    training = _make_training_section(data, machine, model)
    validation_every = max(20, min(1_000, int(plain_values(training)["steps"]) // 10))
    values: DraftValues = {
        "run_dir": DraftValue(run_dir),
        "seed": DraftValue(0),
        "data": _make_data_section(data, machine, model),
        "model": _make_model_section(model, machine),
        "adapter": _make_adapter_section(model, data),
        "training": training,
        "validation": {
            "every": DraftValue(validation_every, "in steps; the best checkpoint is rarely the last one"),
            "clips": DraftValue(64),
        },
        "checkpoint": {
            "every": DraftValue(validation_every),
            "keep": DraftValue(3, "checkpoints, in addition to the best one"),
            "keep_best": DraftValue(
                "ranking", "the prediction error may fall while planning gets worse (docs/training.md)"
            ),
        },
    }
    config = parse_config(plain_values(values), where="vjepa2-ac init")
    # A guessed control rate gives no reliable duration of a model step.
    warnings = list_config_warnings(config, None if data.rate_hz.is_guess else data.rate_hz.value)
    costs: list[str] = []
    if data.steps and config.data.uses_cached_latents:
        costs.append(
            f"Disk space for cached latents: at most {_format_gigabytes(data.steps * model.bytes_per_frame)} GB."
        )
    if model.is_tiny:
        return Draft(values, config, costs, warnings)
    batch, checkpointing, needed = _choose_batch(config, machine)
    verdict = "fits into" if needed <= machine.gpu_bytes else "does not fit into"
    batch_values = {
        "batch_size": DraftValue(batch, f"{verdict} {machine.memory_text}"),
        "accumulation": DraftValue(
            _CLIPS_PER_STEP // batch, f"micro-batches per optimizer step; {_CLIPS_PER_STEP} clips per step"
        ),
        "gradient_checkpointing": DraftValue(
            checkpointing, "required to fit into memory" if checkpointing else "not required to fit into memory"
        ),
    }
    values = {**values, "training": {**training, **batch_values}}
    costs.insert(0, f"Estimated peak GPU memory: {needed / GIGABYTE:.1f} GB, which {verdict} {machine.memory_text}.")
    if machine.gpu is None:
        costs.append("Run `vjepa2-ac init` on the training machine to choose batch size and precision for its GPU.")
    return Draft(values, parse_config(plain_values(values), where="vjepa2-ac init"), costs, warnings)


def _format_gigabytes(size: float) -> str:
    return f"{max(0.1, size / GIGABYTE):,.1f}"


def _choose_batch(config: Config, machine: Machine) -> tuple[int, bool, int]:
    """Return the first candidate that fits, or the last: batch size, gradient checkpointing, estimated peak bytes."""
    sizes = base_sizes(config.model)
    for batch, checkpointing in _BATCHES_ON_GPU if machine.gpu else _BATCHES_WITHOUT_GPU:
        training = config.training.model_copy(update={"batch_size": batch})
        estimate = estimate_memory(config.model_copy(update={"training": training}), sizes)
        needed = int(estimate.total(checkpointing=checkpointing))
        if needed <= machine.gpu_bytes:
            break
    return batch, checkpointing, needed


def _make_data_section(data: DatasetProperties, machine: Machine, model: ModelChoice) -> DraftValues:
    """Return the section `data`."""
    stride = max(1, round(data.rate_hz.value * _MODEL_STEP_S))
    stride_reason = (
        f"{stride / data.rate_hz.value:.2f} s per model step at {data.rate_hz.value:g} control steps per second; "
        "the released model may suit 0.27, 0.53 or 1 s, which `data calibrate` compares"
    )
    size = (data.steps or math.inf) * model.bytes_per_frame
    is_cached = size <= machine.free_bytes * _CACHE_SHARE
    cache_reason = f"each frame is encoded once ({_format_gigabytes(size)} GB at most); training then needs no encoder"
    workers = max(1, min(4 if is_cached else 8, machine.cores - 1))
    vector = DraftValue("vector", "states are vectors of measured numbers; actions are their differences")
    return {
        "source": DraftValue(data.source),
        "path": DraftValue(data.path),
        **({} if data.states == "pose" else {"states": vector}),
        **data.config_values,
        "frames": _choose_num_frames(data, model, stride),
        "stride": DraftValue(stride, stride_reason, data.rate_hz.is_guess),
        **{
            f"{split}_share": value
            for split, value in _choose_shares(data).items()
            if split not in data.predefined_splits
        },
        **(
            {"idle": data.idle}
            if data.idle and (data.median_steps or _MIN_STEPS_FOR_IDLE_FILTER) >= _MIN_STEPS_FOR_IDLE_FILTER
            else {}
        ),
        **({"cache": DraftValue("auto", cache_reason)} if is_cached else {}),
        "workers": DraftValue(workers, f"for {counted(machine.cores, 'CPU core')}"),
    }


def _make_model_section(model: ModelChoice, machine: Machine) -> DraftValues:
    """Return the section `model`."""
    dtype = DraftValue("float32" if model.is_tiny or machine.precision != "bf16" else "bfloat16")
    path = DraftValue(model.path, ": ".join(model.download or ()))
    if model.is_scratch:
        return {
            "base": DraftValue(RANDOM, "a new predictor, initialised close to copying the last frame"),
            "encoder": {"path": path} if model.is_tiny else {"path": path, "frame": DraftValue("tubelet")},
            "sizes": _make_predictor_sizes(model),
            "dtype": dtype,
        }
    if model.is_tiny:
        path = DraftValue(
            model.path, "trained on a simulated arm only; for trying the commands, not for results on real data"
        )
    return {"base": path, "dtype": dtype}


def _make_adapter_section(model: ModelChoice, data: DatasetProperties) -> DraftValues:
    """Return the section `adapter`."""
    if model.is_scratch:
        return {"kind": DraftValue("none", "all weights of a new predictor are trained")}
    modules = ["state_encoder", "action_encoder"] if data.states == "vector" else _INPUT_OUTPUT_PROJECTIONS
    reason = "trained as whole matrices, which lowers the error at every rank (sim)"
    if data.states == "vector":
        reason = "trained from scratch, because states are not poses"
    return {
        "kind": DraftValue("lora"),
        "rank": DraftValue(
            32, "with modules_to_save, same error as full fine-tuning; rank 8 plans equally well, rank 4 worse (sim)"
        ),
        "alpha": DraftValue(32, "for every rank: rsLoRA scales by alpha / sqrt(rank)"),
        "rslora": DraftValue(True),
        "targets": DraftValue(["q", "k", "v", "o", "fc1", "fc2"]),
        "modules_to_save": DraftValue(modules, reason),
    }


def _make_training_section(data: DatasetProperties, machine: Machine, model: ModelChoice) -> DraftValues:
    """Return the section `training`. `make_draft` replaces the batch size by one that fits into GPU memory."""
    batch, accumulation = (8, 1) if model.is_tiny else (4, _CLIPS_PER_STEP // 4)
    learning_rate = DraftValue(1e-4, "also try 3e-4")
    if model.is_tiny:
        learning_rate = DraftValue(3e-3)
    elif model.is_scratch:
        learning_rate = DraftValue(
            1.5e-4, "V-JEPA 2-AC's 4.25e-4 for 256 clips per step, times sqrt(32 / 256); not tested"
        )
    allow_weak_base = DraftValue(True, "accepts the tiny model, which was not trained on real images")
    no_gpu = "no GPU; on Ampere or newer GPUs use bf16" + ("" if model.is_tiny else " and model.dtype: bfloat16")
    precision_reason = {"fp32": no_gpu, "fp16": "this GPU does not support bf16", "bf16": ""}[machine.precision]
    return {
        "steps": _choose_num_steps(data, batch * accumulation),
        "batch_size": DraftValue(batch),
        "accumulation": DraftValue(accumulation),
        "rollout_steps": DraftValue(2),
        "learning_rate": learning_rate,
        "precision": DraftValue(machine.precision, precision_reason),
        "gradient_checkpointing": DraftValue(False),
        **({"allow_weak_base": allow_weak_base} if model.is_tiny and not model.is_scratch else {}),
    }


def _choose_num_frames(data: DatasetProperties, model: ModelChoice, stride: int) -> DraftValue:
    frames = 4 if model.is_tiny else 16 if (data.episodes or 0) > _FEW_EPISODES else 8
    if data.median_steps is None or data.p10_steps is None:
        return DraftValue(frames, "per clip, one per model step")
    max_frames = 1 + (min(data.median_steps // 2, data.p10_steps) - 1) // stride
    frames = max(_MIN_FRAMES, min(max_frames, frames))
    lengths = f"half of the episodes have at least {data.median_steps}, one in ten has at most {data.p10_steps}"
    return DraftValue(frames, f"a clip spans {counted((frames - 1) * stride + 1, 'control step')}; {lengths}")


def _choose_shares(data: DatasetProperties) -> dict[Split, DraftValue]:
    """Return the shares of validation and test; with few episodes the test share is raised for a usable interval."""
    share, test_share, reason = 0.05, 0.05, "share of the episodes, selected by a hash; at least one episode"
    if data.episodes is not None:
        share = next(share for minimum, share in _SHARES if data.episodes > minimum or minimum == 0)
        count = max(1, round(share * data.episodes))
        required = min(_MAX_TEST_SHARE, math.ceil(100 * (MIN_EPISODES + 1) / data.episodes) / 100)
        test_share = max(share, required)
        about = "about " if data.episodes > 1 else ""
        reason = f"{about}{count:,} of {counted(data.episodes, 'episode')}, selected by a hash"
    return {
        "validation": DraftValue(share, reason),
        "test": DraftValue(test_share, "episodes for `evaluate`; not used in training or validation"),
    }


def _choose_num_steps(data: DatasetProperties, clips_per_step: int) -> DraftValue:
    if data.steps is None:
        return DraftValue(_MIN_STEPS, "for a first run; docs/training.md explains how to choose the number")
    # Each control step starts a clip.
    steps_for_passes = math.ceil(_CLIPS_PER_CONTROL_STEP * data.steps / _CLIPS_PER_STEP / 100) * 100
    steps = max(_MIN_STEPS, min(_MAX_STEPS, steps_for_passes))
    clips = steps * clips_per_step / data.steps
    return DraftValue(steps, f"{clips:.2g} clips per control step of the data; more steps may make planning worse")


def _make_predictor_sizes(model: ModelChoice) -> DraftValues:
    if model.is_tiny:
        return {
            "image_size": DraftValue(96),
            "predictor": {"width": DraftValue(128), "depth": DraftValue(4), "heads": DraftValue(4)},
        }
    width = model.sizes.encoder.width
    reason = "equal to the width of the latents, so that training can start from copying"
    predictor = {"width": DraftValue(width, reason), "depth": DraftValue(12), "heads": DraftValue(width // 64)}
    return {"image_size": DraftValue(256, "256 tokens per frame"), "predictor": predictor}
