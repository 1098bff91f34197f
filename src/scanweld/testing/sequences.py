"""The contracts of an RGB-D sequence, a camera, and a gyroscope beside them, as tests."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import islice, pairwise

import numpy as np

from scanweld.arrays import Float64
from scanweld.datasets.base import LiveSequence, RgbdSequence
from scanweld.datasets.gyroscope import Gyroscope, HasGyroscope
from scanweld.datasets.images import check_depth_unit
from scanweld.errors import UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.testing.promises import contents, described, require
from scanweld.trajectory import Trajectory


def check_sequence(sequence: RgbdSequence, *, max_frames: int = 16) -> None:
    """Check that a reader keeps what :class:`~scanweld.datasets.base.RgbdSequence` promises.

    It looks at names and lengths; times, which increase; shapes, types and units; that reading frames in any order, or
    on several threads, gives what iterating gives; that frames share no memory; and that the ground truth is rigid and
    of the time of the frames, as is a gyroscope where there is one. An unreadable frame is no fault as long as it
    stays unreadable.

    Parameters
    ----------
    sequence : what the reader opened
    max_frames : number of frames that are decoded, from the first one

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    require(isinstance(sequence, RgbdSequence), "it has not all the attributes and methods of RgbdSequence")
    _check_description(sequence)
    _check_times(sequence)
    count = min(len(sequence), max_frames)
    iterated = {frame.timestamp_s: frame for frame in islice(sequence, count)}
    require(bool(iterated), "iterating yields no frame")
    for frame in iterated.values():
        _check_frame(frame, sequence)
    _check_unit(list(iterated.values()), sequence.depth_scale)
    _check_random_access(sequence, iterated, count)
    _check_threads(sequence, iterated, count)
    _check_ground_truth(sequence)
    if isinstance(sequence, HasGyroscope):
        check_gyroscope(sequence)


def _check_description(sequence: RgbdSequence) -> None:
    require(isinstance(sequence.name, str) and bool(sequence.name), f"name: expected text, got {sequence.name!r}")
    require("\n" not in sequence.name and "/" not in sequence.name, f"name: {sequence.name!r} is no name of a folder")
    require(isinstance(sequence.camera, PinholeCamera), f"camera: expected a PinholeCamera, got {sequence.camera!r}")
    scale = sequence.depth_scale
    require(np.isfinite(scale) and scale > 0, f"depth_scale: expected a positive number, got {scale!r}")
    require(len(sequence) > 0, "it has no frame; a reader raises DatasetError instead")


def _check_times(sequence: RgbdSequence) -> None:
    times = sequence.timestamps_s
    require(
        isinstance(times, np.ndarray) and times.dtype == np.float64 and times.shape == (len(sequence),),
        f"timestamps_s: expected float64 ({len(sequence)},), got {getattr(times, 'dtype', type(times))} "
        f"{np.shape(times)}",
    )
    require(bool(np.isfinite(times).all()), "timestamps_s: a time is not finite")
    later = np.diff(times) > 0
    if not later.all():
        raise AssertionError(f"timestamps_s: frame {int(np.argmin(later)) + 1} is not later than the one before")


def _check_frame(frame: Frame, sequence: RgbdSequence) -> None:
    where = f"frame at {frame.timestamp_s:.6f} s"
    require(frame.timestamp_s in sequence.timestamps_s, f"{where}: its time is none of timestamps_s")
    require(frame.camera == sequence.camera, f"{where}: its camera is not that of the sequence")
    require(bool((frame.depth_m > 0).any()), f"{where}: no pixel has depth")
    # Type, shape, and values that are finite and not negative are what Frame itself insists on.
    for name, image in (("depth_m", frame.depth_m), ("color", frame.color)):
        if image is not None:
            require(
                image.flags.c_contiguous and image.flags.writeable,
                f"{where}: {name} must be contiguous and writable (kernels are compiled for such arrays)",
            )


def _check_unit(frames: list[Frame], depth_scale: float) -> None:
    valid = np.concatenate([frame.depth_m[frame.depth_m > 0] for frame in frames])
    doubt = check_depth_unit(float(np.median(valid)), depth_scale)
    require(doubt is None, f"depth_m: {doubt}")


def _check_random_access(sequence: RgbdSequence, iterated: dict[float, Frame], count: int) -> None:
    # Backwards, then with jumps: what was read before must not matter.
    order = [*range(count - 1, -1, -1), *range(0, count, 3), *range(1, count, 3)]
    for index in order:
        _compare(sequence, index, iterated)
    first = next(iter(iterated.values()))
    again = sequence.read(int(np.searchsorted(sequence.timestamps_s, first.timestamp_s)))
    for one, other in ((first.depth_m, again.depth_m), (first.color, again.color)):
        shared = one is not None and other is not None and np.shares_memory(one, other)
        require(not shared, "read: two frames share memory; changing one would change the other")
    for index in (len(sequence), len(sequence) + 7):
        try:
            sequence.read(index)
        except IndexError:
            continue
        raise AssertionError(f"read: frame {index} of {len(sequence)} must raise IndexError")


