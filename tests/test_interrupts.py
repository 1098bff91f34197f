"""Ctrl-C in the middle of a run: a real signal, at the worst moments."""

from __future__ import annotations

import csv
import os
import signal
from pathlib import Path

import pytest

import scanweld as sw
from rendered import rendered
from scanweld.mapping.mapper import SurfelMapper
from scanweld.runs import run as runs
from scanweld.runs.interrupts import Patience


def interrupt(*_: object, **__: object) -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_the_first_waits_and_the_second_does_not() -> None:
    with Patience() as patience:
        patience.check()
        interrupt()
        with pytest.raises(KeyboardInterrupt):
            patience.check()
        with pytest.raises(KeyboardInterrupt):
            interrupt()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_another_handler_is_left_alone() -> None:
    seen: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: seen.append(number))
    try:
        with Patience():
            interrupt()
    finally:
        signal.signal(signal.SIGINT, before)
    assert seen == [signal.SIGINT]


def test_a_frame_is_in_map_and_trajectory_or_in_neither(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal comes within the fifth fusion, after the map has changed: before the frame is noted, or while the next
    one is tracked."""
    fuse, count = SurfelMapper.fuse, []

    def fuse_and_interrupt(self: SurfelMapper, *arguments: object, **options: object) -> object:
        done = fuse(self, *arguments, **options)
        count.append(done)
        if len(count) == 5:
            interrupt()
        return done

    monkeypatch.setattr(SurfelMapper, "fuse", fuse_and_interrupt)
    summary = sw.run_sequence(rendered(count=40).part(0, 12), out=tmp_path / "run")
    assert summary.interrupted
    assert len(count) in (5, 6)
    assert len(summary.results) == len(count)
    assert summary.results[-1].num_surfels == len(summary.map)
    with (tmp_path / "run" / "frames.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(count)


def test_what_is_done_is_written_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal comes while the folder is written."""
    write = runs.write_run

    def interrupt_and_write(*arguments: object, **options: object) -> None:
        interrupt()
        write(*arguments, **options)

    monkeypatch.setattr(runs, "write_run", interrupt_and_write)
    summary = sw.run_sequence(rendered(count=40).part(0, 4), out=tmp_path / "run")
    assert len(summary.results) == 4
    assert (tmp_path / "run" / "report.html").exists()
