"""Config keys of version 0.1 that were removed or moved.

Configs of older runs still load; in other configs such a key is an error with an explanation.
"""

from __future__ import annotations

import logging
from functools import cache
from typing import Any, NamedTuple

logger = logging.getLogger(__name__)


class RemovedKey(NamedTuple):
    """What replaces a removed config key."""

    always: str
    """The behaviour in this version, as the end of the sentence "it is always ..."."""
    values: tuple[Any, ...]
    """The values in older configs that had the same meaning; a section is a dict."""


REMOVED: dict[str, RemovedKey] = {
    "planning.cem.answer": RemovedKey("mean", ("mean",)),
    "planning.context": RemovedKey("1", (1,)),
    "planning.gripper_start_std": RemovedKey("1", (1.0,)),
    "planning.limits.gripper_from": RemovedKey("0", (0,)),
    "planning.limits.gripper_rounding": RemovedKey("0.25", (0.25,)),
    "planning.prior_steps": RemovedKey("3", (3,)),
    "planning.goals": RemovedKey("the share of each goal", ({"share": None, "stop_share": None},)),
    "planning.replan": RemovedKey("a new search at each decision", ("always",)),
    "decoder.average": RemovedKey("0.999, less in a short training", (0.999, 0.998, 0.99)),
    "decoder.checkpoint_every": RemovedKey("500, or a third of decoder.steps", (500, 200)),
    "decoder.held_out_frames": RemovedKey("1,000", (1_000,)),
    "decoder.max_grad_norm": RemovedKey("1", (1.0,)),
    "decoder.noise": RemovedKey("0", (0.0,)),
    "decoder.warmup_steps": RemovedKey("500, at most a 15th of decoder.steps", (500, 100, 30)),
    "decoder.weight_decay": RemovedKey("0.05", (0.05,)),
    "model.encoder_weights": RemovedKey("target_encoder, if the file has it", ("target_encoder",)),
    "model.encode_chunk": RemovedKey("16", (16,)),
    "model.sizes.encoder.family": RemovedKey("v2 for a random encoder, else that of the file", ("v2",)),
    "model.sizes.encoder.frame": RemovedKey("tubelet, or model.encoder.frame", ("tubelet",)),
    "model.sizes.encoder.mlp_ratio": RemovedKey("that of the published width, else 4", (48 / 11, 4.0)),
    "model.sizes.patch_size": RemovedKey("16 for a random encoder, else that of the file", (16,)),
    "model.sizes.predictor.action_dim": RemovedKey("the width of the data's actions", (7,)),
    "model.sizes.predictor.mlp_ratio": RemovedKey("4", (4.0,)),
    "model.sizes.predictor.state_dim": RemovedKey("the width of the data's states", (7,)),
    "model.random_start": RemovedKey("persistence", ("persistence",)),
    "data.augment": RemovedKey(
        "off (data.transforms changes training clips)",
        ({"crop_scale": None, "crop_aspect": [0.75, 1.35], "brightness": 0.0, "contrast": 0.0, "saturation": 0.0},),
    ),
    "data.check_crc": RemovedKey("once", ("once",)),
    "data.connections": RemovedKey("16", (16,)),
    "data.droid_raw": RemovedKey(
        "15 Hz, without the steps that have no operator", ({"skip_action": "drop", "control_rate_hz": 15.0},)
    ),
    "data.lerobot.fps": RemovedKey("the rate in meta/info.json", (None,)),
    "data.lerobot.joint_velocity": RemovedKey(
        "action.joint_velocity, if there is one", ("action.joint_velocity", None)
    ),
    "data.motion_limits": RemovedKey("2.5 m/s and 10 rad/s", ({"speed_m_s": 2.5, "rotation_rad_s": 10.0},)),
    "data.prefetch": RemovedKey("2", (2,)),
    "data.short_episodes": RemovedKey("skip", ("skip",)),
    "data.stride_candidates": RemovedKey("4, 8 and 15 at 15 Hz, scaled to other rates", (None,)),
    "training.teacher_forcing_weight": RemovedKey("1", (1.0,)),
    "training.rollout_weight": RemovedKey("1", (1.0,)),
    "training.start_learning_rate": RemovedKey("0", (0.0,)),
    "training.final_learning_rate": RemovedKey("0", (0.0,)),
    "training.betas": RemovedKey("(0.9, 0.999)", ([0.9, 0.999],)),
    "validation.ranking_reach_cm": RemovedKey("7.5", (7.5,)),
    "tracking.project": RemovedKey("vjepa2-ac, or the environment variable WANDB_PROJECT", ("vjepa2-ac",)),
    "checkpoint.every_minutes": RemovedKey("15", (15.0,)),
}
"""Removed keys and sections, by their dotted key. An entry for a key of `data` also applies to `replay.data`."""


