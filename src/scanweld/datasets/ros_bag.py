"""ROS 1 and ROS 2 bags, by topic, through rosbags (extra `ros`).

    recording.bag                          ROS 1
    recording/metadata.yaml, *.db3, *.mcap ROS 2; also a single .db3 or .mcap file

    depth   sensor_msgs/Image: 16UC1 or mono16 (1000 = 1 m), 32FC1 (m); CompressedImage: compressedDepth as PNG
    colour  sensor_msgs/Image: rgb8, bgr8, rgba8, bgra8, mono8, Bayer, YUV 4:2:2; CompressedImage: JPEG or PNG
    camera  sensor_msgs/CameraInfo beside the depth, else beside the colour

Topics are found where there is no choice: one of depth; one of colour, grey only where there is none. Depth that is
named as registered to colour (aligned_depth, depth_registered) goes before other depth, an image before its compressed
twin. Otherwise the error lists the topics, and they are named: ``open_sequence(..., topics="depth=/a,color=/b")``; also
``camera_info=/c``, and ``color=`` for no colour.

The time of a frame is that in the header of its depth message; where it does not increase, the time of recording.
Colour and depth are paired as in TUM's format, nearest first, at most 0.02 s apart. Intrinsics are K of the CameraInfo,
P where the topic's name says that the image is rectified; distortion is not corrected, with a warning. Colour of
another size or camera is resampled by the two intrinsics, as if both cameras stood at one place: record depth that is
registered to colour where they do not. Poses are not read.

Opening reads the messages of the two topics once, for their times; only these are kept. The content of messages is
parsed here: no code is made of the definitions in a bag.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanweld.arrays import Float32, Float64, UInt8
from scanweld.datasets.color_registration import ColorToDepth
from scanweld.datasets.intrinsics import Intrinsics, Overrides, make_camera, read_camera_file
from scanweld.datasets.layout import settle_camera, settle_depth_scale
from scanweld.datasets.recorded import RecordedSequence, require_a_readable_frame
from scanweld.datasets.ros_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    GREY,
    IMAGE,
    RosCameraInfo,
    RosImage,
    decode_color_message,
    decode_depth_message,
    parse_camera_info,
    parse_image,
    read_stamp,
)
from scanweld.errors import DatasetError, InvalidInputError, MissingDependencyError, UnreadableFrameError
from scanweld.geometry.camera import PinholeCamera
from scanweld.io.timestamps import MAX_TIME_DIFFERENCE_S, associate_times

logger = logging.getLogger(__name__)

SUFFIXES = (".bag", ".mcap", ".db3")
ROLES = ("depth", "color", "camera_info")
_METADATA = "metadata.yaml"
_REGISTERED = ("aligned_depth", "depth_registered", "depth_to_color")
_TRANSPORTS = ("compressed", "compressedDepth")


def bag_path(path: Path) -> Path | None:
    """Return the bag that `path` is, a file or a folder of ROS 2, or the only one in the folder."""
    if path.is_file():
        return path if path.suffix.lower() in SUFFIXES else None
    metadata = path / _METADATA
    if metadata.is_file():
        with metadata.open("rb") as stream:
            return path if b"rosbag2_bagfile_information" in stream.read(4096) else None
    found = [file for file in path.iterdir() if file.is_file() and file.suffix.lower() in SUFFIXES]
    return found[0] if len(found) == 1 else None


def is_ros_bag(path: Path) -> bool:
    """Whether this is a bag, or a folder with one."""
    return bag_path(path) is not None


def parse_topics(text: str) -> dict[str, str]:
    """Turn "depth=/a,color=/b,camera_info=/c" into a dictionary; any of the three may be left out.

    Raises
    ------
    InvalidInputError
        When the text is anything else.
    """
    parts = [part.partition("=") for part in text.split(",") if part.strip()]
    topics = {role.strip(): topic.strip() for role, _, topic in parts}
    if not topics or not set(topics) <= set(ROLES) or not all(equals for _, equals, _ in parts):
        raise InvalidInputError(
            f"topics: expected depth=TOPIC,color=TOPIC,camera_info=TOPIC, some of them, got '{text}'"
        )
    return topics


def open_ros_bag(path: Path, overrides: Overrides) -> RecordedSequence:
    """Open a ROS bag.

    Raises
    ------
    DatasetError
        When it cannot be read, or the topics are missing or ambiguous.
    MissingDependencyError
        When rosbags is not installed: pip install 'scanweld[ros]'.
    """
    place = bag_path(path)
    if place is None:
        raise DatasetError(f"{path}: expected a ROS bag: a .bag, .mcap or .db3 file, or a folder with {_METADATA}")
    bag = _Bag(place)
    topics = _chosen_topics(bag, overrides.topics)
    depth_first = bag.first_image(topics["depth"])
    color_first = bag.first_image(topics["color"]) if "color" in topics else None
    size = depth_first.width, depth_first.height
    infos = {"depth": _info(bag, topics, "depth", size)}
    if color_first is not None:
        infos["color"] = _info(bag, topics, "color", (color_first.width, color_first.height))
    color_is_as_large = color_first is not None and (color_first.width, color_first.height) == size
    known = infos["depth"] or (infos["color"] if color_is_as_large else None)
    given = read_camera_file(path) if path.is_dir() else None
    camera = settle_camera(path if given else place, size, given, overrides, intrinsics=None, intrinsics_file=known)
    scale = settle_depth_scale(path if given else place, depth_first.units_per_metre, given, overrides)
    registration = None
    if color_first is not None:
        registration = _registration(bag, topics, infos, color_first, depth_first, camera)
    times_s, frames = _paired(bag, topics)
    return require_a_readable_frame(
        RecordedSequence(
            name=place.stem if place.is_file() else place.resolve().name,
            camera=camera,
            timestamps_s=times_s,
            frame_source=_BagFrames(bag, topics, frames, camera.shape, scale, registration),
            depth_scale=scale,
        )
    )


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a message is: time of recording [ns], and how many messages of the topic with this time come before."""

    recorded_ns: int
    before: int


