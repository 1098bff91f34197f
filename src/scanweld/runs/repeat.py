"""A finished run made again from what its folder says, to see that the same comes of it."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from scanweld.arrays import Float64
from scanweld.backends import get_backend, set_backend
from scanweld.config import from_mapping, load_toml
from scanweld.datasets.base import RgbdSequence
from scanweld.datasets.open import open_sequence
from scanweld.datasets.synthetic import RenderConfig, render_sequence
from scanweld.errors import DatasetError, InvalidInputError, OutputError
from scanweld.runs.checkpoint.identity import fingerprint_of
from scanweld.runs.comparison import Comparison, compare_runs, differences_of_fingerprints
from scanweld.runs.folder import CHECKPOINT, MARK, write_folder
from scanweld.runs.fragments.run import run_fragments
from scanweld.runs.reopen import given_poses, read_description, reopen_input
from scanweld.runs.run import Progress, poses_by_frame, run_sequence
from scanweld.slam.config import SlamConfig

INPUT = ("input", "format", "frames", "scale", "poses", "camera", "depth_scale", "topics", "render")
"""What run.json says of where the frames come from."""


def repeat_run(
    folder: Path, out: Path | None = None, *, force: bool = False, progress: Progress | None = None
) -> Comparison:
    """Do a run again, with the same input, configuration and options, and compare what comes of it.

    The number of threads is that of this process: results do not depend on it.

    Parameters
    ----------
    folder : of the run
    out : run folder of the repetition, which is there once it is complete; None: a temporary one, which goes in the end
    force : replace an existing run in `out`
    progress : called after each frame

    Raises
    ------
    DatasetError
        When the sequence is not there any more, or is another one by its times or camera.
    InvalidInputError
        When the run was in real time or interrupted: it has no second time.
    FileFormatError, ConfigError, OutputError
        When the folder is none of a run, its configuration is not of this version, or `out` cannot be written.
    """
    run = read_description(folder)
    if run.get("realtime"):
        raise InvalidInputError(f"{folder}: was run in real time, and no two such runs are alike: it cannot be")
    if run.get("interrupted"):
        slam, resumable = f"`scanweld slam .. --out {folder}", (folder / CHECKPOINT).is_file()
        then = f"{slam} --resume` ends it first" if resumable else f"it has no checkpoint, {slam} --force` begins anew"
        raise InvalidInputError(f"{folder}: was interrupted; {then}")
    config = from_mapping(SlamConfig, load_toml(folder / "config.toml"), str(folder / "config.toml"))
    with contextlib.ExitStack() as stack:
        if out is None:
            out = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="scanweld-repeat-"))) / "run"
        if out.resolve() == folder.resolve():
            raise InvalidInputError(f"{out}: is the run that is to be repeated; choose another --out")
        stack.enter_context(_backend(run.get("backend")))
        sequence = stack.enter_context(_input_of(run))
        poses = given_poses(sequence, str(run["poses"])) if run.get("poses") else None
        _check_input(sequence, None if poses is None else poses_by_frame(sequence, poses), run, folder)
        description = {**{key: run[key] for key in INPUT if key in run}, "repeats": str(folder.resolve())}
        tracked_only = bool(run.get("tracked_only"))
        if isinstance(run.get("fragments"), Mapping):
            number = len(run["fragments"]["parts"])
            with _written_whole(out, force=force) as aside:
                run_fragments(
                    lambda: sequence, number, config, out=aside, tracked_only=tracked_only, description=description
                )
            return compare_runs(out, folder)
        with _written_whole(out, force=force) as aside:
            summary = run_sequence(
                sequence,
                config,
                out=aside,
                poses=poses,
                progress=progress,
                calibrate=bool(run.get("calibrate")),
                refine=bool(run.get("refine")),
                tracked_only=tracked_only,
                resumable=False,
                description=description,
            )
            if summary.interrupted:
                raise KeyboardInterrupt
        return compare_runs(out, folder)


@contextlib.contextmanager
def _written_whole(out: Path, *, force: bool) -> Iterator[Path]:
    """Yield a folder for a run that becomes `out`; after an error or Ctrl-C it is gone, and `out` as it was."""
    if (out / CHECKPOINT).is_file() and not force:
        raise OutputError(f"{out}: holds a run that was interrupted; --force replaces it, --out writes elsewhere")
    with write_folder(out, force=force) as aside:
        made = aside / "run"
        yield made  # within: what a run leaves beside its folder goes, too
        for path in made.iterdir():
            path.rename(aside / path.name)
        made.rmdir()


@contextlib.contextmanager
def _backend(name: object) -> Iterator[None]:
    """Use the backend of the run within the block; what an earlier version did not note stays as it is."""
    usual = get_backend()
    set_backend(usual if name is None else str(name))
    try:
        yield
    finally:
        set_backend(usual)


@contextlib.contextmanager
def _input_of(run: Mapping[str, Any]) -> Iterator[RgbdSequence]:
    """Open the sequence of a run; that of a demo is rendered to files again, as the demo did."""
    if not isinstance(run.get("render"), Mapping):
        yield reopen_input(run, fetch=True)
        return
    with tempfile.TemporaryDirectory(prefix="scanweld-repeat-") as aside:
        place = Path(aside) / str(run.get("name") or "rendered")
        render_sequence(place, from_mapping(RenderConfig, run["render"], MARK))
        yield open_sequence(place)


def _check_input(
    sequence: RgbdSequence, poses: list[Float64 | None] | None, run: Mapping[str, Any], folder: Path
) -> None:
    """Raise DatasetError where the sequence is seen to be another one before any frame is read."""
    now, before = json.loads(json.dumps(fingerprint_of(sequence, poses))), run.get("fingerprint")
    changes = differences_of_fingerprints(now, before if isinstance(before, Mapping) else {})
    if changes:
        raise DatasetError(f"{folder}: cannot be repeated, the sequence is another one by now: {'; '.join(changes)}")
