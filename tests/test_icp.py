"""ICP: the worked example, exact recovery, equivariance, and an honest status wherever there is no answer."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rendered import rendered
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud, voxel_downsample
from scanweld.io.point_files import read_points, read_transform
from scanweld.registration.correspondences import KdTree, find_correspondences
from scanweld.registration.icp import IcpConfig, icp
from scanweld.registration.local.config import METHODS
from scanweld.registration.result import Status

POINT, PLANE, SYMMETRIC, GICP = (IcpConfig(method=method) for method in METHODS if method != "coloured")
FAMILY = pytest.mark.parametrize("config", [POINT, PLANE, SYMMETRIC, GICP], ids=lambda config: config.method)
MOTION = se3.exp([0.05, -0.03, 0.04, 0.03, -0.02, 0.04])
MOTION_2D = np.array([[np.cos(0.05), -np.sin(0.05), 0.02], [np.sin(0.05), np.cos(0.05), 0.03], [0, 0, 1]])


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


def outline(count: int, seed: int) -> np.ndarray:
    """Points on the walls of an L-shaped room of the plane."""
    corners = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (0, 2), (0, 0)], dtype=float)
    rng = np.random.default_rng(seed)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    wall = rng.choice(6, count, p=lengths / lengths.sum())
    s = rng.uniform(0, 1, count)[:, None]
    return corners[wall] + s * (corners[wall + 1] - corners[wall])


def slab(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, 3, (count, 2)), np.zeros(count)])


def pose_error(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    difference = T @ se3.inverse(truth)
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(se3.rotation_angle_rad(difference)))


def assert_finite(result) -> None:
    assert np.isfinite(result.T_target_source).all()
    assert np.isfinite(result.information).all()
    assert np.isfinite([result.rmse_m, result.overlap, result.scale]).all()
    assert result.status is Status.CONVERGED or result.note


class TestWorkedExample:
    """Correspondences unknown. The distance from (0, 0) to b_1 = (2.10, 2.71) is sqrt(4.41 + 7.3441) = 3.428, and
    b_1 is nearest to all five, so W = 0: no rotation, t = b_1 - mean(a) = (1.30, 2.21)."""

    A = np.array([(0, 0), (1, 0), (0, 1), (1, 1), (2, 0.5)])
    B = np.array([(2.10, 2.71), (3.01, 3.72), (1.24, 3.79), (1.79, 4.56), (3.04, 4.63)])

    @pytest.fixture
    def result(self):
        return icp(self.A, self.B, config=POINT, keep_history=True)

    def test_first_step(self, result):
        step = result.history[0]
        np.testing.assert_array_equal(step.pairs.target, 0)
        np.testing.assert_allclose(step.pairs.distances_m, [3.428, 2.925, 2.708, 2.033, 2.212], atol=5e-4)
        np.testing.assert_allclose(step.fit.W, 0, atol=1e-15)
        np.testing.assert_allclose(step.T_after, [[1, 0, 1.30], [0, 1, 2.21], [0, 0, 1]], atol=1e-14)

    @pytest.mark.parametrize(
        ("number", "targets", "sigma", "degrees", "translation", "error"),
        [
            (2, [0, 0, 2, 0, 1], [1.8448, 0.6021], 18.54, [0.2105, 0.1896], 1.7861),
            (3, [0, 0, 2, 1, 1], [2.0674, 0.9851], -8.64, [0.1708, 0.2594], 1.1911),
            (4, [0, 0, 2, 1, 1], [2.0674, 0.9851], 0, [0, 0], 1.1911),
        ],
    )
    def test_further_steps(self, result, number, targets, sigma, degrees, translation, error):
        step = result.history[number - 1]
        T = se3.inverse(step.T_before) @ step.T_after
        np.testing.assert_array_equal(step.pairs.target, targets)
        np.testing.assert_allclose(step.fit.singular_values, sigma, atol=5e-5)
        assert np.degrees(np.arctan2(T[1, 0], T[0, 0])) == pytest.approx(degrees, abs=5e-3)
        np.testing.assert_allclose(T[:2, 2], translation, atol=5e-5)
        np.testing.assert_allclose(step.fit.transform, T, atol=1e-12)
        assert step.fit.error == pytest.approx(error, abs=5e-5)

    def test_it_ends_in_a_wrong_minimum_and_is_not_trusted(self, result):
        assert result.num_iterations == 4
        T = result.T_target_source
        assert np.degrees(np.arctan2(T[1, 0], T[0, 0])) == pytest.approx(9.90, abs=5e-3)
        assert result.rmse_m == pytest.approx(np.sqrt(1.1911 / 5), abs=1e-4)
        assert not result.status.success
        assert "5 source points share 3 targets" in result.note


class TestRecovery:
    @FAMILY
    def test_a_moved_copy_comes_back_exactly(self, config):
        target = room(3000, 0)
        result = icp(se3.transform_points(se3.inverse(MOTION), target), target, config=config)
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source, MOTION, atol=1e-12)
        assert result.overlap == 1
        assert result.unobservable == ()
        assert result.note == ""

    @FAMILY
    def test_a_moved_copy_in_the_plane(self, config):
        target = outline(400, 0)
        result = icp(se3.transform_points(se3.inverse(MOTION_2D), target), target, config=config)
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source, MOTION_2D, atol=1e-12)
        assert result.information.shape == (3, 3)

    def test_another_sample_of_the_same_noisy_surface(self):
        """Two samples of 5000 points with 5 mm noise, some 6 cm apart: the surface averages both away."""
        source = se3.transform_points(se3.inverse(MOTION), room(5000, 1, noise=0.005))
        result = icp(source, room(5000, 2, noise=0.005))
        assert result.status is Status.CONVERGED
        distance, degrees = pose_error(result.T_target_source, MOTION)
        assert distance < 2e-3
        assert degrees < 0.05

    def test_half_of_the_points_in_common(self):
        source, target = room(8000, 1), room(8000, 2)
        source = se3.transform_points(se3.inverse(MOTION), source[source[:, 0] < 2.5])
        result = icp(source, target[target[:, 0] > 1.0])
        assert result.status is Status.CONVERGED
        assert pose_error(result.T_target_source, MOTION)[0] < 0.01
        assert 0.4 < result.overlap < 0.9

    @pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman_mcclure", "tukey"])
    @FAMILY
    def test_kernels_resist_outliers_that_the_plain_sum_does_not(self, config, kernel):
        """A tenth of the points is lifted by 20 cm."""
        target = room(3000, 0)
        source = se3.transform_points(se3.inverse(MOTION), target)
        source[::10] += [0, 0, 0.2]

        def error(kernel):
            robust = IcpConfig(method=config.method, kernel=kernel)
            return pose_error(icp(source, target, config=robust).T_target_source, MOTION)[0]

        assert error(kernel) < 0.25 * error("none")

    @FAMILY
    def test_far_from_the_origin_nothing_is_lost(self, config):
        """UTM-like coordinates: the same motion about the clouds' own place."""
        target = room(3000, 0)
        source = se3.transform_points(se3.inverse(MOTION), target)
        far = np.array([4e5, 5.4e6, 300.0])
        near = icp(source, target, config=config)
        result = icp(source + far, target + far, config=config)
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source[:3, :3], MOTION[:3, :3], atol=1e-9)
        moved = se3.transform_points(result.T_target_source, source + far)
        np.testing.assert_allclose(moved, target + far, atol=1e-8)
        assert result.num_iterations == near.num_iterations

    @FAMILY
    @pytest.mark.parametrize("unit", [1e-6, 1e4])
    def test_the_unit_does_not_matter(self, config, unit):
        target = room(2000, 0)
        source = se3.transform_points(se3.inverse(MOTION), target)
        result = icp(unit * source, unit * target, config=config)
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source[:3, :3], MOTION[:3, :3], atol=1e-10)
        np.testing.assert_allclose(result.T_target_source[:3, 3], unit * MOTION[:3, 3], atol=1e-10 * unit)

    def test_similarity(self):
        """Ten percent larger: point-to-point with a symmetric scale finds it; T holds the rigid part only."""
        target = room(2000, 0)
        source = se3.transform_points(se3.inverse(se3.exp([0.02, 0.01, 0, 0.01, 0, 0.02])), target) / 1.05
        result = icp(source, target, config=IcpConfig(method="point-to-point", scale="symmetric"))
        assert result.status is Status.CONVERGED
        assert result.scale == pytest.approx(1.05, abs=1e-9)
        moved = result.scale * source @ result.T_target_source[:3, :3].T + result.T_target_source[:3, 3]
        np.testing.assert_allclose(moved, target, atol=1e-9)

    def test_the_first_guess_is_used(self):
        target = room(3000, 0)
        truth = se3.exp([2.0, -1.0, 0.5, 0.4, -0.8, 1.5])
        source = se3.transform_points(se3.inverse(truth), target)
        near = se3.exp([0.02, 0.01, -0.02, 0.01, 0.02, -0.02]) @ truth
        assert not icp(source, target, config=IcpConfig(attempts=0)).status.success
        result = icp(source, target, T_init=near, config=IcpConfig(attempts=0))
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source, truth, atol=1e-10)

    @settings(max_examples=15)
    @given(st.integers(0, 10**6))
    def test_turning_both_clouds_turns_the_answer(self, seed):
        """T(G source, F target) = F T G^-1, whatever the frames; exact copies, so that rounding breaks no tie."""
        rng = np.random.default_rng(seed)
        target = room(600, seed)
        source = se3.transform_points(se3.inverse(se3.exp(0.02 * rng.normal(size=6))), target)
        F = se3.exp(rng.normal(size=6))
        for config in (POINT, PLANE):
            plain = icp(source, target, config=config)
            turned = icp(se3.transform_points(F, source), se3.transform_points(F, target), config=config)
            expected = F @ plain.T_target_source @ se3.inverse(F)
            assert turned.status is plain.status is Status.CONVERGED
            np.testing.assert_allclose(turned.T_target_source, expected, atol=1e-9)


