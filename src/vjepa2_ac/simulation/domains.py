"""Domains of the simulated arm (cameras, appearance, mounting of the arm), and their scenes in MuJoCo.

The origin of the world frame is on the table under the robot: x to the front, y to the robot's left, z up. The robot
base may be rotated about z (`base_yaw_deg`); states and actions are in the *base* frame, images show the world.
"""

from __future__ import annotations

import colorsys
import importlib.resources
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from jaxtyping import Float

from vjepa2_ac.errors import InputError, require_library

Rgb = tuple[float, float, float]
Range = tuple[float, float]


@dataclass(frozen=True)
class CameraPlacement:
    """Position of a camera that looks at `look_at_m`. Azimuth 0 is in front of the robot, 90 degrees at its left."""

    azimuth_deg: float
    elevation_deg: float
    distance_m: float
    look_at_m: tuple[float, float, float] = (0.40, 0.0, 0.30)
    vertical_fov_deg: float = 36.0

    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the camera's frame in the world: x right, y down, z into the image (OpenCV's convention)."""
        azimuth, up = np.deg2rad(self.azimuth_deg), np.deg2rad(self.elevation_deg)
        outward = np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(-outward, right), -outward], axis=1)
        pose[:3, 3] = np.array(self.look_at_m) + self.distance_m * outward
        return pose

    def turned(self, angle_deg: float) -> CameraPlacement:
        """Return the position with a larger azimuth."""
        return replace(self, azimuth_deg=self.azimuth_deg + angle_deg)


@dataclass(frozen=True)
class Appearance:
    """Colours (RGB, 0 to 1) and light of a scene."""

    arm: Rgb
    joints: Rgb
    hand: Rgb
    table: Rgb
    floor: Rgb
    wall: Rgb
    light_azimuth_deg: float = 100.0
    light_elevation_deg: float = 55.0
    ambient: float = 0.45  # share of ambient light


@dataclass(frozen=True)
class Domain:
    """A world: camera, appearance, mounting and lag of the arm, and objects on the table."""

    name: str
    camera: CameraPlacement
    look: Appearance
    base_yaw_deg: float = 0.0  # rotation of the robot's base about z; changes the direction of an action in the image
    lag_s: float = 0.08  # time constant with which the measured pose follows the commanded one
    clutter_seed: int = 0  # selects the objects on the table, and their positions
    texture_seed: int = 0  # selects the patterns of table, floor and walls; 0: planks, tiles, panels
    moving: int = 0  # number of the five objects that move on circles on the table, without collisions

    def base_pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the robot base frame in the world."""
        from scipy.spatial.transform import Rotation  # imported late, because the names of domains need no SciPy

        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", self.base_yaw_deg, degrees=True).as_matrix()
        return pose


@dataclass(frozen=True)
class DomainRanges:
    """The ranges from which `sample_domain` draws uniformly."""

    azimuth_deg: Range = (25.0, 75.0)
    elevation_deg: Range = (18.0, 38.0)
    distance_m: Range = (1.20, 1.50)
    look_at_jitter_m: float = 0.03
    base_yaw_deg: Range = (-12.0, 12.0)
    lag_s: Range = (0.06, 0.10)
    light_azimuth_deg: Range = (0.0, 360.0)
    light_elevation_deg: Range = (40.0, 75.0)
    ambient: Range = (0.35, 0.6)
    textures: bool = False  # whether patterns are random, too
    moving: int = 0  # number of moving objects


DOMAIN_A = Domain(
    name="A",
    camera=CameraPlacement(azimuth_deg=50.0, elevation_deg=27.0, distance_m=1.35),
    look=Appearance(
        arm=(0.93, 0.93, 0.91),
        joints=(0.22, 0.24, 0.28),
        hand=(0.95, 0.45, 0.10),
        table=(0.30, 0.38, 0.46),
        floor=(0.36, 0.33, 0.31),
        wall=(0.47, 0.53, 0.58),
    ),
)
"""The domain of the base model: camera at the robot's front left, a white arm on a blue-grey background."""

