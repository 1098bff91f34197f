"""What a checkpoint is of: it fits the same frames, configuration and program, and nothing else."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from scanweld.arrays import Float64
from scanweld.backends import get_backend
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.gyroscope import gyroscope_of
from scanweld.errors import ConfigError, FileFormatError, InvalidInputError, UnreadableFrameError
from scanweld.geometry.frame import Frame
from scanweld.mapping.storage.pages import MapConfig
from scanweld.slam.config import SlamConfig


def identity_of(sequence: RgbdSequence, config: SlamConfig, given: Sequence[Float64 | None] | None) -> dict[str, Any]:
    """Return what a run depends on, as it is in a checkpoint: all but what the frames show.

    Where the map is kept (`map.*`) may change: results do not depend on it.

    Parameters
    ----------
    given : T_world_camera (4, 4) of each frame at given poses, None for those that are left out
    """
    identity = {
        "scanweld": version("scanweld"),
        "backend": get_backend(),
        "sequence": fingerprint_of(sequence, given),
        "config": asdict(replace(config, map=MapConfig())),
    }
    return dict(json.loads(json.dumps(identity)))  # as it comes back from a file


def fingerprint_of(sequence: RgbdSequence, given: Sequence[Float64 | None] | None) -> dict[str, Any]:
    """Return what tells a sequence from others, all but what its frames show; `given` as in :func:`identity_of`."""
    gyroscope = gyroscope_of(sequence)
    turned = None if gyroscope is None else gyroscope.orientations(sequence.timestamps_s)
    return {
        "number of frames": len(sequence),
        "camera": asdict(sequence.camera),
        "depth scale": sequence.depth_scale,
        "timestamps": _digest([sequence.timestamps_s]),
        "gyroscope": _digest(turned),
        "given poses": _digest(given),
    }


def check_identity(identity: Mapping[str, Any], stored: Mapping[str, Any], where: str) -> None:
    """Raise what is wrong, in one line, when a checkpoint is of something else than the run."""
    for name, what in (("scanweld", "scanweld"), ("backend", "the backend")):
        if identity[name] != stored.get(name):
            raise FileFormatError(
                f"{where}: was written by {what} {stored.get(name)!r}, this is {identity[name]!r}; resume with that "
                "one, or begin anew with --force"
            )
    for key, (here, there) in differences(identity["sequence"], stored.get("sequence")):
        raise InvalidInputError(
            f"{where}: is of another sequence: {key} {_short(there)}, here {_short(here)}; resume with the same "
            "sequence and options, or begin anew with --force"
        )
    for key, (here, there) in differences(identity["config"], stored.get("config")):
        raise ConfigError(
            f"{where}: was made with {key} = {there!r}, here it is {here!r}; resume with the same configuration, or "
            "begin anew with --force"
        )


def digest_of(frame: Frame, before: int = 0) -> int:
    """Return a checksum of what a frame shows; with that of the frames before it, of them all."""
    color = b"" if frame.color is None else np.ascontiguousarray(frame.color).data
    return zlib.crc32(color, zlib.crc32(np.ascontiguousarray(frame.depth_m).data, before))


def check_frames(sequence: RgbdSequence, digests: Sequence[Sequence[int]], where: str) -> None:
    """Raise InvalidInputError when frames of the sequence, by index, do not show what they did."""
    for index, digest in digests:
        try:
            same = 0 <= index < len(sequence) and digest_of(sequence.read(index)) == digest
        except UnreadableFrameError as error:
            raise InvalidInputError(f"{where}: frame {index} of the run cannot be read any more: {error}") from None
        if not same:
            raise InvalidInputError(
                f"{where}: is of another sequence: frame {index} shows something else; resume with the same sequence, "
                "or begin anew with --force"
            )


def _digest(arrays: Sequence[Float64 | None] | Float64 | None) -> str | None:
    if arrays is None:
        return None
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(b"-" if array is None else np.ascontiguousarray(array, np.float64).tobytes())
    return digest.hexdigest()


def differences(here: Any, there: Any, key: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    """Yield the key of each value that differs, and both values."""
    if isinstance(here, Mapping) and isinstance(there, Mapping):
        for name in [*here, *(name for name in there if name not in here)]:
            yield from differences(here.get(name), there.get(name), f"{key}.{name}" if key else str(name))
    elif here != there:
        yield key, (here, there)


def _short(value: Any) -> str:
    """Show a value; of a digest the beginning tells enough."""
    return f"{value[:8]}.." if isinstance(value, str) else str(value)
