"""The local methods, feature by feature, and what they are worth where there is little to go by."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from scanweld.errors import ConfigError, InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.neighbours import build_index
from scanweld.geometry.normals import estimate_normals, fit_surfaces
from scanweld.geometry.point_cloud import PointCloud
from scanweld.registration import residuals
from scanweld.registration.icp import IcpConfig, icp
from scanweld.registration.local.colour import intensity_gradients
from scanweld.registration.local.config import METHODS
from scanweld.registration.prior import MotionPrior
from scanweld.registration.result import RegistrationResult, Status

MOTION = se3.exp([0.05, -0.03, 0.04, 0.03, -0.02, 0.04])
TURN_2D = np.array([[np.cos(0.05), -np.sin(0.05), 0.02], [np.sin(0.05), np.cos(0.05), 0.03], [0, 0, 1]])

GEOMETRIC = tuple(method for method in METHODS if method != "coloured")
SURFACE = tuple(method for method in GEOMETRIC if method != "point-to-point")
ALL = pytest.mark.parametrize("method", METHODS)
FAMILY = pytest.mark.parametrize("method", GEOMETRIC)
SURFACES = pytest.mark.parametrize("method", SURFACE)


def room(count: int, seed: int, noise: float = 0.0) -> np.ndarray:
    """Points on the six walls of a 4 x 3 x 2.5 m room and on a ball on its floor."""
    rng = np.random.default_rng(seed)
    size = np.array([4, 3, 2.5])
    points = rng.uniform(0, 1, (count, 3)) * size
    face = rng.integers(0, 7, count)
    for k in range(3):
        points[face == 2 * k, k] = 0
        points[face == 2 * k + 1, k] = size[k]
    ball = rng.normal(size=(count, 3))
    ball = [2, 1.5, 0.5] + 0.5 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    points[face == 6] = ball[face == 6]
    return points + noise * rng.normal(size=points.shape)


def yard(T_world_sensor: np.ndarray) -> np.ndarray:
    """What a spinning scanner of 32 rings sees in a yard of 16 x 12 m with high walls, exactly."""
    elevation, azimuth = np.radians(np.linspace(-25, 10, 32)), np.linspace(0.001, 2 * np.pi, 300, endpoint=False)
    e, a = np.meshgrid(elevation, azimuth)
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)
    (x, y, z), (ox, oy, oz) = T_world_sensor[:3, :3] @ rays.T, T_world_sensor[:3, 3]
    walls = np.minimum((np.sign(x) * 8 - ox) / x, (np.sign(y) * 6 - oy) / y)
    return rays * np.minimum(walls, np.where(z < 0, -oz / np.where(z < 0, z, -1), np.inf))[:, None]


def outline(count: int, seed: int, noise: float = 0.0) -> np.ndarray:
    """Points on the walls of an L-shaped room of the plane, 10 m around."""
    corners = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (0, 2), (0, 0)], dtype=float)
    rng = np.random.default_rng(seed)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    wall = rng.choice(6, count, p=lengths / lengths.sum())
    s = rng.uniform(0, 1, count)[:, None]
    points = corners[wall] + s * (corners[wall + 1] - corners[wall])
    return points + noise * rng.normal(size=points.shape)


def slab(count: int, seed: int, noise: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(0, 3, (count, 2)), np.zeros(count)])
    return points + noise * rng.normal(size=points.shape)


def painted(points: np.ndarray) -> PointCloud:
    """A cloud with a smooth texture of known place, in colours of 8 bits."""
    grey = 127 + 60 * np.sin(4 * points[:, 0]) + 60 * np.cos(3 * points[:, 1] + points[:, 2])
    return PointCloud(points, colors=np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[:, None], 3, axis=1))


def cloud_of(method: str, points: np.ndarray) -> PointCloud:
    return painted(points) if method == "coloured" else PointCloud(points)


def back(points: np.ndarray, T: np.ndarray = MOTION) -> np.ndarray:
    return se3.transform_points(se3.inverse(T), points)


def moved_back(cloud: PointCloud, T: np.ndarray = MOTION) -> PointCloud:
    """The cloud in the source's frame, its colours kept."""
    return PointCloud(back(cloud.points_m, T), colors=cloud.colors)


def twist_of(T: np.ndarray) -> np.ndarray:
    """log of a motion of space (6,) or of the plane (3,)."""
    if len(T) == 4:
        return se3.log(T)
    space = np.eye(4)
    space[np.ix_([0, 1, 3], [0, 1, 3])] = T
    return se3.log(space)[[0, 1, 5]]


def pose_error(result: RegistrationResult, truth: np.ndarray) -> tuple[float, float]:
    """Distance [m] and angle [degrees]."""
    xi = twist_of(result.T_target_source @ se3.inverse(truth))
    d = len(truth) - 1
    return float(np.linalg.norm(xi[:d])), float(np.degrees(np.linalg.norm(xi[d:])))


def kinds(result: RegistrationResult) -> list[str]:
    return sorted(direction.words.split(" (")[0] for direction in result.unobservable)


def assert_sound(result: RegistrationResult) -> None:
    """Nothing is NaN, a rotation is one, what is not known is said."""
    assert np.isfinite(result.T_target_source).all()
    assert np.isfinite(result.information).all()
    assert result.covariance is None or np.isfinite(result.covariance).all()
    assert np.isfinite([result.rmse_m, result.overlap, result.scale, result.scale_std]).all()
    d = len(result.T_target_source) - 1
    assert np.linalg.det(result.T_target_source[:d, :d]) == pytest.approx(1)
    assert result.status is Status.CONVERGED or result.note


