"""The contract of an RGB-D sequence, as a test."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numpy as np

from scanweld.arrays import Array
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.images import check_depth_unit
from scanweld.errors import UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.trajectory import Trajectory


def check_sequence(sequence: RgbdSequence, *, max_frames: int = 16) -> None:
    """Check that a reader keeps what :class:`~scanweld.datasets.base.RgbdSequence` promises.

    It looks at names and lengths; times, which increase; shapes, types and units; that reading frames in any order, or
    on several threads, gives what iterating gives; that frames share no memory; and that the ground truth is rigid and
    of the time of the frames. An unreadable frame is no fault as long as it stays unreadable.

    Parameters
    ----------
    sequence : what the reader opened
    max_frames : number of frames that are decoded, from the first one

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    _require(isinstance(sequence, RgbdSequence), "it has not all the attributes and methods of RgbdSequence")
    _check_description(sequence)
    _check_times(sequence)
    count = min(len(sequence), max_frames)
    iterated = {frame.timestamp_s: frame for frame in islice(sequence, count)}
    _require(bool(iterated), "iterating yields no frame")
    for frame in iterated.values():
        _check_frame(frame, sequence)
    _check_unit(list(iterated.values()), sequence.depth_scale)
    _check_random_access(sequence, iterated, count)
    _check_threads(sequence, iterated, count)
    _check_ground_truth(sequence)


def _check_description(sequence: RgbdSequence) -> None:
    _require(isinstance(sequence.name, str) and bool(sequence.name), f"name: expected text, got {sequence.name!r}")
    _require("\n" not in sequence.name and "/" not in sequence.name, f"name: {sequence.name!r} is no name of a folder")
    _require(isinstance(sequence.camera, PinholeCamera), f"camera: expected a PinholeCamera, got {sequence.camera!r}")
    scale = sequence.depth_scale
    _require(np.isfinite(scale) and scale > 0, f"depth_scale: expected a positive number, got {scale!r}")
    _require(len(sequence) > 0, "it has no frame; a reader raises DatasetError instead")


def _check_times(sequence: RgbdSequence) -> None:
    times = sequence.timestamps_s
    _require(
        isinstance(times, np.ndarray) and times.dtype == np.float64 and times.shape == (len(sequence),),
        f"timestamps_s: expected float64 ({len(sequence)},), got {getattr(times, 'dtype', type(times))} "
        f"{np.shape(times)}",
    )
    _require(bool(np.isfinite(times).all()), "timestamps_s: a time is not finite")
    later = np.diff(times) > 0
    _require(bool(later.all()), f"timestamps_s: frame {int(np.argmin(later)) + 1} is not later than the one before")


def _check_frame(frame: Frame, sequence: RgbdSequence) -> None:
    where = f"frame at {frame.timestamp_s:.6f} s"
    _require(frame.timestamp_s in sequence.timestamps_s, f"{where}: its time is none of timestamps_s")
    _require(frame.camera == sequence.camera, f"{where}: its camera is not that of the sequence")
    _require(bool((frame.depth_m > 0).any()), f"{where}: no pixel has depth")
    # Type, shape, and values that are finite and not negative are what Frame itself insists on.
    for name, image in (("depth_m", frame.depth_m), ("color", frame.color)):
        if image is not None:
            _require(
                image.flags.c_contiguous and image.flags.writeable,
                f"{where}: {name} must be contiguous and writable (kernels are compiled for such arrays)",
            )


def _check_unit(frames: list[Frame], depth_scale: float) -> None:
    valid = np.concatenate([frame.depth_m[frame.depth_m > 0] for frame in frames])
    doubt = check_depth_unit(float(np.median(valid)), depth_scale)
    _require(doubt is None, f"depth_m: {doubt}")


def _check_random_access(sequence: RgbdSequence, iterated: dict[float, Frame], count: int) -> None:
    # Backwards, then with jumps: what was read before must not matter.
    order = [*range(count - 1, -1, -1), *range(0, count, 3), *range(1, count, 3)]
    for index in order:
        _compare(sequence, index, iterated)
    first = next(iter(iterated.values()))
    again = sequence.read(int(np.searchsorted(sequence.timestamps_s, first.timestamp_s)))
    for one, other in ((first.depth_m, again.depth_m), (first.color, again.color)):
        shared = one is not None and other is not None and np.shares_memory(one, other)
        _require(not shared, "read: two frames share memory; changing one would change the other")
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
        _require(time not in iterated, f"read: frame {index} is unreadable, iterating yielded it")
        return
    _require(time in iterated, f"read: frame {index} is readable, iterating left it out")
    expected = iterated[time]
    _require(frame.timestamp_s == time, f"read: frame {index} has time {frame.timestamp_s}, timestamps_s {time}")
    _require(np.array_equal(frame.depth_m, expected.depth_m), f"read: depth of frame {index} differs from iterating")
    _require(_same(frame.color, expected.color), f"read: colour of frame {index} differs from iterating")


def _same(one: Array | None, other: Array | None) -> bool:
    return (one is None) == (other is None) and (one is None or other is None or np.array_equal(one, other))


def _check_ground_truth(sequence: RgbdSequence) -> None:
    truth = sequence.ground_truth
    if truth is None:
        return
    _require(isinstance(truth, Trajectory), f"ground_truth: expected a Trajectory or None, got {type(truth).__name__}")
    rotation = truth.T_world_camera[:, :3, :3]
    defect = float(np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max())
    _require(defect < 1e-9 and bool((np.linalg.det(rotation) > 0).all()), "ground_truth: a rotation is none")
    first, last = float(sequence.timestamps_s[0]), float(sequence.timestamps_s[-1])
    _require(
        truth.timestamps_s[0] <= last + 1 and truth.timestamps_s[-1] >= first - 1,
        f"ground_truth: its times {truth.timestamps_s[0]:.3f} to {truth.timestamps_s[-1]:.3f} s are not those of the "
        f"frames, {first:.3f} to {last:.3f} s",
    )


def _require(satisfied: bool, fault: str) -> None:
    if not satisfied:
        raise AssertionError(fault)
