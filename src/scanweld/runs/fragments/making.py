"""A fragment: a part of a recording that is tracked and fused by itself, and what is kept of it on disk.

Its folder holds `fragment.swc` (what happened to each frame, the graph of keyframes), `keyframes.swc` (the keyframes
themselves) and `map-K.swc` for each submap K, all in the format of checkpoints (docs/checkpoints.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from scanweld.arrays import Float64, Int64
from scanweld.checkup.first_look import FirstLook
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.selection import select
from scanweld.errors import FileFormatError
from scanweld.geometry.frame import Frame
from scanweld.loop_closure.loop_closer import KeyframeLoopCloser
from scanweld.loop_closure.place_recognition import KeyframeDatabase
from scanweld.loop_closure.search import Edge
from scanweld.mapping.mapper import SurfelMapper
from scanweld.parallel import limited_threads
from scanweld.runs.checkpoint import encoding, file
from scanweld.runs.checkpoint.identity import identity_of
from scanweld.runs.fragments.exchange import Exchange
from scanweld.runs.storage.urls import names_in
from scanweld.runs.summary import peak_rss_mb
from scanweld.runs.walk import Tally, process_all
from scanweld.slam.config import SlamConfig
from scanweld.slam.frame_log import FrameLog
from scanweld.slam.parts import Part
from scanweld.slam.system import build_slam
from scanweld.slam.warmup import compile_kernels
from scanweld.state import Stateful
from scanweld.trajectory import FrameResult

OpenSequence = Callable[[], RgbdSequence]
"""Opens a recording; on another process, too, so that it must be what `pickle` can send: a function with arguments."""

FRAGMENT, KEYFRAMES = "fragment.swc", "keyframes.swc"

FRAGMENT_FOLDER = "fragment-"
"""What the names of the folders of fragments begin with."""


def _name(part: int, file_name: str) -> str:
    """Return the name of a file of a fragment in the exchange."""
    return f"{FRAGMENT_FOLDER}{part:04d}/{file_name}"


class Fragment(Stateful):
    """What the whole run has to know of a fragment: little, whatever its length.

    Attributes
    ----------
    frames : what happened to each frame, in the worlds of the fragment's submaps
    keyframe_frames : (K,) frame of each keyframe, counted from the first of the fragment
    T_world_keyframe : (K, 4, 4)
    submaps : (K,) of each keyframe
    edges : between keyframes
    num_closures, num_joins : loops closed, and submaps joined
    num_points_input : valid depth pixels, without the frames that the part before has, too
    median_depth_m : of the first frame with depth
    content : checksum of what its frames show
    warnings : what the run warned of
    peak_rss_mb : memory of the process that made it
    """

    STATE: ClassVar = {
        "frames": Stateful, "keyframe_frames": Int64, "T_world_keyframe": Float64, "submaps": Int64,
        "edges": list[Edge], "num_closures": int, "num_joins": int, "num_points_input": int, "median_depth_m": float,
        "content": int,
        "warnings": list[str], "peak_rss_mb": float | None,
    }  # fmt: skip

    def __init__(self) -> None:
        self.frames = FrameLog()
        self.keyframe_frames: Int64 = np.empty(0, np.int64)
        self.T_world_keyframe: Float64 = np.empty((0, 4, 4))
        self.submaps: Int64 = np.empty(0, np.int64)
        self.edges: list[Edge] = []
        self.num_closures = self.num_joins = self.num_points_input = self.content = 0
        self.median_depth_m = 0.0
        self.warnings: list[str] = []
        self.peak_rss_mb: float | None = None

    def restored(self) -> None:
        """Check that all is of the same keyframes."""
        count = len(self.keyframe_frames)
        right = self.T_world_keyframe.shape == (count, 4, 4) and self.submaps.shape == (count,)
        if not right or not all(0 <= k < count for edge in self.edges for k in (edge.i, edge.j)):
            raise ValueError("keyframes that are not there")


@dataclass(frozen=True, slots=True)
class Workplace:
    """Where fragments are kept, and how they are made.

    Attributes
    ----------
    exchange : of all workers
    config : of the run
    threads : of each task
    """

    exchange: Exchange
    config: SlamConfig
    threads: int = 1


def make_fragment(place: Workplace, open_sequence: OpenSequence, part: Part) -> int:
    """Track and fuse a part of a recording, and write what comes of it; returns the part's number.

    A fragment that is there already, of the same frames, configuration and program, is left as it is.
    """
    whole = open_sequence()
    sequence, header = select(whole, slice(part.start, part.stop)), _header(place, whole, part)
    if _is_there(place, part.index, header):
        return part.index
    with limited_threads(place.threads):
        compile_kernels(lambda _: None)
        slam, tally = build_slam(sequence.camera, place.config), Tally()
        look = FirstLook(sequence) if part.index == 0 else None
        made, closer = Fragment(), slam.loop_closer

        def count(_: object, frame: Frame | None, result: FrameResult) -> None:
            if frame is not None and result.index >= part.shared:
                made.num_points_input += int(np.count_nonzero(frame.depth_m))

        process_all(slam, sequence, tally, None, count, look=look)
        slam.finish()
        made.frames = slam.results
        database = KeyframeDatabase(place.config.loop_closing.places)
        if isinstance(closer, KeyframeLoopCloser):
            database, made.submaps, made.edges = closer.database, closer.submaps, closer.edges
        made.keyframe_frames = np.array([keyframe.frame_index for keyframe in database.keyframes], np.int64)
        made.T_world_keyframe = np.array([k.T_world_camera for k in database.keyframes]).reshape(-1, 4, 4)
        made.num_closures, made.num_joins = slam.num_closures, slam.num_joins
        made.median_depth_m, made.content = tally.median_depth_m, tally.content
        made.warnings = [f"{part}: {warning}" for warning in tally.warnings]
        for submap, surfels in slam.maps.items():
            _write(place, part.index, f"map-{submap}.swc", header, surfels)
        _write(place, part.index, KEYFRAMES, header, database)
        made.peak_rss_mb = peak_rss_mb()
        _write(place, part.index, FRAGMENT, header, made)  # last: where it is, all is
    return part.index


def finished_in(exchange: str) -> list[int]:
    """Return the numbers of the fragments that are finished in an exchange, path or URL.

    Raises
    ------
    OutputError
        When the storage cannot be reached.
    """
    folders = (name.removesuffix(f"/{FRAGMENT}") for name in names_in(exchange) if name.endswith(f"/{FRAGMENT}"))
    numbers = (folder.removeprefix(FRAGMENT_FOLDER) for folder in folders if folder.startswith(FRAGMENT_FOLDER))
    return sorted(int(number) for number in numbers if number.isdecimal())


def left_unfit(place: Workplace, sequence: RgbdSequence, parts: Sequence[Part]) -> list[int]:
    """Return the numbers of fragments left there that are none of the run's: it has others in their place, or none."""
    # With copies of its own where it is behind a URL: what is made anew has the same names.
    seen = replace(place, exchange=Exchange(place.exchange.place))

    def fits(number: int) -> bool:
        return number < len(parts) and _is_there(seen, number, _header(place, sequence, parts[number]))

    return [number for number in finished_in(place.exchange.place) if not fits(number)]


