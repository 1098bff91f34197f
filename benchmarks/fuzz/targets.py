"""Every parser with good inputs to begin with: those that the tests write to the formats' specifications."""

from __future__ import annotations

import functools
import gzip
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
from inputs import Files, collect

import scanweld as sw
from scanweld.config import from_mapping, load_toml, parse_override, to_toml
from scanweld.datasets.gyroscope import read_gyroscope
from scanweld.datasets.lzfse import decompress_lzfse
from scanweld.datasets.open import open_sequence
from scanweld.datasets.ros_messages import IMAGE, parse_camera_info, parse_image, read_stamp
from scanweld.errors import ScanweldError, UnreadableFrameError
from scanweld.geometry.point_cloud import PointCloud
from scanweld.io.point_files import read_points, read_transform, write_points
from scanweld.io.trajectory_files import read_pose, read_trajectory, write_kitti, write_redwood_log, write_tum

TESTS = Path(__file__).resolve().parents[2] / "tests"
sys.path.append(str(TESTS))

import written_captures as captures  # noqa: E402  (found by the path above)
import written_runs as runs  # noqa: E402
import written_sequences as sequences  # noqa: E402

MAX_FRAMES = 8
"""Frames that are decoded of a sequence; damage may make more of them."""


@dataclass(frozen=True, slots=True)
class Target:
    """A parser.

    Attributes
    ----------
    seeds : makes good inputs, in a folder of its own
    read : reads an input that lies in a folder, all of it
    """

    seeds: Callable[[Path], list[Files]]
    read: Callable[[Path], object]


def written(write: Callable[[Path], object]) -> Callable[[Path], list[Files]]:
    """Return the seeds of one writer."""

    def seeds(folder: Path) -> list[Files]:
        write(folder)
        return [collect(folder)]

    return seeds


def in_turn(*writers: Callable[[Path], object]) -> Callable[[Path], list[Files]]:
    """Return the seeds of several writers, each in a folder of its own."""

    def seeds(folder: Path) -> list[Files]:
        found = []
        for number, write in enumerate(writers):
            (folder / str(number)).mkdir(parents=True)
            write(folder / str(number))
            found.append(collect(folder / str(number)))
        return found

    return seeds


def files_of(folder: Path) -> list[Path]:
    """Return the files of an input."""
    return sorted(path for path in folder.rglob("*") if path.is_file())


# --- points -----------------------------------------------------------------------------------------


def cloud(count: int = 12) -> PointCloud:
    """A few points with normals and colours."""
    random = np.random.default_rng(0)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(
        random.normal(size=(count, 3)), normals=normals, colors=random.integers(0, 256, (count, 3)).astype(np.uint8)
    )


def ply_text(folder: Path) -> None:
    """An ASCII PLY with faces, and one whose vertices have lists."""
    (folder / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\n"
        "property float x\nproperty double y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty list uchar int around\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 1 255 0 9 2 1 2\n1 0 1 0 255 9 0\n0 1 1 0 0 9 1 7\n3 0 1 2\n"
    )


def ply_big_endian(folder: Path) -> None:
    """A big-endian PLY with a list before the vertices."""
    header = (
        "ply\nformat binary_big_endian 1.0\nelement face 2\nproperty list uchar ushort vertex_indices\n"
        "element vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nend_header\n"
    )
    rows = np.zeros(3, [("xyz", ">f4", 3), ("red", "u1")])
    (folder / "a.ply").write_bytes(header.encode() + b"\3\0\0\0\1\0\2\0" + rows.tobytes())


def pcd(encoding: str) -> Callable[[Path], None]:
    """A PCD file."""
    from scanweld.io.pcd import write_pcd

    return lambda folder: write_pcd(folder / "a.pcd", cloud(), encoding=encoding)  # type: ignore[arg-type]


def las(name: str) -> Callable[[Path], None]:
    """A LAS or LAZ file."""
    return lambda folder: write_points(folder / name, PointCloud(cloud().points_m, colors=cloud().colors))


