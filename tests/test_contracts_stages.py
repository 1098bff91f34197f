"""The contracts of stages and observers: the library keeps them, and each notices parts that break a promise."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scanweld as sw
from rendered import rendered
from scanweld import testing
from scanweld.geometry import se3
from scanweld.geometry.views import MapCorrection, ModelView
from scanweld.loop_closure.loop_closer import KeyframeLoopCloser, LoopClosingConfig
from scanweld.mapping.pipelined import PipelinedMapper
from scanweld.parallel import get_num_threads
from scanweld.registration.result import RegistrationResult, Status
from scanweld.tracking.tracker import TrackingConfig
from test_contracts import breaks


class BentTracker(sw.FrameToModelTracker):
    """The library's tracker, but for what a function makes of its answer and its arguments."""

    def __init__(self, bend: Callable[..., RegistrationResult]) -> None:
        super().__init__()
        self.bend, self.count = bend, 0

    def track(self, pyramid: sw.SurfacePyramid, view: ModelView, T_world_camera: np.ndarray) -> RegistrationResult:
        result = super().track(pyramid, view, T_world_camera)
        self.count += 1
        return self.bend(result, T=T_world_camera, pyramid=pyramid, tracker=self)


def spoil(T: np.ndarray, result: RegistrationResult) -> RegistrationResult:
    T[0, 3] += 1e-9
    return result


def slid(result: RegistrationResult) -> RegistrationResult:
    T = result.T_target_source @ se3.exp([0.05, 0, 0, 0, 0, 0])
    return replace(result, T_target_source=T) if result.status is Status.DEGENERATE else result


def converged(result: RegistrationResult, *of: Status) -> RegistrationResult:
    return replace(result, status=Status.CONVERGED, note="") if result.status in of else result


class TestTracker:
    @pytest.mark.parametrize("photometry", ["auto", "off"])
    def test_ours(self, photometry: str) -> None:
        testing.check_tracker(lambda: sw.FrameToModelTracker(TrackingConfig(photometry=photometry)))

    @pytest.mark.parametrize(
        ("bend", "words"),
        [
            (lambda r, **_: r.T_target_source, "expected a RegistrationResult"),
            (lambda r, **_: replace(r, status="converged"), "expected a Status"),
            (lambda r, **_: replace(r, T_target_source=se3.inverse(r.T_target_source)), "m from the truth"),
            (lambda r, T, **_: replace(r, T_target_source=T, status=Status.CONVERGED), "m from the truth"),
            (lambda r, **_: replace(r, T_target_source=r.T_target_source.astype(np.float32)), "expected float64"),
            (lambda r, **_: replace(r, T_target_source=np.full((4, 4), np.nan)), "not finite"),
            (lambda r, **_: replace(r, T_target_source=np.diag([2.0, 2, 2, 1])), "not a rigid transform"),
            (lambda r, **_: replace(r, information=np.triu(r.information)), "not symmetric"),
            (lambda r, **_: replace(r, information=-r.information), "less than none"),
            (lambda r, **_: replace(r, overlap=40.0), "overlap"),
            (lambda r, **_: replace(r, num_inliers=0), "num_inliers"),
            (lambda r, T, **_: spoil(T, r), "track: it has changed what it was given"),
            (lambda r, tracker, **_: replace(r, rmse_m=r.rmse_m + 1e-12 * tracker.count), "after another frame"),
            (lambda r, **_: replace(r, num_iterations=get_num_threads()), "thread"),
            (lambda r, **_: converged(r, Status.TOO_FEW_CORRESPONDENCES), "a frame without depth"),
            (lambda r, **_: replace(r, note=""), "note: it is empty"),
            (lambda r, **_: converged(r, Status.NO_OVERLAP), "another building"),
            (lambda r, **_: converged(r, Status.DEGENERATE), "CONVERGED for a blank wall"),
            (lambda r, **_: replace(r, unobservable=()), "unobservable"),
            (lambda r, **_: slid(r), "along a blank wall"),
        ],
    )
    def test_broken(self, bend: Callable[..., RegistrationResult], words: str) -> None:
        with breaks(words):
            testing.check_tracker(lambda: BentTracker(bend))

    def test_gives_up(self) -> None:
        class Blind:
            def track(self, pyramid: object, view: object, T_world_camera: np.ndarray) -> RegistrationResult:
                return RegistrationResult(
                    T_target_source=T_world_camera, status=Status.NO_OVERLAP, information=np.zeros((6, 6)), note="blind"
                )

        with breaks("expected CONVERGED"):
            testing.check_tracker(Blind)


class Unmoved(sw.SurfelMapper):
    def apply(self, correction: MapCorrection) -> None:
        pass


