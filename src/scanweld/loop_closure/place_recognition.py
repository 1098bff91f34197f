"""The memory of places: keyframes, and which of them look like a frame.

Two measures of similarity. The share of ferns that agree (:mod:`~.ferns`) is there for every frame, but holds for
nearby views only. The words that the image features share find places from half a metre and 30 degrees away, and need
texture: a binary descriptor of 256 bits is cut into 16 words of 16 bits, and descriptors of one place, which differ in
a few dozen bits, share some of them, others hardly ever. Where a frame has features, words decide; else ferns do.

Source of the words: M. Norouzi, A. Punjani, D. Fleet, "Fast search in Hamming space with multi-index hashing", 2012.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from scanweld.arrays import Array, Float64, Int32, UInt8, as_transforms
from scanweld.config import check_ranges, section, setting
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.depth import SurfacePyramid
from scanweld.loop_closure import kernels
from scanweld.loop_closure.ferns import FernCode, Ferns, similarities
from scanweld.loop_closure.held_out import fits_in_place
from scanweld.loop_closure.keyframes import (
    Keyframe,
    KeyframeConfig,
    Sighting,
    keyframe_of,
    keyframe_reason,
    motion_size,
    reduced_pyramid,
    sighting_of,
)
from scanweld.parallel import run_ranges
from scanweld.state import Stateful

_WORDS = 16  # of a descriptor
_FARTHEST_M = 1e6  # largest coordinate of a keyframe that numbers can be trusted with
_WORD_BITS = 16
_GRAIN = 128  # keyframes that are worth a thread


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceConfig:
    """What is remembered, and how it is found."""

    keyframes: KeyframeConfig = section(KeyframeConfig, "what is kept of a keyframe, and when a frame becomes one")
    indexed_features: int = setting(
        250, "features of a keyframe that words are taken from; raise for far views, costs time", low=10, high=10_000
    )
    min_features: int = setting(30, "with fewer features a frame is compared by ferns alone", low=1)

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A keyframe that may show the place of a frame.

    Attributes
    ----------
    index : of the keyframe in the database
    similarity : share of ferns that agree, 0..1
    shared_words : words of the keyframe's features that the frame's have too
    """

    index: int
    similarity: float
    shared_words: int


