"""The contract of an observer, as a test."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from scanweld.runs.observer import RunObserver
from scanweld.slam.system import Slam, build_slam
from scanweld.testing.promises import contents, require, untouched
from scanweld.testing.scenes import CAMERA, dark, room
from scanweld.trajectory import FrameResult

_ASKED_S = 0.05
_SLACK_S = 5.0  # of a busy machine
_PATIENCE_S = 10.0


def check_observer(make: Callable[[], RunObserver]) -> None:
    """Check that an observer keeps what :class:`~scanweld.runs.observer.RunObserver` promises.

    It looks on at a short run of a rendered room, with a frame without depth, one that could not be read, and a second
    beginning: trajectory, map and results must be those of a run that nobody looks on at, and frames stay as they are;
    an answer of no comes within the time that was given, and sooner or later the run may go on.

    Parameters
    ----------
    make : makes an observer of a run that has not begun; a class that needs no arguments is one

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    require(_run([make()]) == _run(()), "an observer has changed the run: trajectory, map or results are others")


def _run(observers: Sequence[RunObserver]) -> Any:
    """Return what a run came to: it is begun again after a frame, as where a camera was calibrated."""
    _part(build_slam(CAMERA), range(1), observers)
    slam = build_slam(CAMERA)
    _part(slam, range(5), observers)
    for observer in observers:
        observer.on_end(slam)
    results = [replace(result, stage_ms={}) for result in slam.results]
    return contents([results, slam.trajectory, slam.map.columns()])


def _part(slam: Slam, indices: range, observers: Sequence[RunObserver]) -> None:
    for index in indices:
        pyramid = room(index) if index != 3 else dark()
        frame = replace(pyramid.frame, timestamp_s=room(index).frame.timestamp_s)
        result = slam.process(frame)
        for observer in observers:
            with untouched("on_frame", frame, replace(result, stage_ms={})):
                observer.on_frame(slam, frame, result)
        _wait(observers)
    unread: FrameResult = slam.skip(room(len(indices)).frame.timestamp_s, "damaged")
    for observer in observers:
        observer.on_frame(slam, None, unread)
    _wait(observers)


def _wait(observers: Sequence[RunObserver]) -> None:
    """Ask until the run may go on."""
    for observer in observers:
        began_s = time.monotonic()
        while True:
            asked_s = time.monotonic()
            answer = observer.ready(_ASKED_S)
            now_s = time.monotonic()
            require(isinstance(answer, bool), f"ready: expected True or False, got {answer!r}")
            if answer:
                break
            require(
                now_s - asked_s < _ASKED_S + _SLACK_S,
                f"ready: no after {now_s - asked_s:.2f} s, where it may take {_ASKED_S} s",
            )
            require(now_s - began_s < _PATIENCE_S, f"ready: no for {_PATIENCE_S:.0f} s; the run would never go on")
