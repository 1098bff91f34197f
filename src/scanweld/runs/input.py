"""Which frames of which recording a run takes, in the words of the command line and of run.json."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.intrinsics import parse_intrinsics
from scanweld.datasets.open import open_sequence
from scanweld.datasets.realsense import LIVE
from scanweld.runs.storage.recordings import local_place
from scanweld.runs.storage.urls import is_url


@dataclass(frozen=True, slots=True)
class RunInput:
    """Where the frames of a run come from.

    Attributes
    ----------
    input : a folder or file; "realsense:" for a camera; a URL (s3://, ..) of what is fetched before it is opened
    format : a name of :data:`~.open.FORMATS`, or "auto"
    frames : "A:B" or "A:B:STEP", None: all
    scale : factor on the image size
    camera : "FX,FY,CX,CY" of the images on disk, None: those that the recording gives
    depth_scale : depth units per metre, None: those that the recording gives
    topics : of a bag, "depth=/A,color=/B"
    """

    input: str
    format: str = "auto"
    frames: str | None = None
    scale: float = 1.0
    camera: str | None = None
    depth_scale: float | None = None
    topics: str | None = None

    @classmethod
    def of_run(cls, run: Mapping[str, Any]) -> RunInput:
        """Return the input of a run, from what run.json holds."""
        return cls(**{item.name: run[item.name] for item in fields(cls) if run.get(item.name)})

    def open(self) -> RgbdSequence:
        """Open the sequence; errors are those of :func:`~.open.open_sequence` and :func:`~.storage.local_place`."""
        return open_sequence(
            local_place(self.input),
            format=self.format,
            camera=parse_intrinsics(self.camera) if self.camera else None,
            depth_scale=self.depth_scale,
            frames=self.frames,
            scale=self.scale,
            topics=self.topics,
        )

    def described(self) -> dict[str, Any]:
        """Return what run.json holds of it: the place as it is found from any other folder."""
        is_path = not self.input.startswith(LIVE) and not is_url(self.input)
        return {**asdict(self), "input": str(Path(self.input).resolve()) if is_path else self.input}


@contextlib.contextmanager
def collected_warnings() -> Iterator[list[str]]:
    """Yield a list that grows by what the library warns of in this thread meanwhile."""
    messages: list[str] = []
    here = threading.get_ident()

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.thread == here:
                messages.append(record.getMessage())

    collector = Collector(logging.WARNING)
    library = logging.getLogger("scanweld")
    library.addHandler(collector)
    try:
        yield messages
    finally:
        library.removeHandler(collector)