class TestHonesty:
    @pytest.mark.parametrize("noise", [0.0, 0.005, 0.02])
    @FAMILY
    def test_a_plane_slid_in_itself(self, config, noise):
        """Golden case 10: 15 cm within its own plane. Three directions are free and stay at the first guess."""
        rng = np.random.default_rng(0)
        source, target = slab(2000, 1) + [0.15, 0, 0.01], slab(2000, 2)
        source, target = (p + noise * rng.normal(size=p.shape) for p in (source, target))
        result = icp(source, target, config=config)
        assert result.status is Status.DEGENERATE
        words = sorted(direction.words.split(" (")[0] for direction in result.unobservable)
        assert words == ["rotation about", "translation along", "translation along"]
        assert np.abs(result.T_target_source[:2, 3]).max() < 2e-3 + 0.2 * noise
        assert result.T_target_source[2, 3] == pytest.approx(-0.01, abs=2e-3 + noise / 10)
        for direction in result.unobservable:
            assert direction.words in result.note

    def test_points_that_are_the_same_points_hold_a_plane(self):
        """A slid copy, point by point: point-to-point may say so, because the points coincide in the end."""
        target = slab(2000, 1)
        result = icp(target + [0.15, 0, 0], target, config=POINT)
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source[:3, 3], [-0.15, 0, 0], atol=1e-12)

    def test_a_corridor_of_the_plane(self):
        rng = np.random.default_rng(0)
        walls = [np.column_stack([rng.uniform(0, 5, 600), np.repeat([0.0, 1.0], 300)]) for _ in range(2)]
        result = icp(walls[0] + [0.1, 0.02], walls[1])
        assert result.status is Status.DEGENERATE
        assert [d.words for d in result.unobservable] == ["translation along (1.00, 0.00)"]
        np.testing.assert_allclose(result.T_target_source[:2, 2], [0, -0.02], atol=1e-9)

    @FAMILY
    @pytest.mark.parametrize("count", [20, 50, 200, 2000])
    def test_unrelated_points_of_one_place(self, config, count):
        """Nearest neighbours always exist: small steps and a small rmse are no evidence."""
        rng = np.random.default_rng(count)
        result = icp(rng.uniform(size=(count, 3)), rng.uniform(size=(count, 3)), config=config)
        assert not result.status.success
        assert_finite(result)

    @FAMILY
    def test_unrelated_rooms(self, config):
        rng = np.random.default_rng(0)
        other = rng.normal(size=(5000, 3))
        other = 1.2 * other / np.linalg.norm(other, axis=1, keepdims=True)
        result = icp(room(5000, 0) - [2, 1.5, 1.2], other, config=config)
        assert not result.status.success

    @FAMILY
    def test_clouds_apart(self, config):
        result = icp(room(500, 0), room(500, 0) + 100, config=config)
        assert result.status is Status.NO_OVERLAP
        assert result.overlap == 0
        np.testing.assert_allclose(result.T_target_source, np.eye(4), atol=1e-12)

    @FAMILY
    @pytest.mark.parametrize(
        ("source", "target"),
        [
            pytest.param(np.zeros((0, 3)), room(100, 0), id="empty source"),
            pytest.param(room(100, 0), np.zeros((0, 3)), id="empty target"),
            pytest.param(np.zeros((1, 3)), np.ones((1, 3)), id="single"),
            pytest.param(np.full((50, 3), np.nan), room(100, 0), id="all NaN"),
        ],
    )
    def test_hardly_any_points(self, config, source, target):
        result = icp(source, target, config=config)
        assert result.status is Status.TOO_FEW_CORRESPONDENCES
        assert_finite(result)

    @FAMILY
    @pytest.mark.parametrize(
        ("source", "target"),
        [
            pytest.param(np.ones((50, 3)), np.full((50, 3), 2.0), id="coincident"),
            pytest.param(np.ones((50, 3)), room(500, 0), id="coincident source"),
            pytest.param(room(500, 0), np.ones((50, 3)), id="coincident target"),
            pytest.param(np.arange(60)[:, None] * [1.0, 2, 3], np.arange(60)[:, None] * [1.0, 2, 3] + 0.1, id="line"),
            pytest.param(np.random.default_rng(0).normal(size=(300, 3)), None, id="mirrored"),
        ],
    )
    def test_clouds_that_determine_no_motion(self, config, source, target):
        if target is None:
            target = source * [1, 1, -1]
        result = icp(source, target, config=config)
        assert not result.status.success
        assert_finite(result)
        assert np.linalg.det(result.T_target_source[:3, :3]) == pytest.approx(1)

    def test_a_line_leaves_the_turn_about_itself(self):
        line = np.linspace(0, 1, 80)[:, None] ** 1.5 * [1.0, 0, 0]
        result = icp(line + [0.001, 0.02, 0], line, config=POINT)
        assert result.status is Status.DEGENERATE
        assert "rotation about (1.00, 0.00, 0.00)" in [d.words for d in result.unobservable]

    @FAMILY
    def test_rows_that_are_not_finite_are_dropped_and_counted(self, config):
        target = room(2000, 0)
        source = se3.transform_points(se3.inverse(MOTION), target)
        source[::100] = np.nan
        target = np.vstack([target, [[np.inf, 0, 0]]])
        result = icp(source, target, config=config)
        assert result.status is Status.CONVERGED
        assert result.note == "21 points were not finite and were dropped"
        np.testing.assert_allclose(result.T_target_source, MOTION, atol=1e-9)

    def test_too_few_steps(self):
        target = room(2000, 0)
        source = se3.transform_points(se3.inverse(MOTION), target)
        result = icp(source, target, config=IcpConfig(max_iterations=1))
        assert result.status is Status.MAX_ITERATIONS
        assert "max_iterations" in result.note


