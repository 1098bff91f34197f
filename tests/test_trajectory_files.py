"""Trajectory files: what is written reads back exactly, every format is known, errors name their line."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanweld.errors import FileFormatError, InvalidInputError, OutputError
from scanweld.geometry import se3
from scanweld.io.trajectory_files import (
    flip_y_axes,
    read_pose,
    read_trajectory,
    write_kitti,
    write_redwood_log,
    write_tum,
)
from scanweld.trajectory import Trajectory

WRITERS = {"tum": write_tum, "kitti": write_kitti, "redwood": write_redwood_log}


def random_trajectory(seed: int, count: int = 7, start_s: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(seed)
    times = start_s + np.cumsum(rng.uniform(1e-3, 1, size=count))
    return Trajectory(times, se3.exp(rng.normal(scale=2, size=(count, 6))))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1305031098.6659]))
def test_tum_round_trip(tmp_path: Path, seed: int, start_s: float) -> None:
    """Golden 4: write then read, error below 1e-9; timestamps come back to the bit."""
    trajectory = random_trajectory(seed, start_s=start_s)
    write_tum(tmp_path / "t.txt", trajectory)
    back = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_array_equal(back.timestamps_s, trajectory.timestamps_s)
    assert np.abs(back.T_world_camera - trajectory.T_world_camera).max() < 1e-9


@pytest.mark.parametrize("suffix", ["", ".gz"])
@pytest.mark.parametrize("format", ["kitti", "redwood"])
def test_matrix_formats_round_trip(tmp_path: Path, format: str, suffix: str) -> None:
    """They keep the poses to the last bits (rotations are made orthonormal on reading), and no times."""
    trajectory = random_trajectory(5)
    path = tmp_path / f"t.txt{suffix}"
    WRITERS[format](path, trajectory)
    for requested in ("auto", format):
        back = read_trajectory(path, format=requested)
        np.testing.assert_allclose(back.T_world_camera, trajectory.T_world_camera, atol=1e-14)
        np.testing.assert_allclose(back.timestamps_s, np.arange(7) / 30)


def test_tum_layout_by_hand(tmp_path: Path) -> None:
    """90 degrees about z is the quaternion (0, 0, sin 45, cos 45); it maps camera x to world y."""
    path = tmp_path / "t.txt"
    path.write_text("# comment\n\n1.5 1 2 3 0 0 0.70710678118654752 0.70710678118654752\n")
    T = read_trajectory(path).T_world_camera[0]
    np.testing.assert_allclose(T, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)


def test_tum_takes_commas_tabs_and_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_bytes("\ufeff0,1,2,3,0,0,0,1\r\n1\t1 2\t3 0 0 0 1\r\n".encode())
    assert len(read_trajectory(tmp_path / "t.txt")) == 2


def test_quaternions_of_four_digits_are_normalised(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("0 0 0 0 0.6132 0.5962 -0.3311 -0.3986\n")
    rotation = read_trajectory(tmp_path / "t.txt").T_world_camera[0, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


def test_matrices_of_four_digits_are_made_orthonormal(tmp_path: Path) -> None:
    T = random_trajectory(1).T_world_camera
    lines = [" ".join(f"{v:.4f}" for v in pose[:3].ravel()) for pose in T]
    (tmp_path / "t.txt").write_text("\n".join(lines))
    back = read_trajectory(tmp_path / "t.txt").T_world_camera
    assert np.abs(back - T).max() < 2e-4


@pytest.mark.parametrize("height", [3, 4])
def test_blocks_of_rows(tmp_path: Path, height: int) -> None:
    """ICL-NUIM prints three lines of four numbers a pose, with a blank line between."""
    T = random_trajectory(2).T_world_camera
    blocks = ["\n".join(" ".join(map(repr, row)) for row in pose[:height].tolist()) for pose in T]
    (tmp_path / "t.txt").write_text("\n\n".join(blocks) + "\n")
    np.testing.assert_allclose(read_trajectory(tmp_path / "t.txt").T_world_camera, T, atol=1e-14)


@pytest.mark.parametrize("name", ["livingRoom2.gt.freiburg", "livingRoom0n.gt.sim", "livingRoom0n.gt.sim.gz"])
def test_icl_files_are_turned_to_y_down(tmp_path: Path, name: str) -> None:
    """T = F T_file F: a camera 2 m up in their world is at y = -2 here, its rotation stays proper."""
    trajectory = random_trajectory(3)
    (write_tum if "freiburg" in name else write_kitti)(tmp_path / name, trajectory)
    back = read_trajectory(tmp_path / name)
    np.testing.assert_allclose(back.T_world_camera, flip_y_axes(trajectory.T_world_camera), atol=1e-12)
    np.testing.assert_allclose(back.positions_m, trajectory.positions_m * [1, -1, 1], atol=1e-12)
    raw = read_trajectory(tmp_path / name, format="tum" if "freiburg" in name else "kitti")
    np.testing.assert_allclose(raw.T_world_camera, trajectory.T_world_camera, atol=1e-12)
    np.testing.assert_allclose(flip_y_axes(back.T_world_camera), raw.T_world_camera, atol=1e-15)


GOOD = "0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no pose"),
        ("# nothing\n", "holds no pose"),
        (GOOD + "1 0 0 zero 0 0 0 1\n", "line 2: not numbers: '1 0 0 zero"),
        (GOOD + "1 0 0 0 0 0 0\n", "line 2: expected 8 numbers .*, got 7"),
        (GOOD + "\n1 0 0 nan 0 0 0 1\n", "line 3: a value is not finite"),
        (GOOD + "1 0 0 0 0 0 0 0\n", "line 2: the quaternion has norm 0"),
        (GOOD + "1 0 0 0 1 0 0 1\n", "line 2: the quaternion has norm 1.414"),
        (GOOD + "0 0 0 0 0 0 0 1\n", "line 2: timestamp 0.000000 repeats 0.000000 .*remove"),
        (GOOD + "-1 0 0 0 0 0 0 1\n", "line 2: timestamp -1.000000 is before 0.000000 .*sort"),
        ("1 2 3 4 5\n", "line 1: 5 numbers; expected 8"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0\n", "line 2: expected 12 numbers, got 4"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", r"line 1: not a rigid pose .*det R = -1"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n", "line 1: not a rigid pose .*scale"),
        ("1 0 0 0 0 1 0 0 0 0 1 inf\n", "line 1: a value is not finite"),
        ("1 0 0 0\n0 1 0 0\n", "2 lines are no multiple of 3"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n", "4 lines are no multiple of 3"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n", "4 lines are no multiple of 5"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n", "line 2: not a rigid pose"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1\n0 0 0 1\n", "line 4: expected 4 numbers, got 3"),
    ],
)
def test_a_malformed_file_names_its_line(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(FileFormatError, match=rf"bad[.]txt.*{words}") as caught:
        read_trajectory(tmp_path / "bad.txt")
    assert "\n" not in str(caught.value)


def test_a_redwood_header_in_the_wrong_place(tmp_path: Path) -> None:
    block = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    (tmp_path / "bad.log").write_text("0 0 1\n" + block + "0 0 0 1\n" + block)
    with pytest.raises(FileFormatError, match="line 6: expected three integers"):
        read_trajectory(tmp_path / "bad.log")


@pytest.mark.parametrize(
    "content", [b"\x1f\x8b\x08\x00rubbish", gzip.compress(b"0 0 0 0 0 0 0 1\n" * 99, mtime=0)[:-9]]
)
def test_damaged_gzip(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "t.gz").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"t[.]gz: cannot be read"):
        read_trajectory(tmp_path / "t.gz")


def test_what_is_no_text_file(tmp_path: Path) -> None:
    (tmp_path / "binary.txt").write_bytes(bytes(range(128, 256)))
    for path, words in (
        (tmp_path / "none.txt", "no such file"),
        (tmp_path, "is a folder"),
        (tmp_path / "binary.txt", "not a text"),
    ):
        with pytest.raises(FileFormatError, match=words):
            read_trajectory(path)


def test_gzip_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """100 kB of zeros pack into a few hundred bytes; with the limit at 1 kB they must not be unpacked."""
    monkeypatch.setattr("scanweld.io.trajectory_files.MAX_BYTES", 1024)
    (tmp_path / "bomb.gz").write_bytes(gzip.compress(b"0 " * 50_000))
    with pytest.raises(FileFormatError, match="larger than"):
        read_trajectory(tmp_path / "bomb.gz")


def test_unknown_format_names_the_known(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="'euroc' is not known; known are auto, tum, kitti, redwood, icl"):
        read_trajectory(tmp_path / "t.txt", format="euroc")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(alphabet="0123456789 .-+einfaNx#,\n\t", max_size=200))
def test_any_text_is_read_or_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "any.txt").write_text(text)
    try:
        trajectory = read_trajectory(tmp_path / "any.txt")
    except FileFormatError:
        return
    assert len(trajectory) > 0


@pytest.mark.parametrize("write", WRITERS.values())
def test_a_failed_write_leaves_nothing(tmp_path: Path, write: Callable[[Path, Trajectory], None]) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/file").touch()
    for target in (tmp_path / "missing/t.txt", tmp_path / "taken"):
        with pytest.raises(OutputError, match="cannot be written"):
            write(target, random_trajectory(0))
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_writing_replaces_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("old")
    write_tum(path, random_trajectory(0))
    assert len(read_trajectory(path)) == 7
    assert [p.name for p in tmp_path.iterdir()] == ["t.txt"]


def test_the_same_bytes_twice(tmp_path: Path) -> None:
    for name in ("a.txt.gz", "b.txt.gz"):
        write_tum(tmp_path / name, random_trajectory(0))
    assert (tmp_path / "a.txt.gz").read_bytes() == (tmp_path / "b.txt.gz").read_bytes()


def test_read_pose(tmp_path: Path) -> None:
    T = random_trajectory(4).T_world_camera[0]
    np.savetxt(tmp_path / "p.txt", T)
    pose = read_pose(tmp_path / "p.txt")
    assert pose is not None
    np.testing.assert_allclose(pose, T, atol=1e-14)
    (tmp_path / "p.txt").write_text("-inf -inf -inf -inf\n" * 4)
    assert read_pose(tmp_path / "p.txt") is None
    (tmp_path / "p.txt").write_text("1 2 3\n")
    with pytest.raises(FileFormatError, match="4x4"):
        read_pose(tmp_path / "p.txt")


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("freiburg1_xyz-groundtruth.txt", 3000),
        ("freiburg1_xyz-rgbdslam.txt", 788),
        ("icl_nuim_lr_kt0_gt_poses_1508x3x4.txt", 1508),
        ("redwood_office2_traj_gt.log.gz", 2538),
    ],
)
def test_recorded_paths(shared_data: Path, name: str, count: int) -> None:
    assert len(read_trajectory(shared_data / "camera_paths" / name)) == count