MOVED = {
    **{
        f"planning.{name}": f"planning.planner: {{name: {name}, options: {{...}}}}"
        for name in ("cem", "icem", "mppi", "gradient")
    },
    "planning.planner_options": "planning.planner: {name: NAME, options: {...}}",
    "planning.start_std": "planning.planner: {name: NAME, options: {start_std: NUMBER}}",
    "planning.limits.ball": "planning.limits.l1: METRES, the limit of the L1 norm",
    "planning.limits.radius": "planning.limits.l1: METRES, the limit of the L1 norm",
    "planning.energy.options": "planning.energy.distance: {name: NAME, options: {...}}",
    "training.loss_options": "training.loss: {name: NAME, options: {...}}",
    "training.smooth_l1_beta": "training.loss: {name: smooth_l1, options: {beta: 1.0}}",
}
"""Removed keys and sections -> the keys that replace them, most of which are options of a component."""


def explain_removed_key(key: str) -> str | None:
    """Return the explanation for a removed key; None if the key was never removed."""
    if key in MOVED:
        return f"moved in 0.2, to {MOVED[key]}"
    removed = REMOVED.get(key.removeprefix("replay."))
    return removed and f"removed in 0.2; it is always {removed.always} now. Delete the key"


@cache
def _warn(text: str, *values: object) -> None:
    """Log a warning only once, because a command reads the config of its run several times."""
    logger.warning(text, *values)


def drop_removed_keys(values: dict[str, Any], where: str) -> None:
    """Delete removed keys from the config of an older run, in place.

    A value that differs from today's fixed behaviour is reported as a warning.

    Args:
        values: The plain values of the config.
        where: The file, for the warning.
    """
    for key, removed in REMOVED.items():
        for path in (key, f"replay.{key}") if key.startswith("data.") else (key,):
            *sections, name = path.split(".")
            section: Any = values
            for part in sections:
                section = section.get(part) if isinstance(section, dict) else None
            if not isinstance(section, dict) or name not in section:
                continue
            if (value := section.pop(name)) not in removed.values:
                _warn("%s: %s was %s; this version always uses %s", where, path, str(value), removed.always)


def move_norm_limit(values: dict[str, Any], where: str) -> None:
    """Replace the norm ball of the limits in the config of an older run by a limit of the L1 norm, in place.

    The L1 norm of a motion is at least its length, so that a limit of the L1 norm is never looser than the same limit
    of the L2 norm. The replacement of an L2 ball is reported as a warning.

    Args:
        values: The plain values of the config.
        where: The file, for the warning.
    """
    planning = values.get("planning")
    limits = planning.get("limits") if isinstance(planning, dict) else None
    if not isinstance(limits, dict):
        return
    ball, radius = limits.pop("ball", "none"), limits.pop("radius", 0.05)
    if ball == "none":
        return
    limits.setdefault("l1", radius)
    if ball != "l1":
        text = "%s: planning.limits.ball was %s; this version uses the stricter planning.limits.l1: %s"
        _warn(text, where, str(ball), str(limits["l1"]))


def move_component_options(values: dict[str, Any], where: str) -> None:
    """Move the options of planner, energy and loss in the config of an older run to their component, in place.

    A value of the removed key start_std is reported as a warning for a planner without this option.

    Args:
        values: The plain values of the config.
        where: The file, for the warning.
    """
    components = (  # section, key, default name
        (("planning",), "planner", "cem"),
        (("planning", "energy"), "distance", "l1"),
        (("training",), "loss", "l1"),
    )
    for sections, key, default in components:
        section: Any = values
        for part in sections:
            section = section.get(part) if isinstance(section, dict) else None
        component = section.get(key, default) if isinstance(section, dict) else None
        component = {"name": component} if isinstance(component, str) else component
        if not isinstance(component, dict):
            continue  # validation reports this error later
        name = component.get("name", default)
        if not isinstance(name, str):
            continue  # validation reports this error later
        older = {option: section.pop(option, None) for option in _OLDER_OPTIONS[key]}
        if name == "smooth_l1" and "smooth_l1_beta" in older:
            older[name] = {"beta": older["smooth_l1_beta"]}
        if (start_std := older.get("start_std")) not in (None, 1.0):
            if name in {"cem", "icem", "mppi"}:
                planner_options = older.get(name)
                older[name] = {**(planner_options if isinstance(planner_options, dict) else {}), "start_std": start_std}
            elif name != "prior":  # the planner prior draws no samples
                text = "%s: planning.start_std was %s; the planner %s has no such option, and uses 1"
                _warn(text, where, str(start_std), name)
        # Later sources override earlier ones.
        sources = (older.get(name), older.get(f"{key}_options"), older.get("options"), component.get("options"))
        options = {option: source[option] for source in sources if isinstance(source, dict) for option in source}
        section[key] = {**component, "options": options} if options else component


_OLDER_OPTIONS = {
    "planner": ("planner_options", "cem", "icem", "mppi", "gradient", "start_std"),
    "distance": ("options",),
    "loss": ("loss_options", "smooth_l1_beta"),
}
