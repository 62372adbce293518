"""A small random map with rays through it: more cases than the recorded scene has, and features that matter."""

from __future__ import annotations

import numpy as np
import torch

from tests.kernels.iteration import Rays
from tests.reference import oracle

LO, HI = np.array([-1.3, -0.9, -0.7]), np.array([1.7, 1.5, 1.9])
SHAPES = {"coarse": (4, 3, 5), "middle": (7, 6, 8), "fine": (12, 10, 11), "color": (11, 12, 9)}
# The coarse lattice reaches beyond the box, the colour lattice stays inside it, so that its lookups clamp.
REACH = {"coarse": 0.5, "middle": 0.0, "fine": 0.0, "color": -0.2}
FOCAL, CENTER = 60.0, 29.5


def random_field(seed: int, *, feature_std: float = 0.5, dtype: torch.dtype = torch.float64) -> oracle.Field:
    """Map of random features and weights, biases and all outputs nonzero; rows and colour weights require gradients.

    Values are float32 numbers whatever ``dtype`` is, so that the kernels start from the same ones.
    """
    rng = np.random.default_rng(seed)

    def normal(*shape: int, std: float) -> torch.Tensor:
        return torch.tensor(rng.normal(0.0, std, shape).astype(np.float32), dtype=dtype)

    grids, decoders = {}, {}
    for level in oracle.LEVELS:
        shape, reach = SHAPES[level], REACH[level]
        origin = (LO - reach).astype(np.float32)
        spacing = ((HI - LO + 2 * reach) / (np.array(shape) - 1)).astype(np.float32)
        rows = normal(int(np.prod(shape)), 32, std=feature_std).requires_grad_()
        grids[level] = oracle.Grid(torch.tensor(origin, dtype=dtype), torch.tensor(spacing, dtype=dtype), shape, rows)
        entry, condition = (32, 0) if level == "coarse" else (93, 64 if level == "fine" else 32)
        weights = {}
        for k in range(oracle.BLOCK_COUNT):
            size = entry if k == 0 else entry + 32 if k == oracle.SKIP_AFTER + 1 else 32
            weights[f"pts_linears.{k}.weight"] = normal(32, size, std=1.2 / np.sqrt(size))
            weights[f"pts_linears.{k}.bias"] = normal(32, std=0.1)
            if condition:
                weights[f"fc_c.{k}.weight"] = normal(32, condition, std=0.6 / np.sqrt(condition))
                weights[f"fc_c.{k}.bias"] = normal(32, std=0.1)
        if condition:
            weights["embedder._B"] = normal(3, 93, std=12.0)
        outputs = 4 if level == "color" else 1
        # Logits around -0.15: rays that pass most samples, so that every sample has weight and gradient.
        weights["output_linear.weight"] = normal(outputs, 32, std=0.1 if level == "color" else 0.01)
        weights["output_linear.bias"] = (
            normal(outputs, std=0.1) if level == "color" else torch.full((1,), -0.15).to(dtype)
        )
        decoders[level] = weights
    for weight in decoders["color"].values():
        weight.requires_grad_()
    lo, hi = (torch.tensor(bound.astype(np.float32), dtype=dtype) for bound in (LO, HI))
    return oracle.Field(lo, hi, grids, decoders)


def random_rays(seed: int, count: int = 40) -> tuple[Rays, np.ndarray, np.ndarray]:
    """Rays of two frames that look around from near the middle of the box, and their pixels (column, row).

    A quarter has no depth; some surfaces lie outside the box, so that the pre-filter drops their rays. Quaternions are
    not of unit length.
    """
    rng = np.random.default_rng(seed + 1000)
    poses = np.concatenate([rng.normal(0.0, 0.6, (2, 4)), rng.uniform(-0.15, 0.35, (2, 3))], axis=1)
    frame = np.repeat([0, 1], count // 2).astype(np.int32)
    column, row = rng.integers(0, 60, (2, count))
    depth = rng.uniform(0.2, 1.1, count)
    depth[::4] = 0.0
    depth[1::8] = 6.0
    rgb = rng.uniform(0.0, 1.0, (count, 3))
    rays = Rays.from_pixels(poses, frame, column, row, depth, rgb, FOCAL, FOCAL, CENTER, CENTER)
    return rays, column, row


def oracle_rays(rays: Rays, column, row, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pose vectors (frames, 7) that require gradients, and with them origins and directions (N, 3)."""
    poses = torch.tensor(rays.poses, dtype=dtype, requires_grad=True)
    parts = []
    for frame, pose in enumerate(poses):
        mine = rays.frame == frame
        pixels = torch.tensor(column[mine]), torch.tensor(row[mine])
        parts.append(oracle.rays_from_pose(pose, *pixels, FOCAL, FOCAL, CENTER, CENTER))
    origins, directions = (torch.cat(part) for part in zip(*parts, strict=True))
    return poses, origins, directions