class _Bag:
    """Messages of a bag by topic. Threads take turns; the bag is closed with the last reference to it."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader as Reader2
        except ImportError:
            raise MissingDependencyError("rosbags", "ros") from None
        self.path = path
        self.is_cdr = path.is_dir() or path.suffix.lower() != ".bag"
        self._lock = threading.Lock()
        try:
            self._reader: Any = (Reader2 if self.is_cdr else Reader1)(path)
            self._reader.open()
        except Exception as error:  # whatever a parser of damaged bytes runs into
            if hasattr(self, "_reader"):
                _close(self._reader)
            raise DatasetError(f"{path}: cannot be read as a ROS bag: {_one_line(error)}") from None
        weakref.finalize(self, _close, self._reader)
        self.types: dict[str, str] = {}
        for connection in self._reader.connections:
            # A damaged index may name anything, or nothing.
            if isinstance(connection.topic, str) and connection.topic.isprintable():
                self.types[connection.topic] = str(connection.msgtype)

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield time of recording [ns] and content of every message; nothing else may read meanwhile."""
        yield from self._messages(topic, None, None)

    def read(self, topic: str, place: _Place) -> bytes:
        """Return the content of one message; raises UnreadableFrameError."""
        with self._lock:
            try:
                found = self._messages(topic, place.recorded_ns, place.recorded_ns + 1)
                for count, (_, data) in enumerate(found):
                    if count == place.before:
                        return data
            except DatasetError as error:
                raise UnreadableFrameError(str(error)) from None
        raise UnreadableFrameError(f"{self.path}: {topic} has no message at {place.recorded_ns} ns any more")

    def first_image(self, topic: str) -> RosImage:
        """Return the first message of an image topic; raises DatasetError when there is none."""
        for _, data in self.messages(topic):
            return parse_image(data, self.types[topic], is_cdr=self.is_cdr, where=f"{self.path}: {topic}")
        raise DatasetError(f"{self.path}: {topic} has no message")

    def camera_info(self, topic: str) -> RosCameraInfo | None:
        """Return the first message of a CameraInfo topic, or None."""
        for _, data in self.messages(topic):
            return parse_camera_info(data, is_cdr=self.is_cdr, where=f"{self.path}: {topic}")
        return None

    def _messages(self, topic: str, start: int | None, stop: int | None) -> Iterator[tuple[int, bytes]]:
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        found = self._reader.messages(connections, start, stop)
        while True:
            try:
                _, recorded_ns, data = next(found)
            except StopIteration:
                return
            except Exception as error:  # as above
                raise DatasetError(f"{self.path}: {topic} cannot be read: {_one_line(error)}") from None
            yield recorded_ns, bytes(data)


