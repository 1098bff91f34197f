"""Open3D's dense SLAM on a rendered sequence; run in a process of its own, it needs Open3D and NumPy alone.

    python open3d_peer.py SEQUENCE

The tensor pipeline of its `t.pipelines.slam` example: TSDF blocks, voxels of 5.8 mm, frame-to-model odometry. Prints
one JSON object; the time is that of tracking, integration and ray casting, without decoding.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

VOXEL_M = 0.0058


def run(folder: Path) -> dict[str, Any]:
    """Return frames, ms of each, and the estimated camera centres."""
    import open3d as o3d

    about = json.loads((folder / "camera.json").read_text(encoding="utf-8"))
    scale, size = about["depth_scale"], (about["height"], about["width"])
    core, slam, device = o3d.core, o3d.t.pipelines.slam, o3d.core.Device("CPU:0")
    K = core.Tensor([[about["fx"], 0, about["cx"]], [0, about["fy"], about["cy"]], [0, 0, 1.0]], core.float64)
    model = slam.Model(VOXEL_M, 16, 40000, core.Tensor(np.eye(4)), device)
    frame, raycast = slam.Frame(*size, K, device), slam.Frame(*size, K, device)
    pose, centres, milliseconds = np.eye(4), [], []
    rows = [line.split() for line in (folder / "associations.txt").read_text(encoding="utf-8").splitlines()]
    for index, (_, color_name, _, depth_name) in enumerate(rows):
        depth = o3d.t.io.read_image(str(folder / depth_name))
        color = o3d.t.io.read_image(str(folder / color_name))
        start = time.perf_counter()
        frame.set_data_from_image("depth", depth)
        frame.set_data_from_image("color", color)
        if index > 0:
            pose = pose @ model.track_frame_to_model(frame, raycast, scale, 8.0, 0.07).transformation.numpy()
        model.update_frame_pose(index, core.Tensor(pose))
        model.integrate(frame, scale, 8.0, 8.0)
        model.synthesize_model_frame(raycast, scale, 0.1, 8.0, 8.0, False)
        milliseconds.append(1e3 * (time.perf_counter() - start))
        centres.append(pose[:3, 3].tolist())
    return {"version": o3d.__version__, "ms": milliseconds, "centres_m": centres}


if __name__ == "__main__":
    print(json.dumps(run(Path(sys.argv[1]))))
