"""When the state of a run is written down, and how a run goes on from there."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from scanweld.arrays import Float64
from scanweld.datasets.base import RgbdSequence
from scanweld.errors import DatasetError, FileFormatError, InvalidInputError, OutputError
from scanweld.geometry.frame import Frame
from scanweld.report.run_files import read_json
from scanweld.runs.checkpoint import encoding, file
from scanweld.runs.checkpoint.identity import check_frames, check_identity, digest_of, identity_of
from scanweld.runs.folder import CHECKPOINT, MARK
from scanweld.slam.config import SlamConfig
from scanweld.state import Stateful

EVERY_S = 60.0
"""Seconds between two checkpoints, where the user does not say."""

MOST_OF_THE_TIME = 0.02
"""Share of the time that checkpoints may take, where the user does not say: a large map has fewer of them."""


class Checkpoints:
    """The checkpoint of a run in its folder; without a folder, none.

    Parameters
    ----------
    folder : of the run
    sequence, config, given : what the run is of, see :func:`~.identity.identity_of`
    every_s : seconds between two checkpoints; 0: none by the clock; None: as often as costs little
    """

    def __init__(
        self,
        folder: Path | None,
        sequence: RgbdSequence,
        config: SlamConfig,
        given: Sequence[Float64 | None] | None = None,
        *,
        every_s: float | None = None,
    ) -> None:
        if every_s is not None and not 0 <= every_s < float("inf"):
            raise InvalidInputError(f"checkpoint_every_s: {every_s} is no time; expected seconds, or 0 for none")
        self.path = None if folder is None else folder / CHECKPOINT
        self.seconds_before = 0.0
        """Seconds that a resumed run took before."""
        self._sequence, self._every_s = sequence, every_s
        self._identity = {} if folder is None else identity_of(sequence, config, given)
        self._shown: list[list[int]] = []  # index and checksum of the first frame that could be read, and of the last
        self._begun = self._written = time.perf_counter()
        self._cost_s = 0.0
        self._has_warned = False

    def resume(self, run: Stateful) -> bool:
        """Put the state of the checkpoint into a run that has seen nothing yet; False where there is no checkpoint.

        Raises
        ------
        FileFormatError
            When the checkpoint is damaged, or of another version.
        InvalidInputError, ConfigError
            When it is of another sequence or configuration, or there is none and the run was written.
        """
        if self.path is None:
            raise InvalidInputError("resume: there is no run folder to resume from")
        if not self.path.is_file():
            folder = self.path.parent
            if not (folder / MARK).is_file():
                return False
            if read_json(folder / MARK).get("interrupted"):
                raise InvalidInputError(
                    f"{folder}: was interrupted and has no checkpoint, it cannot be resumed; --force without --resume "
                    "begins anew"
                )
            raise InvalidInputError(f"{folder}: the run is finished, there is nothing to resume")
        where = str(self.path)
        with file.CheckpointFile(self.path) as stored:
            check_identity(self._identity, stored.header, where)
            with _as_it_should_be(where):
                self._shown = [[int(index), int(digest)] for index, digest in stored.header["shown"]]
                self.seconds_before = float(stored.header["seconds"])
            check_frames(self._sequence, self._shown, where)
            with _as_it_should_be(where):
                encoding.restore(stored, run)
                if stored.left:
                    raise ValueError(f"{stored.left} bytes more than the state of a run")
        self._written = time.perf_counter()
        return True

    def keep(self, run: Stateful, index: int, frame: Frame | None, *, surely: bool = False) -> str:
        """Write the state of a run, between two frames, where it is time for it or it shall be done `surely`.

        Where it cannot be written the checkpoint before stays; returns why, but once.

        Parameters
        ----------
        index, frame : the frame that the run took in last; None where it could not be read
        """
        if self.path is None:
            return ""
        due = surely or self._due
        if frame is not None and (due or not self._shown):
            self._shown = [*self._shown[:1], [index, digest_of(frame)]]
        if not due or not self._shown:
            return ""
        begun = time.perf_counter()
        seconds = self.seconds_before + begun - self._begun
        header = {**self._identity, "shown": self._shown, "seconds": seconds}
        fault = ""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file.write(self.path, header, encoding.encode(run, Stateful))
        except (OSError, OutputError) as error:
            fault = "" if self._has_warned else f"no checkpoint: {error}; the run goes on, and what was there is kept"
            self._has_warned = True
        self._written = time.perf_counter()
        self._cost_s = self._written - begun
        return fault

    @contextlib.contextmanager
    def told_in_errors(self) -> Iterator[None]:
        """Say in errors of the input and the output that there is a checkpoint to go on from, where there is one."""
        try:
            yield
        except (DatasetError, OutputError) as error:
            if self.path is None or not self.path.is_file():
                raise
            raise type(error)(f"{error}; the last checkpoint is whole, and --resume goes on from there") from None

    @property
    def _due(self) -> bool:
        """Whether it is time for the next one."""
        if self._every_s == 0:
            return False
        wait_s = max(EVERY_S, self._cost_s / MOST_OF_THE_TIME) if self._every_s is None else self._every_s
        return time.perf_counter() - self._written >= wait_s

    def keep_in(self, folder: Path) -> bool:
        """Have the checkpoint in the folder, too, that is to take the place of the run's; False where there is none."""
        if self.path is None or not self.path.is_file():
            return False
        try:
            os.link(self.path, folder / CHECKPOINT)
        except OSError:  # a file system without links
            shutil.copyfile(self.path, folder / CHECKPOINT)
        return True


@contextlib.contextmanager
def _as_it_should_be(where: str) -> Iterator[None]:
    """Tell of what cannot be in a checkpoint, although its checksums are right."""
    try:
        yield
    except (ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError) as error:
        raise FileFormatError(f"{where}: holds no state of a run ({error}); --force begins the run anew") from None
