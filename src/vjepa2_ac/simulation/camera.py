"""Render camera images by ray casting in MuJoCo, without OpenGL."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from vjepa2_ac.simulation.domains import ARM_GROUP, STATIC_GROUP, CameraPlacement, Domain, load_mujoco

FRAME_SIZE = 180, 320  # height and width, as in DROID's RLDS data

Pose = Float[np.ndarray, "4 4"]  # camera frame in the world: x right, y down, z into the image
Point = Float[np.ndarray, " 3"]
Spots = Float[np.ndarray, "spots 3"]  # points on surfaces
Rays = Float[np.ndarray, "rays 3"]  # unit vectors

_SKIN_M = 6e-3  # a hit that is closer to a point than this does not shade the point
_LAMP_M = 2.2  # distance of the lamp from the origin of the world
_LAMP_CELLS = 160  # cells along each edge of the lamp's view
_LAMP_HALF_VIEW = 1.6  # tangent of half the opening angle of the lamp's view, which always contains the arm


class Hits(NamedTuple):
    """The first hit of each ray."""

    distance_m: Float[np.ndarray, " rays"]
    geoms: Int[np.ndarray, " rays"]  # -1: nothing
    normals: Float[np.ndarray, "rays 3"]


class Caster:
    """MuJoCo's ray casting on one group of geoms, and the bounding spheres (indices, radii) of the arm's geoms."""

    def __init__(self, model: Any) -> None:
        self._mujoco, self._model = load_mujoco(), model
        self.arm = np.flatnonzero(model.geom_group == ARM_GROUP)
        self.radii = np.array(model.geom_rbound[self.arm])

    def cast(self, data: Any, origin: Point, rays: Rays, group: int) -> Hits:
        """Return the hits of unit rays from one point."""
        count = len(rays)
        geoms = np.full(count, -1, dtype=np.int32)
        distance, normals = np.full(count, -1.0), np.zeros((count, 3))
        if count:
            groups = np.zeros(6, dtype=np.uint8)
            groups[group] = 1
            flat = np.ascontiguousarray(rays).reshape(-1)
            out = (geoms, distance, normals.reshape(-1))
            self._mujoco.mj_multiRay(self._model, data, origin, flat, groups, True, -1, *out, count, 1e10)
        return Hits(distance, geoms, normals)

    def shaded(self, data: Any, lamp: Point, spots: Spots, group: int) -> Bool[np.ndarray, " spots"]:
        """Return which points are in the shadow of one group of geoms."""
        reach = np.linalg.norm(spots - lamp, axis=1)
        hits = self.cast(data, lamp, unit(spots - lamp), group)
        return np.asarray((hits.geoms >= 0) & (hits.distance_m < reach - _SKIN_M))


class View:
    """Unit rays from one point, sorted into the cells of a grid.

    With the grid, the rays that may hit the arm are found without casting.

    Args:
        pose: Frame of the view in the world: x right, y down, z forward.
        rays: Unit rays in the world.
        half_view: Tangents of half the opening angles of the grid, across and down.
        cells: Cells of the grid, across and down.
    """

    def __init__(self, pose: Pose, rays: Rays, half_view: Float[np.ndarray, " 2"], cells: tuple[int, int]) -> None:
        self.origin, self._rotation = pose[:3, 3].copy(), pose[:3, :3]
        self.rays = rays
        self._half_view, self._cells = half_view, np.array(cells)
        local_rays = rays @ self._rotation
        is_ahead = local_rays[:, 2] > 1e-6
        column, row = self._cell(local_rays[:, :2] / np.where(is_ahead, local_rays[:, 2], 1.0)[:, None]).T
        is_in_grid = is_ahead & (column >= 0) & (column < cells[0]) & (row >= 0) & (row < cells[1])
        self._index = np.where(is_in_grid, row * cells[0] + column, cells[0] * cells[1]).astype(np.int64)

    def near_arm(self, caster: Caster, data: Any) -> Int[np.ndarray, " near"]:
        """Return the indices of the rays that may hit the arm, by the bounding spheres of its geoms."""
        radii, centres = caster.radii, (data.geom_xpos[caster.arm] - self.origin) @ self._rotation
        depths = centres[:, 2] - radii, centres[:, 2] + radii  # of the nearest and the farthest point of each sphere
        if depths[0].min() <= 0.0:  # the view is inside the arm
            return np.arange(len(self.rays))
        edges = np.stack(
            [(centres[:, :2] + sign * radii[:, None]) / depth[:, None] for sign in (-1, 1) for depth in depths]
        )
        low = np.clip(self._cell(edges.min(axis=0)), 0, self._cells).astype(int)
        high = np.clip(self._cell(edges.max(axis=0)) + 1, 0, self._cells).astype(int)
        is_near = np.zeros((self._cells[1], self._cells[0]), dtype=bool)  # per cell
        for (left, top), (right, bottom) in zip(low, high, strict=True):
            is_near[top:bottom, left:right] = True
        return np.flatnonzero(np.append(is_near.reshape(-1), False)[self._index])

    def _cell(self, slopes: Float[np.ndarray, "rays 2"]) -> Float[np.ndarray, "rays 2"]:
        """Return column and row, as whole numbers in floating point."""
        return np.asarray(np.floor((slopes / self._half_view + 1.0) / 2.0 * self._cells))


def unit(vectors: Float[np.ndarray, "vectors 3"]) -> Float[np.ndarray, "vectors 3"]:
    """Normalise vectors to length 1."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))