def e57(folder: Path) -> None:
    """Two scans as the tests write them."""
    import test_e57 as tests

    few = tests.POINTS[:8]
    scaled = {f"cartesian{axis}": ("scaled", few[:, k] + 5e5) for k, axis in enumerate("XYZ")}
    pose = {"rotation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}, "translation": {"x": 1.0, "y": 2.0, "z": 3.0}}
    tests.write(folder / "a.e57", tests.cartesian(few) | tests.colored(tests.COLORS[:8]) | {"pose": pose}, scaled)


def read_cloud(folder: Path) -> None:
    """Read each file as points."""
    for path in files_of(folder):
        read_points(path)


# --- text -------------------------------------------------------------------------------------------


def trajectories(folder: Path) -> None:
    """Each form of a trajectory."""
    T = sequences.poses(4)
    trajectory = sw.Trajectory(np.arange(4) / 30, T)
    write_tum(folder / "tum.txt", trajectory)
    write_kitti(folder / "kitti.txt", trajectory)
    write_redwood_log(folder / "redwood.log", trajectory)
    (folder / "packed.txt.gz").write_bytes(gzip.compress((folder / "tum.txt").read_bytes(), mtime=0))
    np.savetxt(folder / "pose.txt", T[1])


def read_trajectories(folder: Path) -> None:
    """Read each file in each form."""
    for path in files_of(folder):
        for form in ("auto", "tum", "kitti", "redwood"):
            tolerate(lambda path=path, form=form: read_trajectory(path, form))
        tolerate(lambda path=path: read_pose(path))
        tolerate(lambda path=path: read_transform(path))


def tolerate(read: Callable[[], object]) -> None:
    """Call, where an error is no end: others of the input are to be read, too."""
    try:
        read()
    except ScanweldError as error:
        check_message(error)


def check_message(error: ScanweldError) -> None:
    """Raise AssertionError when a message is not one line that can be printed."""
    text = str(error)
    assert text, "an error without a message"
    assert "\n" not in text, f"a message of several lines: {text!r}"


def config_seeds(folder: Path) -> None:
    """All settings, and lines of --set."""
    (folder / "config.toml").write_text(to_toml(sw.SlamConfig()), encoding="utf-8")
    (folder / "set.txt").write_text('tracking.stable_fraction=0.1\nseed=3\nmap.folder="/tmp/x"\na.b.c=[1, {x = 2}]\n')


def read_config(folder: Path) -> None:
    """Read a file of settings, and each line as one setting."""
    for path in files_of(folder):
        tolerate(lambda path=path: from_mapping(sw.SlamConfig, load_toml(path), str(path)))
        for line in path.read_bytes().decode("utf-8", "replace").splitlines()[:40]:
            tolerate(lambda line=line: from_mapping(sw.SlamConfig, parse_override(line)))


def imu_seeds(folder: Path) -> None:
    """A gyroscope and its axes."""
    (folder / "imu.txt").write_text(
        "# t wx wy wz\n" + "".join(f"{k / 100} 0.1 {k / 50} -0.2 0 0 9.8\n" for k in range(9))
    )
    (folder / "R_camera_imu.txt").write_text("1 0 0\n0 1 0\n0 0 1\n")


def read_turns(folder: Path) -> None:
    """Read a gyroscope, and where the camera was turned to."""
    if (gyroscope := read_gyroscope(folder)) is not None:
        gyroscope.orientations(np.array([-1.0, 0.0, 0.01, 0.033, 1e9]))


# --- sequences --------------------------------------------------------------------------------------


def read_sequence(folder: Path, *, format: str = "auto", is_file: bool = False) -> None:
    """Open a folder, or its only file, and read the frames."""
    for place in files_of(folder) if is_file else [folder]:
        sequence = open_sequence(place, format=format)
        for index in range(min(len(sequence), MAX_FRAMES)):
            try:
                frame = sequence.read(index)
            except UnreadableFrameError as error:
                check_message(error)
                continue
            assert frame.depth_m.shape == sequence.camera.shape
        assert len(sequence.timestamps_s) == len(sequence)


def sequence(format: str, *writers: Callable[[Path], object], is_file: bool = False) -> Target:
    """Return the target of a format, opened by name and by its looks."""
    named = functools.partial(read_sequence, format=format, is_file=is_file)

    def read(folder: Path) -> None:
        tolerate(lambda: named(folder))
        tolerate(lambda: read_sequence(folder, is_file=is_file))

    return Target(in_turn(*writers), read)


def tum_with_associations(folder: Path) -> None:
    """A TUM folder whose frames are in associations.txt."""
    sequences.write_tum(folder, 3, color_delay_s=0.0)
    names = [line.split() for line in (folder / "depth.txt").read_text().splitlines()[1:]]
    rows = [f"{time} rgb/{Path(depth).name} {time} {depth}" for time, depth in names]
    (folder / "associations.txt").write_text("\n".join(rows) + "\n")
    sequences.write_camera(folder)
    imu_seeds(folder)


def bag(version: int, storage: str, name: str) -> Callable[[Path], None]:
    """One file that is a bag."""

    def write(folder: Path) -> None:
        with tempfile.TemporaryDirectory() as aside:
            place = captures.write_bag(
                Path(aside) / "a.bag" if version == 1 else Path(aside) / "bag", version, 2, storage
            )
            content = place if version == 1 else next(place.glob(f"*{Path(name).suffix}"))
            (folder / name).write_bytes(content.read_bytes())

    return write


def icl_original(folder: Path) -> None:
    """ICL-NUIM as it is published: ray distances in text, cameras of POV-Ray."""
    import cv2

    for index in range(2):
        stem = folder / f"scene_00_{index:04d}"
        depth = sequences.depth_units(index, 100.0).astype(float)
        Path(f"{stem}.depth").write_text(" ".join(f"{value:g}" for value in depth.ravel()))
        assert cv2.imwrite(f"{stem}.png", sequences.color_rgb(index))
        Path(f"{stem}.txt").write_text(
            "cam_pos = [1, 2, 3]';\ncam_dir = [0, 0, 1]';\ncam_up = [0, 1, 0]';\ncam_lookat = [0, 0, 1]';\n"
            "cam_sky = [0, 1, 0]';\ncam_right = [1.33, 0, 0]';\ncam_fpoint = [0, 0, 10]';\ncam_angle = 90;\n"
        )


# --- messages ---------------------------------------------------------------------------------------


def message_seeds(folder: Path) -> None:
    """Messages as they lie in a bag, and planes as they lie in an archive."""
    with captures.BagWriter(folder / "x.bag", 1) as writer:
        written_messages: list[bytes] = []
        writer.writer.write = lambda connection, time, data: written_messages.append(data)  # type: ignore[method-assign]
        writer.image("/d", 1.0, "16UC1", sequences.depth_units(0, 1000))
        writer.compressed("/c", 1.0, "jpeg", b"\xff\xd8\xff\xd9")
        writer.info("/i", 1.0, (16, 12), captures.DEPTH_K, (0.1, 0.2))
        (folder / "x.bag").unlink(missing_ok=True)
    for name, data in zip(("image", "compressed", "info"), written_messages, strict=True):
        (folder / name).write_bytes(data)
    (folder / "plane").write_bytes(captures.record3d_files(1)["rgbd/0.depth"])


def read_messages(folder: Path) -> None:
    """Read each file as each kind of message."""
    for path in files_of(folder):
        data = path.read_bytes()
        for is_cdr in (False, True):
            for kind in (IMAGE, IMAGE.replace("Image", "CompressedImage")):
                tolerate(lambda d=data, k=kind, c=is_cdr: parse_image(d, k, is_cdr=c, where="x"))
            tolerate(lambda d=data, c=is_cdr: parse_camera_info(d, is_cdr=c, where="x"))
            tolerate(lambda d=data, c=is_cdr: read_stamp(d, is_cdr=c, where="x"))
        tolerate(lambda d=data: decompress_lzfse(d, 768, "x"))


def images_seeds(folder: Path) -> None:
    """Depth and colour."""
    sequences.write_frame(folder / "depth.png", folder / "color.png", 0, 1000)
    sequences.write_frame(folder / "d.png", folder / "color.jpg", 1, 1000)
    grey = sequences.color_rgb(0)[..., 0]
    sequences.write_image(folder / "grey.png", grey)


def read_images(folder: Path) -> None:
    """Read each file as depth and as colour."""
    from scanweld.datasets.images import read_color, read_depth_png, read_ray_distance_text

    for path in files_of(folder):
        for read in (lambda p: read_depth_png(p, (12, 16), 1000.0), lambda p: read_color(p, (12, 16)),
                     lambda p: read_ray_distance_text(p, (12, 16), 1.0)):  # fmt: skip
            tolerate(lambda path=path, read=read: read(path))


# --- runs -------------------------------------------------------------------------------------------


@functools.cache
def recording() -> sw.SyntheticSequence:
    """A few frames to run."""
    return sw.SyntheticSequence(sw.RenderConfig(width=48, height=36, noise="none", frames=4))


def checkpoint_seeds(folder: Path) -> None:
    """The checkpoint of a run that was interrupted after its third frame."""
    from scanweld.runs.folder import CHECKPOINT

    def stop(result: sw.FrameResult) -> None:
        if result.index == 2:
            raise KeyboardInterrupt

    nothing = mock.patch("scanweld.runs.run.write_run")
    with tempfile.TemporaryDirectory() as aside, nothing:
        sw.run_sequence(recording(), out=Path(aside) / "run", progress=None, observers=[Stopping(stop)])
        (folder / CHECKPOINT).write_bytes((Path(aside) / "run" / CHECKPOINT).read_bytes())


class Stopping:
    """Looks on, and interrupts."""

    def __init__(self, call: Callable[[sw.FrameResult], None]) -> None:
        self._call, self._stop = call, False

    def on_frame(self, slam: object, frame: object, result: sw.FrameResult) -> None:
        self._stop = result.index == 2

    def ready(self, timeout_s: float) -> bool:
        if self._stop:
            raise KeyboardInterrupt
        return True

    def on_end(self, slam: object) -> None:
        pass


def read_checkpoint(folder: Path) -> None:
    """Resume from it, for what is left of the run."""
    with mock.patch("scanweld.runs.run.write_run"):
        sw.run_sequence(recording(), out=folder, resume=True, checkpoint_every_s=0.0)


def run_seeds(folder: Path) -> None:
    """A run folder, small, of a sequence beside it."""
    few = runs.rows(4)
    sequences.write_tum(folder / "recorded", 3)
    runs.write_run_folder(folder, table=few, points=40, run={"input": "recorded", "fingerprint": {"content": "0"}})
    for picture in (folder / "renders").iterdir():
        picture.unlink()


def read_run(folder: Path) -> None:
    """Make the page, open the view, the sequence, the mesh's frames and the comparison."""
    from scanweld.report.page import make_page
    from scanweld.report.run_files import read_run_files
    from scanweld.runs.comparison import compare_runs
    from scanweld.runs.reopen import posed_frames, read_description, reopen_sequence

    tolerate(lambda: make_page(read_run_files(folder)))
    tolerate(lambda: posed_frames(folder))
    tolerate(lambda: compare_runs(folder, folder))
    tolerate(lambda: reopen_sequence(inside(folder, read_description(folder))))
    tolerate(lambda: look_at(folder))


def inside(folder: Path, run: Mapping[str, object]) -> Mapping[str, object]:
    """Return a description whose recording is that of the input, where it still names it."""
    return {**run, "input": str(folder / "recorded")} if run.get("input") == "recorded" else run


def look_at(folder: Path) -> None:
    """Open the view of a run without a server behind it."""
    names = ("start_server", "stop_server", "Scene", "_Timeline", "Panel")
    with mock.patch.multiple("scanweld.viewer.finished", **{name: mock.MagicMock() for name in names}):
        from scanweld.viewer import finished

        finished.start_server.return_value = (mock.MagicMock(), "http://127.0.0.1:1/")  # type: ignore[attr-defined]
        finished.FinishedView(folder)


TARGETS: dict[str, Target] = {
    "ply": Target(in_turn(ply_text, ply_big_endian, lambda f: write_points(f / "a.ply", cloud())), read_cloud),
    "pcd": Target(in_turn(pcd("ascii"), pcd("binary"), pcd("binary_compressed")), read_cloud),
    "tables": Target(
        in_turn(*(lambda f, name=name: write_points(f / name, cloud()) for name in ("a.csv", "a.xyz", "a.npy"))),
        read_cloud,
    ),
    "las": Target(in_turn(las("a.las"), las("a.laz")), read_cloud),
    "e57": Target(in_turn(e57), read_cloud),
    "trajectory": Target(in_turn(trajectories), read_trajectories),
    "config": Target(in_turn(config_seeds), read_config),
    "gyroscope": Target(in_turn(imu_seeds), read_turns),
    "images": Target(in_turn(images_seeds), read_images),
    "messages": Target(in_turn(message_seeds), read_messages),
    "sens": sequence(
        "scannet",
        lambda f: captures.write_sens(f / "a.sens", 3),
        lambda f: captures.write_sens(f / "a.sens", 2, color_compression=2, depth_compression=0, lost=(1,)),
        is_file=True,
    ),
    "record3d": sequence(
        "record3d",
        lambda f: captures.write_record3d(f / "a.r3d", captures.record3d_files(3)),
        lambda f: captures.write_record3d(f / "a.r3d", captures.record3d_files(2, compress=False)),
        is_file=True,
    ),
    "bag1": sequence("rosbag", bag(1, "", "a.bag"), is_file=True),
    "bag2-sqlite": sequence("rosbag", bag(2, "sqlite3", "a.db3"), is_file=True),
    "bag2-mcap": sequence("rosbag", bag(2, "mcap", "a.mcap"), is_file=True),
    "tum": sequence("tum", tum_with_associations, lambda f: sequences.write_tum(f, 3)),
    "eth3d": sequence("eth3d", lambda f: captures.write_eth3d(f, 3)),
    "redwood": sequence("redwood", lambda f: sequences.write_redwood(f, 3)),
    "7scenes": sequence("7scenes", lambda f: sequences.write_seven_scenes(f, (0, 1, 3))),
    "icl": sequence("icl", icl_original),
    "replica": sequence("replica", lambda f: captures.write_replica(f, 3, parameters=f)),
    "bundlefusion": sequence("bundlefusion", lambda f: captures.write_bundle_fusion(f, (0, 1, 2))),
    "stray": sequence("stray", lambda f: captures.write_stray(f, 3)),
    "video": sequence(
        "video",
        lambda f: captures.write_video_pair(f, 3),
        lambda f: captures.write_video_pair(f, 2, depth="depth", timestamps=[0.0, 0.04]),
    ),
    "checkpoint": Target(in_turn(checkpoint_seeds), read_checkpoint),
    "run": Target(in_turn(run_seeds), read_run),
}
"""Every parser by name."""