class TestMethods:
    @pytest.mark.parametrize(("method", "distance", "degrees"), [
        ("point-to-point", 0.03, 0.7), ("point-to-plane", 2e-3, 0.05), ("symmetric", 2e-3, 0.05),
        ("gicp", 2e-3, 0.05), ("coloured", 2e-3, 0.05),
    ])  # fmt: skip
    def test_another_sample_of_a_noisy_surface(self, method, distance, degrees):
        """5000 points some 10 cm apart with 5 mm noise. Surface methods average it away; pairs of points show the
        sampling."""
        source, target = (cloud_of(method, p) for p in (room(5000, 1, 0.005), room(5000, 2, 0.005)))
        result = icp(moved_back(source), target, config=IcpConfig(method=method))
        assert result.status is Status.CONVERGED
        assert np.less(pose_error(result, MOTION), (distance, degrees)).all()

    @ALL
    def test_a_far_guess_with_other_starts_around_it(self, method):
        """40 degrees and 0.5 m off: the first start leads elsewhere, one of the others does not."""
        far = se3.exp([0.3, -0.3, 0.25, 0.4, -0.3, 0.5])
        target = cloud_of(method, room(2000, 1))
        result = icp(moved_back(target, far), target, config=IcpConfig(method=method))
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source, far, atol=1e-6)
        alone = icp(moved_back(target, far), target, config=IcpConfig(method=method, attempts=0))
        assert not alone.status.success or pose_error(alone, far)[0] < 1e-6

    @pytest.mark.parametrize("seed", [1, 2])
    def test_distances_alone_tell_that_a_start_led_astray(self, seed):
        """Rolled by 69 degrees about the room's centre and 0.5 m off; point-to-point has no normals that disagree."""
        centre, turn = np.array([2, 1.5, 1.25]), se3.exp([0, 0, 0, 1.2, 0, 0])
        far = turn.copy()
        far[:3, 3] = centre - turn[:3, :3] @ centre + [0.3, -0.3, 0.3]
        target = room(1000, seed)
        one, many = (
            icp(back(target, far), target, config=IcpConfig(method="point-to-point", attempts=attempts))
            for attempts in (0, 24)
        )
        assert not one.status.success
        assert many.status is Status.CONVERGED
        np.testing.assert_allclose(many.T_target_source, far, atol=1e-6)

    def test_a_wide_gate_is_narrowed_once_the_surfaces_meet(self):
        """Of the source 54 % have their copy in the target, and what else is within 1 m of its rim pulls towards it."""
        cloud = room(3000, 1)
        source, target = cloud[cloud[:, 0] < 2.5], cloud[cloud[:, 0] > 1.0]
        common = float((source[:, 0] > 1.0).mean())
        narrowed, wide = (
            icp(back(source), target, config=IcpConfig(method="gicp", kernel="none", max_correspondence_distance_m=1.0,
                                                       attempts=0, coarse_to_fine=coarse))
            for coarse in (True, False)
        )  # fmt: skip
        assert narrowed.status is Status.CONVERGED
        assert narrowed.overlap == pytest.approx(common, abs=0.05)
        assert wide.overlap > common + 0.15
        assert pose_error(narrowed, MOTION)[0] < 1e-3 < pose_error(wide, MOTION)[0] / 5

    @ALL
    def test_coarse_levels_lead_to_the_same_answer(self, method):
        source, target = (cloud_of(method, room(4000, seed, 0.002)) for seed in (1, 2))
        one, other = (
            icp(moved_back(source), target, config=IcpConfig(method=method, coarse_to_fine=c, attempts=0,
                                                             max_correspondence_distance_m=0.2, tolerance=1e-6,
                                                             max_iterations=400))
            for c in (True, False)
        )  # fmt: skip
        assert one.status is other.status is Status.CONVERGED
        if method == "point-to-point":  # many minima, as far apart as the sampling makes them
            assert pose_error(one, other.T_target_source)[0] < 0.02
        else:
            sigma = np.sqrt(np.diag(one.covariance))
            assert (np.abs(twist_of(one.T_target_source @ se3.inverse(other.T_target_source))) < sigma).all()

    @ALL
    def test_thinned_first(self, method):
        source, target = (cloud_of(method, room(20_000, seed, 0.002)) for seed in (1, 2))
        result = icp(moved_back(source), target, config=IcpConfig(method=method, voxel_m=0.1))
        assert result.status is Status.CONVERGED
        assert result.num_inliers < 7000
        assert pose_error(result, MOTION)[0] < (0.03 if method == "point-to-point" else 4e-3)

    @ALL
    def test_every_step_is_kept_with_the_rows_as_given(self, method):
        """Rows count in the clouds as they were passed, those that are not finite included."""
        target = cloud_of(method, room(5000, 1))  # large enough to be reordered inside
        source = moved_back(target)
        points = np.vstack([np.full((1, 3), np.nan), source.points_m])
        colors = None if source.colors is None else np.vstack([source.colors[:1], source.colors])
        config = IcpConfig(method=method, coarse_to_fine=False)
        result = icp(PointCloud(points, colors=colors), target, config=config, keep_history=True)
        assert len(result.history) == result.num_iterations
        last = result.history[-1]
        np.testing.assert_array_equal(last.pairs.source, np.arange(1, 5001))
        np.testing.assert_array_equal(last.pairs.target, np.arange(5000))
        np.testing.assert_allclose(last.T_after, result.T_target_source, atol=1e-12)
        np.testing.assert_allclose(result.history[0].T_before, np.eye(4), atol=1e-12)
        for step, following in zip(result.history, result.history[1:], strict=False):
            np.testing.assert_allclose(step.T_after, following.T_before, atol=1e-12)
            assert (np.diff(step.pairs.source) > 0).all()
        first = result.history[0]
        apart = np.linalg.norm(points[first.pairs.source] - target.points_m[first.pairs.target], axis=1)
        np.testing.assert_allclose(first.pairs.distances_m, apart, atol=1e-9)
        assert (first.fit is not None) == (method == "point-to-point")
        assert icp(source, target, config=config).history == ()

    @ALL
    def test_threads_do_not_change_a_byte(self, method):
        source, target = (cloud_of(method, room(9000, seed, 0.01)) for seed in (1, 2))
        results = [icp(source, target, config=IcpConfig(method=method), num_threads=n) for n in (1, 2, 8)]
        for result in results[1:]:
            for name in ("T_target_source", "information", "covariance"):
                assert getattr(result, name).tobytes() == getattr(results[0], name).tobytes()
            assert result.rmse_m == results[0].rmse_m

    @ALL
    def test_arguments_stay_as_they_are(self, method):
        source, target = moved_back(cloud_of(method, room(600, 1))), cloud_of(method, room(600, 2))
        weights, T = np.ones(600), np.eye(4)
        arrays = [source.points_m, target.points_m, weights, T]
        kept = [array.copy() for array in arrays]
        icp(source, target, weights=weights, T_init=T, config=IcpConfig(method=method))
        for array, copy in zip(arrays, kept, strict=True):
            np.testing.assert_array_equal(array, copy)

    def test_symmetric_needs_fewer_steps_on_curved_surfaces(self):
        """An ellipsoid turned by 11 degrees: the symmetric metric is exact on surfaces of second order between the
        points (Rusinkiewicz 2019, section 3), planes are not."""
        rng = np.random.default_rng(0)
        ball = rng.normal(size=(3000, 3))
        target = ball / np.linalg.norm(ball, axis=1, keepdims=True) * [2.0, 1.3, 0.8]
        truth = se3.exp([0.02, 0.03, -0.02, 0.1, -0.12, 0.12])
        plain, symmetric = (
            icp(back(target, truth), target, config=IcpConfig(method=m, coarse_to_fine=False, kernel="none"))
            for m in ("point-to-plane", "symmetric")
        )
        assert symmetric.status is Status.CONVERGED
        assert symmetric.num_iterations <= plain.num_iterations
        np.testing.assert_allclose(symmetric.T_target_source, truth, atol=1e-9)

    def test_given_normals_are_used_whatever_their_sign_and_length(self):
        target = room(2000, 1)
        normals = estimate_normals(target)
        rng = np.random.default_rng(0)
        signs = rng.choice([-3.0, 0.5], len(target))[:, None]
        for method in ("symmetric", "gicp"):
            config = IcpConfig(method=method)
            source = back(target)
            turned = normals @ MOTION[:3, :3]
            one = icp(source, target, target_normals=normals, source_normals=turned, config=config)
            other = icp(source, target, target_normals=signs * normals, source_normals=-signs * turned, config=config)
            assert one.status is other.status is Status.CONVERGED
            np.testing.assert_allclose(one.T_target_source, other.T_target_source, atol=1e-9)


class TestColour:
    def test_gradients_of_a_known_texture(self):
        """I = 0.5 + 0.3 sin(2 x) on the plane z = 0.1 y: the gradient is that of I within the plane,
        g - n (n . g), n = (0, -0.1, 1) / sqrt(1.01); here dI/dx = 0.6 cos(2 x) along x alone, as n has no x."""
        rng = np.random.default_rng(0)
        xy = rng.uniform(0, 3, (24_000, 2))
        points = np.column_stack([xy, 0.1 * xy[:, 1]])
        normals = np.tile(np.array([0, -0.1, 1]) / np.sqrt(1.01), (len(points), 1))
        values = 0.5 + 0.3 * np.sin(2 * points[:, 0])
        found = intensity_gradients(points, normals, values, build_index(points), 12)
        inner = (np.abs(xy - 1.5) < 1.3).all(axis=1)
        expected = np.column_stack([0.6 * np.cos(2 * points[:, 0]), np.zeros((len(points), 2))])
        np.testing.assert_allclose(found[inner], expected[inner], atol=0.035)
        np.testing.assert_allclose((found * normals).sum(axis=1), 0, atol=1e-12)

    def test_a_gradient_across_the_tilt(self):
        """I = y on the plane z = y: the unit direction within the plane is u = (0, 1, 1) / sqrt(2), along which I
        rises by 1 / sqrt(2) a metre, so the gradient is u / sqrt(2) = (0, 1/2, 1/2)."""
        rng = np.random.default_rng(1)
        xy = rng.uniform(0, 1, (500, 2))
        points = np.column_stack([xy, xy[:, 1]])
        normals = np.tile(np.array([0, -1, 1]) / np.sqrt(2), (500, 1))
        found = intensity_gradients(points, normals, points[:, 1], build_index(points), 10)
        np.testing.assert_allclose(found, np.tile([0, 0.5, 0.5], (500, 1)), atol=2e-5)

    def test_a_textured_plane_slid_in_itself(self):
        """Geometry leaves three directions free; the texture holds them."""
        slide = se3.exp([0.08, -0.05, 0.01, 0, 0, 0.03])
        source, target = painted(slab(4000, 1)), painted(slab(4000, 2))
        result = icp(moved_back(source, slide), target, config=IcpConfig(method="coloured"))
        assert result.status is Status.CONVERGED
        assert pose_error(result, slide)[0] < 3e-3
        assert pose_error(result, slide)[1] < 0.1
        plane = icp(moved_back(source, slide), target, config=IcpConfig(method="point-to-plane"))
        assert plane.status is Status.DEGENERATE
        assert len(plane.unobservable) == 3

    def test_stripes_hold_one_direction_only(self):
        def striped(points):
            grey = (127 + 100 * np.sin(5 * points[:, 0])).astype(np.uint8)
            return PointCloud(points, colors=np.repeat(grey[:, None], 3, axis=1))

        source, target = striped(slab(4000, 1)), striped(slab(4000, 2))
        source = PointCloud(source.points_m + [0.05, 0.1, 0], colors=source.colors)
        result = icp(source, target, config=IcpConfig(method="coloured"))
        assert result.status is Status.DEGENERATE
        assert [d.words for d in result.unobservable] == ["translation along (0.00, 1.00, 0.00)"]
        assert result.T_target_source[0, 3] == pytest.approx(-0.05, abs=4e-3)
        assert abs(result.T_target_source[1, 3]) < 4e-3

    def test_one_colour_is_no_texture(self):
        grey = np.full((2000, 3), 90, np.uint8)
        source, target = (PointCloud(slab(2000, seed), colors=grey) for seed in (1, 2))
        result = icp(source, target, config=IcpConfig(method="coloured"))
        assert result.status is Status.DEGENERATE
        assert kinds(result) == ["rotation about", "translation along", "translation along"]

    def test_colours_are_needed(self):
        with pytest.raises(InvalidInputError, match="colours"):
            icp(room(100, 0), room(100, 1), config=IcpConfig(method="coloured"))