@lru_cache
def two_scans() -> tuple[np.ndarray, np.ndarray]:
    """Three thousand points (N, 3) each of a furnished room with Kinect noise, none of them in both."""
    sequence = rendered("room", "kinect", 96, "sweep")
    seen = []
    for k in range(0, 96, 12):
        frame = sequence.frames[k]
        assert frame is not None
        points = sequence.camera.back_project(frame.depth_m)[frame.depth_m > 0]
        seen.append(se3.transform_points(sequence.ground_truth.T_world_camera[k], points))
    points = np.concatenate(seen)
    order = np.random.default_rng(0).permutation(len(points))
    return points[order[:3000]], points[order[3000:6000]]


@pytest.mark.parametrize("seed", range(0, 60, 2))
def test_a_room_from_anywhere_is_placed_rightly_or_not_at_all(seed: int) -> None:
    """Starts 0.6 to 3.1 rad and up to a metre off; some end where a wall crosses the furniture."""
    source, target = two_scans()
    rng = np.random.default_rng(seed)
    axis, angle_rad = rng.normal(size=3), rng.uniform(0.6, 3.1)
    turn = se3.exp(np.concatenate([np.zeros(3), angle_rad * axis / np.linalg.norm(axis)]))
    centre = source.mean(axis=0)
    moved = se3.transform_points(turn, source - centre) + centre + rng.normal(size=3) * 0.5
    result = icp(moved, target)
    error_m = np.sqrt(((se3.transform_points(result.T_target_source, moved) - source) ** 2).sum(axis=1).mean())
    assert not result.status.success or error_m < 0.02


