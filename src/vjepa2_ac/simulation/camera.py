"""What does a camera see? Pictures by ray casting: no OpenGL, no display, the same bytes on every machine.

MuJoCo says which geom each pixel's ray meets, and where; colour, light and shadow are numpy. What never moves is cast
and lit once per camera; per picture only the arm is cast, and its shadow, and only where they can be.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from vjepa2_ac.errors import InputError
from vjepa2_ac.simulation.domains import CameraPlace, Domain
from vjepa2_ac.simulation.scene import ARM_GROUP, STATIC_GROUP, light_position, load_mujoco

FRAME_HEIGHT, FRAME_WIDTH = 180, 320
"""Size of DROID's pictures in RLDS."""

_SHADOW = 0.35  # light that reaches a shadowed spot besides the ambient
_SKIN_M = 6e-3  # a spot does not shade itself
_LAMP_CELLS = 160  # cells along each edge of the lamp's view


class RayCamera:
    """A camera in the world that sees by casting one ray per pixel.

    Args:
        model: The scene as `scene.compile_scene` gives it.
        domain: Its look.
        pose: The camera's frame in the world: x right, y down, z into the picture.
        vertical_fov_deg: Angle from the upper to the lower edge of the picture.
        height, width: Size of the picture.
    """

    def __init__(
        self,
        model: Any,
        domain: Domain,
        pose: Float[np.ndarray, "4 4"],
        *,
        vertical_fov_deg: float,
        height: int = FRAME_HEIGHT,
        width: int = FRAME_WIDTH,
    ) -> None:
        self._caster = _Caster(model)
        self._colours = _Colours(model)
        self._height, self._width = height, width
        self._lamp = light_position(domain.look)
        self._ambient = domain.look.ambient
        self._rays = _pixel_rays(height, width, vertical_fov_deg)
        self._half_view = np.tan(np.deg2rad(vertical_fov_deg) / 2) * np.array([width / height, 1.0])
        self._pose = pose
        self._background: tuple[Any, ...] | None = None

    def move(self, pose: Float[np.ndarray, "4 4"]) -> None:
        """Put the camera elsewhere; the next picture is cast anew, walls and table included."""
        self._pose = pose
        self._background = None

    def picture(self, data: Any) -> UInt8[np.ndarray, "height width 3"]:
        """Return what the camera sees of this `mujoco.MjData`, whose kinematics must be up to date."""
        if self._background is None:
            self._background = self._see_background(data)
        lit, shaded, depth, view, lamp_view = self._background
        pixels = lit.copy()
        dark = lamp_view.shaded(self._caster, data, ARM_GROUP, lamp_view.candidates(self._caster, data))
        pixels[dark] = shaded[dark]
        near = view.candidates(self._caster, data)
        distance, geoms, normals = self._caster.cast(data, view.origin, view.directions[near], ARM_GROUP)
        seen = np.flatnonzero((geoms >= 0) & (distance < depth[near]))
        spots = view.origin + view.directions[near[seen]] * distance[seen, None]
        ambient, direct = self._light(data, spots, geoms[seen], normals[seen], ARM_GROUP)
        pixels[near[seen]] = _bytes(ambient + direct)
        return np.asarray(pixels.reshape(self._height, self._width, 3))

    def _see_background(self, data: Any) -> tuple[Any, ...]:
        """Return what does not move: pixels in the lamp's light and out of it, depth, and both views of the spots."""
        view = _View(self._pose, self._rays @ self._pose[:3, :3].T, self._half_view, (self._width, self._height))
        depth, geoms, normals = self._caster.cast(data, view.origin, view.directions, STATIC_GROUP)
        depth = np.where(geoms >= 0, depth, 20.0)
        spots = view.origin + view.directions * depth[:, None]
        ambient, direct = self._light(data, spots, geoms, normals, STATIC_GROUP)
        ambient[geoms < 0], direct[geoms < 0] = 0.5, 0.0
        lamp_view = _lamp_view(self._lamp, spots)
        return _bytes(ambient + direct), _bytes(ambient + _SHADOW * direct), depth, view, lamp_view

    def _light(self, data: Any, spots: Any, geoms: Any, normals: Any, group: int) -> tuple[Any, Any]:
        """Return the colour of spots in the light from everywhere, and what the lamp adds; the group shades itself."""
        colour = self._colours.at(geoms, spots)
        to_lamp = self._lamp - spots
        reach = np.linalg.norm(to_lamp, axis=1, keepdims=True)
        to_lamp /= np.maximum(reach, 1e-9)
        shine = np.einsum("ij,ij->i", normals, to_lamp).clip(0.0, 1.0)
        distance, shading, _ = self._caster.cast(data, self._lamp, -to_lamp, group)
        shine[(shading >= 0) & (distance < reach[:, 0] - _SKIN_M)] *= _SHADOW
        return colour * (self._ambient * (0.8 + 0.2 * normals[:, 2:])), colour * (
            (1.15 - self._ambient) * shine[:, None]
        )


