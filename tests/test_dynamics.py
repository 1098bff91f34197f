"""What moves is found, kept out of tracking and of the map, and what is merely new is not."""

from __future__ import annotations

from collections import deque
from functools import lru_cache

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, frame_of, plane_depth, rendered
from scanweld.datasets.synthetic import NOISE_MODELS, degrade_depth
from scanweld.errors import ConfigError, InvalidInputError
from scanweld.geometry import se3
from scanweld.geometry.views import ModelView
from scanweld.parallel import limited_threads
from scanweld.registration.result import RegistrationResult, Status
from scanweld.slam.motion import ConstantVelocity
from scanweld.tracking import kernels
from scanweld.tracking.dynamics import (
    DynamicsConfig,
    MotionDetector,
    empty_space,
    leave_out,
    search_level,
    track_static,
    widened,
)

HERE = np.eye(4)
BOX = (slice(40, 80), slice(60, 100))
"""Rows and columns of something in front of the wall."""


def wall(depth_m: float = 2.0) -> np.ndarray:
    return plane_depth((0, 0, 1), depth_m)


def with_box(depth_m: float = 1.2, behind_m: float = 2.0) -> np.ndarray:
    depth = wall(behind_m)
    depth[BOX] = depth_m
    return depth


def mapped(*depths: np.ndarray) -> sw.SurfelMapper:
    mapper = sw.SurfelMapper()
    for depth in depths:
        mapper.fuse(sw.build_pyramid(frame_of(depth)), HERE)
    return mapper


def found(
    map_of: list[np.ndarray], remembered: np.ndarray, now: np.ndarray, config: DynamicsConfig | None = None
) -> np.ndarray | None:
    """What is found to move in `now`, the map made of some images and one image remembered, all from one place."""
    detector = MotionDetector(config)
    detector.remember(sw.build_pyramid(frame_of(remembered)), HERE)
    return detector.find(sw.build_pyramid(frame_of(now)), mapped(*map_of).view(HERE, CAMERA), HERE)