class TestScale:
    @FAMILY
    def test_a_moved_and_grown_copy(self, method):
        target = room(2000, 0)
        rigid = se3.exp([0.02, 0.01, 0, 0.01, 0, 0.02])
        source = back(target, rigid) / 1.05
        result = icp(source, target, config=IcpConfig(method=method, scale="least_squares"))
        assert result.status is Status.CONVERGED
        assert result.scale == pytest.approx(1.05, abs=1e-6)
        moved = result.scale * source @ result.T_target_source[:3, :3].T + result.T_target_source[:3, 3]
        np.testing.assert_allclose(moved, target, atol=1e-5)
        assert np.linalg.det(result.T_target_source[:3, :3]) == pytest.approx(1)

    @FAMILY
    def test_in_the_plane(self, method):
        target = outline(600, 0)
        source = back(target, TURN_2D) / 0.97
        result = icp(source, target, config=IcpConfig(method=method, scale="least_squares"))
        assert result.status is Status.CONVERGED
        assert result.scale == pytest.approx(0.97, abs=1e-6)

    @pytest.mark.parametrize("method", ["symmetric", "gicp"])
    def test_its_deviation_is_that_of_the_answers(self, method):
        """40 samples: the mean of (s - 1)^2 / std^2 has the deviation sqrt(2 / 40) = 0.22 about 1. Not point-to-plane:
        a point between those of a curved target lies off their tangent planes by d^2 / (2 R), which is no scatter but
        a bias of the scale."""
        errors = []
        for seed in range(40):
            source, target = room(1500, 2 * seed + 1, 0.005), room(1500, 2 * seed + 2, 0.005)
            config = IcpConfig(method=method, scale="least_squares", attempts=0)
            result = icp(source, target, config=config)
            assert result.scale_std > 0
            errors.append(((result.scale - 1) / result.scale_std) ** 2)
        assert 0.45 < np.mean(errors) < 1.75

    @FAMILY
    @pytest.mark.parametrize("shape", ["corner", "plane"])
    def test_what_tells_no_scale(self, method, shape):
        """Three planes through a point are the same at any scale about it; so is one."""

        def make(seed: int) -> np.ndarray:
            rng = np.random.default_rng(seed)
            points = rng.uniform(0, 2, (1500, 3))
            points[np.arange(1500), rng.integers(0, 3, 1500) if shape == "corner" else 2] = 0
            return points

        result = icp(1.02 * make(1), make(2), config=IcpConfig(method=method, scale="least_squares", attempts=0))
        assert result.status is Status.DEGENERATE
        assert "scale" in [direction.words for direction in result.unobservable]
        assert result.scale == 1

    def test_it_is_one_unless_asked_for(self):
        target = room(2000, 0)
        result = icp(target / 1.01, target, config=IcpConfig())
        assert result.scale == 1
        assert result.scale_std == 0


KERNELS = ("huber", "cauchy", "geman_mcclure", "tukey", "welsch", "barron", "trimmed")


class TestRobustness:
    @pytest.mark.parametrize("kernel", KERNELS)
    @FAMILY
    def test_a_tenth_of_outliers(self, method, kernel):
        """Every tenth point lifted by 20 cm: the kernel must beat the plain sum by a factor of four."""
        target = room(3000, 0)
        source = back(target)
        source[::10] += [0, 0, 0.2]

        def error(name: str) -> float:
            config = IcpConfig(method=method, kernel=name, attempts=0)
            return pose_error(icp(source, target, config=config), MOTION)[0]

        assert error(kernel) < 0.25 * error("none")

    @pytest.mark.parametrize("kernel", ["cauchy", "geman_mcclure"])
    @SURFACES
    def test_many_outliers_with_a_narrowing_kernel(self, method, kernel):
        """A third of the points hangs 5 to 30 cm over the floor and before the walls, all on the same side."""
        rng = np.random.default_rng(0)
        target = room(3000, 0)
        source = target.copy()
        source[::3] += rng.uniform(0.05, 0.3, (1000, 1))
        config = IcpConfig(method=method, kernel=kernel, graduated=True, attempts=0)
        result = icp(back(source), target, config=config)
        assert result.status is Status.CONVERGED
        assert pose_error(result, MOTION)[0] < 1e-3
        plain = icp(back(source), target, config=IcpConfig(method=method, kernel="none", attempts=0))
        assert pose_error(plain, MOTION)[0] > 0.02

    def test_half_of_the_points_are_outliers(self):
        """Started narrow, the kernel settles on a compromise; narrowing, it finds the half that agrees."""
        rng = np.random.default_rng(0)
        target = room(3000, 0)
        rng.uniform(size=1000)
        source = target.copy()
        source[::2] += rng.uniform(0.05, 0.3, (1500, 1))

        def error(graduated: bool) -> float:
            config = IcpConfig(method="gicp", graduated=graduated, attempts=0, coarse_to_fine=False)
            return pose_error(icp(back(source), target, config=config), MOTION)[0]

        assert error(True) < 1e-3
        assert error(False) > 0.02

    def test_steps_of_no_length_end_the_narrowing(self):
        """From the exact answer the first step is 0, and the schedule has just begun."""
        target = room(1000, 0)
        for kernel in ("cauchy", "trimmed"):
            result = icp(target, target, config=IcpConfig(method="gicp", graduated=True, kernel=kernel))
            assert result.status is Status.CONVERGED
            np.testing.assert_allclose(result.T_target_source, np.eye(4), atol=1e-12)

    def test_trimmed_point_to_point_on_a_partial_copy(self):
        """A sixth of the source has no counterpart: its pairs with the rim pull on the plain sum, and are trimmed."""
        target = room(4000, 1)
        source, target = target[target[:, 0] > 0.3], target[target[:, 0] < 3.5]
        plain, trimmed = (
            icp(back(source), target, config=IcpConfig(method="point-to-point", kernel=kernel, attempts=0))
            for kernel in ("none", "trimmed")
        )
        assert trimmed.status is Status.CONVERGED
        assert pose_error(trimmed, MOTION)[0] < 1e-6
        assert pose_error(plain, MOTION)[0] > 1e-3 or plain.overlap < trimmed.overlap

    def test_a_known_noise_sets_the_kernel(self):
        """With a scale far above the residuals Huber is the plain sum; with one far below it counts signs only."""
        source, target = back(room(2000, 1, 0.01)), room(2000, 2, 0.01)
        options = {"coarse_to_fine": False, "max_correspondence_distance_m": 0.3}
        plain = icp(source, target, config=IcpConfig(kernel="none", kernel_scale_m=10.0, **options))
        wide = icp(source, target, config=IcpConfig(kernel="huber", kernel_scale_m=10.0, **options))
        narrow = icp(source, target, config=IcpConfig(kernel="huber", kernel_scale_m=1e-3, **options))
        np.testing.assert_allclose(wide.T_target_source, plain.T_target_source, atol=1e-12)
        assert np.abs(narrow.T_target_source - plain.T_target_source).max() > 1e-5

    @FAMILY
    def test_a_point_of_weight_zero_is_absent(self, method):
        """Normals are given: estimated ones would see the absent points."""
        target = room(1500, 1)
        source = np.vstack([back(room(1500, 2)), back(room(300, 3)) + [0, 0, 0.15]])
        normals, own = estimate_normals(target), estimate_normals(source)
        weights = np.append(np.ones(1500), np.zeros(300))
        config = IcpConfig(
            method=method, kernel="none", coarse_to_fine=False, attempts=0, max_correspondence_distance_m=0.4
        )
        given = icp(source, target, target_normals=normals, source_normals=own, weights=weights, config=config)
        absent = icp(source[:1500], target, target_normals=normals, source_normals=own[:1500], config=config)
        present = icp(source, target, target_normals=normals, source_normals=own, config=config)
        np.testing.assert_allclose(given.T_target_source, absent.T_target_source, atol=2e-5)
        assert np.abs(present.T_target_source - absent.T_target_source).max() > 1e-3

    @FAMILY
    def test_a_point_of_weight_two_is_there_twice(self, method):
        target, source = room(1500, 1), back(room(1500, 2))
        normals, own = estimate_normals(target), estimate_normals(source)
        rows = np.append(np.arange(1500), np.arange(500))
        weights = np.append(np.full(500, 2.0), np.ones(1000))
        config = IcpConfig(
            method=method, kernel="none", coarse_to_fine=False, attempts=0, max_correspondence_distance_m=0.4
        )
        options = {"target_normals": normals, "config": config}
        weighted = icp(source, target, source_normals=own, weights=weights, **options)
        twice = icp(source[rows], target, source_normals=own[rows], **options)
        np.testing.assert_allclose(weighted.T_target_source, twice.T_target_source, atol=2e-5)
        np.testing.assert_allclose(weighted.information, twice.information, rtol=1e-2, atol=1)

    @pytest.mark.parametrize(
        ("weights", "words"),
        [(np.ones(3), "one per source point"), (-np.ones(100), "negative"), (np.full(100, np.nan), "finite")],
    )
    def test_weights_that_are_none(self, weights, words):
        with pytest.raises(InvalidInputError, match=words):
            icp(room(100, 0), room(100, 1), weights=weights)

    def test_all_weights_zero(self):
        result = icp(room(300, 0), room(300, 0), weights=np.zeros(300))
        assert not result.status.success
        assert_sound(result)


