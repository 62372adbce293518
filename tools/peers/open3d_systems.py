"""Open3D on the CPU: its dense SLAM, its RGB-D odometry, and the Redwood pipeline that its wheel carries."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tools.peers.recording import STORED_SCALE, Account, Recording, fuse, stored_depth, write_mesh
from warpslam.sequences.pose_files import read_redwood_log

SLAM_VOXEL = 0.01  # [m]
TRUNCATION = 8.0  # [voxels]
BLOCKS = 40_000
LARGEST_STEP = 0.15  # [m]
FEWEST_INLIERS = 0.1


def slam(recording: Recording, account: Account, mesh: bool) -> None:
    """Frame-to-model tracking against a TSDF (``t.pipelines.slam.Model``), as Open3D's own dense SLAM example does it.

    With the failure check of its C++ twin: a frame with fitness below 0.1 or a step above 15 cm is lost, keeps the last
    pose and is not integrated.
    """
    import open3d as o3d

    core, image = o3d.core, o3d.t.geometry.Image
    odometry = o3d.t.pipelines.odometry
    device, K, T = core.Device("CPU:0"), core.Tensor(recording.intrinsics.matrix), core.Tensor(np.eye(4))
    height, width = recording.intrinsics.height, recording.intrinsics.width
    model = o3d.t.pipelines.slam.Model(SLAM_VOXEL, 16, BLOCKS, T, device)
    frame, seen = (o3d.t.pipelines.slam.Frame(height, width, K, device) for _ in range(2))
    method = odometry.Method.PointToPlane
    criteria = [odometry.OdometryConvergenceCriteria(count) for count in (6, 3, 1)]
    farthest = recording.depth_range
    with account.timed("tracking"):
        for number in range(len(recording)):
            now = recording[number]
            frame.set_data_from_image("depth", image(core.Tensor(stored_depth(now.depth))))
            frame.set_data_from_image("color", image(core.Tensor(now.rgb)))
            ok = True
            if number:
                try:
                    step = model.track_frame_to_model(frame, seen, STORED_SCALE, farthest, 0.07, method, criteria)
                    length = float(np.linalg.norm(step.transformation.numpy()[:3, 3]))
                    ok = step.fitness >= FEWEST_INLIERS and length < LARGEST_STEP
                except RuntimeError:  # a singular system
                    ok = False
                if ok:
                    T = T @ step.transformation
            model.update_frame_pose(number, T)
            if ok:
                model.integrate(frame, STORED_SCALE, farthest, TRUNCATION)
            model.synthesize_model_frame(seen, STORED_SCALE, 0.1, farthest, TRUNCATION, False)
            account.add(T.numpy(), ok)
    if mesh:
        with account.timed("mesh"):
            world = account.world_poses()[0] @ np.linalg.inv(account.poses[0])
            write_mesh(model.extract_trianglemesh(3.0).transform(core.Tensor(world)), account.out / "mesh.ply")


def odometry(recording: Recording, account: Account, mesh: bool) -> None:
    """Hybrid (colour and depth) odometry from frame to frame, chained."""
    import open3d as o3d

    core, image, pipeline = o3d.core, o3d.t.geometry.Image, o3d.t.pipelines.odometry
    K, start = core.Tensor(recording.intrinsics.matrix), core.Tensor(np.eye(4))
    criteria = [pipeline.OdometryConvergenceCriteria(count) for count in (10, 5, 3)]
    T, before = np.eye(4), None
    with account.timed("tracking"):
        for number in range(len(recording)):
            frame = recording[number]
            now = o3d.t.geometry.RGBDImage(image(core.Tensor(frame.rgb)), image(core.Tensor(frame.depth)))
            ok = True
            if before is not None:
                try:
                    step = pipeline.rgbd_odometry_multi_scale(
                        now, before, K, start, 1.0, recording.depth_range, criteria, pipeline.Method.Hybrid
                    )
                    ok = step.fitness >= FEWEST_INLIERS
                    T = T @ step.transformation.numpy() if ok else T
                except RuntimeError:
                    ok = False
            before = now
            account.add(T, ok)
    if mesh:
        with account.timed("mesh"):
            fuse(recording, account.world_poses(), account.out / "mesh.ply")


def redwood(recording: Recording, account: Account, mesh: bool) -> None:
    """The offline pipeline of Choi, Zhou, Koltun 2015 (``open3d/examples/reconstruction_system``), unchanged.

    Fragments of 100 frames with a pose graph each, registration of all pairs of fragments, global optimisation,
    refinement, integration, with the settings of its tutorial but for depth. A step that its odometry
    has no answer for is taken as none; no frame is called lost.
    """
    import cv2
    import open3d as o3d

    work = account.out / "dataset"
    for name in ("color", "depth"):
        (work / name).mkdir(parents=True, exist_ok=True)
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    for number in range(len(recording)):
        frame = recording[number]
        cv2.imwrite(str(work / f"color/{number:06d}.png"), frame.rgb[..., ::-1], fast)
        cv2.imwrite(str(work / f"depth/{number:06d}.png"), stored_depth(frame.depth), fast)
    k = recording.intrinsics
    camera = o3d.camera.PinholeCameraIntrinsic(k.width, k.height, k.fx, k.fy, k.cx, k.cy)
    o3d.io.write_pinhole_camera_intrinsic(str(work / "camera.json"), camera)
    settings = {
        "name": recording.sequence.name,
        "path_dataset": str(work),
        "path_intrinsic": str(work / "camera.json"),
        "depth_scale": STORED_SCALE,
        "depth_max": recording.depth_range,
        "voxel_size": 0.05,
        "depth_diff_max": 0.07,
        "preference_loop_closure_odometry": 0.1,
        "preference_loop_closure_registration": 5.0,
        "tsdf_cubic_size": 3.0,
        "icp_method": "color",
        "global_registration": "ransac",
        "python_multi_threading": False,
    }
    (work / "config.json").write_text(json.dumps(settings))
    # In Open3D 0.20 `ScalableTSDFVolume` yields no triangle for float depth.
    o3d.pipelines.integration.ScalableTSDFVolume = _Volume
    script = Path(o3d.__file__).parent / "examples/reconstruction_system/run_system.py"
    before = sys.argv
    sys.argv = [str(script), "--config", str(work / "config.json"), "--make", "--register", "--refine", "--integrate"]
    try:
        with account.timed("tracking"):
            runpy.run_path(str(script), run_name="__main__")
    finally:
        sys.argv = before
    account.remarks.append(_fragments(work / "fragments"))
    poses = read_redwood_log(work / "scene/trajectory.log", len(recording))
    for pose in poses:
        account.add(pose, bool(np.isfinite(pose).all()))
    if mesh:
        found = o3d.io.read_triangle_mesh(str(work / "scene/integrated.ply"))
        found.transform(account.world_poses()[0] @ np.linalg.inv(poses[0]))
        o3d.io.write_triangle_mesh(str(account.out / "mesh.ply"), found)


def _fragments(folder: Path) -> str:
    """What the pose graphs of the fragments say: how many, and how often odometry had no answer."""
    graphs = [json.loads(path.read_text()) for path in sorted(folder.glob("fragment_[0-9]*.json"))]
    steps = [edge for graph in graphs for edge in graph["edges"] if not edge["uncertain"]]
    failed = sum(bool(np.allclose(edge["transformation"], np.eye(4).ravel())) for edge in steps)
    return f"{len(graphs)} fragments, {failed} of {len(steps)} steps without odometry"


class _Volume:
    """Stands for Open3D's `ScalableTSDFVolume`, by a voxel block grid."""

    def __init__(self, voxel_length: float, sdf_trunc: float, color_type: Any) -> None:
        import open3d as o3d

        core = o3d.core
        self._limits = (1.0, 100.0, max(1.0, sdf_trunc / voxel_length))
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"), (core.float32, core.uint16, core.uint16), ((1,), (1,), (3,)), voxel_length,
            16, 10000, core.Device("CPU:0"),
        )  # fmt: skip

    def integrate(self, rgbd: Any, intrinsic: Any, extrinsic: np.ndarray) -> None:
        import open3d as o3d

        core, image = o3d.core, o3d.t.geometry.Image
        depth = image(core.Tensor(np.asarray(rgbd.depth)))
        color = image(core.Tensor(np.asarray(rgbd.color).astype(np.float32) / 255.0))
        K, T = core.Tensor(intrinsic.intrinsic_matrix), core.Tensor(np.ascontiguousarray(extrinsic))
        blocks = self._grid.compute_unique_block_coordinates(depth, K, T, *self._limits)
        self._grid.integrate(blocks, depth, color, K, K, T, *self._limits)

    def extract_triangle_mesh(self) -> Any:
        return self._grid.extract_triangle_mesh(0.5).to_legacy()
