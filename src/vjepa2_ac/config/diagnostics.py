"""Config errors as messages: all of them at once, with suggestions for misspelled names."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.config.data import source_of
from vjepa2_ac.config.effects import marks_of, sections_in
from vjepa2_ac.storage.structured import message_of

_ROUNDS = 20  # more than the number of rules about several values
_MOST_LINES = 30
_LONGEST_KEY = 80

# Names of knobs in other programs, by their key here.
_ALSO_CALLED = {
    "run_dir": ("output_dir", "out_dir", "save_dir"),
    "replay": ("mix", "data_mix"),
    "data.path": ("dataset", "data_path", "data_dir", "root"),
    "data.frames": ("num_frames", "clip_frames", "frames_per_clip"),
    "data.stride": ("fps", "frame_stride", "frameskip"),
    "data.workers": ("num_workers",),
    "model.base": ("base_model", "pretrained", "pretrained_path"),
    "adapter.rank": ("r", "lora_r", "lora_rank"),
    "adapter.alpha": ("lora_alpha",),
    "adapter.dropout": ("lora_dropout",),
    "adapter.targets": ("target_modules",),
    "training.steps": ("max_steps", "num_steps", "total_steps", "iterations", "epochs", "num_epochs"),
    "training.batch_size": ("bs", "micro_batch_size", "per_device_train_batch_size"),
    "training.accumulation": (
        "grad_accum", "accumulation_steps", "gradient_accumulation_steps", "accumulate_grad_batches",
    ),
    "training.rollout_steps": ("auto_steps",),
    "training.learning_rate": ("lr", "peak_lr", "max_lr"),
    "training.final_learning_rate": ("min_lr", "final_lr"),
    "training.start_learning_rate": ("start_lr",),
    "training.weight_decay": ("wd",),
    "training.warmup_steps": ("warmup",),
    "training.max_grad_norm": ("grad_clip", "clip_grad", "clip_grad_norm", "gradient_clipping"),
    "training.precision": ("amp", "mixed_precision"),
    "training.gradient_checkpointing": ("activation_checkpointing", "grad_checkpointing"),
    "training.compile": ("torch_compile",),
    "training.log_every": ("logging_steps",),
    "validation.every": ("eval_every", "eval_steps"),
    "checkpoint.every": ("save_every", "save_steps"),
}  # fmt: skip


def wrong_values(values: Mapping[str, Any], error: ValidationError) -> list[str]:
    """Return a line for every error in plain values, given their validation error.

    Rules about several values are only checked when each single value is valid. Invalid values are therefore removed,
    and the rest is checked again; messages about removed values are then ignored.
    """
    left, found, taken = json.loads(json.dumps(values)), _errors_in(error), set[str]()
    lines: list[str] = []
    for _ in range(_ROUNDS):
        messages = _messages_of([one for one in found if not _is_about(one, taken)])
        lines += [line for line in messages if line not in lines]
        if len(lines) >= _MOST_LINES:
            return [*lines[:_MOST_LINES], "and more, which are not looked at before these are right"]
        before = json.dumps(left)
        for one in found:
            taken |= _take_out(left, one)
        _stand_in(left, taken)
        if json.dumps(left) == before:
            break
        try:
            Config.model_validate_json(json.dumps(left))
            break
        except ValidationError as again:
            found = _errors_in(again)
    return lines


def _errors_in(error: ValidationError) -> list[Any]:
    """Return the errors but those of defaults that follow from another value, which is wrong."""
    found = error.errors(include_url=False)
    return [one for one in found if one["type"] != "default_factory_not_called"][:_MOST_LINES]


def all_keys() -> list[str]:
    """Return the dotted keys of all sections and knobs."""
    paths = [key.split(".") for key in marks_of(Config)]
    return list(dict.fromkeys(".".join(path[:depth]) for path in paths for depth in range(1, len(path) + 1)))


def _messages_of(details: Sequence[Any]) -> list[str]:
    """Return a line for each invalid value: a value that may be of several types gets one line, not one per type."""
    kinds: dict[tuple[Any, ...], list[Any]] = {}
    for detail in details:
        kinds.setdefault(_union_of(detail["loc"]) or (*detail["loc"], detail["msg"]), []).append(detail)
    lines = []
    for together in kinds.values():
        deepest = max(len(detail["loc"]) for detail in together)  # of the type that fits best
        line, *others = [_explain(detail) for detail in together if len(detail["loc"]) == deepest]
        also = [other.split("Input should be ", 1)[-1].split(" (found ", 1)[0] for other in others]
        message, found, rest = line.partition(" (found ")
        lines.append(", or ".join([message, *also]) + found + rest)
    return lines


def _explain(detail: Any) -> str:
    path = ".".join(_places(detail["loc"]))
    if detail["type"] == "union_tag_invalid":
        kinds = [repr(kind) for kind in _kinds_of(_section_at(detail["loc"]))]
        return f"{path}.source: Input should be {' or '.join(kinds)} (found {source_of(detail['input'])!r})"
    if detail["type"] == "extra_forbidden" and (owner := _owner_of(detail["loc"])):
        return f"{path}: a section of source {owner}, and this is source {detail['loc'][-2]}"
    if detail["type"] == "extra_forbidden":
        meant = _probably_meant(detail["loc"])
        hint = f"did you mean {meant}?" if meant else f"known here: {', '.join(_keys_at(detail['loc'][:-1]))}"
        return f"{path}: unknown key; {hint}"
    if detail["type"] == "missing" and isinstance(detail["loc"][-1], int):
        return f"{'.'.join(_places(detail['loc'][:-1]))}: List should have at least {detail['loc'][-1] + 1} items"
    if detail["type"] == "missing":
        return f"{path}: missing; it has no default"
    return f"{path}: {message_of(detail)}" if path else message_of(detail)


def _places(location: Sequence[Any]) -> list[str]:
    """Return the keys and item numbers that lead to a value, without pydantic's names of union members."""
    union = _union_of(location)
    kept = _untagged(location if union is None else (*union, *location[len(union) + 1 :]))
    return [part if len(part := str(one)) <= _LONGEST_KEY else f"{part[:_LONGEST_KEY]}…" for one in kept]


