"""Storage of surfels: what goes in comes out, in order, whatever is removed or grown in between."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

import scanweld as sw
from scanweld.geometry import se3

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
            assert stored.remove(doomed) == doomed.sum()
            expected = {name: expected[name][..., ~doomed] for name in NAMES}
        assert len(stored) == expected["radii_m"].shape[0]
        for name, values in content(stored).items():
            np.testing.assert_array_equal(values, expected[name], err_msg=name)


def test_capacity_doubles_and_keeps_what_is_there() -> None:
    stored = sw.SurfelMap(capacity=16)
    first = surfels(1, 16)
    stored.append(*first.values(), 3)
    assert stored.capacity == 16
    stored.append(*surfels(2, 1).values(), 4)
    assert stored.capacity == 32
    stored.append(*surfels(3, 200).values(), 5)
    assert stored.capacity == 256
    np.testing.assert_array_equal(stored.positions_m[:, :16], first["positions_m"])
    np.testing.assert_array_equal(np.unique(stored.created, return_counts=True)[1], [16, 1, 200])


def test_readers_get_read_only_views() -> None:
    stored = sw.SurfelMap()
    stored.append(*surfels(1, 5).values(), 0)
    for name in NAMES:
        if name != "colors":  # a copy
            with pytest.raises(ValueError, match="read-only"):
                getattr(stored, name)[..., 0] = 1
    assert np.shares_memory(stored.positions_m, stored.arrays.positions)


def test_contract_is_checked() -> None:
    stored = sw.SurfelMap(capacity=16)
    stored.append(*surfels(1, 5).values(), 0)
    with pytest.raises(sw.InvalidInputError, match=r"shape \(5,\), got \(4,\)"):
        stored.remove(np.zeros(4, bool))
    for more in (-1, 12):
        with pytest.raises(sw.InvalidInputError, match="reserve first"):
            stored.extend(more)
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