class _BagFrames:
    """Read frame i of a bag."""

    def __init__(
        self,
        bag: _Bag,
        topics: Mapping[str, str],
        frames: list[tuple[_Place, _Place | None]],
        shape: tuple[int, int],
        depth_scale: float,
        registration: ColorToDepth | None,
    ) -> None:
        self._bag, self._topics, self._frames = bag, topics, frames
        self._shape, self._depth_scale, self._registration = shape, depth_scale, registration

    def __call__(self, index: int) -> tuple[Float32, UInt8 | None]:
        depth_place, color_place = self._frames[index]
        image, where = self._image("depth", depth_place, index)
        if not image.is_depth:
            raise UnreadableFrameError(f"{where}: encoding '{image.encoding}' is none of depth")
        depth_m = decode_depth_message(image, self._shape, self._depth_scale, where)
        if color_place is None or self._registration is None:
            return depth_m, None
        image, where = self._image("color", color_place, index)
        if not image.is_color:
            raise UnreadableFrameError(f"{where}: encoding '{image.encoding}' is none of colour")
        color = decode_color_message(image, self._registration.color_shape, where)
        return depth_m, self._registration(color, depth_m)

    def _image(self, role: str, place: _Place, index: int) -> tuple[RosImage, str]:
        topic = self._topics[role]
        where = f"{self._bag.path}, frame {index}: {topic}"
        data = self._bag.read(topic, place)
        return parse_image(data, self._bag.types[topic], is_cdr=self._bag.is_cdr, where=where), where


def _chosen_topics(bag: _Bag, wanted: Mapping[str, str]) -> dict[str, str]:
    """The topics by role; what the caller names goes before what is found."""
    for role, topic in wanted.items():
        types = (CAMERA_INFO,) if role == "camera_info" else (IMAGE, COMPRESSED_IMAGE)
        if topic and bag.types.get(topic) not in types:
            what = f"of type {bag.types[topic]}" if topic in bag.types else "not in the bag"
            raise DatasetError(f"{bag.path}: {role} topic {topic} is {what}; {_listed(bag)}")
    topics = {role: topic for role, topic in wanted.items() if topic}
    if "depth" in topics and "color" in wanted:
        return topics
    depth, color, grey = _candidates(bag)
    if "depth" not in topics:
        topics["depth"] = _only(bag, "depth", depth)
    if "color" not in wanted and (color or grey):
        topics["color"] = _only(bag, "color", color or grey)
    return topics


def _candidates(bag: _Bag) -> tuple[list[str], list[str], list[str]]:
    """Topics that can be depth, colour, and grey."""
    depth: list[str] = []
    color: list[str] = []
    grey: list[str] = []
    for topic, msgtype in bag.types.items():
        if msgtype not in (IMAGE, COMPRESSED_IMAGE):
            continue
        try:
            image = bag.first_image(topic)
        except DatasetError as error:
            logger.info("%s is passed over: %s", topic, error)
            continue
        if image.is_depth and (image.encoding != "mono16" or "depth" in topic.lower()):
            depth.append(topic)
        elif image.is_color:
            (grey if image.encoding in GREY else color).append(topic)
    registered = [topic for topic in depth if any(word in topic for word in _REGISTERED)]
    return registered or depth, color, grey


def _only(bag: _Bag, role: str, candidates: list[str]) -> str:
    single = [topic for topic in candidates if _base(topic) == topic or _base(topic) not in candidates]
    if len(single) == 1:
        return single[0]
    fault = f"several topics can be {role}" if single else f"no topic of {role}"
    raise DatasetError(f"{bag.path}: {fault}; pass topics as 'depth=/a,color=/b'; {_listed(bag)}")


def _listed(bag: _Bag) -> str:
    images = [f"{topic} ({kind.rpartition('/')[2]})" for topic, kind in sorted(bag.types.items())
              if kind in (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO)]  # fmt: skip
    return f"the bag has {', '.join(images)}" if images else f"none of its {len(bag.types)} topics is of a camera"


