"""Config errors as messages: all of them at once, with suggestions for misspelled names."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.config.effects import marks_of
from vjepa2_ac.storage.structured import message_of

_TYPE_OF_A_UNION = re.compile(r"int|float|str|bool|.*[\[(-].*")  # as pydantic names it in the location of an error

# Names of knobs in other programs.
_ALSO_CALLED = {
    "output_dir": "run_dir", "save_dir": "run_dir",
    "mix": "replay", "data_mix": "replay",
    "dataset": "data.path", "data_dir": "data.path",
    "num_frames": "data.frames", "frames_per_clip": "data.frames",
    "fps": "data.stride", "frameskip": "data.stride",
    "num_workers": "data.workers",
    "base_model": "model.base", "pretrained": "model.base",
    "r": "adapter.rank", "lora_r": "adapter.rank", "lora_alpha": "adapter.alpha", "lora_dropout": "adapter.dropout",
    "target_modules": "adapter.targets",
    "max_steps": "training.steps", "num_steps": "training.steps", "epochs": "training.steps",
    "num_epochs": "training.steps", "iterations": "training.steps",
    "per_device_train_batch_size": "training.batch_size",
    "gradient_accumulation_steps": "training.accumulation", "accumulate_grad_batches": "training.accumulation",
    "auto_steps": "training.rollout_steps",
    "lr": "training.learning_rate", "max_lr": "training.learning_rate", "min_lr": "training.final_learning_rate",
    "wd": "training.weight_decay", "warmup": "training.warmup_steps",
    "grad_clip": "training.max_grad_norm", "clip_grad": "training.max_grad_norm",
    "amp": "training.precision", "mixed_precision": "training.precision",
    "activation_checkpointing": "training.gradient_checkpointing",
    "torch_compile": "training.compile", "logging_steps": "training.log_every",
    "eval_steps": "validation.every", "save_steps": "checkpoint.every",
}  # fmt: skip


def wrong_values(error: ValidationError) -> list[str]:
    """Return a line for every wrong value; a knob that may be of several types gets one line, not one per type."""
    found: dict[str, list[str]] = {}
    for detail in error.errors(include_url=False):
        if detail["type"] != "default_factory_not_called":  # a default that follows from another value, which is wrong
            key = _key_of(detail["loc"]) + ".source" * (detail["type"] == "union_tag_invalid")
            found.setdefault(key, []).append(_explain(key, detail))
    return [f"{key}: {_joined(lines)}".removeprefix(": ") for key, lines in found.items()]


def all_keys() -> list[str]:
    """Return the dotted keys of all sections and knobs."""
    paths = [key.split(".") for key in marks_of(Config)]
    return list(dict.fromkeys(".".join(path[:depth]) for path in paths for depth in range(1, len(path) + 1)))


def _key_of(location: Sequence[Any]) -> str:
    """Return the dotted key of pydantic's location, without its names for forms of data and types of a union."""
    parts: list[str] = []
    for before, part in zip(["", *location], map(str, location), strict=False):
        is_form = before == "data" and part in DataConfig.kinds
        is_type = ".".join(parts) in all_keys() and _TYPE_OF_A_UNION.fullmatch(part)
        if not is_form and not is_type:
            parts.append(part)
    return ".".join(parts)


def _joined(lines: list[str]) -> str:
    """Return the messages of the types of a union, which are about the same value, as one."""
    *others, last = dict.fromkeys(lines)
    return ", or ".join([*(line.split(" (found ")[0] for line in others), last])


def _explain(key: str, detail: Any) -> str:
    if detail["type"] == "missing":
        return "missing; it has no default"
    if detail["type"] == "union_tag_invalid":
        return f"Input should be {' or '.join(map(repr, DataConfig.kinds))} (found {detail['ctx']['tag']!r})"
    if detail["type"] != "extra_forbidden":
        return message_of(detail)
    section, _, name = key.rpartition(".")
    if key in all_keys():
        owners = [source for source, kind in DataConfig.kinds.items() if name in kind.model_fields]
        return f"a section of source {' or '.join(owners)}, and this is source {detail['loc'][-2]}"
    siblings = [one.rpartition(".")[2] for one in all_keys() if one.rpartition(".")[0] == section]
    prefix = f"{section}." if section else ""
    close = [prefix + one for one in difflib.get_close_matches(name, siblings, n=1)]
    elsewhere = [one for one in all_keys() if one.endswith(f".{name}")]
    also = [_ALSO_CALLED[name]] if name in _ALSO_CALLED else []
    meant = next(iter([*also, *close, *elsewhere]), None)
    hint = f"known here: {', '.join(siblings)}" if meant is None else f"did you mean {meant.removeprefix(prefix)}?"
    return f"unknown key; {hint}"