_SHADOW = 0.35  # share of the lamp's light that reaches a point in the shadow
_FAR_M = 20.0  # assumed distance of the background for a ray without a hit


@dataclass(frozen=True)
class _Background:
    """The static part of the image of one camera; pixels are flattened."""

    lit: UInt8[np.ndarray, "pixels 3"]
    shaded: UInt8[np.ndarray, "pixels 3"]  # in the arm's shadow
    distance_m: Float[np.ndarray, " pixels"]
    spots: Float[np.ndarray, "pixels 3"]
    from_camera: View
    from_lamp: View


class RayCamera:
    """A camera in the world that casts one ray per pixel.

    Args:
        model: The scene from `domains.compile_scene`.
        domain: The domain of the scene, for light and patterns.
        pose: The camera's frame in the world: x right, y down, z into the image.
        vertical_fov_deg: Angle from the upper to the lower edge of the image.
        size: Height and width of the image.
    """

    def __init__(
        self,
        model: Any,
        domain: Domain,
        pose: Pose,
        vertical_fov_deg: float,
        size: tuple[int, int] = FRAME_SIZE,
    ) -> None:
        self._caster, self._colours = Caster(model), _Colours(model, domain.texture_seed)
        look = domain.look
        lamp = CameraPlacement(look.light_azimuth_deg, look.light_elevation_deg, _LAMP_M, look_at_m=(0.0, 0.0, 0.0))
        self._lamp_pose, self._ambient = lamp.pose(), look.ambient
        self._lamp = self._lamp_pose[:3, 3]
        self._height, self._width = size
        self._half_view = np.tan(np.deg2rad(vertical_fov_deg) / 2) * np.array([self._width / self._height, 1.0])
        self._pose = pose
        self._background: _Background | None = None

    def move(self, pose: Pose) -> None:
        """Move the camera. The next image recomputes the static background."""
        self._pose = pose
        self._background = None

    def image(self, data: Any) -> UInt8[np.ndarray, "height width 3"]:
        """Return the image of this `mujoco.MjData`, whose kinematics must be up to date."""
        background = self._background = self._background or self._render_background(data)
        pixels = background.lit.copy()
        near = background.from_lamp.near_arm(self._caster, data)
        shaded = near[self._caster.shaded(data, self._lamp, background.spots[near], ARM_GROUP)]
        pixels[shaded] = background.shaded[shaded]
        visible, hits = self._cast_at_arm(data, background)
        spots = background.from_camera.origin + background.from_camera.rays[visible] * hits.distance_m[:, None]
        ambient, direct = self._light(data, spots, hits, ARM_GROUP)
        pixels[visible] = _as_bytes(ambient + direct)
        return pixels.reshape(self._height, self._width, 3)

    def silhouette(self, data: Any) -> Bool[np.ndarray, "height width"]:
        """Return which pixels of the image show the arm, the block or moving objects."""
        background = self._background = self._background or self._render_background(data)
        is_visible = np.zeros(self._height * self._width, dtype=bool)
        is_visible[self._cast_at_arm(data, background)[0]] = True
        return is_visible.reshape(self._height, self._width)

    def _cast_at_arm(self, data: Any, background: _Background) -> tuple[Int[np.ndarray, " visible"], Hits]:
        """Return the pixels that show the arm, the block or moving objects, and the hits of their rays."""
        view = background.from_camera
        near = view.near_arm(self._caster, data)
        hits = self._caster.cast(data, view.origin, view.rays[near], ARM_GROUP)
        front = np.flatnonzero((hits.geoms >= 0) & (hits.distance_m < background.distance_m[near]))
        return near[front], Hits(*(part[front] for part in hits))

    def _render_background(self, data: Any) -> _Background:
        size = (self._width, self._height)
        across, down = (  # slopes of the rays through the centre of each pixel
            ((np.arange(count) + 0.5) / count * 2 - 1) * half for count, half in zip(size, self._half_view, strict=True)
        )
        rays = np.stack(np.broadcast_arrays(across[None, :], down[:, None], 1.0), axis=-1).reshape(-1, 3)
        rays = unit(rays) @ self._pose[:3, :3].T
        view = View(self._pose, rays, self._half_view, size)
        hits = self._caster.cast(data, view.origin, view.rays, STATIC_GROUP)
        distance = np.where(hits.geoms >= 0, hits.distance_m, _FAR_M)
        spots = view.origin + view.rays * distance[:, None]
        ambient, direct = self._light(data, spots, hits, STATIC_GROUP)
        lit, shaded = _as_bytes(ambient + direct), _as_bytes(ambient + _SHADOW * direct)
        cells, half_view = (_LAMP_CELLS, _LAMP_CELLS), np.full(2, _LAMP_HALF_VIEW)
        from_lamp = View(self._lamp_pose, unit(spots - self._lamp), half_view, cells)
        return _Background(lit, shaded, distance, spots, view, from_lamp)

    def _light(self, data: Any, spots: Any, hits: Hits, group: int) -> tuple[Any, Any]:
        """Return the colours of points from ambient light and from the lamp; only geoms of the group cast shadows."""
        colour = self._colours.at(hits.geoms, spots)
        to_lamp = unit(self._lamp - spots)
        direct = np.einsum("ij,ij->i", hits.normals, to_lamp).clip(0.0, 1.0)
        facing = np.flatnonzero(direct > 0.0)
        direct[facing[self._caster.shaded(data, self._lamp, spots[facing], group)]] *= _SHADOW
        sky = 0.8 + 0.2 * hits.normals[:, 2:]
        return colour * (self._ambient * sky), colour * ((1.15 - self._ambient) * direct[:, None])