def read_fragment(place: Workplace, part: int) -> Fragment:
    """Return what the whole run has to know of a fragment."""
    fragment = Fragment()
    _read(place, part, FRAGMENT, fragment)
    return fragment


def read_keyframes(place: Workplace, part: int) -> KeyframeDatabase:
    """Return the keyframes of a fragment, in its own worlds."""
    database = KeyframeDatabase(place.config.loop_closing.places)
    _read(place, part, KEYFRAMES, database)
    return database


def read_map(place: Workplace, part: int, submap: int) -> SurfelMapper:
    """Return the map of a submap of a fragment, and what shows it."""
    mapper = SurfelMapper(place.config.fusion, place.config.map)
    _read(place, part, f"map-{submap}.swc", mapper.map)
    return mapper


def _header(place: Workplace, whole: RgbdSequence, part: Part) -> Mapping[str, Any]:
    """Return what a fragment is of."""
    return identity_of(select(whole, slice(part.start, part.stop)), place.config, None)


def _is_there(place: Workplace, part: int, header: Mapping[str, Any]) -> bool:
    try:
        with file.CheckpointFile(place.exchange.read(_name(part, FRAGMENT))) as stored:
            return stored.header == header
    except FileFormatError:
        return False


def _write(place: Workplace, part: int, name: str, header: Mapping[str, Any], state: Stateful) -> None:
    with place.exchange.written(_name(part, name)) as path:
        file.write(path, header, encoding.encode(state, Stateful))


def _read(place: Workplace, part: int, name: str, state: Stateful) -> None:
    path = place.exchange.read(_name(part, name))
    with file.CheckpointFile(path) as stored:
        try:
            encoding.restore(stored, state)
        except (ValueError, IndexError, TypeError, OverflowError, MemoryError) as error:
            raise FileFormatError(f"{path}: is no part of a fragment ({error})") from None