class TestWhatMoves:
    def test_something_before_a_known_wall(self) -> None:
        """All that has a normal is found, and nothing of the wall: normals end one pixel from the box's edge."""
        moving = found([wall()] * 5, wall(), with_box())
        inner = np.zeros(CAMERA.shape, bool)
        inner[41:79, 61:99] = True
        assert moving[inner].all()
        outer = np.ones(CAMERA.shape, bool)
        outer[BOX] = False
        assert not moving[outer].any()

    def test_nothing_moves_where_nothing_changed(self) -> None:
        assert found([wall()] * 5, wall(), wall()) is None

    def test_what_was_never_seen_before_is_new_and_does_not_move(self) -> None:
        """The earlier view had no depth where the box stands now: nobody knows that the place was empty."""
        unseen = wall()
        unseen[30:90, 50:110] = 0
        assert found([unseen] * 5, unseen, with_box()) is None

    def test_what_the_map_knows_does_not_move(self) -> None:
        """One earlier view missed the box, as of a thin or shiny thing, but the map holds it."""
        assert found([with_box()] * 5, wall(), with_box()) is None

    def test_a_map_that_is_not_stable_confirms_nothing(self) -> None:
        assert found([with_box()], wall(), with_box()) is not None

    def test_what_went_away_leaves_nothing_that_moves(self) -> None:
        """The wall that shows again lies behind what was seen: that place was not empty but unseen."""
        assert found([with_box()] * 5, with_box(), wall()) is None

    def test_a_step_within_the_margin_is_no_motion(self) -> None:
        """sigma(2 m) = 0.0012 + 0.0019 * 1.6^2 = 6.1 mm. The wall seen empty up to 2 - 4 sigma = 1.976 m, the box must
        be 0.05 m + 4 sigma(1.9 m) = 76 mm before that: further than 1.90 m it is no motion, nearer it is one."""
        assert found([wall()] * 5, wall(), with_box(1.92)) is None
        assert found([wall()] * 5, wall(), with_box(1.87)) is not None

    def test_small_regions_are_left_alone(self) -> None:
        """1 % of 160 x 120 pixels are 192; a box of 15 x 15 has normals on 13 x 13 = 169, one of 17 x 17 on 225."""
        for size, seen in ((15, False), (17, True)):
            now = wall()
            now[50 : 50 + size, 70 : 70 + size] = 1.2
            assert (found([wall()] * 5, wall(), now, DynamicsConfig(min_share=0.01)) is not None) is seen

    def test_memory_of_no_frames_finds_nothing(self) -> None:
        assert found([wall()] * 5, wall(), with_box(), DynamicsConfig(memory_frames=0)) is None

    def test_nothing_is_known_before_the_first_view_nor_after_forgetting(self) -> None:
        detector, view = MotionDetector(), mapped(wall()).view(HERE, CAMERA)
        pyramid = sw.build_pyramid(frame_of(with_box()))
        assert detector.find(pyramid, view, HERE) is None
        detector.remember(sw.build_pyramid(frame_of(wall())), HERE)
        assert detector.find(pyramid, view, HERE) is not None
        detector.forget()
        assert detector.find(pyramid, view, HERE) is None

    def test_another_camera_starts_anew(self) -> None:
        detector = MotionDetector()
        detector.remember(sw.build_pyramid(frame_of(wall())), HERE)
        small = CAMERA.scaled(0.8)
        pyramid = sw.build_pyramid(frame_of(plane_depth((0, 0, 1), 1.0, small), camera=small))
        assert detector.find(pyramid, mapped(wall()).view(HERE, small), HERE) is None
        detector.remember(pyramid, HERE)
        assert [past.camera.shape for past in detector._memory] == [small.shape]

    def test_empty_space_is_what_a_neighbourhood_was_seen_through(self) -> None:
        """2 m less four times sigma(2 m) = 6.064 mm; the box is 1.2 m away. Columns 59 and 60, wall and box, lie on the
        edge and have no normals: they and their neighbours tell nothing."""
        level = search_level(sw.build_pyramid(frame_of(with_box())))
        until = empty_space(level, HERE, 4.0).empty_until_m
        assert until[20, 20] == pytest.approx(2 - 4 * 0.006064, abs=2e-4)
        assert until[60, 80] == pytest.approx(1.2 - 4 * (0.0012 + 0.0019 * 0.8**2), abs=2e-4)
        assert (until[60, 58:62] == 0).all()
        assert until[0, 0] == 0  # beside the image nothing is known

    @pytest.mark.parametrize("noise", ["none", "kinect", "realsense"])
    def test_nothing_moves_in_a_static_room(self, noise: str) -> None:
        """A moving camera, true poses: surfaces come into view and go, edges flicker, and none of it moves."""
        sequence = rendered(noise=noise, count=40)
        mapper, detector = sw.SurfelMapper(), MotionDetector()
        for frame, T in zip(sequence.frames, sequence.ground_truth.T_world_camera, strict=True):
            pyramid = sw.build_pyramid(frame)
            assert detector.find(pyramid, mapper.view(T, CAMERA), T) is None
            detector.remember(pyramid, T)
            mapper.fuse(pyramid, T)

    def test_same_pixels_at_any_thread_count(self) -> None:
        frames = crossing()[0]
        masks = []
        for threads in (1, 2):
            with limited_threads(threads):
                mapper, detector = sw.SurfelMapper(), MotionDetector()
                pyramids = [sw.build_pyramid(frames[k]) for k in (0, 1, 2, 3, 24)]
                for pyramid in pyramids[:4]:
                    mapper.fuse(pyramid, HERE)
                detector.remember(pyramids[0], HERE)
                masks.append(detector.find(pyramids[4], mapper.view(HERE, CAMERA), HERE))
        assert masks[0].any()
        np.testing.assert_array_equal(*masks)

    def test_settings_are_checked(self) -> None:
        with pytest.raises(ConfigError, match="min_share"):
            DynamicsConfig(min_share=1.5)


