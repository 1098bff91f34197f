"""What `--explain` shows: every number of the worked example, in words that say what it is worth."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError, OutputError
from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud
from scanweld.registration.closed_form import align_closed_form
from scanweld.registration.explain import WORKED_SOURCE, WORKED_TARGET, explain_horn, explain_icp
from scanweld.registration.icp import IcpConfig
from scanweld.registration.pictures import draw_alignment, draw_horn, draw_icp


def test_every_term_of_w_sums_to_w():
    """W_1 = b'_1 a'_1^T with a'_1 = (-0.8, -0.5) and b'_1 = (-0.136, -1.172)."""
    horn = explain_horn()
    np.testing.assert_allclose(horn.terms[0], [[0.1088, 0.068], [0.9376, 0.586]], atol=1e-12)
    np.testing.assert_allclose(horn.terms.sum(axis=0), horn.fit.W, atol=1e-14)
    np.testing.assert_allclose(horn.fit.U @ np.diag(horn.fit.singular_values) @ horn.fit.Vt, horn.fit.W, atol=1e-14)


def test_the_text_of_horns_method_shows_the_figures():
    text = explain_horn().text()
    for figure in ("(0.8000, 0.5000)", "(2.2360, 3.8820)", "1.9360", "-1.0400", "2.0120", "0.9600", "2.7924", "1.4149",
                   "0.6883", "-0.7254", "2.0480", "2.9575", "0.2678", "1.1335", "1.1072", "46.5024 deg"):  # fmt: skip
        assert figure in text
    assert text.count("0.1088") == 1
    assert max(map(len, text.splitlines())) <= 80


def test_the_distance_table_of_the_first_step():
    """First row: (0, 0) to b_1 .. b_5; sqrt(3.01^2 + 3.72^2) = 4.785 and so on."""
    step = explain_icp().steps[0]
    np.testing.assert_allclose(step.distances_m[0], [3.428, 4.785, 3.988, 4.899, 5.539], atol=5e-4)
    np.testing.assert_allclose(step.distances_m[:, 0], [3.428, 2.925, 2.708, 2.033, 2.212], atol=5e-4)


def test_the_target_moves_by_the_inverse_of_each_step():
    steps = explain_icp().steps
    expected = [(0.80, 0.50), (1.71, 1.51), (-0.06, 1.58), (0.49, 2.35), (1.74, 2.42)]
    np.testing.assert_allclose(steps[1].target, expected, atol=1e-12)
    np.testing.assert_array_equal(steps[1].pairs[:, 1] + 1, [1, 1, 3, 1, 2])
    np.testing.assert_array_equal(steps[2].pairs[:, 1] + 1, [1, 1, 3, 2, 2])
    assert len(steps) == 4
    total = np.eye(3)
    for step in steps:
        total = total @ step.T_step
        np.testing.assert_allclose(total, step.T_total, atol=1e-12)
        fit = step.horn.fit
        np.testing.assert_allclose(step.T_step, fit.transform, atol=1e-12)
        np.testing.assert_allclose(step.horn.terms.sum(axis=0), fit.W, atol=1e-12)


def test_the_text_of_icp_shows_the_figures_and_the_verdict():
    explanation = explain_icp()
    text = explanation.text()
    for figure in ("3.428*", "4.785", "3.988", "4.899", "5.539", "a3-b3", "1.3000", "2.2100", "1.8448", "0.6021",
                   "18.5386", "0.2105", "0.1896", "1.7861", "2.0674", "0.9851", "-8.6350", "0.1708", "0.2594",
                   "1.1911", "9.9036"):  # fmt: skip
        assert figure in text
    assert "rank 0 of 2: the rotation is free, and R = I on the free part" in text
    verdict = " ".join(explanation.verdict.split())
    for words in (
        "Five sources share three targets",
        "wrong local minimum",
        "What would help",
        "46.5024",
        "rmse 0.4881",
    ):
        assert words in verdict
    assert max(map(len, text.splitlines())) <= 80


def test_a_good_run_in_space_is_called_good():
    source = np.random.default_rng(0).normal(size=(8, 3))
    explanation = explain_icp(source, source + [0.05, 0, 0.02])
    assert explanation.verdict.startswith("Verdict: converged")
    assert "What would help" not in explanation.verdict
    assert "wrong local minimum" not in explanation.verdict
    text = explanation.text()
    assert max(map(len, text.splitlines())) <= 84  # three columns of W beside four of coordinates
    assert "0.0500" in text


def test_large_tables_are_cut_and_say_so():
    source = np.random.default_rng(0).normal(size=(30, 2))
    text = explain_icp(source, source + 0.01).text()
    assert "(the first 12 x 9 of 30 x 30)" in text
    assert "and 18 more" in text


@pytest.mark.parametrize(
    ("source", "target", "words"),
    [
        (np.zeros((201, 2)), np.zeros((5, 2)), "200 points"),
        (np.zeros((0, 2)), np.zeros((5, 2)), "1 to 200"),
        ([[np.nan, 0]], [[0, 0]], "not finite"),
    ],
)
def test_what_cannot_be_explained(source, target, words):
    with pytest.raises(InvalidInputError, match=words):
        explain_icp(source, target)


def corner(count):
    """Points on three faces that meet, and their normals (N, 3)."""
    points, normals = np.random.default_rng(1).uniform(0, 2, (count, 3)), np.zeros((count, 3))
    for k in range(3):
        points[k::3, k], normals[k::3, k] = 0, 1
    return points, normals


class TestGaussNewton:
    """The tables of point-to-plane and its relatives."""

    def test_one_step_by_hand(self):
        """Two points on the line y = 0 (normals (0, 1)) and one on x = 0 (normal (1, 0)); every p' is 0.1 too far along
        its normal.

        Target (-1, 0), (1, 0), (0, 1.5): centre (0, 0.5). About it the moved points are (-1, -0.4),
        (1, -0.4) and (0.1, 1).
        J = n^T [I | (-y, x)]: (0, 1, -1), (0, 1, 1), (1, 0, -1), r = 0.1 each, so

            H = [[1, 0, -1], [0, 2, 0], [-1, 0, 3]],  g = (0.1, 0.2, -0.1).

        H xi = -g gives the shift (-0.1, -0.1) and no turn.
        """
        target, normals = np.array([(-1.0, 0), (1, 0), (0, 1.5)]), np.array([(0.0, 1), (0, 1), (1, 0)])
        cloud = PointCloud(target, normals)
        config = IcpConfig(kernel="none", max_correspondence_distance_m=1, min_overlap=0)
        step = explain_icp(target + 0.1 * normals, cloud, config=config).steps[0]
        np.testing.assert_allclose(step.center_m, [0, 0.5], atol=1e-15)
        np.testing.assert_allclose(step.moved, [(-1, -0.4), (1, -0.4), (0.1, 1)], atol=1e-15)
        np.testing.assert_allclose(step.residuals_m, 0.1, atol=1e-15)
        np.testing.assert_allclose(step.weights, 1)
        np.testing.assert_allclose(step.information, [[1, 0, -1], [0, 2, 0], [-1, 0, 3]], atol=1e-15)
        np.testing.assert_allclose(step.gradient, [0.1, 0.2, -0.1], atol=1e-15)
        np.testing.assert_allclose(step.xi, [-0.1, -0.1, 0], atol=1e-15)
        np.testing.assert_allclose(step.T_total, [[1, 0, -0.1], [0, 1, -0.1], [0, 0, 1]], atol=1e-15)

    @pytest.mark.parametrize("dimension", [2, 3])
    @pytest.mark.parametrize("method", ["point-to-plane", "gicp"])
    def test_the_steps_shown_are_those_taken(self, method, dimension):
        """exp(xi) T_before, about the target's centre, is the T_after that the run recorded, step for step."""
        if dimension == 3:
            target = corner(120)[0]
            motion = se3.exp([0.05, -0.04, 0.03, 0.02, 0.01, -0.03])
        else:
            along = np.linspace(0, 1, 40)
            target = np.concatenate([np.column_stack([along, 0 * along]), np.column_stack([0 * along, along])])
            motion = np.array([[np.cos(0.03), -np.sin(0.03), 0.01], [np.sin(0.03), np.cos(0.03), -0.02], [0, 0, 1]])
        explanation = explain_icp(se3.transform_points(motion, target), target, config=IcpConfig(method=method))
        before = np.eye(dimension + 1)
        assert len(explanation.steps) > 1
        for step in explanation.steps:
            to_center = np.eye(dimension + 1)
            to_center[:-1, -1] = -step.center_m
            xi = step.xi if dimension == 3 else np.array([*step.xi[:2], 0, 0, 0, step.xi[2]])
            T_step = se3.exp(xi)
            if dimension == 2:
                T_step = T_step[np.ix_([0, 1, 3], [0, 1, 3])]
            taken = se3.inverse(to_center) @ T_step @ to_center @ before
            np.testing.assert_allclose(step.T_total, taken, atol=1e-9)
            before = step.T_total
        np.testing.assert_allclose(before, explanation.result.T_target_source, atol=1e-12)
        text = explanation.text()
        assert max(map(len, text.splitlines())) <= 80
        assert text.count("    H = sum w J^T J") == len(explanation.steps)

    def test_coloured_needs_colours_and_shows_them(self):
        target, normals = corner(90)
        colors = (100 + 60 * np.sin(3 * target)).astype(np.uint8)
        source = PointCloud(target + 0.02, normals, colors)
        explanation = explain_icp(source, PointCloud(target, normals, colors), config=IcpConfig(method="coloured"))
        assert "a row of intensity" in explanation.text()
        assert explanation.result.status.success

    def test_free_directions_are_named_and_get_no_step(self):
        """A line of points slides along itself."""
        target = np.column_stack([np.linspace(0, 1, 50), np.zeros(50)])
        explanation = explain_icp(target + [0, 0.01], target, config=IcpConfig())
        first = explanation.steps[0]
        assert first.free == ("translation along (1.00, 0.00)",)
        assert abs(first.xi[0]) < 1e-12
        assert "free, no step along it: translation along (1.00, 0.00)" in explanation.text()

    @pytest.mark.parametrize(
        "config",
        [
            IcpConfig(anderson=5),
            IcpConfig(graduated=True),
            IcpConfig(scale="least_squares"),
            IcpConfig(voxel_m=0.1),
            IcpConfig(method="point-to-point", kernel="huber"),
        ],
    )
    def test_settings_that_the_tables_do_not_show(self, config):
        with pytest.raises(InvalidInputError, match="cannot be explained step by step"):
            explain_icp(config=config)