class TestPairs:
    def test_one_to_one_serves_every_target_once(self):
        source, target = back(room(2000, 1)), room(500, 2)
        config = IcpConfig(method="point-to-point", pairing="one-to-one", coarse_to_fine=False, attempts=0)
        for step in icp(source, target, config=config, keep_history=True).history:
            assert len(np.unique(step.pairs.target)) == len(step.pairs.target)
        free = icp(source, target, config=IcpConfig(method="point-to-point", coarse_to_fine=False), keep_history=True)
        assert len(np.unique(free.history[0].pairs.target)) < len(free.history[0].pairs.target)

    def test_mutual_pairs_are_each_other_s_nearest(self):
        source, target = room(800, 1), room(500, 2)
        config = IcpConfig(method="point-to-point", pairing="mutual", coarse_to_fine=False, attempts=0)
        pairs = icp(source, target, config=config, keep_history=True).history[0].pairs
        apart = np.linalg.norm(source[:, None] - target[None], axis=2)
        expected = [
            (i, j) for i, j in enumerate(apart.argmin(axis=1)) if apart[:, j].argmin() == i and apart[i, j] < 10
        ]
        assert set(zip(pairs.source.tolist(), pairs.target.tolist(), strict=True)) == set(expected)

    @pytest.mark.parametrize("pairing", ["one-to-one", "mutual"])
    @FAMILY
    def test_every_pairing_finds_a_moved_copy(self, method, pairing):
        target = room(2000, 0)
        result = icp(back(target), target, config=IcpConfig(method=method, pairing=pairing))
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source, MOTION, atol=1e-9)

    def test_normals_that_disagree_are_no_pair(self):
        """A shelf 6 cm over the floor, seen from the side in one cloud only: its edge faces x, the floor z."""
        floor = slab(3000, 1)
        rng = np.random.default_rng(0)
        wall = np.column_stack([np.full(600, 1.5), rng.uniform(0, 3, 600), rng.uniform(0.02, 0.5, 600)])
        normals = np.vstack([np.tile([0, 0, 1.0], (3000, 1)), np.tile([1.0, 0, 0], (600, 1))])
        source, target = np.vstack([floor, wall]), floor
        target_normals = np.tile([0, 0, -1.0], (3000, 1))  # the sign means nothing
        options = {"target_normals": target_normals, "source_normals": normals, "keep_history": True}
        strict = icp(source, target, config=IcpConfig(min_normal_cosine=0.5, coarse_to_fine=False), **options)
        loose = icp(source, target, config=IcpConfig(coarse_to_fine=False), **options)
        assert strict.history[0].pairs.source.max() < 3000
        assert loose.history[0].pairs.source.max() >= 3000

    @pytest.mark.parametrize("shape", [room, outline])
    def test_pairs_with_the_rim_do_not_count(self, shape):
        """The source reaches beyond the target, whose rim pulls on point-to-point; without it a copy comes back."""
        cloud, truth = (room(6000, 1), MOTION) if shape is room else (outline(1500, 1), TURN_2D)
        source, target = cloud[cloud[:, 0] < 2.5], cloud[cloud[:, 0] > 0.5]

        def run(reject: bool) -> RegistrationResult:
            config = IcpConfig(method="point-to-point", reject_boundary=reject, coarse_to_fine=False, attempts=0,
                               max_correspondence_distance_m=0.4)  # fmt: skip
            return icp(back(source, truth), target, config=config, keep_history=True)

        strict, loose = run(True), run(False)
        assert strict.status is Status.CONVERGED
        assert pose_error(strict, truth)[0] < 0.02
        assert pose_error(loose, truth)[0] > 3 * pose_error(strict, truth)[0]

    @SURFACES
    def test_no_partner_lies_on_the_rim(self, method):
        target = slab(3000, 1) * [1, 1, 0] + [0, 0, 1]
        target[:, 2] += 0.2 * np.sin(2 * target[:, 0]) * np.sin(2 * target[:, 1])
        config = IcpConfig(method=method, reject_boundary=True, coarse_to_fine=False)
        result = icp(target + [0.02, 0.01, 0], target, config=config, keep_history=True)
        assert result.status is Status.CONVERGED
        used = target[result.history[-1].pairs.target, :2]
        assert used.min() > 0.005
        assert used.max() < 2.995
        assert result.overlap > 0.75

    def test_anderson_reaches_the_same_answer_in_fewer_steps(self):
        """Point-to-point crawls along walls; an exact copy has one fixed point."""
        target = slab(1500, 1)
        target[:, 2] = 0.15 * np.sin(2 * target[:, 0]) * np.cos(2 * target[:, 1])
        options = {"method": "point-to-point", "coarse_to_fine": False, "attempts": 0, "max_iterations": 300,
                   "max_correspondence_distance_m": 1.0}  # fmt: skip
        slide = se3.exp([0.2, -0.15, 0.02, 0, 0, 0.05])
        plain, fast = (icp(back(target, slide), target, config=IcpConfig(anderson=a, **options)) for a in (0, 5))
        assert plain.status is fast.status is Status.CONVERGED
        np.testing.assert_allclose(fast.T_target_source, slide, atol=1e-6)
        np.testing.assert_allclose(plain.T_target_source, slide, atol=1e-6)
        assert fast.num_iterations < 0.8 * plain.num_iterations


