"""The launch of a run: its device, precision and number of processes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import timedelta

from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import InitProcessGroupKwargs

from vjepa2_ac.config import Config
from vjepa2_ac.distributed.device import computing_device
from vjepa2_ac.errors import InputError

LONGEST_WAIT = timedelta(hours=2)  # of a process for the others: one may be indexing a data set
_OTHER_WAYS = {
    "ACCELERATE_USE_DEEPSPEED": "DeepSpeed",
    "ACCELERATE_USE_MEGATRON_LM": "Megatron-LM",
    "ACCELERATE_USE_PARALLELISM_CONFIG": "a parallelism config",
}
_OPTIONS = {  # that would have no effect, and have no recognisable default
    "FSDP_OFFLOAD_PARAMS": ("--fsdp_offload_params true", "Start without it"),
    "FSDP_ACTIVATION_CHECKPOINTING": (
        "--fsdp_activation_checkpointing true",
        "Start without it, and set training.gradient_checkpointing=true",
    ),
}


def make_accelerator(config: Config) -> Accelerator:
    """Return the device and precision of a run.

    With several processes it joins them.

    Raises:
        InputError: CUDA was requested and there is none, the device does not compute so (fp16 on a CPU, bf16 on an old
            GPU), or an unsupported launch.
    """
    check_launch(config)
    training, on_cpu = config.training, computing_device(config.training).type == "cpu"
    AcceleratorState._reset_state(reset_partial_state=False)  # or a second run keeps the first's precision
    precision = "no" if training.precision == "fp32" else training.precision
    patience = InitProcessGroupKwargs(timeout=LONGEST_WAIT)
    return Accelerator(mixed_precision=precision, cpu=on_cpu, kwargs_handlers=[patience])


def check_launch(config: Config, environment: Mapping[str, str] = os.environ) -> None:
    """Refuse unsupported ways to shard a model, and runs that FSDP2 cannot shard.

    Raises:
        InputError: Any of these, with a fix.
    """
    for name, way in _OTHER_WAYS.items():
        if _is_set(environment, name):
            raise _refusal(way, "processes that share clips, or weights by FSDP2", "Start it without that")
    if not shares_weights(environment):
        return
    version = environment.get("FSDP_VERSION", "1")
    if version != "2":
        raise _refusal(f"FSDP version {version}", "version 2", "Add --fsdp_version 2")
    _check_run(config)
    for name, (option, way_out) in _OPTIONS.items():
        if _is_set(environment, name):
            raise _refusal(option, "FSDP2 without it", way_out)


def shares_weights(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether the launch requests FSDP."""
    return _is_set(environment, "ACCELERATE_USE_FSDP")


def _check_run(config: Config) -> None:
    """Refuse runs whose weights FSDP2 cannot shard."""
    training, untried, without = config.training, "together they are untried", "Start without --use_fsdp"
    clips = "clips for every process: one without would leave the others waiting"
    whole = "Set data.broken_episodes=error, or start without --use_fsdp"
    skips = any(data.broken_episodes == "skip" for data in config.data_sets)
    for knob, is_set, needed, fix in (
        ("adapter.kind lora", config.adapter.kind == "lora", "adapter.kind none: an adapter needs no shards", without),
        ("training.optimizer adamw_8bit", training.optimizer == "adamw_8bit", "adamw", "Set training.optimizer=adamw"),
        ("training.compile blocks", training.compile != "off", f"off: {untried}", "Set training.compile=off"),
        ("training.cuda_graph", training.cuda_graph, f"false: {untried}", "Set it to false"),
        ("data.broken_episodes skip", skips, clips, whole),
    ):
        if is_set:
            raise _refusal(f"FSDP with {knob}", needed, fix)


def _is_set(environment: Mapping[str, str], name: str) -> bool:
    return environment.get(name, "false").lower() in {"1", "true", "yes", "on"}


def _refusal(found: str, needed: str, fix: str) -> InputError:
    return InputError(where="accelerate launch", found=found, needed=needed, fix=fix)
