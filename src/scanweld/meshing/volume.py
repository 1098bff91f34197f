"""A sparse grid of truncated signed distances into which posed depth is fused.

Sources: B. Curless and M. Levoy, "A volumetric method for building complex models from range images", 1996 (the
weighted mean of distances, and carving); M. Nießner et al., "Real-time 3D reconstruction at scale using voxel hashing",
2013 (blocks of voxels, in a hash table, only about surfaces).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Array, Float32, Int32, Int64, as_transform
from scanweld.errors import InvalidInputError
from scanweld.geometry.depth import SurfaceConfig, as_kernel_input, build_pyramid, intrinsics_array, noise_scale
from scanweld.geometry.frame import Frame
from scanweld.geometry.voxels.kernels import fill_table
from scanweld.meshing import kernels
from scanweld.meshing.config import MeshConfig
from scanweld.parallel import run_ranges

_FIRST_BLOCKS = 1 << 12
_BYTES_PER_BLOCK = kernels.SAMPLES * (4 + 4 + 6) + 8 + 4 * 4
_GREY = 160
_DISC_RADII, _DISC_VOXELS = 2.0, 1.8
"""A surfel counts up to so many of its radii, at least so many voxels: neighbours overlap, and none is stepped over."""


class GridTooLargeError(InvalidInputError):
    """The grid would take more memory than it may."""


@dataclass(frozen=True, slots=True)
class SurfaceFrame:
    """A frame, ready to be fused.

    Attributes
    ----------
    surface : (H, W, 8) float32, see :class:`scanweld.geometry.depth.SurfaceLevel`
    color : (H, W, 3) uint8
    intrinsics : (4,) float32
    noise_scale : how much noisier it is than the model of the depth noise
    """

    surface: Float32
    color: Array
    intrinsics: Float32
    noise_scale: float


def prepare_frame(frame: Frame, config: SurfaceConfig) -> SurfaceFrame:
    """Return the surfaces of a frame; may be called ahead, on another thread."""
    level = build_pyramid(frame, config).levels[0]
    color = np.full((*frame.camera.shape, 3), _GREY, np.uint8) if frame.color is None else frame.color
    return SurfaceFrame(
        level.surface,
        as_kernel_input(color, np.uint8),
        intrinsics_array(level.camera),
        noise_scale(level.depth_m, config),
    )


class TsdfVolume:
    """Blocks of samples of the signed distance, positive in front of surfaces, with weights and colours.

    Parameters
    ----------
    voxel_m : distance between samples [m]
    config : what the distances are

    Raises
    ------
    InvalidInputError
        When the spacing is not positive.
    """

    def __init__(self, voxel_m: float, config: MeshConfig | None = None) -> None:
        if not 0 < voxel_m < np.inf:
            raise InvalidInputError(f"voxel: expected a positive spacing in metres, got {voxel_m}")
        self.voxel_m = float(voxel_m)
        self.config = config or MeshConfig()
        self.num_blocks = 0
        self.num_frames = 0
        self._largest = int(self.config.max_memory_mb * 1e6 / _BYTES_PER_BLOCK)
        self._allocate(min(_FIRST_BLOCKS, self._largest))

    def __len__(self) -> int:
        """Return the number of samples."""
        return self.num_blocks * kernels.SAMPLES

    @property
    def memory_mb(self) -> float:
        """What the blocks take [MB]."""
        return self.num_blocks * _BYTES_PER_BLOCK / 1e6

    @property
    def keys(self) -> Int64:
        """(B,) keys of the blocks."""
        return self._keys[: self.num_blocks]

    @property
    def table(self) -> Int32:
        """Hash table of the blocks' labels."""
        return self._table

    @property
    def distances_m(self) -> Float32:
        """(B, 512) float32, 0 where there is none [m]."""
        return self._distances[: self.num_blocks]

    @property
    def weights(self) -> Float32:
        """(B, 512) float32, 0 where nothing was observed."""
        return self._weights[: self.num_blocks]

    @property
    def colors(self) -> Array:
        """(B, 512, 3) uint16, 1 + 256 times the channel, 0 where there is none."""
        return self._colors[: self.num_blocks]

    def integrate(self, frame: Frame | SurfaceFrame, T_world_camera: npt.ArrayLike) -> None:
        """Fuse a frame that was taken at a pose (4, 4).

        Raises
        ------
        InvalidInputError
            When the pose is no rigid transform.
        GridTooLargeError
            When the grid would take more memory than it may.
        """
        seen = prepare_frame(frame, self.config.surfaces) if isinstance(frame, Frame) else frame
        pose = np.ascontiguousarray(as_transform(T_world_camera, "T_world_camera")[:3])
        band, noise = self._band(seen.noise_scale)
        if not self._mark(seen, pose, band):
            return
        labels = self._visible(seen, pose, float(band[4]))
        pixels, voxel = np.empty_like(seen.surface), self.voxel_m
        run_ranges(
            len(pixels),
            lambda start, stop: kernels.weigh_pixels(start, stop, seen.surface, band, noise, pixels),
            grain=64,
        )
        self.num_frames += 1

        def integrate(start: int, stop: int) -> None:
            kernels.integrate_blocks(
                start, stop, labels, self._keys, voxel, pose, seen.intrinsics, pixels, seen.color,
                self._distances, self._weights, self._colors,
            )  # fmt: skip

        run_ranges(len(labels), integrate, grain=16)

    def integrate_surfels(self, surfels: Mapping[str, Array]) -> None:
        """Fuse surfels: each is a disc with a plane, which says less than depth, as nothing is seen through.

        Parameters
        ----------
        surfels : columns of a map: x y z nx ny nz red green blue radius confidence

        Raises
        ------
        GridTooLargeError
            When the grid would take more memory than it may.
        """

        def stacked(*names: str) -> Array:
            return np.ascontiguousarray(np.stack([np.asarray(surfels[name]) for name in names], axis=1))

        positions = stacked("x", "y", "z").astype(np.float64)
        normals = stacked("nx", "ny", "nz").astype(np.float64)
        paint = stacked("red", "green", "blue").astype(np.uint8)
        radii = np.maximum(_DISC_RADII * np.asarray(surfels["radius"], np.float64), _DISC_VOXELS * self.voxel_m)
        strengths = np.maximum(np.asarray(surfels["confidence"], np.float64), 1e-3)
        limit = self.config.least_truncation_voxels * self.voxel_m
        reach, block_m = np.hypot(radii, limit), self.voxel_m * kernels.SIDE
        self._enter(lambda table, keys, count: kernels.mark_balls(positions, reach, block_m, table, keys, count))
        kernels.integrate_discs(
            positions, normals, paint, radii, strengths, self.voxel_m, limit, self._keys, self._table,
            self._distances, self._weights, self._colors,
        )  # fmt: skip

    def _band(self, scale: float) -> tuple[Float32, Float32]:
        """Parameters of the truncation and of the noise, as kernels take them."""
        c, s = self.config, self.config.surfaces
        floor, growth = s.noise_floor_m * scale, s.noise_growth * scale
        low, high = c.least_truncation_voxels * self.voxel_m, c.most_truncation_voxels * self.voxel_m
        sigmas = c.truncation_sigmas
        band = np.array([sigmas * floor, sigmas * growth, s.noise_nearest_m, low, max(low, high)], np.float32)
        return band, np.array([floor, growth, s.noise_nearest_m, s.noise_floor_m], np.float32)

    def _mark(self, seen: SurfaceFrame, pose: Array, band: Float32) -> bool:
        """Enter the blocks about the surfaces of a frame; return whether it has any."""
        block_m = self.voxel_m * kernels.SIDE
        farthest = float(seen.surface[..., 2].max(initial=0))
        if farthest <= 0:
            return False
        focal = float(min(seen.intrinsics[0], seen.intrinsics[1]))
        stride = max(1, int(0.4 * block_m * focal / farthest))  # no block is stepped over
        self._enter(
            lambda table, keys, count: kernels.mark_blocks(
                seen.surface, pose, seen.intrinsics, band, block_m, stride, table, keys, count
            )
        )
        return True

    def _enter(self, mark: Callable[[Int32, Int64, int], int]) -> None:
        """Let a kernel enter blocks (table, keys, number so far), with more room until there is enough."""
        while (count := mark(self._table, self._keys, self.num_blocks)) < 0:
            if count == -2 - len(self._keys):
                raise InvalidInputError(
                    f"voxel: {self.voxel_m:g} m is too small for surfaces that far from the origin of the world"
                )
            self.num_blocks = -1 - count
            self._grow()
        self.num_blocks = count

    def _visible(self, seen: SurfaceFrame, pose: Array, margin: float) -> Int64:
        """Labels of the blocks in view."""
        visible = np.zeros(self.num_blocks, np.bool_)
        farthest = float(seen.surface[..., 2].max()) + 3 * margin
        block_m, shape = self.voxel_m * kernels.SIDE, seen.surface.shape[:2]

        def look(start: int, stop: int) -> None:
            kernels.blocks_in_view(start, stop, self._keys, block_m, pose, seen.intrinsics, shape, farthest, visible)

        run_ranges(self.num_blocks, look, grain=4096)
        return np.flatnonzero(visible)

    def _grow(self) -> None:
        """Make room for twice as many blocks."""
        if len(self._keys) >= self._largest:
            raise GridTooLargeError(
                f"the grid needs more than {self.config.max_memory_mb:g} MB at a voxel of {self.voxel_m:g} m; "
                "raise the voxel, lower the depth that is used, or allow more memory"
            )
        before: tuple[Array, ...] = (self._keys, self._distances, self._weights, self._colors)
        self._allocate(min(2 * len(self._keys), self._largest))
        after: tuple[Array, ...] = (self._keys, self._distances, self._weights, self._colors)
        for old, new in zip(before, after, strict=True):
            new[: len(old)] = old
        fill_table(self._keys, self.num_blocks, self._table)

    def _allocate(self, blocks: int) -> None:
        samples = kernels.SAMPLES
        self._keys = np.empty(blocks, np.int64)
        self._distances = np.zeros((blocks, samples), np.float32)
        self._weights = np.zeros((blocks, samples), np.float32)
        self._colors = np.zeros((blocks, samples, 3), np.uint16)
        self._table = np.full(1 << (2 * blocks).bit_length(), -1, np.int32)
