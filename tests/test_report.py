"""The report's parts and its page as text; what a browser makes of it is in test_report_browser.py."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from importlib.resources import files as package_files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import scanweld as sw
from rendered import rendered
from scanweld.cli.app import run as run_command
from scanweld.errors import FileFormatError, OutputError
from scanweld.geometry import se3
from scanweld.report.charts import accuracy_charts, evaluate, tracking_charts
from scanweld.report.page import MAX_ROWS, make_page, write_report
from scanweld.report.plots import plot_tracking
from scanweld.report.run_files import (
    FrameTable,
    poses_of_frames,
    read_frames,
    read_keyframes,
    read_run_files,
)
from scanweld.report.scene import display_frame, encode_scene, select_points
from scanweld.report.settings import find_differences, marked_toml
from scanweld.report.stretches import find_stretches
from scanweld.report.verdict import DOUBTFUL, TRUSTWORTHY, UNTRUSTWORTHY, Verdict, judge
from scanweld.report.words import count_of, length, percent
from scanweld.runs import output
from scanweld.trajectory import FrameResult, FrameState
from written_runs import COUNT, corner, path, rows, write_frames, write_run_folder

EVIL = '</script><script>window.owned=1</script><img src=x onerror="window.owned=1">&\'"'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run_folder(tmp_path_factory.mktemp("report") / "run", error_m=0.004)


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return make_page(read_run_files(folder))


def table_of(tmp_path: Path, changes: dict[int, dict[str, object]] | None = None, count: int = COUNT) -> FrameTable:
    """Frames that were plainly tracked, but for some."""
    plain = [row | {"status": "tracking", "note": "", "alignment": "converged"} for row in rows(count)]
    for i, change in (changes or {}).items():
        plain[i] |= change
    write_frames(tmp_path, plain)
    return read_frames(tmp_path / "frames.csv")


class TestWords:
    def test_lengths_have_the_unit_that_fits(self) -> None:
        assert [length(v) for v in (0.0, 0.00009, 0.0035, 0.0421, 0.25, 36.7)] == [
            "0 mm", "0.09 mm", "3.5 mm", "42.1 mm", "0.25 m", "36.7 m",
        ]  # fmt: skip

    def test_shares_have_digits_that_say_something(self) -> None:
        assert [percent(v) for v in (1, 0.125, 0.0312, 0.00231, 0.000024)] == [
            "100 %", "12 %", "3.1 %", "0.23 %", "0.002 %",
        ]  # fmt: skip

    def test_counts(self) -> None:
        assert (count_of(1, "frame"), count_of(2500, "frame")) == ("1 frame", "2,500 frames")


class TestStretches:
    def test_what_happened_why_and_how_it_ended(self, folder: Path) -> None:
        """Five lost frames with alike notes are one line; the relocalised frame is its ending."""
        found = find_stretches(read_frames(folder / "frames.csv"))
        assert [(s.kind, s.first, s.last, s.count) for s in found] == [
            ("lost", 10, 14, 5), ("unreadable", 20, 20, 1), ("degenerate", 25, 26, 2),
        ]  # fmt: skip
        assert found[0].reasons == (("residual 0.010 m, usually below 0.0040 m; overlap 10%, usually above 60%", 5),)
        assert [s.ending for s in found] == ["found again at 15", "", ""]

    def test_different_reasons_are_counted(self, tmp_path: Path) -> None:
        notes = ["0 matches, fewer than 200", "7 matches, fewer than 200", "no keyframe fits"]
        frames = table_of(tmp_path, {37 + k: {"status": "lost", "note": note} for k, note in enumerate(notes)})
        (stretch,) = find_stretches(frames)
        assert stretch.reasons == (("0 matches, fewer than 200", 2), ("no keyframe fits", 1))
        assert stretch.ending == "the run ends here"

    def test_an_alignment_without_a_note_is_spelt_out(self, tmp_path: Path) -> None:
        (stretch,) = find_stretches(table_of(tmp_path, {4: {"alignment": "max_iterations"}}))
        assert (stretch.kind, stretch.reasons) == ("unfinished", (("max iterations", 1),))

    def test_frames_of_another_submap_are_not_of_this_map(self, tmp_path: Path) -> None:
        frames = table_of(
            tmp_path, {i: {"submap": 0} for i in range(COUNT)} | {i: {"submap": 1} for i in range(30, 40)}
        )
        (stretch,) = find_stretches(frames)
        assert (stretch.kind, stretch.first, stretch.last) == ("elsewhere", 30, 39)
        assert frames.posed.sum() == 30
        verdict = judge_table(frames)
        assert verdict.level == DOUBTFUL
        assert "10 frames were tracked in another submap" in verdict.reasons[0]


def judge_table(frames: FrameTable, ate_m: float | None = 0.001, **run: object) -> Verdict:
    """Judge a run of 10 m with these frames."""
    metrics = {"path_length_m": 10.0} | ({} if ate_m is None else {"ate_rmse_m": ate_m, "ate_max_m": 2 * ate_m})
    return judge(frames, metrics, run)


class TestVerdict:
    def test_plain_run(self, tmp_path: Path) -> None:
        verdict = judge_table(table_of(tmp_path))
        assert (verdict.level, verdict.advice) == (TRUSTWORTHY, ())
        assert verdict.reasons[0] == "All 40 frames were aligned with the map, and the camera was never lost."

    def test_without_truth_it_says_that_nothing_was_measured(self, tmp_path: Path) -> None:
        verdict = judge_table(table_of(tmp_path), None)
        assert verdict.level == TRUSTWORTHY
        assert "no ground truth" in verdict.reasons[-1]

    def test_lost_and_found_is_a_reservation(self, tmp_path: Path) -> None:
        lost = {i: {"status": "lost", "alignment": "too_few_correspondences"} for i in (5, 6, 7)}
        verdict = judge_table(table_of(tmp_path, lost | {8: {"status": "relocalised"}}))
        assert verdict.level == DOUBTFUL
        assert "lost in 3 of 40 frames and found again once" in verdict.reasons[0]
        assert "no usable depth" in verdict.advice[0]

    @pytest.mark.parametrize(("alignment", "word"), [("converged", "unlike"), ("no_overlap", "did not fit")])
    def test_advice_follows_the_cause(self, tmp_path: Path, alignment: str, word: str) -> None:
        lost = {5: {"status": "lost", "alignment": alignment, "note": "why"}, 6: {"status": "relocalised"}}
        assert word in judge_table(table_of(tmp_path, lost)).advice[0]

    def test_lost_at_the_end_is_not_to_be_trusted(self, tmp_path: Path) -> None:
        verdict = judge_table(table_of(tmp_path, {38: {"status": "lost"}, 39: {"status": "unreadable"}}))
        assert verdict.level == UNTRUSTWORTHY
        assert "lost at the end, for the last 2 frames" in verdict.reasons[0]

    def test_fewer_than_half_is_not_to_be_trusted(self, tmp_path: Path) -> None:
        verdict = judge_table(table_of(tmp_path, {i: {"status": "lost"} for i in range(10, 31)}))
        assert verdict.level == UNTRUSTWORTHY
        assert verdict.reasons[0] == "Only 19 of 40 frames were tracked, fewer than half."

    @pytest.mark.parametrize(("ate_m", "level"), [(0.09, TRUSTWORTHY), (0.11, DOUBTFUL), (0.51, UNTRUSTWORTHY)])
    def test_truth_has_the_last_word(self, tmp_path: Path, ate_m: float, level: str) -> None:
        """1 % and 5 % of a path of 10 m are 0.1 m and 0.5 m."""
        verdict = judge_table(table_of(tmp_path), ate_m)
        assert verdict.level == level
        assert any(f"off by {length(ate_m)}" in reason for reason in verdict.reasons)

    @pytest.mark.parametrize(
        ("changes", "run", "word"),
        [
            ({i: {"alignment": "degenerate"} for i in range(4)}, {}, "did not determine the motion"),
            ({i: {"alignment": "max_iterations"} for i in range(4)}, {}, "had not settled"),
            ({i: {"status": "unreadable"} for i in range(4, 6)}, {}, "2 frames could not be read"),
            ({}, {"interrupted": True, "warnings": ["interrupted after 40 of 90 frames"]}, "after 40 of 90 frames: it"),
            ({}, {"warnings": ["no intrinsics"]}, "warnings"),
        ],
    )
    def test_reservations(self, tmp_path: Path, changes: dict, run: dict, word: str) -> None:
        verdict = judge_table(table_of(tmp_path, changes), **run)
        assert verdict.level == DOUBTFUL
        assert any(word in reason for reason in verdict.reasons)


class TestScene:
    def test_thinning_is_even_confident_and_repeatable(self) -> None:
        """Of 60,000 points about 2,000 stay, one in each cell, and the most confident of those that share it."""
        columns = corner(60_000)
        points = select_points(columns, 2_000)
        assert 1_600 <= len(points.position_m) <= 2_000
        assert points.total == 60_000
        low = np.min([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
        cells = np.floor((points.position_m - low) / points.spacing_m).astype(int)
        assert len(np.unique(cells, axis=0)) == len(cells)
        every = np.floor((np.stack([columns[a] for a in "xyz"], 1).astype(np.float64) - low) / points.spacing_m)
        same = (every.astype(int) == cells[0]).all(axis=1)
        assert points.confidence[0] == columns["confidence"][same].max()
        again = select_points(columns, 2_000)
        np.testing.assert_array_equal(points.position_m, again.position_m)
        first, rest = points.position_m[:500], points.position_m[500:]
        np.testing.assert_allclose(first.mean(axis=0), rest.mean(axis=0), atol=0.25)  # any part is the whole, coarser

    def test_a_small_map_is_kept_whole(self) -> None:
        points = select_points(corner(300))
        assert (len(points.position_m), points.spacing_m) == (300, 0.0)

    def test_points_are_what_they_were_within_a_step(self) -> None:
        """16 bits over 4 m are steps of 0.06 mm."""
        points = select_points(corner(500))
        trajectory = path()
        scene, text = encode_scene(
            points, trajectory.T_world_camera, np.ones(COUNT, bool), camera=None,
            keyframes=np.empty(0, np.int64), loops=np.empty((0, 2), np.int64),
        )  # fmt: skip
        blob, n = base64.b64decode(text), scene["count"]
        assert len(blob) == 14 * n
        low, high = np.array(scene["low"]), np.array(scene["high"])
        grid = np.frombuffer(blob, "<u2", 3 * n).reshape(n, 3)
        T = display_frame(points.position_m, trajectory.T_world_camera)
        np.testing.assert_allclose(
            low + grid / 65535 * (high - low), se3.transform_points(T, points.position_m), atol=4.1 / 65535
        )
        confidence = np.frombuffer(blob, np.uint8, n, 7 * n) / 255 * scene["maxConfidence"]
        np.testing.assert_allclose(confidence, points.confidence, atol=0.2)
        np.testing.assert_array_equal(np.frombuffer(blob, np.uint8, 3 * n, 8 * n).reshape(n, 3), points.color)
        normal = np.frombuffer(blob, np.int8, 3 * n, 11 * n).reshape(n, 3) / 127
        np.testing.assert_allclose(normal, points.normal @ T[:3, :3].T, atol=0.01)

    def test_up_is_against_the_cameras_down(self) -> None:
        trajectory = path()
        T = display_frame(select_points(corner(500)).position_m, trajectory.T_world_camera)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
        np.testing.assert_allclose(T[:3, :3] @ [0, -1, 0], [0, 0, 1], atol=1e-9)

    @pytest.mark.parametrize("missing", [("radius",), ("confidence",), ("nx", "ny", "nz"), ("red",)])
    def test_columns_of_other_programs_may_be_missing(self, missing: tuple[str, ...]) -> None:
        columns = {name: values for name, values in corner(200).items() if name not in missing}
        assert len(select_points(columns).position_m) == 200

    def test_points_that_are_nowhere_are_left_out(self) -> None:
        columns = corner(200)
        columns["x"] = columns["x"].copy()
        columns["x"][:5] = np.nan
        assert len(select_points(columns).position_m) == 195

    def test_an_empty_map_makes_a_page(self, tmp_path: Path) -> None:
        write_run_folder(tmp_path, points=0)
        assert "All 0 surfels" in make_page(read_run_files(tmp_path))

    @pytest.mark.parametrize(
        ("doubtful", "most", "words"),
        [
            (0, 5_000, "All 3,000 surfels of the map are shown."),
            (40, 5_000, "2,960 of 3,000 surfels are shown: 40 that were seen about once, mostly noise, are left out."),
            (0, 1_000, r"[\d,]+ of 3,000 surfels are shown: they are thinned evenly to one in [\d.]+ m?m\."),
            (
                40,
                1_000,
                r"are shown: 40 that were .* are left out, the others are thinned evenly to one in [\d.]+ m?m\.",
            ),
        ],
    )
    def test_what_is_not_shown_is_told_with_why(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, doubtful: int, most: int, words: str
    ) -> None:
        run = read_run_files(write_run_folder(tmp_path, points=3_000))
        confidence = run.surfels["confidence"].copy()
        confidence[:doubtful] = 1.0
        monkeypatch.setattr("scanweld.report.page.select_points", lambda columns: select_points(columns, most))
        text = make_page(replace(run, surfels={**run.surfels, "confidence": confidence}))
        assert re.search(words, text)
        assert "one in 0 mm" not in text


class TestCharts:
    def test_the_size_at_the_last_frame_is_not_called_that_of_the_final_map(self, folder: Path) -> None:
        """The last of 40 frames saw 3000 + 39 * 75 surfels."""
        frames = read_frames(folder / "frames.csv")

        def said(final: float | None) -> str:
            charts = tracking_charts(frames, np.arange(COUNT), final_surfels=final)
            return next(chart.summary for chart in charts if chart.key == "surfels")

        assert said(5_000) == "5,925 surfels at the last frame, 5,000 in the final map"
        assert said(5_925) == said(None) == "5,925 surfels at the last frame"

    def test_errors_are_those_of_the_evaluation(self, folder: Path) -> None:
        run = read_run_files(folder)
        error = evaluate(run.trajectory, run.truth)
        assert error is not None
        charts = {chart.key: chart for chart in accuracy_charts(run, error, np.arange(COUNT))}
        assert list(charts) == ["ate", "rpe", "rpe_rot", "drift", "path"]
        np.testing.assert_allclose(charts["ate"].series[0].y, error.errors_m * 1e3)
        step = sw.rpe(run.trajectory, run.truth)
        np.testing.assert_allclose(charts["rpe"].series[0].y[1:], step.errors_trans_m * 1e3)
        assert np.isnan(charts["rpe"].series[0].y[0])

    def test_what_was_not_aligned_is_a_gap(self, folder: Path) -> None:
        charts = {chart.key: chart for chart in tracking_charts(read_frames(folder / "frames.csv"), np.arange(COUNT))}
        gaps = np.flatnonzero(np.isnan(charts["rmse"].series[0].y))
        np.testing.assert_array_equal(gaps, [0, 20])
        assert [s.name for s in charts["time"].series][2] == "alignment"


class TestFiles:
    def test_what_is_no_run_is_refused_in_one_line(self, tmp_path: Path) -> None:
        with pytest.raises(FileFormatError, match=r"not a run folder \(no run\.json\)"):
            write_report(tmp_path)

    @pytest.mark.parametrize(
        ("file", "content"),
        [
            ("run.json", "{"), ("run.json", "[1]"), ("metrics.json", "\xff"), ("frames.csv", "frame\nx\n"),
            ("frames.csv", "frame,timestamp,rmse\n0,0,nan\n"), ("frames.csv", "frame,timestamp\n"),
            ("trajectory.txt", "1 2 3\n"), ("map.ply", "no"), ("keyframes.csv", "frame,loop\n1,x\n"),
        ],
    )  # fmt: skip
    def test_damaged_files_are_named(self, tmp_path: Path, file: str, content: str) -> None:
        write_run_folder(tmp_path, points=60)
        (tmp_path / file).write_bytes(content.encode("latin-1"))
        with pytest.raises(FileFormatError, match=re.escape(file)) as caught:
            write_report(tmp_path)
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "report.html").exists()

    def test_runs_of_earlier_versions_have_a_report(self, tmp_path: Path) -> None:
        """No truth, no keyframes, no name, no intrinsics, no configuration, no pictures."""
        write_run_folder(tmp_path / "old-run", truth=False, points=60, run={"name": "", "intrinsics": None})
        for name in ("keyframes.csv", "config.toml", "renders/overview-rgb.png", "renders/overview-normals.png"):
            (tmp_path / "old-run" / name).unlink()
        text = write_report(tmp_path / "old-run").read_text(encoding="utf-8")
        assert "<h1>old-run</h1>" in text
        assert "no ground truth" in text

    def test_frames_left_out_of_the_trajectory_keep_the_pose_before(self, folder: Path) -> None:
        frames = read_frames(folder / "frames.csv")
        poses, known = poses_of_frames(frames, path().subset([i for i in range(COUNT) if not 10 <= i < 15]))
        assert np.flatnonzero(~known).tolist() == [10, 11, 12, 13, 14]
        np.testing.assert_array_equal(poses[12], poses[9])
        np.testing.assert_allclose(poses[15], path().T_world_camera[15])

    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_few_frames(self, tmp_path: Path, count: int) -> None:
        text = make_page(read_run_files(write_run_folder(tmp_path, table=rows(count), points=60)))
        assert f"<dd>{count} <small>of {count}</small>" in text
        assert "NaN" not in re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)

    def test_given_poses_are_not_called_tracked(self, tmp_path: Path) -> None:
        table = [row | {"status": "tracking", "alignment": "", "note": "", "inliers": 0} for row in rows()]
        text = make_page(read_run_files(write_run_folder(tmp_path, table=table, points=60)))
        assert "The poses were given: the map was fused there" in text
        assert "was plainly tracked:" not in text

    def test_a_truth_that_is_longer_or_of_another_time(self, tmp_path: Path) -> None:
        """Drift is measured over parts of the way that the run went; without a common time nothing is compared."""
        run = read_run_files(write_run_folder(tmp_path, points=60, error_m=0.004))
        long = path(400)
        error = evaluate(run.trajectory, sw.Trajectory(long.timestamps_s, long.T_world_camera))
        assert error is not None
        drift = next(c for c in accuracy_charts(replace(run, truth=long), error, np.arange(COUNT)) if c.key == "drift")
        assert drift.series[0].x is not None
        way = float(np.linalg.norm(np.diff(long.positions_m[:COUNT], axis=0), axis=1).sum())
        np.testing.assert_allclose(drift.series[0].x[-1], way / 2, rtol=1e-6)
        text = make_page(replace(run, truth=sw.Trajectory(long.timestamps_s + 1e6, long.T_world_camera)))
        assert "nothing can be compared" in text

    def test_figures_that_are_none_are_left_out(self, tmp_path: Path) -> None:
        write_run_folder(tmp_path, points=60)
        (tmp_path / "metrics.json").write_text('{"ate_rmse_m": "<b>", "fps": NaN, "num_surfels": [1]}')
        assert "<b>" not in write_report(tmp_path).read_text(encoding="utf-8")


class TestSettings:
    def test_only_what_differs_is_marked(self) -> None:
        text = '# a <doc>\nseed = 3\n\n[tracking]\nlevels = 3\nname = "a<b"\n'
        values = {"seed": 3, "tracking": {"levels": 3, "name": "a<b"}}
        differences = find_differences(values, {"seed": 0, "tracking": {"levels": 3}})
        assert [(d.key, d.value, d.default) for d in differences] == [("seed", 3, 0), ("tracking.name", "a<b", None)]
        html = marked_toml(text, differences).splitlines()
        assert html[:2] == ['<span class="comment"># a &lt;doc&gt;</span>', "<mark>seed = 3</mark>"]
        assert html[4:] == ["levels = 3", "<mark>name = &quot;a&lt;b&quot;</mark>"]

    def test_the_page_has_them(self, tmp_path: Path) -> None:
        config = sw.SlamConfig(seed=5, tracking=sw.TrackingConfig(stable_fraction=0.9))
        text = make_page(read_run_files(write_run_folder(tmp_path, points=60, config=config)))
        assert "2 settings differ from the defaults" in text
        assert "<mark>stable_fraction = 0.9</mark>" in text


class TestRuns:
    def test_a_run_has_its_report(self, tmp_path: Path) -> None:
        sequence = rendered(count=40).part(0, 3)
        sw.run_sequence(sequence, out=tmp_path / "run")
        run = read_run_files(tmp_path / "run")
        assert (run.name, len(run.frames), run.keyframes.tolist(), len(run.loops)) == (sequence.name, 3, [0], 0)
        assert run.run["intrinsics"]["fx"] == sequence.camera.fx
        assert (tmp_path / "run/report.html").read_text(encoding="utf-8") == make_page(run)

    def test_a_fault_of_the_report_does_not_cost_the_run(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        def fail(folder: Path) -> None:
            raise ZeroDivisionError("a fault of the page")

        monkeypatch.setattr(output, "write_report", fail)
        sw.run_sequence(rendered(count=40).part(0, 3), out=tmp_path / "run")
        assert (tmp_path / "run/map.ply").is_file()
        assert not (tmp_path / "run/report.html").exists()
        assert "report.html could not be made" in caplog.text

    def test_keyframes_and_loops_are_kept(self, tmp_path: Path) -> None:
        """Keyframes 0 to 3 are of frames 0, 8, 20 and 31; loops tie the last to the first two."""
        outcome = SimpleNamespace(keyframe_frames=[0, 8, 20, 31], loops=[(0, 3), (3, 1)])
        output.write_keyframes(tmp_path / "keyframes.csv", outcome)  # type: ignore[arg-type]
        frames, loops = read_keyframes(tmp_path / "keyframes.csv")
        assert frames.tolist() == [0, 8, 20, 31]
        assert loops.tolist() == [[31, 0], [31, 8]]


class Outline(HTMLParser):
    """Collects what a page is made of, and checks that elements are closed in order."""

    VOID = frozenset({"meta", "img", "input", "br", "link", "hr"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


class TestPage:
    def test_is_well_formed_and_accessible(self, page: str) -> None:
        outline = Outline(page)
        assert outline.open == []
        levels = [int(tag[1]) for tag, _ in outline.elements if re.fullmatch("h[1-6]", tag)]
        assert levels.count(1) == 1
        assert all(after <= before + 1 for before, after in zip([0, *levels], levels, strict=False))
        assert all(attributes.get("alt") for attributes in outline.all("img"))
        assert all(attributes.get("scope") for attributes in outline.all("th"))
        assert outline.all("html")[0]["lang"] == "en"
        names = [attributes["id"] for _, attributes in outline.elements if "id" in attributes]
        assert len(names) == len(set(names))
        pointed = [a[key] for _, a in outline.elements for key in ("aria-labelledby", "aria-describedby") if key in a]
        assert set(pointed) <= set(names)
        assert {a["href"] for a in outline.all("a")} <= {f"#{name}" for name in names}
        assert all(a.get("aria-label") for _, a in outline.elements if a.get("role") in ("img", "region"))

    def test_needs_nothing_from_elsewhere(self, page: str) -> None:
        outline = Outline(page)
        sources = [a.get("src") or "" for _, a in outline.elements if "src" in a]
        assert sources
        assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
        assert not outline.all("link")
        without_points = re.sub(r'id="points">[^<]*', "", page)
        assert set(re.findall(r"https?://[^\s\"']+", without_points)) <= {"http://www.w3.org/2000/svg"}

    def test_only_its_own_script_and_style_may_run(self, page: str) -> None:
        """The policy names the hashes of exactly the two that are there; nothing is inline elsewhere."""
        policy = Outline(page).all("meta")[1]["content"] or ""
        for tag, directive in (("script", "script-src"), ("style", "style-src")):
            (text,) = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
            digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
            assert f"{directive} 'sha256-{digest}'" in policy
        assert policy.startswith("default-src 'none';")
        assert "unsafe" not in policy
        attributes = {name for _, a in Outline(page).elements for name in a}
        assert not {name for name in attributes if name.startswith("on")} | ({"style"} & attributes)

    def test_nothing_of_a_run_becomes_markup(self, tmp_path: Path) -> None:
        table = rows()
        table[10]["note"] = table[20]["note"] = EVIL
        run = {"warnings": [EVIL], "input": EVIL, EVIL: EVIL, "packages": {EVIL: EVIL}}
        write_run_folder(tmp_path, name=EVIL, table=table, points=60, run=run)
        text = make_page(read_run_files(tmp_path))
        outline = Outline(text)
        assert outline.open == []
        assert len(outline.all("script")) == 3
        assert all((a["src"] or "").startswith("data:") for a in outline.all("img"))
        data = json.loads(re.findall(r'id="data">(.*?)</script>', text, re.DOTALL)[0])
        assert EVIL in data["frames"]["texts"]

    def test_template_marks_in_a_name_stay_what_they_are(self, tmp_path: Path) -> None:
        write_run_folder(tmp_path, name="{{points}}", points=60)
        assert "<h1>{{points}}</h1>" in make_page(read_run_files(tmp_path))

    def test_says_what_happened(self, page: str) -> None:
        assert 'data-frame="10">10–14</button>' in page
        assert "found again at 15" in page
        assert "residual 0.010 m, usually below 0.0040 m" in page
        assert "Trustworthy with reservations" in page
        assert "The map from behind and above, in colour" in page

    def test_frames_of_another_submap_are_counted_as_lost(self, tmp_path: Path) -> None:
        """Five lost, and six tracked elsewhere, one of them found again there: 11 of 40 have no pose in this map."""
        table = [row | {"submap": int(30 <= row["frame"] < 36)} for row in rows()]
        table[31]["status"] = "relocalised"
        text = make_page(read_run_files(write_run_folder(tmp_path, table=table, points=60)))
        assert "<dd>28 <small>of 40</small>" in text  # one more is unreadable
        assert "<dt>frames lost</dt><dd>11 <small>found again 1×, 6 of them in another submap</small>" in text

    def test_a_run_in_fragments_says_so_in_words(self, tmp_path: Path, page: str) -> None:
        links = [{"fragments": [0, 1], "edges": 30, "kept": 28}, {"fragments": [0, 2], "edges": 5, "kept": 0}]
        fragments = {"parts": [{"frames": [0, 20]}, {"frames": [15, 30]}, {"frames": [25, 40]}], "links": links}
        text = make_page(read_run_files(write_run_folder(tmp_path, points=60, run={"fragments": fragments})))
        assert "made in fragments</th><td>3, tied together by 28 of 35 links between them</td>" in text
        assert "fragments" not in re.sub(r"<script.*?</script>|<pre.*?</pre>", "", page, flags=re.DOTALL)
        odd = make_page(read_run_files(write_run_folder(tmp_path, points=60, run={"fragments": {"parts": 3}})))
        assert "made in fragments</th><td>{&quot;parts&quot;: 3}</td>" in odd

    def test_many_stretches_leave_the_longest(self, tmp_path: Path) -> None:
        table = rows(400)
        for i in range(40, 400, 4):
            table[i] |= {"alignment": "degenerate", "note": "free"}
        write_run_folder(tmp_path, table=table, points=60)
        text = make_page(read_run_files(tmp_path))
        assert text.count('class="go"') == MAX_ROWS
        assert "LOST</span>" in text
        assert "shorter stretches left out" in text

    def test_scripts_and_style_are_in_the_package(self) -> None:
        names = {item.name for item in package_files("scanweld.report").iterdir()}
        assert {"frame.html", "run.html", "report.css", "page.js", "charts.js", "viewer.js"} <= names


def luminance(color: str) -> float:
    """Relative luminance of #rrggbb as WCAG 2 defines it."""
    values = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