class OpenGlCamera:
    """The same camera by MuJoCo's own renderer, where `MUJOCO_GL` works. Colours as in the MJCF, without patterns.

    Raises:
        InputError: OpenGL does not work here.
    """

    def __init__(
        self,
        model: Any,
        domain: Domain,
        pose: Float[np.ndarray, "4 4"],
        *,
        vertical_fov_deg: float,
        height: int = FRAME_HEIGHT,
        width: int = FRAME_WIDTH,
    ) -> None:
        del domain  # the light and the colours are in the model
        self._mujoco, self._model = load_mujoco(), model
        self._fov = vertical_fov_deg
        self.move(pose)
        try:
            self._renderer = self._mujoco.Renderer(model, height, width)
        except Exception as error:  # each back end fails in its own way: ImportError, AttributeError, FatalError, ...
            raise InputError(
                where="renderer: opengl",
                found=f"OpenGL does not work here ({type(error).__name__}: {error})",
                needed="a display, or MUJOCO_GL=egl or osmesa with its system library",
                fix="Use renderer: rays, which needs neither",
            ) from error

    def move(self, pose: Float[np.ndarray, "4 4"]) -> None:
        """Put the camera elsewhere."""
        forward = pose[:3, 2]
        self._eye = self._mujoco.MjvCamera()
        self._eye.type = self._mujoco.mjtCamera.mjCAMERA_FREE
        self._eye.distance = 1.0
        self._eye.lookat[:] = pose[:3, 3] + forward
        self._eye.azimuth = np.rad2deg(np.arctan2(forward[1], forward[0]))
        self._eye.elevation = np.rad2deg(np.arcsin(forward[2]))

    def picture(self, data: Any) -> UInt8[np.ndarray, "height width 3"]:
        """Return what the camera sees of this `mujoco.MjData`."""
        self._model.vis.global_.fovy = self._fov
        self._renderer.update_scene(data, camera=self._eye)
        return np.asarray(self._renderer.render())


class _Caster:
    """MuJoCo's ray casting, and where the arm's geoms are."""

    def __init__(self, model: Any) -> None:
        self._mujoco, self._model = load_mujoco(), model
        self._arm = np.flatnonzero(model.geom_group == ARM_GROUP)
        self._radii = model.geom_rbound[self._arm]

    def arm_spheres(self, data: Any) -> tuple[Float[np.ndarray, "geoms 3"], Float[np.ndarray, " geoms"]]:
        """Return a sphere around each geom of the arm."""
        return data.geom_xpos[self._arm], self._radii

    def cast(self, data: Any, origin: Any, directions: Any, group: int) -> tuple[Any, Any, Any]:
        """Return distance, geom (-1: none) and surface normal of what each unit ray meets first in one group."""
        count = len(directions)
        geoms = np.full(count, -1, dtype=np.int32)
        distance, normals = np.full(count, -1.0), np.zeros((count, 3))
        if count:
            groups = np.zeros(6, dtype=np.uint8)
            groups[group] = 1
            rays = np.ascontiguousarray(directions).reshape(-1)
            out = (geoms, distance, normals.reshape(-1))
            self._mujoco.mj_multiRay(self._model, data, origin, rays, groups, True, -1, *out, count, 1e10)
        return distance, geoms, normals


