"""A person-sized object that walks through a rendered sequence, with the exact truth of which pixels are its own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from scanweld.arrays import Bool, Float32, Float64, UInt8, as_points
from scanweld.datasets.synthetic.assembly import assemble
from scanweld.datasets.synthetic.rendering import render_frame
from scanweld.datasets.synthetic.scene import Material, Scene, Texture, new_placement
from scanweld.datasets.synthetic.sequence import RenderConfig, SyntheticSequence
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.trajectory import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """Where the object is, frame by frame.

    Attributes
    ----------
    start : the first frame that has it
    T_world_object : (K, 4, 4), its poses in the frames start .. start + K - 1; it stands on the floor
    """

    start: int
    T_world_object: Float64

    def pose(self, index: int) -> Float64 | None:
        """Return T_world_object (4, 4) in frame `index`, None where it is not there."""
        k = index - self.start
        return self.T_world_object[k] if 0 <= k < len(self.T_world_object) else None


class CrossedSequence(SyntheticSequence):
    """A rendered sequence through which a person walks; depth noise is that of the whole picture.

    With the same configuration, :class:`SyntheticSequence` is the same without the person.

    Parameters
    ----------
    config, trajectory : see :class:`SyntheticSequence`
    walk : where the person is; see :func:`walk_across`

    Raises
    ------
    InvalidInputError
        When the walk begins before the sequence or ends after it.
    """

    def __init__(self, config: RenderConfig, walk: Walk, *, trajectory: Trajectory | None = None) -> None:
        super().__init__(config, trajectory=trajectory)
        stop = walk.start + len(walk.T_world_object)
        if walk.start < 0 or stop > len(self):
            raise InvalidInputError(f"walk: frames {walk.start} to {stop}, but the sequence has {len(self)}")
        self.walk = walk
        self.name += "-crossed"

    def exact(self, index: int) -> tuple[UInt8, Float32]:
        """Render frame `index` with the person, without noise and rounding."""
        color, depth_m = super().exact(index)
        person = self._person(index)
        if person is None:
            return color, depth_m
        person_color, person_depth_m = person
        mine = _in_front(person_depth_m, depth_m)
        return np.where(mine[..., None], person_color, color), np.where(mine, person_depth_m, depth_m)

    def object_mask(self, index: int) -> Bool:
        """Return which pixels (H, W) of frame `index` show the person."""
        person = self._person(index)
        if person is None:
            return np.zeros(self.camera.shape, dtype=np.bool_)
        return _in_front(person[1], super().exact(index)[1])

    def in_object(self, points_m: npt.ArrayLike, margin_m: float = 0.03) -> Bool:
        """Return which points (N, 3) [m, world] the person has been at, or within `margin_m` of."""
        points = as_points(points_m, "points", dimensions=(3,))
        low, high = self.walk.T_world_object[:, :3, 3].min(axis=0), self.walk.T_world_object[:, :3, 3].max(axis=0)
        reach = HEIGHT_M + margin_m
        near = np.flatnonzero(((points > low - reach) & (points < high + reach)).all(axis=1))
        touched = np.zeros(len(points), dtype=np.bool_)
        for T in self.walk.T_world_object:
            near = near[~touched[near]]
            touched[near] = _inside(build_person(), se3.transform_points(se3.inverse(T), points[near]), margin_m)
        return touched

    def _person(self, index: int) -> tuple[UInt8, Float32] | None:
        T_world_object = self.walk.pose(index)
        if T_world_object is None:
            return None
        T_object_camera = se3.inverse(T_world_object) @ self.ground_truth.T_world_camera[index]
        return render_frame(build_person(), self.camera, T_object_camera)


def walk_across(
    trajectory: Trajectory, start: int, count: int, *, distance_m: float = 1.15, reach_m: float = 1.5
) -> Walk:
    """Walk from the left to the right of the camera, `distance_m` ahead of where it is in the middle of the walk.

    Parameters
    ----------
    trajectory : the camera's path in a scene whose floor is y = 0
    start, count : frames of the walk
    distance_m : horizontally from the camera to the middle of the walk [m]; at 1.15 m a person fills 30 % of the image
    reach_m : the walk begins and ends so far from its middle [m], outside the image

    Raises
    ------
    InvalidInputError
        When the path has no such frames.
    """
    if not (start >= 0 and count >= 2 and start + count <= len(trajectory)):
        raise InvalidInputError(f"walk_across: frames {start} to {start + count} of a path of {len(trajectory)}")
    T = trajectory.T_world_camera[start + count // 2]
    ahead, middle = T[:3, 2] * np.array([1.0, 0.0, 1.0]), T[:3, 3] * np.array([1.0, 0.0, 1.0])
    ahead /= np.linalg.norm(ahead)
    down = np.array([0.0, 1.0, 0.0])
    right = np.cross(down, ahead)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.stack([-right, down, -ahead], axis=1)  # sideways, facing the camera: it looks larger so
    along = np.linspace(-reach_m, reach_m, count)
    poses[:, :3, 3] = middle + distance_m * ahead + along[:, None] * right
    return Walk(start, poses)


HEIGHT_M = 1.75


@lru_cache(maxsize=1)
def build_person() -> Scene:
    """Return a person of ellipsoids, 1.75 m tall, 0.62 m wide and 0.34 m deep, who stands at the origin, facing z."""
    p = new_placement()
    shirt = Material(Texture.STRIPES, "#385f8f", "#e9dfc8", 0.6)
    trousers = Material(Texture.FABRIC, "#3b3a3c", "#27374d")
    skin = Material(Texture.PAINT, "#d9a98a", "#c08e70")
    p.ball((0, 1.62, 0), (0.09, 0.13, 0.11), skin)
    p.ball((0, 1.2, 0), (0.22, 0.36, 0.14), shirt)
    p.ball((0, 0.9, 0), (0.19, 0.2, 0.15), trousers)
    for side, step in ((-1, 0.14), (1, -0.14)):
        p.ball((side * 0.25, 1.12, -step * 0.4), (0.06, 0.36, 0.07), shirt, axis=(-0.1 * side, 1, step))
        p.ball((side * 0.1, 0.45, step), (0.1, 0.45, 0.12), trousers, axis=(0, 1, -step))
    for x, z in ((-1.5, -1.5), (1.5, -1.5), (1.5, 1.5), (-1.5, 1.5)):
        p.light((x, 2.3, z), "#fff1df", 0.6, 5.0)
    return assemble("person", p, (0.14, 0.14, 0.14))


def _in_front(mine_m: Float32, other_m: Float32) -> Bool:
    return np.asarray((mine_m > 0) & ((mine_m < other_m) | (other_m == 0)))


def _inside(ellipsoids: Scene, points_m: Float64, margin_m: float) -> Bool:
    """Points (N, 3) in or within about `margin_m` of the ellipsoids, whose radii grow by it."""
    inside = np.zeros(len(points_m), dtype=np.bool_)
    for row, radii in zip(ellipsoids.affine.reshape(-1, 3, 4), ellipsoids.scalars[:, :3], strict=True):
        unit = points_m @ row[:, :3].T + row[:, 3]  # the unit ball, each axis scaled by its radius
        inside |= np.square(unit * (radii / (radii + margin_m))).sum(axis=1) <= 1
    return inside
