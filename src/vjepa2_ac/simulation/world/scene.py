"""The scene: arm, table and things on it, as MuJoCo compiles them; where asked for with block, contacts and servos."""

from __future__ import annotations

import importlib.resources
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from vjepa2_ac.errors import require_library
from vjepa2_ac.simulation.world.domains import Domain

STATIC_GROUP, ARM_GROUP = 0, 1  # geom groups: static, and moving
FINGER_TRAVEL_M = 0.04
FINGER_INSIDE_M, FINGER_OUTSIDE_M, FINGER_HALF_M = 0.004, 0.028, 0.014
"""Of a closed finger: from the middle of the hand to its inner and outer side, and half its width across."""
FINGERTIP_M = 0.15  # length of the fingers beyond the flange
BLOCK_M = 0.06  # edge length of the block, a cube
MARK_M = 0.055  # radius of the mark, a flat disc: it is seen on all sides of a block that lies in its middle
WORK_AREA_M = ((0.28, 0.74), (-0.38, 0.38))
"""Ranges of x and y in the world that are kept free of other objects, for the block."""
SUBSTEPS = 32  # steps of physics per control step

_SCENE = "assets/simulation/arm.xml"
_COLOURED = ("arm", "joints", "hand", "table", "floor", "wall")  # classes of geoms, and colours of a Look


def load_mujoco() -> Any:
    """Return the mujoco module.

    Raises:
        UnreachableError: It is not installed.
    """
    return require_library("mujoco", where="simulation", called="MuJoCo, which simulates the arm", extra="sim")


def compile_scene(domain: Domain, *, block: bool = False, mark: bool = False) -> Any:
    """Return the compiled `mujoco.MjModel` of a domain.

    It has seven hinges `joint1` .. `joint7`, two slides `finger1`, `finger2`, and the site `flange`.

    Args:
        domain: Its world.
        block: Whether the free body `block` lies in the work area, which is cleared for it, and servos drive the arm.
        mark: Whether a coloured disc lies on the table: the mocap body `mark`, which nothing touches.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """
    mujoco = load_mujoco()
    root = ET.fromstring(importlib.resources.files("vjepa2_ac").joinpath(_SCENE).read_text())  # noqa: S314 - our own
    world, actuators = root.findall("worldbody")[0], root.findall("actuator")[0]
    bodies = {body.get("name"): body for body in world.iter("body")}
    for one in root.iter("default"):
        if (name := one.get("class", "").split("_")[-1]) in _COLOURED:
            geom = one.find("geom")
            (ET.SubElement(one, "geom") if geom is None else geom).set("rgba", _text(*getattr(domain.look, name), 1.0))
    bodies["link0"].set("euler", _text(0.0, 0.0, np.deg2rad(domain.base_yaw_deg)))
    for thing in _things(np.random.default_rng(domain.clutter_seed), avoid_work_area=block):
        ET.SubElement(world, "geom", thing)
    for name, wanted in {"block": block, "mark": mark}.items():
        if not wanted:
            world.remove(bodies[name])
    if not block:
        root.remove(actuators)
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def _things(rng: np.random.Generator, *, avoid_work_area: bool) -> Iterator[dict[str, str]]:
    """Yield the attributes of five objects on the table, outside the robot's foot."""
    for index in range(5):
        x, y = rng.uniform(0.25, 0.8), rng.uniform(-0.5, 0.5)
        size, height = rng.uniform(0.02, 0.04), rng.uniform(0.02, 0.05)
        colour, turn = rng.uniform(0.15, 0.9, size=3), rng.uniform(0, np.pi)
        if avoid_work_area and all(low <= at <= high for at, (low, high) in zip((x, y), WORK_AREA_M, strict=True)):
            continue
        kind, half = ("box", (size, size, height)) if index % 2 else ("cylinder", (size, height))
        place = {"pos": _text(x, y, height), "size": _text(*half), "euler": _text(0.0, 0.0, turn)}
        yield {"class": "static", "type": kind, "rgba": _text(*colour, 1.0), **place}


def _text(*numbers: float) -> str:
    """Return numbers as text, exactly."""
    return " ".join(repr(float(number)) for number in numbers)
