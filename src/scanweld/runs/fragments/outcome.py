"""What fragments come to once they are put together, as a run has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from scanweld.geometry import se3
from scanweld.runs.fragments.assembling import Assembly
from scanweld.runs.fragments.making import Fragment
from scanweld.slam.motion import POSED, trajectory_of
from scanweld.slam.parts import Part
from scanweld.slam.submaps import in_one_world, main_submap
from scanweld.trajectory import FrameResult, FrameState, Trajectory


@dataclass(frozen=True)
class FragmentsOutcome:
    """A run in fragments, as :class:`~scanweld.runs.summary.Outcome` describes one; its submaps are the components.

    Attributes
    ----------
    results : one per frame
    maps : of each component
    keyframe_frames, loops : keyframes of all fragments in turn; those between fragments, too, that were kept
    num_closures, num_joins : loops closed within fragments; submaps joined, and fragments
    """

    results: Sequence[FrameResult]
    maps: Mapping[int, Any]
    keyframe_frames: Sequence[int]
    loops: Sequence[tuple[int, int]]
    num_closures: int
    num_joins: int

    @cached_property
    def main_results(self) -> list[FrameResult]:
        """The results in the world of the main component; frames of others are LOST there."""
        return in_one_world(self.results, main_submap(self.results))

    @cached_property
    def trajectory(self) -> Trajectory:
        """One pose per frame; LOST stretches are interpolated where tracking was regained."""
        return trajectory_of(self.main_results)

    @property
    def map(self) -> Any:
        """The map of the main component."""
        return self.maps[main_submap(self.results)]

    @property
    def unjoined(self) -> list[int]:
        """The components that do not connect to the main one."""
        return [component for component in self.maps if component != main_submap(self.results)]


def joined_results(parts: Sequence[Part], fragments: Sequence[Fragment], assembly: Assembly) -> list[FrameResult]:
    """Return one result per frame, in the worlds of the components.

    Of a frame that two fragments have tracked the pose goes over from one to the other with time. The frames of the
    fragments move with their keyframes.
    """
    components = {(piece.fragment, piece.submap): piece.component for piece in assembly.pieces}
    for piece in assembly.pieces:
        fragments[piece.fragment].frames.follow(piece.correction)

    def result_of(part: Part, frame: int) -> FrameResult:
        result = fragments[part.index].frames[frame - part.start]
        component = components.get((part.index, result.submap))
        if component is None and result.state in POSED:  # too little depth for a keyframe, ever
            result = replace(result, state=FrameState.LOST, note=f"fragment {part.index} has no keyframe")
        return replace(result, index=frame, submap=component or 0)

    results: list[FrameResult] = []
    for part in parts:
        seen_before = len(results)
        for frame in range(part.start, part.stop):
            result = result_of(part, frame)
            if frame < seen_before:
                share = (frame - part.start + 1) / (seen_before - part.start + 1)
                results[frame] = _both(results[frame], result, share)
            else:
                results.append(result)
    return results


def _both(before: FrameResult, after: FrameResult, share: float) -> FrameResult:
    """Return the result of a frame that two fragments have seen; `share` of the later one, from 0 to 1."""
    posed = [result for result in (before, after) if result.state in POSED]
    if len(posed) == 1:
        return posed[0]
    nearer = after if share > 0.5 else before
    if not posed or before.submap != after.submap:
        return nearer
    T_world_camera = se3.interpolate(before.T_world_camera, after.T_world_camera, share)
    return replace(nearer, T_world_camera=T_world_camera)
