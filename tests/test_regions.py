"""Shelves of pages belong to regions: what is near together is on few of them, however pages come and go."""

from __future__ import annotations

import numpy as np
import pytest

import scanweld as sw
from scanweld.mapping.storage.kernels import SHELF
from scanweld.mapping.storage.regions import Regions


def around(rng: np.random.Generator, place_m: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """Surfels within half a metre of a place, mostly each in a page of its own."""
    ones = np.ones((3, count), np.float32)
    return (place_m[:, None] + rng.uniform(-0.5, 0.5, (3, count))).astype(np.float32), ones, ones, ones[0], ones[0]


def test_places_that_take_turns_keep_to_their_shelves() -> None:
    """Twelve places, ten metres apart, of which a third of the surfels goes and comes again and again, at random."""
    rng, surfels = np.random.default_rng(0), sw.SurfelMap()
    places = np.array([[10.0 * k + 1.0, 1.0, 1.0] for k in range(12)])
    for turn in range(60):
        surfels.append(*around(rng, places[rng.integers(12)], 60), turn)
        if turn % 3 == 2:
            surfels.remove(rng.random(len(surfels)) < 0.3)
    pages = surfels.pages
    pages.regions.check(pages.counts > 0)
    middles = 0.5 * (pages.boxes[pages.live, 0] + pages.boxes[pages.live, 3])
    for shelf in np.unique(pages.live // SHELF):
        assert np.ptp(middles[pages.live // SHELF == shelf]) < 2.0
    assert len(np.unique(pages.live // SHELF)) <= 24


def test_an_empty_shelf_can_be_any_regions() -> None:
    rng, surfels = np.random.default_rng(1), sw.SurfelMap()
    for turn in range(30):
        surfels.append(*around(rng, np.array([10.0 * turn + 1.0, 1.0, 1.0]), 60), turn)
        surfels.remove(np.ones(len(surfels), bool))
    assert surfels.pages.capacity <= 4 * SHELF
    assert surfels.pages.regions.left[0] == len(surfels.pages.regions.used)


def test_a_state_that_is_none_is_refused() -> None:
    regions = Regions()
    regions.grow(2)
    nothing = np.zeros(2 * SHELF, bool)
    regions.check(nothing)
    with pytest.raises(ValueError, match="shelves of other pages"):
        regions.check(~nothing)
    regions.free[:2] = 1
    with pytest.raises(ValueError, match="empty"):
        regions.check(nothing)
