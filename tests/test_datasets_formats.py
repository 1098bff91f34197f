"""Every format on a sequence that the test writes: pairing, time, intrinsics, unit, truth, errors."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest

from scanweld.arrays import Float64
from scanweld.datasets.icl_nuim import read_povray_camera
from scanweld.datasets.open import open_sequence
from scanweld.errors import DatasetError, FileFormatError
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.io.trajectory_files import read_trajectory
from written_sequences import (
    HEIGHT,
    WIDTH,
    color_rgb,
    depth_units,
    poses,
    tum_lines,
    write_camera,
    write_frame,
    write_image,
    write_redwood,
    write_seven_scenes,
    write_tum,
)


def scaled_from_vga(fx: float, fy: float, cx: float, cy: float) -> PinholeCamera:
    """640x480 intrinsics at 16x12, 1/40 of the size: cx' = (cx + 0.5) / 40 - 0.5."""
    return PinholeCamera(fx / 40, fy / 40, (cx + 0.5) / 40 - 0.5, (cy + 0.5) / 40 - 0.5, WIDTH, HEIGHT)


def assert_camera(camera: PinholeCamera, expected: PinholeCamera) -> None:
    np.testing.assert_allclose(camera.matrix, expected.matrix, rtol=1e-12)
    assert camera.shape == expected.shape


def assert_frame(frame: object, index: int, depth_scale: float) -> None:
    """The frame holds the images that the writer made for `index`."""
    np.testing.assert_allclose(frame.depth_m, depth_units(index, depth_scale) / depth_scale, rtol=1e-6)  # type: ignore[attr-defined]
    assert np.abs(frame.color.astype(int) - color_rgb(index)).max() < 4  # type: ignore[attr-defined]


# --- Redwood --------------------------------------------------------------------------------------


@pytest.mark.parametrize("color", ["image", "color", "rgb"])
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("first", [0, 1])
def test_redwood(tmp_path: Path, color: str, suffix: str, first: int) -> None:
    sequence = open_sequence(write_redwood(tmp_path / "room", color=color, suffix=suffix, first=first))
    assert sequence.name == "room"
    assert len(sequence) == 4
    assert_camera(sequence.camera, scaled_from_vga(525, 525, 319.5, 239.5))
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(4) / 30)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.T_world_camera, poses(4), atol=1e-12)
    for index, frame in enumerate(sequence):
        assert_frame(frame, index, 1000)
        assert frame.timestamp_s == index / 30


def test_redwood_part_of_a_sequence_keeps_its_time(tmp_path: Path) -> None:
    sequence = open_sequence(write_redwood(tmp_path, first=90))
    np.testing.assert_allclose(sequence.timestamps_s, 3 + np.arange(4) / 30)


def test_redwood_trajectory_log_gives_each_frame_its_pose(tmp_path: Path) -> None:
    """A log has no times: with as many poses as frames, pose i belongs to frame i whatever its number."""
    write_redwood(tmp_path, first=90)
    (tmp_path / "groundtruth.txt").unlink()
    blocks = [f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(str, row)) for row in T) for i, T in enumerate(poses(4))]
    (tmp_path / "trajectory.log").write_text("\n".join(blocks))
    sequence = open_sequence(tmp_path)
    assert sequence.ground_truth is not None
    np.testing.assert_array_equal(sequence.ground_truth.timestamps_s, sequence.timestamps_s)
    np.testing.assert_allclose(sequence.ground_truth.T_world_camera, poses(4), atol=1e-12)


