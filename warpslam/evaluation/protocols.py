"""The mesh of a run against the true surface, under named protocols."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpslam.evaluation.culling import DEFAULT_PROTOCOL, Culling, Views, check_protocol, sample_surface
from warpslam.evaluation.reconstruction import ReconstructionResult, evaluate_reconstruction, load_mesh
from warpslam.evaluation.virtual_views import virtual_culling_views, virtual_depth
from warpslam.spread import spread

if TYPE_CHECKING:
    import trimesh

    from warpslam.sequences.base import RgbdSequence

FRAME_COUNT = 60
TARGET_COUNT = 5_000


def evaluate_mesh(
    mesh_path: Path,
    truth_mesh: trimesh.Trimesh,
    sequence: RgbdSequence,
    frame_indices: list[int],
    poses: np.ndarray,
    *,
    protocols: Sequence[str] = (DEFAULT_PROTOCOL,),
    seed: int = 0,
    device: str | None = None,
) -> dict[str, ReconstructionResult]:
    """Reconstruction metrics of a mesh under each of the protocols, by the protocol's name.

    Args:
        mesh_path: Mesh to judge.
        truth_mesh: True surface [m], same world frame.
        sequence: Where the depth images come from.
        frame_indices: Frames that were used, N of them; 60, evenly spread, decide what counts.
        poses: Their true camera-to-world transforms, shape (N, 4, 4); estimated ones where the truth is unknown.
        protocols: Of `warpslam.evaluation.PROTOCOLS`.
        seed: Seed of the drawn points and views.
        device: Warp device; None for Warp's default.

    Raises:
        ConfigError: There is no such protocol.
        MeshError: A mesh can't be read or has no surface that counts.
    """
    for protocol in protocols:
        check_protocol(protocol)
    chosen = spread(len(frame_indices), FRAME_COUNT)
    depths = [sequence[frame_indices[position]].depth for position in chosen]
    frames = Views(poses[chosen], sequence.intrinsics, depths)
    mesh = load_mesh(mesh_path)
    results = {}
    for protocol in protocols:
        virtual = None
        if protocol.endswith("virtual"):
            targets, _ = sample_surface(truth_mesh, TARGET_COUNT, seed, culling=Culling(DEFAULT_PROTOCOL, frames))
            virtual = virtual_culling_views(truth_mesh, targets, frames, seed=seed, device=device)
        culling = Culling(protocol, frames, virtual)
        result = evaluate_reconstruction(mesh, truth_mesh, culling=culling, seed=seed)
        aligned = mesh.copy()
        aligned.apply_transform(result.T_truth_mesh)
        targets, _ = sample_surface(truth_mesh, TARGET_COUNT, seed, culling=culling)
        depth = virtual_depth(aligned, truth_mesh, targets, culling, seed=seed, device=device)
        results[protocol] = replace(result, virtual_depth=depth)
    return results
