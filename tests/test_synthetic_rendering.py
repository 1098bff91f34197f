"""The scenes and what is rendered of them: geometry, uprightness, determinism, paths, files."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from scanweld import parallel
from scanweld.arrays import Float32, Float64
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.open import open_sequence
from scanweld.datasets.synthetic import (
    PATHS,
    SCENES,
    RenderConfig,
    SyntheticSequence,
    build_scene,
    render_sequence,
)
from scanweld.datasets.synthetic.casting import cast_rays
from scanweld.datasets.synthetic.lighting import octahedral_directions
from scanweld.datasets.synthetic.paths import built_in_path, sample_trajectory
from scanweld.errors import ConfigError, FileFormatError, InvalidInputError, OutputError
from scanweld.geometry import se3
from scanweld.io.trajectory_files import write_kitti, write_redwood_log, write_tum
from scanweld.trajectory import Trajectory

SMALL = {"width": 160, "height": 120}
KT0 = Path("camera_paths") / "icl_nuim_lr_kt0_gt_poses_1508x3x4.txt"


@pytest.fixture(scope="module")
def room() -> SyntheticSequence:
    return SyntheticSequence(RenderConfig(**SMALL))


def _world_points(sequence: SyntheticSequence, index: int, depth_m: Float32) -> Float64:
    T = sequence.ground_truth.T_world_camera[index]
    return se3.transform_points(T, sequence.camera.back_project(depth_m).reshape(-1, 3))


@pytest.mark.parametrize("scene", list(SCENES))
def test_two_poses_agree_on_the_surface(scene: str) -> None:
    """Points of one frame, moved to another camera, lie on its surface or behind something nearer."""
    sequence = SyntheticSequence(RenderConfig(scene=scene, width=320, height=240))
    a, b = 40, 48
    color_a, depth_a = sequence.exact(a)
    color_b, _ = sequence.exact(b)
    points = _world_points(sequence, a, depth_a)
    T_b = sequence.ground_truth.T_world_camera[b]
    in_b = se3.transform_points(se3.inverse(T_b), points)
    pixel, inside = sequence.camera.project(in_b)
    # The exact surface along the very ray of each point, so that the test measures poses and depth, not
    # interpolation.
    distance, _ = cast_rays(build_scene(scene, 0), T_b[:3, 3], points - T_b[:3, 3])
    gap_m = (1 - distance) * np.linalg.norm(points - T_b[:3, 3], axis=1)
    visible = inside & (gap_m < 0.02)
    assert visible.sum() > 0.5 * len(points)
    assert (np.abs(gap_m[visible]) < 1e-3).mean() > 0.95
    assert np.abs(gap_m[inside]).min() < 1e-6
    assert gap_m[inside].min() > -1e-4  # nothing is ever behind a point that was seen
    # Colour does not depend on the view: the median difference of the nearest pixels is texture, not light.
    u, v = np.rint(pixel[visible]).astype(int).T
    difference = np.abs(color_b[v, u].astype(int) - color_a.reshape(-1, 3)[visible].astype(int))
    assert np.median(difference) <= 4


def test_frames_do_not_depend_on_threads_or_on_what_was_rendered_before(room: SyntheticSequence) -> None:
    noisy = RenderConfig(**SMALL, noise="kinect")
    before = parallel.get_num_threads()
    try:
        parallel.set_num_threads(1)
        one = SyntheticSequence(noisy).read(7)
        parallel.set_num_threads(2)
        sequence = SyntheticSequence(noisy)
        sequence.read(3)
        two = sequence.read(7)
    finally:
        parallel.set_num_threads(before)
    assert one.color is not None
    assert two.color is not None
    assert one.color.tobytes() == two.color.tobytes()
    assert one.depth_m.tobytes() == two.depth_m.tobytes()
    assert one.depth_m.tobytes() != room.read(7).depth_m.tobytes()


def test_a_seed_changes_noise_and_furnishing() -> None:
    a = SyntheticSequence(RenderConfig(**SMALL, path="sweep")).read(100)
    b = SyntheticSequence(RenderConfig(**SMALL, path="sweep", seed=1)).read(100)
    assert (a.depth_m != b.depth_m).any()


def test_the_room_looks_like_a_room(room: SyntheticSequence) -> None:
    """Many surfaces, many colours, no holes, geometry where a depth camera sees it."""
    for index in range(0, len(room), 60):
        frame = room.read(index)
        assert (frame.depth_m > 0).all()
        assert (frame.depth_m < 5.5).mean() > 0.95
        assert frame.color is not None
        assert frame.color.reshape(-1, 3).std(axis=0).min() > 25
        assert 50 < frame.color.mean() < 190
        assert (frame.color > 250).all(axis=2).mean() < 0.1
        directions = room.camera.rays().reshape(-1, 3) @ room.ground_truth.T_world_camera[index, :3, :3].T
        _, hit = cast_rays(build_scene("room", 0), room.ground_truth.positions_m[index], directions)
        assert len(np.unique(hit)) > 40


@pytest.mark.parametrize("name", list(PATHS))
def test_the_camera_keeps_clear_of_things_and_moves_like_a_hand(name: str) -> None:
    path = built_in_path(name, 0, 30.0)
    scene = build_scene(PATHS[name].scene, 0)
    directions = octahedral_directions(24).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    nearest = min(cast_rays(scene, p, directions)[0].min() for p in path.positions_m[::10])
    assert nearest > 0.4
    T = path.T_world_camera
    steps = se3.inverse(T[:-1]) @ T[1:]
    speed = np.linalg.norm(steps[:, :3, 3], axis=1) * 30
    turn_deg = np.rad2deg(se3.rotation_angle_rad(steps)) * 30
    assert speed.min() > 0.2
    assert speed.max() < 1.0
    assert turn_deg.max() < 40
    # One round and a little: the end has passed the start, at the pace of the frames.
    gap = np.linalg.norm(path.positions_m[len(path) // 2 :] - path.positions_m[0], axis=1)
    assert gap.min() < speed.max() / 30


def test_the_corridor_is_a_loop_of_at_least_30_m() -> None:
    path = built_in_path("loop", 0, 30.0)
    round_trip = round(len(path) / 1.06)
    assert path.subset(slice(0, round_trip)).path_length_m > 30
    T_close = se3.inverse(path.T_world_camera[0]) @ path.T_world_camera[round_trip]
    assert np.linalg.norm(T_close[:3, 3]) < 0.03
    assert se3.rotation_angle_rad(T_close) < math.radians(2)


def test_more_frames_only_extend_a_path_and_a_higher_rate_only_refines_it() -> None:
    short, long, fine = (
        built_in_path("orbit", 10, 30.0),
        built_in_path("orbit", 900, 30.0),
        built_in_path("orbit", 19, 60.0),
    )
    np.testing.assert_array_equal(short.T_world_camera, long.T_world_camera[:10])
    np.testing.assert_allclose(short.T_world_camera, fine.T_world_camera[::2], atol=1e-12)
    assert long.path_length_m == pytest.approx(0.6 * 899 / 30, rel=0.05)


def test_kt0_is_upright(shared_data: Path) -> None:
    """In ICL-NUIM's frame the heights are up: the floor must be at height 0 and in the lower rows.

    The motion is right when the camera's forward axis and its travel agree with the file's own, turned around
    in y.
    """
    config = RenderConfig(**SMALL, path=str(shared_data / KT0), path_frame="icl")
    sequence = SyntheticSequence(config)
    assert len(sequence) == 1508
    rows = np.loadtxt(shared_data / KT0).reshape(-1, 3, 4)
    truth = sequence.ground_truth
    np.testing.assert_allclose(truth.positions_m, rows[:, :, 3] * [1, -1, 1], atol=1e-12)
    np.testing.assert_allclose(truth.T_world_camera[:, :3, 2], rows[:, :, 2] * [1, -1, 1], atol=1e-3)
    assert np.linalg.det(truth.T_world_camera[:, :3, :3]).min() > 0.999
    # Frame 0 looks level along -z at the sofa wall.
    _, depth_m = sequence.exact(0)
    height = -_world_points(sequence, 0, depth_m)[:, 1].reshape(depth_m.shape)
    assert height[0].min() > 2.3  # ceiling at the top
    assert height[-1].max() < 1.0  # sofa and floor at the bottom
    assert (np.diff(height[:, ::20].mean(axis=1)) < 0.02).mean() > 0.95
    floor_rows, ceiling_rows = [], []
    for index in range(0, 1508, 58):
        _, depth_m = sequence.exact(index)
        height = -_world_points(sequence, index, depth_m)[:, 1].reshape(depth_m.shape)
        assert height.min() > -1e-3
        assert height.max() < 2.61
        floor_rows.extend(np.nonzero(height < 0.015)[0])
        ceiling_rows.extend(np.nonzero(height > 2.59)[0])
        assert depth_m.min() > 0.4
    assert np.mean(floor_rows) > 80 > 40 > np.mean(ceiling_rows)


def test_the_camera_of_kt0_keeps_clear_of_the_furniture(shared_data: Path) -> None:
    truth = SyntheticSequence(RenderConfig(path=str(shared_data / KT0), path_frame="icl")).ground_truth
    directions = octahedral_directions(24).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scene = build_scene("room", 0)
    assert min(cast_rays(scene, p, directions)[0].min() for p in truth.positions_m[::15]) > 0.4


def test_every_kind_of_path_file_gives_the_same_poses(tmp_path: Path) -> None:
    path = built_in_path("orbit", 6, 30.0)
    write_tum(tmp_path / "a.txt", path)
    write_kitti(tmp_path / "b.txt", path)
    write_redwood_log(tmp_path / "c.log.gz", path)
    for name in ("a.txt", "b.txt", "c.log.gz"):
        sequence = SyntheticSequence(RenderConfig(path=str(tmp_path / name)))
        assert len(sequence) == 6
        np.testing.assert_allclose(sequence.ground_truth.T_world_camera, path.T_world_camera, atol=1e-9)
    assert len(SyntheticSequence(RenderConfig(path=str(tmp_path / "a.txt"), frames=4))) == 4


def test_a_timed_path_is_sampled_on_its_own_clock() -> None:
    """Poses at 0, 1.5, 2.5 s moving 1 m/s along x: four a second lie at x = t."""
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = [0.0, 1.5, 2.5]
    sampled = sample_trajectory(Trajectory(np.array([10.0, 11.5, 12.5]), T), 4.0)
    np.testing.assert_allclose(sampled.timestamps_s, 10 + np.arange(11) / 4, atol=1e-6)
    np.testing.assert_allclose(sampled.positions_m[:, 0], np.arange(11) / 4, atol=1e-6)
    counted = sample_trajectory(Trajectory(np.array([1.0, 2.0, 3.0]), T), 30.0)
    np.testing.assert_array_equal(counted.T_world_camera, T)


def test_files_give_the_same_frames_as_memory(tmp_path: Path) -> None:
    config = RenderConfig(**SMALL, frames=3, noise="realsense", seed=4)
    calls: list[tuple[int, int]] = []
    written = render_sequence(tmp_path / "s", config, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s"]
    names = {"rgb", "depth", "rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt", "camera.json"}
    assert {p.name for p in (tmp_path / "s").iterdir()} == names
    assert (tmp_path / "s" / "associations.txt").read_text().splitlines()[1] == (
        "0.033333 rgb/0.033333.png 0.033333 depth/0.033333.png"
    )
    camera = json.loads((tmp_path / "s" / "camera.json").read_text())
    # 640x480 with 525 525 319.5 239.5, a quarter: cx' = 320 / 4 - 0.5.
    assert camera == {
        "fx": 131.25, "fy": 131.25, "cx": 79.5, "cy": 59.5,
        "width": 160, "height": 120, "depth_scale": 5000.0,
    }  # fmt: skip
    read = open_sequence(tmp_path / "s")
    memory = SyntheticSequence(config)
    assert isinstance(memory, RgbdSequence)
    assert len(read) == len(memory) == len(written) == 3
    assert read.camera == memory.camera
    for a, b in zip(read, memory, strict=True):
        assert a.color is not None
        assert b.color is not None
        assert a.timestamp_s == b.timestamp_s
        np.testing.assert_array_equal(a.depth_m, b.depth_m)
        np.testing.assert_array_equal(a.color, b.color)
    assert read.ground_truth is not None
    np.testing.assert_allclose(read.ground_truth.T_world_camera, memory.ground_truth.T_world_camera, atol=1e-14)
    np.testing.assert_array_equal(read.timestamps_s, memory.timestamps_s)


def test_depth_is_rounded_to_fifths_of_a_millimetre(room: SyntheticSequence) -> None:
    _, exact = room.exact(5)
    stored = room.read(5).depth_m
    assert np.abs(stored - exact).max() <= 0.5 / 5000 + 1e-6
    np.testing.assert_allclose(stored * 5000, np.rint(stored * 5000), atol=1e-2)


def test_other_sizes_keep_the_focal_length_by_width() -> None:
    wide = RenderConfig(width=320, height=160).camera()
    assert (wide.fx, wide.fy, wide.cx, wide.cy) == (262.5, 262.5, 159.5, 79.5)


def test_an_existing_folder_is_kept_without_force(tmp_path: Path) -> None:
    config = RenderConfig(width=32, height=24, frames=1)
    target = tmp_path / "s"
    target.mkdir()
    (target / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="--force"):
        render_sequence(target, config)
    with pytest.raises(OutputError, match="will not replace"):
        render_sequence(target, config, force=True)
    assert (target / "notes.txt").read_text() == "mine"
    (target / "notes.txt").unlink()
    render_sequence(target, config)  # an empty folder is free to use
    with pytest.raises(OutputError, match="not empty"):
        render_sequence(target, config)
    render_sequence(target, RenderConfig(width=32, height=24, frames=2), force=True)
    assert len(list((target / "rgb").iterdir())) == 2
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        render_sequence(tmp_path / "file", config)
    with pytest.raises(OutputError, match="cannot be written"):
        render_sequence(tmp_path / "file" / "s", config)


def test_nothing_is_left_of_a_rendering_that_fails(tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_sequence(tmp_path / "s", RenderConfig(width=32, height=24, frames=2), progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"scene": "castle"}, "scene = 'castle': expected one of room, corridor"),
        ({"noise": "lidar"}, "noise = 'lidar': expected one of none, kinect, realsense"),
        ({"path_frame": "up"}, "path_frame = 'up': expected one of cv, icl"),
        ({"frames": -3}, "frames = -3"),
        ({"width": 4}, "width = 4"),
        ({"fps": 0.0}, "fps = 0"),
    ],
)
def test_wrong_values_are_named(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        RenderConfig(**values)  # type: ignore[arg-type]
    assert message in str(caught.value)


def test_wrong_paths_are_named(tmp_path: Path) -> None:
    for path, message in (("figure", "orbit, sweep"), ("loop", "belongs to scene 'corridor'")):
        with pytest.raises(ConfigError, match=message):
            SyntheticSequence(RenderConfig(path=path))
    with pytest.raises(ConfigError, match="built-in path"):
        SyntheticSequence(RenderConfig(path="orbit", path_frame="icl"))
    (tmp_path / "bad.txt").write_text("hello\n")
    with pytest.raises(FileFormatError, match=r"bad\.txt"):
        SyntheticSequence(RenderConfig(path=str(tmp_path / "bad.txt")))
    write_tum(tmp_path / "short.txt", built_in_path("orbit", 3, 30.0))
    with pytest.raises(InvalidInputError, match="has 3 frames"):
        SyntheticSequence(RenderConfig(path=str(tmp_path / "short.txt"), frames=4))
    with pytest.raises(ConfigError, match="room, corridor"):
        build_scene("castle", 0)


def test_a_camera_outside_the_scene_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    T = np.eye(4)[None].copy()
    T[0, 2, 3] = 50.0
    write_tum(tmp_path / "far.txt", Trajectory(np.zeros(1), T))
    frame = SyntheticSequence(RenderConfig(**SMALL, path=str(tmp_path / "far.txt"))).read(0)
    assert (frame.depth_m == 0).all()
    assert "out of the scene" in caplog.text


def test_an_index_out_of_range_is_refused(room: SyntheticSequence) -> None:
    with pytest.raises(IndexError):
        room.read(len(room))


@pytest.mark.parametrize(("scene", "name"), [("room", "orbit"), ("corridor", "loop")])
def test_the_default_path_is_named_where_it_is_recorded(scene: str, name: str) -> None:
    config = RenderConfig(scene=scene, frames=2)
    sequence = SyntheticSequence(config)
    assert sequence.config.path == ""
    assert sequence.path_name == sequence.config.resolved().path == name
    assert SyntheticSequence(config.resolved()).name == sequence.name
    assert RenderConfig(path="sweep").resolved() == RenderConfig(path="sweep")
