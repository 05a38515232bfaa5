"""The plan command: the next action of a robot for given images and states."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli.options import (
    NEGATIVE_NUMBERS,
    Commands,
    add_checkpoint,
    add_decoder,
    argument,
    as_local,
    as_model,
    as_numbers,
    as_path,
    camera_pose,
    command,
    given_decoder,
    load_planning_session,
    require_overrides,
    require_to_plan,
    say_places_elsewhere,
    whole_number,
)
from vjepa2_ac.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from vjepa2_ac.config import Config
    from vjepa2_ac.config.planning import PlanningConfig
    from vjepa2_ac.planning.goal_folder import GoalFolder

_QUICK, _QUICK_SEQUENCES = "planning.samples=64 planning.iterations=4", 256  # docs/planning.md says how good it is


def add_to(commands: Commands) -> None:
    """Add `plan` to a parser."""
    text = (
        "Plan from an image and a state to a goal image: plan.json, and an image of how the planner came to it."
        " Status 1 where the model gives no finite energy."
    )
    parser = command(commands, "plan", _plan, text)
    parser._negative_number_matcher = NEGATIVE_NUMBERS  # "-0.3,0.1,..." is a value, not an option
    argument(parser, "subject RUN_OR_MODEL", "folder of a run, or what model.base takes", as_model)
    text = f"such as planning.horizon=2; quick, for a CPU: {_QUICK}"
    argument(parser, "overrides key=value", text, nargs="*")
    argument(parser, "--start IMAGE", "what the camera sees: PNG or JPEG", as_local, required=True)
    text = (
        "measured x,y,z (m), roll,pitch,yaw (radians, extrinsic xyz), gripper (0 open .. 1 closed); or the numbers of a"
        " vector, as the data had them"
    )
    argument(parser, "--state NUMBERS", text, required=True)
    text = "what it shall see; again for goals that follow one another"
    goals = parser.add_mutually_exclusive_group(required=True)
    argument(goals, "--goal IMAGE", text, as_local, action="append")
    text = "goals with rules of their own, that `vjepa2-ac goals` made; the first one applies"
    argument(goals, "--goals FOLDER", text, as_path)
    text = "model steps of each goal but the last, as 2,1; default: equal shares of planning.horizon"
    argument(parser, "--durations STEPS", text)
    text = "what of the image counts: of the goal's size, black where it does not"
    argument(parser, "--mask IMAGE", text, as_local)
    text = "the camera in the robot base frame: x,y,z,roll,pitch,yaw; where the model uses it"
    argument(parser, "--extrinsics NUMBERS", text)
    text = "for a model: the config whose planning, crop and dtype count"
    argument(parser, "--config CONFIG", text, as_local)
    add_checkpoint(parser)
    argument(parser, "--seed N", "default: the config's", whole_number(0, 2**31 - 1))
    text = (
        "of the image's energy maps along each axis; 0: no maps; default: 13, or as many as evaluate no more action"
        " sequences than the search"
    )
    argument(parser, "--nodes N", text, whole_number(0, 101))
    add_decoder(parser, "what the planner imagined, beside the goal, in the image")
    argument(parser, "--out FOLDER", "for both files (plan)", as_path, default=Path("plan"))


def _plan(options: argparse.Namespace) -> int:
    from vjepa2_ac.storage import user_can_write

    # Wrong words are told before what takes seconds is imported.
    require_overrides(options.overrides, fix="Numbers of --state or --extrinsics go in one word: --state 0.4,0,0.3,...")
    state, extrinsics = as_numbers(options.state, "--state"), camera_pose(options.extrinsics)
    durations = _durations(options)
    _require_state(state, require_to_plan(options))
    with user_can_write(options.out):
        options.out.mkdir(parents=True, exist_ok=True)
    start, goals, mask = _images(options)

    from vjepa2_ac.console.plan import plan_table
    from vjepa2_ac.console.progress import ConsoleReporter, console
    from vjepa2_ac.decoding.imagined_plan import imagine_plan
    from vjepa2_ac.planning.decision import PLAN_FILE, PlanRequest, decide, summarize, write_plan
    from vjepa2_ac.reports.figures.planning import PLAN_IMAGE, plot_plan

    say_places_elsewhere(options.subject)
    decoder = given_decoder(options)
    session = load_planning_session(options)
    if decoder is not None:
        decoder.require_fit(session.world_model, session.config.data.crop, subject=options.subject)
    if isinstance(goals, tuple):
        request = PlanRequest(start, state, goals, durations, mask)
        names = options.goal
    else:
        request = PlanRequest.of_sub_goals(start, state, session.goals_of(goals), mask)
        names = [str(options.goals)]
    if not options.durations and isinstance(goals, tuple):
        request = request.with_equal_durations(session.config.planning.horizon)
    with ConsoleReporter() as reporter:
        reporter.note(_search_line(session.config.planning, on_cpu=session.world_model.device.type == "cpu"))
        progress = reporter.task("planning", "action sequences")
        controller = session.controller(seed=options.seed, extrinsics=extrinsics, progress=progress)
        found = decide(controller, request, nodes=options.nodes, reporter=reporter)
    about = session.as_dict() | {"start": options.start, "goals": names, "mask": options.mask}
    about["decoder"] = None if decoder is None else decoder.as_dict()
    imagined = None if decoder is None else imagine_plan(found, decoder)
    with user_can_write(options.out):
        written = [
            write_plan(found, about, options.out / PLAN_FILE),
            plot_plan(found, options.out / PLAN_IMAGE, imagined),
        ]
    console.print(plan_table(found))
    console.print(summarize(found))
    for path in written:
        console.print(f"  {path}")
    return int(found.decision.why == "no finite energy")


def _search_line(config: PlanningConfig, *, on_cpu: bool) -> str:
    """Return what a search predicts, and on a CPU what is quicker."""
    count = sum(config.sequences)
    text = f"Planning: {count:,} action sequences in {config.iterations} iteration{'s' * (config.iterations > 1)}"
    text += f", {config.horizon} model step{'s' * (config.horizon > 1)} each"
    if config.budget_s is not None:
        text += f", for {config.budget_s:g} s at most"
    is_long = on_cpu and config.planner != "gradient" and count > _QUICK_SEQUENCES
    return text + f". Quick, for a CPU: {_QUICK}" * is_long


def _require_state(state: np.ndarray, config: Config) -> None:
    """Refuse a state that is none of the config's space; how wide a vector is, only the model knows."""
    from vjepa2_ac.data.sources.configured_spaces import measured_space
    from vjepa2_ac.planning.input_checks import require_numbers

    require_numbers(state, measured_space(config.data, len(state)), where="--state")


