"""`scanweld register`: what it prints, writes and returns."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import typer

from scanweld.cli.app import run as command_line
from scanweld.cli.register import register
from scanweld.cli.registration.alignment import Aligner, run_timed
from scanweld.cli.registration.options import Method, settings
from scanweld.datasets.synthetic import RenderConfig, SyntheticSequence
from scanweld.errors import ConfigError, FileFormatError, InvalidInputError, OutputError
from scanweld.geometry import se3
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.ply import read_ply, write_ply
from scanweld.io.point_files import read_points
from scanweld.registration.closed_form import align_closed_form
from scanweld.registration.icp import IcpConfig, icp
from scanweld.registration.local.config import METHODS

KEYS = {"status", "T_target_source", "scale", "scale_std", "rmse_m", "overlap", "num_inliers", "num_iterations",
        "information", "covariance", "unobservable", "seconds"}  # fmt: skip
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
    assert np.shape(figures["information"]) == np.shape(figures["covariance"]) == (6, 6)
    assert (figures["scale"], figures["scale_std"]) == (1, 0)
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


@pytest.mark.parametrize("method", [method.value for method in Method])
def test_every_method(run, clouds, method):
    """Clouds whose points coincide: every method finds T to the printed digits."""
    for file in clouds:
        points = read_ply(file).points_m
        write_ply(file, PointCloud(points, colors=np.full((len(points), 3), 128, np.uint8)))
    code, out = run(*clouds, "--method", method)
    assert code == 0
    assert "converged" in out
    assert f"method           {method}, " in out
    for value in T[0]:
        assert f"{value:.6f}" in out
    figures = json.loads(run(*clouds, "--method", method, "--json")[1])
    assert figures["method"] == method


def test_methods_are_those_of_the_api():
    assert {method.value for method in Method} == {*METHODS, "closed-form"}


def test_coloured_needs_colours(run, clouds):
    with pytest.raises(InvalidInputError, match=r"source\.ply: has no colours, which --method coloured needs"):
        run(*clouds, "--method", "coloured")


class TestSet:
    """`--set` reaches every setting of the local methods: defaults < --set < options."""

    def test_a_lock(self, run, clouds):
        """T turns about all axes; with planar locks the answer keeps z, roll and pitch of the identity."""
        figures = json.loads(run(*clouds, "--set", "locks=planar", "--json")[1])
        found = np.array(figures["T_target_source"])
        np.testing.assert_allclose(found[2, :3], [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(found[:3, 2], [0, 0, 1], atol=1e-12)

    def test_it_is_the_setting_of_the_api(self, run, clouds):
        options = ("--set", "kernel=tukey", "--set", "pairing=mutual", "--set", "method=gicp")
        result = icp(*map(read_ply, clouds), config=IcpConfig(method="gicp", kernel="tukey", pairing="mutual"))
        figures = json.loads(run(*clouds, *options, "--json")[1])
        assert figures["method"] == "gicp"
        assert figures["T_target_source"] == result.T_target_source.tolist()
        assert figures["num_iterations"] == result.num_iterations

    def test_options_win(self):
        chosen = settings(
            Method.GICP, scale=True, explain=False, use_global=False, voxel=0.1, max_distance=0.5,
            overrides=["method=symmetric", "voxel_m=9", "max_correspondence_distance_m=9", "min_overlap=0.4"],
        )  # fmt: skip
        assert chosen.icp == IcpConfig(
            method="gicp", scale="least_squares", voxel_m=0.1, max_correspondence_distance_m=0.5, min_overlap=0.4
        )

    def test_nothing_set_is_the_default(self):
        def config(method=None, **given):
            nothing = {"scale": False, "explain": False, "use_global": False, "voxel": None, "max_distance": None}
            return settings(method, **{**nothing, "overrides": [], **given}).icp

        assert config() == IcpConfig()
        assert config(explain=True) == IcpConfig(method="point-to-point")
        assert config(scale=True) == IcpConfig(scale="least_squares")
        assert config(Method.POINT_TO_POINT, scale=True).scale == "symmetric"

    @pytest.mark.parametrize(
        ("override", "words"),
        [
            ("kernal=tukey", "--set: unknown key 'kernal'; did you mean 'kernel'"),
            ("kernel=tukay", "--set: kernel = 'tukay': expected one of"),
            ("min_overlap=2", "--set: min_overlap = 2.* from 0.0 to 1.0"),
            ("locks=up", "'up' is none of x, y, z"),
        ],
    )
    def test_what_is_wrong_is_named(self, run, clouds, override, words):
        with pytest.raises(ConfigError, match=words):
            run(*clouds, "--set", override)


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """Frames 75 and 25 of the room as PLY files, the first moved by T_moved, and the true T_target_source."""
    folder = tmp_path_factory.mktemp("scans")
    sequence = SyntheticSequence(RenderConfig(width=160, height=120))
    T_world_camera = sequence.ground_truth.T_world_camera
    T_moved = se3.from_quaternion_xyzw([0.3, -0.5, 0.2, 0.7], [1, -2, 0.5])
    for name, index, T_name_camera in (("source", 75, T_moved), ("target", 25, np.eye(4))):
        frame = sequence.read(index)
        points = frame.camera.back_project(frame.depth_m)[frame.depth_m > 0]
        write_ply(folder / f"{name}.ply", PointCloud(se3.transform_points(T_name_camera, points)))
    truth = se3.inverse(T_world_camera[25]) @ T_world_camera[75] @ se3.inverse(T_moved)
    return folder / "source.ply", folder / "target.ply", truth


class TestGlobal:
    """Scans of a rendered room, the source anywhere."""

    @pytest.mark.parametrize("options", [(), ("--method", "point-to-plane", "--voxel", 0.03)])
    def test_no_first_guess_is_needed(self, run, scans, options):
        source, target, truth = scans
        code, out = run(source, target, "--global", "--json", *options)
        figures = json.loads(out)
        assert code == 0
        assert set(figures) >= KEYS
        error = np.array(figures["T_target_source"]) @ se3.inverse(truth)
        assert np.linalg.norm(error[:3, 3]) < 0.005
        assert np.degrees(se3.rotation_angle_rad(error)) < 0.2
        assert figures["method"] == ("global, then point-to-plane" if options else "global, then gicp")
        assert figures["overlap"] > 0.6

    def test_the_local_methods_alone_do_not_reach_it(self, run, scans):
        assert run(*scans[:2], "--json")[0] == 3

    def test_unrelated_clouds_exit_with_3(self, run, scans, tmp_path):
        """Forty balls are no room."""
        rng = np.random.default_rng(0)
        directions = rng.normal(size=(20_000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        centers = rng.uniform(-2, 2, (40, 3))[rng.integers(0, 40, 20_000)]
        write_ply(tmp_path / "balls.ply", PointCloud(centers + 0.3 * directions))
        code, out = run(tmp_path / "balls.ply", scans[1], "--global", "--json")
        figures = json.loads(out)
        assert code == 3
        assert figures["status"] in ("no_overlap", "too_few_correspondences")
        assert figures["covariance"] is None
        assert figures["note"]

    def test_its_settings(self, run, scans):
        with pytest.raises(ConfigError, match=r"unknown key 'global\.hypothesis'; did you mean 'global\.hypotheses'"):
            run(*scans[:2], "--global", "--set", "global.hypothesis=3")
        with pytest.raises(ConfigError, match="unknown key 'global'"):
            run(*scans[:2], "--set", "global.hypotheses=3")

    def test_the_plane_is_an_error(self, run, tmp_path):
        np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(200, 2)))
        with pytest.raises(InvalidInputError, match="needs points in 3-D"):
            run(tmp_path / "a.npy", tmp_path / "a.npy", "--global")


def test_seconds_are_those_of_the_alignment_alone():
    """Loading kernels (here a nap of 0.3 s) comes before the clock starts."""
    seen = []

    def warm(source, target):
        seen.append((len(source), len(target)))
        time.sleep(0.3)
        return "warm"

    result = align_closed_form(np.eye(3), np.eye(3))
    cloud = PointCloud(np.zeros((20_000, 3)))
    found, seconds = run_timed(Aligner("nap", lambda a, b: result, warm), cloud, cloud)
    assert found.T_target_source is result.T_target_source
    assert seconds < 0.2
    assert seen == [(5000, 5000)]  # a sample of 20 000


def test_the_aligned_source_and_the_picture_are_written(run, clouds, tmp_path):
    code, out = run(*clouds, "--out", tmp_path / "aligned.ply", "--plot", tmp_path / "plot.png", "--voxel", 0.05)
    assert code == 0
    np.testing.assert_allclose(read_ply(tmp_path / "aligned.ply").points_m, read_ply(clouds[1]).points_m, atol=2e-3)
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    assert str(tmp_path / "aligned.ply") in out


@pytest.mark.parametrize("name", ["a.pcd", "a.xyz", "a.csv", "a.txt", "a.npy"])
def test_the_ending_chooses_the_format(run, clouds, tmp_path, name):
    assert run(*clouds, "--out", tmp_path / name)[0] == 0
    np.testing.assert_allclose(read_points(tmp_path / name).points_m, read_ply(clouds[1]).points_m, atol=2e-6)
    assert run(tmp_path / name, clouds[1])[0] == 0  # it reads back, too


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
    for method in ("point-to-plane", "point-to-point", "gicp"):
        options = () if method == "point-to-plane" else ("--method", method)
        figures = json.loads(run(tmp_path / "a.csv", tmp_path / "b.xyz", "--scale", "--json", *options)[1])
        assert figures["method"] == method
        assert figures["scale"] == pytest.approx(1.03)
        assert figures["scale_std"] >= 0


def test_a_first_guess_and_a_gate(run, clouds, tmp_path):
    np.savetxt(tmp_path / "T.txt", T)
    figures = json.loads(run(*clouds, "--init", tmp_path / "T.txt", "--max-distance", 0.01, "--json")[1])
    assert figures["status"] == "converged"
    assert figures["num_iterations"] <= 3  # nothing is left to do


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


@pytest.mark.parametrize("method", ["point-to-plane", "symmetric", "gicp"])
def test_explain_follows_every_method(run, small, method):
    code, out = run(*small, "--explain", "--method", method)
    steps, result = out.split("Verdict")
    assert code == 0
    assert steps.startswith(f"ICP, {method}: 150 source and 150 target points in 3-D")
    assert f"method           {method}, " in result
    assert steps.count("    H = sum w J^T J") == steps.count("\nStep ") > 1
    # The last step's T is the reported one.
    shown = np.array([line.split() for line in steps.split("T after step")[-1].splitlines()[1:5]], float)
    found = np.array(json.loads(run(*small, "--method", method, "--json")[1])["T_target_source"])
    np.testing.assert_allclose(shown, found, atol=6e-5)


def test_explain_shows_a_scale(run, small):
    out = run(*small, "--explain", "--scale")[1]
    assert out.startswith("ICP, point-to-point")
    assert "scaled by" in out.split("Verdict")[1]
    assert "  s = " in out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--method", "gicp", "--scale"), "--explain: scale = 'least_squares' with gicp cannot be explained"),
        (("--set", "kernel=huber"), "--explain: kernel = 'huber' with point-to-point"),
        (("--method", "point-to-plane", "--set", "anderson=5"), "--explain: anderson = 5"),
    ],
)
def test_explain_says_what_it_cannot_show(run, small, options, words):
    with pytest.raises(InvalidInputError, match=words):
        run(*small, "--explain", *options)


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
        (("--method", "icp"), "point-to-plane"),
        (("--method", "closed-form", "--voxel", "0.1"), "row i with row i: it takes no --voxel"),
        (("--method", "closed-form", "--set", "kernel=huber"), "it takes no --set"),
        (("--method", "closed-form", "--global"), "it takes no --global"),
        (("--global", "--init", "T.txt"), "leave out --init"),
        (("--global", "--explain"), "leave out --global"),
        (("--threads", "0"), "greater than or equal to 1|in the range x>=1"),
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
    with pytest.raises(typer.BadParameter) as error:
        run(*clouds, option, value)
    assert error.value.message == f"{option}: expected a positive number of metres, got {value}"


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
            ("--out", "a.e57", r"must end in \.ply or \.pcd or .*, got '\.e57'"),
            ("--out", "a.obj", r"must end in \.ply or \.pcd or .*, got '\.obj'"),
            ("--out", "a", r"must end in \.ply or .*, got a name without ending"),
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


class TestBadInput:
    """What a newcomer gives: an exit code, one line where there is no answer, and never a NaN."""

    @pytest.fixture
    def command(self, capsys, clouds):
        """Run the whole command line with one of the inputs replaced; the other is a good cloud."""

        def call(name, content, *options, replaced=0):
            files = list(clouds)
            files[replaced] = clouds[0].parent / name
            if isinstance(content, bytes):
                files[replaced].write_bytes(content)
            elif content is not None:
                np.save(files[replaced], content)
            capsys.readouterr()
            code = command_line(["register", *map(str, files), "--json", *map(str, options)])
            return code, *capsys.readouterr()

        return call

    HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\n"

    @pytest.mark.parametrize(
        ("name", "content", "words"),
        [
            ("a.ply", HEADER + b"property float z\nend_header\n" + bytes(120), "promises 1000000000000 x vertex"),
            ("a.ply", b"\x89PNG", "not a PLY file"),
            ("a.ply", b"", "not a PLY file"),
            ("none.ply", None, "no such file"),
            ("a.obj", b"v 1 2 3", "cannot read '.obj'"),
            ("a.csv", b"1,2,3\n4,5\n", "line 2: expected 3 columns"),
            ("a.csv", b"1,2\n3,4\n5,6\n", "is 2-D and"),
            ("a.npy", np.zeros((5, 4)), "got 4"),
        ],
    )
    def test_a_file_that_is_none_is_one_line(self, command, name, content, words):
        code, out, err = command(name, content)
        assert (code, out) == (1, "")
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        assert words in err

    @pytest.mark.parametrize("options", [(), ("--method", "point-to-point"), ("--method", "gicp")])
    @pytest.mark.parametrize("replaced", [0, 1])
    @pytest.mark.parametrize(
        "points",
        [
            np.zeros((0, 3)),
            np.ones((1, 3)),
            np.ones((400, 3)),
            np.column_stack([np.linspace(0, 1, 400), np.zeros((400, 2))]),
            np.full((50, 3), np.nan),
            np.random.default_rng(0).normal(size=(500, 3)) + 1000,
        ],
        ids=["empty", "one", "coincident", "line", "nan", "far"],
    )
    def test_points_without_an_answer_exit_with_3(self, command, points, replaced, options):
        code, out, err = command("odd.npy", points, *options, replaced=replaced)
        figures = json.loads(out, parse_constant=lambda name: pytest.fail(name))  # NaN and Infinity are no JSON
        assert code == 3
        assert figures["status"] in ("too_few_correspondences", "degenerate", "no_overlap")
        assert figures["note"]
        assert "Traceback" not in err

    def test_rows_that_are_not_finite_are_counted(self, command, clouds):
        points = read_ply(clouds[0]).points_m.copy()
        points[::10] = np.inf
        code, out, err = command("holes.npy", points)
        assert code == 0
        np.testing.assert_allclose(json.loads(out)["T_target_source"], T, atol=1e-6)
        assert "90 of 900 points are not finite and were dropped" in err

    @pytest.mark.parametrize(
        "options", [("--threads", 0), ("--method", "icp"), ("--no-such",), ("--global", "--explain")]
    )
    def test_wrong_usage_exits_with_2(self, command, clouds, options):
        code, out, err = command(clouds[0].name, None, *options)
        assert (code, out) == (2, "")
        assert "Traceback" not in err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line(clouds):
    """Standard output that takes nothing."""
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "scanweld", "register", *map(str, clouds)],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == "error: [Errno 28] No space left on device"
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")
def test_a_reader_may_leave(clouds):
    done = subprocess.run(
        ["/bin/sh", "-c", f"'{sys.executable}' -m scanweld register '{clouds[0]}' '{clouds[1]}' | head -1"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.startswith("status ")
    assert "Traceback" not in done.stderr


def test_help_names_every_option(run):
    text = re.sub(r"\x1b\[[0-9;]*m", "", run("--help")[1])
    for option in ("--method", "--scale", "--init", "--global", "--voxel", "--max-distance", "--set", "--threads",
                   "--explain", "--plot", "--out", "--json"):  # fmt: skip
        assert option in text
