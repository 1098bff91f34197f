"""A run folder: complete or absent, what its files hold, and what is said about a run."""

from __future__ import annotations

import csv
import json
import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, MemorySequence, blind, rendered
from scanweld.config import load_toml
from scanweld.io.atomic import write_file
from scanweld.mapping.rendering import BACKGROUND
from scanweld.runs import output
from scanweld.runs.folder import check_writable, next_run_folder, write_folder
from scanweld.runs.run import RunSummary, summarise

VIEWS = ("view-1", "view-2", "view-3", "overview")
FILES = {
    "config.toml", "trajectory.txt", "map.ply", "metrics.json", "frames.csv", "run.json",
    *(f"renders/{view}-{kind}.png" for view in VIEWS for kind in ("rgb", "normals")),
    "plots/tracking.png", "plots/trajectory.png", "groundtruth.txt", "keyframes.csv", "report.html",
}  # fmt: skip
METRICS = {
    "frames", "frames_tracked", "frames_lost", "relocalisations", "loop_closures", "ate_rmse_m", "ate_max_m",
    "rpe_trans_m", "rpe_rot_deg", "num_surfels", "num_points_input", "compression_ratio", "ms_per_frame_median", "fps",
    "peak_rss_mb", "seconds_total",
}  # fmt: skip
EXTRAS = {
    "frames_unreadable", "frames_dropped", "path_length_m", "submaps_joined", "submaps_unjoined",
    "frames_in_unjoined_submaps",
}  # fmt: skip


def files_of(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def troubled(count: int = 14) -> MemorySequence:
    """Frames 3 and 9 cannot be decoded, 5 and 6 are blind."""
    sequence = rendered(count=40).part(0, count)
    frames = sequence.frames
    return sequence.with_frames({3: None, 9: None, 5: blind(frames[5]), 6: blind(frames[6])})


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunSummary]:
    folder = tmp_path_factory.mktemp("runs") / "troubled"
    config = sw.SlamConfig(seed=5, tracking=sw.TrackingConfig(stable_fraction=0.9))
    summary = sw.run_sequence(troubled(), config, out=folder, description={"input": "memory"})
    return folder, summary


