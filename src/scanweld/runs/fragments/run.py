"""A recording run in fragments: made, tied together, put together and written, each step in tasks."""

from __future__ import annotations

import contextlib
import logging
import struct
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from scanweld.datasets.base import LiveSequence, RgbdSequence
from scanweld.datasets.images import explain_unusable_depth
from scanweld.errors import DatasetError, InvalidInputError, OutputError
from scanweld.runs.checkpoint.identity import fingerprint_of
from scanweld.runs.fragments.assembling import Assembly, assemble
from scanweld.runs.fragments.exchange import exchange_beside, opened_exchange
from scanweld.runs.fragments.fusing import BLOCK_FOLDER, Block, fuse_block, sort_into_blocks, whole_map
from scanweld.runs.fragments.linking import link_fragments
from scanweld.runs.fragments.making import (
    FRAGMENT_FOLDER,
    Fragment,
    OpenSequence,
    Workplace,
    finished_in,
    left_unfit,
    make_fragment,
    read_fragment,
)
from scanweld.runs.fragments.outcome import FragmentsOutcome, joined_results
from scanweld.runs.output import write_run
from scanweld.runs.run import RunSummary
from scanweld.runs.storage.run_folders import check_place, written_at
from scanweld.runs.storage.urls import is_url
from scanweld.runs.summary import peak_rss_mb, summarise
from scanweld.slam.config import SlamConfig
from scanweld.slam.motion import POSED
from scanweld.slam.parts import Part, parts_of
from scanweld.slam.submaps import main_submap

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
"""Is told what is being done, how much of it is, and of how much."""


def run_fragments(
    open_sequence: OpenSequence,
    number: int,
    config: SlamConfig | None = None,
    *,
    out: Path | str | None = None,
    force: bool = False,
    resume: bool = False,
    executor: Executor | None = None,
    threads: int = 1,
    tracked_only: bool = False,
    progress: Progress | None = None,
    description: Mapping[str, Any] | None = None,
    started: float | None = None,
) -> RunSummary:
    """Run SLAM over a recording in fragments, and write one run folder.

    Results depend neither on the executor nor on the number of its workers.

    Parameters
    ----------
    open_sequence : opens the recording, here and in every task
    number : of fragments
    config : what to do; `fragments.*` says how they overlap
    out : run folder, path or URL (s3://, ..); None writes nothing. What the tasks hand to each other lies beside it, in
        `OUT.fragments`, which all workers must reach, and goes when the run is there
    force : replace an existing run, and what an interrupted one has left there
    resume : go on with the fragments that an earlier run, which was interrupted, has left there; a warning names those
        of other frames or settings
    executor : where tasks run; by default one after the other in this process
    threads : of each task
    tracked_only : leave lines of frames without a measured pose out of trajectory.txt
    progress : told of each finished task
    description : goes into run.json
    started : `time.perf_counter()` from which seconds_total counts; default now

    Raises
    ------
    InvalidInputError
        When there are too few frames for so many fragments, or the configuration remembers no keyframes.
    OutputError
        When `out` cannot be written, or an interrupted run has left fragments there and neither `force` nor `resume`
        says what is to become of them; checked before any frame is read.
    DatasetError
        When no frame has usable depth.
    """
    started = time.perf_counter() if started is None else started
    config = config or SlamConfig()
    if config.loop_closer == "none":
        raise InvalidInputError("fragments: are tied together by their keyframes; set loop_closer = 'keyframes'")
    out = None if out is None else str(out)
    if out is not None:
        check_out(out, force=force, resume=resume)
    sequence = open_sequence()
    if isinstance(sequence, LiveSequence):
        raise InvalidInputError(f"{sequence.name}: a live camera cannot be run in fragments; record it first")
    parts = parts_of(len(sequence), number, config.fragments.overlap)
    with contextlib.ExitStack() as stack:
        # Blocks are of poses that may be others now.
        left = stack.enter_context(
            opened_exchange(out, (FRAGMENT_FOLDER, BLOCK_FOLDER), kept=(FRAGMENT_FOLDER,) if resume else ())
        )
        place = Workplace(left, config, threads)
        if resume and (unfit := left_unfit(place, sequence, parts)):
            which, are = ("fragment", "is") if len(unfit) == 1 else ("fragments", "are")
            logger.warning(
                "%s: %s %s left there %s of other frames, settings or program, or damaged, and %s not used",
                left.place, which, ", ".join(map(str, unfit)), are, are,
            )  # fmt: skip
        executor = executor or stack.enter_context(ThreadPoolExecutor(max_workers=1))
        tasks = _Tasks(executor, place, progress or (lambda *_: None))
        links = tasks.make_and_link(open_sequence, parts)
        fragments = [read_fragment(place, part.index) for part in parts]
        _check(sequence, config, fragments)
        assembly = assemble(fragments, links)
        blocks = tasks.fuse(assembly)
        outcome = _outcome(place, parts, fragments, assembly, blocks)
        points = sum(fragment.num_points_input for fragment in fragments)
        metrics, error = summarise(outcome, sequence.ground_truth, points)
        metrics["peak_rss_mb"] = max([f.peak_rss_mb for f in fragments if f.peak_rss_mb] + [peak_rss_mb() or 0.0])
        metrics["seconds_total"] = time.perf_counter() - started
        if out is not None:
            given = dict(description or {})
            in_fragments, warnings = _described(parts, fragments, assembly, main_submap(outcome.results))
            content = zlib.crc32(b"".join(struct.pack("<I", fragment.content) for fragment in fragments))
            fingerprint = {**fingerprint_of(sequence, None), "content": f"{content:08x}"}
            given |= {
                "tracked_only": tracked_only, "fragments": in_fragments, "fingerprint": fingerprint,
                "warnings": [*given.get("warnings", ()), *warnings],
            }  # fmt: skip
            with written_at(out, force=force) as aside:
                write_run(
                    aside, outcome, sequence, config, metrics, error, tracked_only=tracked_only,
                    description=given, started=started,
                )  # fmt: skip
    folder = None if out is None or is_url(out) else Path(out)
    return RunSummary(folder, metrics, tuple(outcome.main_results), outcome.map)


