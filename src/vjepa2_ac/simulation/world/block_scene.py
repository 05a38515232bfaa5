"""The scene with contacts: a block on the table, friction, a gripper that holds, servos; perhaps a mark."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree as ET

from vjepa2_ac.simulation.world.domains import Domain
from vjepa2_ac.simulation.world.motion import CONTROL_RATE_HZ
from vjepa2_ac.simulation.world.scene import ARM_GROUP, BLOCK_M, add, compile_tree, scene_tree

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
