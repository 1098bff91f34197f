"""Layers that two passes left of a surface become one again."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scanweld.evaluation.doubled_surfaces import doubled_surfaces
from scanweld.geometry.views import MapCorrection
from scanweld.mapping.fusion import FusionConfig
from scanweld.mapping.mapper import SurfelMapper
from scanweld.mapping.merging import MergingConfig, merge_doubled, merge_maps, thin_crowded
from scanweld.mapping.surfel_map import SurfelMap

SPACING = 0.01


def wall(count: int = 60, height: float = 0.0, *, spacing: float = SPACING, seed: int = 0) -> np.ndarray:
    """Positions (3, count^2) on the plane z = height, on a grid with some jitter."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(count) * spacing, np.arange(count) * spacing)
    positions = np.stack([x.ravel(), y.ravel(), np.full(count * count, height)])
    positions[:2] += rng.uniform(-0.2, 0.2, (2, count * count)) * spacing
    return positions.astype(np.float32)


def add(
    surfels: SurfelMap,
    positions: np.ndarray,
    *,
    anchor: int,
    confidence: float = 10.0,
    normal: tuple[float, float, float] = (0, 0, 1),
    grey: float = 100.0,
    radius: float = SPACING * 0.75,
) -> None:
    """Append surfels that all face the same way."""
    count = positions.shape[1]
    normals = np.repeat(np.array(normal, np.float32)[:, None], count, axis=1)
    surfels.append(
        positions, normals, np.full((3, count), grey, np.float32), np.full(count, radius, np.float32),
        np.full(count, confidence, np.float32), anchor, anchor,
    )  # fmt: skip


def merge(surfels: SurfelMap, shift_m: float = 0.01, config: MergingConfig | None = None) -> int:
    """Move each pass by so much more than the one before, and fuse the layers that this brings together."""
    move(surfels, shift_m)
    return merge_doubled(surfels, 100.0, config)


def move(surfels: SurfelMap, shift_m: float = 0.01) -> None:
    """Move each pass to where it is, from where it would be with so much more of a shift than the one before."""
    anchors = np.unique(surfels.anchors).astype(np.int32)
    T = np.tile(np.eye(4), (len(anchors), 1, 1))
    for sign in (-1, 1):
        T[:, :3, 3] = sign * shift_m * anchors[:, None]
        surfels.apply_correction(MapCorrection(anchors, T))
        surfels.pages.follow(surfels.pages.capacity)
        if sign < 0:
            surfels.pages.corrections.meetings.fresh[:] = False