def check_out(out: str, *, force: bool, resume: bool) -> None:
    """Raise OutputError before any work is done when a run could not be written to `out` at the end, path or URL, or
    would throw away unasked what an earlier one has finished."""
    check_place(out, force=force)
    if force or resume:
        return
    left = exchange_beside(out)
    if count := len(finished_in(left)):
        raise OutputError(
            f"{left}: holds {count} finished fragment{'' if count == 1 else 's'} of a run that was interrupted; "
            "--resume continues it, --force begins anew"
        )


class _Tasks:
    """Hands tasks to an executor, and puts what they return in an order that does not depend on it."""

    def __init__(self, executor: Executor, place: Workplace, progress: Progress) -> None:
        self._executor, self._place, self._progress = executor, place, progress

    def make_and_link(self, open_sequence: OpenSequence, parts: Sequence[Part]) -> dict[tuple[int, int], list[Any]]:
        """Make all fragments, and link each with those that are there already."""
        submit, place = self._executor.submit, self._place
        making = {submit(make_fragment, place, open_sequence, part): part for part in parts}
        linking: dict[tuple[int, int], Future[list[Any]]] = {}
        there: list[Part] = []
        try:
            for part in self._done(making, "fragments"):
                for other in there:
                    a, b = sorted((other, part), key=lambda p: p.index)
                    linking[a.index, b.index] = submit(link_fragments, place, a, b)
                there.append(part)
            for _ in self._done({future: pair for pair, future in linking.items()}, "links between fragments"):
                pass
            return {pair: linking[pair].result() for pair in sorted(linking)}
        finally:
            for future in linking.values():  # where a fragment could not be made
                future.cancel()

    def fuse(self, assembly: Assembly) -> dict[int, list[Block]]:
        """Move all surfels, and fuse them block by block; returns the blocks of each component."""
        submit, place, pieces = self._executor.submit, self._place, assembly.pieces
        last = {piece.component: number for number, piece in enumerate(pieces)}
        sorting = {
            submit(sort_into_blocks, place, piece, number, last=last[piece.component] == number): number
            for number, piece in enumerate(pieces)
        }
        numbers: dict[Block, list[int]] = {}
        for _ in self._done(sorting, "maps"):
            pass
        for future, number in sorting.items():
            for block in future.result():
                numbers.setdefault(block, []).append(number)
        fusing = {submit(fuse_block, place, block, numbers[block]): block for block in sorted(numbers)}
        for _ in self._done(fusing, "blocks"):
            pass
        blocks: dict[int, list[Block]] = {}
        for block in sorted(numbers):
            blocks.setdefault(block.component, []).append(block)
        return blocks

    def _done(self, tasks: Mapping[Future[Any], Any], what: str) -> Iterator[Any]:
        """Yield the keys of tasks as these end; raises what one of them has raised, and takes the others back."""
        try:
            self._progress(what, 0, len(tasks))
            for done, future in enumerate(as_completed(tasks), 1):
                future.result()
                self._progress(what, done, len(tasks))
                yield tasks[future]
        except BrokenExecutor as error:
            raise OutputError(f"{what}: a worker was lost ({error}); was there enough memory?") from None
        finally:
            for future in tasks:
                future.cancel()


