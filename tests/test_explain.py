"""What `--explain` shows: every number of the worked example, in words that say what it is worth."""

from __future__ import annotations

import numpy as np
import pytest

from scanweld.errors import InvalidInputError, OutputError
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


def test_other_methods_cannot_be_explained():
    with pytest.raises(InvalidInputError, match="point-to-point"):
        explain_icp(config=IcpConfig(method="point-to-plane"))


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
            for color in ((209, 73, 91), (0, 121, 140)):
                assert (np.abs(image - color).max(axis=2) < 60).sum() > 50
        assert sorted(p.name for p in tmp_path.iterdir()) == ["both.png", "horn.png", "icp.png"]

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
