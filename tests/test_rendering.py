"""The map seen from a pose, and pictures of discs whose outline is known; a plain z-buffer is in test_backends."""

from __future__ import annotations

import numpy as np
import pytest

import scanweld as sw
from scanweld.geometry import se3
from scanweld.mapping.rendering import find_candidates, render_index_map, render_model_view, render_picture
from scanweld.mapping.storage.pages import CELL_M

SMALL = sw.PinholeCamera(40.0, 42.0, 19.3, 14.8, 40, 30)
POSE = se3.exp([0.3, -0.2, 0.1, 0.4, -0.3, 0.2])


def cloud(seed: int, count: int, T_world_camera: np.ndarray = POSE) -> sw.SurfelMap:
    """Surfels all around the camera, a third in view, facing anywhere."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -0.8, -0.5], [1, 0.8, 2], (count, 3)) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    normals = rng.standard_normal((count, 3)) - 0.8 * T_world_camera[:3, 2]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    surfels = sw.SurfelMap()
    surfels.append(
        points.T.astype(np.float32), normals.T.astype(np.float32), rng.integers(0, 256, (3, count)),
        np.full(count, 0.01, np.float32), rng.random(count).astype(np.float32), 0,
    )  # fmt: skip
    return surfels


def seen_from(surfels: sw.SurfelMap, T_world_camera: np.ndarray) -> tuple[np.ndarray, ...]:
    """Camera-frame points and normals, pixel coordinates u and v."""
    T = np.linalg.inv(T_world_camera)
    p = T[:3, :3] @ surfels.positions_m + T[:3, 3:]
    n = T[:3, :3] @ surfels.normals
    with np.errstate(divide="ignore", invalid="ignore"):
        return p, n, SMALL.fx * p[0] / p[2] + SMALL.cx, SMALL.fy * p[1] / p[2] + SMALL.cy


def index_map_of(surfels: sw.SurfelMap, T_world_camera: np.ndarray, stable: float = 0) -> np.ndarray:
    """The index map with the places of the surfels in the map's properties."""
    candidates = find_candidates(surfels, T_world_camera, SMALL)
    seen = render_index_map(surfels, candidates, T_world_camera, SMALL, stable)
    return np.where(seen.numbers >= 0, surfels.rows_of(np.maximum(seen.numbers, 0)), -1)


@pytest.mark.parametrize("seed", range(3))
def test_candidates_hold_all_that_is_near_the_image_and_little_else(seed: int) -> None:
    """The margin of 5 pixels is 0.12 m at 1 m; a page that reaches into the frustum reaches out of it by a cell."""
    surfels = cloud(2 + seed, 24_000)
    slots = find_candidates(surfels, POSE, SMALL, margin_pixels=5.0, far_m=1.5)
    listed = np.isin(surfels.pages.live, slots)
    in_pages = np.repeat(listed, surfels.pages.counts[surfels.pages.live])
    p, _, u, v = seen_from(surfels, POSE)
    inside = (p[2] > 0.01) & (p[2] < 1.5) & (u > -5) & (u < SMALL.width + 5) & (v > -5) & (v < SMALL.height + 5)
    assert 0.05 < inside.mean() < 0.95
    assert in_pages[inside].all()
    reach = CELL_M * np.sqrt(3)
    margin = 5 + SMALL.fx * reach / np.maximum(p[2], 0.01)
    near = (p[2] > -reach) & (p[2] < 1.5 + reach) & (
        (p[2] < reach) | (np.abs(u - 20) < 22 + 2 * margin) & (np.abs(v - 15) < 17 + 2 * margin)
    )  # fmt: skip
    assert not in_pages[~near].any()
    assert in_pages.mean() < 0.9


def test_same_view_at_any_number_of_threads() -> None:
    from scanweld.parallel import get_num_threads

    surfels, usual, views = cloud(3, 80_000), get_num_threads(), set()
    try:
        for threads in (1, 2, 3, 8):
            sw.set_num_threads(threads)
            view = render_model_view(surfels, find_candidates(surfels, POSE, SMALL), POSE, SMALL)
            picture = render_picture(surfels, POSE, SMALL)
            views.add(view.index_map.tobytes() + view.positions_m.tobytes() + picture.color.tobytes())
    finally:
        sw.set_num_threads(usual)
    assert len(views) == 1