class TestContract:
    def test_clouds_and_their_normals_are_accepted(self):
        target = room(2000, 0)
        source = se3.transform_points(se3.inverse(MOTION), target)
        plain = icp(source, target)
        normals = np.zeros_like(target)
        normals[:, 2] = 1  # deliberately wrong: if they are used, walls hold nothing
        result = icp(PointCloud(source), PointCloud(target, normals))
        assert plain.status is Status.CONVERGED
        assert result.status is Status.DEGENERATE

    def test_threads_do_not_change_a_byte(self):
        source, target = room(20_000, 1, 0.01), room(20_000, 2, 0.01)
        one, two = (icp(source, target, num_threads=n) for n in (1, 2))
        assert one.T_target_source.tobytes() == two.T_target_source.tobytes()
        assert one.information.tobytes() == two.information.tobytes()

    def test_arguments_stay_as_they_are(self):
        source, target, T = room(500, 0), room(500, 1), np.eye(4)
        kept = [x.copy() for x in (source, target, T)]
        icp(source, target, T_init=T)
        for array, copy in zip((source, target, T), kept, strict=True):
            np.testing.assert_array_equal(array, copy)

    @pytest.mark.parametrize(
        ("source", "target", "options", "words"),
        [
            (np.zeros((5, 4)), np.zeros((5, 3)), {}, "source"),
            (np.zeros((5, 3)), np.zeros((5, 2)), {}, "source"),
            (np.zeros((3, 50)), np.zeros((50, 3)), {}, r"source\.T"),
            (np.zeros((5, 3)), np.zeros((5, 3)), {"target_normals": np.zeros((4, 3))}, "target_normals"),
            (np.zeros((5, 3)), np.zeros((5, 3)), {"T_init": 2 * np.eye(4)}, "T_init"),
            (np.zeros((5, 3)), np.zeros((5, 3)), {"T_init": np.eye(3)}, "T_init"),
        ],
    )
    def test_wrong_input_raises(self, source, target, options, words):
        with pytest.raises(InvalidInputError, match=words):
            icp(source, target, **options)

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"method": "gycp"}, "point-to-plane"),
            ({"kernel": "hubber"}, "huber"),
            ({"scale": "yes"}, "symmetric"),
            ({"scale": "symmetric"}, "point-to-point"),
            ({"max_iterations": 0}, "max_iterations"),
            ({"max_correspondence_distance_m": -1.0}, "max_correspondence_distance_m"),
            ({"min_overlap": float("nan")}, "min_overlap"),
        ],
    )
    def test_wrong_settings_raise(self, options, words):
        with pytest.raises(ConfigError, match=words):
            IcpConfig(**options)


