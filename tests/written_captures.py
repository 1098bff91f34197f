"""Recordings of cameras and phones that the tests write to the formats' specifications: 16x12 depth, 32x24 colour."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from scanweld.geometry import se3
from written_sequences import HEIGHT, WIDTH, color_rgb, depth_units, poses, write_frame, write_image, write_tum

COLOR_SIZE = (2 * WIDTH, 2 * HEIGHT)
COLOR_K = (26.0, 27.0, 15.5, 11.5)  # of the 32x24 colour
DEPTH_K = (13.0, 13.5, 7.5, 5.5)  # the same field of view: cx' = (15.5 + 0.5) / 2 - 0.5
FROM_ARKIT = np.diag([1.0, -1, -1, 1])


def large_color(index: int) -> np.ndarray:
    """Colour (24, 32, 3) of frame `index`: that of the small one everywhere."""
    return np.full((COLOR_SIZE[1], COLOR_SIZE[0], 3), color_rgb(index)[0, 0], dtype=np.uint8)


def encoded(image: np.ndarray, suffix: str) -> bytes:
    """PNG or JPEG of an image given as RGB, or of a plane."""
    stored = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    ok, data = cv2.imencode(suffix, stored)
    assert ok
    return bytes(data.tobytes())


def matrix4(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Intrinsics as a 4x4 matrix."""
    return np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64)


# --- .sens ------------------------------------------------------------------------------------------


def sens_bytes(
    count: int = 4,
    *,
    lost: Sequence[int] = (),
    color_compression: int = 1,
    depth_compression: int = 1,
    with_times: bool = True,
    extrinsics: np.ndarray | None = None,
    version: int = 4,
    num_frames: int | None = None,
    depth_size: tuple[int, int] = (WIDTH, HEIGHT),
    with_color: bool = True,
) -> bytes:
    """A .sens file, field by field as its specification lists them."""
    data = struct.pack("<I", version) + struct.pack("<Q", 5) + b"Kinec"
    for matrix in (matrix4(*COLOR_K), np.eye(4), matrix4(*DEPTH_K), np.eye(4) if extrinsics is None else extrinsics):
        data += matrix.astype("<f4").tobytes()
    data += struct.pack("<ii", color_compression, depth_compression)
    data += struct.pack("<IIII", *COLOR_SIZE, *depth_size)
    data += struct.pack("<f", 1000.0)
    data += struct.pack("<Q", count if num_frames is None else num_frames)
    for index in range(count):
        pose = np.full((4, 4), -np.inf) if index in lost else poses(count)[index]
        raw = large_color(index)
        color = raw.tobytes() if color_compression == 0 else encoded(raw, {1: ".png", 2: ".jpg"}[color_compression])
        color = color if with_color else b""
        depth = depth_units(index, 1000).astype("<u2").tobytes()
        if depth_compression == 1:
            depth = zlib.compress(depth)
        time_us = 33000 * index + 1_000_000 if with_times else 0
        data += pose.astype("<f4").tobytes() + struct.pack("<QQ", time_us + 7, time_us)
        data += struct.pack("<QQ", len(color), len(depth)) + color + depth
    return data + struct.pack("<Q", 0)