class KeyframeDatabase(Stateful):
    """Keyframes in the order in which they were added."""

    STATE: ClassVar = {"_keyframes": list[Keyframe]}
    MADE = frozenset({"config", "ferns", "_codes", "_has_grey", "_words", "_num_features"})

    def __init__(self, config: PlaceConfig | None = None) -> None:
        self.config = config or PlaceConfig()
        self.ferns = Ferns(self.config.keyframes.ferns)
        self._keyframes: list[Keyframe] = []
        count = self.config.keyframes.ferns.count
        # Rows beyond the number of keyframes are room to grow.
        self._codes: UInt8 = np.empty((0, 2, count), np.uint8)
        self._has_grey = np.empty(0, np.bool_)
        self._words: Array = np.empty((0, self.config.indexed_features, _WORDS), np.uint16)
        self._num_features: Int32 = np.empty(0, np.int32)

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """All keyframes."""
        return tuple(self._keyframes)

    def __getitem__(self, index: int) -> Keyframe:
        return self._keyframes[index]

    def sight(self, pyramid: SurfacePyramid) -> Sighting:
        """Return what has to be known of a frame to add it or to look for its place."""
        return sighting_of(pyramid, self.ferns, self.config.keyframes)

    def reason(
        self, pyramid: SurfacePyramid, T_world_camera: Float64, *, among: Array | None = None, last: int | None = None
    ) -> str:
        """Say why a tracked frame should be added; "" when it should not (:func:`~.keyframes.keyframe_reason`).

        `among` : (K,) bool, the keyframes of its own world, which it is compared with; all by default. `last` : the
        keyframe that the camera was at before, by default the newest of these.
        """
        mine = np.arange(len(self)) if among is None else np.flatnonzero(among)
        if len(mine) == 0:
            return keyframe_reason(pyramid, T_world_camera, None, 0.0, self.config.keyframes)
        code, last = self.ferns.encode(pyramid), int(mine[-1]) if last is None else last
        # Mostly the frame is like the last keyframe, and the others need not be asked.
        similarity = float(self.similarities(code, slice(last, last + 1))[0])
        if similarity < self.config.keyframes.max_similarity:
            similarity = float(self.similarities(code)[mine].max())
        return keyframe_reason(pyramid, T_world_camera, self[last], similarity, self.config.keyframes)

    def nearest(self, pyramid: SurfacePyramid, T_world_camera: Float64, *, among: Array) -> int | None:
        """Return the keyframe that would spare a frame being added; None when there is none.

        It looks like the frame, was seen from as near by as two keyframes should be, and its depth agrees.

        `among` : (K,) bool, the keyframes of the frame's own world.
        """
        config, mine = self.config.keyframes, np.flatnonzero(among)
        alike = mine[self.similarities(self.ferns.encode(pyramid))[mine] >= config.max_similarity]
        if len(alike) == 0:
            return None
        motions = se3.inverse(np.stack([self[index].T_world_camera for index in alike])) @ T_world_camera
        shift, turn = motion_size(pyramid, motions)
        apart = np.maximum(shift / config.max_shift, turn / config.max_turn_rad)
        best = int(apart.argmin())
        reduced = reduced_pyramid(pyramid, config)
        if apart[best] > 1 or not fits_in_place(reduced, self[alike[best]], motions[best], config.surfaces):
            return None
        return int(alike[best])

    def add(self, sighting: Sighting, T_world_camera: Float64, *, frame_index: int) -> Keyframe:
        """Remember a frame that was seen from `T_world_camera`.

        Raises
        ------
        InvalidInputError
            When too little of its image has surfaces: it could never be recognised.
        """
        if sighting.usable < self.config.keyframes.min_usable:
            raise InvalidInputError(
                f"keyframe: {sighting.usable:.1%} of the image has surfaces, expected at least "
                f"{self.config.keyframes.min_usable:.1%} (min_usable); add frames that `reason` speaks for"
            )
        keyframe = keyframe_of(sighting, T_world_camera, index=len(self), frame_index=frame_index)
        self._keyframes.append(keyframe)
        self._note(keyframe)
        return keyframe

    def restored(self) -> None:
        """Check that keyframes are somewhere, and note what they are found by."""
        if self._keyframes:
            poses = as_transforms(np.stack([keyframe.T_world_camera for keyframe in self._keyframes]), "keyframe")
            if np.abs(poses[:, :3, 3]).max() > _FARTHEST_M:
                raise ValueError("keyframes that are nowhere")
        for index, keyframe in enumerate(self._keyframes):
            if keyframe.index != index or keyframe.depth_steps.shape != keyframe.camera.shape:
                raise ValueError(f"keyframe {index} is not that")
            self._note(keyframe)

    def _note(self, keyframe: Keyframe) -> None:
        """Note what a keyframe is found by."""
        row = keyframe.index
        if row == len(self._has_grey):
            self._grow()
        self._codes[row] = keyframe.code.depth, keyframe.code.grey
        self._has_grey[row] = keyframe.code.has_grey
        words = words_of(keyframe.features.descriptors[: self.config.indexed_features])
        self._words[row, : len(words)] = words
        self._num_features[row] = len(words)

    def move(self, T_world_camera: Sequence[Float64] | Float64) -> None:
        """Give every keyframe a new pose (K, 4, 4)."""
        if len(T_world_camera) != len(self):
            raise InvalidInputError(f"T_world_camera: {len(T_world_camera)} poses for {len(self)} keyframes")
        self._keyframes = [
            replace(keyframe, T_world_camera=np.array(T, np.float64))
            for keyframe, T in zip(self._keyframes, T_world_camera, strict=True)
        ]

    def similarities(self, code: FernCode, some: slice = slice(None)) -> Float64:
        """Return the share (K,) of ferns that agree with each keyframe, or with each of some."""
        codes = self._codes[: len(self)][some]
        return similarities(code, codes[:, 0], codes[:, 1], self._has_grey[: len(self)][some])

    def shared_words(self, descriptors: UInt8) -> Int32:
        """Count (K,) the words of each keyframe's features that features with `descriptors` (N, 32) have too."""
        present = np.zeros((_WORDS, 1 << _WORD_BITS), np.uint8)
        present[np.arange(_WORDS), words_of(descriptors)] = 1
        shared = np.zeros(len(self), np.int32)

        def rows(start: int, stop: int) -> None:
            kernels.count_shared_words(start, stop, self._words, self._num_features, present, shared)

        run_ranges(len(self), rows, grain=_GRAIN)
        return shared

    def query(self, sighting: Sighting, k: int = 5, *, allowed: Array | None = None) -> list[Candidate]:
        """Return the k keyframes that are most similar to a frame, best first.

        Parameters
        ----------
        sighting : of the frame
        allowed : (K,) bool, the keyframes that may be returned; all by default
        """
        if len(self) == 0:
            return []
        similarity = self.similarities(sighting.code)
        if len(sighting.features) >= self.config.min_features:
            words = self.shared_words(sighting.features.descriptors)
        else:
            words = np.zeros(len(self), np.int32)
        # Ferns break ties; where there are no words they decide.
        order = np.lexsort((-similarity, -words))
        if allowed is not None:
            order = order[np.asarray(allowed, np.bool_)[order]]
        return [Candidate(int(i), float(similarity[i]), int(words[i])) for i in order[:k]]

    def _grow(self) -> None:
        rows = max(64, 2 * len(self._has_grey))
        for name in ("_codes", "_has_grey", "_words", "_num_features"):
            old = getattr(self, name)
            new = np.zeros((rows, *old.shape[1:]), old.dtype)
            new[: len(old)] = old
            setattr(self, name, new)


def words_of(descriptors: UInt8) -> Array:
    """Cut descriptors (N, 32) into words (N, 16) uint16."""
    return np.ascontiguousarray(descriptors).view("<u2").astype(np.uint16).reshape(-1, _WORDS)
