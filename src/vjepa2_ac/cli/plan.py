"""The commands plan, which plans the next action of a robot, and goals, which extracts goals from a demonstration."""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from vjepa2_ac.cli import options as cli
from vjepa2_ac.config import Config
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.errors import counted
from vjepa2_ac.reporter import INDEXING
from vjepa2_ac.storage import translate_write_errors

if TYPE_CHECKING:
    import numpy as np

    from vjepa2_ac.planning.goals import SubGoal

_COLUMNS = 100


def add_plan(commands: cli.Commands) -> None:
    """Add `plan` to a parser."""
    parser = cli.add_command(commands, "plan", _plan, "demo/run --start a.png --goal b.png --state 0.4,0,0.3,3,0,0,0")
    cli.add_planner(parser, "such as planning.horizon=2, or planning.preset=paper for the search of the paper")
    cli.add(parser, "--start IMAGE", "the current camera image: PNG or JPEG", cli.as_local, required=True)
    text = "measured x,y,z (m), roll,pitch,yaw (radians, extrinsic xyz), gripper (0 open .. 1 closed); or a vector"
    cli.add(parser, "--state NUMBERS", text, cli.as_numbers, required=True)
    goals = parser.add_mutually_exclusive_group(required=True)
    cli.add(
        goals,
        "--goal IMAGE",
        "the goal image; repeat the option for several goals in order",
        cli.as_local,
        action="append",
    )
    cli.add(goals, "--goals FOLDER", "a folder of goals, written by `vjepa2-ac goals`", cli.as_path)
    text = "the last frame of an episode of the run's data; EPISODE:STEP: the frame at this control step"
    cli.add(goals, "--goal-from EPISODE", text)
    cli.add(parser, "--out FOLDER", "output folder (plan)", cli.as_path, default=Path("plan"))
    cli.add(parser, "--mask IMAGE", "mask of the goal image, of the same size: black pixels are ignored", cli.as_local)
    group = parser.add_argument_group("the search and its image")
    cli.add(group, "--seed N", "random seed of the search (the seed in the config)", cli.whole_number(0, 2**31 - 1))
    cli.add(
        group,
        "--nodes N",
        "points of the energy maps along each axis; 0: no maps (9)",
        cli.whole_number(0, 101),
        default=9,
    )
    cli.add_decoder(group, "the predicted frames next to the goal")


def add_goals(commands: cli.Commands) -> None:
    """Add `goals` to a parser."""
    parser = cli.add_command(commands, "goals", _goals, "my_robot.yaml --episode 3 --out goals/cup")
    cli.add(parser, "source CONFIG", "the config of the data with the episode", cli.as_local)
    cli.add_overrides(parser, "config keys to change, such as data.camera=wrist_left")
    cli.add(parser, "--out FOLDER", "output folder, new or empty", cli.as_path, required=True)
    cli.add(parser, "--episode ID|NUMBER", "name of the episode, or its number from 0 on (0)", default="0")
    cli.add(parser, "--every N", "use every N-th control step, instead of key frames", cli.count)
    group = parser.add_argument_group("selection of the goals, and when the next goal applies")
    cli.add(
        group,
        "--apart N",
        "minimum number of frames between a stop of the arm and another goal (4)",
        cli.count,
        default=4,
    )
    cli.add(group, "--slack N", "tolerance of a goal's duration in model steps (3)", cli.whole_number(0), default=3)
    fraction = cli.number_between(0.0, 1.0)
    text = "use the next goal when the energy is below X times its value at the goal's start (only after N steps)"
    cli.add(group, "--share X", text, fraction)
    text = "the same for the end of the last goal (only an image that equals the goal)"
    cli.add(group, "--stop-share X", text, fraction)


