"""Storage of surfels: what goes in comes out, in order, whatever is removed or grown in between."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

import scanweld as sw
from scanweld.geometry import se3
from scanweld.mapping.storage.kernels import PAGE
from scanweld.mapping.storage.pages import CELL_M

NAMES = ("positions_m", "normals", "colors", "radii_m", "confidences", "created", "last_seen", "anchors")


def surfels(seed: int, count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((3, count))
    return {
        "positions_m": rng.standard_normal((3, count)).astype(np.float32),
        "normals": (normals / np.linalg.norm(normals, axis=0)).astype(np.float32),
        "colors": rng.integers(0, 256, (3, count)).astype(np.uint8),
        "radii_m": rng.random(count).astype(np.float32),
        "confidences": rng.random(count).astype(np.float32),
    }


def content(surfel_map: sw.SurfelMap) -> dict[str, np.ndarray]:
    return {name: np.array(getattr(surfel_map, name)) for name in NAMES}


operations = st.lists(
    st.one_of(
        st.tuples(st.just("append"), st.integers(0, 40), st.integers(0, 5)),
        st.tuples(st.just("remove"), st.integers(0, 2**31), st.floats(0, 1)),
    ),
    max_size=12,
)


def as_set(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Put the surfels into the order of their positions: a map keeps them in an order of its own."""
    order = np.lexsort(values["positions_m"])
    return {name: values[name][..., order] for name in NAMES}


@given(operations)
def test_any_order_of_append_and_remove_matches_numpy(steps: list[tuple[str, int, float]]) -> None:
    stored, expected = sw.SurfelMap(capacity=16), content(sw.SurfelMap(capacity=16))
    for frame_id, (kind, number, extra) in enumerate(steps):
        if kind == "append":
            new = surfels(frame_id, number)
            stored.append(*new.values(), frame_id, anchor=int(extra))
            new |= {"created": np.full(number, frame_id), "last_seen": np.full(number, frame_id)}
            new |= {"anchors": np.full(number, extra)}
            expected = {name: np.concatenate([expected[name], new[name]], axis=-1) for name in NAMES}
        else:
            doomed = np.random.default_rng(number).random(len(stored)) < extra
            expected = {name: values[..., ~doomed] for name, values in content(stored).items()}
            assert stored.remove(doomed) == doomed.sum()
        assert len(stored) == expected["radii_m"].shape[0]
        for name, values in as_set(content(stored)).items():
            np.testing.assert_array_equal(values, as_set(expected)[name], err_msg=name)


@pytest.mark.parametrize("spread_m", [0.01, 2.0, 500.0])
def test_storage_grows_and_keeps_what_is_there(spread_m: float) -> None:
    """All in one cell, in many, and each in one of its own: more pages and more cells than there was room for."""
    stored, parts = sw.SurfelMap(capacity=16), []
    for k in range(6):
        parts.append(surfels(k, 700))
        parts[-1]["positions_m"] *= np.float32(spread_m)
        stored.append(*parts[-1].values(), k)
    assert len(stored) == 4200 <= stored.capacity
    everything = {name: np.concatenate([part[name] for part in parts], axis=-1) for name in parts[0]}
    numbers = np.repeat(np.arange(6), 700)
    everything |= {"created": numbers, "last_seen": numbers, "anchors": np.zeros(4200)}
    for name, values in as_set(content(stored)).items():
        np.testing.assert_array_equal(values, as_set(everything)[name], err_msg=name)


@pytest.mark.parametrize("spread_m", [0.05, 1.0, 40.0])
def test_pages_keep_within_a_cell_and_know_where_they_are(spread_m: float) -> None:
    stored = sw.SurfelMap(capacity=16)
    for k in range(4):
        part = surfels(k, 900)
        part["positions_m"] *= np.float32(spread_m)
        stored.append(*part.values(), k)
        stored.remove(np.random.default_rng(k).random(len(stored)) < 0.3)
    pages = stored.pages
    for slot in pages.live:
        positions = pages.page(slot)[:3]
        assert np.ptp(np.floor(positions / CELL_M), axis=1).max() == 0
        assert (positions >= pages.boxes[slot, :3, None]).all()
        assert (positions <= pages.boxes[slot, 3:, None]).all()


def test_released_pages_are_used_again() -> None:
    stored, capacity = sw.SurfelMap(capacity=1 << 12), 0
    for k in range(40):
        stored.append(*surfels(k, 500).values(), k)
        capacity = stored.capacity if k == 1 else capacity
        stored.remove(np.ones(len(stored), bool))
    assert len(stored) == 0
    assert stored.capacity == capacity