def _untagged(location: Sequence[Any]) -> list[Any]:
    """Return a location without the forms of data, which pydantic names in it, but no file does."""
    return [one for depth, one in enumerate(location) if one not in _kinds_of(_section_at(location[:depth]))]


def _owner_of(location: Sequence[Any]) -> str | None:
    """Return the form of data that an unknown section belongs to."""
    around = _kinds_of(_section_at(location[:-2])) if len(location) > 1 else {}
    return next((name for name, kind in around.items() if location[-1] in kind.model_fields), None)


def _union_of(location: Sequence[Any]) -> tuple[Any, ...] | None:
    """Return the location of the knob that contains a location, if it may be of several types."""
    for depth in range(1, len(location)):
        section = _section_at(location[: depth - 1])
        knob = None if section is None else section.model_fields.get(str(location[depth - 1]))
        if knob is not None and len([kind for kind in get_args(knob.annotation) if kind is not NoneType]) > 1:
            return tuple(location[:depth]) if get_origin(knob.annotation) in {Union, UnionType} else None
    return None


def _probably_meant(location: Sequence[Any]) -> str | None:
    """Return the key that an unknown one probably stands for; with its section if that differs."""
    name, here = str(location[-1]), "".join(f"{part}." for part in _untagged(location)[:-1])
    known = [key.removeprefix(here) for key, names in _ALSO_CALLED.items() if name in names]
    close = difflib.get_close_matches(name, _keys_at(location[:-1]), n=1)
    elsewhere = [key for key in all_keys() if key.split(".")[-1] == name]
    return next(iter([*known, *close, *elsewhere]), None)


def _is_about(detail: Any, names: Iterable[str]) -> bool:
    """Return whether a message is about one of these keys."""
    return any(re.search(rf"(?<!\w){re.escape(name)}(?!\w)", _explain(detail)) for name in names)


def _take_out(values: dict[str, Any], detail: Any) -> set[str]:
    """Remove an invalid value; return the names of the values that are changed by that."""
    location, names = [str(part) for part in _untagged(detail["loc"])], set[str]()
    if detail["type"] == "union_tag_invalid":
        return _delete(values, [*location, "source"], whole=False)
    if detail["type"] == "missing" and isinstance(detail["loc"][-1], int):
        return _delete(values, location[:-1], whole=False)
    if detail["type"] == "missing":
        return {location[-1]}
    if detail["type"] in {"value_error", "assertion_error"} and _section_at(location) is not None:
        words = re.findall(r"[a-z]\w*(?:\.\w+)*", str(detail["msg"]))
        for path in [[*location, *word.split(".")] for word in words] + [word.split(".") for word in words]:
            names |= _delete(values, path, whole=True)
        return names
    names |= _delete(values, location, whole=False)
    if detail["type"] == "extra_forbidden" and (meant := _probably_meant(location)):
        names.add(meant.split(".")[-1])
    return names


def _delete(values: dict[str, Any], path: Sequence[str], *, whole: bool) -> set[str]:
    """Delete the value at a path, or the nearest one above it; `whole`: only if the complete path exists."""
    inside: Any = values
    for depth, key in enumerate(path):
        if key not in inside:
            return set()
        if depth == len(path) - 1 or not (isinstance(inside[key], dict) and path[depth + 1] in inside[key]):
            if whole and (depth < len(path) - 1 or (not depth and _section_at(path) is not None)):
                return set()
            del inside[key]
            if not inside and depth and _section_at(path[:depth]) is None:  # an empty list of cameras is invalid
                return {key, *_delete(values, path[:depth], whole=False)}
            return {key}
        inside = inside[key]
    return set()


def _stand_in(values: dict[str, Any], taken: set[str]) -> None:
    """Fill in values that have no default, so that the rest can be checked."""
    data, model = (values.setdefault(section, {}) for section in ("data", "model"))
    for inside, key, others in ((values, "run_dir", ()), (data, "path", ()), (model, "base", ("random",))):
        if not any(inside.get(one) is not None for one in (key, *others)):
            inside[key] = "?"
            taken.add(key)


def _section_at(location: Iterable[Any]) -> type[BaseModel] | None:
    section: type[BaseModel] | None = Config
    for part in location:
        kinds = _kinds_of(section)
        if part in kinds:
            section = kinds[part]
            continue
        known = [one for one in (section, *kinds.values()) if one is not None and part in one.model_fields]
        if not known:
            return None
        section = _section_of(known[0].model_fields[part].annotation)
    return section


def _kinds_of(section: type[BaseModel] | None) -> Mapping[str, type[BaseModel]]:
    """Return the forms of data where any may stand."""
    return DataConfig.kinds if section is DataConfig else {}


def _section_of(annotation: Any) -> type[BaseModel] | None:
    return next(iter(sections_in(annotation)), None)


def _keys_at(location: Iterable[Any]) -> list[str]:
    section = _section_at(location)
    return list(section.model_fields) if section else []
