"""Two fragments tied together: by the frames that both have seen, and by their keyframes and maps."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from scanweld.geometry import se3
from scanweld.loop_closure import linking
from scanweld.loop_closure.linking import Linker, Place, common_motion
from scanweld.loop_closure.search import Edge, tracked_edge
from scanweld.parallel import limited_threads
from scanweld.runs.fragments.making import Fragment, Workplace, read_fragment, read_keyframes, read_map
from scanweld.slam.motion import POSED
from scanweld.slam.parts import Part
from scanweld.tracking.tracker import FrameToModelTracker


def link_fragments(place: Workplace, a: Part, b: Part) -> list[Edge]:
    """Return the edges from keyframes of one fragment to those of a later one; none where nothing ties them.

    Those that are no loops are from frames that both have seen.
    """
    config = place.config.loop_closing
    with limited_threads(place.threads):
        first, second = read_fragment(place, a.index), read_fragment(place, b.index)
        if not (len(first.submaps) and len(second.submaps)):
            return []
        linker = Linker(FrameToModelTracker(place.config.tracking), config)
        seen = _seen_by_both(a, b, first, second)
        loops = linker.link(_known(place, a, first), _known(place, b, second), seen)
    return [*_seams(a, b, first, second, config.drift), *loops]


def _known(place: Workplace, part: Part, note: Fragment) -> linking.MappedPart:
    @lru_cache
    def map_of(submap: int) -> linking.MapView:
        return read_map(place, part.index, submap)

    return linking.MappedPart(read_keyframes(place, part.index), note.submaps, map_of)


def _seen_by_both(a: Part, b: Part, first: Fragment, second: Fragment) -> dict[int, Place]:
    """Return where the first of two fragments has seen the frames of keyframes of the second one."""
    seen = {}
    for j, frame in enumerate((second.keyframe_frames + b.start).tolist()):
        if a.start <= frame < a.stop and (result := first.frames[frame - a.start]).state in POSED:
            seen[j] = Place(result.submap, result.T_world_camera)
    return seen


def _seams(a: Part, b: Part, first: Fragment, second: Fragment, drift: float) -> list[Edge]:
    """Return what frames that both have seen say, one edge for each pair of submaps that they were in."""
    measured: dict[tuple[int, int], list[int]] = {}
    for frame in range(max(a.start, b.start), min(a.stop, b.stop)):
        here, there = first.frames[frame - a.start], second.frames[frame - b.start]
        if here.state in POSED and there.state in POSED:
            measured.setdefault((here.submap, there.submap), []).append(frame)
    edges = []
    for frames in measured.values():
        middle = frames[len(frames) // 2]
        i, j = int(first.frames.keyframes[middle - a.start]), int(second.frames.keyframes[middle - b.start])
        T_i_world, T_world_j = se3.inverse(first.T_world_keyframe[i]), second.T_world_keyframe[j]
        T_a_b = [
            first.frames[frame - a.start].T_world_camera @ se3.inverse(second.frames[frame - b.start].T_world_camera)
            for frame in frames
        ]
        T_i_j = common_motion(T_i_world @ np.stack(T_a_b) @ T_world_j)
        if T_i_j is not None:
            edges.append(tracked_edge(i, j, T_i_j, drift))
    return edges
