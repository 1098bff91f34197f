"""The contract of the hot operation of registration, as a test."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Float32, Float64, Int64
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfaceLevel
from scanweld.parallel import limited_threads
from scanweld.registration.backends import ProjectiveBackend, reference
from scanweld.testing.promises import require, require_array, untouched
from scanweld.testing.scenes import CAMERA, room, wall

_SUMS = 32
_ROUNDING = 1e-5  # of what sums of products of float32 rows are at most (Cauchy and Schwarz)


def check_projective_backend(backend: ProjectiveBackend) -> None:
    """Check that an implementation keeps what :class:`~scanweld.registration.backends.ProjectiveBackend` promises.

    It gives the sums that were derived by hand for three points before a wall, and for a rendered room those of the
    reference, part by part, with one thread and with several; arrays stay as they are.

    Parameters
    ----------
    backend : a module or an object with the operation

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    _check_by_hand(backend)
    source, target = room(4).levels[0].surface.reshape(-1, 8), room(0).levels[0]
    source = source[source[:, 6] > 0]
    points, normals = (np.ascontiguousarray(source[:, rows].T) for rows in (slice(0, 3), slice(3, 6)))
    T = se3.exp([0.06, 0.02, 0.0, 0.01, -0.03, -0.01])
    n = len(source)
    for bounds in ([0], [0, n], [0, 0, 7, 7, 2000, n, n], list(range(0, n + 1, n // 50))):
        expected = _sums(reference, points, normals, T, target, np.array(bounds))
        for count in (1, 3):
            with limited_threads(count):
                sums = _sums(backend, points, normals, T, target, np.array(bounds))
            _require_same(sums, expected, f"{len(bounds) - 1} parts of {n} points, {count} thread(s)")


def _check_by_hand(backend: ProjectiveBackend) -> None:
    """A wall 1 m away, sigma 1 cm, n = (0, 0, -1); Huber's threshold is 2.

    On the rays of pixels, with J = [n, p x n] / sigma = 100 [0, 0, -1, -y, x, 0] and r = n . (p - q) / sigma:
    p = 1.004 ray: r = -0.4, weight 1, loss 0.08. p = 1.05 ray: r = -5, weight 0.4, loss 2 (5 - 1) = 8.
    The third is behind the camera, and seen by no pixel.
    """
    level = wall(1.0).levels[0]
    surface = level.surface.copy()
    surface[..., 6] = 100
    level = SurfaceLevel(CAMERA, level.depth_m, surface)
    rays = CAMERA.rays()[[60, 40, 60], [80, 100, 80]]
    depths = np.array([1.004, 1.05, -1.0])
    points: Float32 = (rays * depths[:, None]).T.astype(np.float32)
    normals = np.tile(np.array([[0], [0], [-1]], np.float32), 3)
    sums = _sums(backend, points, normals, np.eye(4), level, np.array([0, 1, 3]), gate_m=0.1)
    for row, r, weight, loss, counts, (x, y, _) in (
        (sums[0], -0.4, 1.0, 0.08, (1, 1, 1), points[:, 0].tolist()),
        (sums[1], -5.0, 0.4, 8.0, (0, 1, 1), points[:, 1].tolist()),
    ):
        columns = np.array([0, 0, -100, -100 * y, 100 * x, 0, r])
        expected = np.concatenate([weight * np.outer(columns, columns)[np.triu_indices(7)], [loss, *counts]])
        wrong = ~np.isclose(row, expected, rtol=1e-4, atol=1e-2)
        require(
            not wrong.any(),
            f"point_to_plane_sums: {r:g} sigma in front of or behind a wall: sum {int(np.argmax(wrong))} is "
            f"{row[np.argmax(wrong)]:.6g}, expected {expected[np.argmax(wrong)]:.6g}",
        )


def _sums(
    backend: ProjectiveBackend,
    points: Float32,
    normals: Float32,
    T: Float64,
    target: SurfaceLevel,
    bounds: Int64,
    gate_m: float = 0.15,
) -> Float64:
    with untouched("point_to_plane_sums", points, normals, T, target, bounds):
        sums = backend.point_to_plane_sums(points, normals, T, target, bounds, gate_m, 0.6, 2.0)
    require_array(sums, np.float64, (len(bounds) - 1, _SUMS), "point_to_plane_sums")
    return sums


def _require_same(sums: Float64, expected: Float64, what: str) -> None:
    for name, column in (("inliers", 29), ("matched", 30), ("projected", 31)):
        apart = np.abs(sums[:, column] - expected[:, column]).max(initial=0)
        # A point at the edge of a gate, rounded to the other side of it.
        require(apart <= 1, f"point_to_plane_sums: {name} differ from the reference by {apart:g}: {what}")
    exact = (sums[:, 29:] == expected[:, 29:]).all(axis=1)
    sums, expected = sums[exact], expected[exact]
    full = np.zeros((len(sums), 7, 7))
    full[:, *np.triu_indices(7)] = expected[:, :28]
    most = np.sqrt(np.abs(np.einsum("kii->ki", full)))
    scale = np.concatenate([(most[:, :, None] * most[:, None])[:, *np.triu_indices(7)], expected[:, 28:29]], axis=1)
    wrong = np.abs(sums[:, :29] - expected[:, :29]) > _ROUNDING * scale + 1e-6
    if wrong.any():
        place = tuple(np.argwhere(wrong)[0].tolist())
        raise AssertionError(
            f"point_to_plane_sums: part {place[0]}, sum {place[1]} is {sums[place]:.9g}, the reference has "
            f"{expected[place]:.9g}: {what}"
        )