class TestPriors:
    FREE = se3.exp([0.15, -0.1, 0, 0, 0, 0.02])

    @FAMILY
    def test_a_prior_holds_what_a_plane_leaves_free(self, method):
        """Along x, y and yaw the prior alone speaks, whatever the first guess: the answer is its mean, the deviations
        are its own, about the plane's place."""
        source, target = slab(2000, 1, 0.003) - [1.5, 1.5, 0], slab(2000, 2, 0.003) - [1.5, 1.5, 0]
        prior = MotionPrior.from_deviations(self.FREE, translation_m=0.01, rotation_rad=0.01)
        result = icp(source, target, prior=prior, config=IcpConfig(method=method))
        assert result.status is Status.CONVERGED
        assert result.unobservable == ()
        xi = se3.log(result.T_target_source)
        np.testing.assert_allclose(xi[[0, 1, 5]], se3.log(self.FREE)[[0, 1, 5]], atol=1e-3)
        sigma = np.sqrt(np.diag(result.covariance))
        np.testing.assert_allclose(sigma[[0, 1, 5]], 0.01, rtol=0.02)
        assert (sigma[[2, 3, 4]] < 2e-3).all()

    @SURFACES
    def test_what_neither_knows_stays_free(self, method):
        """The prior knows x only; y and yaw stay at the first guess."""
        source, target = slab(2000, 1) - [1.5, 1.5, 0], slab(2000, 2) - [1.5, 1.5, 0]
        information = np.zeros((6, 6))
        information[0, 0] = 1e4
        prior = MotionPrior(se3.exp([0.1, 0.3, 0, 0, 0, 0]), information)
        result = icp(source, target, prior=prior, config=IcpConfig(method=method))
        assert result.status is Status.DEGENERATE
        assert "translation along (0.00, 1.00, 0.00)" in result.note
        assert len(result.unobservable) == 2
        np.testing.assert_allclose(result.T_target_source[:2, 3], [0.1, 0], atol=5e-3)
        assert result.covariance[0, 0] == pytest.approx(1e-4, rel=0.05)
        assert result.covariance[1, 1] < 1e-6

    @FAMILY
    def test_what_is_left_may_be_known_to_the_prior_alone(self, method):
        """A plane whose own directions are locked: x, y and yaw are the prior's, and so is what is known of them."""
        source, target = slab(1000, 1) - [1.5, 1.5, 0], slab(1000, 2) - [1.5, 1.5, 0]
        prior = MotionPrior.from_deviations(self.FREE, translation_m=[0.01, 0.02, 1], rotation_rad=[1, 1, 0.005])
        result = icp(source, target, prior=prior, config=IcpConfig(method=method, locks="planar"))
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source, self.FREE, atol=1e-9)
        expected = np.diag([0.01, 0.02, 0, 0, 0, 0.005]) ** 2
        np.testing.assert_allclose(result.covariance, expected, rtol=1e-6, atol=1e-12)

    @FAMILY
    def test_two_gaussians_are_fused(self, method):
        """Data and prior are two Gaussians: x = (D + P)^-1 (D x_data + P x_prior), D = H / sigma^2.

        The source is the target: the data says the identity exactly, and small motions change no pair.
        """
        target = room(2000, 1)
        sigma = 0.1
        config = IcpConfig(method=method, kernel="none", kernel_scale_m=sigma, coarse_to_fine=False, attempts=0,
                           tolerance=1e-9)  # fmt: skip
        data = icp(target, target, config=config).information / sigma**2
        P = np.diag([2e5, 1e5, 3e5, 4e5, 2e5, 1e5])
        wanted = 1e-3 * np.array([1, -1, 1, 0.5, 0.5, -0.5])
        result = icp(target, target, prior=MotionPrior(se3.exp(wanted), P), config=config)
        expected = np.linalg.solve(data + P, P @ wanted)
        assert 0.1 < np.linalg.norm(expected) / np.linalg.norm(wanted) < 0.9  # neither of the two alone
        np.testing.assert_allclose(se3.log(result.T_target_source), expected, atol=0.01 * np.linalg.norm(expected))

    @SURFACES
    def test_far_from_the_origin(self, method):
        """The error of a prior is about the target's origin: at UTM coordinates 1e-9 rad are 5 mm at the points."""
        far = np.array([4e5, 5.4e6, 300.0])
        source, target = slab(1500, 1) + far, slab(1500, 2) + far
        shift = se3.exp([0.05, -0.04, 0, 0, 0, 0])
        prior = MotionPrior.from_deviations(shift, translation_m=0.01, rotation_rad=1e-9)
        result = icp(source, target, prior=prior, config=IcpConfig(method=method))
        assert result.status is Status.CONVERGED
        moved = se3.transform_points(result.T_target_source, source)
        np.testing.assert_allclose((moved - source)[:, :2].mean(axis=0), [0.05, -0.04], atol=2e-3)

    @pytest.mark.parametrize(
        "information", [np.ones((3, 3)), np.diag([1, 1, 1, 1, 1, -1.0]), np.full((6, 6), np.nan), np.triu(np.ones(6))]
    )
    def test_priors_that_are_none(self, information):
        with pytest.raises(InvalidInputError, match="prior"):
            MotionPrior(np.eye(4), information)

    def test_in_the_plane_there_are_no_priors(self):
        prior = MotionPrior(np.eye(4), np.eye(6))
        with pytest.raises(InvalidInputError, match="prior"):
            icp(outline(100, 0), outline(100, 1), prior=prior)

    @pytest.mark.parametrize(
        ("locks", "held"),
        [("planar", [2, 3, 4]), ("gravity", [3, 4]), ("roll", [3]), ("pitch", [4]), ("yaw", [5]),
         ("yaw, gravity", [3, 4, 5])],
    )  # fmt: skip
    @FAMILY
    def test_locked_turns_stay_at_the_first_guess(self, method, locks, held):
        """A locked axis of a turn is one of the target's; shifts are those of the points' centroid."""
        target = room(2000, 1)
        first = se3.exp([0.02, 0, 0.01, 0.01, 0.02, -0.01])
        result = icp(back(target), target, T_init=first, config=IcpConfig(method=method, locks=locks, attempts=0))
        assert result.status.has_pose
        since = se3.log(result.T_target_source @ se3.inverse(first))
        np.testing.assert_allclose(since[[k for k in held if k > 2]], 0, atol=1e-3)
        free = [k for k in (3, 4, 5) if k not in held]
        assert (np.abs(since[free]) > 3e-3).all()
        assert np.abs(np.diag(result.covariance)[[k for k in held if k > 2]]).max() < 1e-12

    @pytest.mark.parametrize(("locks", "axis"), [("x", 0), ("y", 1), ("z", 2)])
    @FAMILY
    def test_locked_shifts_stay_at_the_first_guess(self, method, locks, axis):
        target = room(2000, 1) - [2, 1.5, 1.25]
        shift = np.array([0.03, -0.04, 0.05])
        result = icp(target - shift, target, config=IcpConfig(method=method, locks=locks, attempts=0))
        moved = se3.transform_points(result.T_target_source, target - shift) - target
        others = [k for k in range(3) if k != axis]
        assert abs((moved + shift)[:, axis].mean()) < 5e-3
        np.testing.assert_allclose(moved[:, others].mean(axis=0), 0, atol=0.02)

    def test_planar_motion_in_a_hall_without_a_ceiling(self):
        """Walls alone leave z free; locked, it is known, and nothing is degenerate."""
        walls = room(4000, 1)
        walls = walls[(walls[:, 2] > 0.01) & (walls[:, 2] < 2.49) & (np.abs(walls[:, :2] - [2, 1.5]).max(axis=1) > 1.4)]
        drive = se3.exp([0.05, 0.03, 0, 0, 0, 0.03])
        other = room(4000, 2)
        other = other[(other[:, 2] > 0.01) & (other[:, 2] < 2.49) & (np.abs(other[:, :2] - [2, 1.5]).max(axis=1) > 1.4)]
        free = icp(back(walls, drive), other)
        assert free.status is Status.DEGENERATE
        assert [d.words for d in free.unobservable] == ["translation along (0.00, 0.00, 1.00)"]
        locked = icp(back(walls, drive), other, config=IcpConfig(locks="planar"))
        assert locked.status is Status.CONVERGED
        assert pose_error(locked, drive)[0] < 5e-3
        assert locked.T_target_source[2, 3] == pytest.approx(0, abs=1e-9)

    @FAMILY
    def test_locks_in_the_plane(self, method):
        target = outline(600, 1)
        result = icp(back(target, TURN_2D), target, config=IcpConfig(method=method, locks="yaw", attempts=0))
        np.testing.assert_allclose(result.T_target_source[:2, :2], np.eye(2), atol=1e-12)
        assert np.abs(result.T_target_source[:2, 2]).max() > 0.01

    def test_unknown_locks(self):
        with pytest.raises(ConfigError, match="gravity"):
            IcpConfig(locks="gravitas")

    def test_a_closed_form_scale_knows_no_locks(self):
        config = IcpConfig(method="point-to-point", scale="symmetric", locks="z")
        with pytest.raises(InvalidInputError, match="least_squares"):
            icp(room(100, 0), room(100, 0), config=config)


