"""A sequence that is rendered while it is read, and its configuration."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from scanweld.arrays import Array, Float32, Float64, UInt8
from scanweld.config import check_ranges, setting
from scanweld.datasets.synthetic.catalogue import SCENES, build_scene
from scanweld.datasets.synthetic.noise import NOISE_MODELS, degrade_color, degrade_depth
from scanweld.datasets.synthetic.paths import choose_path, path_names
from scanweld.datasets.synthetic.rendering import render_frame
from scanweld.errors import ConfigError
from scanweld.geometry.camera import PinholeCamera
from scanweld.geometry.frame import Frame
from scanweld.trajectory import Trajectory

logger = logging.getLogger(__name__)

DEPTH_SCALE = 5000.0
"""Units of the stored depth per metre, as in TUM RGB-D."""

STANDARD_CAMERA = PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480)
PATH_FRAMES = ("cv", "icl")


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderConfig:
    """What to render.

    Raises
    ------
    ConfigError
        When a value is out of range or a name is unknown.
    """

    scene: str = setting("room", "Scene: 'room', 'corridor' (a loop of rooms, 34 m around), 'twin-rooms' or 'wall'.")
    path: str = setting(
        "",
        "Camera path: built in (room: orbit, sweep; corridor: loop; twin-rooms: visit; wall: plain, brick) or a "
        "trajectory file; '': the scene's first.",
    )
    path_frame: str = setting("cv", "Axes of a trajectory file: 'cv' (y down), or 'icl' (ICL-NUIM, y up, fy = -480).")
    noise: str = setting("none", "Depth camera: 'none' (exact), 'kinect' or 'realsense'.")
    frames: int = setting(0, "Number of frames; 0 is one round of a built-in path, or all of a file.", low=0)
    width: int = setting(640, "Image width [px]; the focal length is 525 px at 640.", low=16, high=8192)
    height: int = setting(480, "Image height [px].", low=16, high=8192)
    fps: float = setting(30.0, "Frames per second [1/s]; a higher rate makes the steps smaller.", low=0.1, high=1000.0)
    seed: int = setting(0, "Seed of the noise and of small things in the scene.", low=0)

    def __post_init__(self) -> None:
        check_ranges(self)
        for name, choices in (("scene", SCENES), ("path_frame", PATH_FRAMES), ("noise", NOISE_MODELS)):
            value = getattr(self, name)
            if value not in choices:
                raise ConfigError(f"{name} = '{value}': expected one of {', '.join(choices)}")

    def resolved(self) -> RenderConfig:
        """Return this configuration with the name of the path that '' stands for, as records should have it."""
        return replace(self, path=self.path or path_names(self.scene)[0])

    def camera(self) -> PinholeCamera:
        """Return the camera: 525 pixels of focal length at 640 pixels of width, square pixels, centred."""
        if self.width * 3 == self.height * 4:
            return STANDARD_CAMERA.scaled(self.width / STANDARD_CAMERA.width)
        focal = STANDARD_CAMERA.fx * self.width / STANDARD_CAMERA.width
        return PinholeCamera(focal, focal, (self.width - 1) / 2, (self.height - 1) / 2, self.width, self.height)


class SyntheticSequence:
    """A rendered RGB-D sequence with exact ground truth; frames are rendered when they are read.

    It satisfies :class:`scanweld.datasets.base.RgbdSequence`. A frame depends on the configuration and its
    index alone, so any part of a sequence equals the same part of the whole. Depth has the steps of the
    16-bit files that :func:`scanweld.datasets.synthetic.render_sequence` writes, so both give the same run.

    Parameters
    ----------
    config : what to render; the default is the furnished room
    trajectory : the poses to render, where neither a built-in path nor a file has them; `config` then has no path,
        no number of frames, and its rate is not used

    Attributes
    ----------
    config : as it was given; `config.resolved()` names the path that '' stands for
    path_name : name of the built-in path, or of the file without its folder and endings
    name, camera, depth_scale, ground_truth, timestamps_s : as every sequence has them

    Raises
    ------
    ConfigError, FileFormatError, InvalidInputError
        When the path is unknown, cannot be read, or is too short, or poses are given beside a path.
    """

    def __init__(self, config: RenderConfig | None = None, *, trajectory: Trajectory | None = None) -> None:
        self.config = config or RenderConfig()
        c = self.config
        if trajectory is None:
            self.path_name, self._trajectory = choose_path(c.scene, c.path, c.path_frame, c.frames, c.fps)
        elif c.path or c.frames:
            raise ConfigError(f"path = '{c.path}', frames = {c.frames}: leave both out where the poses are given")
        else:
            self.path_name, self._trajectory = "given", trajectory
        self.name = f"{c.scene}-{self.path_name}" + ("" if c.noise == "none" else f"-{c.noise}")
        self.camera = c.camera()
        self.depth_scale = DEPTH_SCALE
        self._warned = False

    @property
    def ground_truth(self) -> Trajectory:
        """True T_world_camera of every frame."""
        return self._trajectory

    @property
    def timestamps_s(self) -> Float64:
        """Time of every frame (N,) [s]."""
        return self._trajectory.timestamps_s

    def __len__(self) -> int:
        return len(self._trajectory)

    def read(self, index: int) -> Frame:
        """Render frame `index`, 0 <= index < len(self)."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        color, depth = self.read_stored(index)
        depth_m = np.divide(depth, np.float32(DEPTH_SCALE), dtype=np.float32)
        return Frame(float(self.timestamps_s[index]), depth_m, color, self.camera)

    def __iter__(self) -> Iterator[Frame]:
        for index in range(len(self)):
            yield self.read(index)

    def exact(self, index: int) -> tuple[UInt8, Float32]:
        """Render frame `index` without noise and rounding: colour (H, W, 3) and depth (H, W) [m]."""
        scene = build_scene(self.config.scene, self.config.seed)
        color, depth_m = render_frame(scene, self.camera, self._trajectory.T_world_camera[index])
        if not self._warned and (depth_m == 0).mean() > 0.2:
            self._warned = True
            logger.warning("frame %d of %s looks out of the scene; wrong --path-frame or scene?", index, self.name)
        return color, depth_m

    def read_stored(self, index: int) -> tuple[UInt8, Array]:
        """Render frame `index` as files hold it: colour (H, W, 3) and depth (H, W) uint16, 5000 = 1 m."""
        color, depth_m = self.exact(index)
        model = NOISE_MODELS[self.config.noise]
        if model is not None:
            rng = np.random.default_rng([self.config.seed, index])
            depth_m = degrade_depth(depth_m, self.camera, model, rng)
            color = degrade_color(color, model, rng)
        units = np.rint(depth_m.astype(np.float64) * DEPTH_SCALE)
        return color, np.where(units < 65535, units, 0).astype(np.uint16)
