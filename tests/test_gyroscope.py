"""Gyroscopes: orientations from rates, the file layout, and what they do for tracking."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, pose_error, rendered, write_tum_folder
from scanweld.datasets.gyroscope import Gyroscope, HasGyroscope, gyroscope_of, read_gyroscope
from scanweld.datasets.open import open_sequence
from scanweld.datasets.selection import ResizedSequence, select
from scanweld.datasets.synthetic.paths import built_in_path
from scanweld.datasets.synthetic.scenarios import GyroscopeSequence, blackout, simulate_gyroscope
from scanweld.errors import DatasetError, InvalidInputError
from scanweld.geometry import se3
from scanweld.slam.rotation_aid import RotationAid
from scanweld.trajectory import FrameState

TILTED = se3.exp_so3([0.3, -1.0, 0.5])
"""A sensor that is worn on the camera at an angle of 66 degrees."""


def angle_deg(R: np.ndarray) -> float:
    return float(np.degrees(se3.rotation_angle_rad(R)))


class TestOrientations:
    def test_a_constant_rate(self) -> None:
        """1 rad/s about z: after 0.25 s it has turned by 0.25 rad; before and after the samples nothing is known."""
        gyroscope = Gyroscope(np.arange(11) / 10, np.tile([0.0, 0.0, 1.0], (11, 1)), np.eye(3))
        got = gyroscope.orientations(np.array([-0.1, 0.0, 0.25, 1.0, 1.1]))
        assert got[0] is None
        assert got[4] is None
        for R, turned in zip(got[1:4], (0.0, 0.25, 1.0), strict=True):
            np.testing.assert_allclose(R, se3.exp_so3([0.0, 0.0, turned]), atol=1e-12)

    def test_a_growing_rate(self) -> None:
        """w = 2 t about x turns by t^2, whatever the times of the samples."""
        times = np.array([0.0, 0.1, 0.15, 0.4, 0.9, 1.0])
        gyroscope = Gyroscope(times, np.outer(2 * times, [1.0, 0.0, 0.0]), np.eye(3))
        (R,) = gyroscope.orientations(np.array([0.7]))
        np.testing.assert_allclose(R, se3.exp_so3([0.49, 0.0, 0.0]), atol=1e-12)

    def test_axes_of_the_sensor(self) -> None:
        """The sensor's x is the camera's y: turning about x by the sensor is turning about y by the camera."""
        R_camera_imu = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        gyroscope = Gyroscope(np.array([0.0, 1.0]), np.tile([0.5, 0.0, 0.0], (2, 1)), R_camera_imu)
        (R,) = gyroscope.orientations(np.array([1.0]))
        np.testing.assert_allclose(R, se3.exp_so3([0.0, 0.5, 0.0]), atol=1e-12)

    @pytest.mark.parametrize("R_camera_imu", [np.eye(3), TILTED])
    def test_a_simulated_one_measures_the_path(self, R_camera_imu: np.ndarray) -> None:
        path = built_in_path("sweep", 60, 30.0)
        gyroscope = simulate_gyroscope(path, noise_rad_s=0.0, R_camera_imu=R_camera_imu)
        got = gyroscope.orientations(path.timestamps_s)
        true = path.T_world_camera[:, :3, :3]
        assert angle_deg(true[0].T @ true[-1]) > 20
        for k in range(60):
            assert got[k] is not None
            assert angle_deg((true[0].T @ true[k]).T @ got[0].T @ got[k]) < 0.05

    @pytest.mark.parametrize(
        ("times", "rates", "R", "message"),
        [
            ([0.0], [[0.0, 0, 0]], np.eye(3), "two or more"),
            ([0.0, 1.0], [[0.0, 0]] * 2, np.eye(3), "two or more"),
            ([0.0, 0.0], [[0.0, 0, 0]] * 2, np.eye(3), "time must increase"),
            ([0.0, 1.0], [[0.0, 0, np.nan]] * 2, np.eye(3), "not finite"),
            ([0.0, 1.0], [[0.0, 0, 0]] * 2, np.diag([1.0, 1, -1]), "no rotation"),
        ],
    )
    def test_what_is_none_is_refused(self, times: object, rates: object, R: np.ndarray, message: str) -> None:
        with pytest.raises(InvalidInputError, match=message):
            Gyroscope(np.array(times), np.array(rates), R)


class TestSequences:
    def test_a_folder_with_imu_txt(self, tmp_path: Path) -> None:
        folder = write_tum_folder(tmp_path / "seq", rendered(count=40).part(0, 3))
        assert gyroscope_of(open_sequence(folder)) is None
        (folder / "imu.txt").write_text("# t w a\n-1 0.1 0.2 0.3 0 0 9.8\n2 0.4 0.5 0.6 0 0 9.8\n")
        got = gyroscope_of(open_sequence(folder))
        assert got is not None
        np.testing.assert_array_equal(got.timestamps_s, [-1, 2])
        np.testing.assert_array_equal(got.rates_rad_s, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
        np.testing.assert_array_equal(got.R_camera_imu, np.eye(3))
        np.savetxt(folder / "R_camera_imu.txt", TILTED)
        np.testing.assert_allclose(read_gyroscope(folder).R_camera_imu, TILTED)  # type: ignore[union-attr]

    @pytest.mark.parametrize("text", ["1 2 3\n2 2 3\n", "2 0 0 0\n1 0 0 0\n", "a b c d\n"])
    def test_a_malformed_file_says_what_is_wrong(self, tmp_path: Path, text: str) -> None:
        (tmp_path / "imu.txt").write_text(text)
        with pytest.raises(DatasetError, match=r"imu\.txt: expected lines"):
            read_gyroscope(tmp_path)

    def test_it_goes_through_what_wraps_a_sequence(self) -> None:
        base = rendered(count=40)
        gyroscope = simulate_gyroscope(base.ground_truth)  # type: ignore[arg-type]
        worn = GyroscopeSequence(base, gyroscope)
        for sequence in (worn, select(worn, "1:9:2"), blackout(worn, 2), ResizedSequence(worn, 0.5)):
            assert isinstance(sequence, sw.RgbdSequence)
            assert isinstance(sequence, HasGyroscope)
            assert gyroscope_of(sequence) is gyroscope
        assert len(select(worn, "1:9:2")) == 4
        assert gyroscope_of(base) is None
        assert gyroscope_of(select(base, "1:9")) is None

    def test_a_run_uses_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        base = rendered(count=40).part(0, 4)
        gyroscope = simulate_gyroscope(base.ground_truth)  # type: ignore[arg-type]
        given = []
        process = sw.Slam.process

        def spy(self: sw.Slam, frame: sw.Frame, **kept: object) -> sw.FrameResult:
            given.append(kept["orientation"])
            return process(self, frame, **kept)  # type: ignore[arg-type]

        monkeypatch.setattr(sw.Slam, "process", spy)
        sw.run_sequence(GyroscopeSequence(base, gyroscope))
        np.testing.assert_array_equal(given, gyroscope.orientations(base.timestamps_s))
        given.clear()
        sw.run_sequence(base)
        assert given == [None] * 4


class TestAid:
    """A camera that turns to and fro about y, as a sine; the motion model expects it to stand still."""

    @staticmethod
    def follow(bias: object = (0, 0, 0), *, scale: float = 1.0, frames: int = 60) -> tuple[RotationAid, list[float]]:
        """Return the aid, and the angles between its predictions and the truth [degrees]."""
        aid, off, before = RotationAid(), [], np.eye(4)
        assert aid.turn(before) is before
        drift = np.eye(3)
        for k in range(frames):
            t = k / 30
            true = se3.exp([0, 0, 0, 0, 0.4 * np.sin(3 * t), 0])
            if k:
                step = se3.exp_so3(scale * se3.log_so3(before[:3, :3].T @ true[:3, :3]))
                drift = drift @ step @ se3.exp_so3(np.array(bias, float) / 30)
            predicted = aid.predict(t, before, drift)
            off.append(angle_deg(predicted[:3, :3].T @ true[:3, :3]))
            aid.observe(t, true, surely=True)
            before = true
        return aid, off

    def test_the_bias_is_found(self) -> None:
        aid, off = self.follow([0.05, -0.03, 0.08])
        assert aid.trusted
        np.testing.assert_allclose(aid.bias_rad_s, [0.05, -0.03, 0.08], atol=2e-3)
        assert max(off[10:]) < 0.02
        assert max(off[1:5]) > 1  # before it is known, the motion model's rotation stands

    @pytest.mark.parametrize("scale", [-1.0, 3.5])
    def test_a_wrong_one_is_left_alone(self, scale: float) -> None:
        aid, off = self.follow(scale=scale)
        assert not aid.trusted
        angles = 0.4 * np.sin(3 * np.arange(60) / 30)
        np.testing.assert_allclose(off, np.degrees(np.abs(np.diff(angles, prepend=0))), atol=1e-6)

    def test_a_gap_begins_anew(self) -> None:
        aid, _ = self.follow()
        model = se3.exp([1, 2, 3, 0.1, 0, 0])
        assert aid.predict(9.0, model, None) is model
        assert aid.predict(9.1, model, np.eye(3)) is model  # nothing was seen since: another reference, maybe

    def test_through_a_loss_and_a_correction(self) -> None:
        """While nothing is seen the orientation goes on, and a world that turns takes it along."""
        aid, _ = self.follow()
        end = aid._last[1]  # type: ignore[index]
        turned = aid.predict(2.1, np.eye(4), end @ se3.exp_so3([0.5, 0, 0]))
        further = aid.turn(np.eye(4))
        np.testing.assert_array_equal(turned, further)
        world = se3.exp([0, 0, 0, 0, 0, 1.0])
        aid.move(world)
        np.testing.assert_allclose(aid.turn(np.eye(4)), world @ turned, atol=1e-12)
        aid.forget()
        np.testing.assert_array_equal(aid.turn(np.eye(4)), np.eye(4))


@lru_cache(maxsize=1)
def jerks() -> sw.SyntheticSequence:
    """The camera looks around by 70 degrees, then jerks by 40 degrees from one frame to the next, four times."""
    yaws = list(np.linspace(0, 70, 22))
    for angle in (30, 70, 28, 66):
        yaws += [angle, angle + 0.5, angle + 1]
    start = built_in_path("sweep", 1, 30.0).T_world_camera[0]
    poses = [start @ se3.exp([0.004 * k, 0, 0.002 * k, 0, np.deg2rad(yaw), 0]) for k, yaw in enumerate(yaws)]
    config = sw.RenderConfig(width=CAMERA.width, height=CAMERA.height, noise="kinect")
    path = sw.Trajectory(np.arange(len(poses)) / 30, np.stack(poses))
    return sw.SyntheticSequence(config, trajectory=path)


@lru_cache(maxsize=1)
def jerked_frames() -> tuple[sw.Frame, ...]:
    return tuple(jerks())


def lost_frames(gyroscope: Gyroscope | None) -> list[int]:
    """Return the LOST frames of a run; every other one is where it should be."""
    frames, path = jerked_frames(), jerks().ground_truth
    turned = [None] * len(frames) if gyroscope is None else gyroscope.orientations(path.timestamps_s)
    slam = sw.build_slam(CAMERA)
    for frame, orientation in zip(frames, turned, strict=True):
        slam.process(frame, orientation=orientation)
    true = se3.inverse(path.T_world_camera[0]) @ path.T_world_camera
    for r in slam.results:
        if r.state is not FrameState.LOST:
            assert pose_error(r.T_world_camera, true[r.index])[0] < 8e-3
    return [r.index for r in slam.results if r.state is FrameState.LOST]


class TestJerks:
    def test_what_is_lost_to_the_eye_is_held_by_the_gyroscope(self) -> None:
        assert {22, 25, 28} <= set(lost_frames(None))
        worn = simulate_gyroscope(jerks().ground_truth, bias_rad_s=[0.05, -0.03, 0.08], R_camera_imu=TILTED)
        assert lost_frames(worn) == []

    def test_one_that_is_wrong_does_no_harm(self) -> None:
        path = jerks().ground_truth
        right = simulate_gyroscope(path)
        without = set(lost_frames(None))
        backwards = Gyroscope(right.timestamps_s, -right.rates_rad_s, np.eye(3))
        assert set(lost_frames(backwards)) <= without

    def test_an_orientation_is_checked(self) -> None:
        slam = sw.build_slam(CAMERA)
        with pytest.raises(InvalidInputError, match="orientation"):
            slam.process(jerked_frames()[0], orientation=np.diag([1.0, 1, -1]))
