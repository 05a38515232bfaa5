"""Server metadata, named goals, and a first decision before a robot connects."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac import __version__
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import read_image, require_contrast, require_image
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goals import GOALS_FILE, SubGoal, read_goal_folder
from vjepa2_ac.runs.subject import Subject
from vjepa2_ac.serving.session import Session

PROTOCOL = 2  # incremented when clients must change
_MAX_NAMES = 60  # names of goals in the metadata
_IMAGE_SIZE = 180, 320  # height and width of each view in the first decision
_REACHABLE_POSE = np.array([0.4, 0.0, 0.4, np.pi, 0.0, 0.0, 0.0])  # measured state of the first decision


def make_metadata(loaded: Subject, session: Session) -> dict[str, Any]:
    """Return the metadata that clients receive on connect, as plain values without local paths."""
    planning, options, model = loaded.config.planning, session.options, loaded.as_dict()["model"]
    sections = (getattr(loaded.config.data, name) for name in loaded.config.data.format_sections())
    rates = (getattr(section, "control_rate_hz", None) for section in sections)
    rate = next((rate for rate in rates if rate is not None), None)  # None: only the data set contains the rate
    return {
        "policy": "vjepa2-ac",
        "protocol": PROTOCOL,
        "version": __version__,
        **{name: model[name] for name in ("predictor", "encoder")},
        "state": list(session.controller.spaces.state.names),
        "frame_of_states": loaded.config.data.pose_frame,
        **{name: getattr(options, name) for name in ("control_steps", "deadline_s", "dry_run")},
        "seconds_per_step": None if rate is None else options.control_steps / rate,
        "horizon": planning.horizon,
        "limits": planning.limits.model_dump(mode="json"),
        "planning": planning.model_dump(mode="json"),
        "seed": session.controller.seed,
        "checkpoint": loaded.checkpoint_label,
        "use_extrinsics": loaded.world_model.sizes.predictor.use_extrinsics,
        "image_keys": list(options.image_keys),
        "goals": sorted(session.goals)[:_MAX_NAMES],
        "warnings": list(loaded.warnings),
        "action_space": get_action_space(session),
    }


def get_action_space(session: Session) -> str:
    """Return the name of the action space; for poses the name that RoboArena uses."""
    space = session.controller.spaces
    if session.options.actions == "pose":
        return "cartesian_position"
    return "cartesian_delta" if space.state.is_pose else f"vector_{space.action.effect}"


def describe_server(metadata: Mapping[str, Any], subject: str) -> str:
    """Return the lines that the server prints about itself at the start."""
    limits = metadata["limits"]
    lines = [
        f"model: {subject}",
        f"action space: {metadata['action_space']}",
        f"limits: at most {limits['xyz']} m per step in x, y, z; workspace box {limits['workspace'] or 'none'}",
        f"goals by name: {', '.join(metadata['goals']) or 'none'}",
    ]
    if metadata["dry_run"]:
        lines.append("dry run: every action is zero")
    return "\n".join(lines)


def warm_up(controller: Controller) -> float:
    """Make a decision with noise images to initialise libraries and caches; return its duration in seconds.

    Raises:
        InputError: The model returns no finite energy.
    """
    start_time, rng = time.perf_counter(), np.random.default_rng(0)
    height, width = _IMAGE_SIZE
    goal, frame = rng.integers(0, 256, (2, height, width * controller.config.views, 3), dtype=np.uint8)
    space, box = controller.spaces.state, controller.config.limits.workspace
    state = _REACHABLE_POSE.copy() if space.is_pose else np.zeros(len(space))
    if space.is_base_pose and box is not None:
        state[:3] = np.mean(box, axis=0)
    controller.reset(goal)
    controller.act(frame, state)
    if controller.decision is None or controller.decision.why == "no finite energy":
        problem = "the model returned no finite energy for any action"
        raise InputError(where="serve", found=problem, fix="Choose another checkpoint: --checkpoint")
    return time.perf_counter() - start_time


NamedGoals = Mapping[str, tuple[SubGoal, ...]]

_IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg"}


def read_named_goals(folder: Path) -> NamedGoals:
    """Read the named goals in a folder.

    A folder with goals.json is one sequence of goals with the folder's name. In any other folder each image is a goal
    (`cup.png` has the name `cup`), and each inner folder with goals.json is a sequence of goals.

    Raises:
        InputError: There is no goal, two goals have the same name, or a file cannot be read.
    """
    if not folder.is_dir():
        problem = "a file" if folder.exists() else "no such folder"
        raise InputError(where=f"--goals {folder}", found=problem, needed="a folder with goal images")
    if (folder / GOALS_FILE).is_file():
        return {folder.resolve().name: read_goal_folder(folder)}
    goals: dict[str, tuple[SubGoal, ...]] = {}
    for path in sorted(folder.iterdir()):
        is_sequence, is_image = (path / GOALS_FILE).is_file(), path.suffix.lower() in _IMAGE_SUFFIXES and path.is_file()
        if not is_sequence and not is_image:
            continue
        if path.stem in goals:
            raise InputError(where=str(path), found=f"two goals named {path.stem!r}", fix="Rename one of them")
        if is_sequence:
            goals[path.stem] = read_goal_folder(path)
        else:
            require_image(image := read_image(path), where=str(path))
            require_contrast([image], where=str(path))
            goals[path.stem] = (SubGoal(image, name=path.stem),)
    if not goals:
        needed = f"images (PNG or JPEG), or folders with a {GOALS_FILE} (`vjepa2-ac goals` writes them)"
        raise InputError(where=f"--goals {folder}", found="no goals", needed=needed)
    return goals
