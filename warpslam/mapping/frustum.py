"""What one frame sees: the box of its measurements, the grid vertices that it may change (A.1), and those at which it
has measured something.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.field.arrays import projection
from warpslam.kernels import frustum, seen
from warpslam.kernels.grid import Lattice
from warpslam.runtime.launching import Launcher
from warpslam.runtime.phases import phase

if TYPE_CHECKING:
    from warpslam.scene.feature_grid import FeatureGrid

REACH = 1.75
"""Of a measurement, behind its surface, in vertex spacings: the corners of the cell with the surface lie no farther."""


@phase("frustum selection")
def select_in_frustum(
    lattice: Lattice,
    rows: int,
    camera: Intrinsics,
    T_world_camera: np.ndarray,
    depth: wp.array,
    margin: float,
) -> np.ndarray:
    """Mask of the vertices in the frustum, bool (rows,); rows that are shared are not in it.

    Args:
        lattice: Lattice of the level.
        rows: Its rows in use.
        camera: Intrinsics of the depth image.
        T_world_camera: Pose of the frame (4, 4).
        depth: Depth image on the device [m], float32 (H, W).
        margin: Reach behind the surface and around the camera [m].
    """
    device = depth.device
    looked_up = wp.empty(rows, dtype=float, device=device)
    vertex_depth = wp.empty(rows, dtype=float, device=device)
    max_depth = wp.zeros(1, dtype=float, device=device)
    selected = wp.zeros(rows, dtype=wp.uint8, device=device)
    wp.launch(
        frustum.project_vertices,
        dim=rows - lattice.shared,
        inputs=[lattice, *projection(camera, T_world_camera), depth],
        outputs=[looked_up, vertex_depth, max_depth],
        device=device,
        record_tape=False,
    )
    wp.launch(
        frustum.select_vertices,
        dim=rows - lattice.shared,
        inputs=[lattice, wp.vec3(*T_world_camera[:3, 3]), margin, looked_up, vertex_depth, max_depth],
        outputs=[selected],
        device=device,
        record_tape=False,
    )
    return selected.numpy() != 0


def mark_seen(grid: FeatureGrid, camera: Intrinsics, T_world_camera: np.ndarray, depth: wp.array) -> None:
    """Mark the vertices in view that lie in front of a measured surface or no more than `REACH` behind it.

    Args:
        grid: `FeatureGrid.seen` becomes 1 there, and stays what it is elsewhere.
        camera, T_world_camera, depth: As in `select_in_frustum`.
    """
    mark_rows(grid, grid.lattice, grid.own_rows, camera, T_world_camera, depth, grid.seen)


def mark_rows(
    grid: FeatureGrid,
    lattice: Lattice,
    count: int,
    camera: Intrinsics,
    T_world_camera: np.ndarray,
    depth: wp.array,
    marks: wp.array,
) -> None:
    """The same of ``count`` rows that belong to one vertex each, of a lattice like that of the grid, into ``marks``."""
    inputs = [lattice, *projection(camera, T_world_camera), depth, REACH * grid.spacing, marks]
    Launcher(grid.device).spread(seen.mark_seen, count, inputs)


def measured_extent(
    depth: np.ndarray, T_world_camera: np.ndarray, camera: Intrinsics, stride: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Box of the camera and of everything it measures [m]: lower and upper corner, float64 (3,) each.

    Args:
        depth: Depth image [m], (H, W), 0 = missing.
        T_world_camera: Pose (4, 4).
        camera: Intrinsics of the image.
        stride: Rows and columns from one pixel looked at to the next.
    """
    v, u = np.nonzero(depth[::stride, ::stride])
    d = depth[::stride, ::stride][v, u].astype(np.float64)
    points = camera.backproject(u * stride, v * stride, d) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    points = np.concatenate([points, T_world_camera[None, :3, 3]])
    return points.min(axis=0), points.max(axis=0)