def test_redwood_other_log_that_is_no_trajectory_is_passed_over(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_redwood(tmp_path)
    (tmp_path / "groundtruth.txt").unlink()
    (tmp_path / "recorder.log").write_text("started\n")
    assert open_sequence(tmp_path).ground_truth is None
    assert "no ground truth" in caplog.text


def test_redwood_numbering_that_differs_by_one_is_paired_by_order(tmp_path: Path) -> None:
    """Colour 1..4 and depth 0..3: equal numbers would pair every depth image with the colour before it."""
    write_redwood(tmp_path)
    for n in (3, 2, 1, 0):
        (tmp_path / f"color/{n:05d}.jpg").rename(tmp_path / f"color/{n + 1:05d}.jpg")
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 4
    assert_frame(sequence.read(2), 2, 1000)


def test_redwood_images_without_partner_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_redwood(tmp_path)
    (tmp_path / "color/00001.jpg").unlink()
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 3
    assert_frame(sequence.read(1), 2, 1000)
    assert "1 images without a partner" in caplog.text


def test_redwood_names_with_microseconds(tmp_path: Path) -> None:
    """The Redwood scans name files `number-microseconds`; the two clocks differ."""
    for i in range(3):
        write_frame(
            tmp_path / f"depth/{i + 1:07d}-{i * 33333:012d}.png",
            tmp_path / f"rgb/{i + 1:07d}-{i * 33400:012d}.jpg",
            i,
            1000,
        )
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 3
    assert_frame(sequence.read(2), 2, 1000)


def test_two_files_of_one_number_are_an_error(tmp_path: Path) -> None:
    write_redwood(tmp_path)
    shutil.copy(tmp_path / "depth/00001.png", tmp_path / "depth/1.png")
    with pytest.raises(DatasetError, match="same number"):
        open_sequence(tmp_path)


# --- 7-Scenes -------------------------------------------------------------------------------------


def test_seven_scenes_with_gaps(tmp_path: Path) -> None:
    sequence = open_sequence(write_seven_scenes(tmp_path / "chess"))
    assert sequence.name == "chess"
    assert_camera(sequence.camera, scaled_from_vga(585, 585, 320, 240))
    np.testing.assert_allclose(sequence.timestamps_s, np.array([0, 1, 2, 5]) / 30)
    assert_frame(sequence.read(3), 5, 1000)
    assert sequence.ground_truth is not None
    np.testing.assert_array_equal(sequence.ground_truth.timestamps_s, sequence.timestamps_s)
    np.testing.assert_allclose(sequence.ground_truth.T_world_camera[3], poses(6)[5], atol=1e-12)


@pytest.mark.parametrize("name", ["intrinsics.K.txt", "camera-intrinsics.txt"])
def test_seven_scenes_intrinsics_file(tmp_path: Path, name: str) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / name).write_text("15.4 0 7.46\n0 15.5 6.2\n0 0 1\n")
    assert_camera(open_sequence(tmp_path).camera, PinholeCamera(15.4, 15.5, 7.46, 6.2, WIDTH, HEIGHT))
    write_camera(tmp_path)
    assert open_sequence(tmp_path).camera.fx == 13.0, "camera.json wins"


@pytest.mark.parametrize("text", ["1 0\n0 1\n", "15 0 7\n0 15 6\n0 0 2\n", "a b c\n0 1 0\n0 0 1\n", ""])
def test_intrinsics_file_that_is_no_camera_matrix(tmp_path: Path, text: str) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "intrinsics.K.txt").write_text(text)
    with pytest.raises(DatasetError, match=r"intrinsics[.]K[.]txt"):
        open_sequence(tmp_path)


def test_seven_scenes_lost_poses_have_no_truth(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "frame-000001.pose.txt").write_text("-inf -inf -inf -inf\n" * 3 + "-inf -inf -inf -inf\n")
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 4
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s * 30, [0, 2, 5])
    assert "1 of 4 true poses" in caplog.text


def test_seven_scenes_pose_that_is_not_rigid_is_an_error(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    np.savetxt(tmp_path / "frame-000002.pose.txt", np.diag([2.0, 2, 2, 1]))
    with pytest.raises(FileFormatError, match=r"frame-000002[.]pose[.]txt.*not a rigid pose"):
        open_sequence(tmp_path)


# --- TUM ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "intrinsics"),
    [
        ("rgbd_dataset_freiburg1_desk", (517.3, 516.5, 318.6, 255.3)),
        ("fr2_xyz", (520.9, 521.0, 325.1, 249.7)),
        ("tum-FR3-office", (535.4, 539.2, 320.1, 247.6)),
    ],
)
def test_tum(tmp_path: Path, name: str, intrinsics: tuple[float, float, float, float]) -> None:
    sequence = open_sequence(write_tum(tmp_path / name))
    assert_camera(sequence.camera, scaled_from_vga(*intrinsics))
    np.testing.assert_allclose(sequence.timestamps_s, [round(1000 + i / 30, 6) for i in range(4)], atol=1e-9)
    for index, frame in enumerate(sequence):
        assert_frame(frame, index, 5000)
    assert sequence.ground_truth is not None
    assert len(sequence.ground_truth) == 16, "the whole truth at its own rate"