def test_text_stands_out_from_what_is_behind_it(theme: int) -> None:
    """WCAG 2 level AA: 4.5 for text, 3 for lines of charts."""
    css = package_files("scanweld.report").joinpath("report.css").read_text(encoding="utf-8")
    block = re.findall(r":root \{(.*?)\}", css, re.DOTALL)[theme]
    colors = dict(re.findall(r"--([\w]+): (#[0-9a-f]{6});", block))
    for names, against, least in (
        (("ink", "muted", "accent", "lost", "unreadable", "relocalised", "degenerate", "good", "loop"),
         ("page", "surface"), 4.5),
        (("accent", "lost", "unreadable", "degenerate", "truth", "loop", "ink"), ("well",), 3.0),
        (("s1", "s2", "s3", "s4", "s5"), ("page",), 3.0),
    ):  # fmt: skip
        for name in names:
            for ground in against:
                bright, dim = sorted((luminance(colors[name]), luminance(colors[ground])), reverse=True)
                assert (bright + 0.05) / (dim + 0.05) >= least, (name, ground)


class TestCommand:
    def test_makes_the_page_again(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        write_run_folder(tmp_path / "run", points=60)
        assert run_command(["report", str(tmp_path / "run")]) == 0
        assert capsys.readouterr().out.strip() == f"written  {tmp_path / 'run' / 'report.html'}"
        assert (tmp_path / "run" / "report.html").stat().st_size > 10_000

    def test_takes_a_truth_and_another_place(self, tmp_path: Path) -> None:
        write_run_folder(tmp_path / "run", points=60, truth=False)
        sw.write_tum(tmp_path / "truth.txt", path())
        arguments = ["report", str(tmp_path / "run"), "--truth", str(tmp_path / "truth.txt")]
        assert run_command([*arguments, "--out", str(tmp_path / "a.html")]) == 0
        assert "Error of the position" in (tmp_path / "a.html").read_text(encoding="utf-8")
        assert not (tmp_path / "run" / "report.html").exists()

    def test_tells_a_fault_in_one_line(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert run_command(["report", str(tmp_path)]) == 1
        assert capsys.readouterr().err.startswith(f"error: {tmp_path}: not a run folder")

    def test_a_place_that_cannot_be_written(self, tmp_path: Path) -> None:
        write_run_folder(tmp_path, points=60)
        with pytest.raises(OutputError, match="cannot be written"):
            write_report(tmp_path, out=tmp_path / "no" / "where.html")


def test_tracking_plot_shades_every_kind(tmp_path: Path) -> None:
    """Each kind of frame changes the picture of a run that was plainly tracked."""
    import cv2

    def drawn(**changes: object) -> np.ndarray:
        plain = {"timestamp_s": 0.0, "state": FrameState.TRACKING, "T_world_camera": np.eye(4), "status": "converged"}
        results = [FrameResult(index=i, overlap=0.9, loss=0.1, num_inliers=500, **plain) for i in range(20)]
        results[8] = replace(results[8], **changes)
        plot_tracking(results, tmp_path / "t.png")
        return cv2.imread(str(tmp_path / "t.png")).astype(int)

    plain = drawn()
    shaded = [
        drawn(state=FrameState.LOST), drawn(state=FrameState.UNREADABLE), drawn(state=FrameState.RELOCALISED),
        drawn(status="degenerate"), drawn(status="max_iterations"),
    ]  # fmt: skip
    pictures = [plain, *shaded]
    for i, a in enumerate(pictures):
        for b in pictures[i + 1 :]:
            assert (np.abs(a - b).max(axis=2) > 8).sum() > 300