class TestPlane:
    """Laser scans of two dimensions."""

    @FAMILY
    def test_two_scans_of_an_outline(self, method):
        source, target = outline(1000, 1, 0.005), outline(1000, 2, 0.005)
        result = icp(back(source, TURN_2D), target, config=IcpConfig(method=method))
        assert result.status is Status.CONVERGED
        assert result.information.shape == result.covariance.shape == (3, 3)
        assert np.less(pose_error(result, TURN_2D), (0.006, 0.2)).all()

    @FAMILY
    def test_a_corridor_leaves_its_own_direction_free(self, method):
        rng = np.random.default_rng(0)
        walls = [np.column_stack([rng.uniform(0, 5, 800), np.repeat([0.0, 1.0], 400)]) for _ in range(2)]
        result = icp(walls[0] + [0.1, 0.02], walls[1], config=IcpConfig(method=method))
        assert result.status is Status.DEGENERATE
        assert [d.words for d in result.unobservable] == ["translation along (1.00, 0.00)"]
        np.testing.assert_allclose(result.T_target_source[:2, 2], [0, -0.02], atol=2e-3)
        assert result.covariance[0, 0] == pytest.approx(0, abs=1e-6)

    @FAMILY
    def test_a_circle_leaves_the_turn_free(self, method):
        rng = np.random.default_rng(0)
        angles = rng.uniform(0, 2 * np.pi, (2, 800))
        circles = [np.column_stack([np.cos(a), np.sin(a)]) for a in angles]
        result = icp(circles[0] + [0.03, -0.02], circles[1], config=IcpConfig(method=method))
        assert result.status is Status.DEGENERATE
        assert kinds(result) == ["rotation"]
        np.testing.assert_allclose(result.T_target_source[:2, 2], [-0.03, 0.02], atol=5e-3)

    @FAMILY
    def test_far_from_the_origin(self, method):
        target = outline(800, 0)
        far = np.array([4e5, 5.4e6])
        result = icp(back(target, TURN_2D) + far, target + far, config=IcpConfig(method=method))
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(se3.transform_points(result.T_target_source, back(target, TURN_2D) + far),
                                   target + far, atol=1e-7)  # fmt: skip

    @FAMILY
    def test_unrelated_points(self, method):
        rng = np.random.default_rng(3)
        result = icp(rng.uniform(size=(400, 2)), rng.uniform(size=(400, 2)), config=IcpConfig(method=method))
        assert not result.status.success
        assert_sound(result)


HARD = {
    "unrelated": (lambda: np.random.default_rng(1).uniform(size=(500, 3)),
                  lambda: np.random.default_rng(2).uniform(size=(500, 3))),
    "empty source": (lambda: np.zeros((0, 3)), lambda: room(200, 0)),
    "empty target": (lambda: room(200, 0), lambda: np.zeros((0, 3))),
    "single": (lambda: np.ones((1, 3)), lambda: np.ones((1, 3))),
    "two": (lambda: np.eye(3)[:2], lambda: np.eye(3)[:2]),
    "coincident": (lambda: np.ones((50, 3)), lambda: np.full((50, 3), 2.0)),
    "coincident and the same": (lambda: np.ones((50, 3)), lambda: np.ones((50, 3))),
    "duplicates": (lambda: np.repeat(np.eye(3)[:2], 40, axis=0), lambda: np.repeat(np.eye(3)[:2], 40, axis=0) + 0.01),
    "collinear": (lambda: np.arange(80)[:, None] * [1.0, 2, 3], lambda: np.arange(80)[:, None] * [1.0, 2, 3] + 0.1),
    "not finite": (lambda: np.full((50, 3), np.nan), lambda: room(200, 0)),
    "mirrored": (lambda: np.random.default_rng(0).normal(size=(300, 3)),
                 lambda: np.random.default_rng(0).normal(size=(300, 3)) * [1, 1, -1]),
    "apart": (lambda: room(300, 0), lambda: room(300, 0) + 1e6),
    "metres and millimetres": (lambda: back(room(1000, 0)), lambda: 1000 * room(1000, 0)),
    "millimetres and metres": (lambda: 1000 * back(room(1000, 0)), lambda: room(1000, 0)),
}  # fmt: skip


def coloured_if(method: str, points: np.ndarray) -> PointCloud:
    grey = np.full((len(points), 3), 100, np.uint8)
    return PointCloud(points, colors=grey) if method == "coloured" else PointCloud(points)


