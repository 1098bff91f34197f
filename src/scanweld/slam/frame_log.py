"""What happened to every frame so far, in columns: a quarter of a kilobyte each, moved together with a closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, overload

import numpy as np

from scanweld.arrays import Array, Float64, Int64
from scanweld.geometry.views import MapCorrection
from scanweld.state import Stateful
from scanweld.trajectory import FrameResult, FrameState

_STATES = tuple(FrameState)
_NUMBERS = ("timestamp_s", "rmse_m", "loss", "overlap")
_COUNTS = ("num_inliers", "num_surfels", "submap")
_FEWEST = 256
"""Frames that there is room for at first."""


class FrameLog(Sequence[FrameResult], Stateful):
    """The results of a run, one per frame; each is made of its row when it is asked for."""

    STATE: ClassVar = {
        "_count": int, "_poses": Float64, "_numbers": Float64, "_counts": Int64, "_labels": Int64, "_stage_ms": Float64,
        "_stages": list[str], "_statuses": list[str], "_notes": dict[int, str],
    }  # fmt: skip

    def __init__(self) -> None:
        self._count = 0
        # Rows beyond the count are room to grow.
        self._poses: Float64 = np.zeros((_FEWEST, 3, 4))
        self._numbers: Float64 = np.zeros((_FEWEST, len(_NUMBERS)))
        self._counts: Int64 = np.zeros((_FEWEST, len(_COUNTS)), np.int64)
        self._labels: Int64 = np.zeros((_FEWEST, 3), np.int64)  # state, status, keyframe
        self._stage_ms: Float64 = np.zeros((_FEWEST, 0))  # NaN where a stage did not run
        self._stages: list[str] = []
        self._statuses: list[str] = []
        self._notes: dict[int, str] = {}

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> FrameResult: ...
    @overload
    def __getitem__(self, index: slice) -> list[FrameResult]: ...
    def __getitem__(self, index: int | slice) -> FrameResult | list[FrameResult]:
        """Return the result of a frame, or of several."""
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(self._count))]
        k = index + self._count if index < 0 else index
        if not 0 <= k < self._count:
            raise IndexError(f"frame {index} of {self._count}")
        T = np.eye(4)
        T[:3] = self._poses[k]
        timestamp_s, rmse_m, loss, overlap = self._numbers[k].tolist()
        num_inliers, num_surfels, submap = self._counts[k].tolist()
        state, status, _ = self._labels[k].tolist()
        stage_ms = {name: ms for name, ms in zip(self._stages, self._stage_ms[k].tolist(), strict=True) if ms == ms}
        return FrameResult(
            index=k, timestamp_s=timestamp_s, state=_STATES[state], T_world_camera=T, status=self._statuses[status],
            rmse_m=rmse_m, loss=loss, num_inliers=num_inliers, overlap=overlap, num_surfels=num_surfels,
            stage_ms=stage_ms, note=self._notes.get(k, ""), submap=submap,
        )  # fmt: skip

    def append(self, result: FrameResult, keyframe: int) -> None:
        """Note the result of the next frame, which moves with a keyframe."""
        k = self._count
        if k == len(self._poses):
            for name in ("_poses", "_numbers", "_counts", "_labels", "_stage_ms"):
                rows: Array = getattr(self, name)
                setattr(self, name, np.concatenate([rows, np.zeros_like(rows)]))
        self._poses[k] = result.T_world_camera[:3]
        self._numbers[k] = [getattr(result, name) for name in _NUMBERS]
        self._counts[k] = [getattr(result, name) for name in _COUNTS]
        for names, new in ((self._stages, list(result.stage_ms)), (self._statuses, [result.status])):
            names += [name for name in new if name not in names]
        if len(self._stages) > self._stage_ms.shape[1]:
            more = np.full((len(self._stage_ms), len(self._stages) - self._stage_ms.shape[1]), np.nan)
            self._stage_ms = np.concatenate([self._stage_ms, more], axis=1)
        self._stage_ms[k] = [result.stage_ms.get(name, np.nan) for name in self._stages]
        self._labels[k] = _STATES.index(result.state), self._statuses.index(result.status), keyframe
        if result.note:
            self._notes[k] = result.note
        self._count += 1

    def set_num_surfels(self, index: int, num_surfels: int) -> None:
        """Note the size of the map after a frame."""
        self._counts[index, 1] = num_surfels

    def submap(self, index: int) -> int:
        """Return the submap that a frame is in."""
        return int(self._counts[index, 2])

    @property
    def keyframes(self) -> Int64:
        """The keyframe (N,) that each frame moves with."""
        return self._labels[: self._count, 2].copy()

    def follow(self, correction: MapCorrection) -> None:
        """Move the frames with their keyframes."""
        keyframes = self._labels[: self._count, 2]
        order = np.argsort(correction.keyframe_ids)
        ids = correction.keyframe_ids[order]
        place = np.minimum(np.searchsorted(ids, keyframes), max(len(ids) - 1, 0))
        moved = np.flatnonzero(ids[place] == keyframes) if len(ids) else np.empty(0, np.int64)
        self.move(moved, correction.T_new_old[order[place[moved]]])

    def move(self, frames: Array, T_new_old: Float64) -> None:
        """Give some frames (N,) new poses T_new_old (N, 4, 4) @ T_world_camera."""
        T = np.tile(np.eye(4), (len(frames), 1, 1))
        T[:, :3] = self._poses[frames]
        self._poses[frames] = (T_new_old @ T)[:, :3]

    def rename(self, old: int, new: int) -> None:
        """Let the frames of a submap be those of another one."""
        submaps = self._counts[: self._count, 2]
        submaps[submaps == old] = new

    def frames_in(self, submap: int) -> Int64:
        """Return the numbers of the frames of a submap."""
        return np.flatnonzero(self._counts[: self._count, 2] == submap)

    def restored(self) -> None:
        """Check that there is a row of everything for each frame."""
        rows, count = len(self._poses), self._count
        shapes = [array.shape for array in (self._poses, self._numbers, self._counts, self._labels, self._stage_ms)]
        widths = [(3, 4), (len(_NUMBERS),), (len(_COUNTS),), (3,), (len(self._stages),)]
        if shapes != [(rows, *width) for width in widths] or not 0 <= count <= rows:
            raise ValueError("rows of other frames")
        state, status, _ = self._labels[:count].T
        for labels, names in ((state, _STATES), (status, self._statuses)):
            if count and not 0 <= labels.min() <= labels.max() < len(names):
                raise ValueError("states that there are not")
