"""The contract of a tracker, as a test."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanweld.arrays import Float64
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import ModelView
from scanweld.parallel import limited_threads
from scanweld.registration.result import RegistrationResult, Status
from scanweld.slam.stages import Tracker
from scanweld.testing.promises import contents, described, require, require_array, require_pose, untouched
from scanweld.testing.scenes import as_map, corridor, dark, room, room_pose, wall

_WRONG = se3.exp([0.03, -0.02, 0.02, 0.02, 0.015, -0.01])
"""A prediction is off by 4 cm and 1.5 degrees: as much as between two frames of a hurried hand."""

_SYMMETRIC = 1e-6  # of what the numbers are at most


def check_tracker(make: Callable[[], Tracker]) -> None:
    """Check that a tracker keeps what :class:`~scanweld.slam.stages.Tracker` promises.

    It aligns frames of a rendered room with maps that are known, from a prediction that is off: the answer is
    T_world_camera and nearer to the truth; `information` is symmetric and not negative; nothing that was passed
    changes; the same call gives the same bytes, with one thread and with several. Where there is no answer (no depth,
    an empty map, another building) or only part of one (a blank wall), the status says so, and nothing is NaN.

    Parameters
    ----------
    make : makes a tracker, the same one each time; a class that needs no arguments is one

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    true = room_pose(3)
    near, here, predicted = as_map(room(0), room_pose(0)), room(3), true @ _WRONG
    result = _tracked(make(), here, near, predicted)
    require(
        result.status is Status.CONVERGED,
        f"track: {result.status.name} ({result.note}) for a room seen from 6 cm aside; expected CONVERGED",
    )
    require(
        _apart(result.T_target_source, true) < 0.25 * _apart(predicted, true),
        f"track: {_apart(result.T_target_source, true):.4f} m from the truth, the prediction was "
        f"{_apart(predicted, true):.4f} m from it; T_target_source is T_world_camera, which moves points of the frame "
        "into the map",
    )
    require(0 < result.overlap <= 1, f"overlap: expected a share of the map's points, got {result.overlap!r}")
    require(result.num_inliers > 0, f"num_inliers: expected those of the last step, got {result.num_inliers!r}")
    _check_repetition(make, here, near, predicted)
    nothing = as_map(dark(), true)
    for frame, view, what in (
        (dark(), near, "a frame without depth"),
        (here, nothing, "an empty map"),
        (dark(), nothing, "a frame without depth and an empty map"),
    ):
        _refuses(_tracked(make(), frame, view, predicted), what)
    result = _tracked(make(), corridor(), near, predicted)
    require(
        not result.status.success,
        f"track: {result.status.name} for a frame of another building; only what was measured is CONVERGED",
    )
    _check_free_motion(make())


def _tracked(tracker: Tracker, pyramid: SurfacePyramid, view: ModelView, T_world_camera: Float64) -> RegistrationResult:
    """Return what a tracker says; the result is of the right form, and the arguments stay as they are."""
    with untouched("track", pyramid, view, T_world_camera):
        result = tracker.track(pyramid, view, T_world_camera)
    require(isinstance(result, RegistrationResult), f"track: expected a RegistrationResult, got {described(result)}")
    require(isinstance(result.status, Status), f"status: expected a Status, got {result.status!r}")
    require_pose(result.T_target_source, "T_target_source")
    H = result.information
    require_array(H, np.float64, (6, 6), "information")
    scale = max(float(np.abs(H).max()), 1.0)
    require(np.abs(H - H.T).max() <= _SYMMETRIC * scale, "information: not symmetric")
    require(np.linalg.eigvalsh(H).min() >= -_SYMMETRIC * scale, "information: a direction has less than none")
    return result


def _check_repetition(make: Callable[[], Tracker], pyramid: SurfacePyramid, view: ModelView, T: Float64) -> None:
    """The answer depends on the arguments alone: not on threads, nor on what was tracked before."""
    tracker = make()
    first = contents(_tracked(tracker, pyramid, view, T))
    _tracked(tracker, dark(), view, T)
    require(contents(_tracked(tracker, pyramid, view, T)) == first, "track: another answer after another frame")
    for count in (1, 3):
        with limited_threads(count):
            again = contents(_tracked(make(), pyramid, view, T))
        require(again == first, f"track: another answer with {count} thread(s)")


def _refuses(result: RegistrationResult, what: str) -> None:
    require(
        not result.status.has_pose,
        f"track: {result.status.name} for {what}; expected TOO_FEW_CORRESPONDENCES or NO_OVERLAP, not a pose",
    )
    require(bool(result.note), f"note: it is empty, and says nothing of why there is no pose for {what}")


def _check_free_motion(tracker: Tracker) -> None:
    """Sliding along a blank wall is not seen: that is said, and the pose stays where it was expected."""
    T_world_wall = room_pose(0)
    T_camera = se3.exp([0.03, 0.02, 0.01, 0, 0, 0])
    result = _tracked(tracker, wall(1.5), as_map(wall(1.5), T_world_wall), T_world_wall @ T_camera)
    require(
        not result.status.success,
        "track: CONVERGED for a blank wall; expected DEGENERATE, as nothing tells where along it the camera is",
    )
    if result.status is not Status.DEGENERATE:
        return
    require(len(result.unobservable) >= 3, f"unobservable: expected 3 motions that are free, got {result.unobservable}")
    moved = se3.inverse(T_world_wall) @ result.T_target_source
    require(
        float(np.linalg.norm(moved[:2, 3] - T_camera[:2, 3])) < 0.01,
        f"track: the camera slid from {T_camera[:2, 3]} to {moved[:2, 3]} along a blank wall; expected the prediction",
    )


def _apart(T: Float64, T_true: Float64) -> float:
    """How far points a metre in front of the camera are from where they should be [m]."""
    shift, turn = np.split(se3.log(se3.inverse(T_true) @ T), 2)
    return float(np.hypot(np.linalg.norm(shift), np.linalg.norm(turn)))