class _View:
    """Rays from one point, sorted into the cells of a grid, so that those near the arm are found without casting."""

    def __init__(self, pose: Any, directions: Any, half_view: Any, cells: tuple[int, int]) -> None:
        self.origin = pose[:3, 3].copy()
        self.directions = directions
        self._pose, self._half_view, self._cells = pose, half_view, np.array(cells)
        inside = directions @ pose[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = self._cell(inside[:, :2] / inside[:, 2:]).T
        away = (inside[:, 2] <= 1e-6) | (column < 0) | (column >= cells[0]) | (row < 0) | (row >= cells[1])
        nowhere = cells[0] * cells[1]
        self._index = np.where(away, nowhere, np.where(away, 0, row * cells[0] + column)).astype(np.int64)

    def candidates(self, caster: _Caster, data: Any) -> Int[np.ndarray, " near"]:
        """Return the rays that may meet the arm: those in the cells that a sphere around one of its geoms touches."""
        centres, radii = caster.arm_spheres(data)
        inside = (centres - self.origin) @ self._pose[:3, :3]
        near, far = inside[:, 2] - radii, inside[:, 2] + radii
        if near.min() <= 0.0:
            return np.arange(len(self.directions))
        edges = np.stack(
            [(inside[:, :2] + sign * radii[:, None]) / z[:, None] for sign in (-1, 1) for z in (near, far)]
        )
        low = np.clip(self._cell(edges.min(axis=0)), 0, self._cells).astype(int)
        high = np.clip(self._cell(edges.max(axis=0)) + 1, 0, self._cells).astype(int)
        touched = np.zeros((self._cells[1], self._cells[0]), dtype=bool)
        for (left, top), (right, bottom) in zip(low, high, strict=True):
            touched[top:bottom, left:right] = True
        return np.flatnonzero(np.append(touched.reshape(-1), False)[self._index])

    def _cell(self, slopes: Any) -> Any:
        """Return column and row (not yet whole-number types) of slopes x/z, y/z."""
        return np.floor((slopes / self._half_view + 1.0) / 2.0 * self._cells)


class _LampView(_View):
    """The background's spots as the lamp sees them."""

    def __init__(self, pose: Any, spots: Any, half_view: Any, cells: tuple[int, int]) -> None:
        rays = spots - pose[:3, 3]
        self._reach = np.linalg.norm(rays, axis=1)
        super().__init__(pose, rays / np.maximum(self._reach, 1e-9)[:, None], half_view, cells)

    def shaded(self, caster: _Caster, data: Any, group: int, near: Any) -> Int[np.ndarray, " dark"]:
        """Return which of the spots `near` are in the shadow of a group of geoms."""
        distance, geoms, _ = caster.cast(data, self.origin, self.directions[near], group)
        return np.asarray(near[(geoms >= 0) & (distance < self._reach[near] - _SKIN_M)])


def _lamp_view(lamp: Any, spots: Any) -> _LampView:
    azimuth, elevation = np.arctan2(lamp[1], lamp[0]), np.arcsin(lamp[2] / np.linalg.norm(lamp))
    toward = CameraPlace(
        float(np.rad2deg(azimuth)), float(np.rad2deg(elevation)), float(np.linalg.norm(lamp)), (0.0, 0.0, 0.0)
    )
    return _LampView(toward.pose(), spots, np.array([1.6, 1.6]), (_LAMP_CELLS, _LAMP_CELLS))


class _Colours:
    """Colours by geom, and by place for those that carry a pattern, so that pictures have texture."""

    def __init__(self, model: Any) -> None:
        mujoco = load_mujoco()
        self._colours = model.geom_rgba[:, :3].astype(np.float32)
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, index) or "" for index in range(model.ngeom)]
        self._table = np.array([name == "table" for name in names])
        self._floor = np.array([name == "floor" for name in names])
        self._wall = np.array([name.startswith("wall") for name in names])

    def at(self, geoms: Any, spots: Any) -> Any:
        colour = self._colours[geoms]
        for chosen, pattern in ((self._table, _planks), (self._floor, _tiles), (self._wall, _panels)):
            index = np.flatnonzero(chosen[geoms])
            if len(index):
                colour[index] *= pattern(spots[index])[:, None]
        return colour


def _planks(spots: Any) -> Any:
    """Boards along x, each of its own tone, with a faint grain."""
    board = np.floor(spots[:, 1] / 0.125)
    tone = 0.93 + 0.07 * np.sin(board * 12.9898)
    grain = 0.03 * np.sin(60.0 * spots[:, 1] + 2.0 * np.sin(5.0 * spots[:, 0] + board))
    seam = np.abs(spots[:, 1] / 0.125 - board - 0.5) > 0.48
    return np.where(seam, 0.78, tone + grain).astype(np.float32)


def _tiles(spots: Any) -> Any:
    """A chequered floor."""
    odd = (np.floor(spots[:, 0] / 0.4) + np.floor(spots[:, 1] / 0.4)) % 2
    return (0.85 + 0.3 * odd).astype(np.float32)


def _panels(spots: Any) -> Any:
    """Wide upright panels over a dark skirting, brighter to the top."""
    along = spots[:, 0] + spots[:, 1]
    panel = np.floor(along / 0.6) % 2
    shade = 0.86 + 0.10 * panel + 0.08 * np.clip(spots[:, 2], -0.7, 1.5)
    return np.where(spots[:, 2] < -0.6, 0.5, shade).astype(np.float32)


def _pixel_rays(height: int, width: int, vertical_fov_deg: float) -> Float[np.ndarray, "pixels 3"]:
    """Return unit rays through the middle of each pixel in the camera's frame, row by row."""
    half = np.tan(np.deg2rad(vertical_fov_deg) / 2)
    down = (np.arange(height) + 0.5) / height * 2 - 1
    right = ((np.arange(width) + 0.5) / width * 2 - 1) * width / height
    rays = np.stack(np.broadcast_arrays(right[None, :] * half, down[:, None] * half, 1.0), axis=-1).reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _bytes(colour: Any) -> UInt8[np.ndarray, "pixels 3"]:
    return np.asarray((colour.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))