def reference_regions(
    surface: np.ndarray,
    state: np.ndarray,
    pixel: float,
    step: float,
    sigmas: float,
    cosine: float,
    least: int,
    reach: float,
) -> np.ndarray:
    """Regions one pixel at a time: sets of connected seeds, then growth in rings."""

    def neighbours(at: tuple[int, int], kind: int) -> list[tuple[int, int]]:
        s = surface[at].astype(np.float64)
        near = [(at[0] - 1, at[1]), (at[0], at[1] - 1), (at[0], at[1] + 1), (at[0] + 1, at[1])]
        inside = [(y, x) for y, x in near if 0 <= y < state.shape[0] and 0 <= x < state.shape[1]]
        return [
            n
            for n in inside
            if state[n] == kind
            and abs(surface[n][2] - s[2]) < step * s[2] + sigmas / s[6]
            and s[3:6] @ surface[n][3:6] > cosine
        ]

    regions, taken = [], set()
    for start in zip(*np.nonzero(state == kernels.SEED), strict=True):
        region, todo = [], deque([start] if start not in taken else [])
        taken.add(start)
        while todo:
            at = todo.popleft()
            region.append(at)
            fresh = [n for n in neighbours(at, kernels.SEED) if n not in taken]
            taken.update(fresh)
            todo.extend(fresh)
        regions.append(region)
    distance = {at: 0.0 for region in regions if len(region) >= least for at in region}
    todo = deque(distance)
    while todo:
        at = todo.popleft()
        far = distance[at] + pixel * surface[at][2]
        for n in neighbours(at, kernels.OPEN) if far <= reach else []:
            if n not in distance:
                distance[n] = far
                todo.append(n)
    mask = np.zeros(state.shape, bool)
    mask[tuple(np.array(list(distance)).T) if distance else ([], [])] = True
    return mask


class TestRegions:
    @pytest.mark.parametrize("seed", range(6))
    def test_same_as_one_pixel_at_a_time(self, seed: int) -> None:
        """Patches of two depths and two normals, states at random."""
        rng = np.random.default_rng(seed)
        shape = (24, 31)
        surface = np.zeros((*shape, 8), np.float32)
        coarse = rng.integers(0, 2, (2, 6, 8)).repeat(4, axis=1).repeat(4, axis=2)[:, : shape[0], : shape[1]]
        surface[..., 2] = 1.5 + 0.5 * coarse[0] + rng.normal(0, 0.004, shape)
        surface[..., 3], surface[..., 5] = 0.9 * coarse[1], -np.sqrt(1 - (0.9 * coarse[1]) ** 2)
        surface[..., 6] = 1 / 0.003
        state = rng.choice(np.array([0, 1, 2], np.uint8), shape, p=[0.1, 0.45, 0.45])
        settings = (0.01, 0.005, 2.0, 0.7, 6, 0.045)
        expected = reference_regions(surface, state, *settings)
        pixel, step, sigmas, cosine, least, reach = settings
        moving, queue, distance = np.zeros(shape, np.bool_), np.empty(state.size, np.int32), np.empty(shape, np.float32)
        marked = kernels.grow_regions(
            surface, state.copy(), np.float32(pixel), np.float32(step), np.float32(sigmas), np.float32(cosine),
            least, np.float32(reach), queue, distance, moving,
        )  # fmt: skip
        np.testing.assert_array_equal(moving, expected)
        assert marked == expected.sum()
        assert 0.1 < expected.mean() < 0.95


