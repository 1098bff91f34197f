"""What is drawn in the browser: the map in pieces, the path, the camera with its image, the loops."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import cv2
import numpy as np

from scanweld.arrays import Bool, Float32, Float64, UInt8
from scanweld.geometry import se3
from scanweld.geometry.camera import PinholeCamera
from scanweld.viewer.changes import Piece

IMAGE_WIDTH = 320
"""Width of the camera's image in the frustum at most [pixels]: it is drawn small, and sent again and again."""

TRACKED, LOST, LOOP = (42, 111, 219), (214, 59, 47), (232, 150, 20)
"""Colours of poses that were measured, of those that were not, and of loops."""

_PATH_STEP = 64
"""Poses of one line of the path: only the last of them grows."""

_FRUSTUM_M = 0.25


class Scene:
    """Draws into a viser server; a browser that comes later gets what there is by then.

    Everything is in the world frame. Parts that are replaced keep their names, and a browser that does not keep up
    gets only the newest of each.
    """

    def __init__(self, server: Any, *, point_size_m: float) -> None:
        self._server, self._scene = server, server.scene
        self._point_size_m = point_size_m
        self._pieces: dict[int, Any] = {}
        self._lines: dict[str, Any] = {}
        self._frustum: Any = None
        self._shape: tuple[float, float] = (0.0, 0.0)
        self._path_length = 0
        self._visible = {"path": True, "loops": True, "camera": True}

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self._server.get_clients())

    def together(self) -> contextlib.AbstractContextManager[None]:
        """Let a browser show all that is drawn within the block at once."""
        block: contextlib.AbstractContextManager[None] = self._server.atomic()
        return block

    def look(self, T_world_camera: Float64) -> None:
        """Stand new browsers behind a camera, with its upward direction up."""
        self._scene.set_up_direction(tuple(-T_world_camera[:3, 1]))
        eye, target = _behind(T_world_camera, back_m=1.5, up_m=0.7)
        start = self._server.initial_camera
        start.position, start.look_at = tuple(eye), tuple(target)
        start.up = tuple(-T_world_camera[:3, 1])

    def show_piece(self, piece: Piece) -> None:
        """Draw a piece of the map in place of the one with the same number."""
        if len(piece.positions_m) == 0:
            self._remove_piece(piece.number)
            return
        handle = self._pieces.get(piece.number)
        if handle is not None:  # a fifth of the time that a new one takes
            handle.points, handle.colors = piece.positions_m, piece.colors
            return
        self._pieces[piece.number] = self._scene.add_point_cloud(
            f"/map/{piece.number}", piece.positions_m, piece.colors, point_size=self._point_size_m,
            point_shape="circle", precision="float32", point_shading="flat",
        )  # fmt: skip

    def clear_map(self) -> None:
        """Draw nothing of the map."""
        for number in list(self._pieces):
            self._remove_piece(number)

    def set_point_size(self, size_m: float) -> None:
        """Draw points so large [m]."""
        if size_m == self._point_size_m:
            return
        self._point_size_m = size_m
        for handle in list(self._pieces.values()):
            handle.point_size = size_m

    def set_visible(self, part: str, visible: bool) -> None:
        """Show or hide "path", "loops" or "camera"."""
        if visible == self._visible[part]:
            return
        self._visible[part] = visible
        for name, handle in self._lines.items():
            if name.startswith(f"/{part}"):
                handle.visible = visible
        if part == "camera" and self._frustum is not None:
            self._frustum.visible = visible

    def show_camera(self, T_world_camera: Float64, camera: PinholeCamera, *, lost: bool = False) -> None:
        """Draw the camera, with the image that it had."""
        shape = 2 * math.atan(camera.height / (2 * camera.fy)), camera.width / camera.height
        wxyz = _wxyz(T_world_camera)
        position, color = tuple(T_world_camera[:3, 3].tolist()), LOST if lost else TRACKED
        if self._frustum is None or shape != self._shape:
            self._shape = shape
            self._frustum = self._scene.add_camera_frustum(
                "/camera", *shape, scale=_FRUSTUM_M, thickness=2.0, thickness_units="screen", color=color,
                jpeg_quality=80, wxyz=wxyz, position=position, visible=self._visible["camera"],
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            return
        self._frustum.wxyz, self._frustum.position = wxyz, position
        if self._frustum.color != color:
            self._frustum.color = color

    def show_image(self, image: UInt8 | None) -> None:
        """Draw an image (H, W, 3) RGB of any size in the camera that is shown; None leaves the one before."""
        if image is not None:
            self._frustum.image = smaller(image)

    def show_path(self, positions_m: Float64, lost: Bool, *, anew: bool = False) -> None:
        """Draw the path through camera centres (N, 3), of which some (N,) were not measured.

        What was drawn of it before is taken to be its beginning, unless `anew` says that it moved.
        """
        first = 0 if anew or len(positions_m) < self._path_length else max(0, self._path_length - 1) // _PATH_STEP
        for part in range(first, max(1, -(-(len(positions_m) - 1) // _PATH_STEP))):
            piece = slice(part * _PATH_STEP, (part + 1) * _PATH_STEP + 1)
            points = positions_m[piece].astype(np.float32)
            segments = np.stack([points[:-1], points[1:]], axis=1)
            colors = np.where(lost[piece][1:, None], LOST, TRACKED).astype(np.uint8)
            self._draw_lines(f"/path/{part}", segments, np.stack([colors, colors], axis=1), width=2.5)
        for part in range(-(-(len(positions_m) - 1) // _PATH_STEP), -(-(self._path_length - 1) // _PATH_STEP)):
            self._remove_lines(f"/path/{part}")
        self._path_length = len(positions_m)

    def show_loops(self, starts_m: Float64, ends_m: Float64) -> None:
        """Draw loops between places (L, 3)."""
        segments = np.stack([starts_m, ends_m], axis=1).astype(np.float32).reshape(-1, 2, 3)
        self._draw_lines("/loops", segments, np.full((len(segments), 2, 3), LOOP, np.uint8), width=2.0)

    def follow(self, T_world_camera: Float64, *, rate: float) -> None:
        """Move the eyes of all browsers a part of the way, `rate` 0..1, to behind and above a camera."""
        eye, target = _behind(T_world_camera, back_m=1.2, up_m=0.5)
        for client in self._server.get_clients().values():
            before_eye, before_target = client.camera.position, client.camera.look_at
            with client.atomic():
                client.camera.position = before_eye + rate * (eye - before_eye)
                client.camera.look_at = before_target + rate * (target - before_target)

    def _draw_lines(self, name: str, segments: Float32, colors: UInt8, *, width: float) -> None:
        if len(segments) == 0:
            self._remove_lines(name)
            return
        handle = self._lines.get(name)
        if handle is not None:
            handle.points, handle.colors = segments, colors
            return
        part = name.split("/")[1]
        self._lines[name] = self._scene.add_line_segments(
            name, segments, colors, thickness=width, thickness_units="screen", visible=self._visible[part]
        )

    def _remove_lines(self, name: str) -> None:
        handle = self._lines.pop(name, None)
        if handle is not None:
            handle.remove()

    def _remove_piece(self, number: int) -> None:
        handle = self._pieces.pop(number, None)
        if handle is not None:
            handle.remove()


def smaller(image: UInt8) -> UInt8:
    """Return an image of at most `IMAGE_WIDTH` columns: means of 2 x 2 pixels, an odd row or column left out."""
    while image.shape[1] > IMAGE_WIDTH:  # by two is ten times as fast as by any other number
        height, width = image.shape[0] // 2, image.shape[1] // 2
        image = np.asarray(cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA))
    return image


def _wxyz(T_world_camera: Float64) -> tuple[float, ...]:
    x, y, z, w = se3.quaternion_xyzw_from_rotation(T_world_camera[:3, :3]).tolist()
    return (w, x, y, z)


def _behind(T_world_camera: Float64, *, back_m: float, up_m: float) -> tuple[Float64, Float64]:
    """Return where to stand behind a camera, and a place before it to look at."""
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    return t - R[:, 2] * back_m - R[:, 1] * up_m, t + R[:, 2] * 1.5
