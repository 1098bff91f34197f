"""What Slam asks of its stages: each is a Protocol of a few methods, and can be replaced."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from scanweld.arrays import Bool, Float64
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.depth import SurfacePyramid
from scanweld.geometry.views import MapCorrection, ModelView
from scanweld.loop_closure.joining import Join
from scanweld.registration.result import RegistrationResult
from scanweld.trajectory import FrameResult


class Tracker(Protocol):
    """Finds the camera's pose against the map."""

    def track(self, pyramid: SurfacePyramid, view: ModelView, T_world_camera: Float64) -> RegistrationResult:
        """Align a frame with the map as seen from the predicted pose; T_target_source is T_world_camera."""
        ...


class Mapper(Protocol):
    """Keeps the map."""

    @property
    def map(self) -> Any:
        """The map; anything with a length."""
        ...

    def view(self, T_world_camera: Float64, camera: PinholeCamera) -> ModelView:
        """Return the map as seen from a pose."""
        ...

    def fuse(self, pyramid: SurfacePyramid, T_world_camera: Float64, *, keyframe: int, moving: Bool | None) -> object:
        """Merge a frame into the map, but for pixels (H, W) that move; what is new is corrected with a keyframe."""
        ...

    def apply(self, correction: MapCorrection) -> None:
        """Move the map with its keyframes."""
        ...


@runtime_checkable
class DeferringMapper(Mapper, Protocol):
    """A mapper that puts work off, so that no frame has to wait for it."""

    def finish(self) -> None:
        """Do at once what was put off; asked for before anybody takes the whole map."""
        ...


@runtime_checkable
class SubmapMapper(Mapper, Protocol):
    """A mapper that can begin another map and take it in later; without it a lost camera begins no submap."""

    def fresh(self) -> SubmapMapper:
        """Return a mapper of the same kind and settings with an empty map."""
        ...

    def take_in(self, other: Any, correction: MapCorrection) -> None:
        """Add the map of another mapper, moved with its keyframes."""
        ...


class LoopCloser(Protocol):
    """Recognises places, finds a lost camera, and corrects the map."""

    @property
    def keyframe(self) -> int:
        """The keyframe that new surfels and frames move with."""
        ...

    @property
    def num_closures(self) -> int:
        """Number of loops closed so far."""
        ...

    def process(self, pyramid: SurfacePyramid, result: FrameResult) -> MapCorrection | Join | None:
        """Look at a tracked frame; return a correction when a loop was closed, or what joins two submaps."""
        ...

    def relocalise(self, pyramid: SurfacePyramid) -> RegistrationResult:
        """Look for a lost camera; only CONVERGED says that T_target_source is T_world_camera."""
        ...


@runtime_checkable
class DeferringLoopCloser(LoopCloser, Protocol):
    """A loop closer that looks for loops beside the frames, and answers some frames later."""

    def conclude(self) -> MapCorrection | Join | None:
        """Return at once what `process` would return some frames later; None when there is nothing more."""
        ...


@runtime_checkable
class SubmapLoopCloser(LoopCloser, Protocol):
    """A loop closer whose keyframes may be in several submaps, each with a world of its own."""

    def look_for(self, pyramid: SurfacePyramid) -> tuple[int, RegistrationResult]:
        """Look for a lost camera in all submaps; return the submap and what `relocalise` does, in its world."""
        ...

    def begin_submap(self, pyramid: SurfacePyramid, T_world_camera: Float64, frame_index: int) -> int | None:
        """Begin a submap with a frame and return its number; None where the frame cannot be recognised later."""
        ...

    def enter(self, submap: int) -> None:
        """Go on in a submap, in which the camera was found."""
        ...

    def join(self, join: Join) -> MapCorrection:
        """Make one submap of two; return how the keyframes of the joined one move."""
        ...