def test_tum_of_an_unknown_camera_warns(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sequence = open_sequence(write_tum(tmp_path / "frozen_fr4"))
    assert_camera(sequence.camera, scaled_from_vga(525, 525, 319.5, 239.5))
    assert "--camera" in caplog.text
    caplog.clear()
    open_sequence(tmp_path / "frozen_fr4", camera=(13, 13, 7, 5))
    write_camera(tmp_path / "frozen_fr4")
    open_sequence(tmp_path / "frozen_fr4")
    assert caplog.text == ""


def test_tum_associates_the_nearest_and_counts_the_rest(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Depth at 0, 33, 67 and 100 ms, colour at 5, 40, 45 and 200 ms.

    40 is nearer to 33 than 45 is, and the depth at 67 ms gets nothing, because 45 is 22 ms away.
    """
    write_tum(tmp_path / "fr1")
    names = [line.split()[1] for line in (tmp_path / "fr1/rgb.txt").read_text().splitlines()[1:]]
    times = [1000.005, 1000.040, 1000.045, 1000.2]
    lines = [f"{time:.3f} {name}" for time, name in zip(times, names, strict=True)]
    (tmp_path / "fr1/rgb.txt").write_text("\n".join(lines))
    with caplog.at_level(logging.INFO):
        sequence = open_sequence(tmp_path / "fr1")
    assert len(sequence) == 2
    assert_frame(sequence.read(1), 1, 5000)
    assert "2 depth and 2 colour images have no partner" in caplog.text


@pytest.mark.parametrize("depth_first", [True, False])
def test_tum_associations_file_in_either_order(tmp_path: Path, depth_first: bool) -> None:
    folder = write_tum(tmp_path / "fr1")
    depth = (folder / "depth.txt").read_text().splitlines()[1:]
    color = (folder / "rgb.txt").read_text().splitlines()[1:]
    (folder / "depth.txt").unlink()
    (folder / "rgb.txt").unlink()
    pairs = zip(depth, color, strict=True) if depth_first else zip(color, depth, strict=True)
    (folder / "associations.txt").write_text("\n".join(f"{a} {b}" for a, b in pairs))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.timestamps_s[1], 1000.033333)
    assert_frame(sequence.read(3), 3, 5000)


@pytest.mark.parametrize("path", ["../outside.png", "/etc/passwd", "depth/../../x.png", "C:\\x.png"])
def test_tum_paths_stay_inside_the_folder(tmp_path: Path, path: str) -> None:
    folder = write_tum(tmp_path / "fr1")
    (folder / "depth.txt").write_text(f"# depth\n1000.0 {path}\n")
    with pytest.raises(DatasetError, match=r"depth[.]txt, line 2: .* leaves the sequence folder"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1000.1 depth/a.png\n1000.0 depth/b.png\n", "line 2: timestamp 1000.000000 is before .* sort"),
        ("1000.1 depth/a.png\n# x\n1000.1 depth/b.png\n", "line 3: timestamp 1000.100000 repeats .* remove"),
        ("1000.1\n", "line 1: expected `timestamp path`"),
        ("nan depth/a.png\n", "line 1: expected a timestamp"),
        ("depth/a.png 1000.1\n", "line 1: expected a timestamp"),
        ("500.0 depth/a.png\n", "no depth image within 0.02 s .* one clock"),
        ("", "empty"),
    ],
)
def test_tum_lists_that_are_wrong(tmp_path: Path, text: str, words: str) -> None:
    folder = write_tum(tmp_path / "fr1")
    (folder / "depth.txt").write_text(text)
    with pytest.raises(DatasetError, match=words):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1000.5 0 0 nan 0 0 0 1", "not finite"),
        ("1000.5 0 0 0 0 0 0 2", "quaternion has norm 2"),
        ("999 0 0 0 0 0 0 1", "is before"),
        ("1000.15 0 0 0 0 0 0 1", "repeats"),
    ],
)
def test_tum_truth_that_is_wrong_names_its_line(tmp_path: Path, line: str, words: str) -> None:
    folder = write_tum(tmp_path / "fr1")
    with (folder / "groundtruth.txt").open("a") as file:
        file.write(line + "\n")
    with pytest.raises(FileFormatError, match=rf"groundtruth[.]txt, line 18: .*{words}"):
        open_sequence(folder)


def test_tum_color_without_depth(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1")
    (folder / "depth.txt").unlink()
    with pytest.raises(DatasetError, match=r"rgb[.]txt without depth[.]txt"):
        open_sequence(folder)


# --- ICL-NUIM -------------------------------------------------------------------------------------


def project_icl(point_world: Float64, T_icl: Float64) -> Float64:
    """The dataset's own projection: K with fy = -480, camera x right, y up, z forward."""
    p = se3.transform_points(se3.inverse(T_icl), point_world)
    return np.array([481.2 * p[0] / p[2] + 319.5, -480 * p[1] / p[2] + 239.5])


def icl_pose(rng: np.random.Generator) -> Float64:
    T = se3.exp(rng.normal(scale=0.2, size=6))
    T[2, 3] -= 2.25
    return T


def test_icl_truth_agrees_with_the_dataset_s_projection(tmp_path: Path) -> None:
    """A point projected by the dataset's convention (fy = -480) and by ours (fy = +480) lands on one pixel.

    Our world is the dataset's with y turned over, so the same physical point is (x, -y, z) there.
    """
    rng = np.random.default_rng(3)
    T_icl = np.stack([icl_pose(rng) for _ in range(3)])
    folder = tmp_path / "living_room_traj2_frei_png"
    q = se3.quaternion_xyzw_from_rotation(T_icl[:, :3, :3])
    lines = [" ".join(map(repr, [i + 1, *T[:3, 3].tolist(), *q[i].tolist()])) for i, T in enumerate(T_icl)]
    for n in (0, 1, 2, 3):
        write_frame(folder / f"depth/{n}.png", folder / f"rgb/{n}.png", n, 5000)
    (folder / "associations.txt").write_text("".join(f"{n} depth/{n}.png {n} rgb/{n}.png\n" for n in range(4)))
    (folder / "livingRoom2.gt.freiburg").write_text("\n".join(lines))
    sequence = open_sequence(folder)
    assert_camera(sequence.camera, scaled_from_vga(481.2, 480, 319.5, 239.5))
    np.testing.assert_array_equal(sequence.timestamps_s, [0, 1, 2, 3])
    assert_frame(sequence.read(2), 2, 5000)
    truth = sequence.ground_truth
    assert truth is not None
    np.testing.assert_array_equal(truth.timestamps_s, [1, 2, 3])
    camera = PinholeCamera(481.2, 480, 319.5, 239.5, 640, 480)
    for i in range(3):
        in_camera = np.array([0.3, -0.2, 2.0])
        point_icl = se3.transform_points(T_icl[i], in_camera)
        point = point_icl * [1, -1, 1]
        pixel, inside = camera.project(se3.transform_points(se3.inverse(truth.T_world_camera[i]), point))
        assert inside
        np.testing.assert_allclose(pixel, project_icl(point_icl, T_icl[i]), atol=1e-9)
        assert np.linalg.det(truth.T_world_camera[i, :3, :3]) == pytest.approx(1)


def test_icl_without_lists_pairs_by_number(tmp_path: Path) -> None:
    for n in (1, 2, 10):
        write_frame(tmp_path / f"depth/{n}.png", tmp_path / f"rgb/{n}.png", n, 5000)
    (tmp_path / "traj0.gt.freiburg").write_text(tum_lines([1, 2, 10], poses(3)))
    sequence = open_sequence(tmp_path)
    np.testing.assert_array_equal(sequence.timestamps_s, [1, 2, 10])
    assert_frame(sequence.read(2), 10, 5000)


def test_icl_two_truths_are_an_error(tmp_path: Path) -> None:
    write_redwood(tmp_path, color="rgb")
    for name in ("a.gt.freiburg", "b.gt.freiburg"):
        (tmp_path / name).write_text(tum_lines([1], poses(1)))
    with pytest.raises(DatasetError, match=r"a[.]gt[.]freiburg, b[.]gt[.]freiburg"):
        open_sequence(tmp_path)


def povray_text(position: Float64, direction: Float64, up: Float64) -> str:
    def row(name: str, v: Float64) -> str:
        return f"{name:12} = [{v[0]!r}, {v[1]!r}, {v[2]!r}]';"

    vectors = (
        ("cam_pos", position),
        ("cam_dir", direction),
        ("cam_up", up),
        ("cam_right", np.array([1.33, 0, 0])),
    )
    return "\n".join(row(name, [float(x) for x in v]) for name, v in vectors) + "\ncam_angle    = 90;\n"  # type: ignore[arg-type]


def test_icl_original_layout(tmp_path: Path) -> None:
    """A wall at z = 2 m straight ahead: the file holds 2 |ray|, the frame 2 everywhere."""
    camera = scaled_from_vga(481.2, 480, 319.5, 239.5)
    distance = 2 * np.linalg.norm(camera.rays(), axis=-1)
    position = np.array([1.0, 1.5, -0.5])
    for n in range(3):
        stem = tmp_path / f"scene_00_{n:04d}"
        write_image(Path(f"{stem}.png"), color_rgb(n))
        Path(f"{stem}.depth").write_text(" ".join(f"{d:.9f}" for d in distance.ravel()))
        text = povray_text(position + np.array([0.1 * n, 0, 0]), np.array([0, 0, 1.0]), np.array([0, 1.0, 0]))
        Path(f"{stem}.txt").write_text(text)
    sequence = open_sequence(tmp_path)
    assert_camera(sequence.camera, camera)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(3) / 30)
    frame = sequence.read(1)
    np.testing.assert_allclose(frame.depth_m, 2, rtol=1e-6)
    np.testing.assert_array_equal(frame.color, color_rgb(1))
    assert sequence.ground_truth is not None
    expected = np.tile(np.eye(4), (3, 1, 1))
    expected[:, :3, 3] = [[1.0 + 0.1 * n, -1.5, -0.5] for n in range(3)]
    np.testing.assert_allclose(sequence.ground_truth.T_world_camera, expected, atol=1e-12)


def test_povray_camera_by_hand(tmp_path: Path) -> None:
    """Looking along +z, a point 0.5 right, 0.25 above and 2 ahead is at v = 239.5 - 480 * 0.125 = 179.5.

    With y down that point is (1.5, -2.25, 5) in the world and at y = -0.25 in the camera.
    """
    path = tmp_path / "c.txt"
    path.write_text(povray_text(np.array([1.0, 2, 3]), np.array([0, 0, 1.0]), np.array([0, 1.0, 0])))
    T = read_povray_camera(path)
    np.testing.assert_allclose(T[:3, 3], [1, -2, 3])
    pixel, inside = PinholeCamera(481.2, 480, 319.5, 239.5, 640, 480).project(
        se3.transform_points(se3.inverse(T), np.array([1.5, -2.25, 5]))
    )
    assert inside
    np.testing.assert_allclose(pixel, [319.5 + 481.2 * 0.25, 179.5])


def test_povray_cameras_agree_with_the_published_poses(tmp_path: Path, shared_data: Path) -> None:
    """kt0 begins at (1.3705, 1.51739, 1.44963) looking along (-0.0218, 0, -0.99976): its first 3x4 rows."""
    path = tmp_path / "c.txt"
    path.write_text(
        povray_text(np.array([1.3705, 1.51739, 1.44963]), np.array([-0.021799, 0, -0.999762]), np.array([0, 1.0, 0]))
    )
    rows = read_trajectory(shared_data / "camera_paths/icl_nuim_lr_kt0_gt_poses_1508x3x4.txt", format="icl")
    np.testing.assert_allclose(read_povray_camera(path), rows.T_world_camera[0], atol=2e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("cam_pos = [1, 2, 3]';\n", "cam_dir"),
        ("cam_pos = [1, 2]';\ncam_dir = [0,0,1]';\ncam_up = [0,1,0]';", "cam_pos"),
        ("cam_pos = [1, 2, x]';\ncam_dir = [0,0,1]';\ncam_up = [0,1,0]';", "cam_pos"),
        ("cam_pos = [1, 2, nan]';\ncam_dir = [0,0,1]';\ncam_up = [0,1,0]';", "cam_pos"),
        ("cam_pos = [1, 2, 3]';\ncam_dir = [0,2,0]';\ncam_up = [0,1,0]';", "parallel"),
    ],
)
def test_povray_camera_that_is_wrong(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "c.txt"
    path.write_text(text)
    with pytest.raises(DatasetError, match=words):
        read_povray_camera(path)


# --- recorded sequences ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "count", "fx", "median_m"),
    [
        ("livingroom1", 211, 525, 1.8),
        ("livingroom1_noisy", 5, 525, 1.8),
        ("shelf_realsense", 50, 615.195, 0.41),
    ],
)
def test_recorded_sequences_open(shared_data: Path, name: str, count: int, fx: float, median_m: float) -> None:
    sequence = open_sequence(shared_data / name)
    assert len(sequence) == count
    assert sequence.ground_truth is not None
    assert len(sequence.ground_truth) == count
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, sequence.timestamps_s, atol=1e-5)
    assert sequence.camera.fx == pytest.approx(fx, abs=1e-3)
    depth = sequence.read(0).depth_m
    assert np.median(depth[depth > 0]) == pytest.approx(median_m, rel=0.05)
