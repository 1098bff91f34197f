"""The contract of a loop closer, as a test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection
from scanweld.loop_closure.joining import Join, PlacePair
from scanweld.parallel import limited_threads
from scanweld.registration.result import RegistrationResult, Status
from scanweld.slam.stages import DeferringLoopCloser, LoopCloser, SubmapLoopCloser
from scanweld.state import Stateful
from scanweld.testing.promises import contents, described, require, require_array, require_pose, untouched
from scanweld.testing.scenes import corridor, dark, room, room_pose
from scanweld.testing.states import stored_copy
from scanweld.trajectory import FrameResult, FrameState

_THERE = list(range(0, 180, 12))
_THERE_AND_BACK = [*_THERE, *_THERE[::-1]]

_DRIFT = se3.exp([0.006, -0.004, 0.003, 0.002, 0.003, -0.001])
"""Of a tracker, from one frame of the walk to the next: 8 mm and 0.2 degrees."""

_NEAR_M = 0.05

_MOST_ANSWERS = 1000


def check_loop_closer(make: Callable[[], LoopCloser]) -> None:
    """Check that a loop closer keeps what :class:`~scanweld.slam.stages.LoopCloser` promises.

    It walks through a rendered room and back, at true poses and with drift: corrections are rigid motions of keyframes,
    each once, and are counted; a lost camera is found where it is or not at all, never by a frame without depth or of
    another building; frames and results stay as they are; the same walk gives the same answers, with one thread and
    with several. What is a :class:`~scanweld.slam.stages.DeferringLoopCloser`, a
    :class:`~scanweld.slam.stages.SubmapLoopCloser` or :class:`~scanweld.state.Stateful` is held to that, too. No loop
    has to be found.

    Parameters
    ----------
    make : makes a loop closer that knows no place, the same one each time; a class that needs no arguments is one

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    closer = make()
    require(closer.num_closures == 0, f"num_closures: {closer.num_closures} before any frame was seen")
    _keyframe(closer)
    _refuses(_relocalised(closer, room(0)), "a frame before any place is known")
    _Walk(closer).over(_THERE)
    _check_lost(closer)
    if isinstance(closer, SubmapLoopCloser):
        _check_submaps(make())
    if isinstance(closer, Stateful):
        _check_state(make)
    reference = contents(_Walk(make(), _DRIFT).over(_THERE_AND_BACK))
    for count in (1, 3):
        with limited_threads(count):
            again = contents(_Walk(make(), _DRIFT).over(_THERE_AND_BACK))
        require(again == reference, f"process: the same walk has other answers with {count} thread(s)")


class _Walk:
    """Frames as a run brings them to a loop closer: each with the pose that it was tracked at."""

    def __init__(self, closer: LoopCloser, drift: Float64 | None = None) -> None:
        self.closer, self.drift, self.count = closer, drift, 0
        self.T_drifted_true: Float64 = np.eye(4)

    def over(self, steps: list[int]) -> list[Any]:
        """Go over some steps of the path; return the answers to them, and the keyframes."""
        answers: list[Any] = []
        for step in steps:
            T = self.T_drifted_true @ room_pose(step)
            if self.drift is not None:
                self.T_drifted_true = T @ self.drift @ se3.inverse(room_pose(step))
            answers += [self.take(room(step), T), _keyframe(self.closer)]
        return [*answers, *self.conclude()]

    def take(self, pyramid: SurfacePyramid, T_world_camera: Float64) -> MapCorrection | Join | None:
        """Let it look at one frame."""
        result = FrameResult(
            index=self.count, timestamp_s=float(self.count), state=FrameState.TRACKING, T_world_camera=T_world_camera
        )
        self.count += 1
        closures = self.closer.num_closures
        with untouched("process", pyramid, result):
            answer = self.closer.process(pyramid, result)
        return self.follow(answer, closures, "process")

    def conclude(self) -> list[Any]:
        """Ask for what was put off, until there is nothing more."""
        answers: list[Any] = []
        while isinstance(self.closer, DeferringLoopCloser):
            closures = self.closer.num_closures
            answer = self.closer.conclude()
            if answer is None:
                require(self.closer.conclude() is None, "conclude: there is more after it was None")
                break
            answers.append(self.follow(answer, closures, "conclude"))
            require(len(answers) < _MOST_ANSWERS, "conclude: it never becomes None, and a run never ends")
        return answers

    def follow(self, answer: object, closures: int, call: str) -> MapCorrection | Join | None:
        """Check what was answered, and go on from where it puts the camera."""
        if answer is None or isinstance(answer, Join):
            return answer
        correction = _correction(answer, call)
        count = self.closer.num_closures
        require(count > closures, f"num_closures: {count} as before, though {call} has closed a loop")
        mine = correction.keyframe_ids == _keyframe(self.closer)
        require(mine.any(), f"{call}: the correction leaves out the keyframe that the camera moves with")
        self.T_drifted_true = correction.T_new_old[mine][0] @ self.T_drifted_true
        return correction