class TestMergeDoubled:
    def test_two_layers_become_one_between_them(self) -> None:
        """Of equal confidence: half way; of confidence 30 and 10: a quarter of the way from the stronger."""
        surfels = SurfelMap()
        add(surfels, wall(), anchor=0, confidence=30, grey=100)
        add(surfels, wall(height=0.02, seed=1), anchor=20, confidence=10, grey=200)
        assert doubled_surfaces(surfels.positions_m.T, surfels.normals.T).share > 0.9
        gone = merge(surfels)
        assert gone > 0.95 * 60 * 60
        assert doubled_surfaces(surfels.positions_m.T, surfels.normals.T).share < 0.01
        assert np.median(surfels.positions_m[2]) == pytest.approx(0.005, abs=1e-3)
        assert np.median(surfels.confidences) == pytest.approx(40)
        assert abs(int(np.median(surfels.colors)) - 125) <= 4

    def test_lateral_places_stay(self) -> None:
        surfels = SurfelMap()
        kept = wall()  # of pass 0, which does not move
        add(surfels, kept, anchor=0, confidence=30)
        add(surfels, wall(height=0.02, seed=1), anchor=20, confidence=10)
        merge(surfels)
        strong = surfels.positions_m[:2, surfels.confidences >= 30]
        np.testing.assert_array_equal(strong[:, np.lexsort(strong)], kept[:2, np.lexsort(kept[:2])])

    @pytest.mark.parametrize(
        ("height", "anchor", "normal"),
        [(0.02, 2, (0, 0, 1)), (0.08, 20, (0, 0, 1)), (0.02, 20, (0, 0, -1)), (0.02, 20, (1, 0, 0))],
        ids=["same pass", "further apart", "the other side of a board", "another direction"],
    )
    def test_what_is_not_one_surface_stays(self, height: float, anchor: int, normal: tuple[int, int, int]) -> None:
        surfels = SurfelMap()
        add(surfels, wall(), anchor=0)
        add(surfels, wall(height=height), anchor=anchor, normal=normal)
        move(surfels)
        before = surfels.positions_m.copy()
        assert merge_doubled(surfels, 100.0) == 0
        np.testing.assert_array_equal(surfels.positions_m, before)

    def test_beside_is_not_behind(self) -> None:
        """Two passes that share an edge keep all of their surfels."""
        surfels = SurfelMap()
        add(surfels, wall(), anchor=0)
        add(surfels, wall() + np.array([[60 * SPACING + 0.01], [0], [0.02]], np.float32), anchor=20)
        assert merge(surfels) == 0

    def test_the_finer_surfels_stay(self) -> None:
        surfels = SurfelMap()
        add(surfels, wall(20, spacing=0.03), anchor=0, radius=0.0225, confidence=90)
        add(surfels, wall(height=0.01), anchor=20, confidence=10)
        merge(surfels)
        assert np.count_nonzero(surfels.radii_m < 0.01) == 60 * 60
        assert np.count_nonzero(surfels.radii_m > 0.01) < 0.05 * 400

    def test_confidence_is_bounded(self) -> None:
        surfels = SurfelMap()
        add(surfels, wall(), anchor=0, confidence=80)
        add(surfels, wall(height=0.01), anchor=20, confidence=80)
        merge(surfels)
        assert surfels.confidences.max() == 100

    def test_what_moved_alike_stays_as_it_is(self) -> None:
        """Layers that a correction does not bring together are left to fusion."""
        surfels = SurfelMap()
        add(surfels, wall(), anchor=0)
        add(surfels, wall(height=0.01), anchor=20)
        assert merge(surfels, 0.0) == 0

    def test_off_and_empty(self) -> None:
        assert merge_doubled(SurfelMap(), 100.0) == 0
        surfels = SurfelMap()
        add(surfels, wall(), anchor=0)
        add(surfels, wall(height=0.01), anchor=20)
        assert merge(surfels, config=MergingConfig(distance_m=0)) == 0

    def test_against_a_plain_reference(self) -> None:
        rng = np.random.default_rng(3)
        surfels = SurfelMap()
        weights = rng.permutation(1500).astype(np.float32) + 1  # no ties: their order is that of the cells
        for anchor, some in zip((0, 1, 9, 10, 30), np.split(weights, 5), strict=True):
            positions = rng.uniform(0, 0.3, (3, 300)).astype(np.float32)
            normals = rng.normal(size=(3, 300))
            normals[2] += 2
            normals /= np.linalg.norm(normals, axis=0)
            surfels.append(
                positions, normals.astype(np.float32), rng.uniform(0, 255, (3, 300)).astype(np.float32),
                rng.uniform(0.02, 0.05, 300).astype(np.float32), some, 0, anchor,
            )  # fmt: skip
        move(surfels)
        expected = reference(surfels, 0.04, 0.7, 5, 100.0)
        gone = merge_doubled(surfels, 100.0)
        assert gone == 1500 - len(expected) > 100
        found = np.concatenate([surfels.positions_m, surfels.normals, surfels.confidences[None]]).T
        # The map keeps its surfels in an order of its own.
        distance, order = cKDTree(found[:, :3]).query(expected[:, :3])
        assert distance.max() < 1e-4
        assert len(np.unique(order)) == len(expected)
        np.testing.assert_allclose(found[order], expected, atol=2e-5, rtol=1e-5)


def reference(surfels: SurfelMap, distance: float, cosine: float, gap: int, most: float) -> np.ndarray:
    """The same in plain NumPy, one surfel at a time, cell by cell: rows of position, normal, confidence."""
    p, n = surfels.positions_m.T.astype(float), surfels.normals.T.astype(float)
    r, w, a = surfels.radii_m.astype(float), surfels.confidences.astype(float), surfels.anchors.astype(int)
    pages = surfels.pages
    cells = np.repeat(pages.cells[pages.live], pages.counts[pages.live])
    alive = np.ones(len(r), bool)
    for cell in np.unique(cells):
        ranking = np.lexsort((-w, np.floor(np.log(r) / np.log(1.5))))
        rank = np.empty(len(r), int)
        rank[ranking] = np.arange(len(r))
        for k in ranking[cells[ranking] == cell]:
            if not alive[k]:
                continue
            d = p - p[k]
            h = d @ n[k]
            lateral = (d**2).sum(axis=1) - h**2
            eaten = alive & (rank > rank[k]) & (abs(a - a[k]) >= gap) & (abs(h) <= distance) & (n @ n[k] >= cosine)
            eaten &= lateral <= np.maximum(r, r[k]) ** 2
            if not eaten.any():
                continue
            alive &= ~eaten
            weight = w[k] + w[eaten].sum()
            p[k] += n[k] * (w[eaten] @ h[eaten]) / weight
            direction = w[k] * n[k] + w[eaten] @ n[eaten]
            n[k] = direction / np.linalg.norm(direction)
            w[k] = min(weight, most)
    return np.concatenate([p, n, w[:, None]], axis=1)[alive]