class TestFusion:
    def test_what_moves_adds_nothing_and_takes_confidence(self) -> None:
        """Five looks at a box, a sixth when it is known to move: its surfels are left with one look's weight, did not
        move and are not younger; the wall's gain."""
        mapper = mapped(*[with_box()] * 5)
        on_box = mapper.map.positions_m[2] < 1.5
        before = mapper.map.confidences.copy()
        moving = np.zeros(CAMERA.shape, bool)
        moving[BOX] = True
        count = len(mapper.map)
        counts = mapper.fuse(sw.build_pyramid(frame_of(with_box(1.201))), HERE, moving=moving)
        assert counts.appended == 0
        after = mapper.map.confidences[:count]
        np.testing.assert_array_equal(after[on_box], np.minimum(before[on_box], 1.0))
        assert before[on_box].min() > 3
        assert (after[~on_box] >= before[~on_box]).all()
        assert after[~on_box].mean() > before[~on_box].mean() + 0.5
        np.testing.assert_allclose(mapper.map.positions_m[2][on_box], 1.2, atol=1e-4)
        assert (mapper.map.last_seen[on_box] == 4).all()

    def test_what_moves_is_not_appended(self) -> None:
        mapper, moving = mapped(*[wall()] * 3), np.zeros(CAMERA.shape, bool)
        moving[BOX] = True
        assert mapper.fuse(sw.build_pyramid(frame_of(with_box())), HERE, moving=moving).appended == 0
        assert mapper.fuse(sw.build_pyramid(frame_of(with_box())), HERE).appended > 1000

    def test_surfels_in_front_of_what_moves_are_seen_through(self) -> None:
        mapper, moving = mapped(*[with_box(0.8)] * 2), np.ones(CAMERA.shape, bool)
        before = mapper.map.confidences.copy()
        mapper.fuse(sw.build_pyramid(frame_of(with_box(1.2))), HERE, moving=moving)
        near = mapper.map.positions_m[2] < 1.0
        assert (mapper.map.confidences[near] < before[near]).mean() > 0.8

    def test_an_empty_mask_changes_nothing(self) -> None:
        depths = [wall(), with_box(), wall(1.9)]
        plain, masked = sw.SurfelMapper(), sw.SurfelMapper()
        for depth in depths:
            plain.fuse(sw.build_pyramid(frame_of(depth)), HERE)
            masked.fuse(sw.build_pyramid(frame_of(depth)), HERE, moving=np.zeros(CAMERA.shape, bool))
        for name in ("positions_m", "normals", "confidences", "created", "last_seen"):
            np.testing.assert_array_equal(getattr(plain.map, name), getattr(masked.map, name))


class TestLeavingOut:
    def test_no_level_has_surfaces_there_and_the_frame_is_as_it_was(self) -> None:
        pyramid = sw.build_pyramid(frame_of(with_box()))
        before = [level.surface.copy() for level in pyramid.levels]
        mask = np.zeros(CAMERA.shape, bool)
        mask[41:80, 61:100] = True
        rest = leave_out(pyramid, mask)
        for k, (old, new, level) in enumerate(zip(before, rest.levels, pyramid.levels, strict=True)):
            rows, columns = slice(40 >> k, 80 >> k), slice(60 >> k, 100 >> k)  # any of four pixels counts
            inside = np.zeros(level.camera.shape, bool)
            inside[(slice(41, 80), slice(61, 100)) if k == 0 else (rows, columns)] = True
            assert (new.surface[inside][:, 3:] == 0).all()
            assert (new.depth_m[inside] == 0).all()
            np.testing.assert_array_equal(new.surface[~inside], old[~inside])
            np.testing.assert_array_equal(level.surface, old)

    def test_widened_by_a_share_of_the_width(self) -> None:
        """2.5 % of 160 pixels are 4: one pixel becomes 9 x 9, cut off at the image's edge."""
        mask = np.zeros((120, 160), bool)
        mask[50, 70] = mask[0, 159] = True
        expected = np.zeros_like(mask)
        expected[46:55, 66:75] = expected[:5, 155:] = True
        np.testing.assert_array_equal(widened(mask), expected)

    def test_user_mask_is_depth_that_is_missing(self) -> None:
        frame, mask = frame_of(with_box()), np.zeros(CAMERA.shape, bool)
        mask[BOX] = True
        left = frame.without(mask)
        assert (left.depth_m[BOX] == 0).all()
        np.testing.assert_array_equal(left.depth_m[~mask], frame.depth_m[~mask])
        assert (frame.depth_m > 0).all()
        assert len(mapped(left.depth_m).map) < len(mapped(wall()).map) - 1200
        for wrong in (mask[:-1], mask.astype(np.uint8)):
            with pytest.raises(InvalidInputError, match="bool mask of the depth's shape"):
                frame.without(wrong)