def test_model_view_gathers_the_surfels_of_its_pixels() -> None:
    surfels = cloud(4, 4000)
    mapper = sw.SurfelMapper()
    mapper.map = surfels
    seen = mapper.view(POSE, SMALL)
    expected = index_map_of(surfels, POSE, mapper.config.stable_confidence)
    np.testing.assert_array_equal(seen.index_map >= 0, expected >= 0)
    assert len(seen) == (expected >= 0).sum() > 100
    np.testing.assert_array_equal(seen.index_map.ravel()[seen.pixels], np.arange(len(seen)))
    ids = expected.ravel()[seen.pixels]
    np.testing.assert_array_equal(seen.positions_m, surfels.positions_m[:, ids])
    np.testing.assert_array_equal(seen.normals, surfels.normals[:, ids])
    np.testing.assert_array_equal(seen.confidences, surfels.confidences[ids])
    grey = np.array([0.299, 0.587, 0.114]) @ surfels.colors[:, ids]
    np.testing.assert_allclose(seen.intensities, grey, atol=1e-3)


def test_view_outlives_changes_of_the_map() -> None:
    surfels = cloud(4, 4000)
    mapper = sw.SurfelMapper()
    mapper.map = surfels
    seen, same = mapper.view(POSE, SMALL), mapper.view(POSE, SMALL)
    expected = same.positions_m.copy()
    surfels.remove(np.ones(len(surfels), bool))
    np.testing.assert_array_equal(seen.positions_m, expected)


def test_plain_view_and_its_pixels() -> None:
    """A mapper of somebody else's may hand over arrays."""
    points, index_map = np.arange(12, dtype=np.float32).reshape(3, 4), np.full(SMALL.shape, -1, np.int32)
    index_map[3, [9, 5, 7, 2]] = np.arange(4)
    view = sw.ModelView(POSE, SMALL, points, -points, points[0], index_map)
    assert len(view) == 4
    assert view.pixels.tolist() == [3 * SMALL.width + u for u in (9, 5, 7, 2)]
    assert view.intensities is None


def test_view_must_hold_the_rows_of_its_image() -> None:
    none, index_map = np.zeros((3, 0), np.float32), np.zeros(SMALL.shape, np.int32)
    with pytest.raises(sw.InvalidInputError, match="row 0 of a view of 0 rows"):
        sw.ModelView(POSE, SMALL, none, none, none[0], index_map)


def test_speck_does_not_hide_the_surface_it_belongs_to() -> None:
    """A doubtful surfel 1 % nearer than a stable one loses, 3 % nearer it wins."""
    for nearer, winner in ((0.99, 0), (0.97, 1)):
        surfels = append_disc(sw.SurfelMap(), [0, 0, 1], [0, 0, -1], 0.05, confidence=9)
        append_disc(surfels, [0, 0, nearer], [0, 0, -1], 0.05, confidence=1)
        assert index_map_of(surfels, np.eye(4), stable=5.0).max() == winner


def test_equal_depth_has_one_winner() -> None:
    """Two surfels in one place: the first one wins, always."""
    surfels = disc([0, 0, 1], [0, 0, -1], 0.05)
    surfels.append(surfels.positions_m, surfels.normals, surfels.colors, surfels.radii_m, surfels.confidences, 0)
    index_map = index_map_of(surfels, np.eye(4))
    assert index_map.max() == 0


@pytest.mark.parametrize("far_m", [1500, 2200, 3000, 5000, 9000, 1e5])
def test_far_surfels_do_not_win_by_overflow(far_m: float) -> None:
    """The depth in micrometres must fit its part of the key, however far a surfel is."""
    surfels = disc([0, 0, far_m], [0, 0, -1], 0.05)
    append_disc(surfels, [0, 0, 1], [0, 0, -1], 0.05)
    index_map = index_map_of(surfels, np.eye(4))
    assert set(np.unique(index_map)) == {-1, 1}


def disc(centre: list[float], normal: list[float], radius: float, color: int = 200) -> sw.SurfelMap:
    return append_disc(sw.SurfelMap(), centre, normal, radius, color)


def append_disc(
    surfels: sw.SurfelMap,
    centre: list[float],
    normal: list[float],
    radius: float,
    color: int = 200,
    confidence: float = 1,
) -> sw.SurfelMap:
    n = np.array(normal) / np.linalg.norm(normal)
    surfels.append(
        np.array(centre, np.float32)[:, None], n[:, None].astype(np.float32), np.full((3, 1), color),
        np.array([radius], np.float32), np.array([confidence], np.float32), 0,
    )  # fmt: skip
    return surfels


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.5, 0, -1), (0.3, -0.8, -1)])
def test_disc_covers_the_pixels_whose_rays_meet_it(normal: tuple[float, ...]) -> None:
    """Drawn: rays that meet the disc's plane within the radius plus three quarters of a pixel."""
    centre, radius = np.array([0.1, -0.05, 1.0]), 0.2
    picture = render_picture(disc([*centre], [*normal], radius), np.eye(4), SMALL, background=17)
    n = np.array(normal) / np.linalg.norm(normal)
    t = (n @ centre) / (SMALL.rays() @ n)
    distance = np.linalg.norm(SMALL.rays() * t[..., None] - centre, axis=-1)
    pixel = 0.75 / SMALL.fx
    drawn = np.isfinite(picture.depth_m)
    assert drawn[distance < radius].all()
    assert not drawn[distance > radius + 1.01 * pixel].any()
    np.testing.assert_allclose(picture.depth_m[drawn], t[drawn], rtol=1e-4)
    assert (picture.color[drawn] == 200).all()
    assert (picture.color[~drawn] == 17).all()
    np.testing.assert_allclose(picture.normals[drawn], np.broadcast_to(n, picture.normals[drawn].shape), atol=1e-6)
    assert not picture.normals[~drawn].any()