def _base(topic: str) -> str:
    stem, _, last = topic.rpartition("/")
    return stem if last in _TRANSPORTS else topic


def _info(bag: _Bag, topics: Mapping[str, str], role: str, size: tuple[int, int]) -> Intrinsics | None:
    """Intrinsics of an image topic by the CameraInfo beside it, or the one that was named, if it is of this size."""
    beside = _base(topics[role]).rpartition("/")[0] + "/camera_info"
    topic = topics.get("camera_info", beside) if role == "depth" else beside
    info = bag.camera_info(topic) if bag.types.get(topic) == CAMERA_INFO else None
    if info is None or (info.width, info.height) not in (size, (0, 0)) or not info.K[0] > 0:
        return None
    if "rect" in _base(topics[role]).rpartition("/")[2] and info.P[0] > 0:
        return info.P[0], info.P[5], info.P[2], info.P[6]
    if any(info.distortion):
        logger.warning("%s: %s has distortion, which is not corrected", bag.path, topics[role])
    return info.K[0], info.K[4], info.K[2], info.K[5]


def _registration(
    bag: _Bag,
    topics: Mapping[str, str],
    infos: Mapping[str, Intrinsics | None],
    color: RosImage,
    depth: RosImage,
    camera: PinholeCamera,
) -> ColorToDepth:
    size, info = (color.width, color.height), infos["color"]
    if size == (depth.width, depth.height) and (info is None or infos["depth"] in (None, info)):
        return ColorToDepth(camera, camera)
    if info is None:
        raise DatasetError(
            f"{bag.path}: {topics['color']} is {size[0]}x{size[1]}, {topics['depth']} {depth.width}x{depth.height}, "
            "and there is no camera_info beside the colour; record depth that is registered to colour"
        )
    if color.frame_id != depth.frame_id:
        logger.warning(
            "%s: colour is recorded in frame %s, depth in %s; the distance between the cameras is ignored: "
            "record depth that is registered to colour", bag.path, color.frame_id, depth.frame_id,
        )  # fmt: skip
    return ColorToDepth(make_camera(info, *size, f"{bag.path}: {topics['color']}"), camera)


def _paired(bag: _Bag, topics: Mapping[str, str]) -> tuple[Float64, list[tuple[_Place, _Place | None]]]:
    """Times of the frames, and where their messages are."""
    depth_times, depth = _index(bag, topics["depth"])
    if "color" not in topics:
        logger.warning("%s: no colour images, the map will have no colour", bag.path)
        return depth_times, [(place, None) for place in depth]
    color_times, color = _index(bag, topics["color"])
    pairs = associate_times(depth_times, color_times)
    if not pairs:
        raise DatasetError(
            f"{bag.path}: no message of {topics['depth']} within {MAX_TIME_DIFFERENCE_S} s of one of {topics['color']}"
        )
    dropped = len(depth) + len(color) - 2 * len(pairs)
    if dropped:
        logger.info("%s: %d images without a partner are left out", bag.path, dropped)
    return depth_times[[a for a, _ in pairs]], [(depth[a], color[b]) for a, b in pairs]


def _index(bag: _Bag, topic: str) -> tuple[Float64, list[_Place]]:
    """Times [s], increasing, and places of the messages of a topic."""
    stamps: list[float] = []
    places: list[_Place] = []
    for recorded_ns, data in bag.messages(topic):
        repeats = bool(places) and places[-1].recorded_ns == recorded_ns
        places.append(_Place(recorded_ns, places[-1].before + 1 if repeats else 0))
        stamps.append(read_stamp(data, is_cdr=bag.is_cdr, where=f"{bag.path}: {topic}"))
    times = np.array(stamps)
    if not (np.diff(times) > 0).all():
        logger.warning(
            "%s: the times in the headers of %s do not increase; those of recording are used", bag.path, topic
        )
        times = np.array([place.recorded_ns * 1e-9 for place in places])
        first = np.concatenate([[True], np.diff(times) > 0])
        times, places = times[first], [place for place, is_first in zip(places, first, strict=True) if is_first]
    return times, places


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _close(reader: Any) -> None:
    with contextlib.suppress(Exception):  # one that was never open
        reader.close()