DOMAIN_B = Domain(
    name="B",
    camera=CameraPlacement(azimuth_deg=93.0, elevation_deg=32.0, distance_m=1.30, look_at_m=(0.40, 0.0, 0.34)),
    look=Appearance(
        arm=(0.20, 0.28, 0.42),
        joints=(0.90, 0.78, 0.30),
        hand=(0.75, 0.12, 0.18),
        table=(0.80, 0.68, 0.50),
        floor=(0.55, 0.52, 0.45),
        wall=(0.78, 0.80, 0.70),
        light_azimuth_deg=-60.0,
        light_elevation_deg=48.0,
        ambient=0.5,
    ),
    base_yaw_deg=30.0,
    lag_s=0.10,
    clutter_seed=7,
)
"""The shifted domain: camera rotated by 43 degrees, dark arm on wood, other light, robot rotated by 30 degrees."""

DOMAINS = {domain.name: domain for domain in (DOMAIN_A, DOMAIN_B)}


def named_domain(name: str) -> Domain:
    """Return domain `A` or `B`.

    Raises:
        InputError: There is no domain with this name.
    """
    if name not in DOMAINS:
        raise InputError(where="domain", found=repr(name), needed=f"one of {', '.join(DOMAINS)}, or random")
    return DOMAINS[name]


def sample_domain(rng: np.random.Generator, ranges: DomainRanges = DomainRanges()) -> Domain:
    """Return a random domain (camera, light, colours, mounting), for training a base model on many domains.

    The arm is always light on a dark background or dark on a light one, so that it is visible.
    """

    def draw(bounds: Range) -> float:
        return float(rng.uniform(*bounds))

    centre = np.array(CameraPlacement(0.0, 0.0, 1.0).look_at_m)
    jitter = rng.uniform(-ranges.look_at_jitter_m, ranges.look_at_jitter_m, size=3)
    x, y, z = (float(value) for value in centre + jitter)
    return Domain(
        name="random",
        camera=CameraPlacement(
            draw(ranges.azimuth_deg), draw(ranges.elevation_deg), draw(ranges.distance_m), (x, y, z)
        ),
        look=replace(
            _sample_colours(rng),
            light_azimuth_deg=draw(ranges.light_azimuth_deg),
            light_elevation_deg=draw(ranges.light_elevation_deg),
            ambient=draw(ranges.ambient),
        ),
        base_yaw_deg=draw(ranges.base_yaw_deg),
        lag_s=draw(ranges.lag_s),
        clutter_seed=int(rng.integers(2**31)),
        texture_seed=int(rng.integers(1, 2**31)) if ranges.textures else 0,
        moving=ranges.moving,
    )


def _sample_colours(rng: np.random.Generator) -> Appearance:
    def colour(value: Range, saturation: Range) -> Rgb:
        return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(*saturation), rng.uniform(*value))

    light, dark = (0.80, 1.0), (0.12, 0.30)
    bright_arm = bool(rng.uniform() < 0.5)
    ground = (0.25, 0.50) if bright_arm else (0.60, 0.90)
    return Appearance(
        arm=colour(light if bright_arm else dark, (0.0, 0.35)),
        joints=colour(dark if bright_arm else light, (0.0, 0.4)),
        hand=colour((0.75, 1.0) if bright_arm else (0.4, 0.8), (0.6, 0.95)),
        table=colour(ground, (0.05, 0.35)),
        floor=colour(ground, (0.0, 0.3)),
        wall=colour(ground, (0.0, 0.4)),
    )


