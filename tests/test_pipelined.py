"""Fusion beside tracking: the same answers at any timing, and nothing lost."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

import scanweld as sw
from rendered import CAMERA, rendered
from scanweld.mapping.fusion import FusionConfig
from scanweld.mapping.mapper import SurfelMapper
from scanweld.mapping.pipelined import PipelinedMapper
from scanweld.parallel import get_num_threads


class SlowMapper(SurfelMapper):
    """Waits until it may fuse."""

    def __init__(self) -> None:
        super().__init__(FusionConfig(stable_confidence=0.0))
        self.may_fuse = threading.Event()
        self.may_fuse.set()

    def fuse(self, *arguments: object, **options: object) -> object:
        assert self.may_fuse.wait(10)
        return super().fuse(*arguments, **options)


class BrokenMapper(SurfelMapper):
    def fuse(self, *arguments: object, **options: object) -> object:
        raise MemoryError("no room for more surfels")


@pytest.fixture
def two_threads():
    usual = get_num_threads()
    sw.set_num_threads(2)
    yield
    sw.set_num_threads(usual)


def frames(count: int) -> list[tuple[sw.SurfacePyramid, np.ndarray]]:
    sequence = rendered(count=40)
    poses = sequence.ground_truth.T_world_camera
    return [(sw.build_pyramid(sequence.frames[k]), poses[k]) for k in range(count)]


def content(surfels: sw.SurfelMap) -> bytes:
    return surfels.positions_m.tobytes() + surfels.confidences.tobytes()


@pytest.mark.usefixtures("two_threads")
class TestPipelined:
    def test_map_is_that_of_one_frame_after_the_other(self) -> None:
        plain, pipelined = SurfelMapper(), PipelinedMapper(SurfelMapper())
        for pyramid, T in frames(4):
            plain.fuse(pyramid, T)
            pipelined.fuse(pyramid, T)
        assert content(pipelined.map) == content(plain.map)

    def test_view_does_not_wait_for_fusion_close_by(self) -> None:
        slow = SlowMapper()
        mapper, three = PipelinedMapper(slow), frames(3)
        mapper.fuse(*three[0])
        first = mapper.view(three[1][1], CAMERA)  # of one frame: this one is waited for
        assert len(first) > 0
        mapper.fuse(*three[1])
        expected = slow.last_seen if mapper.settled is slow else None
        slow.may_fuse.clear()
        mapper.fuse(*three[2])
        seen = mapper.view(three[2][1], CAMERA)
        slow.may_fuse.set()
        assert seen is expected

    def test_a_look_waits_for_fusion_and_nobody_for_the_look(self) -> None:
        """It sees the frame that was being fused, not the next one, and what moves the map waits for it."""
        slow = SlowMapper()
        mapper, two, order = PipelinedMapper(slow), frames(2), []
        slow.may_fuse.clear()
        mapper.fuse(*two[0])
        mapper.look(lambda surfels: order.append(len(surfels)))
        assert order == []
        slow.may_fuse.set()
        after_one = len(mapper.map)
        assert order == [after_one] != [0]
        mapper.fuse(*two[1])
        mapper.look(lambda surfels: order.append(len(surfels)))
        mapper.apply(sw.MapCorrection(np.array([0], np.int32), np.eye(4)[None]))
        assert len(order) == 2

    def test_what_fusion_raises_is_raised_after_a_look(self) -> None:
        mapper, looked = PipelinedMapper(BrokenMapper()), []
        mapper.fuse(*frames(1)[0])
        mapper.look(looked.append)
        with pytest.raises(MemoryError, match="no room"):
            _ = mapper.map
        assert looked == []

    def test_view_of_a_young_map_is_waited_for(self) -> None:
        """Most of it is unstable, and changes much with each frame."""
        mapper, plain = PipelinedMapper(SurfelMapper()), SurfelMapper()
        for pyramid, T in frames(2):
            mapper.fuse(pyramid, T)
            plain.fuse(pyramid, T)
            assert mapper.view(T, CAMERA).confidences.tobytes() == plain.view(T, CAMERA).confidences.tobytes()

    def test_view_is_the_same_whether_fusion_has_ended_or_not(self) -> None:
        views = []
        for waits in (False, True):
            mapper = PipelinedMapper(SurfelMapper())
            for pyramid, T in frames(4):
                mapper.fuse(pyramid, T)
                if waits:
                    assert len(mapper.map) > 0
                views.append(mapper.view(T, CAMERA).positions_m.tobytes())
        assert views[:4] == views[4:]

    def test_what_fusion_raises_reaches_whoever_asks_for_the_map(self) -> None:
        mapper = PipelinedMapper(BrokenMapper())
        mapper.fuse(*frames(1)[0])
        with pytest.raises(MemoryError, match="no room"):
            len(mapper.map)

    def test_buffers_of_a_camera_may_be_filled_again(self) -> None:
        slow, (pyramid, T) = SlowMapper(), frames(1)[0]
        mapper = PipelinedMapper(slow)
        buffer = np.full((*CAMERA.shape, 3), 200, np.uint8)
        slow.may_fuse.clear()
        mapper.fuse(replace(pyramid, frame=replace(pyramid.frame, color=buffer)), T)
        buffer[:] = 0
        slow.may_fuse.set()
        assert (mapper.map.colors == 200).all()

    def test_several_may_wait_for_the_map(self) -> None:
        slow = SlowMapper()
        mapper, sizes = PipelinedMapper(slow), []
        slow.may_fuse.clear()
        mapper.fuse(*frames(1)[0])
        waiting = [threading.Thread(target=lambda: sizes.append(len(mapper.map))) for _ in range(4)]
        for thread in waiting:
            thread.start()
        slow.may_fuse.set()
        for thread in waiting:
            thread.join(30)
        assert len(sizes) == 4
        assert min(sizes) == max(sizes) > 0


def test_same_bytes_at_any_number_of_threads() -> None:
    usual, answers = get_num_threads(), set()
    sequence = rendered(noise="kinect", count=40)
    try:
        for threads in (1, 2, 4):
            sw.set_num_threads(threads)
            slam = sw.build_slam(CAMERA)
            for frame in sequence.frames[:8]:
                slam.process(frame)
            counts = [result.num_surfels for result in slam.results]
            assert counts[-1] == len(slam.map)
            assert counts[0] > 0
            answers.add(content(slam.map) + slam.trajectory.T_world_camera.tobytes() + bytes(str(counts), "ascii"))
    finally:
        sw.set_num_threads(usual)
    assert len(answers) == 1