class TestFolder:
    def test_holds_what_the_interface_says(self, run_folder: tuple[Path, RunSummary]) -> None:
        folder, _ = run_folder
        assert files_of(folder) == FILES
        assert [path.name for path in folder.parent.iterdir()] == ["troubled"]

    def test_trajectory_has_a_line_for_every_frame_at_full_precision(self, run_folder: tuple[Path, RunSummary]) -> None:
        folder, summary = run_folder
        lines = [line for line in (folder / "trajectory.txt").read_text().splitlines() if not line.startswith("#")]
        sequence = troubled()
        assert len(lines) == len(sequence) == 14
        np.testing.assert_allclose([float(line.split()[0]) for line in lines], sequence.timestamps_s, atol=1e-9)
        read = sw.read_trajectory(folder / "trajectory.txt")
        for k in (0, 1, 2, 4, 7, 8, 10, 13):
            np.testing.assert_allclose(read.T_world_camera[k], summary.results[k].T_world_camera, atol=1e-9)

    def test_frames_without_a_pose_are_interpolated_and_marked(self, run_folder: tuple[Path, RunSummary]) -> None:
        folder, summary = run_folder
        rows = list(csv.DictReader((folder / "frames.csv").read_text().splitlines()))
        states = [row["status"] for row in rows]
        expected = ["tracking"] * 14
        expected[3] = expected[9] = "unreadable"
        expected[5] = expected[6] = "lost"
        expected[7] = "relocalised"
        assert states == expected
        assert [int(row["frame"]) for row in rows] == list(range(14))
        assert rows[3]["note"] == "frame 3 is damaged"
        assert rows[5]["alignment"] == "too_few_correspondences"
        required = {"timestamp", "status", "rmse", "inliers", "overlap", "surfels", "ms_track", "ms_fuse"}
        assert required <= set(rows[0])
        for row, result in zip(rows, summary.results, strict=True):
            assert float(row["timestamp"]) == result.timestamp_s
            assert float(row["rmse"]) == pytest.approx(result.rmse_m, rel=1e-6)
            assert (int(row["inliers"]), int(row["surfels"])) == (result.num_inliers, result.num_surfels)
        read = sw.read_trajectory(folder / "trajectory.txt").T_world_camera
        gap = read[7][:3, 3] - read[4][:3, 3]
        for k in (5, 6):
            np.testing.assert_allclose(read[k][:3, 3], read[4][:3, 3] + gap * (k - 4) / 3, atol=1e-3)

    def test_metrics(self, run_folder: tuple[Path, RunSummary]) -> None:
        folder, summary = run_folder
        metrics = json.loads((folder / "metrics.json").read_text())
        assert set(metrics) == METRICS | EXTRAS
        assert metrics == summary.metrics
        counts = {key: metrics[key] for key in ("frames", "frames_tracked", "frames_lost", "frames_unreadable")}
        assert counts == {"frames": 14, "frames_tracked": 10, "frames_lost": 2, "frames_unreadable": 2}
        assert metrics["relocalisations"] == 1
        points = sum(int(np.count_nonzero(f.depth_m)) for f in troubled().frames if f is not None)
        assert metrics["num_points_input"] == points
        assert metrics["num_surfels"] == len(summary.map)
        assert metrics["compression_ratio"] == pytest.approx(points / len(summary.map))
        assert 0 < metrics["ate_rmse_m"] < metrics["ate_max_m"] < 0.01
        assert 0 < metrics["rpe_trans_m"] < 0.01
        assert 0 < metrics["rpe_rot_deg"] < 0.5
        assert metrics["fps"] == pytest.approx(1e3 / metrics["ms_per_frame_median"])
        assert metrics["seconds_total"] > 0
        assert 50 < metrics["peak_rss_mb"] < 10_000

    def test_map_is_written_as_it_is(self, run_folder: tuple[Path, RunSummary]) -> None:
        folder, summary = run_folder
        with (folder / "map.ply").open("rb") as file:
            header = file.read(2000).split(b"end_header")[0].decode()
        names = re.findall(r"property \w+ (\w+)", header)
        assert "format binary_little_endian" in header
        assert names == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "radius", "confidence"]
        assert f"element vertex {len(summary.map)}" in header
        cloud = sw.read_ply(folder / "map.ply")
        np.testing.assert_allclose(cloud.points_m, summary.map.positions_m.T, atol=1e-7)

    def test_config_and_description(self, run_folder: tuple[Path, RunSummary]) -> None:
        folder, _ = run_folder
        config = sw.from_mapping(sw.SlamConfig, load_toml(folder / "config.toml"))
        assert config == sw.SlamConfig(seed=5, tracking=sw.TrackingConfig(stable_fraction=0.9))
        run = json.loads((folder / "run.json").read_text())
        assert {"scanweld", "python", "platform", "seed", "threads", "input"} <= set(run)
        assert (run["seed"], run["input"], run["interrupted"]) == (5, "memory", False)
        assert any("frame 3 is skipped" in warning for warning in run["warnings"])

    def test_renders_show_the_map(self, run_folder: tuple[Path, RunSummary]) -> None:
        folder, _ = run_folder
        for path in (folder / "renders").iterdir():
            image = cv2.imread(str(path))
            assert image.shape[1] / image.shape[0] == CAMERA.width / CAMERA.height
            assert image.shape[1] >= CAMERA.width
            filled = (image != BACKGROUND).any(axis=2).mean()
            assert filled > (0.15 if "overview" in path.name else 0.8), path.name
        # The first view is from the second tenth of the path: it looks like the frame that was taken there.
        seen = cv2.imread(str(folder / "renders/view-1-rgb.png"))[..., ::-1]
        seen = cv2.resize(seen, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
        drawn = (seen != BACKGROUND).any(axis=2)
        a, b = (cv2.blur(image, (3, 3))[drawn].astype(float) for image in (seen, troubled().frames[1].color))
        shifted = np.roll(cv2.blur(seen, (3, 3)), 8, axis=1)[drawn].astype(float)
        assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.85
        assert np.corrcoef(shifted.ravel(), b.ravel())[0, 1] < 0.7

    def test_tracked_only(self, tmp_path: Path) -> None:
        sw.run_sequence(troubled(), out=tmp_path / "run", tracked_only=True)
        read = sw.read_trajectory(tmp_path / "run/trajectory.txt")
        kept = [k for k in range(14) if k not in (3, 5, 6, 9)]
        np.testing.assert_allclose(read.timestamps_s, troubled().timestamps_s[kept], atol=1e-9)
        assert len((tmp_path / "run/frames.csv").read_text().splitlines()) == 15

    def test_without_truth_the_errors_are_null(self, tmp_path: Path) -> None:
        sw.run_sequence(replace(rendered(count=40).part(0, 3), ground_truth=None), out=tmp_path / "run")
        metrics = json.loads((tmp_path / "run/metrics.json").read_text())
        for key in ("ate_rmse_m", "ate_max_m", "rpe_trans_m", "rpe_rot_deg"):
            assert metrics[key] is None
        assert files_of(tmp_path / "run") == FILES - {"groundtruth.txt"}

    def test_single_frame(self, tmp_path: Path) -> None:
        sw.run_sequence(rendered(count=40).part(0, 1), out=tmp_path / "run")
        text = (tmp_path / "run/metrics.json").read_text()
        assert "NaN" not in text
        assert json.loads(text)["frames"] == 1
        assert files_of(tmp_path / "run") == FILES

    def test_most_frames_unreadable(self, tmp_path: Path) -> None:
        sequence = rendered(count=40).part(0, 12)
        summary = sw.run_sequence(sequence.with_frames(dict.fromkeys(range(3, 12))), out=tmp_path / "run")
        assert files_of(tmp_path / "run") == FILES
        assert not summary.trustworthy


class TestCompleteOrAbsent:
    def test_existing_run_is_kept_without_force(self, tmp_path: Path) -> None:
        sequence, folder = rendered(count=40).part(0, 2), tmp_path / "run"
        sw.run_sequence(sequence, out=folder)
        before = (folder / "metrics.json").read_bytes()
        calls: list[object] = []
        with pytest.raises(sw.OutputError, match="--force"):
            sw.run_sequence(sequence, out=folder, progress=calls.append)
        assert calls == []  # told before any work is done
        assert (folder / "metrics.json").read_bytes() == before
        (folder / "extra.txt").write_text("from the old run")
        sw.run_sequence(sequence, out=folder, force=True)
        assert files_of(folder) == FILES
        assert [path.name for path in tmp_path.iterdir()] == ["run"]

    def test_two_runs_at_once_into_one_folder(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        """The one that ends later does not replace the other, and is not lost."""
        sequence, folder = rendered(count=40).part(0, 3), tmp_path / "run"

        def another(result: sw.FrameResult) -> None:
            if result.index == 1:
                sw.run_sequence(sequence.part(0, 2), out=folder)

        summary = sw.run_sequence(sequence, out=folder, progress=another)
        assert summary.folder == tmp_path / "run-1"
        assert "another run was written there meanwhile; this one is in" in caplog.text
        frames = [json.loads((place / "metrics.json").read_text())["frames"] for place in (folder, summary.folder)]
        assert frames == [2, 3]

    def test_force_does_not_replace_something_else(self, tmp_path: Path) -> None:
        folder = tmp_path / "thesis"
        folder.mkdir()
        (folder / "chapter1.tex").write_text("years of work")
        with pytest.raises(sw.OutputError, match="not a run folder"):
            sw.run_sequence(rendered(count=40).part(0, 2), out=folder, force=True)
        assert (folder / "chapter1.tex").read_text() == "years of work"

    def test_empty_folder_is_used(self, tmp_path: Path) -> None:
        (tmp_path / "run").mkdir()
        sw.run_sequence(rendered(count=40).part(0, 2), out=tmp_path / "run")
        assert files_of(tmp_path / "run") == FILES

    @pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt(), ValueError("bug")])
    @pytest.mark.parametrize("where", ["write_ply", "plot_tracking", "write_renders", "_write_json"])
    def test_nothing_is_left_after_a_failure(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, error: BaseException
    ) -> None:
        def fail(*args: object, **kwargs: object) -> None:
            raise error

        monkeypatch.setattr(output, where, fail)
        expected = sw.OutputError if isinstance(error, OSError) else type(error)
        with pytest.raises(expected, match="No space" if isinstance(error, OSError) else None):
            sw.run_sequence(rendered(count=40).part(0, 2), out=tmp_path / "run")
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("write", [lambda path: path.write_bytes(b""), lambda path: write_file(path, b"")])
    def test_the_folder_aside_is_not_named(self, tmp_path: Path, write: Callable[[Path], object]) -> None:
        """What cannot be written is told by the name that it would have had in the end."""
        expected = f"{tmp_path / 'run' / 'absent' / 'map.ply'}: cannot be written: No such file"
        with pytest.raises(sw.OutputError, match=re.escape(expected)), write_folder(tmp_path / "run", force=False) as f:
            write(f / "absent" / "map.ply")

    def test_old_run_survives_a_failure(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        folder = tmp_path / "run"
        sw.run_sequence(rendered(count=40).part(0, 2), out=folder)
        before = {path: (folder / path).read_bytes() for path in files_of(folder)}
        with monkeypatch.context() as patch:
            patch.setattr(output, "write_ply", lambda *a: (_ for _ in ()).throw(OSError(28, "No space left")))
            with pytest.raises(sw.OutputError):
                sw.run_sequence(rendered(count=40).part(0, 3), out=folder, force=True)
        assert {path: (folder / path).read_bytes() for path in files_of(folder)} == before
        assert list(tmp_path.iterdir()) == [folder]

    def test_old_run_survives_when_the_new_one_cannot_take_its_place(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder = tmp_path / "run"
        folder.mkdir()
        (folder / "run.json").write_text("old")
        rename = Path.rename

        def refuse_new(self: Path, target: Path) -> Path:
            if Path(target) == folder and not self.name.endswith(".old"):
                raise OSError(1, "Operation not permitted")
            return rename(self, target)

        monkeypatch.setattr(Path, "rename", refuse_new)
        with pytest.raises(sw.OutputError, match="cannot be written"), write_folder(folder, force=True) as aside:
            (aside / "run.json").write_text("new")
        assert (folder / "run.json").read_text() == "old"
        assert list(tmp_path.iterdir()) == [folder]

    def test_place_that_is_a_file(self, tmp_path: Path) -> None:
        (tmp_path / "run").write_text("a file")
        for folder in (tmp_path / "run", tmp_path / "run/below"):
            with pytest.raises(sw.OutputError, match="run"):
                sw.run_sequence(rendered(count=40).part(0, 2), out=folder)
        assert (tmp_path / "run").read_text() == "a file"

    def test_read_only_place(self, tmp_path: Path) -> None:
        place = tmp_path / "locked"
        place.mkdir()
        place.chmod(0o500)
        try:
            (place / "probe").touch()
        except PermissionError:
            pass
        else:
            place.chmod(0o700)
            pytest.skip("this user may write anywhere")
        try:
            with pytest.raises(sw.OutputError, match="--out"):
                sw.run_sequence(rendered(count=40).part(0, 2), out=place / "run")
        finally:
            place.chmod(0o700)

    def test_symlink_to_a_run_is_followed(self, tmp_path: Path) -> None:
        sequence = rendered(count=40).part(0, 2)
        sw.run_sequence(sequence, out=tmp_path / "real")
        (tmp_path / "latest").symlink_to(tmp_path / "real")
        sw.run_sequence(sequence, out=tmp_path / "latest", force=True)
        assert files_of(tmp_path / "latest") == FILES
        assert sorted(path.name for path in tmp_path.iterdir()) == ["latest", "real"]

    def test_current_folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """It cannot be renamed away from under the shell: refused, with nothing written."""
        work = tmp_path / "work"
        (work / "deep").mkdir(parents=True)
        monkeypatch.chdir(work / "deep")
        for folder in (Path("."), Path("..")):
            with pytest.raises(sw.OutputError, match="--out"):
                sw.run_sequence(rendered(count=40).part(0, 2), out=folder)
        assert files_of(work) == set()

    def test_permissions_are_those_of_the_users_files(self, tmp_path: Path) -> None:
        (tmp_path / "plain").mkdir()
        with write_folder(tmp_path / "run", force=False) as aside:
            (aside / "run.json").write_text("{}")
        assert (tmp_path / "run").stat().st_mode == (tmp_path / "plain").stat().st_mode

    def test_check_leaves_nothing_behind(self, tmp_path: Path) -> None:
        check_writable(tmp_path / "run", force=False)
        assert list(tmp_path.iterdir()) == []

    def test_next_free_number(self, tmp_path: Path) -> None:
        assert next_run_folder("desk", tmp_path) == tmp_path / "desk-1"
        (tmp_path / "desk-1").mkdir()
        (tmp_path / "desk-3").mkdir()
        assert next_run_folder("desk", tmp_path) == tmp_path / "desk-2"


class TestInterrupt:
    def test_what_was_done_is_kept(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        def stop(result: sw.FrameResult) -> None:
            if result.index == 4:
                raise KeyboardInterrupt

        with caplog.at_level(logging.WARNING):
            summary = sw.run_sequence(rendered(count=40), out=tmp_path / "run", progress=stop)
        assert summary.interrupted
        assert len(summary.results) == 5
        assert "interrupted after 5 of 40 frames" in caplog.text
        assert files_of(tmp_path / "run") == FILES
        assert len(sw.read_trajectory(tmp_path / "run/trajectory.txt")) == 5
        run = json.loads((tmp_path / "run/run.json").read_text())
        assert run["interrupted"] is True
        assert "interrupted after 5 of 40 frames" in run["warnings"]

    def test_before_the_first_frame_nothing_is_written(self, tmp_path: Path) -> None:
        class Impatient(MemorySequence):
            def read(self, index: int) -> sw.Frame:
                raise KeyboardInterrupt

        sequence = rendered(count=40)
        values = {name: getattr(sequence, name) for name in MemorySequence.__dataclass_fields__}
        with pytest.raises(KeyboardInterrupt):
            sw.run_sequence(Impatient(**values), out=tmp_path / "run")
        assert list(tmp_path.iterdir()) == []

    def test_before_anything_was_tracked_it_is_an_interrupt_still(self, tmp_path: Path) -> None:
        def stop(result: sw.FrameResult) -> None:
            raise KeyboardInterrupt

        sequence = rendered(count=40).part(0, 3)
        with pytest.raises(KeyboardInterrupt):
            sw.run_sequence(sequence.with_frames({0: blind(sequence.frames[0])}), out=tmp_path / "run", progress=stop)
        assert list(tmp_path.iterdir()) == []


class TestTrust:
    @pytest.mark.parametrize(
        ("lost", "trusted"), [((), True), ((1, 2, 3), True), (tuple(range(1, 6)), False), ((8,), False), ((9,), False)]
    )
    def test_ended_lost_or_half_of_the_frames(self, lost: tuple[int, ...], trusted: bool) -> None:
        """Of ten frames, 9 unreadable: five tracked are enough, four are not; the last that was read must be."""
        sequence = rendered(count=40).part(0, 10)
        changes: dict[int, sw.Frame | None] = {k: blind(sequence.frames[k]) for k in lost}
        if 9 not in lost:
            changes[9] = None
        assert sw.run_sequence(sequence.with_frames(changes)).trustworthy is trusted

    def test_no_usable_frame_is_an_error_and_leaves_nothing(self, tmp_path: Path) -> None:
        sequence = rendered(count=40).part(0, 3)
        for changes in ({k: blind(sequence.frames[k]) for k in range(3)}, dict.fromkeys(range(3))):
            with pytest.raises(sw.DatasetError, match=r"no frame has usable depth|none of the 3 frames"):
                sw.run_sequence(sequence.with_frames(changes), out=tmp_path / "run")
            assert list(tmp_path.iterdir()) == []


class TestDepthUnit:
    @pytest.mark.parametrize(("factor", "likely"), [(5.0, "5000"), (1000.0, "1000"), (0.01, "100")])
    def test_wrong_unit_gets_a_warning_that_names_the_likely_one(
        self, caplog: pytest.LogCaptureFixture, factor: float, likely: str
    ) -> None:
        """The room has its median at 2 to 3 m; read `factor` times too large it is warned about once."""
        sequence = rendered(count=40).part(0, 4)
        wrong = {k: replace(f, depth_m=f.depth_m * np.float32(factor)) for k, f in enumerate(sequence.frames)}
        sequence = replace(sequence.with_frames(wrong), depth_scale=float(likely) / factor)
        config = sw.SlamConfig(surfaces=sw.SurfaceConfig(max_depth_m=1e5))
        with caplog.at_level(logging.WARNING):
            sw.run_sequence(sequence, config)
        told = [record.getMessage() for record in caplog.records if "--depth-scale" in record.getMessage()]
        assert len(told) == 1
        assert f"pass --depth-scale {likely}" in told[0]

    def test_damaged_first_frame_does_not_hide_it(self, caplog: pytest.LogCaptureFixture) -> None:
        sequence = rendered(count=40).part(0, 4)
        wrong: dict[int, sw.Frame | None] = {
            k: replace(f, depth_m=f.depth_m * np.float32(5)) for k, f in enumerate(sequence.frames)
        }
        with caplog.at_level(logging.WARNING):
            sw.run_sequence(
                replace(sequence.with_frames(wrong | {0: None}), depth_scale=1000.0),
                sw.SlamConfig(surfaces=sw.SurfaceConfig(max_depth_m=100.0)),
            )
        assert "pass --depth-scale 5000" in caplog.text

    def test_right_unit_gets_none(self, caplog: pytest.LogCaptureFixture) -> None:
        with caplog.at_level(logging.WARNING):
            sw.run_sequence(rendered(count=40).part(0, 3))
        assert caplog.text == ""


class TestGivenPoses:
    def test_frames_are_fused_at_the_nearest_pose(self, tmp_path: Path) -> None:
        sequence = rendered(count=40).part(0, 6)
        poses = rendered(count=40).ground_truth
        late = sw.Trajectory(poses.timestamps_s + 0.004, poses.T_world_camera)
        summary = sw.run_sequence(sequence, poses=late, out=tmp_path / "run")
        read = sw.read_trajectory(tmp_path / "run/trajectory.txt")
        np.testing.assert_allclose(read.T_world_camera, poses.T_world_camera[:6], atol=1e-9)
        np.testing.assert_allclose(read.timestamps_s, sequence.timestamps_s, atol=1e-9)
        assert summary.metrics["frames_tracked"] == 6

    def test_frame_without_a_pose_is_left_out(self) -> None:
        sequence, poses = rendered(count=40).part(0, 6), rendered(count=40).ground_truth
        summary = sw.run_sequence(sequence, poses=poses.subset([0, 1, 3, 4, 5]))
        states = [result.state.value for result in summary.results]
        assert states == ["tracking", "tracking", "unreadable", "tracking", "tracking", "tracking"]
        assert summary.results[2].note == "no given pose"

    def test_single_pose(self) -> None:
        sequence, poses = rendered(count=40).part(0, 3), rendered(count=40).ground_truth
        summary = sw.run_sequence(sequence, poses=poses.subset([1]))
        assert [r.state.value for r in summary.results] == ["unreadable", "tracking", "unreadable"]

    def test_no_poses_at_all(self) -> None:
        none = sw.Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        with pytest.raises(sw.InvalidInputError, match="the trajectory is empty"):
            sw.run_sequence(rendered(count=40).part(0, 3), poses=none)

    def test_frames_without_depth_leave_no_map_and_nothing_else(self, tmp_path: Path) -> None:
        sequence = rendered(count=40).part(0, 3)
        changes: dict[int, sw.Frame | None] = {k: blind(sequence.frames[k]) for k in range(3)}
        with pytest.raises(sw.DatasetError, match="the map is empty"):
            sw.run_sequence(sequence.with_frames(changes), poses=rendered(count=40).ground_truth, out=tmp_path / "run")
        assert list(tmp_path.iterdir()) == []

    def test_no_pose_belongs_to_a_frame(self) -> None:
        poses = rendered(count=40).ground_truth
        far = sw.Trajectory(poses.timestamps_s + 100, poses.T_world_camera)
        with pytest.raises(sw.InvalidInputError, match="none belongs to a frame"):
            sw.run_sequence(rendered(count=40).part(0, 3), poses=far)


def test_summary_of_a_truth_that_does_not_overlap_says_so(caplog: pytest.LogCaptureFixture) -> None:
    sequence = rendered(count=40)
    slam = sw.build_slam(CAMERA)
    for frame in sequence.frames[:2]:
        slam.process(frame)
    truth = sw.Trajectory(sequence.ground_truth.timestamps_s + 1000, sequence.ground_truth.T_world_camera)
    with caplog.at_level(logging.WARNING):
        metrics, error = summarise(slam, truth, 100)
    assert error is None
    assert metrics["ate_rmse_m"] is None
    assert "not evaluated" in caplog.text
