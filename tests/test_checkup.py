"""The input doctor: every fault that can be made on purpose is named, and nothing else is."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

import scanweld as sw
from rendered import MemorySequence, rendered
from scanweld.checkup.evidence import Pair, plan_bursts
from scanweld.checkup.examine import examine, examine_input
from scanweld.checkup.findings import FIGURES, WHY, Checkup, Finding, Level
from scanweld.checkup.first_look import FirstLook
from scanweld.checkup.motions import Motion, check_focal_length, check_truth
from scanweld.checkup.pictures import edge_spread
from scanweld.checkup.repeats import check_repeats
from scanweld.checkup.times import check_times
from scanweld.cli.app import run
from scanweld.datasets.synthetic.spoiling import SPOILS, spoil
from scanweld.errors import ConfigError, DatasetError
from scanweld.geometry import se3

SIZE = {"width": 160, "height": 120}
CAMERA = sw.PinholeCamera(260.0, 260.0, 159.5, 119.5, 320, 240)


@lru_cache(maxsize=2)
def recording(count: int = 66, width: int = 160) -> MemorySequence:
    """Four seconds of the orbit, 15 frames a second, as a Kinect sees it."""
    config = sw.RenderConfig(noise="kinect", frames=count, fps=15.0, width=width, height=3 * width // 4)
    sequence = sw.SyntheticSequence(config)
    frames = tuple(sequence.read(index) for index in range(len(sequence)))
    return MemorySequence(sequence.name, sequence.camera, frames, sequence.timestamps_s, sequence.ground_truth)


def faults(sequence: sw.datasets.base.RgbdSequence) -> list[str]:
    return [finding.fault for finding in examine(sequence).findings]


def test_a_sound_recording_has_no_finding() -> None:
    checkup = examine(recording())
    assert checkup.findings == ()
    assert checkup.sound
    assert checkup.num_frames == 66
    assert 40 < checkup.num_looked_at <= 66
    untold = {name for name, value in checkup.figures.items() if value is None}
    assert untold == {name for name in FIGURES if name.startswith("color_")}  # too small for that
    assert set(checkup.figures) == set(FIGURES)


@pytest.mark.parametrize("fault", [name for name, made in SPOILS.items() if made.sequence])
def test_every_fault_is_named_and_nothing_else(fault: str) -> None:
    of_color = fault in ("unregistered", "unsynchronised")
    sequence = recording(33, 320) if of_color else recording()
    assert faults(spoil(sequence, fault)) == [fault]


@pytest.mark.parametrize("fault", [name for name, made in SPOILS.items() if made.folder])
def test_faults_of_files_are_named(fault: str, tmp_path: Path) -> None:
    folder = tmp_path / "room"
    sw.render_sequence(folder, sw.RenderConfig(frames=4, **SIZE), spoil=fault)
    checkup = examine_input(folder, lambda: sw.open_sequence(folder))
    assert [finding.fault for finding in checkup.findings] == [fault]


def test_a_written_fault_is_read_again(tmp_path: Path) -> None:
    """The files of a spoiled sequence give what it gives in memory: depth and times are those that were claimed."""
    config = sw.RenderConfig(frames=4, **SIZE)
    sw.render_sequence(tmp_path / "unit", config, spoil="depth-unit")
    sw.render_sequence(tmp_path / "time", config, spoil="time-unit")
    plain = sw.SyntheticSequence(config)
    wrong = sw.open_sequence(tmp_path / "unit")
    assert wrong.depth_scale == 1000.0
    assert np.allclose(wrong.read(3).depth_m, 5 * plain.read(3).depth_m)
    late = sw.open_sequence(tmp_path / "time")
    assert np.allclose(late.timestamps_s, 1000 * plain.timestamps_s)
    assert np.allclose(late.ground_truth.timestamps_s, late.timestamps_s)


@pytest.mark.parametrize(("scene", "noise"), [("corridor", "realsense"), ("wall", "none")])
def test_no_false_alarm(scene: str, noise: str) -> None:
    assert faults(rendered(scene, noise, 22)) == []


def test_no_false_alarm_on_recordings(shared_data: Path) -> None:
    for name in ("livingroom1", "livingroom1_noisy", "shelf_realsense"):
        assert faults(sw.open_sequence(shared_data / name)) == []


def test_every_fault_says_why_and_is_on_the_page() -> None:
    docs = Path(__file__).parents[1] / "docs"
    assert set(SPOILS) <= set(WHY)
    page = (docs / "check.md").read_text(encoding="utf-8")
    assert [fault for fault in WHY if fault not in page] == []
    page = (docs / "synthetic.md").read_text(encoding="utf-8")
    assert [fault for fault in SPOILS if fault not in page] == []


def test_an_unknown_fault_is_an_error() -> None:
    with pytest.raises(ConfigError, match="expected one of depth-unit"):
        spoil(recording(), "nonsense")
    with pytest.raises(ConfigError, match="only written"):
        spoil(recording(), "swapped")


def test_a_unit_too_small_is_known_by_the_truth() -> None:
    """Depth five times too near is as plausible as the right one; the true path is then five times as long."""
    sequence = recording()
    near = tuple(replace(frame, depth_m=frame.depth_m / np.float32(5)) for frame in sequence.frames)
    (finding,) = examine(replace(sequence, frames=near, depth_scale=5000.0)).findings
    assert finding.fault == "depth-unit"
    assert "--depth-scale 1000" in finding.advice


def test_truth_of_another_clock_and_of_other_axes() -> None:
    sequence, truth = recording(), recording().ground_truth
    late = sw.Trajectory(truth.timestamps_s + 1e4, truth.T_world_camera)
    (finding,) = examine(replace(sequence, ground_truth=late)).findings
    assert finding.fault == "truth"
    assert "clock" in finding.advice
    turned = sw.Trajectory(truth.timestamps_s, truth.T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0]))
    (finding,) = examine(replace(sequence, ground_truth=turned)).findings
    assert finding.fault == "truth"
    assert "OpenGL" in finding.seen


def views_of(points_m: np.ndarray, factor: float = 1.0, num: int = 6) -> list[Pair]:
    """Views of points (N, 3), two metres ahead, from both sides, as a lens `factor` times too long takes them."""
    rng, pairs, lens = np.random.default_rng(3), [], np.array([1 / factor, 1 / factor, 1.0])
    for k in range(num):
        T = se3.exp([0.2, 0, 0, 0, 0, 0]) @ se3.exp([0, 0, 0, 0, 0.08 + 0.01 * k, 0.03])
        sides = [
            side + 0.01 * rng.standard_normal(side.shape) for side in (points_m, se3.transform_points(T, points_m))
        ]
        pairs.append(Pair(0.0, 1.0, sides[0] * lens, sides[1] * lens, np.full(len(points_m), 0.02)))
    return pairs


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 1.0), (1.3, 1 / 1.3), (0.75, 1 / 0.75)])
def test_focal_length_that_makes_one_rigid_thing(factor: float, expected: float) -> None:
    room = np.random.default_rng(0).uniform([-1, -0.8, 1.2], [1, 0.8, 3.5], (300, 3))
    findings, figures = check_focal_length(CAMERA, CAMERA, views_of(room, factor))
    assert [finding.fault for finding in findings] == ([] if factor == 1 else ["intrinsics"])
    assert figures["focal_factor"] == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize(("factor", "beyond"), [(1.3, ""), (0.75, ""), (3.0, " or less"), (1 / 3.0, " or more")])
def test_a_focal_length_beyond_those_tried_is_bounded_alone(factor: float, beyond: str) -> None:
    """From 0.6 to 1.68 times the stated one is tried; the true one is a third, or three times as long."""
    room = np.random.default_rng(0).uniform([-1, -0.8, 1.2], [1, 0.8, 3.5], (300, 3))
    (finding,), figures = check_focal_length(CAMERA, CAMERA, views_of(room, factor))
    found = figures["focal_factor"]
    assert f"focal lengths {found:.2f} times those given{beyond}, fx" in finding.seen
    about = f"(about {found * 260:.0f},{found * 260:.0f},159.5,119.5"
    assert about + (f", FX and FY that{beyond})" if beyond else ")") in finding.advice


def test_a_wall_fits_with_any_focal_length() -> None:
    """Lengths on it shrink alike in all views, and so do the errors of its features: that makes no lens better."""
    wall = np.random.default_rng(0).uniform([-1, -0.8, 2.0], [1, 0.8, 2.0], (300, 3))
    assert check_focal_length(CAMERA, CAMERA, views_of(wall))[0] == []


def test_truth_on_a_wall_is_told_by_what_moves() -> None:
    """A shift of 6 cm and a turn of 0.03 rad all but undo each other at two metres: features tell them apart badly."""
    true = np.stack([se3.exp([0.1 * k, 0, 0, 0, 0, 0]) for k in range(5)])
    truth = sw.Trajectory(np.arange(5.0), true)
    wrong = se3.exp([0.06, 0, 0, 0, -0.03, 0])
    motions = [Motion(k, k + 1.0, wrong @ se3.inverse(true[k + 1]) @ true[k]) for k in range(4)]
    findings, figures = check_truth(truth, truth.timestamps_s, motions, 2.0, 1000.0)
    assert findings == []
    assert figures["truth_disagreement"] < 0.35
    backwards = [Motion(m.source_s, m.target_s, se3.inverse(m.T_target_source)) for m in motions]
    assert [f.fault for f in check_truth(truth, truth.timestamps_s, backwards, 2.0, 1000.0)[0]] == ["truth-inverted"]


def test_intrinsics_of_another_image_size() -> None:
    """Those of images twice as large: the principal point, 159.5, lies half a width beside the centre of 160 pixels."""
    sequence = recording()
    camera = sw.PinholeCamera(262.5, 262.5, 159.5, 119.5, 160, 120)
    frames = tuple(replace(frame, camera=camera) for frame in sequence.frames)
    (finding,) = examine(replace(sequence, camera=camera, frames=frames)).findings
    assert finding.fault == "intrinsics"
    assert "50% beside the centre" in finding.seen


def test_unreadable_frames_are_counted() -> None:
    checkup = examine(recording().with_frames({3: None, 30: None}))
    (finding,) = checkup.findings
    assert (finding.fault, finding.level) == ("unreadable", Level.WARNING)
    assert "frames looked at cannot be decoded, the first is 3" in finding.seen
    with pytest.raises(DatasetError, match="none of the 5 frames"):
        examine(recording().part(0, 5).with_frames(dict.fromkeys(range(5))))


def test_one_frame_is_enough() -> None:
    assert examine(rendered(count=40).part(0, 1)).findings == ()


@pytest.mark.parametrize("count", [1, 2, 5, 11, 30, 31, 200, 100_000])
def test_bursts_lie_within_the_recording(count: int) -> None:
    """At most 8 bursts of 11 and one more each, so the time does not depend on the length."""
    bursts = plan_bursts(count)
    assert 1 <= len(bursts) <= 8
    for burst in bursts:
        assert 0 <= burst.first <= burst.middle < burst.stop <= count
        assert burst.partner is None or burst.middle < burst.partner < count
    assert sum(burst.stop - burst.first for burst in bursts) <= 88


def test_times() -> None:
    """30 frames a second: 3 missing ones are 0.133 s, which is common; 9 are a third of a second."""
    steady = np.arange(300) / 30.0
    assert check_times(steady)[0] == []
    assert check_times(np.delete(steady, [100, 101, 102]))[0] == []
    (gap,), figures = check_times(np.delete(steady, np.arange(100, 109)))
    assert gap.fault == "gaps"
    assert "0.33 s after frame 99" in gap.seen
    assert figures["longest_gap"] == pytest.approx(10)
    for factor, unit in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")):
        (wrong,), _ = check_times(1e5 + steady * factor)
        assert (wrong.fault, unit in wrong.seen) == ("time-unit", True)
    assert check_times(np.array([0.0]))[0] == []


@pytest.mark.parametrize("length", [1, 4, 8])
def test_an_edge_spreads_over_as_many_pixels_as_it_takes(length: int) -> None:
    """A step from 50 to 200 smeared over n pixels rises by 150 / n a pixel."""
    ramp = np.clip((np.arange(64) - 30.0) / length, 0, 1)
    picture = np.tile(np.rint(50 + 150 * ramp).astype(np.uint8), (64, 1))
    assert edge_spread(picture) == pytest.approx(length, rel=0.05)
    assert np.isnan(edge_spread(np.full((64, 64), 90, np.uint8)))


def test_repeats_are_found_in_all_files(tmp_path: Path) -> None:
    sw.render_sequence(tmp_path / "s", sw.RenderConfig(frames=12, **SIZE), spoil="duplicates")
    (finding,), figures = check_repeats(sw.open_sequence(tmp_path / "s"), [])
    assert finding.fault == "duplicates"
    assert figures["repeated_share"] == pytest.approx(4 / 12)  # frames 2, 5, 8 and 11
    assert check_repeats(sw.open_sequence(tmp_path / "s", frames="0:2"), [])[0] == []


def test_the_first_look_of_a_run() -> None:
    """A run of 198 frames has three of them looked at, and each fault is told once."""
    sequence = recording()
    times = 1000 * np.arange(198) / 15.0
    dark = [
        replace(frame, color=frame.color // 2) if index == 1 else frame for index, frame in enumerate(sequence.frames)
    ]
    long = replace(sequence, frames=tuple(dark * 3), timestamps_s=times, ground_truth=None)
    look = FirstLook(long)
    told = [[finding.fault for finding in look.see(index, long.read(index))] for index in range(6)]
    assert told == [["time-unit"], [], ["exposure"], [], [], []]
    short = FirstLook(sequence)
    assert [short.see(index, sequence.read(index)) for index in range(66)] == [[]] * 66


def test_a_run_warns_of_its_input(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sequence = spoil(rendered(count=40).part(0, 6), "time-unit")
    with caplog.at_level(logging.WARNING):
        sw.run_sequence(sequence, out=tmp_path / "run")
    (warning,) = json.loads((tmp_path / "run" / "run.json").read_text())["warnings"]
    assert warning.startswith("time-unit: a frame comes every 33.33 s")
    assert warning in caplog.messages
    assert "time-unit" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")


@pytest.fixture
def shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def call(*arguments: str) -> tuple[int, str, str]:
        code = run(["check", *arguments])
        return code, *capsys.readouterr()

    return call


def test_command(tmp_path: Path, shown: Callable[..., tuple[int, str, str]]) -> None:
    folder = tmp_path / "room"
    sw.render_sequence(folder, sw.RenderConfig(frames=4, **SIZE))
    code, out, err = shown(str(folder))
    assert (code, err) == (0, "")
    assert out.startswith("room: nothing wrong was found (looked at 4 of 4 frames")
    code, out, err = shown(str(folder), "--depth-scale", "100")
    assert (code, err) == (3, "")
    assert "error: depth-unit" in out
    assert "pass --depth-scale" in out
    code, out, err = shown(str(folder), "--camera", "131,-131,79.5,59.5", "--json")
    assert (code, err) == (3, "")
    answer = json.loads(out)
    assert [finding["fault"] for finding in answer["findings"]] == ["negative-fy"]
    assert set(answer["findings"][0]) == {"fault", "level", "seen", "why", "advice"}
    assert (answer["frames"], answer["frames_looked_at"]) == (4, 4)


@pytest.mark.parametrize(("columns", "fitted"), [("30", 40), ("40", 40), ("60", 60), ("80", 80), ("300", 120)])
def test_command_keeps_to_the_terminal(
    shown: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch, columns: str, fitted: int
) -> None:
    """Lines are as wide as the terminal, between 40 and 120 columns, and words are whole."""
    advice = "pass the intrinsics of these images with --camera FX,FY,CX,CY, or --depth-scale 5000, or try --calibrate"
    seen = "the same places seen from two directions fit together best with focal lengths half of those given " * 2
    figures = dict.fromkeys(FIGURES, None) | {"median_depth_m": 1.234}
    made = Checkup("room", 40, 40, (Finding("intrinsics", Level.ERROR, seen, advice),), figures)
    monkeypatch.setattr("scanweld.checkup.examine.examine_input", lambda *_: made)
    monkeypatch.setenv("COLUMNS", columns)
    code, out, _ = shown("room")
    assert code == 3
    assert fitted - 12 <= max(map(len, out.splitlines())) <= fitted
    words = out.split()
    for text in (*seen.split(), *advice.split(), *" ".join(FIGURES.values()).split()):
        assert text in words
    assert "1.23" in words


def test_command_without_a_recording(tmp_path: Path, shown: Callable[..., tuple[int, str, str]]) -> None:
    code, out, err = shown(str(tmp_path / "none"))
    assert (code, out) == (1, "")
    assert "no such folder" in err