class TestHardCases:
    """Golden case 10, for every method: a status, within a second, never NaN or a confident wrong pose."""

    @pytest.mark.parametrize("name", HARD)
    @ALL
    def test_no_answer_is_said(self, method, name):
        source, target = (make() for make in HARD[name])
        pair = coloured_if(method, source), coloured_if(method, target)
        icp(*pair, config=IcpConfig(method=method))  # compiled
        start = time.perf_counter()
        result = icp(*pair, config=IcpConfig(method=method))
        assert time.perf_counter() - start < 1
        assert not result.status.success
        assert_sound(result)

    @pytest.mark.parametrize("noise", [0.0, 0.005])
    @ALL
    def test_a_plane_slid_by_15_cm(self, method, noise):
        source = coloured_if(method, slab(2000, 1, noise) + [0.15, 0, 0.01])
        result = icp(source, coloured_if(method, slab(2000, 2, noise)), config=IcpConfig(method=method))
        assert result.status is Status.DEGENERATE
        assert kinds(result) == ["rotation about", "translation along", "translation along"]
        assert np.abs(result.T_target_source[:2, 3]).max() < 4e-3
        assert result.T_target_source[2, 3] == pytest.approx(-0.01, abs=2e-3)
        assert all(direction.words in result.note for direction in result.unobservable)
        assert np.abs(np.diag(result.covariance)[[5]]).max() < 1e-9  # no finite variance: zero

    @ALL
    @pytest.mark.parametrize(("unit", "far"), [(1e-6, 0.0), (1e3, 0.0), (1.0, 1e6)])
    def test_units_and_offsets(self, method, unit, far):
        target = cloud_of(method, room(1500, 0))
        source = moved_back(target)
        source, target = (PointCloud(unit * c.points_m + far, colors=c.colors) for c in (source, target))
        result = icp(source, target, config=IcpConfig(method=method))
        assert result.status is Status.CONVERGED
        moved = se3.transform_points(result.T_target_source, source.points_m)
        np.testing.assert_allclose(moved, target.points_m, atol=unit * 1e-7 + 1e-9 * (far > 0) * 100)

    @FAMILY
    def test_rows_that_are_not_finite(self, method):
        target = room(1500, 0)
        source = back(target)
        source[::50, 1] = np.inf
        target = np.vstack([target, [[np.nan, 0, 0]]])
        result = icp(source, target, weights=np.ones(1500), config=IcpConfig(method=method))
        assert result.status is Status.CONVERGED
        assert result.note == "31 points were not finite and were dropped"

    @FAMILY
    def test_integers(self, method):
        target = np.round(100 * room(1500, 0)).astype(np.int32)
        result = icp(target - np.array([3, -4, 5], np.int32), target, config=IcpConfig(method=method))
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source[:3, 3], [3, -4, 5], atol=1e-6)

    @FAMILY
    def test_every_point_many_times(self, method):
        target = np.repeat(room(400, 0), 5, axis=0)
        result = icp(back(target), target, config=IcpConfig(method=method))
        assert_sound(result)
        assert not result.status.success or pose_error(result, MOTION)[0] < 1e-6

    @SURFACES
    @pytest.mark.parametrize(
        ("shape", "free"),
        [
            ("sphere", ["rotation about"] * 3),
            ("cylinder", ["rotation about", "translation along"]),
            ("torus", ["rotation about"]),
            ("cone", ["rotation about"]),
            ("edge", ["translation along"]),
            ("parallel walls", ["rotation about", "translation along", "translation along"]),
        ],
    )
    def test_what_a_shape_leaves_free(self, method, shape, free):
        source, target = SHAPES[shape](1), SHAPES[shape](2)
        small = se3.exp([0.03, -0.02, 0.02, 0.02, -0.01, 0.03])
        result = icp(back(source, small), target, config=IcpConfig(method=method))
        assert result.status is Status.DEGENERATE
        assert kinds(result) == free

    def test_a_partly_overlapping_scan_does_not_flee_to_a_symmetric_place(self):
        """A box fits itself after half a turn, with more of the source in the target than at the true place; the
        first answer is near the guess and stays."""
        for seed in range(4):
            source, target = room(1000, 2 * seed + 1, 0.005), room(1000, 2 * seed + 2, 0.005)
            source, target = source[source[:, 0] < 2.5], target[target[:, 0] > 1.0]
            for method in SURFACE:
                result = icp(back(source), target, config=IcpConfig(method=method))
                assert not result.status.success or pose_error(result, MOTION)[0] < 0.1

    @pytest.mark.parametrize("count", [1000, 6000])
    def test_the_rim_s_pull_on_point_to_point_is_noticed(self, count):
        """Two fifths of the source have no counterpart; pairs of points settle half a metre off or more."""
        source, target = room(count, 1, 0.005), room(count, 2, 0.005)
        source, target = source[source[:, 0] < 2.5], target[target[:, 0] > 1.0]
        result = icp(back(source), target, config=IcpConfig(method="point-to-point"))
        assert pose_error(result, MOTION)[0] > 0.3
        assert not result.status.success
        assert "the surfaces do not meet" in result.note
        whole = icp(back(room(count, 1, 0.005)), room(count, 2, 0.005), config=IcpConfig(method="point-to-point"))
        assert whole.status is Status.CONVERGED

    @pytest.mark.parametrize(
        ("source", "target", "options", "words"),
        [
            (np.zeros((5, 4)), np.zeros((5, 3)), {}, "source"),
            (np.zeros((5, 3)), np.zeros((5, 2)), {}, "source"),
            (np.zeros(6), np.zeros((5, 3)), {}, "source"),
            (np.zeros((5, 3)), "a room", {}, "target"),
            (np.zeros((5, 3)), np.zeros((5, 3)), {"target_normals": np.zeros((4, 3))}, "target_normals"),
            (np.zeros((5, 3)), np.zeros((5, 3)), {"source_normals": np.zeros((5, 2))}, "source_normals"),
            (np.zeros((5, 3)), np.zeros((5, 3)), {"T_init": np.diag([1.0, 1, -1, 1])}, "T_init"),
            (np.zeros((5, 3)), np.zeros((5, 3)), {"T_init": np.full((4, 4), np.nan)}, "T_init"),
        ],
    )
    @FAMILY
    def test_wrong_input_raises(self, method, source, target, options, words):
        with pytest.raises(InvalidInputError, match=words):
            icp(source, target, config=IcpConfig(method=method), **options)

    def test_other_libraries_clouds(self):
        """Open3D names its arrays points, colors and normals, trimesh its points vertices."""
        target = room(800, 0)
        open3d = SimpleNamespace(points=back(target), colors=np.zeros((0, 3)), normals=np.zeros((0, 3)))
        trimesh = SimpleNamespace(vertices=target)
        for source, other in ((open3d, trimesh), (back(target).tolist(), PointCloud(target))):
            result = icp(source, other)
            assert result.status is Status.CONVERGED
            np.testing.assert_allclose(result.T_target_source, MOTION, atol=1e-9)


def on_ball(seed: int) -> np.ndarray:
    ball = np.random.default_rng(seed).normal(size=(1500, 3))
    return ball / np.linalg.norm(ball, axis=1, keepdims=True)


def on_cylinder(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    t = rng.uniform(0, 2 * np.pi, 1500)
    return np.column_stack([np.cos(t), np.sin(t), rng.uniform(-2, 2, 1500)])


def on_torus(seed: int) -> np.ndarray:
    t, u = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, 1500))
    R = 2 + 0.5 * np.cos(u)
    return np.column_stack([R * np.cos(t), R * np.sin(t), 0.5 * np.sin(u)])


def on_cone(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    h, t = rng.uniform(0.1, 1, 1500), rng.uniform(0, 2 * np.pi, 1500)
    return np.column_stack([h * np.cos(t), h * np.sin(t), h])


def on_edge(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 2, (1500, 3))
    points[np.arange(1500), rng.integers(0, 2, 1500)] = 0
    return points


def on_parallel_walls(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, 3, 1500), rng.choice([0.0, 1.0], 1500), rng.uniform(0, 2, 1500)])


SHAPES = {
    "sphere": on_ball,
    "cylinder": on_cylinder,
    "torus": on_torus,
    "cone": on_cone,
    "edge": on_edge,
    "parallel walls": on_parallel_walls,
}


def nees(result: RegistrationResult, truth: np.ndarray) -> float:
    """e^T C^-1 e of the error e = log(T T_true^-1), the left perturbation at the target's origin."""
    error = twist_of(result.T_target_source @ se3.inverse(truth))
    return float(error @ np.linalg.solve(result.covariance, error))


def mean_nees(method: str, shape, count: int, draws: int, truth: np.ndarray, cut=None, noise=0.005) -> float:
    """Mean over independent samples of a surface, with noise on both sides; cut: the overlap along x."""
    total = 0.0
    for seed in range(draws):
        source, target = shape(count, 2 * seed + 1, noise), shape(count, 2 * seed + 2, noise)
        if cut is not None:
            source, target = source[source[:, 0] < cut[0]], target[target[:, 0] > cut[1]]
        result = icp(back(source, truth), target, config=IcpConfig(method=method, attempts=0))
        assert result.status is Status.CONVERGED
        total += nees(result, truth)
    return total / draws


