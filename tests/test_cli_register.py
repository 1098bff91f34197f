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
    """Run the command; return its exit code and what it printed on stdout."""
    app = typer.Typer()
    app.command()(register)
    app.callback()(lambda: None)  # a group, as in the real table

    def call(*arguments):
        capsys.readouterr()
        code = app(["register", *map(str, arguments)], standalone_mode=False)
        return code, capsys.readouterr().out

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
    assert "rotation about (0.00, 0.00, 1.00)" in out
    code, out = run(tmp_path / "a.npy", tmp_path / "b.npy", "--json")
    assert code == 3
    assert len(json.loads(out)["unobservable"]) == 3


def test_clouds_apart_are_no_success(run, tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(100, 3)))
    np.save(tmp_path / "b.npy", np.random.default_rng(0).normal(size=(100, 3)) + 500)
    code, out = run(tmp_path / "a.npy", tmp_path / "b.npy", "--json")
    assert code == 3
    assert json.loads(out)["status"] == "no_overlap"


def test_explain_without_files_is_the_worked_example(run, tmp_path):
    code, out = run("--explain", "--plot", tmp_path / "steps.png")
    assert code == 0
    for words in ("Horn's method", "0.6883", "3.428*", "1.8448", "Five sources share three targets"):
        assert words in " ".join(out.split())
    assert (tmp_path / "steps.png").is_file()


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
    with pytest.raises(OutputError, match="cannot be written"):
        run(*clouds, "--out", tmp_path / "no" / "a.ply")
    np.savetxt(tmp_path / "T.txt", 2 * np.eye(4))
    with pytest.raises(FileFormatError, match=r"T\.txt"):
        run(*clouds, "--init", tmp_path / "T.txt")


def test_help_names_every_option(run):
    text = re.sub(r"\x1b\[[0-9;]*m", "", run("--help")[1])
    for option in ("--method", "--scale", "--init", "--voxel", "--max-distance", "--threads", "--explain", "--plot",
                   "--out", "--json"):  # fmt: skip
        assert option in text