class TestTrackStatic:
    """A tracker that notes what it is given, before a wall."""

    @staticmethod
    def run(
        now: np.ndarray, statuses: list[Status], moved: np.ndarray | None = None
    ) -> tuple[RegistrationResult, np.ndarray | None, list[float]]:
        detector = MotionDetector()
        detector.remember(sw.build_pyramid(frame_of(wall())), HERE)
        shares: list[float] = []

        def track(pyramid: sw.SurfacePyramid, view: ModelView, T: np.ndarray) -> RegistrationResult:
            np.testing.assert_array_equal(T, HERE)
            shares.append(float((pyramid.levels[0].surface[..., 6] > 0)[45:75, 65:95].mean()))
            status = statuses[len(shares) - 1]
            return RegistrationResult(T_target_source=T, status=status, information=np.eye(6), note=str(len(shares)))

        view = mapped(*[wall()] * 5).view(HERE, CAMERA)
        return *track_static(track, detector, sw.build_pyramid(frame_of(now)), view, HERE, moved), shares

    def test_once_where_nothing_moves(self) -> None:
        result, moving, shares = self.run(wall(), [Status.CONVERGED])
        assert (result.note, moving, shares) == ("1", None, [1.0])

    def test_again_without_what_moves(self) -> None:
        result, moving, shares = self.run(with_box(), [Status.CONVERGED, Status.CONVERGED])
        assert (result.note, shares) == ("2", [1.0, 0.0])
        assert moving[60, 80]

    def test_once_where_the_same_moved_before(self) -> None:
        before = np.zeros(CAMERA.shape, bool)
        before[BOX] = True
        result, moving, shares = self.run(with_box(), [Status.CONVERGED], before)
        assert (result.note, shares) == ("1", [0.0])
        assert moving[60, 80]

    @pytest.mark.parametrize(
        ("statuses", "chosen"),
        [
            ([Status.CONVERGED, Status.NO_OVERLAP], "1"),
            ([Status.CONVERGED, Status.DEGENERATE], "2"),
            ([Status.NO_OVERLAP, Status.CONVERGED], "2"),
            ([Status.NO_OVERLAP, Status.DEGENERATE], "1"),
        ],
    )
    def test_the_better_answer_counts(self, statuses: list[Status], chosen: str) -> None:
        result, moving, _ = self.run(with_box(), statuses)
        assert result.note == chosen
        assert (moving is not None) is result.status.has_pose

    def test_a_pose_that_slides_starts_no_motion_but_ends_none(self) -> None:
        result, moving, shares = self.run(with_box(), [Status.DEGENERATE])
        assert (result.note, moving, shares) == ("1", None, [1.0])
        before = np.zeros(CAMERA.shape, bool)
        before[BOX] = True
        assert self.run(with_box(), [Status.DEGENERATE], before)[1][60, 80]


OBJECT_COLOR = (250, 0, 250)
CROSSING = range(12, 42)


