"""The simulated scene: the arm from primitives, a table with objects, walls. Our own MJCF."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from vjepa2_ac.errors import InputError, pip_install
from vjepa2_ac.simulation.world.domains import Domain, Look, direction
from vjepa2_ac.simulation.world.kinematics import FLANGE_OFFSET_M, JOINTS

STATIC_GROUP, ARM_GROUP = 0, 1
"""Geom groups: static, and moving."""
FINGER_TRAVEL_M = 0.04
FINGER_INSIDE_M, FINGER_OUTSIDE_M, FINGER_HALF_M = 0.004, 0.028, 0.014
"""Of a closed finger: from the middle of the hand to its inner and outer side, and half its width across."""
FINGERTIP_M = 0.15
"""Length of the fingers beyond the flange."""
BLOCK_M = 0.06
"""Edge length of the block, a cube, in scenes with one."""

Coordinate = float | int
Point = tuple[Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class Shape:
    """A primitive in the frame of its link. Boxes span the corners `start` and `end`, the others run between."""

    kind: str
    start: Point
    end: Point
    radius_m: float
    colour: str  # a colour of the Look


LINK_SHAPES: tuple[tuple[Shape, ...], ...] = (
    (  # the base
        Shape("cylinder", (0, 0, 0), (0, 0, 0.03), 0.11, "joints"),
        Shape("capsule", (-0.11, 0, 0.06), (0, 0, 0.06), 0.058, "arm"),
        Shape("cylinder", (0, 0, 0.03), (0, 0, 0.14), 0.075, "arm"),
        Shape("cylinder", (0, 0, 0.14), (0, 0, 0.17), 0.068, "joints"),
    ),
    (
        Shape("capsule", (0, 0, -0.14), (0, 0, -0.02), 0.066, "arm"),
        Shape("cylinder", (0, -0.07, 0), (0, 0.07, 0), 0.06, "arm"),
    ),
    (
        Shape("cylinder", (0, 0, -0.082), (0, 0, 0.082), 0.056, "joints"),
        Shape("capsule", (0, -0.03, 0), (0, -0.17, 0), 0.062, "arm"),
    ),
    (
        Shape("cylinder", (0, 0, -0.135), (0, 0, -0.115), 0.055, "joints"),
        Shape("capsule", (0, 0, -0.09), (0.02, 0, -0.02), 0.06, "arm"),
        Shape("capsule", (0.02, 0, -0.02), (0.0825, 0, 0), 0.055, "arm"),
    ),
    (
        Shape("cylinder", (0, 0, -0.075), (0, 0, 0.075), 0.05, "joints"),
        Shape("capsule", (0, 0, 0), (-0.0825, 0.09, 0), 0.056, "arm"),
    ),
    (
        Shape("cylinder", (0, 0, -0.275), (0, 0, -0.25), 0.053, "joints"),
        Shape("capsule", (0, 0, -0.235), (0, 0.015, -0.12), 0.055, "arm"),
        Shape("capsule", (0, 0.015, -0.12), (0, 0.0, -0.01), 0.046, "arm"),
    ),
    (
        Shape("cylinder", (0, 0, -0.068), (0, 0, 0.068), 0.044, "joints"),
        Shape("capsule", (0, 0, 0), (0.088, 0, 0), 0.047, "arm"),
    ),
    (
        Shape("cylinder", (0, 0, -0.05), (0, 0, 0.07), 0.046, "arm"),
        Shape("cylinder", (0, 0, 0.07), (0, 0, FLANGE_OFFSET_M), 0.04, "joints"),
    ),
)
"""The base and the seven links, each in its own Denavit-Hartenberg frame."""

HAND_SHAPES = (
    Shape("box", (-0.034, -0.102, 0.0), (0.034, 0.102, 0.068), 0.0, "hand"),
    Shape("box", (-0.028, -0.075, 0.068), (0.028, 0.075, 0.078), 0.0, "joints"),
)
"""In the flange frame, turned by -45 degrees as Franka mounts it."""

_WALL_M = 2.4
_FLOOR_M = -0.75


def load_mujoco() -> ModuleType:
    """Return the mujoco module.

    Raises:
        InputError: MuJoCo is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise InputError(
            where="simulation",
            found="MuJoCo is not installed",
            needed="the extra `sim`",
            fix=f"Run `{pip_install('sim')}`",
        ) from None
    return mujoco  # type: ignore[no-any-return]


def compile_scene(domain: Domain) -> Any:
    """Return the compiled `mujoco.MjModel` of a domain.

    Raises:
        InputError: MuJoCo is not installed.
    """
    return compile_tree(scene_tree(domain))


def compile_tree(root: ET.Element) -> Any:
    """Return the compiled `mujoco.MjModel` of a scene in MJCF.

    Raises:
        InputError: MuJoCo is not installed.
    """
    return load_mujoco().MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def scene_tree(domain: Domain) -> ET.Element:
    """Return the scene as the tree of its MJCF, which can be extended.

    It has seven hinges `joint1`..`joint7`, two slides `finger1`, `finger2`, the site `flange`.
    """
    look, root = domain.look, ET.Element("mujoco", model="arm")
    add(root, "compiler", angle="radian", autolimits="true")
    visual = add(root, "visual")
    add(visual, "global", fovy=domain.camera.vertical_fov_deg, offwidth="1280", offheight="720")
    add(visual, "headlight", ambient=[look.ambient] * 3, diffuse="0 0 0", specular="0 0 0")
    world, light = add(root, "worldbody"), light_position(look)
    add(world, "light", pos=light, dir=-light, diffuse=[1 - look.ambient] * 3, castshadow="true")
    _add_room(world, look)
    _add_clutter(world, np.random.default_rng(domain.clutter_seed))
    _add_arm(world, domain)
    return root