def _images(
    options: argparse.Namespace,
) -> tuple[np.ndarray, tuple[np.ndarray, ...] | GoalFolder, np.ndarray | None]:
    """Return start, goals and mask; refuse what cannot be planned with, before a model is loaded."""
    from vjepa2_ac.media.image_file import read_image
    from vjepa2_ac.planning.goal_folder import read_goal_folder
    from vjepa2_ac.planning.input_checks import require_image, require_mask

    folder = None if options.goals is None else read_goal_folder(options.goals)
    if folder is None:
        images = tuple(read_image(path) for path in options.goal)
        for path, image in zip(options.goal, images, strict=True):
            require_image(image, where=f"--goal {path}", like=images[0])
    else:
        images = tuple(goal.image for goal in folder.goals)
    start = read_image(options.start)
    require_image(start, where=f"--start {options.start}", like=images[0])
    mask = None if options.mask is None else read_image(options.mask).max(axis=-1)
    if mask is not None:
        require_mask(mask, where=f"--mask {options.mask}", like=images[0])
    return start, images if folder is None else folder, mask


def _durations(options: argparse.Namespace) -> tuple[int, ...]:
    if not options.durations:
        return ()
    if options.goals is not None:
        found, needed = f"--goals {options.goals}", "--goal: a folder says how long its goals apply"
        raise InputError(where="--durations", found=found, needed=needed)
    text, goals = options.durations, len(options.goal)
    words = text.replace(",", " ").split()
    if len(words) != goals - 1 or not all(word.isdecimal() and int(word) for word in words):
        found = f"{text!r} for {goals} goal{'s' * (goals > 1)}"
        needed = f"{goals - 1} whole numbers from 1, with commas between them: of each goal but the last"
        raise InputError(where="--durations", found=found, needed=needed)
    return tuple(int(word) for word in words)