def test_a_scale_is_explained_where_it_is_estimated():
    """T_1 .. T_k with their scales compose to the result: x_target = s R x_source + t."""
    source = np.random.default_rng(0).normal(size=(30, 2))
    explanation = explain_icp(
        source, 1.03 * source + 0.02, config=IcpConfig(method="point-to-point", scale="symmetric")
    )
    T, scale = np.eye(3), 1.0
    for step in explanation.steps:
        fit = step.horn.fit
        T = T @ np.block([[step.T_step[:2, :2], scale * step.T_step[:2, 2:]], [np.zeros((1, 2)), np.ones((1, 1))]])
        scale *= fit.scale
        np.testing.assert_allclose(T, step.T_total, atol=1e-9)
    assert scale == pytest.approx(1.03, abs=1e-9)
    assert "scaled by 1.0300" in explanation.verdict


def test_the_verdict_says_that_free_directions_were_put_back():
    """On a plane that slides in itself the steps drift, but the result stays at the first guess."""
    rng = np.random.default_rng(0)
    source, target = (np.column_stack([rng.uniform(0, 1, (100, 2)), np.zeros(100)]) for _ in range(2))
    explanation = explain_icp(source, target)
    last = explanation.steps[-1].T_total
    assert explanation.result.unobservable
    assert not np.allclose(last, explanation.result.T_target_source)
    angle = np.degrees(np.arccos((np.trace(last[:3, :3]) - 1) / 2))
    verdict = " ".join(explanation.verdict.split())
    assert f"The steps ended at {angle:.4f} deg" in verdict
    assert "then put back to the first guess" in verdict
    assert "put back" not in explain_icp().verdict


