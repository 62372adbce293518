"""Registration of back-projected depth images as LiDAR odometry does it: KISS-ICP, and small_gicp against a voxel map.

Depth only; the mesh is TSDF fusion at the poses found. Both are made for metres of LiDAR range; what has to be scaled
to a room is scaled: voxels of 2.5 cm, points of every second pixel, first search radius 10 cm.
"""

from __future__ import annotations

import os

import numpy as np

from tools.peers.recording import Account, Recording, fuse

VOXEL = 0.025  # [m]
STRIDE = 2
SEARCH_RADIUS = 0.1  # [m]
FEWEST_INLIERS = 0.1
"""A frame with a smaller share of its points on the map is lost."""


def kiss_icp(recording: Recording, account: Account, mesh: bool) -> None:
    """KISS-ICP (Vizzo et al. 2023)."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = 1.3 * recording.depth_range, 0.1, False
    config.mapping.voxel_size = VOXEL
    config.adaptive_threshold.initial_threshold, config.adaptive_threshold.min_motion_th = SEARCH_RADIUS, 0.005
    icp = KissICP(config)
    with account.timed("tracking"):
        for number in range(len(recording)):
            icp.register_frame(recording.points(number, STRIDE), np.zeros(0))
            account.add(icp.last_pose)
    _mesh(recording, account, mesh)


def small_gicp(recording: Recording, account: Account, mesh: bool) -> None:
    """small_gicp (Koide 2024) against a Gaussian voxel map that keeps everything."""
    import small_gicp as gicp

    T, step = np.eye(4), np.eye(4)
    model = gicp.GaussianVoxelMap(2 * VOXEL)
    model.set_lru(horizon=1_000_000, clear_cycle=1_000_000)
    threads = os.cpu_count() or 1
    with account.timed("tracking"):
        for number in range(len(recording)):
            points, _ = gicp.preprocess_points(recording.points(number, STRIDE), VOXEL, 10, threads)
            ok = True
            if number:
                found = gicp.align(
                    model, points, T @ step, max_correspondence_distance=SEARCH_RADIUS, num_threads=threads
                )
                ok = found.num_inliers > FEWEST_INLIERS * points.size()
                new = found.T_target_source if ok else T
                step, T = np.linalg.inv(T) @ new, new
            if ok:
                model.insert(points, T)
            account.add(T, ok)
    _mesh(recording, account, mesh)


def _mesh(recording: Recording, account: Account, wanted: bool) -> None:
    if wanted:
        with account.timed("mesh"):
            fuse(recording, account.world_poses(), account.out / "mesh.ply")
