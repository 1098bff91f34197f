"""`scanweld register`: what it prints, writes and returns."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import typer

from scanweld.cli.register import register
from scanweld.errors import FileFormatError, InvalidInputError, OutputError
from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.ply import read_ply, write_ply
from scanweld.registration.icp import IcpConfig, icp

KEYS = {"status", "T_target_source", "scale", "rmse_m", "overlap", "num_inliers", "num_iterations", "information",
        "unobservable", "seconds"}  # fmt: skip
T = se3.exp([0.05, -0.03, 0.04, 0.03, -0.02, 0.04])


@pytest.fixture
def run(capsys):
    """Run the command; return its exit code and what it printed on stdout; `run.err` is what is on stderr."""
    app = typer.Typer()
    app.command()(register)
    app.callback()(lambda: None)  # a group, as in the real table

    def call(*arguments):
        capsys.readouterr()
        code = app(["register", *map(str, arguments)], standalone_mode=False)
        printed = capsys.readouterr()
        call.err = printed.err
        return code, printed.out

    return call


@pytest.fixture
def clouds(tmp_path):
    """A box corner and the same moved, as PLY files."""
    target = np.random.default_rng(0).uniform(0, 2, (900, 3))
    for k in range(3):
        target[k::3, k] = 0
    source = se3.transform_points(se3.inverse(T), target)
    write_ply(tmp_path / "source.ply", PointCloud(source))
    write_ply(tmp_path / "target.ply", PointCloud(target))
    return tmp_path / "source.ply", tmp_path / "target.ply"


def test_json_is_the_only_output_and_holds_the_contract(run, clouds):
    code, out = run(*clouds, "--json")
    figures = json.loads(out)
    assert code == 0
    assert set(figures) >= KEYS
    assert figures["status"] == "converged"
    np.testing.assert_allclose(figures["T_target_source"], T, atol=1e-9)
    assert np.shape(figures["information"]) == (6, 6)
    assert figures["scale"] == 1
    assert figures["unobservable"] == []
    assert figures["seconds"] > 0


def test_the_defaults_are_those_of_the_api(run, clouds):
    source, target = map(read_ply, clouds)
    result = icp(source, target, config=IcpConfig())
    figures = json.loads(run(*clouds, "--json")[1])
    assert figures["T_target_source"] == result.T_target_source.tolist()
    assert figures["num_iterations"] == result.num_iterations
    twice = json.loads(run(*clouds, "--json", "--threads", 1)[1])
    assert twice["T_target_source"] == figures["T_target_source"]


@pytest.mark.parametrize("method", ["point-to-point", "point-to-plane", "closed-form"])
def test_every_method(run, clouds, method):
    code, out = run(*clouds, "--method", method)
    assert code == 0
    assert "converged" in out
    for value in T[0]:
        assert f"{value:.6f}" in out


def test_the_aligned_source_and_the_picture_are_written(run, clouds, tmp_path):
    code, out = run(*clouds, "--out", tmp_path / "aligned.ply", "--plot", tmp_path / "plot.png", "--voxel", 0.05)
    assert code == 0
    np.testing.assert_allclose(read_ply(tmp_path / "aligned.ply").points_m, read_ply(clouds[1]).points_m, atol=2e-3)
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    assert str(tmp_path / "aligned.ply") in out


def test_scale(run, tmp_path):
    a = np.random.default_rng(0).normal(size=(30, 2))
    angle = np.array([[0.6, -0.8], [0.8, 0.6]])
    np.savetxt(tmp_path / "a.csv", a, delimiter=",")
    np.savetxt(tmp_path / "b.xyz", 2.7 * a @ angle.T + [2, 3])
    code, out = run(tmp_path / "a.csv", tmp_path / "b.xyz", "--method", "closed-form", "--scale", "--json")
    figures = json.loads(out)
    assert code == 0
    assert figures["scale"] == pytest.approx(2.7)
    np.testing.assert_allclose(figures["T_target_source"], [[0.6, -0.8, 2], [0.8, 0.6, 3], [0, 0, 1]], atol=1e-9)
    assert np.shape(figures["information"]) == (3, 3)
    near = 1.03 * a + [0.01, -0.02]
    np.savetxt(tmp_path / "b.xyz", near)
    figures = json.loads(run(tmp_path / "a.csv", tmp_path / "b.xyz", "--scale", "--json")[1])
    assert figures["scale"] == pytest.approx(1.03)


def test_a_first_guess_and_a_gate(run, clouds, tmp_path):
    np.savetxt(tmp_path / "T.txt", T)
    figures = json.loads(run(*clouds, "--init", tmp_path / "T.txt", "--max-distance", 0.01, "--json")[1])
    assert figures["status"] == "converged"
    assert figures["num_iterations"] == 1


def test_a_plane_is_degenerate_and_says_so(run, tmp_path):
    rng = np.random.default_rng(0)
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / name, np.column_stack([rng.uniform(0, 1, (500, 2)), np.zeros(500)]))
    code, out = run(tmp_path / "a.npy", tmp_path / "b.npy")
    assert code == 3
    assert "degenerate: the data does not determine the whole motion" in out
    assert out.count("rotation about (0.00, 0.00, 1.00)") == 1
    assert out.count("left free") == 1
    assert "leaves free" not in out
    code, out = run(tmp_path / "a.npy", tmp_path / "b.npy", "--json")
    assert code == 3
    assert len(json.loads(out)["unobservable"]) == 3


def test_clouds_apart_are_no_success(run, tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(100, 3)))
    np.save(tmp_path / "b.npy", np.random.default_rng(0).normal(size=(100, 3)) + 500)
    code, out = run(tmp_path / "a.npy", tmp_path / "b.npy", "--json")
    assert code == 3
    figures = json.loads(out)
    assert figures["status"] == "no_overlap"
    for words in (figures["note"], run(tmp_path / "a.npy", tmp_path / "b.npy")[1]):
        assert "raise --max-distance" in words
        assert "max_correspondence_distance_m" not in words


def test_explain_without_files_is_the_worked_example(run, tmp_path):
    code, out = run("--explain", "--plot", tmp_path / "steps.png")
    assert code == 0
    for words in ("Horn's method", "0.6883", "3.428*", "1.8448", "Five sources share three targets"):
        assert words in " ".join(out.split())
    assert (tmp_path / "steps.png").is_file()


def test_explain_without_files_as_json(run):
    """The ICP result of docs/worked-example.md, alone on stdout."""
    code, out = run("--explain", "--json")
    figures = json.loads(out)
    assert code == 0
    assert set(figures) >= KEYS
    assert figures["status"] == "no_overlap"
    assert figures["num_iterations"] == 4
    assert figures["rmse_m"] == pytest.approx(0.4881, abs=5e-5)
    np.testing.assert_allclose(figures["T_target_source"][0], [0.9851, -0.1720, 1.5899], atol=5e-5)
    assert "Horn's method" in run.err
    assert "Verdict: no_overlap" in run.err


def test_explain_without_files_takes_no_option_that_needs_them(run, tmp_path):
    for arguments in (("--out", tmp_path / "a.ply"), ("--voxel", 1), ("--scale",), ("--method", "point-to-plane")):
        with pytest.raises(typer.BadParameter, match="without SOURCE and TARGET"):
            run("--explain", *arguments)


@pytest.fixture
def small(tmp_path):
    """150 points of a box corner, the target with normals, the source moved and with noise: methods differ."""
    rng = np.random.default_rng(3)
    target, normals = rng.uniform(0, 2, (150, 3)), np.zeros((150, 3))
    for k in range(3):
        target[k::3, k], normals[k::3, k] = 0, 1
    source = target + [0.05, -0.04, 0.03] + rng.normal(0, 0.01, target.shape)
    write_ply(tmp_path / "a.ply", PointCloud(source))
    write_ply(tmp_path / "b.ply", PointCloud(target, normals))
    return tmp_path / "a.ply", tmp_path / "b.ply"


def test_explain_reports_the_method_that_it_explains(run, small):
    """Even where the target has normals: by default both are point-to-point, step for step."""
    a, b = map(read_ply, small)
    for options in ((), ("--max-distance", 0.3), ("--voxel", 0.2)):
        figures = json.loads(run(*small, "--explain", "--json", *options)[1])
        assert run.err.startswith("ICP, point-to-point")
        assert f"after {figures['num_iterations']} step" in run.err
        assert f"rmse {figures['rmse_m']:.4f} m" in " ".join(run.err.split())
    expected = icp(a.points_m, b.points_m, config=IcpConfig(method="point-to-point"))
    figures = json.loads(run(*small, "--explain", "--json")[1])
    assert figures["T_target_source"] == expected.T_target_source.tolist()
    assert "point-to-point" in run(*small, "--explain")[1].split("Verdict")[1]


def test_explain_says_when_the_result_is_that_of_another_method(run, small):
    out = run(*small, "--explain", "--method", "point-to-plane")[1]
    assert out.startswith("The steps shown are those of point-to-point, the result is that of point-to-plane.\n")
    assert "point-to-plane, " in out.split("Verdict")[1]
    out = run(*small, "--explain", "--scale")[1]
    assert out.startswith("The steps shown are those without a scale, the result is the one with it.\n")
    assert "The steps shown" not in run(*small, "--explain")[1]


def test_explain_refuses_large_sets_before_aligning(run, clouds, monkeypatch):
    def never(*_, **__):
        raise AssertionError("aligned")

    monkeypatch.setattr("scanweld.registration.icp.icp", never)
    with pytest.raises(InvalidInputError, match=r"source\.ply: --explain takes 1 to 200 points, got 900"):
        run(*clouds, "--explain")


@pytest.mark.parametrize("dimension", [2, 3])
def test_explain_with_files(run, tmp_path, dimension, capsys):
    points = np.random.default_rng(0).normal(size=(7, dimension))
    np.save(tmp_path / "a.npy", points)
    np.save(tmp_path / "b.npy", points + 0.05)
    files = tmp_path / "a.npy", tmp_path / "b.npy"
    code, out = run(*files, "--explain", "--method", "point-to-point")
    assert code == 0
    assert out.count("W = sum W_i") == 2
    code, out = run(*files, "--explain", "--method", "closed-form", "--json", "--plot", tmp_path / "horn.png")
    assert json.loads(out)["status"] == "converged"
    assert (tmp_path / "horn.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--method", "gicp"), "point-to-plane"),
        (("--scale", "--method", "point-to-plane"), "--scale works with"),
        (("--method", "closed-form", "--voxel", "0.1"), "row i"),
        (("--threads", "0"), "greater than or equal to 1"),
    ],
)
def test_wrong_usage(run, clouds, arguments, words):
    with pytest.raises(typer.BadParameter, match=words):
        run(*clouds, *arguments)


def test_missing_files_are_usage(run, clouds):
    with pytest.raises(typer.BadParameter, match="SOURCE and TARGET"):
        run()
    with pytest.raises(typer.BadParameter, match="SOURCE and TARGET"):
        run(clouds[0])


def test_known_errors(run, clouds, tmp_path):
    with pytest.raises(FileFormatError, match=r"none\.ply"):
        run(clouds[0], tmp_path / "none.ply")
    (tmp_path / "plane.csv").write_text("1,2\n3,4\n")
    with pytest.raises(InvalidInputError, match="3-D"):
        run(clouds[0], tmp_path / "plane.csv")
    for matrix, words in (
        (np.diag([2, 2, 2, 1]), "not a rotation"),
        (np.eye(3), "need a 4x4 .* 3x3"),
        (np.eye(2), "4x4"),
    ):
        np.savetxt(tmp_path / "T.txt", matrix)
        with pytest.raises(FileFormatError, match=rf"^--init .*T\.txt: .*{words}"):
            run(*clouds, "--init", tmp_path / "T.txt")
    write_ply(tmp_path / "few.ply", PointCloud(np.eye(3)))
    with pytest.raises(InvalidInputError, match=r"few\.ply 3 points, .* use --method point-to-plane"):
        run(clouds[0], tmp_path / "few.ply", "--method", "closed-form")


@pytest.mark.parametrize("option", ["--max-distance", "--voxel"])
@pytest.mark.parametrize("value", ["-1", "0", "nan"])
def test_distances_must_be_positive(run, clouds, option, value):
    with pytest.raises(InvalidInputError) as error:
        run(*clouds, option, value)
    assert str(error.value) == f"{option}: expected a positive number of metres, got {value}"


def test_a_voxel_too_small_names_the_option(run, clouds):
    with pytest.raises(InvalidInputError, match=r"^--voxel: 1e-300 m is too small"):
        run(*clouds, "--voxel", 1e-300)


class TestOutputs:
    """They are checked before any work, and never replace an input."""

    @pytest.fixture(autouse=True)
    def no_work(self, monkeypatch):
        def never(*_, **__):
            raise AssertionError("aligned")

        monkeypatch.setattr("scanweld.registration.icp.icp", never)

    def refused(self, run, clouds, arguments, words):
        folder = clouds[0].parent
        before = {file: file.read_bytes() for file in folder.iterdir() if file.is_file()}
        with pytest.raises(OutputError, match=words) as error:
            run(*clouds, *arguments)
        assert "\n" not in str(error.value)
        assert {file: file.read_bytes() for file in folder.iterdir() if file.is_file()} == before

    @pytest.mark.parametrize("option", ["--out", "--plot"])
    @pytest.mark.parametrize("which", [0, 1])
    def test_inputs_are_not_overwritten(self, run, clouds, option, which):
        self.refused(run, clouds, (option, clouds[which]), f"{option} .* is one of the inputs")

    def test_nor_by_another_name(self, run, clouds, tmp_path):
        (tmp_path / "folder").mkdir()
        self.refused(run, clouds, ("--out", tmp_path / "folder" / ".." / "source.ply"), "is one of the inputs")
        (tmp_path / "link.ply").symlink_to(clouds[1])
        self.refused(run, clouds, ("--out", tmp_path / "link.ply"), "is one of the inputs")

    def test_nor_is_the_first_guess(self, run, clouds, tmp_path):
        np.savetxt(tmp_path / "T.txt", T)
        arguments = ("--init", tmp_path / "T.txt", "--plot", tmp_path / "T.txt")
        self.refused(run, clouds, arguments, "is one of the inputs")

    @pytest.mark.parametrize(
        ("option", "name", "words"),
        [
            ("--out", "a.xyz", r"must end in \.ply, got '\.xyz'"),
            ("--out", "a", r"must end in \.ply, got a name without ending"),
            ("--plot", "a.ply", r"must end in \.png or \.pdf or \.svg, got '\.ply'"),
            ("--out", "no/a.ply", "--out .* cannot be written: .*No such file"),
            ("--plot", "no/a.png", "--plot .* cannot be written: .*No such file"),
            ("--out", "source.ply/a.ply", "cannot be written: .*Not a directory"),
        ],
    )
    def test_names_that_cannot_be_written(self, run, clouds, tmp_path, option, name, words):
        self.refused(run, clouds, (option, tmp_path / name), words)

    def test_one_bad_output_keeps_the_other_from_being_written(self, run, clouds, tmp_path):
        good_out, good_plot = ("--out", tmp_path / "a.ply"), ("--plot", tmp_path / "a.png")
        self.refused(run, clouds, (*good_out, "--plot", tmp_path / "no" / "a.png"), "cannot be written")
        self.refused(run, clouds, (*good_plot, "--out", tmp_path / "no" / "a.ply"), "cannot be written")

    def test_a_folder_is_no_file(self, run, clouds, tmp_path):
        (tmp_path / "folder.ply").mkdir()
        self.refused(run, clouds, ("--out", tmp_path / "folder.ply"), "is a folder")


def test_other_files_are_replaced(run, clouds, tmp_path):
    for name in ("aligned.ply", "plot.pdf"):
        (tmp_path / name).write_text("old")
    assert run(*clouds, "--out", tmp_path / "aligned.ply", "--plot", tmp_path / "plot.pdf")[0] == 0
    assert len(read_ply(tmp_path / "aligned.ply")) == 900
    assert (tmp_path / "plot.pdf").read_bytes().startswith(b"%PDF")
    assert len(list(tmp_path.iterdir())) == 4


def test_one_is_singular(run, clouds):
    assert "closed-form, 1 iteration, " in run(*clouds, "--method", "closed-form")[1]
    assert " iterations, " in run(*clouds)[1]
    np.save(clouds[0].parent / "one.npy", np.eye(3)[:1])
    one = clouds[0].parent / "one.npy"
    assert "1 pair, 3 are needed in 3-D" in run(one, one, "--method", "closed-form")[1]


def test_help_names_every_option(run):
    text = re.sub(r"\x1b\[[0-9;]*m", "", run("--help")[1])
    for option in ("--method", "--scale", "--init", "--voxel", "--max-distance", "--threads", "--explain", "--plot",
                   "--out", "--json"):  # fmt: skip
        assert option in text
