"""Recordings for Rerun, read back by its own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed: pip install 'scanweld[rerun]'")

from rerun.chunk import RrdReader

import scanweld as sw
from rendered import rendered
from scanweld.errors import InvalidInputError, OutputError
from scanweld.viewer.rerun_sink import RerunSink


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[sw.RunSummary, dict[str, list[Any]]]:
    """A run of six frames, the fourth unreadable, and the chunks of its recording by entity."""
    path = tmp_path_factory.mktemp("rerun") / "deep" / "run.rrd"
    with RerunSink(str(path), title="room") as sink:
        summary = sw.run_sequence(rendered(count=6).with_frames({3: None}), observers=[sink])
    chunks: dict[str, list[Any]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        chunks.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
    return summary, chunks


def column(batches: list[Any], name: str) -> list[Any]:
    """All rows of a component."""
    rows: list[Any] = []
    for batch in batches:
        for field in batch.schema.names:
            if field.endswith(name):
                rows += [row for row in batch.column(field).to_pylist() if row is not None]
    return rows


def test_the_camera_is_where_it_was(recorded: tuple[sw.RunSummary, dict[str, list[Any]]]) -> None:
    summary, chunks = recorded
    places = np.array(column(chunks["/world/camera"], "Transform3D:translation")).reshape(-1, 3)
    np.testing.assert_allclose(places, [r.T_world_camera[:3, 3] for r in summary.results], atol=1e-6)


def test_what_it_saw_and_what_was_measured(recorded: tuple[sw.RunSummary, dict[str, list[Any]]]) -> None:
    """Five images, since one frame could not be read; a value a frame; a line about the frame that was not."""
    _, chunks = recorded
    assert len(column(chunks["/world/camera/image"], "EncodedImage:blob")) == 5
    assert len(column(chunks["/measured/surfels"], "Scalars:scalars")) == 6
    assert any("frame 3 is damaged" in str(row) for row in column(chunks["/log"], "TextLog:text"))


def test_all_of_the_map_is_there_in_the_end(recorded: tuple[sw.RunSummary, dict[str, list[Any]]]) -> None:
    """The last state of each piece, together, is the map."""
    summary, chunks = recorded
    points = [column(chunks[name], "Points3D:positions")[-1] for name in chunks if name.startswith("/world/map/")]
    written = np.concatenate([np.array(piece, np.float32).reshape(-1, 3) for piece in points])
    expected = summary.map.positions_m.T
    assert written.shape == expected.shape
    np.testing.assert_array_equal(written[np.lexsort(written.T)], expected[np.lexsort(expected.T)])


def test_targets(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"expected a file that ends in \.rrd"):
        RerunSink(str(tmp_path / "run.txt"))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        RerunSink(str(tmp_path / "file" / "run.rrd"))