def _outcome(
    place: Workplace,
    parts: Sequence[Part],
    fragments: Sequence[Fragment],
    assembly: Assembly,
    blocks: Mapping[int, list[Block]],
) -> FragmentsOutcome:
    return FragmentsOutcome(
        results=joined_results(parts, fragments, assembly),
        maps={component: whole_map(place, some) for component, some in blocks.items()},
        keyframe_frames=[
            part.start + frame
            for part, fragment in zip(parts, fragments, strict=True)
            for frame in fragment.keyframe_frames.tolist()
        ],
        loops=assembly.loops,
        num_closures=sum(fragment.num_closures for fragment in fragments),
        num_joins=sum(fragment.num_joins for fragment in fragments) + len(assembly.pieces) - len(blocks),
    )


def _check(sequence: RgbdSequence, config: SlamConfig, fragments: Sequence[Fragment]) -> None:
    """Raise DatasetError when nothing has been mapped."""
    if any(len(fragment.keyframe_frames) for fragment in fragments):
        return
    median_m = next((f.median_depth_m for f in fragments if f.median_depth_m > 0), 0.0)
    why = explain_unusable_depth(median_m, sequence.depth_scale, (0.0, config.surfaces.max_depth_m))
    raise DatasetError(f"{sequence.name}: no fragment has a frame with usable depth, the map is empty; {why}")


def _described(
    parts: Sequence[Part], fragments: Sequence[Fragment], assembly: Assembly, main: int
) -> tuple[dict[str, Any], list[str]]:
    """Return what run.json holds of the fragments, and what is to be warned of."""
    warnings = [warning for fragment in fragments for warning in fragment.warnings]
    described = []
    for part, fragment in zip(parts, fragments, strict=True):
        tracked = sum(result.state in POSED for result in fragment.frames)
        components = sorted({piece.component for piece in assembly.pieces if piece.fragment == part.index})
        described.append({
            "frames": [part.start, part.stop], "tracked": tracked, "keyframes": len(fragment.submaps),
            "components": components,
        })  # fmt: skip
        if 2 * tracked < len(part):
            warnings.append(f"{part}: was lost, {tracked} of {len(part)} frames are tracked")
        if components and main not in components:
            warnings.append(f"{part}: connects to no fragment of the main map; its own is map-{components[0]}.ply")
    links = [{"fragments": [a, b], "edges": of, "kept": kept} for (a, b), (kept, of) in sorted(assembly.kept.items())]
    return {"parts": described, "links": links}, warnings