class AllMoved(sw.SurfelMapper):
    def apply(self, correction: MapCorrection) -> None:
        for keyframe in range(3):
            super().apply(MapCorrection(np.array([keyframe], np.int32), correction.T_new_old[:1]))


class Spoiling(sw.SurfelMapper):
    def fuse(self, pyramid: sw.SurfacePyramid, *args: Any, **kept: Any) -> Any:
        counts = super().fuse(pyramid, *args, **kept)
        pyramid.levels[0].depth_m[0, 0] += 1
        return counts


class TakingAll(sw.SurfelMapper):
    def fuse(self, *args: Any, keyframe: int = 0, moving: object = None) -> Any:
        return super().fuse(*args, keyframe=keyframe)


class TakingNothing(sw.SurfelMapper):
    def fuse(self, pyramid: Any, *args: Any, keyframe: int = 0, moving: object = None) -> Any:
        return super().fuse(pyramid, *args, keyframe=keyframe, moving=np.ones(pyramid.levels[0].depth_m.shape, bool))


class Appending(sw.SurfelMapper):
    def fuse(self, *args: Any, **kept: Any) -> Any:
        other = sw.SurfelMapper()
        counts = other.fuse(*args, **kept)
        self.map.take_in(other.map)
        self.last_seen = None
        return counts


class Inverted(sw.SurfelMapper):
    def fuse(self, pyramid: Any, T_world_camera: np.ndarray, **kept: Any) -> Any:
        return super().fuse(pyramid, se3.inverse(T_world_camera), **kept)


class Starting(sw.SurfelMapper):
    def __init__(self) -> None:
        super().__init__()
        sw.SurfelMapper.fuse(self, sw.build_pyramid(rendered(count=40).frames[0]), np.eye(4))


class Bent(sw.SurfelMapper):
    """Shows the map in another way."""

    bend: Callable[[ModelView], Any]

    def view(self, *args: Any) -> ModelView:
        seen = super().view(*args)
        shown = ModelView(
            seen.T_world_camera, seen.camera, seen.positions_m, seen.normals, seen.confidences, seen.index_map,
            seen.stable_confidence, seen.intensities,
        )  # fmt: skip
        return type(self).bend(shown) or shown


def showing(bend: Callable[[ModelView], Any]) -> type[Bent]:
    return type("Showing", (Bent,), {"bend": staticmethod(bend)})


def set_to(name: str, change: Callable[[Any], Any]) -> type[Bent]:
    return showing(lambda view: setattr(view, name, change(getattr(view, name))))


class Dripping(sw.SurfelMapper):
    """Each time it finishes, the map changes."""

    def finish(self) -> None:
        super().finish()
        if len(self.map):
            self.map.remove(np.arange(len(self.map)) == 0)
            self.last_seen = None


class Sharing(sw.SurfelMapper):
    def fresh(self) -> sw.SurfelMapper:
        return self


class Unlike(sw.SurfelMapper):
    def fresh(self) -> Any:
        return object()


class Unplaced(sw.SurfelMapper):
    def take_in(self, other: sw.SurfelMapper, correction: MapCorrection) -> None:
        super().take_in(other, replace(correction, T_new_old=np.eye(4)[None]))


class Alternating(sw.SurfelMapper):
    made = 0

    def __init__(self) -> None:
        Alternating.made += 1
        super().__init__(sw.FusionConfig(stable_confidence=Alternating.made / 10))


class Unnamed(sw.SurfelMapper):
    def __init__(self) -> None:
        super().__init__()
        self.extra = 0


class Forgetting(sw.SurfelMapper):
    """What it saw last is said to follow from how it was made."""

    STATE = {name: hint for name, hint in sw.SurfelMapper.STATE.items() if name != "last_seen"}  # noqa: RUF012
    MADE = sw.SurfelMapper.MADE | {"last_seen"}


