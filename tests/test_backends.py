"""The implementations of the hot operations: the same answers from compiled kernels and from plain NumPy."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, frame_of, plane_depth, rendered
from scanweld.backends import BACKENDS, get_backend
from scanweld.errors import InvalidInputError
from scanweld.geometry import se3
from scanweld.mapping.backends.arrays import IndexMap
from scanweld.mapping.fusion import FusionConfig
from scanweld.mapping.rendering import find_candidates, render_index_map, render_model_view
from scanweld.mapping.storage.kernels import PAGE
from scanweld.registration import kernels
from scanweld.registration.projective import ProjectiveConfig, projective_step
from test_projective import random_source, random_target
from test_rendering import POSE, SMALL, cloud

COLUMNS = ("positions_m", "normals", "colors", "radii_m", "confidences", "created", "last_seen", "anchors")


@contextmanager
def using(name: str) -> Iterator[None]:
    usual = get_backend()
    sw.set_backend(name)
    try:
        yield
    finally:
        sw.set_backend(usual)


class TestChoice:
    def test_kernels_by_default(self) -> None:
        assert get_backend() == os.environ.get("SCANWELD_BACKEND", "numba")

    def test_unknown_name(self) -> None:
        before = get_backend()
        with pytest.raises(InvalidInputError, match="expected numba or numpy, got 'cuda'"):
            sw.set_backend("cuda")
        assert get_backend() == before

    @pytest.mark.parametrize(("value", "told"), [("numpy", "numpy"), ("", "numba"), ("abacus", "got 'abacus'")])
    def test_environment(self, value: str, told: str) -> None:
        code = "from scanweld.backends import get_backend; print(get_backend())"
        environment = {**os.environ, "SCANWELD_BACKEND": value}
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
        )
        assert told in (done.stdout if done.returncode == 0 else done.stderr.splitlines()[-1])

    def test_the_reference_runs_no_kernel_of_its_operations(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """With the compiled ones taken away it still answers, and they do not."""
        for package, names in (
            ("mapping", ("splat_pages", "list_winners", "show_pages", "merge_pages", "cover_rows", "new_surfels")),
            ("registration", ("point_to_plane_sums",)),
        ):
            for name in names:
                monkeypatch.setattr(f"scanweld.{package}.kernels.{name}", None)
        with using("numpy"):
            short_run(2)
        with using("numba"), pytest.raises(TypeError):
            short_run(2)


@pytest.mark.parametrize("parts", [None, 7])
@pytest.mark.parametrize(
    "count", [0, 1, kernels.BLOCK - 1, kernels.BLOCK, kernels.BLOCK + 1, kernels.CHUNK, 2 * kernels.CHUNK + 700]
)
def test_projective_step(count: int, parts: int | None) -> None:
    """Sums of products of float32 rows: to 1e-5 of what they are at most (Cauchy and Schwarz)."""
    source, target, T = random_source(3, count), random_target(4), se3.exp([0.03, -0.02, 0.05, 0.1, -0.05, 0.2])
    config = ProjectiveConfig(min_cosine=0.6, robust_sigma=8.0)
    steps = []
    for name in BACKENDS:
        with using(name):
            steps.append(projective_step(*source, T, target, 0.15, config, np.zeros(3), 1.0, parts=parts))
    ours, expected = steps
    if count > 500:
        assert 0 < expected.num_inliers < expected.num_matched < expected.num_projected < count
    for field in ("num_inliers", "num_matched", "num_projected"):
        assert getattr(ours, field) == getattr(expected, field)
    assert ours.loss == pytest.approx(expected.loss, rel=1e-4)
    assert ours.rmse_m == pytest.approx(expected.rmse_m, rel=1e-4)
    H, g = expected.shares.information, expected.shares.gradient
    assert ours.shares.information.shape == H.shape
    scale = np.sqrt(np.einsum("kii->ki", H)) + 1e-6
    np.testing.assert_allclose(ours.shares.information / (scale[:, :, None] * scale[:, None]), H / (
        scale[:, :, None] * scale[:, None]), atol=1e-5)  # fmt: skip
    residuals = np.sqrt(2 * 8.0 * max(expected.loss, 1.0) * max(expected.num_matched, 1))
    assert (np.abs(ours.shares.gradient - g) <= 1e-5 * scale * residuals + 1e-9).all()


def listed(seen: IndexMap) -> list[np.ndarray]:
    """What an index map says; the places and pixels beyond the winners of a page are undefined."""
    numbers, pixels = seen.winners()
    return [seen.numbers, seen.slots, seen.won, numbers, pixels]


@pytest.mark.parametrize("stable", [0.0, 0.5])
@pytest.mark.parametrize("count", [0, 1, 12_000])
def test_index_map_and_view(count: int, stable: float) -> None:
    surfels = cloud(1, count)
    slots, maps, views = find_candidates(surfels, POSE, SMALL), [], []
    for name in BACKENDS:
        with using(name):
            maps.append(listed(render_index_map(surfels, slots, POSE, SMALL, stable)))
            views.append(render_model_view(surfels, slots, POSE, SMALL, stable))
    for ours, expected in zip(*maps, strict=True):
        np.testing.assert_array_equal(ours, expected)
    for name in ("index_map", "positions_m", "normals", "confidences"):
        np.testing.assert_array_equal(getattr(views[0], name), getattr(views[1], name))
    np.testing.assert_allclose(views[0].intensities, views[1].intensities, atol=1e-3)
    if count > 1:
        assert len(views[0]) > 200
        assert maps[0][3].max() > PAGE


def lived_in_map(seed: int, config: FusionConfig) -> sw.SurfelMapper:
    """A slanted wall seen twice, and surfels before and behind it that a frame looks through or does not see."""
    rng = np.random.default_rng(seed)
    mapper = sw.SurfelMapper(config)
    for k in range(2):
        mapper.fuse(noisy_wall(rng), se3.exp([0.01 * k, 0, 0, 0, 0.01 * k, 0]))
    count = 150
    points = SMALL.rays().reshape(-1, 3)[rng.integers(0, 1200, count)] * rng.uniform(0.9, 2.2, (count, 1))
    mapper.map.append(
        points.T.astype(np.float32), np.tile(np.array([[0], [0], [-1]], np.float32), count),
        rng.integers(0, 256, (3, count)), np.full(count, 0.01, np.float32),
        rng.uniform(0.1, 2, count).astype(np.float32), 1,
    )  # fmt: skip
    return mapper


def noisy_wall(rng: np.random.Generator) -> sw.SurfacePyramid:
    depth = plane_depth((0.2, 0.1, 1), 1.5, SMALL) + 0.004 * rng.standard_normal(SMALL.shape)
    depth[10:14, 20:30] = 0
    color = rng.integers(0, 256, (*SMALL.shape, 3)).astype(np.uint8)
    return sw.build_pyramid(replace(frame_of(depth, camera=SMALL), color=color))


@pytest.mark.parametrize("moving", [False, True], ids=["still", "something moves"])
@pytest.mark.parametrize("seed", range(3))
def test_fusion(seed: int, moving: bool) -> None:
    """Fused, covered, new and seen through: the same surfels in the same places of the same pages."""
    config = FusionConfig(unstable_frames=1000, clean_interval=1000, max_confidence=3.0)
    with using("numba"):
        mapper = lived_in_map(seed, config)
    before = mapper.map.table()
    pyramid = noisy_wall(np.random.default_rng(100 + seed))
    mask = np.zeros(SMALL.shape, bool)
    mask[5:20, 8:25] = moving
    maps, counts, views = [], [], []
    for name in BACKENDS:
        with using(name):
            mine = copy.deepcopy(mapper)
            T = se3.exp([0.02, -0.01, 0.01, 0.01, 0.02, -0.01])
            counts.append(mine.fuse(pyramid, T, keyframe=4, moving=mask if moving else None))
            maps.append(mine.map)
            views.append(mine.last_seen or mine.view(T, SMALL))
    assert counts[0] == counts[1]
    assert counts[0].appended > 20
    np.testing.assert_array_equal(maps[0].pages.counts, maps[1].pages.counts)
    np.testing.assert_array_equal(maps[0].pages.dirty, maps[1].pages.dirty)
    ours, expected = maps[0].table(), maps[1].table()
    for name in COLUMNS:
        atol = 1e-3 if name == "colors" else 2e-5
        np.testing.assert_allclose(ours[name], expected[name], atol=atol, rtol=0, err_msg=name)
    # Many are merged, some lose confidence; new ones come last in their pages, so counting is all there is.
    old = (expected["created"] < 2).sum()
    assert old == len(before["created"])
    assert ((expected["created"] < 2) & (expected["last_seen"] == 2)).sum() > 100
    assert maps[1].pages.dirty.any()
    np.testing.assert_array_equal(views[0].index_map, views[1].index_map)
    np.testing.assert_allclose(views[0].positions_m, views[1].positions_m, atol=2e-5)


def short_run(frames: int, noise: str = "none") -> sw.Slam:
    slam = sw.build_slam(CAMERA)
    for frame in rendered(noise=noise).frames[:frames]:
        slam.process(frame)
    return slam


@pytest.mark.parametrize(("noise", "within_m"), [("none", 1e-5), ("kinect", 3e-4)])
def test_a_run(noise: str, within_m: float) -> None:
    """Eight frames of a room. Without noise, rounding alone parts the two: some micrometres.

    With noise there are points at the edge of a gate. Where one is matched by one of the two only, the path to the
    minimum is another, and it ends where what is left is a quarter of the pose's standard deviation, which is about
    1 mm at this size. Measured 0.14 mm.
    """
    runs = []
    for name in BACKENDS:
        with using(name):
            runs.append(short_run(8, noise))
    ours, expected = runs
    assert [result.state for result in ours.results] == [result.state for result in expected.results]
    assert [result.status for result in ours.results] == [result.status for result in expected.results]
    apart_m = np.linalg.norm(ours.trajectory.positions_m - expected.trajectory.positions_m, axis=1)
    assert apart_m.max() < within_m
    assert len(ours.map) == pytest.approx(len(expected.map), rel=2e-3)