@pytest.mark.parametrize("source", [np.zeros((1, 3)), np.ones((4, 3)), np.arange(12.0).reshape(4, 3)])
def test_points_without_an_answer_are_explained_too(source):
    for explanation in (explain_horn(source, source + 1), explain_icp(source, source + 1)):
        assert "nan" not in explanation.text().lower()
        assert "converged" not in explanation.verdict


class TestPictures:
    """A picture is checked for being there, of a sensible size, and for showing both colours."""

    @staticmethod
    def pixels(path):
        import matplotlib.image

        return (255 * matplotlib.image.imread(path)[..., :3]).astype(int)

    @pytest.mark.parametrize("dimension", [2, 3])
    def test_both_clouds_are_drawn(self, tmp_path, dimension):
        source = np.random.default_rng(0).normal(size=(9, dimension))
        target = source + 0.1
        result = align_closed_form(source, target)
        draw_horn(tmp_path / "horn.png", explain_horn(source, target))
        draw_icp(tmp_path / "icp.png", explain_icp(source, target))
        draw_alignment(tmp_path / "both.png", PointCloud(source), PointCloud(target), result)
        for name in ("horn", "icp", "both"):
            image = self.pixels(tmp_path / f"{name}.png")
            assert image.shape[0] > 200 < image.shape[1]
            for color in ((213, 94, 0), (0, 114, 178)):
                assert (np.abs(image - color).max(axis=2) < 60).sum() > 50
        assert sorted(p.name for p in tmp_path.iterdir()) == ["both.png", "horn.png", "icp.png"]

    def test_large_clouds_get_a_slice(self, tmp_path):
        """Two rows instead of one, so the picture is about twice as high; before and after share their axes."""
        target = np.random.default_rng(0).uniform(0, 2, (3000, 3)) * [1, 1, 0.5]
        result = align_closed_form(target, target)
        draw_alignment(tmp_path / "large.png", PointCloud(target), PointCloud(target + 0.3), result)
        draw_alignment(tmp_path / "small.png", PointCloud(target[:900]), PointCloud(target[:900] + 0.3), result)
        large, small = (self.pixels(tmp_path / f"{name}.png").shape for name in ("large", "small"))
        assert 1.6 < large[0] / small[0] < 2.1
        assert large[1] == pytest.approx(small[1], rel=0.05)

    @pytest.mark.parametrize(
        "points", [np.zeros((0, 3)), np.zeros((1, 2)), np.zeros((3000, 3)), np.full((5, 3), np.nan)]
    )
    def test_odd_clouds_are_drawn_too(self, tmp_path, points):
        cloud = PointCloud(points)
        result = align_closed_form(points, points)
        draw_alignment(tmp_path / "odd.png", cloud, cloud, result)
        assert (tmp_path / "odd.png").stat().st_size > 5000

    @pytest.mark.parametrize(("name", "start"), [("a.pdf", b"%PDF"), ("a.SVG", b"<?xml"), ("a.png", b"\x89PNG")])
    def test_the_ending_chooses_the_format(self, tmp_path, name, start):
        draw_horn(tmp_path / name, explain_horn())
        assert (tmp_path / name).read_bytes().startswith(start)

    def test_other_endings(self, tmp_path):
        with pytest.raises(OutputError, match=r"must end in \.png"):
            draw_horn(tmp_path / "a.jpg", explain_horn())
        assert not list(tmp_path.iterdir())

    def test_a_folder_that_does_not_exist(self, tmp_path):
        with pytest.raises(OutputError, match="cannot be written"):
            draw_horn(tmp_path / "no" / "horn.png", explain_horn(WORKED_SOURCE, WORKED_TARGET))