def _check_threads(sequence: RgbdSequence, iterated: dict[float, Frame], count: int) -> None:
    with ThreadPoolExecutor(max_workers=4) as pool:
        # Each frame is asked for twice, by different threads, at nearly the same time.
        list(pool.map(lambda index: _compare(sequence, index // 2, iterated), range(2 * count)))


def _compare(sequence: RgbdSequence, index: int, iterated: dict[float, Frame]) -> None:
    time = float(sequence.timestamps_s[index])
    try:
        frame = sequence.read(index)
    except UnreadableFrameError:
        require(time not in iterated, f"read: frame {index} is unreadable, iterating yielded it")
        return
    require(time in iterated, f"read: frame {index} is readable, iterating left it out")
    expected = iterated[time]
    require(frame.timestamp_s == time, f"read: frame {index} has time {frame.timestamp_s}, timestamps_s {time}")
    require(np.array_equal(frame.depth_m, expected.depth_m), f"read: depth of frame {index} differs from iterating")
    require(contents(frame.color) == contents(expected.color), f"read: colour of frame {index} differs from iterating")


def _check_ground_truth(sequence: RgbdSequence) -> None:
    truth = sequence.ground_truth
    if truth is None:
        return
    require(isinstance(truth, Trajectory), f"ground_truth: expected a Trajectory or None, got {type(truth).__name__}")
    rotation = truth.T_world_camera[:, :3, :3]
    defect = float(np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max())
    require(defect < 1e-9 and bool((np.linalg.det(rotation) > 0).all()), "ground_truth: a rotation is none")
    _check_overlap("ground_truth", truth.timestamps_s, sequence)


def check_live_sequence(sequence: LiveSequence, *, max_frames: int = 5) -> None:
    """Check that a camera keeps what :class:`~scanweld.datasets.base.LiveSequence` promises.

    Its frames come once, each later than the one before, and are counted as they come; `close` ends them, and may be
    called again. Afterwards the camera is closed.

    Parameters
    ----------
    sequence : the camera; no frame was asked for yet
    max_frames : number of frames that are asked for; fewer may come

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    require(isinstance(sequence, LiveSequence), "it has not all the attributes and methods of LiveSequence")
    require(len(sequence) == 0, f"len: {len(sequence)} before a frame was asked for; a camera counts those so far")
    frames = sequence.live()
    came: list[Frame] = []
    try:
        for frame in islice(frames, max_frames):
            came.append(frame)
            require(len(sequence) == len(came), f"len: {len(sequence)} after {len(came)} frames have come")
            _check_description(sequence)
            _check_times(sequence)
            last_s = float(sequence.timestamps_s[-1])
            require(frame.timestamp_s == last_s, f"timestamps_s: the last is {last_s}, the frame's {frame.timestamp_s}")
            _check_frame(frame, sequence)
        require(bool(came), "live: no frame has come")
        for one, other in pairwise(came):
            require(not np.shares_memory(one.depth_m, other.depth_m), "live: two frames share memory")
    finally:
        sequence.close()
    require(next(iter(frames), None) is None, "close: frames still come after it")
    sequence.close()


def check_gyroscope(sequence: HasGyroscope) -> None:
    """Check that a sequence keeps what :class:`~scanweld.datasets.gyroscope.HasGyroscope` promises.

    What it measured is a :class:`~scanweld.datasets.gyroscope.Gyroscope` on the clock of the images, or None.

    Parameters
    ----------
    sequence : what the reader opened

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    require(isinstance(sequence, HasGyroscope), "it has no attribute `gyroscope`")
    gyroscope = sequence.gyroscope
    if gyroscope is None:
        return
    require(isinstance(gyroscope, Gyroscope), f"gyroscope: expected a Gyroscope or None, got {described(gyroscope)}")
    require(sequence.gyroscope is gyroscope, "gyroscope: it is read anew each time")
    if isinstance(sequence, RgbdSequence):
        _check_overlap("gyroscope", gyroscope.timestamps_s, sequence)


def _check_overlap(name: str, times_s: Float64, sequence: RgbdSequence) -> None:
    """Require that what was measured beside the frames is of their time."""
    first, last = float(sequence.timestamps_s[0]), float(sequence.timestamps_s[-1])
    require(
        times_s[0] <= last + 1 and times_s[-1] >= first - 1,
        f"{name}: its times {times_s[0]:.3f} to {times_s[-1]:.3f} s are not those of the frames, {first:.3f} to "
        f"{last:.3f} s",
    )
