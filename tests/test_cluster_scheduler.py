"""Clients of Dask: workers that are started here, a scheduler that runs elsewhere, and none."""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from scanweld.cluster.scheduler import CALM, connected, load_distributed
from scanweld.errors import InvalidInputError, MissingDependencyError, OutputError

if TYPE_CHECKING:
    from distributed import Client


def process_and_ctrl_c(_: int) -> tuple[int, bool]:
    """Run in a worker: which process it is, and whether it ignores Ctrl-C."""
    return os.getpid(), signal.getsignal(signal.SIGINT) == signal.SIG_IGN


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with connected(workers=1, resources={"threads": 2}) as client:
        yield client


def test_workers_are_processes_of_this_machine(client: Client) -> None:
    process, ignores_ctrl_c = client.submit(process_and_ctrl_c, 0).result(timeout=60)
    assert process != os.getpid()
    assert ignores_ctrl_c
    workers = client.scheduler_info()["workers"]
    assert [(worker["host"], worker["nthreads"], worker["resources"]) for worker in workers.values()] == [
        ("127.0.0.1", 1, {"threads": 2})
    ]


def test_worker_that_takes_the_place_of_a_lost_one_ignores_ctrl_c(client: Client) -> None:
    process, _ = client.submit(process_and_ctrl_c, 1).result(timeout=60)
    os.kill(process, signal.SIGKILL)
    later, ignores_ctrl_c = client.submit(process_and_ctrl_c, 2).result(timeout=120)
    assert later != process
    assert ignores_ctrl_c


def settings_of_dask(_: int) -> dict[str, object]:
    """Run in a worker: the settings that it was started with."""
    import dask.config

    return {name: dask.config.get(name) for name in CALM}


def test_workers_do_not_look_at_themselves_all_the_time(client: Client) -> None:
    assert client.submit(settings_of_dask, 0).result(timeout=60) == CALM


def test_client_of_a_scheduler_that_is_there(client: Client) -> None:
    address = client.scheduler_info()["address"]
    with connected(address) as other:
        assert other.submit(abs, -3).result(timeout=60) == 3
        with pytest.raises(InvalidInputError, match="has workers of its own"), connected(address, workers=2):
            pass
    assert client.submit(abs, -4).result(timeout=60) == 4  # its workers did not end with that client


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="listening sockets are looked up in /proc")
def test_nothing_listens_but_on_loopback(client: Client) -> None:
    """State 0A is LISTEN; loopback, 127.0.0.1, is 0100007F, and a wildcard is all zeros."""
    pids = [os.getpid(), client.submit(os.getpid).result(timeout=60)]
    mine = {link for pid in pids for fd in Path(f"/proc/{pid}/fd").iterdir() if "socket:" in (link := _target(fd))}
    rows = [line.split() for table in ("tcp", "tcp6") for line in Path(f"/proc/net/{table}").read_text().splitlines()]
    heard = [row[1].partition(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in mine]
    assert heard
    assert set(heard) == {"0100007F"}


def _target(link: Path) -> str:
    try:
        return os.readlink(link)
    except OSError:  # closed meanwhile
        return ""


def test_log_of_dask_is_as_it_was_in_the_end() -> None:
    load_distributed()  # which sets it
    before = logging.getLogger("distributed").level

    def interrupted() -> None:
        with connected(workers=1) as client:
            client.submit(abs, -1).result(timeout=60)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert logging.getLogger("distributed").level == before
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_no_scheduler_at_an_address() -> None:
    with socket.socket() as unheard:
        unheard.bind(("127.0.0.1", 0))
        port = unheard.getsockname()[1]
        address = f"tcp://127.0.0.1:{port}"
        with pytest.raises(OutputError, match=f"{address}: no scheduler is reached"):
            connected(address, timeout_s=0.2).__enter__()


def test_an_address_that_is_none() -> None:
    with pytest.raises(InvalidInputError, match="tcp://HOST:8786"), connected("nonsense://", timeout_s=0.2):
        pass


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"distributed.*pip install 'scanweld\[cluster\]'"), connected():
        pass
