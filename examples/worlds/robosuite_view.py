"""Options of robosuite.py, and its camera, light and mounting.

The lamp casts shadows, because without shadows a single camera does not show heights.
"""

import argparse

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

TASKS = {  # instruction, control steps per episode, field of view and upward rotation of the camera in degrees
    "Lift": ("lift the cube", 60, 42, 7),
    "Stack": ("put the red cube on the green one", 100, 42, 7),
    "PickPlaceCan": ("put the can into its bin", 120, 36, -6),
    "Door": ("open the door", 80, 60, 0),
}


def set_view(sim, options, mount):
    """Set camera, light and the rotation `mount` of the robot's base; return the position of the base."""
    model, (_, _, fov, up) = sim.model, TASKS[options.task]
    camera, base = model.camera_name2id("agentview"), model.body_name2id("robot0_base")
    orbit = Rotation.from_euler("z", options.camera, degrees=True)
    model.cam_pos[camera], model.cam_fovy[camera] = orbit.apply(model.cam_pos[camera]), fov
    pose = orbit * Rotation.from_quat(model.cam_quat[camera], scalar_first=True)
    pose = pose * Rotation.from_euler("x", up, degrees=True)
    model.cam_quat[camera], model.body_quat[base] = pose.as_quat(scalar_first=True), mount.as_quat(scalar_first=True)
    model.light_castshadow[:] = True
    kind = "light_type" if hasattr(model, "light_type") else "light_directional"  # the name before MuJoCo 3.3.3
    getattr(model, kind)[:] = 1  # a directional light
    model.light_dir[:], model.light_diffuse[:], model.vis.headlight.diffuse[:] = (0.15, 0.1, -1.0), 0.5, 0.3
    model.vis.quality.shadowsize = 1024
    screen = sim._render_context_offscreen
    screen.update_offscreen_size(options.size, options.size)
    screen.scn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0  # reflections take a fifth of the time
    if options.look == "dusk":
        model.light_dir[:], model.light_diffuse[:] = (-0.6, 0.3, -1.0), (0.35, 0.25, 0.2)
        model.mat_texid[:], model.mat_rgba[:, :3] = -1, model.mat_rgba[:, :3] * (0.4, 0.55, 0.5)
    return np.array(model.body_pos[base])


def read_options(description):
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--robot", default="Panda", help="Panda, Sawyer, IIWA, UR5e, Kinova3")
    parser.add_argument("--camera", type=float, default=0.0, help="rotation of the camera about the table in degrees")
    parser.add_argument("--mount", type=float, default=0.0, help="rotation of the arm's mounting in degrees")
    parser.add_argument("--look", choices=["day", "dusk"], default="day", help="light and colours")
    parser.add_argument("--size", type=int, default=256, help="pixels of the square image")
    return parser.parse_args()
