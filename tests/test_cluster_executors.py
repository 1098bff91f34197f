"""Where tasks run: processes of this machine, or the workers of a scheduler."""

from __future__ import annotations

import os
from concurrent.futures import as_completed

import pytest

from scanweld.cluster.executors import opened_executor
from scanweld.cluster.scheduler import connected
from scanweld.errors import InvalidInputError


def test_processes_of_this_machine() -> None:
    with opened_executor(workers=1) as executor:
        futures = [executor.submit(pow, 2, k) for k in range(5)]
        assert {future.result() for future in as_completed(futures)} == {1, 2, 4, 8, 16}
        assert executor.submit(os.getpid).result() != os.getpid()
    with pytest.raises(InvalidInputError, match="at least one"), opened_executor(workers=0):
        pass


def test_workers_of_a_scheduler() -> None:
    """The same calls; equal tasks are not taken for one, since tasks write files."""
    with connected(workers=1) as client:
        address = client.scheduler_info()["address"]
        with opened_executor(address) as executor:
            futures = [executor.submit(pow, 2, k) for k in range(5)]
            assert {future.result() for future in as_completed(futures)} == {1, 2, 4, 8, 16}
            assert executor.submit(os.getpid).result() != os.getpid()
            with pytest.raises(ZeroDivisionError):
                executor.submit(divmod, 1, 0).result()
        with pytest.raises(InvalidInputError, match="has workers of its own"), opened_executor(address, workers=2):
            pass