class TestMapper:
    @pytest.mark.parametrize("make", [sw.SurfelMapper, lambda: PipelinedMapper(sw.SurfelMapper())])
    def test_ours(self, make: Callable[[], sw.SurfelMapper]) -> None:
        testing.check_mapper(make)

    def test_ours_without_compiled_kernels(self) -> None:
        sw.set_backend("numpy")
        try:
            testing.check_mapper(sw.SurfelMapper)
        finally:
            sw.set_backend("numba")

    @pytest.mark.parametrize(
        ("make", "words"),
        [
            (Starting, "before anything was fused"),
            (Unmoved, "apply, of the keyframe that moved"),
            (AllMoved, "apply, of a keyframe that did not move"),
            (Spoiling, "fuse: it has changed what it was given"),
            (TakingAll, "pixels that are moving"),
            (TakingNothing, "fuse: the map shows 0%"),
            (Appending, "it should merge"),
            (Inverted, "fuse: the map shows"),
            (showing(lambda view: "a view"), "expected a ModelView"),
            (set_to("positions_m", lambda a: a.astype(np.float64)), "positions_m: expected float32"),
            (set_to("positions_m", lambda a: a + np.float32(0.03)), "is within 0.02 m"),
            (set_to("normals", lambda a: 2 * a), "not unit vectors"),
            (set_to("normals", lambda a: -a), "points away from the camera"),
            (set_to("confidences", lambda a: -a), "a confidence is negative"),
            (set_to("intensities", lambda a: a - 300), "0 to 255"),
            (set_to("index_map", lambda a: np.minimum(a, 0)), "each row must be in index_map once"),
            (set_to("camera", lambda a: a.scaled(0.5)), "camera is not the one"),
            (Dripping, "it should merge|a second one changes the map"),
            (Sharing, "fresh: expected an empty map"),
            (Unlike, "a mapper of the same kind"),
            (Unplaced, "take_in, of what the other map brings"),
            (Alternating, "the same calls give another map"),
            (Unnamed, "extra is neither in STATE nor in MADE"),
            (Forgetting, "goes on in another way"),
        ],
    )
    def test_broken(self, make: Callable[[], Any], words: str) -> None:
        with breaks(words):
            testing.check_mapper(make)


class Guessing(sw.NoLoopCloser):
    def relocalise(self, pyramid: object) -> RegistrationResult:
        return RegistrationResult(T_target_source=np.eye(4), status=Status.CONVERGED, information=np.eye(6))


class Lost(sw.NoLoopCloser):
    def relocalise(self, pyramid: object) -> RegistrationResult:
        return RegistrationResult(
            T_target_source=np.full((4, 4), np.nan), status=Status.NO_OVERLAP, information=np.eye(6), note="lost"
        )


def displaced(status: Status) -> type[KeyframeLoopCloser]:
    class Displaced(KeyframeLoopCloser):
        """Finds the camera half a metre aside, or where nobody can."""

        def relocalise(self, pyramid: sw.SurfacePyramid) -> RegistrationResult:
            result = super().relocalise(pyramid)
            if len(self.database) == 0 or (result.status is not Status.CONVERGED and status is Status.CONVERGED):
                return result
            return replace(
                result, status=Status.CONVERGED,
                T_target_source=result.T_target_source @ se3.exp([0.5, 0, 0, 0, 0, 0]),
            )  # fmt: skip

    return Displaced


def answering(*answers: Any, counts: bool = True) -> type[sw.NoLoopCloser]:
    class Answering(sw.NoLoopCloser):
        """Closes a loop with each frame."""

        STATE = {"num_closures": int}  # noqa: RUF012

        def process(self, pyramid: object, result: sw.FrameResult) -> Any:
            self.num_closures += counts
            return answers[0]

    return Answering


def correction(ids: Any = (0,), T: Any = None, dtype: type = np.int32) -> MapCorrection:
    T_new_old = np.tile(np.eye(4), (len(ids), 1, 1)) if T is None else T
    return MapCorrection(np.array(ids, dtype), T_new_old)


class Endless(sw.NoLoopCloser):
    STATE = {"num_closures": int}  # noqa: RUF012

    def conclude(self) -> MapCorrection:
        self.num_closures += 1
        return correction()


class Accepting(KeyframeLoopCloser):
    def begin_submap(self, pyramid: Any, T_world_camera: np.ndarray, frame_index: int) -> int | None:
        begun = super().begin_submap(pyramid, T_world_camera, frame_index)
        return 7 if begun is None else begun


class Staying(KeyframeLoopCloser):
    def enter(self, submap: int) -> None:
        pass


class Zero(KeyframeLoopCloser):
    def begin_submap(self, *args: Any) -> int | None:
        return None if super().begin_submap(*args) is None else 0


class JoiningInPlace(KeyframeLoopCloser):
    def join(self, join: Any) -> MapCorrection:
        moved = super().join(join)
        return replace(moved, T_new_old=np.tile(np.eye(4), (len(moved.T_new_old), 1, 1)))


class JoiningAll(KeyframeLoopCloser):
    def join(self, join: Any) -> MapCorrection:
        super().join(join)
        return correction(range(len(self.database)), np.tile(join.T_kept_joined, (len(self.database), 1, 1)))


class Keyframe(sw.NoLoopCloser):
    keyframe = -1


class Alternate:
    made, num_closures = 0, 0
    process, relocalise = sw.NoLoopCloser.process, sw.NoLoopCloser.relocalise

    def __init__(self) -> None:
        Alternate.made += 1
        self.keyframe = Alternate.made