def write_sens(path: Path, count: int = 4, **options: object) -> Path:
    """Write a .sens file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(sens_bytes(count, **options))  # type: ignore[arg-type]
    return path


# --- folders of images ------------------------------------------------------------------------------


def write_replica(scene: Path, count: int = 4, *, parameters: Path | None = None) -> Path:
    """NICE-SLAM's layout of Replica; cam_params.json one folder up, or where `parameters` says."""
    for i in range(count):
        write_frame(scene / f"results/depth{i:06d}.png", scene / f"results/frame{i:06d}.jpg", i, 6553.5)
    (scene / "traj.txt").write_text("\n".join(" ".join(map(repr, T.ravel().tolist())) for T in poses(count)) + "\n")
    fx, fy, cx, cy = DEPTH_K
    camera = {"w": WIDTH, "h": HEIGHT, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "scale": 6553.5}
    ((parameters or scene.parent) / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return scene


def write_eth3d(folder: Path, count: int = 4) -> Path:
    """ETH3D SLAM: TUM's files with calibration.txt; colour and depth have the same times."""
    write_tum(folder, count, color_delay_s=0.0)
    (folder / "calibration.txt").write_text(" ".join(map(str, DEPTH_K)) + "\n")
    return folder


def write_bundle_fusion(folder: Path, numbers: Sequence[int] = (0, 1, 2, 3), *, lost: Sequence[int] = ()) -> Path:
    """BundleFusion's folder, colour twice as large as depth."""
    for n in numbers:
        stem = folder / f"frame-{n:06d}"
        write_image(Path(f"{stem}.depth.png"), depth_units(n, 1000))
        write_image(Path(f"{stem}.color.png"), large_color(n))
        np.savetxt(f"{stem}.pose.txt", np.full((4, 4), -np.inf) if n in lost else poses(max(numbers) + 1)[n])
    rows = {kind: " ".join(map(str, matrix4(*K).ravel())) for kind, K in (("Color", COLOR_K), ("Depth", DEPTH_K))}
    (folder / "info.txt").write_text(
        "m_versionNumber = 4\nm_sensorName = Structure Sensor\n"
        f"m_colorWidth = {COLOR_SIZE[0]}\nm_colorHeight = {COLOR_SIZE[1]}\n"
        f"m_depthWidth = {WIDTH}\nm_depthHeight = {HEIGHT}\nm_depthShift = 1000\n"
        f"m_calibrationColorIntrinsic = {rows['Color']} \n"
        "m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1 \n"
        f"m_calibrationDepthIntrinsic = {rows['Depth']} \n"
        "m_calibrationDepthExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1 \n"
        f"m_frames.size = {len(numbers)}\n"
    )
    return folder


# --- phones -----------------------------------------------------------------------------------------


def confidence(index: int) -> np.ndarray:
    """Confidence (12, 16) uint8: one pixel of frame `index` is low, the rest medium and high."""
    plane = np.full((HEIGHT, WIDTH), 2, np.uint8)
    plane[1] = 1
    plane[2, index] = 0
    return plane


def depth_metres(index: int) -> np.ndarray:
    """Depth (12, 16) float32 [m] with one NaN."""
    depth = (depth_units(index, 1000) / 1000).astype("<f4")
    depth[0, 0] = np.nan
    return depth


def record3d_metadata(count: int = 4, **changes: object) -> dict[str, object]:
    """The metadata of a recording, with some values changed."""
    T = poses(count) @ FROM_ARKIT
    fx, fy, cx, cy = COLOR_K
    quaternions = se3.quaternion_xyzw_from_rotation(T[:, :3, :3])
    return {
        "w": COLOR_SIZE[0], "h": COLOR_SIZE[1], "dw": WIDTH, "dh": HEIGHT, "fps": 60,
        "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],
        "poses": np.column_stack([quaternions, T[:, :3, 3]]).tolist(),
        "frameTimestamps": [5.5 + 0.02 * i for i in range(count)],
        "perFrameIntrinsicCoeffs": [[fx, fy, cx, cy]] * count,
        "initPose": [0, 0, 0, 1, 0, 0, 0],
    } | changes  # fmt: skip


def record3d_files(count: int = 4, *, compress: bool = True, **changes: object) -> dict[str, bytes]:
    """The files of a recording, by name; without `compress` the planes are stored as they are."""
    if compress:
        import liblzfse

        pack = liblzfse.compress
    else:
        pack = bytes
    files = {"metadata": json.dumps(record3d_metadata(count, **changes)).encode()}
    for i in range(count):
        files[f"rgbd/{i}.jpg"] = encoded(large_color(i), ".jpg")
        files[f"rgbd/{i}.depth"] = pack(depth_metres(i).tobytes())
        files[f"rgbd/{i}.conf"] = pack(confidence(i).tobytes())
    return files


def write_record3d(path: Path, files: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    """Write an .r3d archive."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def write_video(path: Path, frames: Sequence[np.ndarray], codec: str, rate_hz: float = 30.0) -> Path:
    """Write colour frames given as RGB, or planes of 16 bits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = frames[0].shape[:2]
    options = [cv2.VIDEOWRITER_PROP_IS_COLOR, int(frames[0].ndim == 3)]
    if frames[0].dtype == np.uint16:
        options += [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U]
    fourcc = cv2.VideoWriter_fourcc(*codec)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, rate_hz, (width, height), options)
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame if frame.ndim == 2 else np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    return path


def write_stray(folder: Path, count: int = 4) -> Path:
    """Stray Scanner's export; the colour video is lossless."""
    write_video(folder / "rgb.avi", [large_color(i) for i in range(count)], "FFV1")
    (folder / "rgb.avi").rename(folder / "rgb.mp4")  # FFmpeg looks at the content
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    T = poses(count)
    quaternions = se3.quaternion_xyzw_from_rotation(T[:, :3, :3])
    for i in range(count):
        write_image(folder / f"depth/{i:06d}.png", depth_units(i, 1000))
        write_image(folder / f"confidence/{i:06d}.png", confidence(i))
        values = [*T[i, :3, 3], *quaternions[i]]
        rows.append(f"{100 + i / 60:.6f}, {i:06d}, " + ", ".join(repr(float(v)) for v in values))
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    fx, fy, cx, cy = COLOR_K
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0\n")
    return folder


def write_video_pair(folder: Path, count: int = 6, *, depth: str = "depth.mkv", **description: object) -> Path:
    """An RGB-D video; depth as a video, or as images where `depth` is a folder."""
    write_video(folder / "color.mkv", [large_color(i) for i in range(count)], "FFV1", 25.0)
    if Path(depth).suffix:
        write_video(folder / depth, [depth_units(i, 1000) for i in range(count)], "FFV1", 25.0)
    else:
        for i in range(count):
            write_image(folder / depth / f"{i:05d}.png", depth_units(i, 1000))
    fx, fy, cx, cy = DEPTH_K
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": WIDTH, "height": HEIGHT}
    (folder / "camera.json").write_text(json.dumps(values | description))
    return folder


# --- ROS --------------------------------------------------------------------------------------------


class BagWriter:
    """Write ROS 1 and ROS 2 bags with the serialisers of rosbags, which the reader does not use."""

    def __init__(self, path: Path, version: int, storage: str = "sqlite3") -> None:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore

        path.parent.mkdir(parents=True, exist_ok=True)
        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        if version == 1:
            self.writer = rosbag1.Writer(path)
        else:
            plugins = {plugin.name.lower(): plugin for plugin in rosbag2.StoragePlugin}
            self.writer = rosbag2.Writer(path, version=9, storage_plugin=plugins[storage])
        self.connections: dict[str, object] = {}

    def __enter__(self) -> BagWriter:
        self.writer.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.writer.close()

    def add(self, topic: str, name: str, time_s: float, recorded_s: float | None = None, **fields: object) -> None:
        """Write a message of `sensor_msgs/msg/<name>`."""
        types, msgtype = self.store.types, f"sensor_msgs/msg/{name}"
        seconds = int(time_s)
        stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=round((time_s - seconds) * 1e9))
        counter = {"seq": 3} if self.version == 1 else {}
        frame_id = fields.pop("frame_id", "camera")
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id, **counter)
        message = types[msgtype](header=header, **fields)
        serialize = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        data = bytes(serialize(message, msgtype))
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, msgtype, typestore=self.store)
        recorded = time_s + 0.25 if recorded_s is None else recorded_s
        self.writer.write(self.connections[topic], round(recorded * 1e9), data)

    def image(self, topic: str, time_s: float, encoding: str, pixels: np.ndarray, **more: object) -> None:
        """Write an Image; rows are padded by two bytes, which a reader must pass over."""
        rows = np.ascontiguousarray(pixels).reshape(pixels.shape[0], -1).view(np.uint8)
        padded = np.pad(rows, ((0, 0), (0, 2)), constant_values=0xEE)
        self.add(
            topic, "Image", time_s, height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
            is_bigendian=int(pixels.dtype.byteorder == ">"), step=padded.shape[1], data=padded.ravel(), **more,
        )  # fmt: skip

    def compressed(self, topic: str, time_s: float, format: str, data: bytes, **more: object) -> None:
        """Write a CompressedImage."""
        self.add(topic, "CompressedImage", time_s, format=format, data=np.frombuffer(data, np.uint8), **more)

    def info(
        self, topic: str, time_s: float, size: tuple[int, int], K: tuple[float, float, float, float],
        distortion: Sequence[float] = (), **more: object,
    ) -> None:  # fmt: skip
        """Write a CameraInfo; field names are capital in ROS 1."""
        fx, fy, cx, cy = K
        values = {
            "d": np.array(distortion, np.float64),
            "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], np.float64),
            "r": np.eye(3).ravel(),
            "p": np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], np.float64),
        }
        if self.version == 1:
            values = {name.upper(): value for name, value in values.items()}
        region = self.store.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        self.add(
            topic, "CameraInfo", time_s, width=size[0], height=size[1], distortion_model="plumb_bob", binning_x=0,
            binning_y=0, roi=region, **values, **more,
        )  # fmt: skip


def write_bag(path: Path, version: int = 1, count: int = 4, storage: str = "sqlite3") -> Path:
    """A bag of a usual camera: depth in mm, colour of the same size 5 ms later, CameraInfo of both, and a twin."""
    with BagWriter(path, version, storage) as bag:
        for i in range(count):
            time = 1000 + i / 30
            bag.info("/camera/depth/camera_info", time, (WIDTH, HEIGHT), DEPTH_K)
            bag.image("/camera/depth/image_raw", time, "16UC1", depth_units(i, 1000))
            bag.image("/camera/color/image_raw", time + 0.005, "rgb8", color_rgb(i))
            bag.compressed("/camera/color/image_raw/compressed", time + 0.005, "rgb8; jpeg compressed bgr8",
                           encoded(color_rgb(i), ".jpg"))  # fmt: skip
    return path
