"""Ray casting against plain NumPy: intersections by definition, the tree against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.arrays import Float64
from scanweld.datasets.synthetic.assembly import assemble
from scanweld.datasets.synthetic.casting import cast_rays
from scanweld.datasets.synthetic.kernels import FAR
from scanweld.datasets.synthetic.lighting import octahedral_directions
from scanweld.datasets.synthetic.rendering import render_frame
from scanweld.datasets.synthetic.scene import Material, Scene, Texture, linear_color, new_placement
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera

GREY = Material(Texture.PAINT, "#808080", "#808080")
CAMERA = PinholeCamera(130.0, 130.0, 79.5, 59.5, 160, 120)


def _scene(*kinds: str, seed: int = 0) -> Scene:
    """A scene of random primitives of the given kinds."""
    rng = np.random.default_rng(seed)
    root = new_placement()
    for kind in kinds:
        x, y, z = rng.uniform(-1, 1, 3)
        a, b, c = rng.uniform(0.2, 0.9, 3)
        place = root.at(0.3, -0.2, rng.uniform(0, 360), height=0.1)
        if kind == "box":
            place.box((x, y, z), (a, b, c), GREY, tilt_deg=rng.uniform(-50, 50))
        elif kind == "ball":
            place.ball((x, y, z), (a, b, c), GREY, axis=(a, b, -c))
        elif kind == "frustum":
            place.rod((x, y, z), (x + a, y - b, z + c), 0.4, GREY, end_radius=0.9 * a)
        elif kind == "cylinder":
            place.rod((x, y, z), (x + a, y + b, z - c), 0.4, GREY, depth=0.2)
        elif kind == "sheet":
            place.sheet((x, y, z), a, b, GREY)
    return assemble("test", root, (0.1, 0.1, 0.1))


def _rays(count: int, seed: int = 1) -> tuple[Float64, Float64]:
    rng = np.random.default_rng(seed)
    origin = np.array([3.0, -1.0, -2.5])
    return origin, rng.uniform(-1.2, 1.2, (count, 3)) - origin


def _reference(scene: Scene, row: int, origin: Float64, directions: Float64) -> Float64:
    """Nearest t of one primitive: every crossing of its surfaces, then tested for being on the shape."""
    A = scene.affine[row].reshape(3, 4)
    o, d = A[:, :3] @ origin + A[:, 3], directions @ A[:, :3].T
    kind, taper = scene.integers[row, 0], scene.scalars[row, 4]
    slack = 1 + 1e-9
    candidates = []

    def add(t: Float64, on_shape: Float64) -> None:
        candidates.append(np.where(on_shape & (t > 0), t, np.inf))

    with np.errstate(invalid="ignore", divide="ignore"):
        if kind == 0:
            for axis in range(3):
                for side in (-1, 1):
                    t = (side - o[axis]) / d[:, axis]
                    p = o + t[:, None] * d
                    add(t, (np.abs(np.delete(p, axis, 1)) <= slack).all(axis=1))
        elif kind == 3:
            t = -o[2] / d[:, 2]
            p = o + t[:, None] * d
            add(t, (np.abs(p[:, :2]) <= 1).all(axis=1))
        else:
            # |p|^2 = 1, or x^2 + z^2 = r(y)^2: a quadratic through its values at t = 0, 1, -1.
            def value(t: float) -> Float64:
                p = o + t * d
                if kind == 1:
                    return (p**2).sum(axis=1) - 1
                return p[:, 0] ** 2 + p[:, 2] ** 2 - _radius(p[:, 1], taper) ** 2

            c, plus, minus = value(0.0), value(1.0), value(-1.0)
            a, b = (plus + minus) / 2 - c, (plus - minus) / 2
            root = np.sqrt(b**2 - 4 * a * c)
            for sign in (-1, 1):
                t = (-b + sign * root) / (2 * a)
                y = o[1] + t * d[:, 1]
                add(t, np.isfinite(t) & ((kind == 1) | (np.abs(y) <= 1)))
            if kind == 2:
                for side in (-1, 1):
                    t = (side - o[1]) / d[:, 1]
                    p = o + t[:, None] * d
                    add(t, np.hypot(p[:, 0], p[:, 2]) <= _radius(np.float64(side), taper))
    return np.min(candidates, axis=0)


def _radius(y: Float64, taper: float) -> Float64:
    return np.asarray(1 + (taper - 1) * (y + 1) / 2)


@pytest.mark.parametrize("kind", ["box", "ball", "frustum", "cylinder", "sheet"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_intersections_agree_with_a_plain_reference(kind: str, seed: int) -> None:
    scene = _scene(kind, seed=seed)
    A = scene.affine[0].reshape(3, 4)
    middle = -np.linalg.solve(A[:, :3], A[:, 3])
    origin, directions = _rays(20000, seed)
    directions = directions + middle
    distance, hit = cast_rays(scene, origin, directions)
    expected = _reference(scene, 0, origin, directions)
    seen = np.isfinite(expected)
    assert 150 < seen.sum() < 19000  # the test sees hits and misses
    # A ray that grazes a rim may round to either side.
    assert ((hit == 0) == seen).mean() > 0.999
    both = seen & (hit == 0)
    np.testing.assert_allclose(distance[both], expected[both], rtol=1e-9)


def test_the_tree_finds_what_brute_force_finds() -> None:
    kinds = ["box", "ball", "frustum", "cylinder", "sheet"] * 12
    scene = _scene(*kinds, seed=5)
    origin, directions = _rays(3000)
    distance, hit = cast_rays(scene, origin, directions)
    each = np.stack([_reference(scene, row, origin, directions) for row in range(len(scene))])
    nearest = each.min(axis=0)
    seen = np.isfinite(nearest)
    assert seen.sum() > 1000
    np.testing.assert_array_equal(seen, hit >= 0)
    np.testing.assert_allclose(distance[seen], nearest[seen], rtol=1e-9)
    assert (distance[~seen] == FAR).all()
    np.testing.assert_array_equal(hit[seen], each.argmin(axis=0)[seen])


def test_a_camera_inside_a_box_sees_its_far_side() -> None:
    root = new_placement()
    root.box((0, 0, 0), (2, 2, 2), GREY)
    scene = assemble("inside", root, (1, 1, 1))
    distance, _ = cast_rays(scene, np.zeros(3), np.eye(3))
    np.testing.assert_allclose(distance, 1.0, rtol=1e-12)


def test_depth_of_a_tilted_plane_is_analytic() -> None:
    """The wall z = 2 seen from T = (R, o): (t R d + o)_z = 2, t = (2 - o_z) / (R d)_z; t is depth."""
    root = new_placement()
    root.box((0, 0, 2.5), (50, 50, 1), GREY)
    root.light((0, 1, 0), "#ffffff", 1.0)
    scene = assemble("wall", root, (0.2, 0.2, 0.2))
    T = se3.exp([0.1, -0.2, 0.3, 0.2, -0.3, 0.1])
    color, depth_m = render_frame(scene, CAMERA, T)
    expected = (2 - T[2, 3]) / (CAMERA.rays() @ T[:3, :3].T)[..., 2]
    np.testing.assert_allclose(depth_m, expected, rtol=1e-7)
    assert depth_m.dtype == np.float32
    assert color.dtype == np.uint8
    assert color.min() > 0


def test_nothing_is_hit_where_there_is_nothing() -> None:
    root = new_placement()
    root.box((0, 0, 2), (0.5, 0.5, 0.5), GREY)
    _, depth_m = render_frame(assemble("one", root, (1, 1, 1)), CAMERA, np.eye(4))
    assert depth_m[60, 80] == pytest.approx(1.75)
    assert depth_m[0, 0] == 0


def test_a_shadow_falls_where_the_light_is_hidden() -> None:
    """A board between the light and the floor darkens the floor below it, and only there."""

    def floor_colors(board: bool) -> tuple[float, float]:
        root = new_placement()
        root.box((0, -0.05, 0), (6, 0.1, 6), GREY)
        if board:
            root.box((0, 1.0, 0), (0.8, 0.05, 0.8), GREY)
        root.light((0, 2.0, 0), "#ffffff", 2.0)
        scene = assemble("shadow", root, (0.01, 0.01, 0.01))
        looking_down = np.eye(4)  # camera z is world y (down), camera x is world x
        looking_down[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        looking_down[1, 3] = -0.8  # below the board
        color, depth_m = render_frame(scene, CAMERA, looking_down)
        np.testing.assert_allclose(depth_m, 0.8, rtol=1e-6)
        return float(color[60, 80].mean()), float(color[5, 5].mean())

    lit_middle, lit_corner = floor_colors(board=False)
    dark_middle, _ = floor_colors(board=True)
    assert dark_middle < 0.35 * lit_middle
    assert lit_corner > 0.5 * lit_middle


def test_octahedral_directions_cover_the_sphere_once() -> None:
    """Unit vectors of the texels, weighted by their solid angle |d|^-3, sum to zero, and to 4 pi in all.

    A texel covers (2/S)^2 of the octahedron's unfolded square; on the face |x| + |y| + |z| = 1, whose
    distance from the origin is 1/sqrt 3 and whose area is sqrt 3 times its shadow, the solid angle is dA cos
    / d^2 = (2/S)^2 / |d|^3.
    """
    size = 64
    d = octahedral_directions(size).reshape(-1, 3)
    np.testing.assert_allclose(np.abs(d).sum(axis=1), 1, atol=1e-12)
    norm = np.linalg.norm(d, axis=1)
    weight = (2 / size) ** 2 / norm**3
    assert weight.sum() == pytest.approx(4 * np.pi, rel=2e-3)
    np.testing.assert_allclose((weight[:, None] * d / norm[:, None]).sum(axis=0), 0, atol=1e-9)


def test_linear_color() -> None:
    """IEC 61966-2-1: 0 and 255 are 0 and 1; 128/255 = 0.502 is (0.55696 / 1.055)^2.4 = 0.21586."""
    np.testing.assert_allclose(linear_color("#0080ff"), (0, 0.21586, 1), atol=1e-5)
