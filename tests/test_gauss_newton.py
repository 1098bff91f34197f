"""The shared step: free directions are named, held still, and do not depend on the origin or the unit."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.geometry import se3
from scanweld.registration.closed_form.align import _words as axis_words
from scanweld.registration.gauss_newton import (
    NormalEquations,
    free_directions,
    moved_origin,
    solve,
    spectrum,
    standard_deviation,
)
from scanweld.registration.residuals import normal_equations, point_to_plane


def equations_of(points, normals, offset=None):
    offset = np.zeros_like(points) if offset is None else offset
    residuals, jacobian = point_to_plane(points + offset, points, normals)
    return normal_equations(points + offset, residuals, jacobian, np.ones(len(points)))


def plane(count=400, seed=0):
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.zeros(count)])
    return points, np.tile([0.0, 0.0, 1.0], (count, 1))


def box(count=600, seed=0):
    """Three walls at right angles: everything is held."""
    rng = np.random.default_rng(seed)
    points, normals = rng.uniform(0, 1, (count, 3)), np.zeros((count, 3))
    for k in range(3):
        points[k::3, k], normals[k::3, k] = 0, 1
    return points, normals


def names(equations):
    return sorted(direction.words.split(" ")[0] for direction in free_directions(equations, spectrum(equations)))


def test_a_plane_leaves_two_translations_and_the_turn_about_its_normal():
    directions = free_directions(equations := equations_of(*plane()), spectrum(equations))
    assert [d.words.split(" ")[0] for d in directions] == ["translation", "translation", "rotation"]
    assert directions[2].words == "rotation about (0.00, 0.00, 1.00)"
    for direction in directions[:2]:
        np.testing.assert_allclose(direction.vector[[2, 3, 4, 5]], 0, atol=1e-9)
        assert np.linalg.norm(direction.vector) == pytest.approx(1)


def test_a_cylinder_leaves_a_slide_and_a_turn_and_a_sphere_all_turns():
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 2000), rng.uniform(-1, 1, 2000)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(2000)])
    cylinder = equations_of(0.5 * normals + height[:, None] * [0, 0, 1], normals)
    words = [d.words for d in free_directions(cylinder, spectrum(cylinder))]
    assert words == ["translation along (0.00, 0.00, 1.00)", "rotation about (0.00, 0.00, 1.00)"]
    ball = rng.normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    assert names(equations_of(2 * ball, ball)) == ["rotation"] * 3


def test_three_walls_hold_everything():
    equations = equations_of(*box())
    assert spectrum(equations).observable.all()
    assert free_directions(equations, spectrum(equations)) == ()


def test_a_straight_wall_of_the_plane_leaves_its_own_direction():
    points = np.column_stack([np.linspace(0, 3, 50), np.zeros(50)])
    equations = equations_of(points, np.tile([0.0, 1.0], (50, 1)))
    directions = free_directions(equations, spectrum(equations))
    assert [d.words for d in directions] == ["translation along (1.00, 0.00)"]


@pytest.mark.parametrize("shift", [0.0, 10.0, 1e3])
@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e3])
def test_what_is_free_depends_neither_on_origin_nor_unit(shift, unit):
    points, normals = plane()
    for cloud, expected in (((points, normals), 3), (box(), 0)):
        equations = equations_of(unit * (cloud[0] + shift), cloud[1])
        values = spectrum(equations).values
        assert (~spectrum(equations).observable).sum() == expected
        np.testing.assert_allclose(values, spectrum(equations_of(*cloud)).values, atol=1e-6)


def test_a_step_moves_nothing_along_the_free_directions():
    """A plane lifted by 2 mm and slid by 10 cm: the step takes back the lift and leaves the slide."""
    points, normals = plane()
    equations = equations_of(points, normals, offset=np.array([0.1, -0.05, 0.002]))
    xi = solve(equations, spectrum(equations))
    np.testing.assert_allclose(xi, [0, 0, -0.002, 0, 0, 0], atol=1e-12)


def test_the_step_is_gauss_newtons_where_all_is_held():
    rng = np.random.default_rng(2)
    points, normals = box()
    residuals, jacobian = point_to_plane(points + 0.01 * rng.normal(size=points.shape), points, normals)
    equations = normal_equations(points, residuals, jacobian, np.ones(len(points)))
    expected, *_ = np.linalg.lstsq(jacobian, -residuals, rcond=None)
    np.testing.assert_allclose(solve(equations, spectrum(equations)), expected, atol=1e-12)


def test_the_step_undoes_a_small_motion_about_a_far_origin():
    points, normals = box()
    points = points + [100.0, -50.0, 20.0]
    truth = se3.exp([1e-4, 2e-4, -1e-4, 1e-5, -2e-5, 1e-5])
    moved = se3.transform_points(se3.inverse(truth), points)
    residuals, jacobian = point_to_plane(moved, points, normals)
    equations = normal_equations(moved, residuals, jacobian, np.ones(len(points)))
    step = se3.exp(solve(equations, spectrum(equations)))
    np.testing.assert_allclose(se3.transform_points(step, moved), points, atol=1e-7)


def test_the_constraint_of_a_plane_is_the_scatter_of_its_normals():
    """Normals tilted by +-0.1 rad about y: the mean squared slope is sin(0.1)^2 = 0.00997 along x, 0 along y.

    The turn about z has n_x y / radius; on a square <y^2> is half of radius^2, so its slope is half of that.
    """
    points, normals = plane(4000)
    tilt = np.where(np.arange(len(points)) % 2, 0.1, -0.1)
    normals = np.column_stack([np.sin(tilt), np.zeros(len(tilt)), np.cos(tilt)])
    equations = equations_of(points, normals)
    expected = np.sin(0.1) ** 2 * np.array([0, 0.5, 1])
    np.testing.assert_allclose(spectrum(equations).values[:3], expected, atol=3e-4)
    assert (~spectrum(equations).observable).sum() == 1
    assert (~spectrum(equations, 0.02).observable).sum() == 3


def test_no_data_leaves_everything_free():
    equations = equations_of(np.zeros((0, 3)), np.zeros((0, 3)))
    parts = spectrum(equations)
    assert not parts.observable.any()
    assert len(free_directions(equations, parts)) == 6
    np.testing.assert_array_equal(solve(equations, parts), 0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_information_about_another_origin(dimension):
    """H about a moved origin is what the rows in moved coordinates give."""
    rng = np.random.default_rng(3)
    points, normals = rng.normal(size=(2, 50, dimension))
    offset = rng.normal(size=dimension)
    here, there = equations_of(points, normals), equations_of(points + offset, normals)
    np.testing.assert_allclose(moved_origin(here.information, offset), there.information, atol=1e-10)


def test_a_turn_of_the_plane_is_about_the_centroid():
    """Points in one place hold no turn: what is free leaves the centroid (3, 5) where it is, phi (-5, 3) + rho = 0."""
    c = np.array([3.0, 5.0])
    information = np.diag([1.0, 1.0, 0.0])
    information[:2, 2] = information[2, :2] = [-c[1], c[0]]  # a turn moves the point by (-y, x)
    information[2, 2] = c @ c
    equations = NormalEquations(information, np.zeros(3), 1.0, c, 1.0)
    parts = spectrum(equations)
    assert parts.observable.tolist() == [False, True, True]
    np.testing.assert_allclose(parts.values, [0, 1, 1], atol=1e-12)
    rho, phi = parts.basis[:2, 0], parts.basis[2, 0]
    np.testing.assert_allclose(phi * np.array([-c[1], c[0]]) + rho, 0, atol=1e-9)
    assert abs(phi) > 0.1


def test_what_is_free_does_not_make_the_rest_certain():
    """A wall 1 m across, seen with weights 1 / sigma^2 = 1e4 by 400 points: sigma / sqrt(400) along its normal, and
    more for the two tilts; nothing is known where nothing is seen."""
    points, normals = plane()
    residuals, jacobian = point_to_plane(points, points, normals)
    equations = normal_equations(points, residuals, jacobian, np.full(len(points), 1e4))
    expected = np.sqrt((1 / spectrum(equations).values[3:]).sum() / (400 * 1e4))
    assert standard_deviation(equations, spectrum(equations)) == pytest.approx(expected)
    assert 0.01 / 20 < expected < 0.01 / 5
    nothing = NormalEquations(np.zeros((6, 6)), np.zeros(6), 1.0, np.zeros(3), 1.0)
    assert standard_deviation(nothing, spectrum(nothing)) == 0


def test_names_have_no_negative_zero():
    assert axis_words(np.array([-1.0, 0.004, -0.004])) == "(1.00, 0.00, 0.00)"
