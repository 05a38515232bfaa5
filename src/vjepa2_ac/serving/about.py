"""About a server: the goals that it keeps, what it tells on connect, and its first decision, before a robot comes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac import __version__
from vjepa2_ac.config import Config
from vjepa2_ac.data.windows import require_stride
from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import read_image
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.goal_folder import GOALS_FILE, GoalFolder, read_goal_folder
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.planning.input_checks import require_image
from vjepa2_ac.planning.session import PlanningSession
from vjepa2_ac.serving.session import Session

PROTOCOL = 1  # incremented when a client would have to change
_MOST_NAMES = 60  # of goals that are told
_SIZE = 180, 320  # of the picture of the first decision
_SOMEWHERE = np.array([0.4, 0.0, 0.4, np.pi, 0.0, 0.0, 0.0])


def require_steps(config: Config) -> int:
    """Return the control steps of a model step.

    Raises:
        InputError: Nobody knows.
    """
    return require_stride(config.data, to="say how long an action lasts", fix="Say which, as data.stride=4")


def metadata_of(loaded: PlanningSession, session: Session) -> dict[str, Any]:
    """Return what a client may know of the server: plain values, without a path of this machine."""
    planning, limits, model = loaded.config.planning, loaded.config.planning.limits, loaded.as_dict()["model"]
    steps, rate = session.options.control_steps, _control_rate(loaded.config)
    space = session.controller.spaces.state
    return {
        "policy": "vjepa2-ac",
        "protocol": PROTOCOL,
        "version": __version__,
        "predictor": model["predictor"],
        "encoder": model["encoder"],
        "state": list(space.names),
        "frame_of_states": loaded.config.data.pose_frame,
        "control_steps": steps,
        "seconds_per_step": None if rate is None else steps / rate,
        "horizon": planning.horizon,
        "limits": limits.model_dump(mode="json"),
        "planning": planning.model_dump(mode="json"),
        "seed": session.controller.seed,
        "checkpoint": loaded.checkpoint,
        "use_extrinsics": loaded.world_model.sizes.predictor.use_extrinsics,
        "deadline_s": session.options.deadline_s,
        "image_keys": list(session.options.image_keys),
        "goals": sorted(session.goals)[:_MOST_NAMES],
        "warnings": list(loaded.warnings),
        "dry_run": session.options.dry_run,
        **roboarena_metadata(session),
    }


def roboarena_metadata(session: Session) -> dict[str, Any]:
    """Return the six keys of RoboArena's clients, which take no others."""
    return {
        "image_resolution": None,
        "needs_wrist_camera": False,
        "n_external_cameras": 1,
        "needs_stereo_camera": False,
        "needs_session_id": True,
        "action_space": _action_space(session),
    }


def in_words(about: Mapping[str, Any], subject: str) -> str:
    """Return a line for whoever started the server."""
    limits = about["limits"]
    box = "no workspace box" if limits["workspace"] is None else f"workspace {limits['workspace']}"
    goals = f"goals: {', '.join(about['goals'])}" if about["goals"] else "no goals of its own"
    dry = "; DRY RUN: every action is zero" if about["dry_run"] else ""
    return f"{subject}: {about['action_space']}, xyz within {limits['xyz']} m a step, {box}; {goals}{dry}"


def warm_up(controller: Controller) -> float:
    """Make a decision about two pictures of noise; return how many seconds it took. Libraries and caches are then warm.

    Raises:
        InputError: The model gives no finite energy: it is broken.
    """
    began, rng = time.perf_counter(), np.random.default_rng(0)
    goal, frame = rng.integers(0, 256, (2, *_SIZE, 3), dtype=np.uint8)
    space, box = controller.spaces.state, controller.config.limits.workspace
    state = _SOMEWHERE.copy() if space.is_pose else np.zeros(len(space))
    if space.is_base_pose and box is not None:
        state[:3] = np.mean(box, axis=0)
    controller.reset(goal)
    controller.act(frame, state)
    if controller.decision is None or controller.decision.why == "no finite energy":
        found = "no finite energy for any action: the model is broken"
        raise InputError(where="serve", found=found, fix="Another checkpoint may not be: --checkpoint")
    return time.perf_counter() - began


def _control_rate(config: Config) -> float | None:
    """Return the control steps a second; None: only the data set knows."""
    sections = (getattr(config.data, name) for name in type(config.data).own_sections())
    found = [getattr(one, "control_rate_hz", None) for one in sections]
    return next((rate for rate in found if rate is not None), None)


def _action_space(session: Session) -> str:
    space = session.controller.spaces
    if session.options.actions == "pose":
        return "cartesian_position"
    return "cartesian_delta" if space.state.is_pose else f"vector_{space.action.follows}"


KeptGoals = Mapping[str, GoalFolder]

_PICTURES = {".png", ".jpg", ".jpeg"}


def read_kept_goals(folder: Path) -> KeptGoals:
    """Return the goals of a folder: itself an order of goals; or pictures, and folders with such an order.

    A picture `cup.png` is a goal of the name `cup`; an order of goals has its folder's name.

    Raises:
        InputError: There is no goal, two have one name, or a file cannot be used.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise InputError(where=f"--goals {folder}", found=found, needed="a folder with goal images")
    if (folder / GOALS_FILE).is_file():
        return {folder.resolve().name: read_goal_folder(folder)}
    kept: dict[str, GoalFolder] = {}
    for path in sorted(folder.iterdir()):
        goals = _goals_at(path)
        if goals is not None and path.stem in kept:
            found = f"two goals named {path.stem!r}"
            raise InputError(where=str(path), found=found, needed="another name for one of them")
        kept |= {} if goals is None else {path.stem: goals}
    if not kept:
        found, needed = (
            "no goal",
            f"pictures (PNG or JPEG), or folders with a {GOALS_FILE} (`vjepa2-ac goals` makes them)",
        )
        raise InputError(where=f"--goals {folder}", found=found, needed=needed)
    return kept


def _goals_at(path: Path) -> GoalFolder | None:
    """Return the goals that a file or folder is; None: it is something else."""
    if path.is_dir():
        return read_goal_folder(path) if (path / GOALS_FILE).is_file() else None
    if path.suffix.lower() not in _PICTURES:
        return None
    image = read_image(path)
    require_image(image, where=str(path))
    return GoalFolder((SubGoal(image, name=path.stem),), (None,), (None,))