def test_a_correction_of_the_map_fuses_what_it_brings_together() -> None:
    """The second pass lies 20 cm off; the loop is closed but for 1 cm."""
    mapper = SurfelMapper(FusionConfig())
    add(mapper.map, wall(), anchor=0)
    add(mapper.map, wall(height=0.2, seed=1), anchor=20)
    T = np.eye(4)
    T[2, 3] = -0.19
    mapper.apply(MapCorrection(np.array([20], np.int32), T[None]))
    mapper.finish()
    assert len(mapper.map) < 1.05 * 60 * 60
    assert np.median(mapper.map.positions_m[2]) == pytest.approx(0.005, abs=1e-3)


class TestThinCrowded:
    @staticmethod
    def crowded() -> SurfelMap:
        """Three walls at one place, ten metres from a single one; all are stable."""
        surfels = SurfelMap()
        for seed in range(3):
            add(surfels, wall(seed=seed), anchor=0, radius=0.02)
        add(surfels, wall() + np.array([[10.0], [0], [0]], np.float32), anchor=0)
        surfels.clean(surfels.pages.live, 0, 40, 3.0)
        return surfels

    def test_what_shares_a_place_becomes_one_cell_by_cell(self) -> None:
        surfels = self.crowded()
        gone = [thin_crowded(surfels, 100.0) for _ in range(60)]
        assert gone[0] > 0
        assert gone[-10:] == [0] * 10
        assert np.count_nonzero(surfels.positions_m[0] > 5) == 60 * 60
        rest = surfels.positions_m[:, surfels.positions_m[0] < 5]
        distance, _ = cKDTree(rest.T).query(rest.T, k=2)
        assert np.quantile(distance[:, 1], 0.02) > 0.009  # half of the radius; a page may keep a few that share a place
        assert rest.shape[1] < 60 * 60

    def test_a_wall_that_is_seen_again_and_again_does_not_grow(self) -> None:
        """Centres half a radius apart, 1 cm, leave room for 4157 on 60 x 60 cm (hexagons); pages may keep some more."""
        surfels, sizes = self.crowded(), []
        for seed in range(3, 12):
            add(surfels, wall(seed=seed), anchor=0)
            surfels.clean(surfels.pages.live, 0, 40, 3.0)
            for _ in range(60):
                thin_crowded(surfels, 100.0)
            sizes.append(int(np.count_nonzero(surfels.positions_m[0] < 5)))
        assert sizes[-1] < 1.2 * 4157
        assert sizes[-1] - sizes[-4] < 0.05 * 3 * 60 * 60

    def test_what_is_not_stable_is_waited_for(self) -> None:
        surfels = self.crowded()
        for _ in range(60):
            thin_crowded(surfels, 100.0)
        add(surfels, wall(seed=9), anchor=0, confidence=1.0)
        assert thin_crowded(surfels, 100.0) == 0

    def test_pages_that_have_still_to_move_are_left_alone(self) -> None:
        """After a correction no page is of any cell until it has moved: they must not be taken for one cell."""
        surfels = self.crowded()
        surfels.apply_correction(MapCorrection(np.array([0], np.int32), np.eye(4)[None]))
        assert thin_crowded(surfels, 100.0) == 0
        surfels.pages.follow(surfels.capacity)
        assert thin_crowded(surfels, 100.0) > 0


class TestMaps:
    def test_surface_that_two_maps_have_is_kept_once(self) -> None:
        """Layers 1 cm apart of equal confidence: what stays lies half-way; what one map alone has is left."""
        surfels = SurfelMap()
        add(surfels, wall(40), anchor=0)
        add(surfels, wall(40, 0.01, seed=1)[:, :800], anchor=1)  # over a half of the other one
        gone = merge_maps(surfels, 100.0)
        assert gone == 1600 + 800 - len(surfels)
        assert 1600 <= len(surfels) < 1.03 * 1600
        heights = surfels.positions_m[2]
        inner = (surfels.positions_m[1] > 0.03) & (surfels.positions_m[1] < 0.16)
        assert np.median(heights[inner]) == pytest.approx(0.005, abs=0.001)
        assert heights[surfels.positions_m[1] > 0.25].max() == 0

    def test_one_map_is_left_as_it_is(self) -> None:
        surfels = SurfelMap()
        add(surfels, np.concatenate([wall(20), wall(20, 0.01)], axis=1), anchor=3)
        assert merge_maps(surfels, 100.0) == 0
        assert merge_maps(surfels, 100.0, MergingConfig(distance_m=0.0)) == 0
        assert len(surfels) == 800
