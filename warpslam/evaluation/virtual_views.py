"""Virtual cameras: where they stand, what they look at, and how far off the depth of a reconstruction is there.

A camera stands in space that a frame saw to be free, anywhere in the box of the frames' cameras and of what they saw,
and looks at a point of the true surface that counts. The released code draws positions in a box set by hand and any
direction, and rejects a view that shows one of the points in a file that its authors made; here a pixel that shows true
surface that does not count, or none at all, is left out, and a view with more than 25 % of such pixels is rejected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.evaluation.culling import Culling, Views, visible_points

if TYPE_CHECKING:
    import trimesh

    from warpslam.synthetic import MeshRenderer

VIEW_COUNT = 100
# The field of view of the released code's virtual camera (500 px, f = 300 px), in fewer pixels.
CAMERA = Intrinsics(fx=76.8, fy=76.8, cx=63.5, cy=63.5, width=128, height=128)
MAX_UNSEEN_SHARE = 0.25
CULLING_VIEW_COUNT = 30
MAX_DEPTH = 20.0  # [m], of the released code
_DRAWS_PER_VIEW = 20
_CLEARANCE = 0.2  # [m] of a camera to what is behind it in a frame
_NEAREST_TARGET = 0.5  # [m]
_TEST_STRIDE = 8  # a few pixels are enough to reject a view


@dataclass(frozen=True)
class VirtualDepth:
    """Depth of a reconstruction against the true one, on virtual views."""

    l1: float | None
    """Mean |difference| [m] where the reconstruction has surface; None without a pixel to compare."""
    missed_share: float | None
    """Share, 0..1, of the pixels where it has none; None without a view."""
    l1_misses_as_zero: float | None
    """Mean |difference| [m] with depth 0 for a miss, as the released code counts; None without a view."""
    view_count: int
    """Views that were used."""
    drawn_count: int
    """Views that were drawn to find those."""


def virtual_poses(targets: np.ndarray, frames: Views, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw poses (count, 4, 4) of cameras in free space; fewer, or none, where hardly any space was seen to be free.

    Args:
        targets: Points of the surface to look at [m], shape (N, 3).
        frames: What the frames saw.
        count: Poses to draw.
        rng: Random numbers.
    """
    known = np.isfinite(frames.poses).all(axis=(1, 2))
    centers = frames.poses[known][:, :3, 3]
    ends = np.concatenate([centers, targets])
    lo, hi = ends.min(axis=0), ends.max(axis=0)
    down = frames.poses[known][:, :3, 1].mean(axis=0)
    eyes = np.zeros((0, 3))
    for _ in range(50):
        drawn = rng.uniform(lo, hi, (4 * count, 3))
        free = visible_points(drawn, frames.poses, frames.intrinsics, frames.depths, tolerance=-_CLEARANCE)
        eyes = np.concatenate([eyes, drawn[free]])[:count]
        if len(eyes) == count:
            break
    chosen = targets[rng.integers(0, len(targets), len(eyes))]
    far = np.linalg.norm(chosen - eyes, axis=1) >= _NEAREST_TARGET
    return np.array([_look_at(*pair, down) for pair in zip(eyes[far], chosen[far], strict=True)]).reshape(-1, 4, 4)


def virtual_culling_views(
    truth: trimesh.Trimesh, targets: np.ndarray, frames: Views, *, seed: int = 0, device: str | None = None
) -> Views:
    """Views of the virtual cameras that the third protocol adds; they have the frames' camera and the true depth."""
    poses = virtual_poses(targets, frames, CULLING_VIEW_COUNT, np.random.default_rng([seed, 1]))
    renderer = _renderer(truth, frames.intrinsics, device)
    return Views(poses, frames.intrinsics, [renderer.render(T)[1] for T in poses])


def virtual_depth(
    mesh: trimesh.Trimesh,
    truth: trimesh.Trimesh,
    targets: np.ndarray,
    culling: Culling,
    *,
    view_count: int | None = None,
    seed: int = 0,
    device: str | None = None,
) -> VirtualDepth:
    """Compare the depth of two meshes on virtual views. All of the reconstruction is shown, also what is culled else.

    Args:
        mesh: Reconstruction [m], aligned with the truth.
        truth: True surface [m].
        targets: Points of the true surface that count [m], shape (N, 3).
        culling: Which pixels of the true surface count.
        view_count: Views to use, 100 by default; fewer where they are hard to find.
        seed: Of the views.
        device: Warp device; None for Warp's default.
    """
    view_count = VIEW_COUNT if view_count is None else view_count
    rng = np.random.default_rng([seed, 2])
    test_camera = CAMERA.strided(_TEST_STRIDE)
    test_surface, true_surface = (_renderer(truth, camera, device) for camera in (test_camera, CAMERA))
    surface = _renderer(mesh, CAMERA, device)
    total = missed = zeroed = 0.0
    pixel_count = used = drawn = 0
    while used < view_count and drawn < _DRAWS_PER_VIEW * view_count:
        poses = virtual_poses(targets, culling.frames, view_count, rng)
        if len(poses) == 0:
            break
        for T_world_camera in poses[: _DRAWS_PER_VIEW * view_count - drawn]:
            drawn += 1
            test_depth = test_surface.render(T_world_camera)[1]
            if _counted(test_depth, test_camera, T_world_camera, culling).mean() < 1 - MAX_UNSEEN_SHARE:
                continue
            true_depth = true_surface.render(T_world_camera)[1]
            counted = _counted(true_depth, CAMERA, T_world_camera, culling)
            if counted.mean() < 1 - MAX_UNSEEN_SHARE:
                continue
            depth = surface.render(T_world_camera)[1][counted]
            error = np.abs(depth - true_depth[counted])
            total += float(error[depth > 0].sum())
            zeroed += float(error.sum())
            missed += float((depth == 0).sum())
            pixel_count += len(depth)
            used += 1
            if used == view_count:
                break
    hit = pixel_count - missed
    return VirtualDepth(
        l1=total / hit if hit else None,
        missed_share=missed / pixel_count if pixel_count else None,
        l1_misses_as_zero=zeroed / pixel_count if pixel_count else None,
        view_count=used,
        drawn_count=drawn,
    )


def _counted(depth: np.ndarray, camera: Intrinsics, T_world_camera: np.ndarray, culling: Culling) -> np.ndarray:
    """Which pixels of a true depth image (H, W) show surface that counts, bool (H, W)."""
    v, u = np.nonzero(depth)
    z = depth[v, u].astype(np.float64)
    local = camera.backproject(u, v, z)
    counted = np.zeros(depth.shape, dtype=bool)
    counted[v, u] = culling.keeps(local @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])
    return counted


def _look_at(eye: np.ndarray, target: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Camera at ``eye`` that looks at ``target``; its y axis leans to ``down``."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(down, forward)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(np.eye(3)[np.argmin(np.abs(forward))], forward)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T


def _renderer(mesh: trimesh.Trimesh, camera: Intrinsics, device: str | None) -> MeshRenderer:
    import trimesh

    from warpslam.synthetic import MeshRenderer

    bare = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return MeshRenderer(bare, camera, device=device, max_depth=MAX_DEPTH)