@pytest.mark.parametrize("row", [-2, 3, 59, 60, 61, 117, 121])
def test_disc_is_whole_wherever_bands_of_the_image_meet(row: int) -> None:
    """Threads draw 60 rows each. A disc of radius 0.1 at 1 m is 4 pixels: it belongs to two of them, or reaches in."""
    tall = sw.PinholeCamera(40.0, 40.0, 9.5, 59.5, 20, 120)
    centre = np.array([0.0, (row - tall.cy) / tall.fy, 1.0])
    drawn = np.isfinite(render_picture(disc([*centre], [0, 0, -1], 0.1), np.eye(4), tall).depth_m)
    distance = np.linalg.norm(tall.rays() - centre, axis=-1)
    assert drawn[distance < 0.1].all()
    assert drawn.any()
    assert not drawn[distance > 0.1 + 0.76 / 40].any()


def test_nearest_disc_is_on_top_whatever_the_order() -> None:
    for order in ((0.8, 1.2), (1.2, 0.8)):
        surfels = sw.SurfelMap()
        for z in order:
            append_disc(surfels, [0, 0, z], [0, 0, -1], 0.1, color=int(100 * z))
        picture = render_picture(surfels, np.eye(4), SMALL)
        assert picture.color[15, 19].tolist() == [80, 80, 80]
        assert picture.depth_m[15, 19] == pytest.approx(0.8)


def test_discs_seen_from_behind_or_behind_the_camera_are_not_drawn() -> None:
    for surfels in (disc([0, 0, 1], [0, 0, 1], 0.3), disc([0, 0, -1], [0, 0, -1], 0.3)):
        assert not np.isfinite(render_picture(surfels, np.eye(4), SMALL).depth_m).any()


def test_picture_of_an_empty_map_is_background() -> None:
    picture = render_picture(sw.SurfelMap(), np.eye(4), SMALL, background=17)
    assert (picture.color == 17).all()
    assert (picture.normal_colors(np.eye(4), background=19) == 19).all()


def test_doubtful_surfels_can_be_left_out() -> None:
    surfels = append_disc(sw.SurfelMap(), [0, 0, 1], [0, 0, -1], 0.1, confidence=2)
    assert np.isfinite(render_picture(surfels, np.eye(4), SMALL, min_confidence=2).depth_m).any()
    assert not np.isfinite(render_picture(surfels, np.eye(4), SMALL, min_confidence=2.1).depth_m).any()


def test_normals_as_colours() -> None:
    """Towards the camera is (128, 128, 255); facing right is red, facing up is green, whatever the camera's pose."""
    for normal, color in (((0, 0, -1), (128, 128, 255)), ((1, 0, -1), (218, 128, 218)), ((0, -1, -1), (128, 218, 218))):
        n = POSE[:3, :3] @ np.array(normal, float)
        centre = POSE[:3, :3] @ [0, 0, 1] + POSE[:3, 3]
        picture = render_picture(disc([*centre], [*n], 0.2), POSE, SMALL)
        np.testing.assert_allclose(picture.normal_colors(POSE)[15, 19].astype(int), color, atol=1)


def test_view_does_not_depend_on_the_world_frame() -> None:
    surfels, T = cloud(5, 3000), se3.exp([1, -2, 0.5, 0.3, 1.0, -0.4])
    moved = sw.SurfelMap()
    positions = (T[:3, :3] @ surfels.positions_m + T[:3, 3:]).astype(np.float32)
    normals = (T[:3, :3] @ surfels.normals).astype(np.float32)
    moved.append(positions, normals, surfels.colors, surfels.radii_m, surfels.confidences, 0)
    a, b = index_map_of(surfels, POSE), index_map_of(moved, T @ POSE)
    assert (a >= 0).sum() > 300
    # Their confidences name them: the two maps keep them in orders of their own.
    a, b = (np.where(k >= 0, m.confidences[k], -1) for k, m in ((a, surfels), (b, moved)))
    assert (a != b).mean() < 0.005  # float32 rounding at the borders of pixels
