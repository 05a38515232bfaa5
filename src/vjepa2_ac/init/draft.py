"""Draft a complete config: values with reasons, a batch size that fits on the GPU, and the estimated cost."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vjepa2_ac import storage
from vjepa2_ac.config import Config, EncoderConfig, ModelConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.config.model import RANDOM, ModelSizes
from vjepa2_ac.errors import counted
from vjepa2_ac.init.found import FoundData, Knob, Knobs, as_yaml, guesses, plain
from vjepa2_ac.intervals import ENOUGH_EPISODES
from vjepa2_ac.model.checkpoints import base_sizes
from vjepa2_ac.model.model_files import OFFICIAL, PUBLISHED
from vjepa2_ac.storage.paths import BUILTIN
from vjepa2_ac.training.cost import GIGABYTE, USUAL_GPU, estimate_memory

RELEASED = "checkpoints/vjepa2-ac-vitg.pt"
SCRATCH_ENCODER = "checkpoints/vjepa2.1-vitb-384.pt"
TINY = f"{BUILTIN}sim-tiny"
_BATCHES = ((4, False), (4, True), (2, True), (1, True))  # candidates: batch size, gradient checkpointing
_BATCHES_ON_GPU = ((16, False), (8, False), *_BATCHES)
_CLIPS_A_STEP = 32  # clips per optimizer step, except for the tiny model
_MODEL_STEP_S = 4 / 15  # the shortest of the likely model steps of the released weights: 0.27, 0.53 and 1 s
_FEW_EPISODES = 500  # up to this number the advice for few demonstrations applies
_MOST_TESTED = 0.35  # largest test share
_SHARES = ((5_000, 0.02), (500, 0.05), (100, 0.1), (0, 0.15))  # held-out share if there are more episodes than this
_LEAST_FRAMES = 3  # two rollout steps and the first frame
_PASSES = 3  # clips for each control step of the data
_LEAST_STEPS, _MOST_STEPS = 200, 100_000
_SHORT = 100  # control steps; shorter episodes are used without a filter for idle steps
_CACHE_SHARE = 1 / 3  # share of the free disk space that a latent cache may use
_IN_AND_OUT = ["predictor_embed", "predictor_proj", "action_encoder", "state_encoder"]


@dataclass(frozen=True)
class Machine:
    """The hardware of a machine: GPU, CPU cores and disk space."""

    gpu: str | None
    gpu_bytes: int  # memory of the GPU, or of a usual GPU if the machine has none
    has_bf16: bool  # whether the GPU supports bfloat16
    cores: int
    free_bytes: int  # free disk space in the working directory

    @property
    def precision(self) -> Literal["bf16", "fp16", "fp32"]:
        """The preferred precision; fp32 on a CPU, because bf16 is many times slower there without its instructions."""
        if self.gpu is None:
            return "fp32"
        return "bf16" if self.has_bf16 else "fp16"

    @property
    def room(self) -> str:
        """The GPU memory that a batch may use, as text."""
        return f"{self.gpu_bytes / GIGABYTE:.1f} GB" + ("" if self.gpu else ", a usual GPU's")

    @property
    def about(self) -> str:
        """A one-line description."""
        gpu = f"{self.gpu}, {self.room}" if self.gpu else "no GPU"
        return f"{gpu}; {counted(self.cores, 'core')}; {self.free_bytes / GIGABYTE:.0f} GB of disk free"


def this_machine() -> Machine:
    """Return the hardware of this machine."""
    import torch

    from vjepa2_ac.distributed import cuda_index, has_bf16

    cores, free = len(os.sched_getaffinity(0)), storage.free_bytes(Path.cwd())
    if not torch.cuda.is_available():
        return Machine(None, USUAL_GPU, False, cores, free)
    device = torch.device("cuda", cuda_index())
    card = torch.cuda.get_device_properties(device)
    return Machine(card.name, card.total_memory, has_bf16(), cores, free)


@dataclass(frozen=True)
class ModelChoice:
    """The model to train: a pre-trained predictor, or a new predictor on an encoder."""

    path: str
    is_scratch: bool  # whether a new predictor is trained; `path` is then that of the encoder
    sizes: ModelSizes

    @property
    def bytes_a_frame(self) -> int:
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

    knobs: Knobs
    config: Config
    costs: list[str]  # lines of text: memory and disk space

    def text(self, data: FoundData, machine: Machine) -> str:
        """Return the config as commented YAML."""
        head = [
            f"Written by `vjepa2-ac init` for {data.path}: {'; '.join(data.about)}.",
            f"Machine: {machine.about}.",
            *self.costs,
            "Every other knob has its default: `vjepa2-ac config show` prints all, and docs/training.md explains them.",
            "(sim): measured on the simulated arm with its tiny model, not on your robot.",
        ]
        if unsure := guesses(self.knobs):
            head.append(f"Look at what is marked GUESSED: {', '.join(unsure)}.")
        return as_yaml(head, self.knobs)


def make_draft(data: FoundData, machine: Machine, model: ModelChoice, *, run_dir: str) -> Draft:
    """Draft a config for a data set and a machine.

    Args:
        data: The properties of the data set.
        machine: The hardware.
        model: The model to train.
        run_dir: Folder of the run.

    Raises:
        InputError: The values are not a valid config.
    """
    training = _training(data, machine, model)
    every = max(20, min(1_000, int(plain(training)["steps"]) // 10))
    knobs: Knobs = {
        "run_dir": Knob(run_dir),
        "seed": Knob(0),
        "data": _data(data, machine, model),
        "model": _model(model, machine),
        "adapter": _adapter(model, data),
        "training": training,
        "validation": {"every": Knob(every, "the best checkpoint is rarely the last"), "clips": Knob(64)},
        "checkpoint": {
            "every": Knob(every),
            "keep": Knob(3, "and the best one"),
            "keep_best": Knob("ranking", "not by error: it may fall while planning gets worse (docs/training.md)"),
        },
    }
    config = parse_config(plain(knobs), where="vjepa2-ac init")
    costs: list[str] = []
    if data.steps and config.data.takes_latents:
        costs.append(f"Disk: at most {_gigabytes(data.steps * model.bytes_a_frame)} GB of cached latents.")
    if model.is_tiny:
        return Draft(knobs, config, costs)
    batch, checkpointing, needed = _fit(config, machine)
    fits = "fits" if needed <= machine.gpu_bytes else "does NOT fit"
    fitted = {
        "batch_size": Knob(batch, f"{fits} on {machine.room}"),
        "accumulation": Knob(_CLIPS_A_STEP // batch, f"{_CLIPS_A_STEP} clips a step"),
        "gradient_checkpointing": Knob(checkpointing, "does not fit without" if checkpointing else "fits without"),
    }
    knobs = {**knobs, "training": {**training, **fitted}}
    costs.insert(0, f"Memory, as `vjepa2-ac doctor` counts: {needed / GIGABYTE:.1f} GB; {fits} on {machine.room}.")
    if machine.gpu is None:
        costs.append("`vjepa2-ac init` on the machine with the GPU sets batch size and precision.")
    return Draft(knobs, parse_config(plain(knobs), where="vjepa2-ac init"), costs)


def _gigabytes(size: float) -> str:
    return f"{max(0.1, size / GIGABYTE):,.1f}"


def _fit(config: Config, machine: Machine) -> tuple[int, bool, int]:
    """Return the first candidate that fits, or the last: batch size, gradient checkpointing, estimated peak bytes."""
    sizes = base_sizes(config.model)
    for batch, checkpointing in _BATCHES_ON_GPU if machine.gpu else _BATCHES:
        training = config.training.model_copy(update={"batch_size": batch})
        estimate = estimate_memory(config.model_copy(update={"training": training}), sizes)
        needed = int(estimate.total(checkpointing=checkpointing))
        if needed <= machine.gpu_bytes:
            break
    return batch, checkpointing, needed


def _data(data: FoundData, machine: Machine, model: ModelChoice) -> Knobs:
    """Return the section `data`."""
    stride = max(1, round(data.rate_hz.value * _MODEL_STEP_S))
    why_stride = (
        f"a model step of {stride / data.rate_hz.value:.2f} s at {data.rate_hz.value:g} control steps a second; "
        "`data calibrate` compares others: the released weights may suit 0.27, 0.53 or 1 s"
    )
    size = (data.steps or math.inf) * model.bytes_a_frame
    is_cached = size <= machine.free_bytes * _CACHE_SHARE
    why_cached = f"each frame is encoded once: {_gigabytes(size)} GB at most; training then needs no encoder"
    workers = max(1, min(4 if is_cached else 8, machine.cores - 1))
    vector = Knob("vector", "the robot's own numbers: its actions are their differences")
    return {
        "source": Knob(data.source),
        "path": Knob(data.path),
        **({} if data.states == "pose" else {"states": vector}),
        **data.knobs,
        "frames": _frames(data, model, stride),
        "stride": Knob(stride, why_stride, data.rate_hz.is_guess),
        **{f"{split}_share": knob for split, knob in _shares(data).items() if split not in data.own_splits},
        **({"idle": data.idle} if data.idle and (data.usual_steps or _SHORT) >= _SHORT else {}),
        **({"cache": Knob("auto", why_cached)} if is_cached else {}),
        "workers": Knob(workers, f"of {counted(machine.cores, 'core')}"),
    }


def _model(model: ModelChoice, machine: Machine) -> Knobs:
    """Return the section `model`."""
    dtype = Knob("float32" if model.is_tiny or machine.precision != "bf16" else "bfloat16")
    path = Knob(model.path, ": ".join(model.download or ()))
    if model.is_scratch:
        return {
            "base": Knob(RANDOM, "a fresh predictor, which starts close to copying the last frame"),
            "encoder": {"path": path} if model.is_tiny else {"path": path, "frame": Knob("tubelet")},
            "sizes": _fresh_predictor(model),
            "dtype": dtype,
        }
    if model.is_tiny:
        path = Knob(model.path, "trained on a simulated arm only: to try the commands, not for results")
    return {"base": path, "dtype": dtype}


def _adapter(model: ModelChoice, data: FoundData) -> Knobs:
    """Return the section `adapter`."""
    if model.is_scratch:
        return {"kind": Knob("none", "a fresh predictor has nothing to adapt: all of it is trained")}
    whole = ["state_encoder", "action_encoder"] if data.states == "vector" else _IN_AND_OUT
    why = "fresh: other numbers than a pose" if data.states == "vector" else "whole: less error at every rank (sim)"
    return {
        "kind": Knob("lora"),
        "rank": Knob(32, "the error of full fine-tuning with in/out whole; 8 plans as well, 4 less (sim)"),
        "alpha": Knob(32, "at any rank"),
        "rslora": Knob(True),
        "targets": Knob(["q", "k", "v", "o", "fc1", "fc2"]),
        "modules_to_save": Knob(whole, why),
    }


def _training(data: FoundData, machine: Machine, model: ModelChoice) -> Knobs:
    """Return the section `training`, with a batch size that does not depend on the GPU yet."""
    batch, accumulation = (8, 1) if model.is_tiny else (4, _CLIPS_A_STEP // 4)
    learning_rate = Knob(1e-4, "3e-4 is the other one to try")
    if model.is_tiny:
        learning_rate = Knob(3e-3)
    elif model.is_scratch:
        learning_rate = Knob(1.5e-4, "the released 4.25e-4 for 256 clips a step, times sqrt(32 / 256); not measured")
    weak = Knob(True, "the tiny model was never trained on real images")
    no_gpu = "no GPU here; on one from Ampere on: bf16" + ("" if model.is_tiny else ", and model.dtype: bfloat16")
    why_precision = {"fp32": no_gpu, "fp16": "this GPU has no bf16", "bf16": ""}[machine.precision]
    return {
        "steps": _steps(data, batch * accumulation),
        "batch_size": Knob(batch),
        "accumulation": Knob(accumulation),
        "rollout_steps": Knob(2),
        "learning_rate": learning_rate,
        "precision": Knob(machine.precision, why_precision),
        "gradient_checkpointing": Knob(False),
        **({"allow_weak_base": weak} if model.is_tiny and not model.is_scratch else {}),
    }


def _frames(data: FoundData, model: ModelChoice, stride: int) -> Knob:
    frames = 4 if model.is_tiny else 16 if (data.episodes or 0) > _FEW_EPISODES else 8
    if data.usual_steps is None or data.short_steps is None:
        return Knob(frames, "of a clip, one per model step")
    longest = 1 + (min(data.usual_steps // 2, data.short_steps) - 1) // stride
    frames = max(_LEAST_FRAMES, min(longest, frames))
    lengths = f"half of the episodes have {data.usual_steps} or more, one of ten at most {data.short_steps}"
    return Knob(frames, f"a clip spans {counted((frames - 1) * stride + 1, 'step')}; {lengths}")


def _shares(data: FoundData) -> dict[Split, Knob]:
    """Return the shares of validation and test; with few episodes the test share is raised for a usable interval."""
    share, test_share, why = 0.05, 0.05, "of the episodes, drawn by a hash, at least one"
    if data.episodes is not None:
        share = next(share for least, share in _SHARES if data.episodes > least or least == 0)
        count = max(1, round(share * data.episodes))
        enough = min(_MOST_TESTED, math.ceil(100 * (ENOUGH_EPISODES + 1) / data.episodes) / 100)
        test_share = max(share, enough)
        why = f"about {count:,} of {counted(data.episodes, 'episode')}, drawn by a hash"
    return {"validation": Knob(share, why), "test": Knob(test_share, "for `evaluate`; never seen in training")}


def _steps(data: FoundData, clips_a_step: int) -> Knob:
    if data.steps is None:
        return Knob(_LEAST_STEPS, "a first run; docs/training.md says how many")
    steps_for_passes = math.ceil(_PASSES * data.steps / _CLIPS_A_STEP / 100) * 100  # each control step starts a clip
    steps = max(_LEAST_STEPS, min(_MOST_STEPS, steps_for_passes))
    clips = steps * clips_a_step / data.steps
    return Knob(steps, f"{clips:.2g} clips for each control step of the data; more steps may make planning worse")


def _fresh_predictor(model: ModelChoice) -> Knobs:
    if model.is_tiny:
        return {"image_size": Knob(96), "predictor": {"width": Knob(128), "depth": Knob(4), "heads": Knob(4)}}
    width = model.sizes.encoder.width
    why = "as wide as the latents: it can begin at copying"
    predictor = {"width": Knob(width, why), "depth": Knob(12), "heads": Knob(width // 64)}
    return {"image_size": Knob(256, "256 tokens a frame"), "predictor": predictor}