class TestLoopCloser:
    @pytest.mark.parametrize(
        "make",
        [
            sw.NoLoopCloser,
            KeyframeLoopCloser,
            lambda: KeyframeLoopCloser(LoopClosingConfig(lag_frames=0, min_gap=2, drift=0.1)),
        ],
        ids=["none", "keyframes", "keyframes without a lag"],
    )
    def test_ours(self, make: Callable[[], sw.NoLoopCloser]) -> None:
        testing.check_loop_closer(make)

    def test_it_is_held_to_corrections(self) -> None:
        """The walk that it is tested on has loops: without, nothing would be said of corrections."""
        from scanweld.testing.loop_closers import _DRIFT, _THERE_AND_BACK, _Walk

        closer = KeyframeLoopCloser()
        answers = _Walk(closer, _DRIFT).over(_THERE_AND_BACK)
        assert closer.num_closures == sum(isinstance(answer, MapCorrection) for answer in answers) > 0

    @pytest.mark.parametrize(
        ("make", "words"),
        [
            (Guessing, "CONVERGED for a frame before any place is known"),
            (Lost, "not finite"),
            (displaced(Status.CONVERGED), "0.50 m from where the camera is"),
            (displaced(Status.NO_OVERLAP), "CONVERGED for a frame without depth"),
            (Keyframe, "expected its number, got -1"),
            (type("Closed", (sw.NoLoopCloser,), {"num_closures": 3}), "3 before any frame was seen"),
            (answering("a loop"), "expected a MapCorrection, Join or None"),
            (answering(correction(dtype=np.int64)), "keyframe_ids: expected int32"),
            (answering(correction(T=np.full((1, 4, 4), np.nan))), "not finite"),
            (answering(correction(T=2 * np.eye(4)[None])), "not a rigid transform"),
            (answering(correction((0, 0))), "corrected twice"),
            (answering(correction((4,))), "leaves out the keyframe"),
            (answering(correction(), counts=False), "closed a loop"),
            (Endless, "there is more|never becomes None"),
            (Accepting, "7 with a frame without depth"),
            (Zero, "the number of a new submap, got 0"),
            (Staying, "enter"),
            (JoiningInPlace, "do not move by T_kept_joined"),
            (JoiningAll, "move, expected"),
            (Alternate, "the same walk has other answers"),
        ],
    )
    def test_broken(self, make: Callable[[], Any], words: str) -> None:
        with breaks(words):
            testing.check_loop_closer(make)


class Onlooker:
    def __init__(
        self, look: Callable[..., Any] = lambda *_: None, ready: Callable[[float], Any] = lambda _: True
    ) -> None:
        self.look, self.ready = look, ready

    def on_frame(self, slam: sw.Slam, frame: sw.Frame | None, result: sw.FrameResult) -> None:
        self.look(slam, frame, result)

    def on_end(self, slam: sw.Slam) -> None:
        pass


def darken(slam: sw.Slam, frame: sw.Frame | None, result: sw.FrameResult) -> None:
    if frame is not None:
        frame.depth_m[:] = 0


def thin(slam: sw.Slam, frame: sw.Frame | None, result: sw.FrameResult) -> None:
    surfels = slam.mapper.map
    surfels.remove(np.arange(len(surfels)) % 2 == 0)


def nudge(slam: sw.Slam, frame: sw.Frame | None, result: sw.FrameResult) -> None:
    result.T_world_camera[0, 3] += 0.001


class TestObserver:
    def test_kept(self) -> None:
        testing.check_observer(Onlooker)

    def test_in_the_browser(self) -> None:
        pytest.importorskip("viser", reason="viser is not installed: pip install 'scanweld[view]'")
        from scanweld.viewer.live import LiveView

        with LiveView(port=0) as view:
            testing.check_observer(lambda: view)

    def test_recording(self, tmp_path: Path) -> None:
        pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'scanweld[rerun]'")
        from scanweld.viewer.rerun_sink import RerunSink

        with RerunSink(str(tmp_path / "run.rrd")) as sink:
            testing.check_observer(lambda: sink)

    @pytest.mark.parametrize(
        ("observer", "words"),
        [
            (Onlooker(darken), "on_frame: it has changed"),
            (Onlooker(nudge), "on_frame: it has changed"),
            (Onlooker(thin), "an observer has changed the run"),
            (Onlooker(ready=lambda timeout_s: None), "expected True or False"),
            (Onlooker(ready=lambda timeout_s: bool(time.sleep(0.3))), "where it may take 0.05 s"),
        ],
    )
    def test_broken(self, observer: Onlooker, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("scanweld.testing.observers._SLACK_S", 0.1)
        with breaks(words):
            testing.check_observer(lambda: observer)

    def test_never_ready(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("scanweld.testing.observers._PATIENCE_S", 0.2)
        with breaks("the run would never go on"):
            testing.check_observer(lambda: Onlooker(ready=lambda timeout_s: bool(time.sleep(timeout_s))))
