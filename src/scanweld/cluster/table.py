"""The table of a batch: one row a run, for a terminal and as Parquet."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from scanweld.cluster.outcome import Outcome, State
from scanweld.cluster.task import RunTask
from scanweld.errors import MissingDependencyError
from scanweld.report.words import length
from scanweld.runs.storage.urls import write_to

TABLE_FILE = "batch.parquet"


def rows_of(tasks: Sequence[RunTask], outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return one row a task: what was asked for, what came of it, its metrics, and what it took."""
    return [
        {
            "run": task.name,
            "input": task.source.input,
            **task.swept,
            "state": outcome.state.value,
            "verdict": outcome.verdict,
            "reason": outcome.reason,
            **outcome.metrics,
            "resumed": outcome.resumed,
            "seconds": outcome.seconds,
            "host": outcome.host,
            "scanweld": outcome.version,
        }
        for task, outcome in zip(tasks, outcomes, strict=True)
    ]


def load_pyarrow() -> Any:
    """Return the module `pyarrow`, with `pyarrow.parquet`.

    Raises
    ------
    MissingDependencyError
        When it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        raise MissingDependencyError("pyarrow", "cluster") from None
    return pyarrow


def write_table(rows: Sequence[Mapping[str, Any]], place: str) -> None:
    """Write rows as Parquet, path or URL; a value that a row does not have is null.

    Raises
    ------
    OutputError
        When it cannot be written.
    MissingDependencyError
        When pyarrow is not installed.
    """
    pa = load_pyarrow()
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: pa.array([row.get(name) for row in rows]) for name in names}
    typed = {name: c.cast(pa.float64()) if pa.types.is_null(c.type) else c for name, c in columns.items()}
    buffer = io.BytesIO()
    pa.parquet.write_table(pa.table(typed), buffer)
    write_to(place, buffer.getvalue())


VERDICTS = {"trustworthy": "good", "doubtful": "doubtful", "untrustworthy": "bad"}
"""What a verdict is called where there is room for a word."""


def result_of(outcome: Outcome) -> str:
    """Return what became of a run in one word, with a mark where it was finished before."""
    return VERDICTS.get(outcome.verdict, outcome.state.value) + ("*" if outcome.state is State.KEPT else "")


def table_lines(tasks: Sequence[RunTask], outcomes: Sequence[Outcome], columns: int) -> Iterator[str]:
    """Yield the table as lines of at most so many columns; figures give way to the name where there is no room."""
    cells = [_cells(outcome) for outcome in outcomes]
    heads = ["", "result", "ATE", "tracked", "loops", "fps", "time"]
    widths = [max(len(head), *(len(row[k]) for row in cells)) for k, head in enumerate(heads[1:])]
    longest = max(len(task.name) for task in tasks)
    shown = len(widths)
    while shown > 2 and columns - sum(widths[:shown]) - 2 * shown < min(longest, max(20, columns // 3)):
        shown -= 1
    room = min(longest, columns - sum(widths[:shown]) - 2 * shown)
    rows = [heads, *([_shortened(task.name, room), *row] for task, row in zip(tasks, cells, strict=True))]
    for name, result, *figures in rows:
        row = [name.ljust(room), result.ljust(widths[0])]
        row += [figure.rjust(width) for figure, width in zip(figures, widths[1:shown], strict=False)]
        yield "  ".join(row).rstrip()


def _cells(outcome: Outcome) -> list[str]:
    m = outcome.metrics
    if not m:
        return [result_of(outcome), "", "", "", "", ""]
    ate_m, fps = m.get("ate_rmse_m"), m.get("fps")
    return [
        result_of(outcome),
        "" if ate_m is None else length(ate_m),
        f"{m['frames_tracked']}/{m['frames']}",
        str(m["loop_closures"]),
        "" if fps is None else f"{fps:.1f}",
        f"{m['seconds_total']:.0f} s",
    ]


def _shortened(text: str, room: int) -> str:
    """Leave out the middle of what is too long: names differ in the beginning or in the end."""
    if len(text) <= room:
        return text
    head = (room - 1) // 2
    return f"{text[:head]}…{text[len(text) - (room - 1 - head) :]}"
