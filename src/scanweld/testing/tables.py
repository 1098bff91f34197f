"""The contract of what can be written as a table of points, as a test."""

from __future__ import annotations

import numpy as np

from scanweld.arrays import Array
from scanweld.io.columns import HasBatches, HasColumns
from scanweld.testing.promises import contents, described, require


def check_columns(thing: HasColumns) -> None:
    """Check that something keeps what :class:`~scanweld.io.columns.HasColumns` promises.

    Its columns have names, one dimension and one length, and are the same when they are asked for again. What is a
    :class:`~scanweld.io.columns.HasBatches` must have the same columns, in parts and in order.

    Parameters
    ----------
    thing : what can be written

    Raises
    ------
    AssertionError
        When it does not; the message says what was expected and what was got.
    """
    columns = thing.columns()
    length = _length(columns, "columns")
    require(contents(thing.columns()) == contents(columns), "columns: other ones when they are asked for again")
    if not isinstance(thing, HasBatches):
        return
    require(len(thing) == length, f"len: {len(thing)}, columns have {length} rows")
    parts = list(thing.batches())
    total = 0
    for part in parts:
        require(list(part) == list(columns), f"batches: columns {', '.join(part)}; expected {', '.join(columns)}")
        total += _length(part, "batches")
    require(total == length, f"batches: {total} rows in all, columns have {length}")
    for name, values in columns.items() if parts else ():
        joined = np.concatenate([part[name] for part in parts])
        require(contents(joined) == contents(values), f"batches: '{name}' differs from what columns has")


def _length(columns: dict[str, Array], call: str) -> int:
    require(isinstance(columns, dict) and bool(columns), f"{call}: expected columns by name, got {described(columns)}")
    for name, values in columns.items():
        require(isinstance(name, str) and bool(name), f"{call}: a column has the name {name!r}")
        require(
            isinstance(values, np.ndarray) and values.ndim == 1,
            f"{call}: '{name}': expected an array of one dimension, got {described(values)}",
        )
    lengths = {name: len(values) for name, values in columns.items()}
    require(len(set(lengths.values())) == 1, f"{call}: columns of different lengths: {lengths}")
    return next(iter(lengths.values()))