def test_correspondences_keep_the_bound_and_the_order():
    index = KdTree(np.array([[0.0, 0], [1, 0], [5, 5]]))
    pairs = find_correspondences(index, np.array([[0.0, 1], [9, 9], [1.2, 0]]), 1.0)
    np.testing.assert_array_equal(pairs.source, [0, 2])
    np.testing.assert_array_equal(pairs.target, [0, 1])
    np.testing.assert_allclose(pairs.distances_m, [1.0, 0.2])
    assert pairs.num_targets == 2


class TestRecordedScans:
    def test_lidar(self, shared_data):
        """The reference was found by another method; the scans themselves are 10 Hz apart and partly moving."""
        folder = shared_data / "registration" / "lidar_scans"
        source, target = (voxel_downsample(read_points(folder / f"{n}.ply"), 0.25) for n in ("source", "target"))
        result = icp(source, target, config=IcpConfig(max_correspondence_distance_m=1.0))
        assert result.status is Status.CONVERGED
        distance, degrees = pose_error(result.T_target_source, read_transform(folder / "T_target_source.txt"))
        assert distance < 0.015
        assert degrees < 0.3

    def test_lidar_with_nothing_set(self, shared_data):
        folder = shared_data / "registration" / "lidar_scans"
        result = icp(read_points(folder / "source.ply"), read_points(folder / "target.ply"))
        assert result.status is Status.CONVERGED
        distance, degrees = pose_error(result.T_target_source, read_transform(folder / "T_target_source.txt"))
        assert distance < 0.03
        assert degrees < 0.3

    @FAMILY
    def test_cars(self, shared_data, config):
        """The reference brings the median nearest distance from 46 cm to 9.6 cm; so must we."""
        folder = shared_data / "registration" / "car_clouds"
        source, target = (read_points(folder / f"car_cloud{n}.csv") for n in (400, 401))
        result = icp(source, target, config=config)
        assert result.status is Status.CONVERGED
        index = KdTree(target.points_m)
        moved = se3.transform_points(result.T_target_source, source.points_m)
        assert np.median(index.nearest(moved, np.inf)[0]) < 0.10
        reference = read_transform(folder / "T_400_to_401_reference.txt")
        assert pose_error(result.T_target_source, reference)[0] < 0.15

    @FAMILY
    def test_boxes(self, shared_data, config):
        scan = read_points(shared_data / "registration" / "boxes_2d" / "2D_twoBoxes.csv").points_m
        result = icp(se3.transform_points(se3.inverse(MOTION_2D), scan), scan, config=config)
        assert result.status is Status.CONVERGED
        np.testing.assert_allclose(result.T_target_source, MOTION_2D, atol=1e-9)