def _correction(answer: object, call: str) -> MapCorrection:
    require(
        isinstance(answer, MapCorrection), f"{call}: expected a MapCorrection, Join or None, got {described(answer)}"
    )
    assert isinstance(answer, MapCorrection)
    ids, T_new_old = answer.keyframe_ids, answer.T_new_old
    require_array(ids, np.int32, (len(ids),), f"{call}: keyframe_ids")
    require_array(T_new_old, np.float64, (len(ids), 4, 4), f"{call}: T_new_old")
    require(len(np.unique(ids)) == len(ids), f"{call}: a keyframe is corrected twice")
    for T in T_new_old:
        require_pose(T, f"{call}: T_new_old")
    return answer


def _keyframe(closer: LoopCloser) -> int:
    number = closer.keyframe
    require(isinstance(number, int | np.integer) and number >= 0, f"keyframe: expected its number, got {number!r}")
    return int(number)


def _relocalised(closer: LoopCloser, pyramid: SurfacePyramid) -> RegistrationResult:
    with untouched("relocalise", pyramid):
        result = closer.relocalise(pyramid)
    return _looked_for(result, "relocalise")


def _looked_for(result: RegistrationResult, call: str) -> RegistrationResult:
    require(isinstance(result, RegistrationResult), f"{call}: expected a RegistrationResult, got {described(result)}")
    require(isinstance(result.status, Status), f"{call}: expected a Status, got {result.status!r}")
    require_pose(result.T_target_source, f"{call}: T_target_source")
    return result


def _refuses(result: RegistrationResult, what: str) -> None:
    require(not result.status.success, f"relocalise: CONVERGED for {what}")
    require(bool(result.note), f"note: it is empty, and says nothing of why the camera was not found by {what}")


def _check_lost(closer: LoopCloser) -> None:
    _refuses(_relocalised(closer, dark()), "a frame without depth")
    _refuses(_relocalised(closer, corridor()), "a frame of another building")
    for step in (_THERE[0], _THERE[5], _THERE[8] + 4):
        result = _relocalised(closer, room(step))
        away_m = float(np.linalg.norm(result.T_target_source[:3, 3] - room_pose(step)[:3, 3]))
        require(
            not result.status.success or away_m < _NEAR_M,
            f"relocalise: CONVERGED {away_m:.2f} m from where the camera is; only what is known is CONVERGED",
        )


def _check_submaps(closer: Any) -> None:
    walk = _Walk(closer)
    walk.over(_THERE)
    before = _keyframe(closer)
    with untouched("begin_submap", dark()):
        begun = closer.begin_submap(dark(), np.eye(4), walk.count)
    require(begun is None, f"begin_submap: {begun!r} with a frame without depth, which nobody can recognise")
    require(_keyframe(closer) == before, "begin_submap: the keyframe is another one though no submap was begun")
    submap = closer.begin_submap(room(_THERE[-1]), np.eye(4), walk.count)
    if submap is None:
        return
    require(
        isinstance(submap, int) and submap > 0, f"begin_submap: expected the number of a new submap, got {submap!r}"
    )
    first = _keyframe(closer)
    require(first != before, "begin_submap: the keyframe is that of the submap before")
    for pyramid, what in ((dark(), "a frame without depth"), (corridor(), "a frame of another building")):
        _refuses(_looked_for(closer.look_for(pyramid)[1], "look_for"), what)
    found, result = closer.look_for(room(_THERE[2]))
    _looked_for(result, "look_for")
    if result.status.success:
        require(found == 0, f"look_for: submap {found!r} for a place of submap 0")
    closer.enter(0)
    require(_keyframe(closer) == before, "enter: the keyframe is not the one that the camera was at in this submap")
    T_kept_joined, pair = room_pose(_THERE[-1]), PlacePair(before, first, np.eye(4), np.eye(6))
    moved = _correction(closer.join(Join(0, submap, T_kept_joined, (pair, pair))), "join")
    require(moved.keyframe_ids.tolist() == [first], f"join: keyframes {moved.keyframe_ids} move, expected [{first}]")
    require(np.allclose(moved.T_new_old[0], T_kept_joined), "join: the keyframes do not move by T_kept_joined")
    walk.over(_THERE[-3:])


def _check_state(make: Callable[[], Any]) -> None:
    before, rest = _THERE_AND_BACK[:-5], _THERE_AND_BACK[-5:]
    walk = _Walk(make())
    for step in before:  # without asking for what was put off
        walk.take(room(step), room_pose(step))
    again = _Walk(stored_copy(walk.closer, make(), type(walk.closer).__name__))
    again.count = walk.count
    require(
        contents(again.over(rest)) == contents(walk.over(rest)),
        "STATE: a loop closer that was stored and restored goes on in another way",
    )