def test_table_is_everything_and_can_be_put_back() -> None:
    stored, other = sw.SurfelMap(), sw.SurfelMap()
    stored.append(*surfels(1, 300).values(), 4, anchor=7)
    other.append(*surfels(2, 20).values(), 1)
    table = stored.table()
    table["colors"] += np.float32(0.25)
    other.replace(table)
    for name, values in content(stored).items():
        np.testing.assert_array_equal(getattr(other, name), values, err_msg=name)
    np.testing.assert_array_equal(other.table()["colors"], table["colors"])


def test_other_map_is_taken_in_as_it_is() -> None:
    stored, other = sw.SurfelMap(), sw.SurfelMap()
    stored.append(*surfels(1, 900).values(), 4, anchor=1)
    other.append(*surfels(2, 700).values(), 9, anchor=2)
    before, expected = content(stored), content(other)
    stored.take_in(other)
    assert len(stored) == 1600
    for anchor, part in ((1, before), (2, expected)):
        mine = stored.anchors == anchor
        found = as_set({name: values[..., mine] for name, values in content(stored).items()})
        for name, values in as_set(part).items():
            np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_numbers_lead_to_surfels() -> None:
    stored = sw.SurfelMap()
    stored.append(*surfels(1, 2000).values(), 0)
    slot = int(stored.pages.live[5])
    places = stored.rows_of(slot * PAGE + np.arange(stored.pages.counts[slot]))
    np.testing.assert_array_equal(stored.positions_m[:, places], stored.pages.page(slot)[:3])


def test_readers_cannot_write() -> None:
    stored = sw.SurfelMap()
    stored.append(*surfels(1, 5).values(), 0)
    for name in NAMES:
        with pytest.raises(ValueError, match="read-only"):
            getattr(stored, name)[..., 0] = 1


def test_contract_is_checked() -> None:
    stored = sw.SurfelMap(capacity=16)
    stored.append(*surfels(1, 5).values(), 0)
    with pytest.raises(sw.InvalidInputError, match=r"shape \(5,\), got \(4,\)"):
        stored.remove(np.zeros(4, bool))
    assert len(stored) == 5


def test_correction_moves_the_surfels_of_its_keyframes_only() -> None:
    stored = sw.SurfelMap()
    for anchor in (0, 1, 2, 1):
        stored.append(*surfels(anchor, 10).values(), 0, anchor=anchor)
    before = content(stored)
    T = np.stack([se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]), se3.exp([1, 0, 0, 0, 0, 1])])
    stored.apply_correction(sw.MapCorrection(np.array([2, 1], np.int32), T))
    for i in range(40):
        motion = {0: np.eye(4), 1: T[1], 2: T[0]}[int(before["anchors"][i])]
        expected = motion[:3, :3] @ before["positions_m"][:, i] + motion[:3, 3]
        np.testing.assert_allclose(stored.positions_m[:, i], expected, atol=1e-6)
        np.testing.assert_allclose(stored.normals[:, i], motion[:3, :3] @ before["normals"][:, i], atol=1e-6)


def test_columns_are_those_of_the_file() -> None:
    stored = sw.SurfelMap()
    stored.append(*surfels(1, 7).values(), 0)
    columns = stored.columns()
    assert list(columns) == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "radius", "confidence"]
    assert all(column.shape == (7,) for column in columns.values())
    assert columns["red"].dtype == np.uint8
    np.testing.assert_array_equal(columns["ny"], stored.normals[1])


def test_colors_are_rounded_not_cut() -> None:
    stored = sw.SurfelMap()
    one = surfels(1, 3)
    one["colors"] = np.array([[254.6, -0.4, 300.0]] * 3, np.float32)
    stored.append(*one.values(), 0)
    np.testing.assert_array_equal(stored.colors[0], [255, 0, 255])


def test_removing_from_nearly_empty_pages_of_one_cell() -> None:
    """What is left of the first page goes to the second one, from which something is removed, too."""
    surfels = sw.SurfelMap()
    positions = np.random.default_rng(2).uniform(0.01, 0.2, (3, 300)).astype(np.float32)
    normals = np.tile(np.array([[0], [0], [1]], np.float32), 300)
    grey, ones = np.full((3, 300), 9, np.float32), np.ones(300, np.float32)
    surfels.append(positions, normals, grey, 0.01 * ones, ones, 0)
    doomed = np.zeros(300, np.bool_)
    doomed[:230] = doomed[-1] = True
    expected = surfels.positions_m[:, ~doomed]
    assert surfels.remove(doomed) == 231
    assert len(surfels) == 69
    order = np.lexsort(surfels.positions_m)
    np.testing.assert_array_equal(surfels.positions_m[:, order], expected[:, np.lexsort(expected)])