class _Colours:
    """Colours of geoms. Table, floor and walls have patterns that depend on the position."""

    def __init__(self, model: Any, seed: int) -> None:
        self._colours = model.geom_rgba[:, :3].astype(np.float32)
        names = [model.geom(index).name for index in range(model.ngeom)]
        patterns: list[Callable[[Any], Any]] = [_planks, _tiles, _panels]
        if seed:
            rng = np.random.default_rng(seed)
            patterns = [_vary_pattern(patterns[index], rng) for index in rng.permutation(3)]
        self._patterns = [
            (np.array([name.startswith(start) for name in names]), pattern)
            for start, pattern in zip(("table", "floor", "wall"), patterns, strict=True)
        ]

    def at(self, geoms: Any, spots: Any) -> Any:
        colour = self._colours[geoms]
        for is_patterned, pattern in self._patterns:
            index = np.flatnonzero(is_patterned[geoms])
            if len(index):
                colour[index] *= pattern(spots[index])[:, None]
        return colour


def _vary_pattern(pattern: Callable[[Any], Any], rng: np.random.Generator) -> Callable[[Any], Any]:
    """Return a pattern with random rotation, scale and contrast."""
    turn, scale, strength = rng.uniform(0.0, np.pi), rng.uniform(0.5, 2.0), rng.uniform(0.5, 2.5)
    transform = (
        np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, scale]]) / scale
    )
    return lambda spots: 1.0 + strength * (pattern(spots @ transform) - 1.0)


def _planks(spots: Any) -> Any:
    """Return the brightness of boards along x, each with its own shade and a faint grain."""
    board = np.floor(spots[:, 1] / 0.125)
    tone = 0.93 + 0.07 * np.sin(board * 12.9898)
    grain = 0.03 * np.sin(60.0 * spots[:, 1] + 2.0 * np.sin(5.0 * spots[:, 0] + board))
    seam = np.abs(spots[:, 1] / 0.125 - board - 0.5) > 0.48
    return np.where(seam, 0.78, tone + grain).astype(np.float32)


def _tiles(spots: Any) -> Any:
    """Return the brightness of a chequered floor."""
    odd = (np.floor(spots[:, 0] / 0.4) + np.floor(spots[:, 1] / 0.4)) % 2
    return (0.85 + 0.3 * odd).astype(np.float32)


def _panels(spots: Any) -> Any:
    """Return the brightness of wide vertical panels above a dark skirting board, brighter towards the top."""
    along = spots[:, 0] + spots[:, 1]
    panel = np.floor(along / 0.6) % 2
    shade = 0.86 + 0.10 * panel + 0.08 * np.clip(spots[:, 2], -0.7, 1.5)
    return np.where(spots[:, 2] < -0.6, 0.5, shade).astype(np.float32)


def _as_bytes(colour: Any) -> UInt8[np.ndarray, "pixels 3"]:
    return np.asarray((colour.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))