def object_depth(T_world_camera: np.ndarray, T_world_object: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    """Depth of a box (H, W), inf beside it: the ray enters the last of three slabs before it leaves the first."""
    T = se3.inverse(T_world_object) @ T_world_camera
    rays, origin = CAMERA.rays() @ T[:3, :3].T, T[:3, 3]
    near, far = (-half_m - origin) / rays, (half_m - origin) / rays
    enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


@lru_cache(maxsize=2)
def crossing(present: bool = True) -> tuple[list[sw.Frame], list[np.ndarray], np.ndarray]:
    """The room with Kinect noise, and a box of a person's size that walks through the view 1.3 m ahead, at 1.8 m/s.

    Returns the frames, the pixels of the box, and the true poses in the first camera's frame.
    """
    sequence = sw.SyntheticSequence(sw.RenderConfig(frames=64, width=CAMERA.width, height=CAMERA.height))
    poses = sequence.ground_truth.T_world_camera
    frames, owned = [], []
    for k in range(64):
        color, depth = sequence.exact(k)
        mask = np.zeros(depth.shape, bool)
        if present and k in CROSSING:
            T_world_object = poses[27] @ se3.exp([1.8 * (k - 26.5) / 30, 0.0, 1.3, 0, 0, 0])
            near = object_depth(poses[k], T_world_object, np.array([0.22, 0.85, 0.12]))
            mask = near < np.where(depth > 0, depth, np.inf)
            depth, color = np.where(mask, near, depth).astype(np.float32), color.copy()
            color[mask] = OBJECT_COLOR
        depth = degrade_depth(depth, CAMERA, NOISE_MODELS["kinect"], np.random.default_rng([0, k]))
        frames.append(sw.Frame(k / 30, depth.astype(np.float32), color, CAMERA))
        owned.append(mask)
    return frames, owned, se3.inverse(poses[0]) @ poses


def slam_in_hand(frames: list[sw.Frame]) -> tuple[np.ndarray, sw.SurfelMap, list[np.ndarray | None]]:
    """Track and fuse, nothing else: (N, 4, 4) poses, the map, and what moved in each frame."""
    mapper, tracker, detector = sw.SurfelMapper(), sw.FrameToModelTracker(), MotionDetector()
    motion, moving = ConstantVelocity(), None
    poses: list[np.ndarray] = []
    masks: list[np.ndarray | None] = []
    for k, frame in enumerate(frames):
        pyramid, T = sw.build_pyramid(frame), motion.predict(frame.timestamp_s)
        view = mapper.view(T, CAMERA)
        if k > 0:
            result, moving = track_static(tracker.track, detector, pyramid, view, T, moving)
            assert result.status.has_pose
            T = result.T_target_source
        mapper.fuse(pyramid, T, moving=moving)
        detector.remember(pyramid, T)
        motion.observe(frame.timestamp_s, T)
        poses.append(T)
        masks.append(moving)
    return np.array(poses), mapper.map, masks


def rms_error_m(poses: np.ndarray, true: np.ndarray) -> float:
    return float(np.sqrt((np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1) ** 2).mean()))


def test_an_object_crosses_the_view() -> None:
    """A third of the view is hidden at most; the path is as good as without it, and no stable surfel of it is left."""
    frames, owned, true = crossing()
    assert 0.25 < max(mask.mean() for mask in owned) < 0.6
    poses, surfels, masks = slam_in_hand(frames)
    alone, _, _ = slam_in_hand(crossing(present=False)[0])
    assert rms_error_m(poses, true) < 1.2 * rms_error_m(alone, true)
    for k in range(16, 38):
        surface = sw.build_pyramid(frames[k]).levels[0].surface[..., 6] > 0
        assert masks[k][owned[k] & surface].mean() > 0.9
        assert masks[k][~owned[k] & surface].mean() < 0.02
    assert all(masks[k] is None for k in range(64) if k not in CROSSING)
    assert (of_object(surfels) & (surfels.confidences >= 3)).sum() <= 0.01 * max(mask.sum() for mask in owned)


def test_without_looking_out_the_object_is_mapped() -> None:
    """The same frames at their true poses, without the search: the test above can fail."""
    frames, owned, true = crossing()
    mapper = sw.SurfelMapper()
    for frame, T in zip(frames[:30], true, strict=False):
        mapper.fuse(sw.build_pyramid(frame), T)
    assert of_object(mapper.map).sum() > 0.5 * max(mask.sum() for mask in owned)


def of_object(surfels: sw.SurfelMap) -> np.ndarray:
    """Surfels (N,) of the object's colour, noise apart."""
    return np.abs(surfels.colors.astype(int) - np.array(OBJECT_COLOR)[:, None]).max(axis=0) < 60