def add(parent: ET.Element, tag: str, **attributes: Any) -> ET.Element:
    """Add an element to the tree of an MJCF; numbers become text, exactly."""
    texts = {
        name: value if isinstance(value, str) else " ".join(repr(float(number)) for number in np.ravel(value))
        for name, value in attributes.items()
    }
    return ET.SubElement(parent, tag, texts)


def light_position(look: Look) -> np.ndarray:
    """Return the position of the lamp in the world."""
    return 2.2 * direction(look.light_azimuth_deg, look.light_elevation_deg)


def _add_room(world: ET.Element, look: Look) -> None:
    _add_box(world, "table", (0.25, 0.0, -0.02), (0.75, 0.75, 0.02), look.table)
    for x in (-0.45, 0.95):
        for y in (-0.7, 0.7):
            _add_box(world, f"leg{x}{y}", (x, y, -0.39), (0.03, 0.03, 0.35), look.table)
    _add_box(world, "floor", (0, 0, _FLOOR_M - 0.05), (3, 3, 0.05), look.floor)
    for name, centre, half in (
        ("wall_back", (-_WALL_M, 0, 0.5), (0.05, 3, 2)),
        ("wall_front", (_WALL_M, 0, 0.5), (0.05, 3, 2)),
        ("wall_right", (0, -_WALL_M, 0.5), (3, 0.05, 2)),
        ("wall_left", (0, _WALL_M, 0.5), (3, 0.05, 2)),
    ):
        _add_box(world, name, centre, half, look.wall)


def _add_clutter(world: ET.Element, rng: np.random.Generator) -> None:
    """Put five objects on the table, outside the robot's foot."""
    for index in range(5):
        x, y = rng.uniform(0.25, 0.8), rng.uniform(-0.5, 0.5)
        size, height = rng.uniform(0.02, 0.04), rng.uniform(0.02, 0.05)
        colour = [float(channel) for channel in rng.uniform(0.15, 0.9, size=3)]
        kind, half = ("box", [size, size, height]) if index % 2 else ("cylinder", [size, height])
        place = {"pos": [x, y, height], "size": half, "euler": [0.0, 0.0, rng.uniform(0, np.pi)]}
        add(world, "geom", name=f"thing{index}", type=kind, **place, rgba=[*colour, 1.0], group=f"{STATIC_GROUP}")


def _add_arm(world: ET.Element, domain: Domain) -> None:
    body = add(world, "body", name="link0", euler=[0, 0, np.deg2rad(domain.base_yaw_deg)])
    _add_shapes(body, LINK_SHAPES[0], domain.look)
    for index, joint in enumerate(JOINTS, start=1):
        twist = np.deg2rad(joint.twist_deg)
        offset = [joint.length_m, -np.sin(twist) * joint.offset_m, np.cos(twist) * joint.offset_m]
        body = add(body, "body", name=f"link{index}", pos=offset, euler=[twist, 0, 0])
        limits = [joint.low_rad, joint.high_rad]
        add(body, "joint", name=f"joint{index}", type="hinge", axis="0 0 1", range=limits)
        _add_shapes(body, LINK_SHAPES[index], domain.look)
    add(body, "site", name="flange", pos=[0, 0, FLANGE_OFFSET_M])
    hand = add(body, "body", name="hand", pos=[0, 0, FLANGE_OFFSET_M], euler=[0, 0, -np.pi / 4])
    _add_shapes(hand, HAND_SHAPES, domain.look)
    for index, side in enumerate((1, -1), start=1):
        _add_finger(hand, f"finger{index}", side, domain.look)


def _add_finger(hand: ET.Element, name: str, side: int, look: Look) -> None:
    finger = add(hand, "body", name=name)
    add(finger, "joint", name=name, type="slide", axis=[0, side, 0], range=[0, FINGER_TRAVEL_M])
    low, high = sorted((side * FINGER_INSIDE_M, side * FINGER_OUTSIDE_M))
    ends = (-FINGER_HALF_M, low, 0.07), (FINGER_HALF_M, high, FINGERTIP_M)
    _add_shapes(finger, (Shape("box", *ends, 0.0, "hand"),), look)


def _add_shapes(body: ET.Element, shapes: tuple[Shape, ...], look: Look) -> None:
    for shape in shapes:
        start, end = np.array(shape.start, dtype=float), np.array(shape.end, dtype=float)
        if shape.kind == "box":
            place = {"pos": (start + end) / 2, "size": (end - start) / 2}
        else:
            place = {"fromto": np.append(start, end), "size": np.array(shape.radius_m)}
        rgba = [*getattr(look, shape.colour), 1.0]
        add(body, "geom", type=shape.kind, rgba=rgba, group=f"{ARM_GROUP}", **place)


def _add_box(world: ET.Element, name: str, centre: Point, half: Point, colour: tuple[float, ...]) -> None:
    add(world, "geom", name=name, type="box", pos=centre, size=half, rgba=[*colour, 1.0], group=f"{STATIC_GROUP}")