STATIC_GROUP, ARM_GROUP = 0, 1  # geom groups: static geoms; the arm, the block and moving objects
FINGER_TRAVEL_M = 0.04
FINGER_INSIDE_M, FINGER_OUTSIDE_M, FINGER_HALF_M = 0.004, 0.028, 0.014
"""Distances from the middle of the hand to the inner and outer side of a closed finger, and half the finger's width."""
FINGERTIP_M = 0.15  # length of the fingers beyond the flange
BLOCK_M = 0.06  # edge length of the block, a cube
MARK_M = 0.055  # radius of the mark, a flat disc; it is visible on all sides of a block in its centre
WORK_AREA_M = ((0.28, 0.74), (-0.38, 0.38))
"""Ranges of x and y in the world that are kept free of other objects, for the block."""
SUBSTEPS = 32  # physics steps per control step
MOVING = "moving"  # prefix of the names of moving bodies

_SCENE = "assets/simulation/arm.xml"
_COLOURED = ("arm", "joints", "hand", "table", "floor", "wall")  # classes of geoms and fields of `Appearance`


def load_mujoco() -> Any:
    """Return the mujoco module.

    Raises:
        UnreachableError: It is not installed.
    """
    return require_library("mujoco", where="simulation", called="MuJoCo, which simulates the arm", extra="sim")


def compile_scene(domain: Domain, *, block: bool = False, mark: bool = False) -> Any:
    """Return the compiled `mujoco.MjModel` of a domain.

    The model has seven hinges `joint1` .. `joint7`, two slides `finger1`, `finger2`, and the site `flange`.

    Args:
        domain: The domain.
        block: Whether to add the free body `block`, keep the work area free of other objects, and drive the arm by
            servos.
        mark: Whether to add a coloured disc on the table: the mocap body `mark`, without collisions.

    Raises:
        UnreachableError: MuJoCo is not installed.
    """
    mujoco = load_mujoco()
    root = ET.fromstring(importlib.resources.files("vjepa2_ac").joinpath(_SCENE).read_text())  # noqa: S314 - packaged
    world, actuators = root.findall("worldbody")[0], root.findall("actuator")[0]
    bodies = {body.get("name"): body for body in world.iter("body")}
    for element in root.iter("default"):
        if (name := element.get("class", "").split("_")[-1]) in _COLOURED:
            geom = ET.SubElement(element, "geom") if (existing := element.find("geom")) is None else existing
            geom.set("rgba", _text(*getattr(domain.look, name), 1.0))
    bodies["link0"].set("euler", _text(0.0, 0.0, np.deg2rad(domain.base_yaw_deg)))
    for number, geom_values in enumerate(_clutter(np.random.default_rng(domain.clutter_seed), avoid_work_area=block)):
        if number < domain.moving:
            body = ET.SubElement(world, "body", name=f"{MOVING}{number}", mocap="true", pos=geom_values.pop("pos"))
            ET.SubElement(body, "geom", geom_values | {"group": str(ARM_GROUP), "contype": "0", "conaffinity": "0"})
        else:
            ET.SubElement(world, "geom", geom_values)
    for name, is_included in {"block": block, "mark": mark}.items():
        if not is_included:
            world.remove(bodies[name])
    if not block:
        root.remove(actuators)
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def _clutter(rng: np.random.Generator, *, avoid_work_area: bool) -> Iterator[dict[str, str]]:
    """Yield the geom attributes of five objects on the table, in front of the robot's base."""
    for index in range(5):
        x, y = rng.uniform(0.25, 0.8), rng.uniform(-0.5, 0.5)
        size, height = rng.uniform(0.02, 0.04), rng.uniform(0.02, 0.05)
        colour, turn = rng.uniform(0.15, 0.9, size=3), rng.uniform(0, np.pi)
        ranges = zip((x, y), WORK_AREA_M, strict=True)
        if avoid_work_area and all(low <= coordinate <= high for coordinate, (low, high) in ranges):
            continue
        kind, half = ("box", (size, size, height)) if index % 2 else ("cylinder", (size, height))
        pose = {"pos": _text(x, y, height), "size": _text(*half), "euler": _text(0.0, 0.0, turn)}
        yield {"class": "static", "type": kind, "rgba": _text(*colour, 1.0), **pose}


def _text(*numbers: float) -> str:
    """Return numbers as text without rounding."""
    return " ".join(repr(float(number)) for number in numbers)
