"""Maps larger than their memory budget: the same results, to the byte, and no more memory than was granted."""

from __future__ import annotations

import copy
import logging
import mmap
import os
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

import scanweld as sw
from rendered import CAMERA, rendered
from scanweld.geometry import se3
from scanweld.mapping.merging import merge_doubled
from scanweld.mapping.rendering import render_picture
from scanweld.mapping.storage.backing import MappedFile, Memory
from scanweld.mapping.storage.kernels import PAGE, SHELF, SPAN
from scanweld.mapping.storage.pages import NEVER, MapConfig
from scanweld.mapping.storage.residence import Residence

NAMES = ("positions_m", "normals", "colors", "radii_m", "confidences", "created", "last_seen", "anchors")
SHELF_MB = 4e-6 * SHELF * SPAN


def scattered(seed: int, count: int, spread_m: float = 400.0) -> tuple[np.ndarray, ...]:
    """Surfels so far from each other that each has a page of its own."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((3, count))
    return (
        rng.uniform(-spread_m, spread_m, (3, count)).astype(np.float32),
        (normals / np.linalg.norm(normals, axis=0)).astype(np.float32),
        rng.integers(0, 256, (3, count)).astype(np.float32),
        rng.uniform(0.01, 0.1, count).astype(np.float32),
        rng.uniform(0, 10, count).astype(np.float32),
    )


def content(surfels: sw.SurfelMap) -> bytes:
    return b"".join(np.array(getattr(surfels, name)).tobytes() for name in NAMES)


def twins(budget_mb: float, folder: Path) -> tuple[sw.SurfelMap, sw.SurfelMap]:
    """A map in memory and one with a budget."""
    return sw.SurfelMap(16), sw.SurfelMap(16, MapConfig(memory_budget_mb=budget_mb, folder=str(folder)))


class Witness(Memory):
    """Notes what it is told."""

    paged = True

    def __init__(self) -> None:
        self.recalled: list[int] = []
        self.gone: list[int] = []

    def recall(self, ranges: object) -> None:
        self.recalled = [first // 10 for first, _ in ranges]  # type: ignore[attr-defined]

    def let_go(self, ranges: object) -> None:
        self.gone = [first // 10 for first, _ in ranges]  # type: ignore[attr-defined]


class TestResidence:
    def test_what_was_used_longest_ago_goes_first(self) -> None:
        """Three may stay. 0, 1, 2 are used, then 0 again; 3 comes and 1 goes; 1 and 2: only 1 comes, and 0 goes."""
        witness = Witness()
        residence = Residence(witness, 10, 39)
        residence.grow(6)
        for shelf in (0, 1, 2, 0):
            residence.use(np.array([shelf]))
        assert (residence.room, residence.num_held, witness.gone) == (3, 3, [])
        residence.use(np.array([3]))
        assert (witness.recalled, witness.gone) == ([3], [1])
        residence.use(np.array([1, 2]))
        assert (witness.recalled, witness.gone, residence.num_held) == ([1], [0], 3)

    def test_what_is_used_together_stays_together(self) -> None:
        witness = Witness()
        residence = Residence(witness, 10, 20)
        residence.grow(6)
        residence.use(np.arange(5))
        assert (residence.num_held, witness.gone) == (5, [])
        residence.use(np.array([5]))
        assert residence.num_held == residence.room == 2
        assert witness.gone == [0, 1, 2, 3]
        assert residence.most_held == 5


class TestMemory:
    @pytest.mark.skipif(not hasattr(mmap, "MAP_ANONYMOUS"), reason="no ranges of addresses without memory")
    def test_grows_in_place(self) -> None:
        backing = Memory(room=1 << 30)
        first = backing.grow(np.empty(0, np.float32), 5000)
        first[:] = np.arange(5000)
        second = backing.grow(first, 20_000_000)
        assert np.shares_memory(first, second[:5000])
        np.testing.assert_array_equal(second[:5000], np.arange(5000))

    def test_copies_where_there_is_no_range(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("scanweld.mapping.storage.backing._reserve", lambda size: None)
        check_copied(Memory(room=1 << 30))

    def test_copies_beyond_its_room(self) -> None:
        check_copied(Memory(room=6000))


def check_copied(backing: Memory) -> None:
    first = backing.grow(np.empty(0, np.float32), 5000)
    first[:] = np.arange(5000)
    second = backing.grow(first, 20_000)
    assert not np.shares_memory(first, second)
    assert len(second) == 20_000
    np.testing.assert_array_equal(second[:5000], np.arange(5000))


class TestMappedFile:
    def test_grows_and_forgets_nothing(self, tmp_path: Path) -> None:
        backing = MappedFile(str(tmp_path))
        first = backing.grow(np.empty(0, np.float32), 5000)
        first[:] = np.arange(5000)
        second = backing.grow(first, 20_000)
        assert len(second) == 20_000
        backing.let_go([(0, 20_000)])
        backing.recall([(0, 4096)])
        np.testing.assert_array_equal(second[:5000], np.arange(5000))
        first[7] = -1  # arrays of an earlier mapping see the same bytes
        assert second[7] == -1

    def test_file_has_no_name(self, tmp_path: Path) -> None:
        array = MappedFile(str(tmp_path)).grow(np.empty(0, np.float32), 5000)
        assert not list(tmp_path.iterdir())
        array[:] = 1

    @pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc to see its own memory")
    def test_what_is_let_go_leaves_memory(self, tmp_path: Path) -> None:
        def shared_pages() -> int:
            return int(Path("/proc/self/statm").read_text().split()[2])

        backing = MappedFile(str(tmp_path))
        array = backing.grow(np.empty(0, np.float32), 1 << 23)  # 32 MB
        array[:] = 3
        before = shared_pages()
        backing.let_go([(0, 1 << 22)])
        assert before - shared_pages() == pytest.approx((1 << 24) / 4096, rel=0.1)
        assert array.min() == 3

    def test_without_a_file_the_map_stays_in_memory(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        with caplog.at_level(logging.WARNING):
            _, surfels = twins(1, tmp_path / "missing")
            surfels.append(*scattered(1, 500), 0)
        assert len(surfels) == 500
        assert not surfels.pages._backing.paged
        assert caplog.text.count("the map stays in memory") == 1

    def test_a_disk_that_is_full_loses_nothing_and_gets_its_room_back(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        backing = MappedFile(str(tmp_path))
        first = backing.grow(np.empty(0, np.float32), 5000)
        first[:] = np.arange(5000)
        file = backing._file
        monkeypatch.setattr(backing, "_mapped", raising(OSError(28, "No space left on device")))
        second = backing.grow(first, 20_000)
        np.testing.assert_array_equal(second[:5000], np.arange(5000))
        second[0] = -1
        assert first[0] == 0
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(file)

    def test_a_copy_is_in_memory(self, tmp_path: Path) -> None:
        _, surfels = twins(1, tmp_path)
        surfels.append(*scattered(1, 500), 0)
        other = copy.deepcopy(surfels)
        before = content(surfels)
        assert content(other) == before
        other.append(*scattered(2, 500), 1)
        assert (len(other), other.pages._backing.paged) == (1000, False)
        assert content(surfels) == before


def raising(error: Exception):
    def call(*arguments: object) -> None:
        raise error

    return call


class TestSameBytes:
    def test_whatever_is_done_with_a_map(self, tmp_path: Path) -> None:
        """Add, remove, clean, correct, and take in another one: 4 shelves of 60 in memory, or all."""
        plain, paged = twins(4 * SHELF_MB, tmp_path)
        for surfels in (plain, paged):
            for k in range(4):
                surfels.append(*scattered(k, 800), k, anchor=k)
            assert surfels.remove(np.random.default_rng(1).random(len(surfels)) < 0.1) > 200
            surfels.pages.dirty[surfels.pages.live] = 1
            surfels.clean(surfels.pages.live, 50, 40, 1.0)
            T = np.stack([se3.exp([1, 2, 3, 0.1, 0.2, 0.3]), se3.exp([0, 0, 1, 0.3, 0, 0])])
            surfels.apply_correction(sw.MapCorrection(np.array([1, 3], np.int32), T))
            other = sw.SurfelMap(config=surfels.pages.config)
            other.append(*scattered(9, 900), 7, anchor=9)
            surfels.take_in(other)
            surfels.append(*scattered(3, 500), 8, anchor=9)
        assert len(plain) > 3000
        assert content(plain) == content(paged)
        assert paged.pages.resident_mb <= 4 * SHELF_MB < 0.1 * plain.pages.resident_mb

    def test_of_files_samples_and_pictures(self, tmp_path: Path) -> None:
        plain, paged = twins(3 * SHELF_MB, tmp_path)
        for surfels in (plain, paged):
            surfels.append(*scattered(5, 2000, 5.0), 0)
        parts = list(paged.batches())
        assert len(parts) > 10
        for name, values in plain.columns().items():
            np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), values)
            np.testing.assert_array_equal(paged.sample(100)[name], values[::20])
        sw.write_ply(tmp_path / "plain.ply", plain)
        sw.write_ply(tmp_path / "paged.ply", paged)
        assert (tmp_path / "plain.ply").read_bytes() == (tmp_path / "paged.ply").read_bytes()
        pictures = [render_picture(surfels, np.eye(4), CAMERA) for surfels in (plain, paged)]
        assert (pictures[0].color != 216).mean() > 0.02
        assert pictures[0].color.tobytes() == pictures[1].color.tobytes()

    def test_of_layers_that_become_one(self, tmp_path: Path) -> None:
        """Two passes over a floor of 12 m x 12 m, the second 19 cm too high: brought to 1 cm, it is one floor."""
        plain, paged = twins(4 * SHELF_MB, tmp_path)
        T = np.eye(4)
        T[2, 3] = -0.18
        correction, gone = sw.MapCorrection(np.array([20], np.int32), T[None]), []
        for surfels in (plain, paged):
            for anchor in (0, 20):
                positions, normals, colors, _, confidences = scattered(anchor, 4000, 6.0)
                positions[2], normals[:] = 0.01 * anchor - 0.01 * (anchor > 0), [[0], [0], [1]]
                surfels.append(positions, normals, colors, np.full(4000, 0.3, np.float32), confidences, 0, anchor)
            surfels.apply_correction(correction)
            surfels.pages.follow(surfels.pages.capacity)
            gone.append(merge_doubled(surfels, 100.0))
        assert gone[0] == gone[1] > 2000
        assert len(plain) == len(paged) == 8000 - gone[0]
        assert content(plain) == content(paged)

    @pytest.mark.parametrize("budget_mb", [0.5, 6.0])
    def test_of_a_run(self, budget_mb: float, tmp_path: Path) -> None:
        """Into the room, a correction that splits the map, and on from there; the budget is a part of what is seen."""
        runs = []
        for config in (MapConfig(), MapConfig(memory_budget_mb=budget_mb, folder=str(tmp_path))):
            sequence = rendered(noise="kinect", count=40, path="sweep")
            slam = sw.build_slam(sequence.camera, sw.SlamConfig(map=config))
            for k, frame in enumerate(sequence):
                slam.process(frame)
                if k == 20:
                    T = se3.exp([0.01, 0, 0.02, 0, 0.001, 0])
                    slam.mapper.apply(sw.MapCorrection(np.array([0], np.int32), T[None]))
            runs.append((content(slam.map), slam.trajectory.T_world_camera.tobytes()))
        assert len(slam.map) > 20_000
        assert runs[0] == runs[1]


def test_run_folders_are_the_same_and_nothing_is_left_beside_them(tmp_path: Path) -> None:
    files = []
    for name, budget_mb in (("plain", 0.0), ("paged", 1.0)):
        config = sw.SlamConfig(map=MapConfig(memory_budget_mb=budget_mb))
        summary = sw.run_sequence(rendered(count=8), config, out=tmp_path / name)
        assert summary.map.pages._backing.paged is (budget_mb > 0)
        shown = ("map.ply", "trajectory.txt", "renders/overview-rgb.png", "renders/view-2-normals.png")
        files.append([(tmp_path / name / file).read_bytes() for file in shown])
        assert 'folder = ""' in (tmp_path / name / "config.toml").read_text()
    assert files[0] == files[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["paged", "plain"]


operations = st.lists(
    st.tuples(st.sampled_from(["append", "remove", "move", "clean"]), st.integers(0, 2**31), st.integers(1, 300)),
    min_size=1, max_size=8,
)  # fmt: skip


@given(operations)
@settings(max_examples=20)
def test_pages_in_view_and_pages_on_probation_match_a_walk_over_all(steps: list[tuple[str, int, int]]) -> None:
    """Shelves pass over no page that is in view, and what has to be cleaned is known without looking at every page."""
    surfels = sw.SurfelMap(16)
    for frame, (kind, seed, number) in enumerate(steps):
        rng = np.random.default_rng(seed)
        if kind == "append":
            surfels.append(*scattered(seed, number, 20.0), 10 * frame, anchor=frame)
        elif kind == "remove":
            surfels.remove(rng.random(len(surfels)) < 0.5)
        elif kind == "move":
            T = se3.exp(rng.normal(0, 1, 6))
            surfels.apply_correction(sw.MapCorrection(np.array([rng.integers(0, 8)], np.int32), T[None]))
        else:
            pages, since = surfels.pages, 10 * frame - 15
            expected = np.flatnonzero((pages.counts > 0) & (pages.probation < since))
            slots = pages.on_probation_since(since)
            np.testing.assert_array_equal(slots, expected)
            surfels.clean(slots, 10 * frame, 15, 5.0)
            assert (pages.probation[pages.live] >= since).all()
        pages = surfels.pages
        assert len(surfels) == pages.counts.sum()
        planes = np.concatenate([rng.normal(0, 1, (6, 3)), rng.uniform(0, 20, (6, 1))], axis=1).astype(np.float32)
        farthest = np.maximum(planes[:, None, :3] * pages.boxes[:, :3], planes[:, None, :3] * pages.boxes[:, 3:])
        inside = (farthest.sum(axis=2) + planes[:, 3:] >= -1e-4).all(axis=0) & (pages.counts > 0)
        surely = (farthest.sum(axis=2) + planes[:, 3:] >= 1e-4).all(axis=0) & (pages.counts > 0)
        found = pages.cull(planes)
        assert np.isin(found, np.flatnonzero(inside)).all()
        assert np.isin(np.flatnonzero(surely), found).all()


def test_pages_that_a_correction_moved_are_filled_on() -> None:
    """After a metre to the right, ten surfels where the others have come to: no further page."""
    surfels = sw.SurfelMap()
    positions = np.random.default_rng(0).uniform(0.01, 0.1, (3, 100)).astype(np.float32)
    ones = np.ones((3, 100), np.float32)
    surfels.append(positions, ones, ones, ones[0], ones[0], 0)
    T = np.eye(4)
    T[0, 3] = 1.0
    surfels.apply_correction(sw.MapCorrection(np.array([0], np.int32), T[None]))
    surfels.pages.follow(surfels.pages.capacity)
    surfels.append(
        positions[:, :10] + np.float32([[1], [0], [0]]), ones[:, :10], ones[:, :10], ones[0, :10], ones[0, :10], 1
    )
    assert surfels.pages.counts[surfels.pages.live].tolist() == [110]
    assert surfels.pages.probation[surfels.pages.live].max() < NEVER
    assert surfels.capacity % PAGE == 0


def test_far_away_surfels_of_one_cell_share_a_page() -> None:
    """Beyond 262 km keys would be negative, as those of free places in the table are."""
    surfels = sw.SurfelMap()
    positions, ones = np.full((3, 5), -1e6, np.float32), np.ones((3, 5), np.float32)
    surfels.append(positions, ones, ones, ones[0], ones[0], 0)
    assert surfels.pages.counts[surfels.pages.live].tolist() == [5]


def test_numbers_of_surfels_end_somewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """300 pages in eight regions take eight shelves of 64; as many again do not fit."""
    monkeypatch.setattr("scanweld.mapping.storage.pages.MOST_PAGES", 640)
    surfels = sw.SurfelMap(16)
    surfels.append(*scattered(1, 320, 1.99), 0)
    assert (len(surfels), len(np.unique(surfels.pages.live // 64))) == (320, 8)
    assert surfels.capacity <= 640 * PAGE
    with pytest.raises(sw.InvalidInputError, match="at most 640 pages"):
        surfels.append(*scattered(2, 320, 1.99), 1)