def _plan(options: argparse.Namespace) -> int:
    """Plan actions from an image and a state to a goal image.

    Writes plan.json and an image of the search. The exit status is 1 if the model returns no finite energy, or predicts
    that the plan is worse than the zero action or than the current frame. The first line of the output then states
    this.
    """
    from vjepa2_ac.data.sources.indexed_source import get_state_space
    from vjepa2_ac.planning.goals import require_goal_ends

    state = options.state
    config = cli.read_planning_config(options)
    get_state_space(config.data, len(state)).require_state(state, "--state")  # the model checks the width later
    cli.make_folder(options.out)
    goals = _read_goals(options, config)
    require_goal_ends(goals, first=1)
    start, mask = _read_images(options, goals[0].image)

    from vjepa2_ac.cli.tables import plan_table
    from vjepa2_ac.decoding.decoder import load_decoder
    from vjepa2_ac.evaluation.imagined import imagine_plan
    from vjepa2_ac.planning.controller import Controller
    from vjepa2_ac.planning.decision import PLAN_FILE, PlanRequest, decide, summarize, write_plan
    from vjepa2_ac.reports.planning_figures import PLAN_IMAGE, plot_plan

    decoder = None if options.decoder is None else load_decoder(options.decoder)
    session = cli.load_planning_session(options)
    if decoder is not None:
        decoder.require_compatible(session.world_model, session.config.data, subject=options.subject)
    request = PlanRequest(start, state, goals, mask)
    with cli.make_reporter() as reporter:
        reporter.note(_describe_search(session.config.planning))
        controller = Controller.of_subject(session, seed=options.seed, extrinsics=options.extrinsics)
        controller.planner.progress = reporter.task("planning", "action sequences")
        result = decide(controller, request, nodes=options.nodes, reporter=reporter)
    names = options.goal or [str(options.goals or options.goal_from)]
    about = session.as_dict() | {"start": options.start, "goals": names, "mask": options.mask}
    about["decoder"] = None if decoder is None else decoder.as_dict()
    predicted_frames = None if decoder is None else imagine_plan(result, decoder)
    with translate_write_errors(options.out):
        file = write_plan(result, about, options.out / PLAN_FILE)
        image = plot_plan(result, options.out / PLAN_IMAGE, predicted_frames)
    summary = textwrap.fill(summarize(result), _COLUMNS)
    cli.show(*result.worse_than.values(), plan_table(result), summary, files=[file, image])
    return int(result.decision.why == "no finite energy" or bool(result.worse_than))


def _describe_search(config: PlanningConfig) -> str:
    """Return a line with the size of the search."""
    from vjepa2_ac.planning.planner import count_samples_per_iteration

    sequences, steps = (
        counted(sum(count_samples_per_iteration(config)), "action sequence"),
        counted(config.horizon, "step"),
    )
    text = f"Planning: {sequences} of {steps} in {counted(config.iterations, 'iteration')}"
    text += "" if config.budget_s is None else f", for {config.budget_s:g} s at most"
    return f"{text}."


def _read_images(options: argparse.Namespace, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the start image and the mask. Check that they have the size of the goal image, before a model is loaded."""
    from vjepa2_ac.media.images import read_image, require_image, require_mask

    start = read_image(options.start)
    require_image(start, where=f"--start {options.start}", like=goal)
    mask = None if options.mask is None else read_image(options.mask).max(axis=-1)
    if mask is not None:
        require_mask(mask, where=f"--mask {options.mask}", like=goal)
    return start, mask


def _read_goals(options: argparse.Namespace, config: Config) -> tuple[SubGoal, ...]:
    """Return the goals: from a folder, from an episode, or from images that divide the horizon equally."""
    from vjepa2_ac.media.images import read_image, require_image
    from vjepa2_ac.planning.goals import make_timed_goals, read_goal_folder, split_horizon

    if options.goals is not None:
        return read_goal_folder(options.goals)
    if options.goal_from is not None:
        from vjepa2_ac.goals.make_goals import read_episode_frame

        return make_timed_goals([read_episode_frame(config.data, options.goal_from)], [])
    images = [read_image(path) for path in options.goal]
    for path, image in zip(options.goal, images, strict=True):
        require_image(image, where=f"--goal {path}", like=images[0])
    return make_timed_goals(images, split_horizon(config.planning.horizon, len(images)))


def _goals(options: argparse.Namespace) -> None:
    """Extract a sequence of goals from a demonstration.

    The goals are key frames of an episode, with durations and gripper modes. They are written with a contact sheet to a
    folder that `plan --goals` and `serve --goals` read.
    """
    from vjepa2_ac.data.windows import require_stride

    cli.require_new_path(options.out)
    config = cli.read_config(options.source, options.overrides)
    stride = require_stride(config.data, to="make goals", fix="Set it, for example data.stride=4")

    from vjepa2_ac.cli.tables import goals_table
    from vjepa2_ac.goals.make_goals import KeyFrameOptions, make_goals
    from vjepa2_ac.reports.planning_figures import GOALS_IMAGE, plot_goals

    key_frame_options = cli.make_record(KeyFrameOptions, options, stride=stride, views=config.planning.views)
    with cli.make_reporter() as reporter:
        goals = make_goals(config.data, options.episode, key_frame_options, reporter.task(INDEXING))
    with translate_write_errors(options.out):
        written = [goals.write(options.out), plot_goals(goals, options.out / GOALS_IMAGE)]
    cli.show(goals_table(goals), files=written)