class TestUncertainty:
    """The normalised error of K unknowns over n draws is chi-square of n K degrees over n: mean K, deviation
    sqrt(2 K / n). The bounds are those of 3.3 deviations (one in a thousand) and 10 percent for what the covariance
    leaves out, e.g. the noise that normals share."""

    @staticmethod
    def bounds(unknowns: int, draws: int) -> tuple[float, float]:
        spread = 3.3 * np.sqrt(2 * unknowns / draws)
        return 0.9 * unknowns - spread, 1.1 * unknowns + spread

    @pytest.mark.parametrize("cut", [None, (2.5, 1.0)], ids=["whole", "part"])
    @SURFACES
    def test_samples_of_a_room(self, method, cut):
        low, high = self.bounds(6, 80)
        assert low < mean_nees(method, room, 2000, 80, MOTION, cut) < high

    @pytest.mark.parametrize("cut", [None, (2.0, 0.7)], ids=["whole", "part"])
    def test_samples_of_an_outline(self, cut):
        low, high = self.bounds(3, 150)
        assert low < mean_nees("point-to-plane", outline, 400, 150, TURN_2D, cut) < high

    @pytest.mark.parametrize("method", ["point-to-point", "point-to-plane"])
    def test_noise_as_large_as_the_spacing(self, method):
        """Nearest neighbours pick the noise that suits them: H is too stiff by half, and the plain sandwich would claim
        a fifth of the variance."""
        low, high = self.bounds(3, 60)
        assert low < mean_nees(method, outline, 1500, 60, TURN_2D) < high

    def test_point_to_point_claims_no_less_than_it_knows(self):
        """Its distances show the sampling, not the noise: claims may be wide, never narrow. A few answers are so far
        from what the surfaces want that they are no answers."""
        found = []
        for seed in range(25):
            source, target = room(2000, 2 * seed + 1, 0.005), room(2000, 2 * seed + 2, 0.005)
            result = icp(back(source), target, config=IcpConfig(method="point-to-point", attempts=0))
            if result.status.success:
                found.append(nees(result, MOTION))
        assert len(found) > 20
        assert np.mean(found) < self.bounds(6, len(found))[1]

    @pytest.mark.parametrize("seed", range(3))
    def test_points_that_are_told_apart_are_as_well_known_as_least_squares_says(self, seed):
        """Points 0.6 m apart or more, with 1 cm of noise, keep their partners: C = sigma^2 (sum J^T J)^-1. What is
        claimed shows the scatter of 512 scores of 6 numbers, whose eigenvalues are within (1 +- sqrt(6 / 512))^2 of the
        true ones, 0.80 to 1.23 (V. A. Marchenko, L. A. Pastur, 1967)."""
        rng = np.random.default_rng(seed)
        target = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
        target += rng.uniform(-0.2, 0.2, target.shape)
        source = target + 0.01 * rng.normal(size=target.shape)
        config = IcpConfig(method="point-to-point", coarse_to_fine=False, attempts=0)
        result = icp(source, target, config=config)
        assert result.status is Status.CONVERGED
        J = residuals.point_jacobian(target).reshape(-1, 6)
        shares = np.linalg.eigvals(result.covariance @ (J.T @ J) / 0.01**2).real
        assert 0.7 < shares.min() < shares.max() < 1.4

    @pytest.mark.parametrize("method", SURFACE)
    def test_more_noise_is_more_doubt(self, method):
        def size(noise: float) -> float:
            result = icp(room(2000, 1, noise), room(2000, 2, noise), config=IcpConfig(method=method, attempts=0))
            return float(np.sqrt(np.trace(result.covariance[:3, :3])))

        assert 1.5 < size(0.02) / size(0.01) < 3

    @FAMILY
    def test_a_copy_is_known_exactly(self, method):
        target = room(1500, 0)
        covariance = icp(back(target), target, config=IcpConfig(method=method)).covariance
        assert np.abs(covariance).max() < 1e-15

    @FAMILY
    def test_the_origin_it_is_about(self, method):
        """Moving both clouds by c: a twist (rho, phi) about the new origin is (rho + phi x c, phi) about the old."""
        source, target = room(1500, 1, 0.01), room(1500, 2, 0.01)
        c = np.array([8.0, -16.0, 4.0])
        config = IcpConfig(method=method, attempts=0)
        near, far = icp(source, target, config=config), icp(source + c, target + c, config=config)
        adjoint = np.eye(6)
        adjoint[:3, 3:] = np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])
        expected = adjoint @ near.covariance @ adjoint.T
        np.testing.assert_allclose(far.covariance, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())

    @pytest.mark.parametrize("method", GEOMETRIC)
    def test_the_information_is_the_hessian(self, method):
        """Second differences of the sum of squares over 2, pairs and weights (here 1) held, at the target's origin."""
        target = room(1200, 2, 0.005)
        source = back(room(1200, 1, 0.005))
        normals, own = estimate_normals(target), estimate_normals(source)
        thickness = max(1e-3, float(np.median(fit_surfaces(target).angular_variance)))  # discs as thick as their noise
        config = IcpConfig(method=method, kernel="none", coarse_to_fine=False, attempts=0, tolerance=1e-9,
                           max_iterations=300)  # fmt: skip
        result = icp(source, target, target_normals=normals, source_normals=own, config=config, keep_history=True)
        pairs = result.history[-1].pairs
        p = se3.transform_points(result.T_target_source, source[pairs.source])
        q, n = target[pairs.target], normals[pairs.target]
        m = own[pairs.source] @ result.T_target_source[:3, :3].T

        def half_squares(xi: np.ndarray) -> float:
            if method == "symmetric":  # both sides turned by half
                half = se3.exp_so3(xi[3:] / 2)
                sign = np.where((n * m).sum(axis=1) >= 0, 1.0, -1.0)[:, None]
                return 0.5 * ((((n + sign * m) / 2) * (p @ half.T + xi[:3] - q @ half)).sum(axis=1) ** 2).sum()
            d = se3.transform_points(se3.exp(xi), p) - q
            if method == "point-to-point":
                return 0.5 * (d**2).sum()
            if method == "point-to-plane":
                return 0.5 * ((n * d).sum(axis=1) ** 2).sum()
            M = residuals.generalised_information(n, m, thickness)
            return 0.5 * np.einsum("na,nab,nb->", d, M, d)

        h = 1e-4
        steps = h * np.eye(6)
        hessian = np.array(
            [[half_squares(a + b) - half_squares(a - b) - half_squares(b - a) + half_squares(-a - b) for a in steps]
             for b in steps]
        ) / (4 * h * h)  # fmt: skip
        # Gauss-Newton leaves out r times the second derivative, which residuals of 5 mm and of the sampling make.
        tolerance = 0.05 if method == "point-to-point" else 0.02
        np.testing.assert_allclose(result.information, hessian, atol=tolerance * np.abs(hessian).max())


def test_clouds_of_uneven_density_are_first_aligned_by_even_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points of the floor lie in rings about the scanner wherever it stands, and pair up as if it had not moved."""
    before, after = se3.exp([0, 0, 1.8, 0, 0, 0]), se3.exp([1.0, 0.5, 1.8, 0, 0, 0.1])
    target, source = yard(before), yard(after)
    config = IcpConfig(method="point-to-point", max_correspondence_distance_m=2.0)
    monkeypatch.setattr("scanweld.geometry.neighbours.kd_tree._UNEVEN", 0.0)  # every cloud is uneven
    errors = {}
    for coarse in (True, False):
        result = icp(source, target, config=replace(config, coarse_to_fine=coarse))
        errors[coarse] = np.linalg.norm((se3.inverse(se3.inverse(before) @ after) @ result.T_target_source)[:3, 3])
    assert errors[True] < 0.02
    assert errors[True] < errors[False] / 3


def test_a_prior_is_a_transform_and_what_is_known_of_it() -> None:
    for T, information, words in (
        (np.eye(3), np.eye(6), r"expected a transform \(4, 4\), got \(3, 3\)"),
        (np.eye(4), np.eye(3), r"expected a finite information matrix \(6, 6\), got \(3, 3\)"),
        (np.eye(4), np.full((6, 6), np.inf), "finite"),
        (np.eye(4), -np.eye(6), "positive semidefinite"),
        (np.eye(4), np.triu(np.ones((6, 6))), "symmetric"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            MotionPrior(T, information)
    for sigma in (0.0, -1.0, np.nan):
        with pytest.raises(InvalidInputError, match="standard deviations must be positive"):
            MotionPrior.from_deviations(np.eye(4), translation_m=sigma, rotation_rad=1.0)
    prior = MotionPrior.from_deviations(np.eye(4), translation_m=[0.5, np.inf, 1], rotation_rad=0.1)
    np.testing.assert_allclose(np.diag(prior.information), [4, 0, 1, 100, 100, 100])


def test_points_whose_normal_is_not_known_are_no_partners_of_planes() -> None:
    """Every fifth point of the target has none, as where a scan is too thin: the others hold the motion as well."""
    points = room(3000, 0)
    normals = estimate_normals(points)
    normals[::5] = 0
    source = se3.transform_points(se3.inverse(MOTION), points)
    result = icp(source, points, target_normals=normals, config=IcpConfig(method="point-to-plane"))
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.T_target_source, MOTION, atol=1e-4)
    assert result.overlap == pytest.approx(0.8, abs=0.02)
