"""The scene: arm, table and things on it as MJCF; with a block, servos and contacts where something is to be moved."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from vjepa2_ac.errors import InputError, pip_install
from vjepa2_ac.simulation.world.domains import Domain, Look, direction
from vjepa2_ac.simulation.world.motion import CONTROL_RATE_HZ, FLANGE_OFFSET_M, JOINTS

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


WORK_AREA_M = ((0.28, 0.74), (-0.38, 0.38))
"""Ranges of x and y in the world that are kept free of other objects, for the block."""
SUBSTEPS = 32
"""Steps of physics per control step."""
MARK_M = 0.055
"""Radius of the mark, a flat disc: it is seen on all sides of a block that lies in its middle."""

_BLOCK_KG = 0.15
_GREEN = (0.10, 0.72, 0.22)  # not used elsewhere in domains A and B
_CYAN = (0.05, 0.80, 0.95)  # of the mark, likewise
_MARK_HALF_M = 0.0005  # half its thickness
_SLIDING, _HOLDING = "1.0 0.01 0.001", "1.5 0.05 0.001"  # friction: sliding, about the normal, rolling
_HARD = "0.005 1"  # time constant (s) and damping of contacts: the servos must not press fingers into the table
_ARM_STIFFNESS = (4000.0,) * 4 + (1500.0,) * 3  # N m / rad
_FINGER_STIFFNESS, _FINGER_FORCE = 1500.0, 40.0  # N / m, N


def compile_contact_scene(domain: Domain, *, mark: bool = False) -> Any:
    """Return the compiled `mujoco.MjModel` of a domain with a free body `block`, after all other coordinates.

    Servos `joint1` .. `joint7`, `finger1`, `finger2` drive the arm, without gravity. The fingers and the hand have
    contacts with block, table and objects; the links have none. Objects in the work area are left out.

    Args:
        domain: Its world.
        mark: Whether a coloured disc lies on the table: the mocap body `mark`, which nothing touches.

    Raises:
        InputError: MuJoCo is not installed.
    """
    root = scene_tree(domain)
    timestep = 1.0 / CONTROL_RATE_HZ / SUBSTEPS
    add(root, "option", timestep=timestep, integrator="implicitfast", cone="elliptic", impratio="10")
    world = root.find("worldbody")
    assert world is not None  # noqa: S101 - scene_tree makes it
    _clear_work_area(world)
    for geom in world.findall("geom"):
        geom.attrib.update(contype="1", conaffinity="3", friction=_SLIDING)
    for body in world.iter("body"):
        _drive(body)
    _add_block(world)
    if mark:
        _add_mark(world)
    _add_servos(add(root, "actuator"))
    return compile_tree(root)


def _clear_work_area(world: ET.Element) -> None:
    for geom in world.findall("geom"):
        place = [float(number) for number in geom.get("pos", "0 0 0").split()]
        inside = all(low <= value <= high for value, (low, high) in zip(place, WORK_AREA_M, strict=False))
        if geom.get("name", "").startswith("thing") and inside:
            world.remove(geom)


def _drive(body: ET.Element) -> None:
    """Disable gravity for a body of the arm; enable contacts with other bodies if it is part of the gripper."""
    is_gripper = body.get("name") in {"hand", "finger1", "finger2"}
    body.set("gravcomp", "1")
    for geom in body.findall("geom"):
        if is_gripper:
            geom.attrib.update(contype="2", conaffinity="0", priority="1", condim="4", friction=_HOLDING, solref=_HARD)
        else:
            geom.attrib.update(contype="0", conaffinity="0")
    for joint in body.findall("joint"):
        joint.set("armature", "0.05" if is_gripper else "0.3")


def _add_block(world: ET.Element) -> None:
    half = BLOCK_M / 2
    body = add(world, "body", name="block", pos=[0.5, 0.0, half])
    add(body, "freejoint", name="block")
    shape = {"type": "box", "size": [half] * 3, "mass": _BLOCK_KG, "rgba": [*_GREEN, 1.0], "group": f"{ARM_GROUP}"}
    add(body, "geom", name="block", **shape, contype="1", conaffinity="3", condim="4", friction=_SLIDING)


def _add_mark(world: ET.Element) -> None:
    body = add(world, "body", name="mark", mocap="true", pos=[0.5, 0.0, _MARK_HALF_M])
    shape = {"type": "cylinder", "size": [MARK_M, _MARK_HALF_M], "rgba": [*_CYAN, 1.0], "group": f"{ARM_GROUP}"}
    add(body, "geom", name="mark", **shape, contype="0", conaffinity="0")


def _add_servos(actuators: ET.Element) -> None:
    for index, stiffness in enumerate(_ARM_STIFFNESS, start=1):
        name = f"joint{index}"
        add(actuators, "position", name=name, joint=name, kp=stiffness, dampratio="1")
    for name in ("finger1", "finger2"):
        force = [-_FINGER_FORCE, _FINGER_FORCE]
        add(actuators, "position", name=name, joint=name, kp=_FINGER_STIFFNESS, dampratio="1", forcerange=force)
