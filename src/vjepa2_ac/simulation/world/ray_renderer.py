"""The ray renderer: which rays meet the arm, and where? Cast by MuJoCo; rays that cannot meet it are skipped."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from vjepa2_ac.simulation.world.domains import CameraPlace
from vjepa2_ac.simulation.world.scene import ARM_GROUP, load_mujoco

_SKIN_M = 6e-3  # a point does not shade itself
_LAMP_CELLS = 160  # cells along each edge of the lamp's view
_LAMP_HALF_VIEW = 1.6  # tangent of half its opening angle; the arm is always inside


class Hits(NamedTuple):
    """The first hit of each ray."""

    distance_m: Float[np.ndarray, " rays"]
    geoms: Int[np.ndarray, " rays"]  # -1: nothing
    normals: Float[np.ndarray, "rays 3"]


class Caster:
    """MuJoCo's ray casting on one group of geoms, and bounding spheres of the arm's geoms."""

    def __init__(self, model: Any) -> None:
        self._mujoco, self._model = load_mujoco(), model
        self._arm = np.flatnonzero(model.geom_group == ARM_GROUP)
        self._radii = np.array(model.geom_rbound[self._arm])

    def arm_spheres(self, data: Any) -> tuple[Float[np.ndarray, "geoms 3"], Float[np.ndarray, " geoms"]]:
        """Return centre and radius of a sphere around each geom of the arm."""
        return data.geom_xpos[self._arm], self._radii

    def cast(self, data: Any, origin: Float[np.ndarray, " 3"], rays: Float[np.ndarray, "rays 3"], group: int) -> Hits:
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

    def shaded(
        self, data: Any, lamp: Float[np.ndarray, " 3"], spots: Float[np.ndarray, "spots 3"], group: int
    ) -> Bool[np.ndarray, " spots"]:
        """Return which points are in the shadow of one group of geoms."""
        reach = np.linalg.norm(spots - lamp, axis=1)
        hits = self.cast(data, lamp, unit(spots - lamp), group)
        return np.asarray((hits.geoms >= 0) & (hits.distance_m < reach - _SKIN_M))


class View:
    """Unit rays from one point, sorted into the cells of a grid: those that may hit the arm are found without casting.

    Args:
        pose: Frame of the view in the world: x right, y down, z forward.
        rays: Unit rays in the world.
        half_view: Tangents of half the opening angles of the grid, across and down.
        cells: Cells of the grid, across and down.
    """

    def __init__(
        self,
        pose: Float[np.ndarray, "4 4"],
        rays: Float[np.ndarray, "rays 3"],
        half_view: Float[np.ndarray, " 2"],
        cells: tuple[int, int],
    ) -> None:
        self.origin, self._rotation = pose[:3, 3].copy(), pose[:3, :3]
        self.rays = rays
        self._half_view, self._cells = half_view, np.array(cells)
        inside = rays @ self._rotation
        ahead = inside[:, 2] > 1e-6
        column, row = self._cell(inside[:, :2] / np.where(ahead, inside[:, 2], 1.0)[:, None]).T
        found = ahead & (column >= 0) & (column < cells[0]) & (row >= 0) & (row < cells[1])
        self._index = np.where(found, row * cells[0] + column, cells[0] * cells[1]).astype(np.int64)

    def near_arm(self, caster: Caster, data: Any) -> Int[np.ndarray, " near"]:
        """Return the rays in the cells that a sphere around one of the arm's geoms touches."""
        centres, radii = caster.arm_spheres(data)
        inside = (centres - self.origin) @ self._rotation
        ends = inside[:, 2] - radii, inside[:, 2] + radii
        if ends[0].min() <= 0.0:  # the view is inside the arm
            return np.arange(len(self.rays))
        edges = np.stack([(inside[:, :2] + sign * radii[:, None]) / end[:, None] for sign in (-1, 1) for end in ends])
        low = np.clip(self._cell(edges.min(axis=0)), 0, self._cells).astype(int)
        high = np.clip(self._cell(edges.max(axis=0)) + 1, 0, self._cells).astype(int)
        touched = np.zeros((self._cells[1], self._cells[0]), dtype=bool)
        for (left, top), (right, bottom) in zip(low, high, strict=True):
            touched[top:bottom, left:right] = True
        return np.flatnonzero(np.append(touched.reshape(-1), False)[self._index])

    def _cell(self, slopes: Float[np.ndarray, "rays 2"]) -> Float[np.ndarray, "rays 2"]:
        """Return column and row, as whole numbers in floating point."""
        return np.asarray(np.floor((slopes / self._half_view + 1.0) / 2.0 * self._cells))


def lamp_view(lamp: Float[np.ndarray, " 3"], spots: Float[np.ndarray, "spots 3"]) -> View:
    """Return points in the view of the lamp."""
    distance = float(np.linalg.norm(lamp))
    azimuth = float(np.rad2deg(np.arctan2(lamp[1], lamp[0])))
    elevation = float(np.rad2deg(np.arcsin(lamp[2] / distance)))
    pose = CameraPlace(azimuth, elevation, distance, look_at_m=(0.0, 0.0, 0.0)).pose()
    return View(pose, unit(spots - lamp), np.array([_LAMP_HALF_VIEW] * 2), (_LAMP_CELLS, _LAMP_CELLS))


def unit(ways: Float[np.ndarray, "ways 3"]) -> Float[np.ndarray, "ways 3"]:
    """Return vectors of length 1 in the same directions."""
    return np.asarray(ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9))
