"""The surfels of the adjustment: a sparse set of places, each moved with the keyframe that it was first seen in."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Array, Bool, Float32, Float64, Int32
from scanweld.refinement.calibration import Calibration


@dataclass(frozen=True, slots=True)
class Cameras:
    """Where the keyframes are and what they measure with.

    Attributes
    ----------
    T_camera_world : (K, 4, 4)
    calibration : of the stored images
    """

    T_camera_world: Float64
    calibration: Calibration


@dataclass(frozen=True, slots=True)
class Surfels:
    """Places, world frame.

    Attributes
    ----------
    positions_m, normals : (S, 3) float64
    radii_m : (S,) float64, distance of the two places whose brightness is compared with the surfel's
    hosts : (S,) int32, the keyframe that each moves with
    held : (S,) bool, takes no part in the adjustment and judges it
    """

    positions_m: Float64
    normals: Float64
    radii_m: Float64
    hosts: Int32
    held: Bool

    def __len__(self) -> int:
        return len(self.radii_m)

    def only(self, chosen: Array) -> Surfels:
        """Select by a mask or by indices."""
        return Surfels(
            self.positions_m[chosen], self.normals[chosen], self.radii_m[chosen], self.hosts[chosen], self.held[chosen]
        )

    def joined(self, other: Surfels) -> Surfels:
        """Append others."""
        names = ("positions_m", "normals", "radii_m", "hosts", "held")
        return Surfels(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))

    def carried(self, old: Cameras, new: Cameras) -> Surfels:
        """Keep each at its pixel and measured depth in its host, whose pose and calibration change."""
        T = old.T_camera_world[self.hosts]
        p = np.einsum("nij,nj->ni", T[:, :3, :3], self.positions_m) + T[:, :3, 3]
        n = np.einsum("nij,nj->ni", T[:, :3, :3], self.normals)
        before, after = old.calibration, new.calibration
        if before != after:
            a, b = before.camera, after.camera
            z = p[:, 2]
            u, v = a.fx * p[:, 0] / z + a.cx, a.fy * p[:, 1] / z + a.cy
            shift = after.depth.inverse_depth_offset_per_m - before.depth.inverse_depth_offset_per_m
            z = z / np.maximum(1 + shift * z, 0.1)
            p = np.stack([(u - b.cx) / b.fx * z, (v - b.cy) / b.fy * z, z], axis=1)
        T = new.T_camera_world[self.hosts]
        R = T[:, :3, :3]
        return replace(
            self,
            positions_m=np.einsum("nji,nj->ni", R, p - T[:, :3, 3]),
            normals=np.einsum("nji,nj->ni", R, n),
        )

    def tangents(self) -> Float32:
        """Steps (S, 2, 3) float32 from each surfel along its plane, at right angles, as long as its radius."""
        n = self.normals
        axis = np.eye(3)[np.argmin(np.abs(n), axis=1)]
        first = np.cross(n, axis)
        first /= np.maximum(np.linalg.norm(first, axis=1), 1e-12)[:, None]
        both = np.stack([first, np.cross(n, first)], axis=1)
        return np.asarray(both * self.radii_m[:, None, None], np.float32)


def surfels_in(
    surface: Float32, T_world_camera: Float64, host: int, taken: Array, cell_px: int, block_cells: int, every: int
) -> Surfels:
    """Make a surfel in the middle of every cell of an image in which there is none.

    Parameters
    ----------
    surface : (H, W, 8), of the keyframe `host`, seen from `T_world_camera`
    taken : (M,) pixels (row-major) where there are surfels
    cell_px : size of a cell
    block_cells, every : one in `every` blocks of so many cells is held out
    """
    height, width = surface.shape[:2]
    rows, columns = height // cell_px, width // cell_px
    free = np.ones((-(-height // cell_px), -(-width // cell_px)), np.bool_)
    free[taken // width // cell_px, taken % width // cell_px] = False
    i, j = np.nonzero(free[:rows, :columns])
    middle = surface[i * cell_px + cell_px // 2, j * cell_px + cell_px // 2].astype(np.float64)
    good = middle[:, 6] > 0
    i, j, middle = i[good], j[good], middle[good]
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    # Blocks of neighbours go together, so that what is held out shares no noise with what is not.
    held = (i // block_cells + 3 * (j // block_cells) + host) % every == 0
    return Surfels(
        middle[:, :3] @ R.T + t, middle[:, 3:6] @ R.T, middle[:, 7] * 2.0, np.full(len(i), host, np.int32), held
    )


def no_surfels() -> Surfels:
    """An empty set."""
    return Surfels(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int32), np.zeros(0, np.bool_))
